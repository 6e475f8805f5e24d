"""Scenario `recording` on generated folders: what is scored and compared, what is drawn, what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import pytest

from localization.io import uwb_outdoor
from localization.scenarios.recording import Settings, coarse_fixes, scenario
from problems.bench.measure import measure
from problems.bench.rows import Job
from problems.bench.scenario import Outcome, trial_rng
from problems.bench.settings import complete
from problems.errors import DataError, FormError, ModelWarning, ReadError, SettingError


@pytest.fixture(scope="module")
def folder(samples: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample with published figures."""
    copy = tmp_path_factory.mktemp("scored") / samples["uwb_outdoor"].name
    shutil.copytree(samples["uwb_outdoor"], copy)
    (copy / "published-rmse.txt").write_text("LS RMSE_2d: 2.0\nESKF RMSE_2d: 4.0\n")
    return copy


def copied(folder: Path, tmp_path: Path, name: str, *left_out: str) -> Path:
    shutil.copytree(folder, tmp_path / name, ignore=shutil.ignore_patterns(*left_out))
    return tmp_path / name


def settings(path: Path, **given: Any) -> Settings:
    return Settings(path=str(path), **{"horizon": 5, "lag": 0.0, "delay": 0.5, **given})


def outcome(path: Path, method: str = "mhe", solver: str = "auto", **given: Any) -> Outcome:
    chosen = settings(path, **given)
    return scenario.run(chosen, method, solver, scenario.draw(chosen, trial_rng(0, "recording", 0)))


@pytest.fixture(scope="module")
def plain(folder: Path) -> dict[str, Outcome]:
    """What every method finds."""
    return {method: outcome(folder, method) for method in scenario.methods}


@pytest.mark.parametrize("method", scenario.methods)
def test_every_method_is_scored_and_compared(folder: Path, plain: dict[str, Outcome], method: str) -> None:
    found = plain[method]
    assert set(found.metrics) == set(scenario.metrics)
    rmse = found.metrics["rmse_2d"]
    assert rmse is not None
    assert 0.05 < rmse < (1.5 if method == "ls" else 1.0)
    assert found.metrics["ratio_to_ls"] == pytest.approx(rmse / 2)
    assert found.metrics["ratio_to_eskf"] == pytest.approx(rmse / 4)
    recording = uwb_outdoor.read(folder)
    assert found.metrics["measurements"] == len(recording.time)
    assert found.metrics["keyframes"] == len(found.trace.estimate)
    assert sum(found.status.values()) == (1 if method == "ml" else len(found.step_seconds))
    assert found.times["compile"] > 0
    assert found.times["solve"] == pytest.approx(found.step_seconds.sum())
    assert found.options["delay"] == (0.5 if method == "fixed_lag" else 0.0)


def test_estimates_made_later_are_better(plain: dict[str, Outcome]) -> None:
    causal, delayed, whole = (plain[method].metrics["rmse_2d"] or 0 for method in ("mhe", "fixed_lag", "ml"))
    assert delayed < 0.8 * causal
    assert whole < 0.8 * delayed


def test_the_solver_that_is_named_is_called(folder: Path, plain: dict[str, Outcome]) -> None:
    with pytest.raises(FormError, match="'osqp' takes quadratic programs only"):
        outcome(folder, "ls", "osqp")
    with pytest.raises(FormError, match="'osqp' takes quadratic programs only"):
        outcome(folder, "mhe", "osqp")
    own, other = plain["ls"], outcome(folder, "ls", "ipopt")
    assert other.metrics["rmse_2d"] == pytest.approx(own.metrics["rmse_2d"], abs=1e-3)
    assert other.iterations != own.iterations


def test_two_trials_with_one_seed_are_the_same(folder: Path) -> None:
    one, other = (outcome(folder, gps_rate=2.0) for _ in range(2))
    assert one.metrics == other.metrics
    assert one.trace.estimate.value.tobytes() == other.trace.estimate.value.tobytes()


