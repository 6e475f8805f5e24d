"""`horizonet localize` as people and programs meet it, on a generated recording."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from localization.io import uwb_outdoor
from localization.io.poses import read_poses, read_tum
from localization.scenarios.recording import scenario
from problems.cli.main import app
from problems.solvers.base import Status

FAST = ("--set", "horizon=3", "--set", "iterations=1")


@pytest.fixture(scope="module")
def folder(samples: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample with published figures, in a folder whose name needs quoting."""
    copy = tmp_path_factory.mktemp("with space") / samples["uwb_outdoor"].name
    shutil.copytree(samples["uwb_outdoor"], copy)
    (copy / "published-rmse.txt").write_text("LS RMSE_2d: 2.0\nESKF RMSE_2d: 4.0\n")
    return copy


def localize(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["localize", *map(str, words)])


def answer(*words: str | Path, code: int = 0) -> dict:
    result = localize(*words, "--json")
    assert result.exit_code == code, result.output
    return json.loads(result.stdout)


def test_json_is_the_object_of_the_contract(folder: Path) -> None:
    found = answer(folder, "--method", "mhe", "--method", "ls", *FAST)
    assert list(found) == ["scenario", "seed", "trials", "settings", "rows"]
    assert (found["scenario"], found["seed"], found["trials"]) == ("recording", 0, 1)
    assert found["settings"] | {"path": str(folder), "horizon": 3} == found["settings"]
    assert set(found["settings"]) == set(scenario.settings.model_fields)
    assert [(row["method"], row["solver"]) for row in found["rows"]] == [("mhe", "auto"), ("ls", "auto")]
    for row in found["rows"]:
        assert list(row) == [
            "scenario", "method", "solver", "settings", "options", "metrics", "metrics_se", "time", "status",
            "reproduce",
        ]  # fmt: skip
        assert list(row["metrics"]) == list(scenario.metrics)
        known = {name for name, value in row["metrics"].items() if isinstance(value, float)}
        assert known == {"rmse_2d", "ratio_to_eskf", "ratio_to_ls", "objective", "keyframes", "measurements"}
        assert row["metrics"]["ratio_to_ls"] == pytest.approx(row["metrics"]["rmse_2d"] / 2)
        assert row["metrics_se"] == {}
        assert list(row["time"]) == ["compile", "setup", "update", "solve", "step_median", "step_p95"]
        assert row["time"]["step_median"] <= row["time"]["step_p95"] < row["time"]["solve"]
        assert list(row["status"]) == [status.value for status in Status]
        assert sum(row["status"].values()) == row["metrics"]["keyframes"]


@pytest.mark.serial
def test_the_reproduce_line_gives_the_row_again(folder: Path, tmp_path: Path) -> None:
    words = [folder, "--method", "fixed_lag", "--seed", "7", "--set", "gps_rate=2", "--set", "delay=0.3"]
    (row,) = answer(*words, *FAST, "--set", "start=[-2.5, -4]", "--out", tmp_path / "p.csv")["rows"]
    result = CliRunner().invoke(app, [*shlex.split(row["reproduce"])[1:], "--json"])
    assert result.exit_code == 0, result.output
    (again,) = json.loads(result.stdout)["rows"]
    for key in ("settings", "options", "metrics", "status", "reproduce"):
        assert again[key] == row[key]


