"""The scenario `four-state-ring`: what it draws, runs, counts and prints (design section 8, spec 6.1)."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mhe.distributed import NetworkDesign, run_trials
from mhe.polyhedron import Polyhedron
from mhe.scenarios.four_state_ring import CENTRAL_GAIN, GAINS, scenario
from problems import registry
from problems.bench.measure import measure
from problems.bench.rows import Job
from problems.bench.scenario import Outcome, trial_rng
from problems.bench.settings import complete, describe, validated
from problems.errors import ModelWarning, SettingError, TopologyError


def settings(**given: Any) -> Any:
    return validated(scenario, complete(scenario, given))


def drawn(trial: int = 0, **given: Any) -> Any:
    return scenario.draw(settings(**given), trial_rng(7, scenario.name, trial))


def run(method: str, trial: int = 0, solver: str = "auto", **given: Any) -> Outcome:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return scenario.run(settings(**given), method, solver, drawn(trial, **given))


def test_it_is_registered_with_its_contract() -> None:
    assert registry.load("scenarios", "four-state-ring") is scenario
    assert scenario.methods == ("kf", "mhe", "mhe_pre", "dmhe_f", "dmhe_pre", "dmhe_w_pre")
    assert scenario.metrics == ("rmse", "rmse_1", "rmse_2", "rmse_3", "rmse_4", "distance_to_reference")
    asked = {"horizon", "weights", "bounds", "prior", "form", "tolerance", "warm", "pi_update", "growth_prior"}
    assert asked <= set(describe(scenario)["settings"])
    assert {"kf", "mhe", "mhe_pre", "dmhe_f", "dmhe_pre", "dmhe_w_pre"} <= set(registry.names("estimators"))


def test_world_is_that_of_the_source() -> None:
    world = scenario.world(settings())
    heard = {world.network.labels[i]: world.network.in_neighborhood(i).tolist() for i in range(4)}
    assert heard == {1: [0, 3], 2: [0, 1], 3: [1, 2], 4: [2, 3]}
    assert [output.tolist() for output in world.regional] == [
        [[1, 0, 0, 0], [0, 0, 1, 0]],
        [[1, 0, 0, 0], [1, 0, 0, 0]],
        [[1, 0, 0, 0], [0, 0, 1, 0]],
        [[0, 0, 1, 0], [0, 0, 1, 0]],
    ]
    assert np.array_equal(world.central.C, world.model.C)


def test_a_trial_depends_on_its_number_only() -> None:
    one, again, other = drawn(0), drawn(0, horizon=3, bounds="tight"), drawn(1)
    assert one.states.tobytes() == again.states.tobytes() and one.measurements.shape == (21, 4)
    assert not np.array_equal(one.states, other.states)
    noise = np.concatenate([drawn(k).measurements - drawn(k).states[:, [0, 0, 2, 2]] for k in range(50)])
    assert np.cov(noise.T) == pytest.approx(np.eye(4), abs=0.15)


def test_rmse_has_sixteen_terms_over_fifteen() -> None:
    errors = np.arange(84, dtype=float).reshape(21, 4)
    found = scenario.score(errors)
    each = [np.sqrt(sum(errors[t, i] ** 2 for t in range(5, 21)) / 15) for i in range(4)]
    assert [found[f"rmse_{i}"] for i in (1, 2, 3, 4)] == pytest.approx(each)
    assert found["rmse"] == pytest.approx(np.mean(each))
    assert set(scenario.score(errors[:, :1])) == {"rmse"}


@pytest.mark.parametrize("method", ["dmhe_f", "dmhe_pre"])
def test_run_is_the_batched_network_with_the_printed_gains(method: str) -> None:
    world = scenario.world(settings())
    gains = {} if method == "dmhe_f" else {"gains": list(GAINS.values())}
    design = NetworkDesign(world.model, world.network, method, **gains)
    for trial in range(2):
        made = run(method, trial)
        states = run_trials(design, drawn(trial).measurements[None]).states[0]
        errors = np.linalg.norm(states - drawn(trial).states[:, None], axis=2)
        assert np.abs(made.trace.errors - errors).max() < 1e-10 * errors.max()
        assert made.metrics == pytest.approx(scenario.score(errors))


def test_trials_leave_nothing_behind() -> None:
    for method in scenario.methods:
        first = run(method, 0).trace.errors
        run(method, 1)
        assert run(method, 0).trace.errors.tobytes() == first.tobytes()


def test_every_local_solve_is_counted_and_timed() -> None:
    for method, solves in {"kf": 20, "mhe": 20, "mhe_pre": 20, "dmhe_f": 80, "dmhe_pre": 80, "dmhe_w_pre": 80}.items():
        made = run(method)
        assert sum(made.status.values()) == solves == made.status["solved"]
        assert made.step_seconds.shape == (solves,) and (made.step_seconds > 0).all()
        assert set(made.times) == {"compile", "setup", "update", "solve"}
        spent = made.times["update"] + made.times["solve"]
        assert spent == pytest.approx(made.step_seconds.sum(), rel=0.05)
    for method, solves in {"mhe": 20, "dmhe_f": 80, "dmhe_w_pre": 80}.items():
        named = run(method, solver="daqp")
        assert named.residual is not None and 0 < named.residual < 1e-8 and named.iterations == solves
    assert run("kf").residual is None


@pytest.mark.parametrize(("method", "nodes"), [("mhe", 1), ("dmhe_f", 4), ("dmhe_w_pre", 4)])
def test_distance_to_the_reference_shrinks_with_the_tolerance(method: str, nodes: int) -> None:
    found = []
    for tolerance in (1e-2, 1e-9):
        row, made = measure(
            Job(scenario.name, method, "osqp", complete(scenario, {"tolerance": tolerance, "bounds": "tight"}), 7, 0)
        )
        assert made is not None and made.estimate is not None and made.estimate.shape == (21, nodes, 4)
        found.append(row.metrics["distance_to_reference"])
    assert found[0] > 1e-5 and found[1] < 1e-8
    assert scenario.reference(settings(), "kf", drawn()) is None


def test_the_reference_is_the_optimum_within_the_bounds_of_the_trial() -> None:
    trial, given = drawn(1, bounds="tight"), settings(bounds="tight", tolerance=1e-3)
    tight = scenario.run(settings(bounds="tight"), "dmhe_f", "auto", trial)
    reference = scenario.reference(given, "dmhe_f", trial)
    assert reference is not None and tight.trace.active.any()
    assert tight.estimate == pytest.approx(reference, abs=1e-9)
    assert scenario.reference(given, "dmhe_f", trial) is reference


@pytest.mark.parametrize(("method", "columns"), [("kf", 1), ("dmhe_f", 4)])
def test_the_error_is_followed_through_the_trial(method: str, columns: int) -> None:
    made = run(method)
    assert made.trace.errors.shape == (21, columns) and set(made.curves) == {"error"}
    assert np.array_equal(made.curves["error"].values, made.trace.errors.mean(axis=1))


def test_rows_hold_options_and_gains_as_json() -> None:
    job = Job(scenario.name, "dmhe_pre", "auto", complete(scenario, {"pi_update": "exact"}), 7, 0)
    row, _ = measure(job)
    assert row.failure is None
    json.dumps(row.to_dict())
    assert row.options["pi_update"] == "exact" and row.options["weights"] == "uniform"
    assert np.array(row.options["gains"]["2"]) == pytest.approx(GAINS[2])
    assert row.options["phi"] == pytest.approx(0.55, abs=1e-3)
    assert np.array(run("mhe_pre").options["gain"]) == pytest.approx(CENTRAL_GAIN)
    assert measure(Job(scenario.name, "mhe", "auto", complete(scenario, {}), 7, 0))[0].metrics["rmse_1"] is None


def test_options_can_be_set_one_by_one() -> None:
    plain = run("dmhe_f").metrics["rmse"]
    assert run("dmhe_f", covariances="online").metrics["rmse"] == pytest.approx(plain, rel=1e-9)
    for change in (
        {"pi_update": "exact"},
        {"growth_prior": "own"},
        {"growth_prior": "mean"},
        {"weights": "rank"},
        {"weights": "none"},
        {"horizon": 4},
    ):
        assert abs(run("dmhe_f", **change).metrics["rmse"] - plain) > 1e-6, change
    # the ring is balanced, so that the printed n_S^j and d_j are the same (E1), and so is k_ij = d_j k_ij^2 with halves
    for fusion in ("in_degree", "convex"):
        assert run("dmhe_f", fusion=fusion).metrics["rmse"] == pytest.approx(plain, rel=1e-12)


def test_the_arrival_cost_of_mhe_can_be_the_filter() -> None:
    optimal = run("kf").trace.errors
    for prior in ("filter", "smoothing"):
        assert np.abs(run("mhe", prior=prior).trace.errors - optimal).max() < 1e-8
    assert np.abs(run("mhe").trace.errors - optimal).max() > 1e-3
    assert run("mhe", growth_prior="mean").metrics != run("mhe").metrics


def test_forms_apply_to_the_methods_that_have_them() -> None:
    plain = {method: run(method) for method in ("mhe", "mhe_pre", "dmhe_f", "dmhe_pre")}
    assert [made.options["form"] for made in plain.values()] == ["F2", "P2", "F2", "P2"]
    for form in ("F1", "F3", "P1"):
        for method, reference in plain.items():
            made = run(method, form=form)
            fits = method.endswith("_pre") == (form == "P1")
            assert (made.options["form"] == form) == fits
            assert made.metrics == pytest.approx(reference.metrics, rel=1e-6)


def test_the_literal_gain_of_node_4_is_reachable_by_name() -> None:
    with pytest.warns(ModelWarning, match=r"node 4.*1.526"):
        made = scenario.run(settings(gains="literal"), "dmhe_pre", "auto", drawn())
    world, gain = scenario.world(settings()), np.array(made.options["gains"]["4"])
    eigenvalues = np.linalg.eigvals(world.model.A - gain @ world.regional[3])
    assert np.abs(eigenvalues - (1.17 + 0.98j)).min() < 1e-6
    for gains in ("place", "kalman"):
        assert run("mhe_pre", gains=gains).metrics != run("mhe_pre").metrics


@pytest.mark.parametrize("method", ["mhe", "dmhe_f"])
def test_a_tight_box_is_active_in_some_steps_and_lowers_the_error(method: str) -> None:
    tight, free = [run(method, k, bounds="tight") for k in range(8)], [run(method, k) for k in range(8)]
    assert 0.05 <= np.mean([made.trace.active for made in tight]) <= 0.5
    assert not any(made.trace.active.any() for made in free)
    assert np.mean([made.metrics["rmse"] for made in tight]) < np.mean([made.metrics["rmse"] for made in free])
    for made, trial in zip(tight[:2], range(2), strict=True):
        assert run(method, trial, solver="osqp", bounds="tight").metrics == pytest.approx(made.metrics, rel=1e-5)


def test_infeasible_steps_name_node_and_instant_and_soft_bounds_answer_them() -> None:
    trial = next(k for k in range(20) if run("dmhe_pre", k, bounds="tight").status["infeasible"])
    with pytest.warns(ModelWarning, match=r"dmhe_pre: \d+ local problem.*first node \d, time step \d+"):
        hard = scenario.run(settings(bounds="tight"), "dmhe_pre", "auto", drawn(trial))
    assert len(hard.trace.infeasible) == hard.status["infeasible"] > 0
    soft = run("dmhe_pre", trial, bounds="soft")
    assert soft.options["infeasible"] == "soft" and np.isfinite(soft.trace.errors).all()
    assert soft.metrics["rmse"] != hard.metrics["rmse"]


def test_estimates_recover_from_bounds_that_contradict_the_measurements() -> None:
    """Steps 6 to 8 are infeasible and step 5 nearly so: 3e-3 of x1 there move x3 by 4."""
    hard, trial = settings(bounds="tight"), scenario.draw(settings(bounds="tight"), trial_rng(1, scenario.name, 6))
    with pytest.warns(ModelWarning, match="3 local problem"):
        made = scenario.run(hard, "mhe_pre", "daqp", trial)
    wider = replace(trial, box=Polyhedron.box(trial.box.lower - 3e-3, trial.box.upper + 3e-3), references={})
    with pytest.warns(ModelWarning, match="3 local problem"):
        relaxed = scenario.run(hard, "mhe_pre", "daqp", wider)
    assert made.status == relaxed.status == {"solved": 17, "infeasible": 3}
    assert made.trace.errors[5] > 7 and relaxed.trace.errors[5] < 1
    assert (made.trace.errors[6:9] > 7).all()  # predictions from step 5
    assert np.abs(made.trace.errors[10:] - relaxed.trace.errors[10:]).max() < 0.1


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(SettingError, match="duration"):
        settings(duration=5)
    with pytest.raises(SettingError, match="weights"):
        settings(weights="fair")
    with pytest.raises(TopologyError, match="Metropolis"):
        run("dmhe_f", weights="metropolis")


def test_picture_has_one_panel_per_node_with_every_method() -> None:
    outcomes = {method: run(method) for method in ("kf", "dmhe_f", "dmhe_pre")}
    figure = scenario.plot(settings(), drawn(), outcomes)
    assert [axes.get_title() for axes in figure.axes] == ["node 1", "node 2", "node 3", "node 4"]
    for node, axes in enumerate(figure.axes):
        lines = {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}
        assert set(lines) == {"kf (centralized)", "dmhe_f", "dmhe_pre"}
        assert np.array_equal(lines["dmhe_f"], outcomes["dmhe_f"].trace.errors[:, node])