def test_coarse_fixes_are_the_truth_and_noise(folder: Path) -> None:
    recording = uwb_outdoor.read(folder)
    fixes = coarse_fixes(recording, 10.0, 2.0, np.random.default_rng(0))
    assert fixes is not None
    assert recording.truth is not None
    assert fixes.time[0] >= recording.time[0]
    assert fixes.time[-1] <= recording.time[-1]
    assert len(fixes) == pytest.approx(10 * (recording.time[-1] - recording.time[0]), abs=2)
    at = np.column_stack([np.interp(fixes.time, recording.truth.time, c) for c in recording.truth.value.T[:2]])
    assert np.std(fixes.value - at) == pytest.approx(2.0, rel=0.1)
    assert coarse_fixes(recording, 0.0, 2.0, np.random.default_rng(0)) is None


def test_fixes_are_counted_and_used(folder: Path, plain: dict[str, Outcome]) -> None:
    helped = outcome(folder, "mhe", gps_rate=5.0, gps_sigma=0.05).metrics
    without = plain["mhe"].metrics
    assert (helped["measurements"] or 0) > (without["measurements"] or 0) + 300
    assert (helped["rmse_2d"] or 9) < 0.7 * (without["rmse_2d"] or 0)


def test_a_recording_without_truth_has_a_track_and_no_score(folder: Path, tmp_path: Path) -> None:
    path = copied(folder, tmp_path, "new-trajectory_a", "trajectory.csv")
    found = outcome(path)
    assert found.metrics["rmse_2d"] is None
    assert found.metrics["ratio_to_eskf"] is None
    assert len(found.trace.estimate) > 400
    for needs_truth in ({"start": "truth"}, {"gps_rate": 1.0}):
        with pytest.raises(SettingError, match="needs truth, which this recording does not have"):
            outcome(path, **needs_truth)


def test_a_name_without_a_letter_is_scored_as_a_whole_and_not_compared(
    folder: Path, plain: dict[str, Outcome], tmp_path: Path
) -> None:
    path = copied(folder, tmp_path, "drive7")
    with pytest.warns(ModelWarning, match="--set trajectory=A or B"):
        found = outcome(path)
    assert found.metrics["rmse_2d"] is not None
    assert found.metrics["ratio_to_eskf"] is None
    chosen = outcome(path, trajectory="A")
    assert chosen.metrics["rmse_2d"] == plain["mhe"].metrics["rmse_2d"]
    assert chosen.metrics["ratio_to_eskf"] is not None


def test_the_wrong_letter_is_noticed_before_any_work(folder: Path) -> None:
    chosen = settings(folder, trajectory="B")
    with pytest.raises(DataError, match="never enters the scoring window of trajectory B"):
        scenario.draw(chosen, np.random.default_rng(0))