@pytest.mark.serial
def test_standard_output_of_the_process_is_one_json_object(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "problems.cli", "localize", str(folder), "--json", *FAST]
    command += ["--out", str(tmp_path / "p.csv"), "--plot", str(tmp_path / "p.png")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.count("\n") == 1
    assert json.loads(done.stdout)["rows"][0]["metrics"]["rmse_2d"] < 2
    assert f"poses of mhe: {tmp_path / 'p.csv'}" in done.stderr
    assert f"picture: {tmp_path / 'p.png'}" in done.stderr


def test_people_get_a_table(folder: Path) -> None:
    result = localize(folder, *FAST)
    assert result.exit_code == 0
    head = next(line for line in result.stdout.splitlines() if "rmse_2d" in line)
    assert head.split()[:5] == ["method", "solver", "rmse_2d", "ratio_to_eskf", "ratio_to_ls"]
    assert "mhe" in result.stdout
    assert "100 %" in result.stdout


def test_poses_carry_the_stamps_of_the_recording(folder: Path, tmp_path: Path) -> None:
    recording = uwb_outdoor.read(folder)
    assert recording.truth is not None
    rows = answer(folder, "--method", "mhe", "--method", "ls", *FAST, "--out", tmp_path / "p.csv")["rows"]
    poses = read_poses(tmp_path / "p.csv")
    time = poses.time - recording.start * 1e-9
    assert len(poses) == rows[0]["metrics"]["keyframes"]
    assert time[0] == pytest.approx(recording.time[0], abs=1e-6)
    np.testing.assert_allclose(np.diff(time), 0.1, atol=1e-6)
    assert set(poses.keys) == {"tag"}
    assert np.isnan(poses.orientation).all()
    assert poses.covariance is not None
    assert np.isnan(poses.covariance[:, 2]).all()
    assert (np.linalg.eigvalsh(poses.covariance[:, :2, :2]) > 0).all()
    at = np.column_stack([np.interp(time, recording.truth.time, c) for c in recording.truth.value.T[:2]])
    assert np.sqrt(np.mean(np.sum((poses.position - at) ** 2, axis=1))) < 1.5
    answer(folder, *FAST, "--out", tmp_path / "p.tum")
    tum = read_tum(tmp_path / "p.tum")
    np.testing.assert_allclose(tum.time, poses.time)
    np.testing.assert_allclose(tum.position[:, :2], poses.position)


@pytest.mark.parametrize(("name", "magic"), [("p.png", b"\x89PNG"), ("p.svg", b"<?xml"), ("p.PDF", b"%PDF")])
def test_a_picture_is_drawn(folder: Path, tmp_path: Path, name: str, magic: bytes) -> None:
    result = localize(folder, *FAST, "--plot", tmp_path / name)
    assert result.exit_code == 0, result.output
    assert (tmp_path / name).read_bytes().startswith(magic)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--method", "mh"], "unknown method of recording 'mh'; did you mean mhe"),
        (["--solver", "gauss-newtn"], "unknown solver 'gauss-newtn'; did you mean gauss-newton"),
        (["--set", "horizn=3"], "unknown setting of recording 'horizn'; did you mean horizon"),
        (["--set", "horizon=many"], "horizon of recording cannot be 'many'"),
        (["--set", "horizon"], "KEY=VALUE"),
        (["--set", "path=elsewhere"], "the recording is the argument"),
        (["--set", "trajectory=B"], "never enters the scoring window of trajectory B"),
        (["--out", "no/such/folder/p.csv"], "cannot write to no/such/folder/p.csv: its folder does not exist"),
        (["--out", "p.xml"], "poses are written as .csv, .tum or .g2o"),
        (["--out", "p.g2o"], "poses of a UWB recording are written as .csv or .tum"),
        (["--set", "chart=plain"], "setting chart means nothing for a UWB recording; those that do: horizon"),
        (["--plot", "no/such/folder/p.png"], "its folder does not exist"),
        (["--plot", "p.bmpp"], "pictures are written as"),
        (["--seed", "-1"], "seed"),
    ],
)
def test_what_cannot_be_done_ends_with_code_2_before_any_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], told: str
) -> None:
    def worked(*arguments: object) -> None:
        raise AssertionError("a method was run")

    monkeypatch.setattr("problems.bench.measure.measure", worked)
    result = localize(folder, *words)
    assert result.exit_code == 2
    assert told in " ".join(result.stderr.replace("│", " ").split())
    assert result.stdout == ""


