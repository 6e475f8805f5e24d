"""Recorded detections as CSV (spec dmhe-sporadic-fov 3.3)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mhe.sporadic.recordings import read_positions, read_readings, write_positions, write_readings
from problems.errors import ReadError, ShapeError, WriteError

TIMES = 0.1 * np.arange(7)  # not exact in binary, as recorded times are not


def recorded() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    detected = rng.random((7, 3, 2)) < 0.4
    return detected, np.where(detected[..., None], rng.normal(size=(7, 3, 2, 2)), np.nan)


def read(path: Path, text: str) -> tuple[np.ndarray, np.ndarray]:
    path.write_text("time,sensor,vehicle,x,y\n" + text)
    return read_readings(path, TIMES, sensors=3, vehicles=2)


def test_round_trip_to_the_last_bit(tmp_path: Path) -> None:
    detected, readings = recorded()
    write_readings(tmp_path / "r.csv", TIMES, detected, readings)
    flags, values = read_readings(tmp_path / "r.csv", TIMES, 3, 2)
    np.testing.assert_array_equal(flags, detected)
    np.testing.assert_array_equal(values, readings)
    positions = np.random.default_rng(2).normal(size=(7, 2, 2))
    write_positions(tmp_path / "p.csv", TIMES, positions)
    np.testing.assert_array_equal(read_positions(tmp_path / "p.csv", TIMES, 2), positions)


def test_what_is_not_there_was_not_detected(tmp_path: Path) -> None:
    flags, values = read(tmp_path / "r.csv", "0.30000001,2,1,4.5,-1\n\n0,3,2,1,2\n")
    assert np.argwhere(flags).tolist() == [[0, 2, 1], [3, 1, 0]]
    assert values[3, 1, 0].tolist() == [4.5, -1]
    assert np.isnan(values[~flags]).all()


def test_a_repeated_message_counts_once(tmp_path: Path) -> None:
    flags, _ = read(tmp_path / "r.csv", "0.2,1,1,3,4\n0.2,1,1,3.0,4\n")
    assert flags.sum() == 1


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("0.1,1,1,0,0\n0.1,1,1,0,1\n", 3, r"one reading per time, sensor and vehicle \(another one is in line 2\)"),
        ("0.1,4,1,0,0\n", 2, "a sensor from 1 to 3; found '4'"),
        ("0.1,1,0,0,0\n", 2, "a vehicle from 1 to 2; found '0'"),
        ("0.1,1,1.5,0,0\n", 2, "a vehicle from 1 to 2; found '1.5'"),
        ("0.15,1,1,0,0\n", 2, "an instant of the sampling"),
        ("0.7,1,1,0,0\n", 2, "the last one 0.6 s"),
        ("-0.1,1,1,0,0\n", 2, "an instant of the sampling"),
        ("0.1,1,1,0\n", 2, r"5 fields \(time,sensor,vehicle,x,y\); found 4"),
        ("0.1,1,1,0,0\n\n0.2,1,1,nan,0\n", 4, r"a finite number as x \(m\); found 'nan'"),
        ("0.1,1,1,0,inf\n", 2, r"a finite number as y \(m\)"),
        ("now,1,1,0,0\n", 2, r"a finite number as time \(s\)"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, line: int, message: str) -> None:
    with pytest.raises(ReadError, match=message) as caught:
        read(tmp_path / "r.csv", text)
    assert caught.value.line == line
    assert f"r.csv:{line}: " in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="No such file"):
        read_readings(tmp_path / "no.csv", TIMES, 3, 2)
    (tmp_path / "h.csv").write_text("time,vehicle,sensor,x,y\n")
    with pytest.raises(ReadError, match="the header time,sensor,vehicle,x,y; found time,vehicle,sensor"):
        read_readings(tmp_path / "h.csv", TIMES, 3, 2)
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(ReadError, match="an empty file"):
        read_readings(tmp_path / "empty.csv", TIMES, 3, 2)
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ReadError, match="expected a CSV file"):
        read_readings(tmp_path / "binary.csv", TIMES, 3, 2)
    with pytest.raises(WriteError, match="no/r.csv"):
        write_readings(tmp_path / "no" / "r.csv", TIMES, *recorded())


def test_a_truth_with_gaps(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("time,vehicle,x,y\n0,1,0,0\n0,2,0,0\n0.1,1,0,0\n")
    with pytest.raises(ReadError, match="none of 2 at 0.1 s"):
        read_positions(tmp_path / "p.csv", TIMES, 2)


def test_shapes_that_do_not_fit(tmp_path: Path) -> None:
    detected, readings = recorded()
    with pytest.raises(ShapeError):
        write_readings(tmp_path / "r.csv", TIMES[1:], detected, readings)
    with pytest.raises(ShapeError):
        write_positions(tmp_path / "p.csv", TIMES, np.zeros((7, 2)))