def test_a_track_that_cannot_be_scored_is_kept(folder: Path, tmp_path: Path) -> None:
    path = copied(folder, tmp_path, "short-trajectory_a")
    for file in path.glob("A*.csv"):
        lines = file.read_text().splitlines()
        file.write_text("\n".join(lines[: len(lines) // 2]) + "\n")
    with pytest.warns(ModelWarning, match="not scored: .*scoring needs an estimate"):
        found = outcome(path)
    assert found.metrics["rmse_2d"] is None
    assert found.metrics["objective"] is not None


def test_the_start_can_be_given(folder: Path, tmp_path: Path) -> None:
    recording = uwb_outdoor.read(folder)
    assert recording.truth is not None
    x, y = recording.truth.value[0, :2]
    near = outcome(folder, start=(float(x), float(y)))
    assert near.trace.estimate.value.tobytes() == outcome(folder, start="truth").trace.estimate.value.tobytes()
    path = copied(folder, tmp_path, "two-trajectory_a", "A3.csv", "A5.csv")
    with pytest.raises(DataError, match="only A9, A12 are heard"):
        outcome(path)
    assert outcome(path, start=(float(x), float(y))).metrics["rmse_2d"] is not None


def test_planar_anchors_are_put_at_the_height_of_the_tag(samples: dict[str, Path], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    anchors, lines = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, -1.0]]), []
    for k in range(300):
        place = np.array([np.cos(0.02 * k), np.sin(0.02 * k)])
        anchor = anchors[k % 3]
        distance = np.linalg.norm(place - anchor) + 0.02 * rng.normal()
        stamp = 0.04 * k
        lines.append(f"range2 {stamp} {distance} 0.01 {anchor[0]} {anchor[1]} {k % 3} 0")
        lines.append(f"odom2diff {stamp} 0.0 0.0 0.1 0.1 0.1 0.1 0.1")
    (tmp_path / "X_Input.txt").write_text("\n".join(lines) + "\n")
    found = outcome(tmp_path, bias=False, odometry=False)
    t = found.trace.estimate.time
    error = found.trace.estimate.value - np.column_stack([np.cos(0.5 * t), np.sin(0.5 * t)])
    assert np.sqrt(np.mean(error[20:] ** 2)) < 0.1
    assert found.metrics["rmse_2d"] is None


def test_other_recordings_are_refused_by_name(samples: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="setting horizon means nothing for a team recording"):
        outcome(samples["mrclam"])
    team = Settings(path=str(samples["mrclam"]))
    with pytest.raises(FormError, match="method 'ls' cannot localize a team recording .mrclam.; possible: mhe"):
        scenario.run(team, "ls", "auto", scenario.draw(team, trial_rng(0, "recording", 0)))
    with pytest.raises(ReadError, match="an existing file or folder"):
        outcome(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"horizon": 0}, "greater than or equal to 1"),
        ({"gps_rate": 20.0}, "a knot every 0.1 s holds one fix"),
        ({"trajectory": "C"}, "'A' or 'B'"),
        ({"start": "nowhere"}, "start"),
        ({"windows": 3}, "windows"),
    ],
)
def test_settings_without_meaning_are_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(pydantic.ValidationError, match=told):
        Settings(path="x", **given)


def test_settings_read_from_text() -> None:
    values = complete(scenario, {"path": "x", "start": "[1, -2.5]", "bias": "off", "trajectory": "B"})
    assert (values["start"], values["bias"], values["trajectory"]) == ([1.0, -2.5], False, "B")
    assert all(field.description for field in Settings.model_fields.values())


def test_a_delay_longer_than_the_window_is_a_failed_row_that_says_so(folder: Path) -> None:
    values = complete(scenario, {"path": str(folder), "horizon": 5, "delay": 1.0})
    row, _ = measure(Job("recording", "fixed_lag", "auto", values, 0, 0))
    assert row.failure is not None
    assert "delay 1 s is longer than the window of 0.5 s" in row.failure.message


def test_covariances_are_of_the_positions(folder: Path, plain: dict[str, Outcome]) -> None:
    found = outcome(folder, covariance=True, lag=0.2)
    P = found.trace.covariance
    assert P.shape == (len(found.trace.estimate), 2, 2)
    assert (np.linalg.eigvalsh(P) > 0).all()
    assert plain["mhe"].trace.covariance is None


@pytest.mark.parametrize("with_truth", [True, False])
def test_the_picture_shows_every_track(
    folder: Path, plain: dict[str, Outcome], tmp_path: Path, with_truth: bool
) -> None:
    path = folder if with_truth else copied(folder, tmp_path, "x-trajectory_a", "trajectory.csv")
    chosen = settings(path)
    drawn = scenario.draw(chosen, np.random.default_rng(0))
    outcomes = {method: plain[method] for method in ("mhe", "ls")}
    figure = scenario.plot(chosen, drawn, outcomes)
    assert len(figure.axes) == (2 if with_truth else 1)
    labels = {text.get_text() for text in figure.axes[0].get_legend().get_texts()}
    assert labels == {"mhe", "ls", "anchors", *(["truth"] if with_truth else [])}
    figure.savefig(tmp_path / "tracks.png")
    assert (tmp_path / "tracks.png").stat().st_size > 20_000
