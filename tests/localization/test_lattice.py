"""The lattice team and its two problems: sampling, noise-free data, known statistics, one optimum from every solver."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from localization.lattice import (
    Measurements,
    Sigmas,
    angular_gaussian,
    curvature_ratio,
    draw_lattice,
    lattice,
    linear_data,
    linear_problem,
    linear_start,
    measure,
    position_covariances,
    require_anchored,
    split_squared_error,
    team_data,
    team_problem,
)
from problems import registry
from problems.errors import DataError, FormError, ModelWarning, NoiseError, SettingError, UnobservableError
from problems.noise import Cauchy
from problems.solvers.base import Status
from problems.spaces import wrap

SILENT = Sigmas(0.0, 0.0, 0.0, 0.0)
Angles = Literal["geodesic", "chordal"]


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def solve_ml(team: Measurements, solver: str = "gauss-newton", angles: Angles = "geodesic", tolerance: float = 1e-13):
    session = team_problem(team, angles=angles).compile(solver, tolerance=tolerance)
    return session.solve(team_data(team), initial={"robot": linear_start(team)[0]})


def needs(solver: str) -> None:
    if solver not in registry.names("solvers"):
        pytest.skip(f"solver {solver} is not registered")
    try:
        registry.load("solvers", solver)
    except ImportError as error:
        pytest.skip(str(error))


# the world


@pytest.mark.parametrize(("robots", "pairs"), [(2, 1), (4, 4), (9, 12), (10, 13), (36, 60), (37, 61), (100, 180)])
def test_lattice_joins_all_nearest_neighbours_and_no_others(robots: int, pairs: int) -> None:
    places, edges = lattice(robots, spacing=3.0)
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    close = np.argwhere(np.triu(np.isclose(distance, 3.0)))
    np.testing.assert_array_equal(edges, close)
    assert len(edges) == pairs
    assert (distance + 9 * np.eye(robots) >= 3.0 - 1e-12).all()


def test_a_thousand_robots_have_the_edges_of_the_reference() -> None:
    assert 2 * len(lattice(1000)[1]) == 3870


def test_both_robots_of_a_pair_measure() -> None:
    team = draw_lattice(9, rng(), pairs="both")
    seen = set(zip(team.observer.tolist(), team.target.tolist(), strict=True))
    assert len(seen) == 24
    assert seen == {(b, a) for a, b in seen}


def test_the_same_seed_gives_the_same_bytes() -> None:
    one, other = draw_lattice(9, rng(3)), draw_lattice(9, rng(3))
    assert one.bearing_range.tobytes() == other.bearing_range.tobytes()
    assert one.compass.tobytes() == other.compass.tobytes()


@pytest.mark.parametrize(("sigma", "spread"), [(0.05, 0.05), (0.36, 0.40), (0.645, 0.80)])
def test_angles_are_drawn_by_the_direction_of_a_disturbed_unit_vector(sigma: float, spread: float) -> None:
    drawn = angular_gaussian(np.full(200_000, 3.0), sigma, rng())
    assert np.std(wrap(drawn - 3.0)) == pytest.approx(spread, rel=0.02)


def test_headings_fill_the_circle() -> None:
    truth = draw_lattice(2000, rng()).truth
    assert truth is not None
    assert np.histogram(truth[:, 2], bins=4, range=(-np.pi, np.pi))[0].min() > 400


# the problems


@pytest.mark.parametrize("pairs", ["one", "both"])
def test_noise_free_data_cost_nothing_at_the_truth(pairs: Literal["one", "both"]) -> None:
    team = replace(draw_lattice(25, rng(1), pairs=pairs, sigmas=SILENT), sigmas=Sigmas())
    assert team.truth is not None
    for angles in ("geodesic", "chordal"):
        session = team_problem(team, angles=angles).compile("gauss-newton")
        assert session.solve(team_data(team), initial={"robot": team.truth}).objective < 1e-20
    data = linear_data(team)
    linear = linear_problem(team).compile().solve(data)
    assert linear.objective < 1e-20
    np.testing.assert_allclose(linear["robot"], team.truth[:, :2], atol=1e-11)
    reversed_sign = linear_problem(team).compile().solve({**data, "displacements": -data["displacements"]})
    assert reversed_sign.objective > 1.0  # the sign as printed in the source


@pytest.mark.parametrize("phi", [0.0, 0.7, 2.0])
def test_covariance_of_a_displacement_is_that_of_samples(phi: float) -> None:
    count = 400_000
    truth = np.array([[0.0, 0.0, 0.3], [4 * np.cos(phi), 4 * np.sin(phi), 0.0]])
    observer, target = np.zeros(1, int), np.ones(1, int)
    exact = replace(measure(truth, observer, target, rng(), SILENT), sigmas=Sigmas())
    stated = linear_data(exact)["covariances"][0]
    draw = rng(1)
    ranges = 4 + 0.1 * draw.normal(size=count)
    directions = phi + angular_gaussian(np.zeros(count), 0.03, draw) + angular_gaussian(np.zeros(count), 0.05, draw)
    sampled = np.cov(ranges * np.array([np.cos(directions), np.sin(directions)]))
    np.testing.assert_allclose(np.sqrt(np.linalg.eigvalsh(stated)), [0.1, 0.2332], rtol=1e-3)
    np.testing.assert_allclose(stated, sampled, atol=0.02 * 0.2332**2)
    if phi:
        assert np.sign(stated[0, 1]) == np.sign(sampled[0, 1])


def test_the_centroid_is_that_of_the_fixes() -> None:
    team = draw_lattice(25, rng(2))
    for robot in (linear_start(team)[1]["robot"], solve_ml(team)["robot"]):
        np.testing.assert_allclose(robot[:, :2].mean(axis=0), team.gps.mean(axis=0), atol=1e-9)


def test_with_unequal_fixes_the_weighted_centroid_holds() -> None:
    spread = np.repeat(rng(5).uniform(0.5, 4.0, (25, 1)), 2, axis=1)
    team = draw_lattice(25, rng(2), sigmas=Sigmas(spread))
    gps = team.gps.copy()
    gps[np.arange(25) % 3 > 0] = np.nan
    team = replace(team, gps=gps)
    has = ~np.isnan(gps[:, 0])
    for robot in (linear_start(team)[1]["robot"], solve_ml(team)["robot"]):
        difference = robot[has, :2] - gps[has]
        np.testing.assert_allclose((difference / spread[has] ** 2).sum(axis=0), 0, atol=1e-8)
        assert np.abs(difference.mean(axis=0)).max() > 0.05


def campaign(robots: int, runs: int, pairs: Literal["one", "both"]) -> dict[str, np.ndarray]:
    """Centroid and relative parts of the squared errors of GPS, LS and ML, and squared headings; means over runs."""
    first = draw_lattice(robots, rng(0), pairs=pairs)
    linear, nonlinear = linear_problem(first).compile(), team_problem(first).compile("gauss-newton")
    rows: dict[str, list[tuple[float, float]]] = {"gps": [], "ls": [], "ml": [], "heading": []}
    for seed in range(runs):
        team = draw_lattice(robots, rng(100 + seed), pairs=pairs)
        assert team.truth is not None
        ls = linear.solve(linear_data(team))["robot"]
        start = np.column_stack([ls, team.compass])
        ml = nonlinear.solve(team_data(team), initial={"robot": start})["robot"]
        for name, robot in (("gps", team.gps), ("ls", ls), ("ml", ml)):
            rows[name].append(split_squared_error(robot, team.truth))
        errors = [wrap(h - team.truth[:, 2]) for h in (team.compass, ml[:, 2])]
        rows["heading"].append((float(np.mean(errors[0] ** 2)), float(np.mean(errors[1] ** 2))))
    return {name: np.mean(values, axis=0) for name, values in rows.items()}


def expected_relative(robots: int, pairs: Literal["one", "both"]) -> tuple[float, float]:
    """Relative squared error of LS and ML to first order, from covariances written out.

    LS weighs every displacement by (3.8) on its own, while all displacements of one observer share its compass error.
    """
    team = replace(draw_lattice(robots, rng(), pairs=pairs, sigmas=SILENT), sigmas=Sigmas())
    assert team.truth is not None
    J = world_jacobian(team, team.truth)
    place = np.delete(np.arange(3 * robots), np.arange(2, 3 * robots, 3))
    center = np.eye(2 * robots) - np.tile(np.eye(2), (robots, robots)) / robots
    ml = center @ np.linalg.inv(J.T @ J)[np.ix_(place, place)] @ center
    count = len(team.observer)
    A, S, W = np.zeros((2 * count, 2 * robots)), np.zeros((2 * count,) * 2), np.zeros((2 * count,) * 2)
    compass = np.zeros((2 * count, robots))
    for e, (i, j) in enumerate(zip(team.observer, team.target, strict=True)):
        rows = slice(2 * e, 2 * e + 2)
        along = team.truth[j, :2] - team.truth[i, :2]
        r, across = np.linalg.norm(along), np.array([-along[1], along[0]])
        S[rows, rows] = 0.1**2 * np.outer(along, along) / r**2 + 0.03**2 * np.outer(across, across)
        W[rows, rows] = np.linalg.inv(S[rows, rows] + 0.05**2 * np.outer(across, across))
        A[rows, 2 * j : 2 * j + 2], A[rows, 2 * i : 2 * i + 2] = np.eye(2), -np.eye(2)
        compass[rows, i] = across
    S += 0.05**2 * compass @ compass.T
    fix = np.eye(2 * robots) / 4.0
    inverse = np.linalg.inv(A.T @ W @ A + fix)
    ls = center @ inverse @ (A.T @ W @ S @ W @ A + fix) @ inverse @ center
    return float(np.trace(ls)) / robots, float(np.trace(ml)) / robots


def test_mean_squared_errors_of_nine_robots_are_those_expected() -> None:
    found = campaign(9, 400, "one")
    ls, ml = expected_relative(9, "one")
    assert found["gps"].sum() == pytest.approx(8.0, rel=0.05)
    assert found["ls"].sum() == pytest.approx(0.917, rel=0.15)
    assert found["ls"][0] == pytest.approx(8 / 9, rel=0.20)  # four standard errors
    assert found["ls"][1] == pytest.approx(ls, rel=0.12)
    assert found["ml"][1] == pytest.approx(ml, rel=0.12)
    assert 0.85 < found["ml"][1] / found["ls"][1] < 0.95
    compass, estimated = np.sqrt(found["heading"])
    assert compass == pytest.approx(0.05, rel=0.05)
    assert estimated < 0.8 * compass


def test_two_measurements_of_a_pair_halve_the_heading_error() -> None:
    found = campaign(9, 100, "both")
    compass, estimated = np.sqrt(found["heading"])
    assert estimated < 0.6 * compass
    np.testing.assert_allclose([found["ls"][1], found["ml"][1]], expected_relative(9, "both"), rtol=0.25)


def test_a_hundred_robots_gain_more_from_the_nonlinear_problem() -> None:
    found = campaign(100, 40, "one")
    ls, ml = expected_relative(100, "one")
    assert found["ls"][1] == pytest.approx(ls, rel=0.22)
    assert 0.65 < found["ml"][1] / found["ls"][1] < 0.85
    assert ml / ls == pytest.approx(0.808, abs=0.01)


# solvers


@pytest.mark.parametrize("solver", ["ipopt", "gtsam-lm"])
@pytest.mark.parametrize("angles", ["geodesic", "chordal"])
def test_every_solver_finds_the_same_optimum(solver: str, angles: Angles) -> None:
    needs(solver)
    team = draw_lattice(25, rng(4), pairs="both")
    reference = solve_ml(team, angles=angles)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # chordal residuals have no native factor
        found = solve_ml(team, solver, angles, tolerance=1e-11)
    assert found.solved
    np.testing.assert_allclose(found["robot"][:, :2], reference["robot"][:, :2], atol=1e-7)
    np.testing.assert_allclose(wrap(found["robot"][:, 2] - reference["robot"][:, 2]), 0, atol=1e-8)


def test_chordal_and_geodesic_angles_differ_a_little() -> None:
    team = draw_lattice(100, rng(4), pairs="both")
    away = np.abs(solve_ml(team)["robot"] - solve_ml(team, angles="chordal")["robot"])[:, :2].max()
    assert 1e-6 < away < 1e-2


def normal_equations(team: Measurements) -> np.ndarray:
    """Least squares written out: (3.11)."""
    data, n, m = linear_data(team), team.robots, len(team.observer)
    e = np.arange(m)
    incidence = sp.coo_array((np.r_[-np.ones(m), np.ones(m)], (np.r_[e, e], np.r_[team.observer, team.target])), (m, n))
    A = sp.csr_array(sp.kron(incidence, np.eye(2)))
    weight = sp.block_diag(list(np.linalg.inv(data["covariances"])), format="csr")
    fix = 1 / float(team.sigmas.position) ** 2
    H = A.T @ weight @ A + fix * sp.eye_array(2 * n)
    b = A.T @ weight @ data["displacements"].ravel() + fix * team.gps.ravel()
    return spla.spsolve(sp.csc_matrix(H), b).reshape(n, 2)


@pytest.mark.parametrize("robots", [100, 1000])
@pytest.mark.parametrize("solver", ["auto", "gauss-newton", "osqp", "proxqp", "gtsam-lm"])
def test_least_squares_is_the_same_as_qp_and_as_graph(solver: str, robots: int) -> None:
    if solver != "auto":
        needs(solver)
    team = draw_lattice(robots, rng(6), pairs="both")
    solution = linear_problem(team).compile(solver, tolerance=1e-9).solve(linear_data(team))
    assert solution.solved, solution.message
    np.testing.assert_allclose(solution["robot"], normal_equations(team), atol=1e-7)
    assert max(solution.residuals.values()) < 1e-5


@pytest.mark.parametrize("solver", ["highs", "clarabel", "piqp", "daqp", "quadprog"])
def test_no_backend_is_believed_without_its_residual(solver: str) -> None:
    """On this problem without constraints several libraries are known to claim a wrong answer."""
    needs(solver)
    try:
        registry.load("solvers", solver).version()
    except ImportError as error:
        pytest.skip(str(error))
    team = draw_lattice(100, rng(6), pairs="both")
    solution = linear_problem(team).compile(solver).solve(linear_data(team))
    if solution.status is Status.SOLVED:
        np.testing.assert_allclose(solution["robot"], normal_equations(team), atol=1e-4)
    else:
        assert solution.message or solution.residuals["dual"] > 1e-6


def test_least_squares_is_a_start_and_gps_is_not() -> None:
    first = draw_lattice(100, rng(0), pairs="both")
    session = team_problem(first).compile("gauss-newton")
    stuck = 0
    for seed in range(40):
        team = draw_lattice(100, rng(500 + seed), pairs="both")
        data = team_data(team)
        assert team.truth is not None
        costs = {
            name: session.solve(data, initial={"robot": start}).objective
            for name, start in (
                ("ls", linear_start(team)[0]),
                ("truth", team.truth),
                ("gps", np.column_stack([team.gps, team.compass])),
            )
        }
        assert costs["ls"] <= min(costs.values()) * (1 + 1e-7)
        stuck += costs["gps"] > 2 * costs["ls"]
    assert 1 <= stuck <= 15


def test_the_problem_for_graphs_is_refused_by_qp_solvers() -> None:
    team = draw_lattice(4, rng())
    with pytest.raises(FormError, match="'robot' is on SE2"):
        team_problem(team).compile("osqp")
    with pytest.raises(FormError, match="loss"):
        linear_problem(team, loss=Cauchy()).compile("osqp")


# covariance


def world_jacobian(team: Measurements, poses: np.ndarray) -> np.ndarray:
    """Whitened Jacobian of all measurements with respect to (x, y, theta) of every robot, written by hand."""
    n, m, s = team.robots, len(team.observer), team.sigmas
    J = np.zeros((3 * n + 2 * m, 3 * n))
    J[np.arange(2 * n), (3 * np.arange(n)[:, None] + [0, 1]).ravel()] = 1 / float(s.position)
    J[2 * n + np.arange(n), 3 * np.arange(n) + 2] = 1 / s.heading
    for e, (i, j) in enumerate(zip(team.observer, team.target, strict=True)):
        x, y = poses[j, :2] - poses[i, :2]
        r, row = np.hypot(x, y), 3 * n + 2 * e
        J[row, [3 * j, 3 * j + 1]] = np.array([x, y]) / r / s.range
        J[row + 1, [3 * j, 3 * j + 1]] = np.array([-y, x]) / r**2 / s.bearing
        J[row : row + 2, [3 * i, 3 * i + 1]] = -J[row : row + 2, [3 * j, 3 * j + 1]]
        J[row + 1, 3 * i + 2] = -1 / s.bearing
    return J


def test_covariances_are_the_inverse_of_the_information_in_the_world_frame() -> None:
    team = draw_lattice(9, rng(7), pairs="both")
    problem = team_problem(team)
    solution = problem.compile("gauss-newton").solve(team_data(team), initial={"robot": linear_start(team)[0]})
    J = world_jacobian(team, solution["robot"])
    inverse = np.linalg.inv(J.T @ J)
    expected = np.array([inverse[3 * k : 3 * k + 2, 3 * k : 3 * k + 2] for k in range(9)])
    found = position_covariances(solution, problem.unknowns["robot"])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_covariances_predict_the_errors() -> None:
    team = draw_lattice(9, rng(7), pairs="both")
    session = team_problem(team).compile("gauss-newton")
    assert team.truth is not None
    relative, squares = [], []
    for seed in range(200):
        other = draw_lattice(9, rng(seed), pairs="both")
        assert other.truth is not None
        solution = session.solve(team_data(other), initial={"robot": linear_start(other)[0]})
        joint = solution.covariance(session.problem.unknowns["robot"])
        heading = solution["robot"][:, 2]
        turn = np.zeros((18, 27))
        for k, angle in enumerate(heading):
            c, s = np.cos(angle), np.sin(angle)
            turn[2 * k : 2 * k + 2, 3 * k : 3 * k + 2] = [[c, -s], [s, c]]
        world = turn @ joint @ turn.T
        center = np.eye(18) - np.tile(np.eye(2), (9, 9)) / 9
        relative.append(np.trace(center @ world @ center.T) / 9)
        squares.append(split_squared_error(solution["robot"], other.truth)[1])
    assert np.sqrt(np.mean(relative)) == pytest.approx(0.1075, rel=0.05)
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.sqrt(np.mean(relative)), rel=0.1)


def test_covariances_equal_those_of_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam")
    team = draw_lattice(9, rng(7), pairs="both")
    problem = team_problem(team)
    solution = problem.compile("gauss-newton").solve(team_data(team), initial={"robot": linear_start(team)[0]})
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    s, diagonal = team.sigmas, gtsam.noiseModel.Diagonal.Sigmas
    for k, pose in enumerate(solution["robot"]):
        values.insert(k, gtsam.Pose2(*pose))
        gps = gtsam.noiseModel.Isotropic.Sigma(2, float(s.position))
        graph.add(gtsam.PoseTranslationPrior2D(k, team.gps[k], gps))
        compass = gtsam.Rot2(team.compass[k])
        graph.add(gtsam.PoseRotationPrior2D(k, compass, gtsam.noiseModel.Isotropic.Sigma(1, s.heading)))
    for i, j, (b, r) in zip(team.observer, team.target, team.bearing_range, strict=True):
        noise = diagonal(np.array([s.bearing, s.range]))
        graph.add(gtsam.BearingRangeFactorPose2(int(i), int(j), gtsam.Rot2(b), float(r), noise))
    marginals = gtsam.Marginals(graph, values)
    found = position_covariances(solution, problem.unknowns["robot"])
    for k, pose in enumerate(solution["robot"]):
        R = gtsam.Rot2(pose[2]).matrix()
        body = marginals.marginalCovariance(k)[:2, :2]
        np.testing.assert_allclose(found[k], R @ body @ R.T, rtol=1e-9, atol=1e-12)


# fences, missing and bad data


def test_a_fence_holds_and_helps() -> None:
    fence = np.full(2, -1.0), np.full(2, 9.0)
    first = draw_lattice(9, rng(0))
    free, fenced = linear_problem(first).compile(), linear_problem(first, fence=fence).compile()
    errors, left = [], 0
    for seed in range(100):
        team = draw_lattice(9, rng(900 + seed))
        assert team.truth is not None
        data = linear_data(team)
        without, inside = free.solve(data)["robot"], fenced.solve(data)
        assert inside.solved
        assert inside["robot"].min() > -1 - 1e-6
        assert inside["robot"].max() < 9 + 1e-6
        outside = (without.min() < -1) or (without.max() > 9)
        left += outside
        assert outside == bool(inside.active_set["fence"].any())
        errors.append([sum(split_squared_error(robot, team.truth)) for robot in (without, inside["robot"])])
    before, after = np.mean(errors, axis=0)
    assert 18 <= left <= 45
    assert after < 0.9 * before


@pytest.mark.parametrize("solver", ["gauss-newton", "ipopt"])
def test_the_nonlinear_problem_keeps_the_fence_too(solver: str) -> None:
    needs(solver)
    fence = np.full(2, -0.2), np.full(2, 8.2)
    team = draw_lattice(9, rng(903))
    session = team_problem(team, fence=fence).compile(solver, tolerance=1e-10)
    solution = session.solve(team_data(team), initial={"robot": linear_start(team)[0]})
    assert solution.solved, solution.message
    places = solution["robot"][:, :2]
    assert places.min() > -0.2 - 1e-6
    assert places.max() < 8.2 + 1e-6
    state, force = solution.active_set["fence"], solution.multipliers["fence"]
    assert state.any()
    assert (np.sign(np.where(np.abs(force) > 1e-4, force, 0)) * state >= 0).all()


def test_missing_measurements_are_left_out() -> None:
    team = draw_lattice(9, rng(8), pairs="both")
    seen, compass = team.bearing_range.copy(), team.compass.copy()
    seen[3] = np.nan
    silent = replace(team, bearing_range=seen)
    keep = np.arange(len(team.observer)) != 3
    shorter = replace(
        team, observer=team.observer[keep], target=team.target[keep], bearing_range=team.bearing_range[keep]
    )
    np.testing.assert_allclose(solve_ml(silent)["robot"], solve_ml(shorter)["robot"], atol=1e-7)
    compass[4] = np.nan
    with pytest.raises(DataError, match=r"robot\(s\) 4 measure bearings without a compass"):
        linear_data(replace(team, compass=compass))


def test_groups_without_a_fix_are_named() -> None:
    team = draw_lattice(9, rng(8))
    joins = ((team.observer == 2) & (team.target == 5)) | ((team.observer == 1) & (team.target == 2))
    seen, gps = team.bearing_range.copy(), team.gps.copy()
    seen[joins], gps[2] = np.nan, np.nan
    alone = replace(team, bearing_range=seen, gps=gps)
    with pytest.raises(UnobservableError, match=r"1 group\(s\) of robots connected by measurements: 2;"):
        require_anchored(alone)
    require_anchored(replace(alone, gps=team.gps))


def test_noise_beyond_the_linear_model_is_reported() -> None:
    team = draw_lattice(9, rng(9), sigmas=Sigmas(range=0.001))
    assert curvature_ratio(team).max() > 0.4
    with pytest.warns(ModelWarning, match="curvature ratio reaches 6"):
        linear_data(team)
    nominal = draw_lattice(9, rng(9))
    assert curvature_ratio(nominal).max() == pytest.approx(0.068, rel=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        linear_data(nominal)
    seen = nominal.bearing_range.copy()
    seen[0, 1] = -0.3
    with pytest.warns(ModelWarning, match="1 range.* not positive"):
        data = linear_data(replace(nominal, bearing_range=seen))
    assert np.isnan(data["displacements"][0]).all()
    assert linear_problem(nominal).compile().solve(data).solved


def test_what_has_no_meaning_is_refused() -> None:
    with pytest.raises(SettingError, match="at least 2 robots"):
        lattice(1)
    with pytest.raises(SettingError, match="positive spacing"):
        lattice(4, 0.0)
    with pytest.raises(NoiseError, match="'gps'"):
        team_problem(draw_lattice(4, rng(), sigmas=Sigmas(position=0.0))).compile("gauss-newton")
