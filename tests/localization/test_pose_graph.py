"""Pose graphs as problems: starting values, gauge, every kind of measurement, optima of the recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.io import PoseGraph, open_recording
from localization.io.recording import Edges, Priors
from localization.pose_graph import graph_problem, starting_values
from problems import SE2, SE3, Gaussian, Huber
from problems.errors import DataError, SettingError, UnknownNameError
from problems.spatial import GTSAM_ORDER

SPACES = {2: SE2, 3: SE3}


def product(dimension: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a then b, one pose each, through the plain chart of b."""
    space: Any = SPACES[dimension]
    return space.retract_array(a[None], space.local_array(space.identity()[None], b[None]))[0]


def seen(dimension: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses b in the frames of poses a, stored."""
    space: Any = SPACES[dimension]
    one = np.broadcast_to(space.identity(), a.shape)
    return space.retract_array(one, space.local_array(a, b))


def informations(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Full and different information matrices."""
    root = rng.normal(size=(count, size, size))
    return root @ root.swapaxes(1, 2) + size * np.eye(size)


def edges(first: Any, second: Any, value: np.ndarray, information: np.ndarray) -> Edges:
    first = np.asarray(first, dtype=np.intp)
    return Edges(first, np.asarray(second, dtype=np.intp), value, information, np.full(len(first), np.nan))


def graph(dimension: int, rng: np.random.Generator, poses: int = 12, noise: float = 0.0) -> PoseGraph:
    """A walk with loop closures; the first edge of every third pair is given backwards."""
    space: Any = SPACES[dimension]
    truth = [space.identity()]
    for _ in range(poses - 1):
        turn = rng.normal(scale=0.6, size=space.dim - dimension)
        truth.append(space.retract_array(truth[-1][None], np.concatenate([np.ones(dimension), turn])[None])[0])
    x = np.array(truth)
    first = np.concatenate([np.arange(poses - 1), rng.integers(0, 4, 5)])
    second = np.concatenate([np.arange(1, poses), rng.integers(6, poses, 5)])
    first[::3], second[::3] = second[::3].copy(), first[::3].copy()
    z = seen(dimension, x[first], x[second])
    z = space.retract_array(z, noise * rng.normal(size=(len(first), space.dim)))
    return PoseGraph(
        name="walk",
        dimension=dimension,
        keys=np.array([f"A{k}" for k in range(poses)]),
        time=np.full(poses, np.nan),
        robots=np.full(poses, "A"),
        landmark_keys=np.zeros(0, dtype=str),
        relative_poses=edges(first, second, z, informations(rng, len(first), space.dim)),
        sightings=Edges.none(dimension, dimension),
        ranges=Edges.none(1, 1),
        pose_priors=Priors.none(space.ambient, space.dim),
        landmark_priors=Priors.none(dimension, dimension),
        truth=x,
    )


def solve(problem: Any, initial: dict[str, np.ndarray], **settings: Any) -> Any:
    solution = problem.compile("gauss-newton", **settings).solve(initial=initial)
    assert solution.status == "solved", solution.message
    return solution


def same(dimension: int, a: np.ndarray, b: np.ndarray, tolerance: float = 1e-9) -> None:
    space: Any = SPACES[dimension]
    np.testing.assert_allclose(space.local_array(a, b), 0, atol=tolerance)


@pytest.mark.parametrize("dimension", [2, 3])
def test_chains_are_the_odometry_in_order(dimension: int) -> None:
    g = graph(dimension, np.random.default_rng(0), noise=0.2)
    e, space = g.relative_poses, SPACES[dimension]
    x = [space.identity()]
    for k in range(len(g.keys) - 1):
        step = e.value[k] if e.first[k] == k else seen(dimension, e.value[k][None], space.identity()[None])[0]
        x.append(product(dimension, x[-1], step))
    same(dimension, starting_values(g)["pose"], np.array(x), 1e-12)
    # from another pose: the same chain, moved as a whole
    moved = starting_values(g, {"A5": x[5]})["pose"]
    same(dimension, moved, np.array(x), 1e-12)


def test_a_long_chain_takes_as_many_passes_as_it_doubles_and_stays_exact() -> None:
    count = 3000
    step = np.array([1.0, 0.0, 2 * np.pi / count])
    g = graph(2, np.random.default_rng(1))
    one = np.broadcast_to(np.eye(3), (count, 3, 3))
    circle = edges(np.arange(count), np.arange(1, count + 1), np.tile(step, (count, 1)), one)
    g = replace(g, keys=np.arange(count + 1).astype(str), relative_poses=circle, truth=None)
    x = starting_values(g)["pose"]
    same(2, x[:1], x[-1:], 1e-9)
    radius = 0.5 / np.sin(np.pi / count)
    middle = x[:-1, :2].mean(axis=0)
    np.testing.assert_allclose(np.linalg.norm(x[:, :2] - middle, axis=1), radius, rtol=1e-10)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("chart", ["log", "plain"])
def test_without_noise_the_truth_is_found_and_the_first_pose_stays(dimension: int, chart: Any) -> None:
    rng = np.random.default_rng(2)
    g = graph(dimension, rng)
    space: Any = SPACES[dimension]
    assert g.truth is not None
    start = space.retract_array(g.truth, 0.2 * rng.normal(size=(len(g.keys), space.dim)))
    start[0] = g.truth[0]
    problem, initial = graph_problem(replace(g, initial=start), chart)
    solution = solve(problem, initial)
    assert solution.objective < 1e-16
    same(dimension, solution["pose"], g.truth, 1e-8)
    np.testing.assert_array_equal(solution["pose"][0], start[0])


@pytest.mark.parametrize("dimension", [2, 3])
def test_costs_and_optima_equal_gtsams(dimension: int) -> None:
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(3)
    g = graph(dimension, rng, noise=0.1)
    g = replace(g, pose_priors=prior(g, [4], rng))
    problem, initial = graph_problem(g)
    assert "held" not in problem.terms
    solution = solve(problem, initial)
    order = np.array([0, 1, 2]) if dimension == 2 else GTSAM_ORDER

    def native(x: np.ndarray) -> Any:
        if dimension == 2:
            return gtsam.Pose2(*x)
        return gtsam.Pose3(gtsam.Rot3.Quaternion(x[6], x[3], x[4], x[5]), x[:3])

    def model(information: np.ndarray) -> Any:
        return gtsam.noiseModel.Gaussian.Information(information[np.ix_(order, order)])

    factors, start, found = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Values()
    e, p = g.relative_poses, g.pose_priors
    between = gtsam.BetweenFactorPose2 if dimension == 2 else gtsam.BetweenFactorPose3
    single = gtsam.PriorFactorPose2 if dimension == 2 else gtsam.PriorFactorPose3
    for i, j, z, information in zip(e.first, e.second, e.value, e.information, strict=True):
        factors.add(between(int(i), int(j), native(z), model(information)))
    factors.add(single(4, native(p.value[0]), model(p.information[0])))
    for k in range(len(g.keys)):
        start.insert(k, native(initial["pose"][k]))
        found.insert(k, native(solution["pose"][k]))
    assert factors.error(found) == pytest.approx(solution.objective, rel=1e-9)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    best = gtsam.LevenbergMarquardtOptimizer(factors, start, parameters).optimize()
    assert factors.error(best) == pytest.approx(solution.objective, rel=1e-9)


def prior(g: PoseGraph, index: list[int], rng: np.random.Generator) -> Priors:
    assert g.truth is not None
    space: Any = SPACES[g.dimension]
    value = space.retract_array(g.truth[index], 0.1 * rng.normal(size=(len(index), space.dim)))
    return Priors(np.array(index), value, informations(rng, len(index), space.dim), np.full(len(index), np.nan))


@pytest.mark.parametrize("dimension", [2, 3])
def test_landmarks_and_ranges_of_every_kind(dimension: int) -> None:
    rng = np.random.default_rng(4)
    g = graph(dimension, rng)
    assert g.truth is not None
    marks = rng.normal(scale=4.0, size=(3, dimension))
    poses = len(g.keys)
    space: Any = SPACES[dimension]
    place = np.tile(space.identity(), (3, 1))
    place[:, :dimension] = marks
    look = np.array([0, 3, 7, 9]), np.array([0, 0, 1, 2])
    local = seen(dimension, g.truth[look[0]], place[look[1]])[:, :dimension]
    everything = np.vstack([g.truth[:, :dimension], marks])
    ends = np.array([[1, 8], [poses + 1, 2], [5, poses + 2], [poses, poses + 2]])
    z = np.linalg.norm(everything[ends[:, 0]] - everything[ends[:, 1]], axis=1)[:, None]
    g = replace(
        g,
        landmark_keys=np.array(["L0", "L1", "L2"]),
        sightings=edges(*look, local, informations(rng, 4, dimension)),
        ranges=edges(ends[:, 0], ends[:, 1], z, np.full((4, 1, 1), 25.0)),
        landmark_priors=Priors(np.array([1]), marks[1:2], 4 * np.eye(dimension)[None], np.zeros(1)),
    )
    problem, initial = graph_problem(g, losses={"ranges": Huber(2.0)})
    counts = {name: term.count for name, term in problem.terms.items()}
    assert counts == {
        "relative_poses": 16, "sightings": 4, "landmark_priors": 1,
        "ranges": 1, "ranges_to_landmarks": 2, "ranges_between_landmarks": 1,
    }  # fmt: skip
    assert all((term.loss == Huber(2.0)) == name.startswith("ranges") for name, term in problem.terms.items())
    np.testing.assert_allclose(initial["landmark"], marks, atol=1e-12)
    start = {"pose": initial["pose"], "landmark": marks + 0.1 * rng.normal(size=marks.shape)}
    problem, _ = graph_problem(replace(g, landmark_priors=Priors.none(dimension, dimension)))
    solution = solve(problem, start)
    assert solution.objective < 1e-16
    np.testing.assert_allclose(solution["landmark"], marks, atol=1e-8)
    # a wrong range costs what its own weight says, at the truth
    wrong = replace(g, ranges=replace(g.ranges, value=z + np.array([[0.2], [0.0], [0.0], [0.4]])))
    problem, _ = graph_problem(wrong, losses={})
    problem.equality(
        "poses",
        lambda T, z: space(z).between(T).local(),
        problem.unknowns["pose"],
        problem.data("at", space.ambient, poses, g.truth),
    )
    problem.equality(
        "marks", lambda p, z: p - z, problem.unknowns["landmark"], problem.data("mark_at", dimension, 3, marks)
    )
    assert solve(problem, start).objective == pytest.approx(25 / 2 * (0.2**2 + 0.4**2))


def test_landmarks_with_nothing_but_ranges_are_multilaterated() -> None:
    rng = np.random.default_rng(5)
    g = graph(2, rng)
    assert g.truth is not None
    mark = np.array([3.0, -4.0])
    z = np.linalg.norm(g.truth[:, :2] - mark, axis=1)[:, None]
    count = len(g.keys)
    g = replace(
        g,
        landmark_keys=np.array(["L0"]),
        ranges=edges(np.arange(count), np.full(count, count), z, np.ones((count, 1, 1))),
    )
    np.testing.assert_allclose(starting_values(g)["landmark"], mark[None], atol=1e-4)
    few = replace(
        g,
        ranges=replace(
            g.ranges,
            first=g.ranges.first[:2],
            second=g.ranges.second[:2],
            value=z[:2],
            information=np.ones((2, 1, 1)),
            time=np.zeros(2),
        ),
    )
    with pytest.raises(DataError, match="nothing locates landmark L0"):
        starting_values(few)


def test_gauge_is_fixed_where_the_recording_says_and_only_there() -> None:
    rng = np.random.default_rng(6)
    g = graph(2, rng, noise=0.05)
    assert g.truth is not None
    held, initial = graph_problem(replace(g, initial=g.truth, fixed=np.array([7, 3])))
    solution = solve(held, initial)
    np.testing.assert_allclose(solution["pose"][[3, 7]], g.truth[[3, 7]], atol=1e-13)
    assert not np.allclose(solution["pose"][0], g.truth[0], atol=1e-6)
    free, initial = graph_problem(replace(g, pose_priors=prior(g, [2], rng)))
    assert "held" not in free.terms
    solution = solve(free, initial)
    # one prior only places the graph: it is met exactly
    np.testing.assert_allclose(solution["pose"][2], free.inputs["pose_priors_measured"].value[0], atol=1e-9)  # type: ignore[index]


def test_parts_that_nothing_joins_need_their_starts() -> None:
    g = graph(2, np.random.default_rng(7))
    assert g.truth is not None
    e = g.relative_poses
    apart = (e.first < 6) == (e.second < 6)
    g = replace(g, relative_poses=edges(e.first[apart], e.second[apart], e.value[apart], e.information[apart]))
    with pytest.raises(DataError, match=r"2 separate parts.*A0, A6"):
        starting_values(g)
    with pytest.raises(DataError, match=r"1 of them.*A6"):
        starting_values(g, {"A2": [0, 0, 0]})
    poses = starting_values(g, {"A2": g.truth[2], "A8": g.truth[8]})["pose"]
    same(2, poses, g.truth)
    rng = np.random.default_rng(8)
    one = replace(g, pose_priors=prior(g, [9], rng))
    np.testing.assert_allclose(starting_values(one, {"A0": g.truth[0]})["pose"][9], one.pose_priors.value[0])


def test_the_files_values_come_first_and_are_normalized() -> None:
    g = graph(3, np.random.default_rng(9))
    start = np.tile([1.0, 2.0, 3.0, 0, 0, 0, 2.0], (len(g.keys), 1))
    np.testing.assert_array_equal(starting_values(replace(g, initial=start))["pose"][4], [1, 2, 3, 0, 0, 0, 1])


def test_wrong_arguments_are_named() -> None:
    g = graph(2, np.random.default_rng(10))
    with pytest.raises(SettingError, match="chart.*'gtsam'"):
        graph_problem(g, "gtsam")  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="relative_pose.*did you mean relative_poses"):
        graph_problem(g, losses={"relative_pose": Huber()})
    with pytest.raises(UnknownNameError, match="A99"):
        starting_values(g, {"A99": [0, 0, 0]})


