"""Scenarios ``robot-lattice`` and ``relative-network``, the a-GL behind one of them, and GLS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pydantic
import pytest

from localization.consensus.gradient import GradientArrays, GradientNodes, LocalCosts, independent_groups, unite, wake
from localization.estimators import compass_state_data, compass_state_poses, compass_state_problem
from localization.lattice import (
    Sigmas,
    draw_lattice,
    linear_data,
    linear_problem,
    linear_start,
    team_data,
    team_problem,
)
from localization.scenarios.relative_network import scenario as network_scenario
from localization.scenarios.robot_lattice import scenario
from problems.bench.scenario import trial_rng
from problems.errors import DataError, FormError, ModelWarning, SettingError, UnobservableError
from problems.runtime import EventSimulation, Links


def test_gradient_nodes_are_arrays() -> None:
    team = draw_lattice(9, np.random.default_rng(0))
    costs = LocalCosts.of(team)
    arrays = GradientArrays(costs, 1.0)
    robots = np.random.default_rng(1).integers(0, 9, 500)
    clocks = [(np.flatnonzero(robots == i) + 1).tolist() for i in range(9)]
    with EventSimulation(costs.network, GradientNodes(costs, 1.0), clocks) as simulation:
        for k, robot in enumerate(robots):
            simulation.run(k + 1)
            arrays.step(np.array([robot]))
            np.testing.assert_allclose(np.array(simulation.outputs()), arrays.x[:-1], atol=1e-12)
    assert np.abs(arrays.x[:-1] - costs.start).max() > 0.5


def test_grouped_wake_ups_are_single_ones_also_with_losses() -> None:
    teams = [draw_lattice(n, np.random.default_rng(n), pairs="both") for n in (6, 9)]
    costs = unite([LocalCosts.of(team) for team in teams])
    rng = np.random.default_rng(2)
    robots = rng.integers(0, 15, 400)
    heard = rng.random((400, costs.slots.width)) >= 0.3
    single, grouped = GradientArrays(costs), GradientArrays(costs)
    for k in range(400):
        single.step(robots[k : k + 1], heard[k : k + 1])
    wake(grouped, costs, robots, heard)
    np.testing.assert_array_equal(grouped.x, single.x)
    np.testing.assert_array_equal(grouped.memory[:-1], single.memory[:-1])
    order, sizes = independent_groups(costs.slots, robots)
    assert np.array_equal(np.sort(order), np.arange(400)) and sizes.sum() == 400 and len(sizes) < 250


def test_gradient_descends_to_least_squares_with_few_fixes_and_unequal_sigmas() -> None:
    rng = np.random.default_rng(3)
    team = draw_lattice(6, rng)
    gps = team.gps.copy()
    gps[[1, 2, 4]] = np.nan
    sigma = rng.uniform(0.5, 2.0, (6, 2))
    team = replace(team, gps=gps, sigmas=replace(team.sigmas, position=sigma))
    costs = LocalCosts.of(team)
    arrays = GradientArrays(costs, 1.0)
    wake(arrays, costs, rng.integers(0, 6, 100_000))
    best = linear_problem(team).compile().solve(linear_data(team))["robot"]
    np.testing.assert_allclose(arrays.x[:-1], best, atol=1e-8)


def test_gradient_settings_that_are_not_safe_are_told() -> None:
    costs = LocalCosts.of(draw_lattice(4, np.random.default_rng(0)))
    for step in (0.0, 1.1):
        with pytest.raises(SettingError, match="0.5 is safe"):
            GradientArrays(costs, step)
    with pytest.warns(ModelWarning, match="diverge"):
        GradientNodes(costs, 1.0, Links(delay=2))
    with pytest.raises(UnobservableError, match="0, 1, 2, 3"):
        team = draw_lattice(4, np.random.default_rng(0))
        LocalCosts.of(replace(team, gps=team.gps * np.nan))


def test_gls_is_exact_without_noise_and_closes_the_gap_to_maximum_likelihood() -> None:
    silent = draw_lattice(9, np.random.default_rng(0), sigmas=Sigmas(0.0, 0.0, 0.0, 0.0))
    team = replace(silent, sigmas=Sigmas())
    solution = compass_state_problem(team).compile().solve(compass_state_data(team))
    assert team.truth is not None
    np.testing.assert_allclose(compass_state_poses(team, solution), team.truth, atol=1e-9)
    away = {"ls": [], "gls": []}
    for seed in range(10):
        team = draw_lattice(36, np.random.default_rng(seed))
        start, _ = linear_start(team)
        best = team_problem(team).compile("gauss-newton").solve(team_data(team), initial={"robot": start})["robot"]
        solution = compass_state_problem(team).compile().solve(compass_state_data(team))
        poses = compass_state_poses(team, solution)
        away["ls"].append(np.linalg.norm(start[:, :2] - best[:, :2]))
        away["gls"].append(np.linalg.norm(poses[:, :2] - best[:, :2]))
        assert np.abs(poses[:, 2] - best[:, 2]).max() < 0.01
    assert np.mean(away["gls"]) < 0.35 * np.mean(away["ls"])


def test_gls_keeps_the_covariance_that_one_compass_gives_all_bearings() -> None:
    """Eliminating the compass errors must leave least squares with the full covariance of the relative positions."""
    team = draw_lattice(4, np.random.default_rng(1))
    data, sigmas = linear_data(team), team.sigmas
    u, m = data["displacements"], len(team.observer)
    distance = np.linalg.norm(u, axis=1)
    across = np.column_stack([-u[:, 1], u[:, 0]]) / distance[:, None]
    full = np.zeros((2 * m, 2 * m))
    incidence = np.zeros((2 * m, 8))
    for a in range(m):
        rows = slice(2 * a, 2 * a + 2)
        along = u[a] / distance[a]
        full[rows, rows] = sigmas.range**2 * np.outer(along, along)
        full[rows, rows] += (distance[a] * sigmas.bearing) ** 2 * np.outer(across[a], across[a])
        incidence[rows, 2 * team.target[a] : 2 * team.target[a] + 2] = np.eye(2)
        incidence[rows, 2 * team.observer[a] : 2 * team.observer[a] + 2] = -np.eye(2)
        for b in np.flatnonzero(team.observer == team.observer[a]):
            shared = distance[a] * distance[b] * sigmas.heading**2 * np.outer(across[a], across[b])
            full[rows, 2 * b : 2 * b + 2] += shared
    weight = np.linalg.inv(full)
    hessian = np.eye(8) / 4.0 + incidence.T @ weight @ incidence
    expected = np.linalg.solve(hessian, team.gps.ravel() / 4.0 + incidence.T @ weight @ u.ravel())
    solution = compass_state_problem(team).compile().solve(compass_state_data(team))
    np.testing.assert_allclose(solution["robot"].ravel(), expected, atol=1e-9)


def test_gls_needs_headings_and_holds_a_fence() -> None:
    team = draw_lattice(9, np.random.default_rng(4))
    with pytest.raises(DataError, match="compass"):
        compass_state_data(replace(team, compass=np.full(9, np.nan)))
    box = (np.full(2, 2.0), np.full(2, 7.0))
    solution = compass_state_problem(team, fence=box).compile("daqp").solve(compass_state_data(team))
    assert solution["robot"].min() > 2 - 1e-6 and solution["robot"].max() < 7 + 1e-6


@pytest.mark.parametrize("method", scenario.methods)
def test_lattice_methods_report_what_they_did(method: str) -> None:
    settings = scenario.settings(rounds=6000)
    drawn = scenario.draw(settings, trial_rng(2, scenario.name, 0))
    outcome = scenario.run(settings, method, "auto", drawn)
    assert set(outcome.metrics) == set(scenario.metrics)
    m = outcome.metrics
    assert m["mse"] == pytest.approx(m["mse_centroid"] + m["mse_relative"])
    assert (m["heading_rms"] is None) == (method in ("ls", "agl"))
    gps = scenario.run(settings, "gps", "none", drawn).metrics
    if method != "gps":
        assert m["mse_relative"] < 0.02 * gps["mse_relative"]
        assert m["mse_centroid"] == pytest.approx(gps["mse_centroid"], abs=0.05)


def test_lattice_scenario_with_a_fence_draws_its_picture() -> None:
    settings = scenario.settings(fence=0.0, rounds=10)
    drawn = scenario.draw(settings, trial_rng(2, scenario.name, 0))
    outcomes = {m: scenario.run(settings, m, "osqp", drawn) for m in ("ls", "gls")}
    assert outcomes["ls"].trace.robot.min() > -1e-4 and outcomes["ls"].trace.robot.max() < 8 + 1e-4
    with pytest.raises(FormError, match="quadratic"):
        scenario.run(settings, "ml", "osqp", drawn)
    fenced = scenario.run(settings, "ml", "ipopt", drawn)
    assert fenced.trace.robot[:, :2].min() > -1e-4
    labels = scenario.plot(settings, drawn, outcomes | {"ml": fenced}).axes[0].get_legend_handles_labels()[1]
    assert {"ls", "gls", "ml", "fence"} <= set(labels)


@pytest.mark.parametrize("method", ["gps", "agl"])
def test_methods_that_know_no_fence_refuse_it(method: str) -> None:
    fenced, free = scenario.settings(fence=1.0, rounds=10), scenario.settings(rounds=10)
    drawn = scenario.draw(fenced, trial_rng(2, scenario.name, 0))
    with pytest.raises(FormError, match=f"'{method}' of robot-lattice knows no fence.*ls, gls, ml"):
        scenario.run(fenced, method, "auto", drawn)
    scenario.run(free, method, "auto", scenario.draw(free, trial_rng(2, scenario.name, 0)))


def test_trials_repeat_and_losses_slow_agl_down() -> None:
    plain, lossy = scenario.settings(rounds=500), scenario.settings(rounds=500, loss=0.8)
    drawn = scenario.draw(plain, trial_rng(1, scenario.name, 0))
    again = scenario.draw(plain, trial_rng(1, scenario.name, 0))
    best = scenario.run(plain, "ls", "auto", drawn).trace.robot
    first, second = (scenario.run(plain, "agl", "none", d).trace.robot for d in (drawn, again))
    np.testing.assert_array_equal(first, second)
    late = scenario.run(lossy, "agl", "none", drawn).trace.robot
    assert np.linalg.norm(late - best) > 1.5 * np.linalg.norm(first - best)
    for wrong in ({"robots": 1}, {"pairs": "two"}, {"step": 1.5}, {"sigma_range": 0}, {"unknown": 1}):
        with pytest.raises(pydantic.ValidationError):
            scenario.settings(**wrong)


def test_network_scenario_runs_all_methods_on_one_world_and_draws() -> None:
    settings = network_scenario.settings(nodes=15, radius=0.45, iterations=6000)
    drawn = network_scenario.draw(settings, trial_rng(0, network_scenario.name, 0))
    outcomes = {m: network_scenario.run(settings, m, "none", drawn) for m in network_scenario.methods}
    for method in ("a_cl", "s_cl", "bc", "rek"):
        assert outcomes[method].metrics["packets_per_e6"] is not None, method
    packets = {m: o.metrics["packets_per_e6"] for m, o in outcomes.items()}
    assert packets["a_cl"] < packets["bc"] < packets["rek"]
    assert outcomes["gossip"].metrics["log_error"] > outcomes["a_cl"].metrics["log_error"] + 2
    assert outcomes["s_cl"].trace.packets[-1, 0] == 6000
    figure = network_scenario.plot(settings, drawn, outcomes)
    labels = figure.axes[1].get_legend_handles_labels()[1]
    assert labels == ["a_cl", "s_cl", "gossip", "gossip, average", "bc", "rek"]


def test_network_scenario_refuses_losses_where_they_break_the_method() -> None:
    settings = network_scenario.settings(nodes=10, radius=0.5, iterations=3000, loss=0.3)
    drawn = network_scenario.draw(settings, trial_rng(0, network_scenario.name, 0))
    assert network_scenario.run(settings, "a_cl", "none", drawn).options["loss"] == 0.3
    with pytest.raises(SettingError, match="every packet"):
        network_scenario.run(settings, "rek", "none", drawn)