def test_paths_that_cannot_be_read_name_file_and_what_was_expected(
    folder: Path, samples: dict[str, Path], tmp_path: Path
) -> None:
    missing = localize(tmp_path / "nothing")
    assert missing.exit_code == 2
    assert f"{tmp_path / 'nothing'}: expected an existing file or folder" in missing.stderr
    (tmp_path / "empty").mkdir()
    unknown = localize(tmp_path / "empty")
    assert unknown.exit_code == 2
    assert "expected one of the known layouts" in unknown.stderr
    assert "A<number>.csv" in unknown.stderr
    broken = tmp_path / "broken-trajectory_a"
    shutil.copytree(folder, broken)
    lines = (broken / "A3.csv").read_text().splitlines()
    lines[4] = lines[4][: len(lines[4]) // 2]
    (broken / "A3.csv").write_text("\n".join(lines) + "\n")
    malformed = localize(broken)
    assert malformed.exit_code == 2
    assert "A3.csv:5: expected" in malformed.stderr
    team = localize(samples["mrclam"], "--method", "ml")
    assert team.exit_code == 2
    assert "method 'ml' cannot localize a team recording (mrclam); possible: mhe" in team.stderr
    for result in (missing, unknown, malformed, team):
        assert result.stdout == ""


def test_a_method_the_solver_cannot_take_fails_alone_and_says_why(folder: Path) -> None:
    result = localize(folder, "--solver", "osqp", "--method", "ls", "--method", "mhe", *FAST)
    assert result.exit_code == 1
    assert result.stderr.count("solver 'osqp' takes quadratic programs only") == 2
    assert "horizonet run recording --method ls --solver osqp" in result.stderr


def test_warnings_reach_the_person(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive7"
    shutil.copytree(folder, path)
    result = localize(path, *FAST, "--json")
    assert result.exit_code == 0
    assert "--set trajectory=A or B" in result.stderr
    assert json.loads(result.stdout)["rows"][0]["metrics"]["ratio_to_eskf"] is None


def test_too_few_anchors_at_the_start_say_what_to_do(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "two-trajectory_a"
    shutil.copytree(folder, path, ignore=shutil.ignore_patterns("A3.csv", "A9.csv"))
    result = localize(path, *FAST)
    assert result.exit_code == 1
    assert "only A5, A12 are heard" in result.stderr
    assert "--set 'start=[x, y]'" in result.stderr
    assert localize(path, *FAST, "--set", "start=[-2.5, -4]").exit_code == 0


def test_help_tells_where_the_settings_are(folder: Path) -> None:
    result = localize("--help")
    assert result.exit_code == 0
    assert "horizonet scenarios recording" in " ".join(result.stdout.replace("│", " ").split())
    listed = CliRunner().invoke(app, ["scenarios", "recording"])
    assert listed.exit_code == 0
    for name in scenario.settings.model_fields:
        assert name in listed.stdout


def test_teams_start_at_what_they_see_and_get_a_file_per_robot(samples: dict[str, Path], tmp_path: Path) -> None:
    words = ("--out", tmp_path / "p.csv", "--plot", tmp_path / "p.png")
    (row,) = answer(samples["mrclam"], *words)["rows"]
    (near,) = answer(samples["mrclam"], "--set", "start=truth", "--out", tmp_path / "p.tum")["rows"]
    assert row["method"] == "mhe" and row["options"]["start"] == "ranges"
    assert near["metrics"]["rmse_2d"] <= row["metrics"]["rmse_2d"] + 0.05 < 0.6
    errors = row["options"]["rmse_2d_by_robot"]
    assert row["metrics"]["rmse_2d"] == pytest.approx(np.mean(list(errors.values())))
    poses = read_poses(tmp_path / "p.csv")
    assert len(poses) == row["metrics"]["keyframes"]
    assert poses.covariance is not None and (np.linalg.eigvalsh(poses.covariance) > 0).all()
    for robot in errors:
        mine = read_tum(tmp_path / f"p-robot{robot}.tum")
        assert len(mine) == np.sum(poses.keys == f"robot{robot}")
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_wheel_odometry_is_used_where_there_is_some(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    anchors, folder = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, -1.0]]), tmp_path / "wheels"
    folder.mkdir()
    lines, truth = [], []
    for k in range(200):
        t, anchor = 0.1 * k, anchors[k % 3]
        place = np.array([np.cos(0.3 * t), np.sin(0.3 * t)])
        distance = np.linalg.norm(place - anchor) + 0.1 + 0.03 * rng.normal()
        lines.append(f"range2 {t} {distance} 0.01 {anchor[0]} {anchor[1]} {k % 3} 0")
        lines.append(f"odom2diff {t} {0.3 - 0.03} {0.3 + 0.03} 0.0 0.1 0.01 0.01 0.01")
        truth.append(f"point2 {t} {place[0]} {place[1]} 0 0 0 0")
    (folder / "X_Input.txt").write_text("\n".join(lines) + "\n")
    (folder / "X_GT.txt").write_text("\n".join(truth) + "\n")
    rows = answer(folder, "--method", "ml", "--method", "mhe", "--plot", tmp_path / "p.png")["rows"]
    batch, causal = (row["metrics"]["rmse_2d"] for row in rows)
    assert batch < 0.05 < 0.5 and batch < causal < 0.5
    assert rows[0]["options"]["bias"] == pytest.approx(0.1, abs=0.03)
    (without,) = answer(folder, "--method", "ml", "--set", "odometry=off")["rows"]
    assert without["metrics"]["rmse_2d"] > 2 * batch
