"""What working means for spec ``gps-range-bearing-localization`` (its section 9): least squares and maximum likelihood.

Its item 21 (times) is in ``benchmarks/``. Item numbers stand in the names of the tests.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from localization_worlds import SILENT, generator, solve_ls

from localization.consensus.rates import (
    consensus_weights,
    step_limit,
)
from localization.consensus.relative import measure_differences
from localization.lattice import (
    Measurements,
    Sigmas,
    draw_lattice,
    lattice,
    linear_data,
    linear_problem,
    linear_start,
    position_covariances,
    require_anchored,
    split_squared_error,
    team_data,
    team_problem,
)
from problems.errors import DataError, ModelWarning, NoiseError, SettingError, TopologyError, UnobservableError
from problems.networks import Network, complete
from problems.solvers.base import Status
from problems.spaces import wrap


def solve_ml(team: Measurements, solver: str = "gauss-newton", angles: Any = "geodesic", start: Any = None) -> Any:
    session = team_problem(team, angles=angles).compile(solver, tolerance=1e-12)
    return session.solve(team_data(team), initial={"robot": linear_start(team)[0] if start is None else start})


@pytest.mark.parametrize("pairs", ["one", "both"])
def test_8_noise_free_data_cost_nothing_at_the_truth(pairs: Any) -> None:
    team = replace(draw_lattice(9, generator(8), pairs=pairs, sigmas=SILENT), sigmas=Sigmas())
    assert team.truth is not None and np.ptp(team.truth[:, 2]) > 2
    for angles in ("geodesic", "chordal"):
        solution = solve_ml(team, angles=angles, start=team.truth)
        assert solution.objective < 1e-20
        np.testing.assert_allclose(solution["robot"], team.truth, atol=1e-10)
    solution = linear_problem(team).compile().solve(linear_data(team))
    np.testing.assert_allclose(solution["robot"], team.truth[:, :2], atol=1e-10)
    assert solution.objective < 1e-20


@pytest.mark.parametrize("phi", [0.0, 0.7, 2.0])
def test_9_covariance_of_relative_positions_is_that_of_samples(phi: float) -> None:
    heading, sigmas, rng = 0.4, Sigmas(), generator(9)
    seen = np.array([[phi - heading, 4.0]])
    team = Measurements(np.zeros((2, 2)), np.array([heading, 0.0]), np.array([0]), np.array([1]), seen, sigmas)
    covariance = linear_data(team)["covariances"][0]
    count = 1_000_000
    r = 4.0 + sigmas.range * rng.normal(size=count)
    angle = phi + sigmas.bearing * rng.normal(size=count) + sigmas.heading * rng.normal(size=count)
    sampled = np.cov(np.stack([r * np.cos(angle), r * np.sin(angle)]))
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    local = turn.T @ covariance @ turn
    np.testing.assert_allclose(np.sqrt(np.diag(local)), [0.1, 0.2332], atol=5e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(turn.T @ sampled @ turn)), np.sqrt(np.diag(local)), rtol=0.01)
    np.testing.assert_allclose(covariance, sampled, atol=0.02 * np.abs(covariance).max())


def test_10_centroids_are_those_of_the_fixes() -> None:
    team = draw_lattice(16, generator(10))
    for estimate in (solve_ls(team), solve_ml(team)["robot"][:, :2]):
        assert np.abs(estimate.mean(axis=0) - team.gps.mean(axis=0)).max() < 1e-9
    sigma = generator(1).uniform(0.5, 3.0, (16, 1)).repeat(2, axis=1)
    gps = np.full((16, 2), np.nan)
    gps[::3] = team.gps[::3]
    few = replace(team, gps=gps, sigmas=replace(team.sigmas, position=sigma))
    weight = 1 / sigma[::3] ** 2
    for estimate in (solve_ls(few), solve_ml(few)["robot"][:, :2]):
        assert np.abs((weight * (estimate[::3] - gps[::3])).sum(axis=0)).max() < 1e-8
        assert np.abs((estimate[::3] - gps[::3]).mean(axis=0)).max() > 0.05


@pytest.mark.parametrize("s", [1e-3, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("method", ["ls", "ml"])
def test_11_precise_relative_measurements_leave_the_centroid_only(s: float, method: str) -> None:
    team = draw_lattice(9, generator(11), sigmas=Sigmas(2.0, s, s, s))
    assert team.truth is not None
    truth = team.truth[:, :2]
    expected = team.gps.mean(axis=0) + truth - truth.mean(axis=0)
    # One solution of the normal equations loses the centroid below 1e-5; Gauss-Newton steps refine it.
    found = solve_ls(team, "gauss-newton") if method == "ls" else solve_ml(team)["robot"][:, :2]
    assert np.abs(found - expected).max() < 10 * s


def test_11_coarse_relative_measurements_leave_the_fixes() -> None:
    sharp = draw_lattice(9, generator(11))
    team = replace(sharp, sigmas=Sigmas(2.0, 0.05, 1e6, 1e6))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        assert np.abs(solve_ls(team) - team.gps).max() < 1e-4


@cache
def lattice_campaign(robots: int, pairs: Any, runs: int) -> dict[str, np.ndarray]:
    """Squared errors (runs, 2) as centroid and relative part, and heading rms (runs,), by estimator."""
    rng, first = generator(12), draw_lattice(robots, generator(), pairs=pairs)
    linear, nonlinear = linear_problem(first).compile(), team_problem(first).compile("gauss-newton")
    errors: dict[str, list[Any]] = {name: [] for name in ("gps", "ls", "ml", "compass", "heading")}
    for _ in range(runs):
        team = draw_lattice(robots, rng, pairs=pairs)
        assert team.truth is not None
        ls = linear.solve(linear_data(team))["robot"].copy()
        ml = nonlinear.solve(team_data(team), initial={"robot": np.column_stack([ls, team.compass])})["robot"]
        for name, estimate in (("gps", team.gps), ("ls", ls), ("ml", ml)):
            errors[name].append(split_squared_error(estimate, team.truth))
        for name, heading in (("compass", team.compass), ("heading", ml[:, 2])):
            errors[name].append(np.mean(wrap(heading - team.truth[:, 2]) ** 2))
    return {name: np.array(values) for name, values in errors.items()}


def expected_relative_part(robots: int) -> float:
    """Relative part of the LS error to first order, m^2, in pair mode at nominal noise.

    Weights as the estimator takes them; noise as it is, where all bearings of a robot share its compass error.
    """
    places, pairs = lattice(robots)
    s, m = Sigmas(), len(pairs)
    away = places[pairs[:, 1]] - places[pairs[:, 0]]
    r = np.linalg.norm(away, axis=1)
    along = away / r[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    a, weight, noise = np.zeros((2 * m, 2 * robots)), np.zeros((2 * m, 2 * m)), np.zeros((2 * m, 2 * m))
    for e, (i, j) in enumerate(pairs):
        rows = slice(2 * e, 2 * e + 2)
        a[rows, 2 * j : 2 * j + 2], a[rows, 2 * i : 2 * i + 2] = np.eye(2), -np.eye(2)
        tangential = (r[e] * s.heading) ** 2 + (r[e] * s.bearing) ** 2
        radial, side = np.outer(along[e], along[e]), np.outer(across[e], across[e])
        weight[rows, rows] = radial / s.range**2 + side / tangential
        noise[rows, rows] = s.range**2 * radial + (r[e] * s.bearing) ** 2 * side
        for f in np.flatnonzero(pairs[:, 0] == i):
            noise[rows, 2 * f : 2 * f + 2] += r[e] * r[f] * s.heading**2 * np.outer(across[e], across[f])
    fix = np.eye(2 * robots) / 2.0**2
    inverse = np.linalg.inv(fix + a.T @ weight @ a)
    covariance = inverse @ (fix + a.T @ weight @ noise @ weight @ a) @ inverse
    center = np.eye(2 * robots) - np.kron(np.ones((robots, robots)) / robots, np.eye(2))
    return float(np.trace(center @ covariance @ center)) / robots


def test_12_squared_errors_at_nominal_noise() -> None:
    nine = lattice_campaign(9, "one", 400)
    gps, ls, ml = (nine[name].mean(axis=0) for name in ("gps", "ls", "ml"))
    assert gps.sum() == pytest.approx(8.0, rel=0.05)
    assert ls.sum() == pytest.approx(0.917, rel=0.15)
    assert ls[0] == pytest.approx(0.889, rel=0.15)
    # The spec prints 0.028, from 60 runs. The runs scatter by 60 %, so that value is known to 8 % only and lies above
    # what the noise model implies to first order, 0.0235; the 400 runs here meet the latter.
    expected = expected_relative_part(9)
    assert expected == pytest.approx(0.0235, abs=5e-4)
    assert ls[1] == pytest.approx(expected, rel=0.15)
    assert 0.05 < 1 - ml[1] / ls[1] < 0.15
    hundred = lattice_campaign(100, "one", 60)
    assert hundred["ls"].mean(axis=0)[1] == pytest.approx(expected_relative_part(100), rel=0.15)
    assert 0.15 < 1 - hundred["ml"].mean(axis=0)[1] / hundred["ls"].mean(axis=0)[1] < 0.35


def test_13_headings_improve_on_the_compass() -> None:
    for pairs, gain in (("one", 0.2), ("both", 0.4)):
        run = lattice_campaign(9, pairs, 400)
        compass, heading = np.sqrt(run["compass"].mean()), np.sqrt(run["heading"].mean())
        assert compass == pytest.approx(0.05, rel=0.05)
        assert heading < (1 - gain) * compass


def test_14_one_optimum_from_every_solver() -> None:
    team = draw_lattice(36, generator(14), pairs="both")
    best = {}
    for angles in ("geodesic", "chordal"):
        found = {s: solve_ml(team, s, angles)["robot"].copy() for s in ("gauss-newton", "ipopt")}
        if angles == "geodesic":
            found["gtsam-lm"] = solve_ml(team, "gtsam-lm", angles)["robot"].copy()
        best[angles] = found["gauss-newton"]
        for robot in found.values():
            assert np.abs(robot[:, :2] - best[angles][:, :2]).max() < 1e-7
    apart = np.abs(best["geodesic"][:, :2] - best["chordal"][:, :2]).max()
    assert 1e-6 < apart < 1e-2


@pytest.mark.parametrize("robots", [100, 1000])
def test_15_one_least_squares_solution_from_every_solver(robots: int) -> None:
    team = draw_lattice(robots, generator(15), pairs="both")
    problem, data = linear_problem(team), linear_data(team)
    best = problem.compile("gauss-newton", tolerance=1e-12).solve(data)["robot"].copy()
    for solver in ("gtsam-gn", "osqp", "proxqp"):
        solution = problem.compile(solver, tolerance=1e-9).solve(data)
        assert solution.solved, solver
        assert np.abs(solution["robot"] - best).max() < 1e-7, solver
    checked = problem.compile("highs").solve(data)
    assert checked.status is not Status.SOLVED or np.abs(checked["robot"] - best).max() < 1e-5


def test_16_starts_at_least_squares_never_end_in_a_wrong_basin() -> None:
    first = draw_lattice(100, generator(), pairs="both")
    session = team_problem(first).compile("gauss-newton")
    worse = 0
    for seed in range(40):
        team = draw_lattice(100, generator(seed), pairs="both")
        assert team.truth is not None
        cost = {}
        for name, start in (
            ("ls", linear_start(team)[0]),
            ("truth", team.truth),
            ("gps", np.column_stack([team.gps, team.compass])),
        ):
            cost[name] = session.solve(team_data(team), initial={"robot": start}).objective
        assert cost["ls"] == pytest.approx(min(cost.values()), rel=1e-6)
        worse += cost["gps"] > 1.5 * cost["ls"]
    assert 1 <= worse <= 15  # why least squares is where the nonlinear problem starts


def test_19_covariances_are_the_inverse_information_in_world_axes() -> None:
    team = draw_lattice(9, generator(19), pairs="both")
    dense = {}
    for solver in ("gauss-newton", "gtsam-lm"):
        problem = team_problem(team)
        solution = problem.compile(solver, tolerance=1e-12).solve(
            team_data(team), initial={"robot": linear_start(team)[0]}
        )
        dense[solver] = position_covariances(solution, problem.unknowns["robot"])
    poses = solve_ml(team)["robot"]
    information = numeric_information(team, poses)
    index = 3 * np.arange(9)[:, None] + np.arange(2)
    inverse = np.linalg.inv(information)
    expected = inverse[index[:, :, None], index[:, None, :]]
    for found in dense.values():
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
    apart = np.abs(dense["gauss-newton"] - dense["gtsam-lm"]).max() / np.abs(expected).max()
    assert apart < 1e-7


def numeric_information(team: Measurements, poses: np.ndarray) -> np.ndarray:
    """J'J in world coordinates (x, y, heading), derivatives of the model in closed form."""
    n, s = len(poses), team.sigmas
    rows = []
    for i in range(n):
        for k, sigma in ((0, 2.0), (1, 2.0), (2, s.heading)):
            row = np.zeros(3 * n)
            row[3 * i + k] = 1 / sigma
            rows.append(row)
    for i, j in zip(team.observer, team.target, strict=True):
        away = poses[j, :2] - poses[i, :2]
        r = np.linalg.norm(away)
        ranging, bearing = np.zeros(3 * n), np.zeros(3 * n)
        ranging[3 * j : 3 * j + 2] = away / r
        bearing[3 * j : 3 * j + 2] = np.array([-away[1], away[0]]) / r**2
        for row in (ranging, bearing):
            row[3 * i : 3 * i + 2] = -row[3 * j : 3 * j + 2]
        bearing[3 * i + 2] = -1
        rows += [ranging / s.range, bearing / s.bearing]
    jacobian = np.array(rows)
    return jacobian.T @ jacobian


def test_20_bad_worlds_are_named() -> None:
    rng = generator(20)
    split = measure_differences(Network(4, [(0, 1), (2, 3)], undirected=True), rng.random((4, 1)), 1.0, rng)
    with pytest.raises(TopologyError, match="0, 1; 2, 3"):
        split.require_connected()
    whole = measure_differences(complete(5), rng.random((5, 1)), 1.0, rng)
    with pytest.raises(SettingError, match="R_min / \\(2 d_max\\)"):
        consensus_weights(whole, step_limit(whole))
    with pytest.raises(NoiseError, match="variance 0"):
        replace(whole, variance=np.zeros(len(whole.tail)))
    team = draw_lattice(4, rng)
    with pytest.raises(UnobservableError, match="0, 1, 2, 3"):
        require_anchored(replace(team, gps=np.full((4, 2), np.nan)))
    with pytest.raises(NoiseError):
        team_problem(replace(team, sigmas=Sigmas(range=0.0)))
    blind = team.compass.copy()
    blind[0] = np.nan
    with pytest.raises(DataError, match="robot\\(s\\) 0 measure bearings without"):
        linear_data(replace(team, compass=blind))
