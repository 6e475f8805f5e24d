"""MRCLAM folders: counts and values against an independent reading, the set's traps, bad input."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from localization.io import mrclam
from localization.io.samples import team_sample
from problems.errors import ReadError

Find = Callable[[str], Path]


def table(file: Path) -> list[list[str]]:
    return [line.split() for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]


def test_set_seven_equals_the_files(real_data: Find) -> None:
    folder = real_data("mrclam7")
    team = mrclam.read(folder)
    subject_of = {code: int(subject) for subject, code in table(folder / "Barcodes.dat")}
    marks = table(folder / "Landmark_Groundtruth.dat")
    assert team.robots.tolist() == [1, 2, 3, 4, 5] and team.landmark_subjects.tolist() == [int(row[0]) for row in marks]
    assert team.truth is not None
    known = 0
    for k in range(5):
        odometry = table(folder / f"Robot{k + 1}_Odometry.dat")
        assert len(team.odometry[k]) == len(odometry)
        np.testing.assert_array_equal(
            team.odometry[k].value[::997], [[float(v) for v in r[1:]] for r in odometry[::997]]
        )
        assert team.odometry[k].time[100] == pytest.approx(float(odometry[100][0]) - team.start, abs=1e-6)
        assert len(team.truth[k]) == len(table(folder / f"Robot{k + 1}_Groundtruth.dat"))
        sightings = [row for row in table(folder / f"Robot{k + 1}_Measurement.dat") if row[1] in subject_of]
        known += len(sightings)
        own = team.observer == k
        subjects = np.concatenate([team.robots, team.landmark_subjects])[team.subject[own]]
        assert subjects.tolist() == [subject_of[row[1]] for row in sightings]
        np.testing.assert_array_equal(team.range_bearing[own, 0], [float(row[2]) for row in sightings])
    rows = sum(len(table(folder / f"Robot{k}_Measurement.dat")) for k in range(1, 6))
    assert len(team.sighting_time) == known and team.dropped == rows - known > 0
    assert (np.diff(team.sighting_time) >= 0).all()
    # sightings point where the truth says: wrong only if barcodes were taken for subjects
    nodes = 5 + len(team.landmarks)
    assert team.subject.max() < nodes
    to_marks = np.flatnonzero((team.subject >= 5) & (team.observer == 0))
    truth = team.truth[0]
    place = np.column_stack([np.interp(team.sighting_time[to_marks], truth.time, c) for c in truth.value[:, :2].T])
    distance = np.linalg.norm(team.landmarks[team.subject[to_marks] - 5] - place, axis=1)
    assert np.median(np.abs(distance - team.range_bearing[to_marks, 0])) < 0.1


@pytest.fixture
def folder(samples: dict[str, Path], tmp_path: Path) -> Path:
    shutil.copytree(samples["mrclam"], tmp_path / "team")
    return tmp_path / "team"


def test_sample_reads_back_as_it_was_made(tmp_path: Path) -> None:
    made, codes = team_sample(np.random.default_rng(3))
    mrclam.write(tmp_path, made, codes)
    read = mrclam.read(tmp_path)
    assert read.dropped == 0 and made.truth is not None and read.truth is not None
    for a, b in zip(made.odometry + made.truth, read.odometry + read.truth, strict=True):
        np.testing.assert_allclose(a.time, b.time, atol=1e-6)
        np.testing.assert_allclose(a.value, b.value, atol=1e-12)
    order = np.lexsort((read.subject, read.observer, np.round(read.sighting_time, 3)))
    np.testing.assert_array_equal(made.subject, read.subject[order])
    np.testing.assert_array_equal(made.observer, read.observer[order])
    np.testing.assert_allclose(made.range_bearing, read.range_bearing[order])
    # a robot sees where things are
    truth = made.truth[0].value[np.searchsorted(made.truth[0].time, made.sighting_time - 1e-6)]
    to_marks = (made.subject >= 2) & (made.observer == 0)
    angle = truth[to_marks, 2] + made.range_bearing[to_marks, 1]
    seen = truth[to_marks, :2] + made.range_bearing[to_marks, :1] * np.column_stack([np.cos(angle), np.sin(angle)])
    assert np.abs(seen - made.landmarks[made.subject[to_marks] - 2]).max() < 0.6


def test_traps(folder: Path) -> None:
    before = mrclam.read(folder)
    # stamps that go backwards are put in order; unknown codes and one's own are dropped and counted
    file = folder / "Robot1_Odometry.dat"
    lines = file.read_text().split("\n")
    lines[10], lines[11] = lines[11], lines[10]
    file.write_text("\n".join(lines))
    own = next(row[1] for row in table(folder / "Barcodes.dat") if row[0] == "2")
    with (folder / "Robot2_Measurement.dat").open("a") as stream:
        stream.write(f"1200000029.9\t999 \t 1.0 \t 0.1 \n1200000029.9\t{own}\t1.0\t0.1\n")
    after = mrclam.read(folder)
    np.testing.assert_array_equal(before.odometry[0].time, after.odometry[0].time)
    np.testing.assert_array_equal(before.odometry[0].value, after.odometry[0].value)
    assert after.dropped == 2 and len(after.subject) == len(before.subject)
    for k in (1, 2):
        (folder / f"Robot{k}_Groundtruth.dat").unlink()
    assert mrclam.read(folder).truth is None


@pytest.mark.parametrize(
    ("name", "line", "text", "expected"),
    [
        ("Robot1_Odometry.dat", 5, "1200000000.4 0.1", "3 numbers"),
        ("Robot1_Odometry.dat", 5, "1200000000.4 0.1 x", "a number"),
        ("Robot1_Odometry.dat", 5, "1200000000.4 0.1 nan", "finite"),
        ("Robot2_Measurement.dat", 3, "1200000000.4 5 1", "4 numbers"),
        ("Robot2_Groundtruth.dat", 3, "1200000000.4 5 1 inf", "finite"),
        ("Barcodes.dat", 3, "1 88", "subject not used before; found 1, also in line 2"),
        ("Barcodes.dat", 3, "2.5 88", "whole number"),
        ("Landmark_Groundtruth.dat", 3, "6 1 1 0 0", "also in line 2"),
        ("Landmark_Groundtruth.dat", 3, "2 1 1 0 0", "a subject that is no robot"),
        ("Landmark_Groundtruth.dat", 3, "7 1 1 -1 0", "not negative"),
        ("Landmark_Groundtruth.dat", 3, "7 1 1", "5 numbers"),
    ],
)
def test_bad_rows_are_named(folder: Path, name: str, line: int, text: str, expected: str) -> None:
    lines = (folder / name).read_text().split("\n")
    lines[line - 1] = text
    (folder / name).write_text("\n".join(lines))
    with pytest.raises(ReadError, match=expected) as caught:
        mrclam.read(folder)
    assert caught.value.path == folder / name and caught.value.line == line


def test_two_wearers_of_one_code_and_none(folder: Path) -> None:
    rows = table(folder / "Barcodes.dat")
    (folder / "Barcodes.dat").write_text(f"1 {rows[0][1]}\n2 {rows[0][1]}\n")
    with pytest.raises(ReadError, match="barcode not used before"):
        mrclam.read(folder)
    (folder / "Barcodes.dat").write_text("\n".join(" ".join(row) for row in rows[:-1]))
    with pytest.raises(ReadError, match=f"a barcode for subject {rows[-1][0]}"):
        mrclam.read(folder)


@pytest.mark.parametrize(
    "name",
    [
        "Barcodes.dat",
        "Landmark_Groundtruth.dat",
        "Robot2_Odometry.dat",
        "Robot1_Measurement.dat",
        "Robot1_Groundtruth.dat",
    ],
)
def test_missing_and_empty_files_are_named(folder: Path, name: str) -> None:
    (folder / name).write_text("# Time\n")
    with pytest.raises(ReadError, match="comments only"):
        mrclam.read(folder)
    (folder / name).unlink()
    with pytest.raises(ReadError, match="existing file") as caught:
        mrclam.read(folder)
    assert caught.value.path.name == name


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="Odometry"):
        mrclam.read(tmp_path)