@pytest.mark.parametrize("kind", ["one", "diagonal", "full"])
def test_weights_mean_the_same_however_they_are_said(kind: str) -> None:
    rng = np.random.default_rng(11)
    g = graph(2, rng, noise=0.1)
    count = len(g.relative_poses)
    weights = {
        "one": np.tile(np.diag([4.0, 9.0, 25.0]), (count, 1, 1)),
        "diagonal": np.array([np.diag(row) for row in rng.uniform(1, 9, (count, 3))]),
        "full": informations(rng, count, 3),
    }[kind]
    g = replace(g, relative_poses=replace(g.relative_poses, information=weights))
    problem, initial = graph_problem(g)
    term = problem.terms["relative_poses"]
    assert term.noise is not None and term.noise.kind == ("information" if kind == "full" else "sigma")
    solution = solve(problem, initial)
    plain, _ = graph_problem(g)
    del plain.terms["relative_poses"]
    pose, data = plain.unknowns["pose"], plain.inputs["relative_poses_measured"]
    ends = (pose[g.relative_poses.first], pose[g.relative_poses.second])
    plain.cost("again", term.residual, ends, data, Gaussian(information=weights))
    again = solve(plain, initial)
    assert again.objective == pytest.approx(solution.objective, rel=1e-10)
    same(2, again["pose"], solution["pose"], 1e-7)


