"""UWB folders: counts and values against an independent reading, scoring against the published figures, bad input."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from localization.io import TimeSeries, UwbRecording, uwb_labyrinth, uwb_outdoor
from localization.io.scoring import align, ate, rmse_2d, scoring_window, uwb_scores
from problems.errors import DataError, ReadError, SettingError

CASES = ("uwb-outdoor/los-trajectory_a-case_1", "uwb-outdoor/nlos-trajectory_a-case_1")
Find = Callable[[str], Path]


def raw(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("case", CASES)
def test_outdoor_ranges_equal_the_files(real_data: Find, case: str) -> None:
    folder = real_data(case)
    recording = uwb_outdoor.read(folder)
    assert recording.anchor_names == ("A3", "A5", "A9", "A12")
    assert (np.diff(recording.time) >= 0).all()
    for k, name in enumerate(recording.anchor_names):
        rows = sorted(raw(folder / f"{name}.csv"), key=lambda row: int(row["field.stamp"]))
        own = recording.anchor == k
        assert own.sum() == len(rows)
        np.testing.assert_array_equal(recording.ranges[own], [float(row["field.distanceFromTag"]) for row in rows])
        stamps = [int(row["field.stamp"]) - recording.start for row in rows]
        assert np.rint(recording.time[own] * 1e9).astype(np.int64).tolist() == stamps
        np.testing.assert_array_equal(recording.anchors[k], [float(rows[0][f"field.{axis}"]) for axis in "xyz"])


@pytest.mark.parametrize("case", CASES)
def test_outdoor_truth_fixes_and_published_tracks(real_data: Find, case: str) -> None:
    folder = real_data(case)
    recording = uwb_outdoor.read(folder)
    assert recording.truth is not None and recording.heading is not None and recording.gnss is not None
    rows = raw(folder / "trajectory.csv")
    assert len(recording.truth) == len(rows)
    stamps = [int(Decimal(row["timestamp"])) - recording.start for row in rows]
    assert np.rint(recording.truth.time * 1e9).astype(np.int64).tolist() == stamps
    # heading follows the motion, so its convention (counter-clockwise from +x) is the project's
    moved = recording.truth.value[8:, :2] - recording.truth.value[:-8, :2]
    fast = np.linalg.norm(moved, axis=1) > 0.8
    turn = np.exp(1j * (np.arctan2(moved[:, 1], moved[:, 0]) - recording.heading[4:-4]))[fast]
    assert abs(np.angle(turn.mean())) < 0.1
    assert (np.abs(recording.heading) <= np.pi).all()
    # the fixes are the truth in another frame: a rotation of 19.0 to 19.7 degrees (spec) and a lever arm apart
    fixes = raw(folder / "gnss.csv")
    assert len(recording.gnss) == len(fixes)
    assert recording.gnss.covariance is not None
    assert recording.gnss.covariance[5, 0, 0] == float(fixes[5]["field.position_covariance0"])
    at = np.column_stack([np.interp(recording.truth.time, recording.gnss.time, c) for c in recording.gnss.value.T])
    good = np.abs(recording.truth.value[:, 2]) < 0.5
    rotation, _ = align(at[good, :2], recording.truth.value[good, :2])
    assert 18.5 < abs(np.rad2deg(np.arctan2(rotation[1, 0], rotation[0, 0]))) < 20.2
    assert ate(at[good, :2], recording.truth.value[good, :2]) < 0.5
    for method in ("LS", "ESKF"):
        assert len(recording.published[method.lower()]) == len(raw(folder / f"{method}.csv"))
    assert (np.diff(recording.published["eskf"].time) == 0).any()  # rows repeated in the file are kept


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("method", ["ls", "eskf"])
def test_published_figures_are_reproduced(real_data: Find, case: str, method: str) -> None:
    recording = uwb_outdoor.read(real_data(case))
    assert uwb_scores(recording, recording.published[method]) == pytest.approx(recording.figures[method], abs=1e-6)


def test_anchors_of_the_two_cases_are_swapped(real_data: Find) -> None:
    one, other = (uwb_outdoor.read(real_data(case)).anchors for case in CASES)
    np.testing.assert_array_equal(one[0], other[1])
    np.testing.assert_array_equal(one[1], other[0])


def test_labyrinth_wheels_follow_the_truth(real_data: Find) -> None:
    recording = uwb_labyrinth.read(real_data("uwb-labyrinth"))
    assert recording.truth is not None and recording.odometry is not None
    assert len(recording.time) == len(recording.odometry) == len(recording.truth) == 233
    assert recording.anchors.shape == (4, 2) and recording.range_variance is not None
    np.testing.assert_allclose(recording.range_variance, 0.01)
    # integrating the twist reproduces the track only with the wheels the right way round and the right width
    heading = np.concatenate([[0.0], np.cumsum(np.diff(recording.odometry.time) * recording.odometry.value[1:, 2])])
    step = np.diff(recording.odometry.time) * recording.odometry.value[1:, 0]
    middle = (heading[1:] + heading[:-1]) / 2
    track = np.cumsum(np.column_stack([step * np.cos(middle), step * np.sin(middle)]), axis=0)
    assert ate(track, recording.truth.value[1:]) < 0.1
    assert recording.odometry.covariance is not None
    np.linalg.cholesky(recording.odometry.covariance)


def test_labyrinth_covariance_is_that_of_the_wheels(tmp_path: Path) -> None:
    (tmp_path / "X_Input.txt").write_text(
        "range2 0.1 2.0 0.01 0 0 7 0\nodom2diff 0.1 1.0 3.0 0.5 0.25 0.04 0.16 0.09\nrange2 0.2 1.0 0.02 1 0 8 0\n"
    )
    recording = uwb_labyrinth.read(tmp_path)
    assert recording.odometry is not None and recording.odometry.covariance is not None and recording.truth is None
    np.testing.assert_allclose(recording.odometry.value, [[2.0, 0.5, 4.0]])
    wheels = np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0], [-2.0, 2.0, 0.0]])
    np.testing.assert_allclose(recording.odometry.covariance[0], wheels @ np.diag([0.04, 0.16, 0.09]) @ wheels.T)
    assert recording.anchor.tolist() == [0, 1]


def test_sample_reads_back_as_it_was_made(tmp_path: Path) -> None:
    from localization.io.samples import uwb_sample

    made = uwb_sample(np.random.default_rng(3))
    uwb_outdoor.write(tmp_path / "x-trajectory_a", made)
    read = uwb_outdoor.read(tmp_path / "x-trajectory_a")
    assert made.truth is not None and read.truth is not None
    order = np.lexsort((read.anchor, read.time))
    np.testing.assert_allclose(read.time[order] + (read.start - made.start) / 1e9, made.time, atol=1e-9)
    np.testing.assert_array_equal(read.ranges[order], made.ranges)
    np.testing.assert_array_equal(read.anchors, made.anchors)
    np.testing.assert_array_equal(read.truth.value, made.truth.value)
    again = uwb_sample(np.random.default_rng(3))
    np.testing.assert_array_equal(again.ranges, made.ranges)
    # the truth itself, at the tag's height, scores zero
    series = TimeSeries(made.truth.time, made.truth.value + [0, 0, made.tag_height])
    assert uwb_scores(made, series) == pytest.approx({"rmse_2d": 0, "rmse": 0}, abs=1e-12)
    # ranges are what the anchors see of the tag, up to noise, bias and the blocked 2 %
    tag = np.column_stack([np.interp(made.time, made.truth.time, c) for c in made.truth.value.T]) + [0, 0, 1]
    error = made.ranges - np.linalg.norm(tag - made.anchors[made.anchor], axis=1)
    assert 0.0 < np.median(error) < 0.25 and 0.005 < (error < -0.6).mean() < 0.05


def test_windows() -> None:
    x = np.array([0.0, 49.4, 49.5, 30.0, 11.0, 11.0, 11.0, 8.0, 9.0, 8.0])
    y = np.array([0.0, -6.0, 0.0, 0.0, 0.0, 4.0, -8.0, -8.0, -8.0, -8.0])
    truth = TimeSeries(np.arange(10.0), np.column_stack([x, y, np.zeros(10)]))

    def recording(trajectory: str | None, truth: TimeSeries | None = truth) -> UwbRecording:
        empty = np.zeros(0)
        return UwbRecording("x", np.zeros((1, 3)), ("A1",), empty, empty, empty, trajectory=trajectory, truth=truth)

    assert scoring_window(recording("A")) == (2.0, 5.0)
    assert scoring_window(recording("B")) == (7.0, 8.0)
    assert scoring_window(recording(None)) == (0.0, 9.0)
    with pytest.raises(DataError, match="never enters"):
        scoring_window(recording("A", TimeSeries(truth.time[3:], truth.value[3:])))
    with pytest.raises(DataError, match="never leaves"):
        scoring_window(recording("A", TimeSeries(truth.time[:4], truth.value[:4])))
    with pytest.raises(DataError, match="needs truth"):
        scoring_window(recording("A", None))
    # truth is taken at the estimate's times; a truth row too high is left out before
    high = truth.value.copy()
    high[3] = (1000.0, 1000.0, 0.5)
    estimate = TimeSeries(np.array([1.5, 2.5, 3.5, 5.5]), np.array([[0, 0], [50.0, 0.0], [11.0, 0.0], [0, 0]]))
    at = [np.interp([2.5, 3.5], [2, 4, 5], [49.5, 11, 11]), np.zeros(2)]
    expected = rmse_2d(estimate.value[1:3], np.column_stack(at))
    assert uwb_scores(recording("A", TimeSeries(truth.time, high)), estimate) == {"rmse_2d": pytest.approx(expected)}
    with pytest.raises(DataError, match="from 2.0 s to 5.0 s"):
        uwb_scores(recording("A"), TimeSeries(estimate.time[:3], estimate.value[:3]))
    with pytest.raises(DataError, match="finite"):
        uwb_scores(recording("A"), TimeSeries(estimate.time, np.full((4, 2), np.nan)))


@pytest.mark.parametrize("dimension", [2, 3])
def test_alignment_undoes_a_rigid_motion_and_never_mirrors(dimension: int) -> None:
    rng = np.random.default_rng(5)
    truth = rng.normal(size=(30, dimension))
    turn, _ = np.linalg.qr(rng.normal(size=(dimension, dimension)))
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    moved = truth @ turn.T + rng.normal(size=dimension)
    rotation, translation = align(moved, truth)
    np.testing.assert_allclose(moved @ rotation.T + translation, truth, atol=1e-12)
    assert ate(moved, truth) < 1e-12
    mirrored = truth * np.r_[-1.0, np.ones(dimension - 1)]
    assert np.linalg.det(align(mirrored, truth)[0]) == pytest.approx(1)
    assert ate(mirrored, truth) > 0.1
    assert ate(2 * truth, truth) > 0.1  # no scale
    # nothing near the optimum is better
    noisy = moved + 0.1 * rng.normal(size=moved.shape)
    best = ate(noisy, truth)
    rotation, translation = align(noisy, truth)
    for _ in range(20):
        skew = 0.01 * rng.normal(size=(dimension, dimension))
        nearby = np.linalg.qr(rotation @ (np.eye(dimension) + skew - skew.T))[0]
        nearby *= np.sign(np.diag(nearby.T @ rotation))
        off = noisy @ nearby.T + translation + 0.01 * rng.normal(size=dimension) - truth
        assert np.sqrt((off**2).sum(axis=1).mean()) >= best


def test_errors_of_positions() -> None:
    assert rmse_2d(np.array([[3.0, 4.0, 9.0], [0.0, 0.0, 0.0]]), np.zeros((2, 2))) == pytest.approx(np.sqrt(12.5))
    for estimate, truth in ((np.zeros((2, 2)), np.zeros((3, 2))), (np.zeros((0, 2)), np.zeros((0, 2)))):
        with pytest.raises(DataError):
            rmse_2d(estimate, truth)
    with pytest.raises(DataError, match="row 1"):
        ate(np.array([[0, 0], [np.nan, 0]]), np.zeros((2, 2)))


@pytest.fixture
def outdoor(samples: dict[str, Path], tmp_path: Path) -> Path:
    folder = tmp_path / samples["uwb_outdoor"].name
    shutil.copytree(samples["uwb_outdoor"], folder)
    header = "%time,field.header.stamp,field.status.status,field.latitude,field.longitude,field.altitude,"
    header += ",".join(f"field.position_covariance{k}" for k in range(9)) + ",field.position_covariance_type"
    first = "1,1700000000100000000,2,37.5,127.0,50,1,0,0,0,1,0,0,0,4,2"
    second = "1,1700000001100000000,2,37.50001,127.0,50,1,0,0,0,1,0,0,0,4,2"
    (folder / "gnss.csv").write_text(f"{header}\n{first}\n{second}\n")
    (folder / "LS.csv").write_text("timestamp,x,y,z\n1700000000100000000,1,2,3\n")
    (folder / "published-rmse.txt").write_text("LS RMSE: 1.5 m\nLS RMSE_2d: 1.25\n")
    return folder


def edit(file: Path, line: int, old: str, new: str) -> None:
    lines = file.read_text().split("\n")
    assert old in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new)
    file.write_text("\n".join(lines))


def test_small_outdoor_folder(outdoor: Path) -> None:
    recording = uwb_outdoor.read(outdoor)
    assert recording.trajectory == "A" and uwb_outdoor.read(outdoor, trajectory="b").trajectory == "B"
    assert recording.figures == {"ls": {"rmse": 1.5, "rmse_2d": 1.25}}
    assert recording.gnss is not None and recording.gnss_origin == (37.5, 127.0, 50.0)
    np.testing.assert_allclose(recording.gnss.value, [[0, 0, 0], [0, 1.11, 0]], atol=2e-3)
    np.testing.assert_allclose(recording.gnss.time, [0.1, 1.1], atol=1e-9)
    with pytest.raises(SettingError, match="A or B"):
        uwb_outdoor.read(outdoor, trajectory="C")
    # a receiver without fix writes NaN: left out; an unknown covariance is NaN
    with (outdoor / "gnss.csv").open("a") as stream:
        stream.write("1,1700000002100000000,-1,nan,nan,nan,0,0,0,0,0,0,0,0,0,0\n")
        stream.write("1,1700000003100000000,0,37.5,127.0,50,0,0,0,0,0,0,0,0,0,0\n")
    recording = uwb_outdoor.read(outdoor)
    assert recording.gnss is not None and recording.gnss.covariance is not None and len(recording.gnss) == 3
    assert np.isnan(recording.gnss.covariance[2]).all()
    for name in ("gnss.csv", "LS.csv", "published-rmse.txt", "trajectory.csv"):
        (outdoor / name).unlink()
    recording = uwb_outdoor.read(outdoor)
    assert recording.truth is recording.heading is recording.gnss is recording.gnss_origin is None
    assert recording.published == recording.figures == {}


def test_floating_stamps_are_exact_to_the_text(outdoor: Path) -> None:
    lines = (outdoor / "trajectory.csv").read_text().split("\n")
    stamp = int(lines[2].split(",")[0])
    assert stamp == 1_700_000_000_125_000_000
    lines[2] = lines[2].replace(str(stamp), "1.700000000125000123e+18")
    (outdoor / "trajectory.csv").write_text("\r\n".join(lines))
    recording = uwb_outdoor.read(outdoor)
    assert recording.truth is not None
    assert recording.truth.time[1] == pytest.approx((1_700_000_000_125_000_123 - recording.start) / 1e9, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "line", "old", "new", "expected"),
    [
        ("A3.csv", 1, "field.stamp", "stamp", "field.stamp"),
        ("A3.csv", 3, "1700", "17x0", "nanoseconds"),
        ("A3.csv", 3, "1700", "-1700", "nanoseconds"),
        ("A3.csv", 3, ",3,", ",", "7 fields"),
        ("A3.csv", 4, ",2.6,", ",2.7,", "one anchor position"),
        ("A3.csv", 4, ",2.6,", ",nan,", "finite"),
        ("A3.csv", 4, ",2.6,", ",2_6,", "a number"),
        ("trajectory.csv", 3, "0.0", "inf", "finite"),
        ("trajectory.csv", 3, "0.0", "", "a number"),
        ("trajectory.csv", 3, "1700000000125", "1600000000125", "increase"),
        ("LS.csv", 2, ",3", "", "4 fields"),
        ("LS.csv", 2, ",3", ",1e999", "finite"),
        ("gnss.csv", 2, "37.5", "97.5", "latitude"),
        ("gnss.csv", 2, "37.5", "nan", "latitude"),
        ("gnss.csv", 3, "1,0,0,0,1", "1,2,0,2,1", "positive definite"),
        ("gnss.csv", 3, "1,0,0,0,1", "1,2,0,0,1", "symmetric"),
        ("published-rmse.txt", 2, "1.25", "small", "a number"),
        ("published-rmse.txt", 2, "RMSE_2d", "error", "a line such as"),
    ],
)
def test_bad_outdoor_rows_are_named(outdoor: Path, name: str, line: int, old: str, new: str, expected: str) -> None:
    edit(outdoor / name, line, old, new)
    with pytest.raises(ReadError, match=expected) as caught:
        uwb_outdoor.read(outdoor)
    assert caught.value.path == outdoor / name and caught.value.line == line


def test_bad_outdoor_files_are_named(outdoor: Path) -> None:
    (outdoor / "A5.csv").write_text("")
    with pytest.raises(ReadError, match="empty file"):
        uwb_outdoor.read(outdoor)
    (outdoor / "A5.csv").write_text((outdoor / "A3.csv").read_text().split("\n")[0] + "\n")
    with pytest.raises(ReadError, match="header only"):
        uwb_outdoor.read(outdoor)
    (outdoor / "A5.csv").write_bytes(b"a,b\n\xff\xfe\n")
    with pytest.raises(ReadError, match="UTF-8") as caught:
        uwb_outdoor.read(outdoor)
    assert caught.value.line == 2
    for file in outdoor.glob("A*.csv"):
        file.unlink()
    with pytest.raises(ReadError, match="at least one anchor file"):
        uwb_outdoor.read(outdoor)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("range2 0.2 1.0", "range2 0.2", "7 numbers"),
        ("0.02 1 0 8", "0.02 1 0 8.5", "whole number"),
        ("0.02 1 0 8", "0 1 0 8", "positive variance"),
        ("0.02 1 0 8", "0.02 1 0 7", "one position per module"),
        ("range2 0.2", "range3 0.2", "starting with"),
        ("range2 0.2", "range2 nan", "finite"),
    ],
)
def test_bad_labyrinth_rows_are_named(tmp_path: Path, old: str, new: str, expected: str) -> None:
    text = "range2 0.1 2.0 0.01 0 0 7 0\nrange2 0.2 1.0 0.02 1 0 8 0\n"
    (tmp_path / "X_Input.txt").write_text(text.replace(old, new))
    with pytest.raises(ReadError, match=expected) as caught:
        uwb_labyrinth.read(tmp_path)
    assert caught.value.line == 2
