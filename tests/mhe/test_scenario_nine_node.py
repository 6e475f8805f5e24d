"""The scenario `nine-node`: graphs, cases and metrics (design section 8, spec 6.2)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from mhe.distributed import NetworkDesign, run_trials
from mhe.scenarios.nine_node import CLASSES, scenario
from problems import registry
from problems.bench.measure import measure
from problems.bench.rows import Job
from problems.bench.scenario import Outcome, trial_rng
from problems.bench.settings import complete, validated
from problems.errors import ModelWarning, SettingError
from problems.networks import observability_report


def settings(**given: Any) -> Any:
    return validated(scenario, complete(scenario, given))


def drawn(trial: int = 0, **given: Any) -> Any:
    return scenario.draw(settings(**given), trial_rng(7, scenario.name, trial))


def run(method: str, trial: int = 0, solver: str = "auto", **given: Any) -> Outcome:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return scenario.run(settings(**given), method, solver, drawn(trial, **given))


def outputs(world: Any) -> list[np.ndarray]:
    owned = [[k for k, label in enumerate(world.placement) if label == node] for node in world.network.labels]
    return [world.model.C[rows] for rows in owned]


def classes(**given: Any) -> dict[Any, str]:
    world = scenario.world(settings(**given))
    found = observability_report(world.network, world.model.A, outputs(world)).classes
    return dict(zip(world.network.labels, found, strict=True))


def test_it_is_registered_with_its_contract() -> None:
    assert registry.load("scenarios", "nine-node") is scenario
    assert scenario.methods == ("kf", "mhe", "mhe_pre", "dmhe_f", "dmhe_pre", "dmhe_w_pre")
    assert scenario.metrics == ("transient", "steady", "total", "distance_to_reference")
    assert settings().horizon == 4 and settings().duration == 50


def test_graphs_are_those_of_the_source() -> None:
    green, yellow, orange, red = "green", "yellow", "orange", "red"
    assert classes() == {1: orange, 2: green, 3: green, 4: green, 5: orange, 6: green, 7: red, 8: yellow, 9: yellow}
    cycle = {1: orange, 2: green, 3: green, 4: yellow, 5: orange, 6: orange, 7: red, 8: yellow, 9: yellow}
    assert classes(graph="cycle") == cycle
    assert len(scenario.world(settings()).network.edges) == 28
    assert (scenario.world(settings(graph="cycle")).network.in_degree == 3).all()


def test_random_graphs_show_all_classes_and_follow_from_their_seed() -> None:
    networks = [scenario.world(settings(graph="random", graph_seed=seed)).network for seed in range(5)]
    assert all(set(classes(graph="random", graph_seed=seed).values()) == CLASSES for seed in range(5))
    assert all(network.is_strongly_connected and network.is_undirected for network in networks)
    assert len(set(networks)) == 5
    assert scenario.world(settings(graph="random", graph_seed=3, prior_variance=2.0)).network == networks[3]


def test_initial_states_are_uniform_within_a_hundred() -> None:
    starts = np.array([drawn(k).states[0] for k in range(300)])
    assert np.abs(starts).max() <= 100
    assert starts.mean(axis=0) == pytest.approx(np.zeros(4), abs=14)
    assert starts.var(axis=0) == pytest.approx(np.full(4, 1e4 / 3), rel=0.2)
    assert drawn(0, graph="cycle").measurements.tobytes() == drawn(0).measurements.tobytes()


def test_sums_of_the_mean_error() -> None:
    errors = np.arange(51 * 9, dtype=float).reshape(51, 9)
    found = scenario.score(errors)
    assert found["transient"] == pytest.approx(errors[1:10].mean(axis=1).sum())
    assert found["steady"] == pytest.approx(errors[10:].mean(axis=1).sum())
    assert found["total"] == pytest.approx(errors[1:].mean(axis=1).sum())


def test_run_is_the_batched_network() -> None:
    world, made = scenario.world(settings()), run("dmhe_f")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        design = NetworkDesign(world.model, world.network, "dmhe_f", placement=world.placement, horizon=4)
    states = run_trials(design, drawn().measurements[None]).states[0]
    errors = np.linalg.norm(states - drawn().states[:, None], axis=2)
    assert np.abs(made.trace.errors - errors).max() < 1e-10 * errors.max()
    assert sum(made.status.values()) == 450


def test_case_2_mixes_rank_weights_with_others() -> None:
    short: dict[str, Any] = {"duration": 12}
    ranked, uniform = run("dmhe_w_pre", **short).metrics, run("dmhe_pre", **short).metrics
    assert run("dmhe_pre", case=2, share=1.0, **short).metrics == pytest.approx(ranked)
    assert run("dmhe_w_pre", case=2, share=0.0, **short).metrics == pytest.approx(uniform)
    half = run("dmhe_pre", case=2, share=0.5, **short)
    assert ranked["total"] < half.metrics["total"] < uniform["total"]
    assert (half.options["weights"], half.options["share"]) == ("mixed", 0.5)
    assert run("dmhe_pre", case=2, share=0.5, weights="metropolis", **short).metrics["total"] > half.metrics["total"]
    assert run("dmhe_pre", fusion="convex", **short).metrics["total"] != uniform["total"]
    assert run("dmhe_pre", weights="rank", **short).metrics == pytest.approx(ranked)


def test_centralized_methods_may_have_all_measurements_and_a_prior_that_fits() -> None:
    two, every = run("kf"), run("kf", central="all")
    assert every.metrics["steady"] < two.metrics["steady"]
    assert run("kf", prior_variance=3333.0).metrics["transient"] < 0.5 * two.metrics["transient"]


def test_a_tight_box_is_active_in_some_steps() -> None:
    made = [run("dmhe_f", trial, bounds="tight") for trial in range(3)]
    assert 0.05 <= np.mean([one.trace.active for one in made]) <= 0.5


def test_what_contradicts_itself_is_refused() -> None:
    with pytest.raises(SettingError, match="share=0.5 belongs to case=2"):
        settings(share=0.5)
    with pytest.raises(SettingError, match="case=2 mixes"):
        settings(case=2, weights="rank")
    with pytest.raises(SettingError, match="graph"):
        settings(graph="star")


def test_cycle_warns_that_covariances_grow() -> None:
    with pytest.warns(ModelWarning, match=r"gamma = 1.056"):
        scenario.run(settings(graph="cycle", duration=11), "dmhe_f", "auto", drawn(duration=11))


def test_picture_has_nine_panels() -> None:
    made = {method: run(method, duration=12) for method in ("mhe", "dmhe_f")}
    figure = scenario.plot(settings(duration=12), drawn(duration=12), made)
    assert [axes.get_title() for axes in figure.axes] == [f"node {k}" for k in range(1, 10)]
    assert all(len(axes.lines) == 2 for axes in figure.axes)


def test_rows_say_what_the_estimator_warned_of_in_every_trial() -> None:
    chosen = complete(scenario, {"graph": "cycle", "duration": 10})
    rows = [measure(Job(scenario.name, "dmhe_f", "auto", chosen, 7, trial))[0] for trial in range(3)]
    assert all(len(row.warnings) == len(set(row.warnings)) > 0 for row in rows)
    assert rows[0].warnings == rows[1].warnings == rows[2].warnings
    assert any("gamma = 1.056" in text for text in rows[2].warnings)
