"""The scenario `surveillance`: cases, drawing, metrics, replay and picture (spec dmhe-sporadic-fov 3.11 and 6)."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mhe.scenarios._surveillance_metrics import errors_of, in_window, over_nodes, share
from mhe.scenarios._surveillance_plot import chosen_instants
from mhe.scenarios._surveillance_world import Drawn
from mhe.scenarios.surveillance import export, scenario
from mhe.sporadic import METHODS
from problems import registry
from problems.bench.plan import built_in_plan
from problems.bench.scenario import trial_rng
from problems.bench.settings import complete, validated
from problems.errors import EmptyConstraintError, ModelWarning, ReadError, SettingError
from problems.networks import band


def settings(**given: Any) -> Any:
    return validated(scenario, complete(scenario, given))


def drawn(trial: int = 0, **given: Any) -> Drawn:
    return scenario.draw(settings(**given), trial_rng(7, scenario.name, trial))


def run(method: str, made: Drawn, **given: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return scenario.run(settings(**given), method, "auto", made)


def positions_of(made: Drawn) -> np.ndarray:
    assert made.positions is not None
    return made.positions


SHORT: dict[str, Any] = {"duration": 15.0}


# Contract and settings


def test_it_is_registered_with_its_contract() -> None:
    assert registry.load("scenarios", "surveillance") is scenario
    assert set(scenario.methods) == {"dmhe_w_pre", "dmhe_w_pre_s", "dmhe_f", "dmhe_f_s"}
    assert scenario.metrics == ("rmse_all", "rmse_active", "rmse_detected", "infeasible_share", "outside_share")


def test_cases_bring_their_own_values_and_give_way_to_given_ones() -> None:
    assert (settings().cameras, settings().horizon, settings().detection_rate) == (12, 3, 0.8)
    second = settings(case="2", duration=130)
    assert (second.cameras, second.detection_rate, second.duration, second.steps) == (6, 0.7, 130.0, 260)
    gazebo = settings(case="gazebo", radius=1)
    assert (gazebo.cameras, gazebo.horizon, gazebo.radius, gazebo.measurement_variance) == (17, 4, 1, 0.5)
    assert complete(scenario, {"case": 3})["across"][-1] == 0.66
    assert validated(scenario, complete(scenario, {"case": 2})) == second.model_copy(update={"duration": 100.0})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"case": 3, "cameras": 8}, "across has 12 numbers for cameras=8"),
        ({"case": 4}, "case"),
        ({"across": -1}, "across must be positive"),
        ({"score_from": 100}, "leaves no instant"),
        ({"replay_truth": "x.csv"}, "belongs to replay"),
        ({"gain": 2}, "gain"),
    ],
)
def test_settings_that_do_not_fit(given: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        settings(**given)


def test_the_graph_is_that_of_the_radius() -> None:
    assert set(map(tuple, scenario.world(settings(radius=3)).network.edges)) == set(map(tuple, band(12, 3).edges))
    assert scenario.world(settings(radius=11)).network.in_degree.min() == 12
    assert scenario.world(settings()).network.labels == tuple(range(1, 13))


def test_a_camera_beside_the_road() -> None:
    with pytest.raises(EmptyConstraintError, match="camera 1 looks at no part of the road"):
        scenario.world(settings(sideways=5.0))


# What is drawn


@pytest.mark.parametrize("case", [1, 2, 3, "gazebo"])
def test_detected_vehicles_are_in_view(case: Any) -> None:
    made, world = drawn(case=case), scenario.world(settings(case=case))
    assert made.positions is not None
    assert made.detected.any(axis=(0, 2)).all()
    assert (np.isnan(made.readings).any(axis=-1) == ~made.detected).all()
    for view, flags in zip(world.views, np.moveaxis(made.detected, 1, 0), strict=True):
        x0, y0, x1, y1 = view.footprint.bounds  # rectangles along the axes
        x, y = made.positions[flags].T
        assert (x >= x0).all() and (x <= x1).all() and (y >= y0).all() and (y <= y1).all()


def test_readings_have_the_stated_noise_and_bias() -> None:
    trials = [drawn(trial) for trial in range(20)]
    errors = [made.readings - positions_of(made)[:, None] for made in trials]
    spread = np.concatenate([(e - np.nanmean(e, axis=(0, 2), keepdims=True)).reshape(-1, 2) for e in errors])
    assert np.nanvar(spread) == pytest.approx(0.15, rel=0.1)
    bias: Any = np.array([np.nanmean(e, axis=(0, 2)) for e in errors])
    assert bias.var() == pytest.approx(0.1, rel=0.25)
    found = np.mean([made.detected.sum() for made in trials])
    assert found / drawn(detection_rate=1.0).detected.sum() == pytest.approx(0.8, abs=0.02)


def test_a_turned_camera_turns_what_it_sees_about_its_footprint() -> None:
    given = {"case": "gazebo", "noise": 0.0, "bias": 0.0, "rotation_bias": 0.3}
    made, world = drawn(**given), scenario.world(settings(**given))
    assert made.positions is not None
    offset = made.readings - world.centres[:, None]
    true = made.positions[:, None] - world.centres[:, None]
    np.testing.assert_allclose(
        np.linalg.norm(offset, axis=-1)[made.detected],
        np.broadcast_to(np.linalg.norm(true, axis=-1), made.detected.shape)[made.detected],
    )
    cross = true[..., 0] * offset[..., 1] - true[..., 1] * offset[..., 0]
    angle = np.arctan2(cross, (true * offset).sum(axis=-1))
    for camera in range(17):
        assert np.nanstd(angle[:, camera]) < 1e-9
    assert 0.15 < np.nanstd(angle[:, :, 0]) < 0.6


def test_longer_runs_go_on_where_shorter_ones_end() -> None:
    short, long = drawn(case=2), drawn(case=2, duration=130)
    np.testing.assert_array_equal(short.readings, long.readings[: len(short.times)])
    assert len(long.times) == 261
    with_radius = drawn(case=2, radius=6)
    np.testing.assert_array_equal(short.readings, with_radius.readings)


def test_vehicles_keep_their_formation_and_stop() -> None:
    made = drawn(wobble=0.0, lag=0.0)
    assert made.positions is not None
    leader = made.positions[:, 0]
    np.testing.assert_allclose(leader[[0, -1]], [(-1.75, -3.25), (0.75, 4.0)])
    np.testing.assert_allclose(np.linalg.norm(made.positions[:, 1:] - leader[:, None], axis=-1), 0.3 * np.sqrt(2))
    assert (leader[made.times >= 88] == leader[-1]).all()


# Metrics


def test_errors_are_means_of_norms() -> None:
    positions = np.zeros((3, 5, 2))
    estimates = np.full((3, 2, 5, 2), 0.5 / np.sqrt(2))  # each vehicle is 0.5 m off
    detected = np.zeros((3, 2, 5), dtype=bool)
    detected[1, 0, 2] = detected[2, 0, :2] = True
    estimates[2, 0] *= 3
    made = Drawn(np.arange(3.0), positions, detected, np.full((3, 2, 5, 2), np.nan))
    found = errors_of(estimates, made, np.array([False, True, True]))
    one = 0.5 * np.sqrt(5)
    assert found["rmse_all"] == pytest.approx((one + 2 * one) / 2)
    assert found["rmse_active"] == pytest.approx((one + 3 * one) / 2)
    assert found["rmse_detected"] == pytest.approx(np.sqrt((0.25 + 2 * 2.25) / 3))
    assert np.isnan(over_nodes(np.ones((3, 2)), made.active)[0])
    assert share(detected, detected, np.array([True, False, False])) is None
    assert in_window(detected, 1)[:, 0, 2].tolist() == [False, True, True]
    assert in_window(detected, 1)[:, 0, 0].tolist() == [False, False, True]


def test_scores_count_from_and_until() -> None:
    made = drawn(**SHORT)
    outcome = run("dmhe_w_pre", made, **SHORT)
    late = scenario.score(settings(score_from=10, **SHORT), made, outcome.trace)
    assert late["rmse_all"] != outcome.metrics["rmse_all"]
    curve = outcome.curves["error, all cameras (m)"]
    assert late["rmse_all"] == pytest.approx(curve.values[curve.at >= 10].mean())
    assert outcome.metrics["rmse_all"] == pytest.approx(curve.values[1:].mean())


# Methods


@pytest.mark.parametrize("method", scenario.methods)
def test_a_campaign_equals_single_runs(method: str) -> None:
    trials = [drawn(trial, **SHORT) for trial in range(2)]
    together = scenario.campaign(settings(**SHORT), method, trials)
    for made, trace in zip(trials, together, strict=True):
        outcome = run(method, made, **SHORT)
        np.testing.assert_allclose(trace.estimates, outcome.trace.estimates, rtol=0, atol=1e-9)
        assert (trace.unmet == outcome.trace.unmet).all()
        assert sum(outcome.status.values()) == 30 * 12 == outcome.step_seconds.size


def test_factors_reach_the_estimator() -> None:
    given = {
        "disturbance": "observer",
        "weights": "metropolis",
        "weight_fusion": "out_degree",
        "pi_update": "exact",
        "rows": "soft",
        "observer": "regional",
        "gain": 0.2,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        options = scenario.estimator(settings(**given), "dmhe_f_s").options
    assert {name: getattr(options, name) for name in given if name != "gain"} == {
        name: value for name, value in given.items() if name != "gain"
    }
    assert scenario.estimator(settings(), "dmhe_f_s").options.disturbance == "process_noise"
    assert scenario.estimator(settings(rows="projected"), "dmhe_f_s").options.rows == "hard"
    assert scenario.estimator(settings(rows="projected"), "dmhe_w_pre").options.rows == "none"


def test_the_road_itself_is_a_tighter_set_than_its_hull() -> None:
    given = {"duration": 30.0, "cameras": 5, "overlap": 1.0}
    made, world = drawn(**given), scenario.world(settings(**given))
    exact = run("dmhe_f_s", made, pieces="detected", **given).trace.estimates
    hull = run("dmhe_f_s", made, **given).trace.estimates
    outside = []
    for estimates in (exact, hull):
        at = np.argwhere(made.detected[1:]) + [1, 0, 0]
        outside.append(
            sum(
                min(piece.violation(estimates[k, i, vehicle]) for piece in world.views[i].pieces) > 1e-6
                for k, i, vehicle in at
            )
        )
    assert outside[0] == 0 < outside[1]


def test_the_plan_switches_one_factor_at_a_time() -> None:
    plan = built_in_plan("attribution")
    combinations = [found for study in plan.study for found in study.combinations()]
    weights = {(method, given["weights"]) for method, _, given in combinations}
    assert {(method, rule) for method in METHODS for rule in ("uniform", "rank")} <= weights
    assert {given["pi_update"] for *_, given in combinations} >= {"literal", "exact", "onestep"}
    assert {given["rows"] for *_, given in combinations} == {"hard", "soft", "projected"}


# Replay


def test_a_replayed_trial_gives_the_same_estimates(tmp_path: Path) -> None:
    made = drawn(**SHORT)
    files = {"replay": str(tmp_path / "readings.csv"), "replay_truth": str(tmp_path / "truth.csv")}
    export(made, files["replay"], files["replay_truth"])
    replayed = drawn(trial=5, **SHORT, **files)
    for method in ("dmhe_w_pre_s", "dmhe_f"):
        first, second = run(method, made, **SHORT), run(method, replayed, **SHORT, **files)
        np.testing.assert_array_equal(first.trace.estimates, second.trace.estimates)
        assert first.metrics == second.metrics


def test_a_replay_without_truth_has_no_errors_but_a_picture(tmp_path: Path) -> None:
    made = drawn(**SHORT)
    export(made, tmp_path / "readings.csv")
    given = {"replay": str(tmp_path / "readings.csv"), **SHORT}
    replayed = drawn(**given)
    outcome = run("dmhe_w_pre_s", replayed, **given)
    assert outcome.metrics["rmse_all"] is outcome.metrics["rmse_detected"] is None
    assert outcome.metrics["outside_share"] is not None
    scenario.plot(settings(**given), replayed, {"dmhe_w_pre_s": outcome}).savefig(tmp_path / "scene.png")


def test_a_replay_that_does_not_fit_names_the_line(tmp_path: Path) -> None:
    export(drawn(duration=20.0), tmp_path / "readings.csv")
    with pytest.raises(ReadError, match=r"readings\.csv:\d+: expected an instant .* the last one 15 s"):
        drawn(replay=str(tmp_path / "readings.csv"), **SHORT)
    with pytest.raises(ReadError, match=r"readings\.csv:\d+: expected a sensor from 1 to 2"):
        drawn(replay=str(tmp_path / "readings.csv"), cameras=2, duration=20.0)


# Picture


@pytest.mark.parametrize("case", [1, 2, 3, "gazebo"])
def test_the_picture_shows_scenes_and_errors(case: Any, tmp_path: Path) -> None:
    given = {"case": case, "duration": 6.0}
    made = drawn(**given)
    outcomes = {method: run(method, made, **given) for method in ("dmhe_w_pre", "dmhe_f_s")}
    figure = scenario.plot(settings(instants=(2.0, 5.0), **given), made, outcomes)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert [title.partition(",")[0] for title in titles] == ["t = 2 s", "t = 5 s"]
    labels = {line.get_label() for axes in figure.axes for line in axes.get_lines()}
    assert {"dmhe_w_pre", "dmhe_f_s"} <= labels
    figure.savefig(tmp_path / "scene.png")


def test_instants_of_the_picture_are_those_with_something_to_see() -> None:
    made = drawn(case=2)
    chosen = chosen_instants(made)
    assert len(chosen) == 4
    assert made.active[chosen].any(axis=1).all()
    nothing = Drawn(made.times, made.positions, np.zeros_like(made.detected), made.readings)
    assert chosen_instants(nothing) == [50, 100, 150, 200]