OPTIMA = {
    "kitti_05": (78.551925, 5e-7), "manhattan": (1774.520535, 5e-7), "intel": (22.502117, 5e-7),
    "tinyGrid3D": (9.313909, 5e-7), "sphere2500": (675.700963, 5e-7),
}  # fmt: skip


@pytest.mark.parametrize("name", OPTIMA)
def test_recordings_reach_the_optima_of_gtsams_charts(name: str, real_data: Callable[[str], Path]) -> None:
    g = open_recording(real_data(f"g2o/{name}.g2o"))
    problem, initial = graph_problem(g)
    assert g.has_initial == (name not in ("kitti_05", "manhattan"))
    value, tolerance = OPTIMA[name]
    assert solve(problem, initial).objective == pytest.approx(value, abs=2 * tolerance)


def test_the_plain_chart_has_another_optimum(real_data: Callable[[str], Path]) -> None:
    g = open_recording(real_data("g2o/manhattan.g2o"))
    problem, initial = graph_problem(g, chart="plain")
    assert abs(solve(problem, initial).objective / 1774.520535 - 1) > 5e-7


def test_plaza_from_chained_odometry_and_multilateration(real_data: Callable[[str], Path]) -> None:
    g = open_recording(real_data("pyfg/plaza1.pyfg"))
    problem, initial = graph_problem(g)
    found, truth = solve(problem, initial)["pose"][:, :2], g.truth[:, :2]
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    left, _, right = np.linalg.svd(b.T @ a)
    turn = left @ np.diag([1, np.linalg.det(left @ right)]) @ right
    assert np.sqrt(((a @ turn.T - b) ** 2).sum(axis=1).mean()) == pytest.approx(0.301, abs=0.002)  # spec recordings 3
