"""gtsam graphs as problems: the same cost everywhere, the same optimum, or an error that says what cannot be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization import measurements as meas
from localization import measurements_3d as meas_3d
from localization.io import g2o
from localization.pose_graph import graph_problem
from problems.errors import FormError
from problems.forms.factor_graph import FactorGraph
from problems.forms.from_gtsam import Imported, from_gtsam
from problems.forms.layout import DataStore, Layout
from problems.forms.least_squares import LeastSquares
from problems.forms.native_factors import native_factors
from problems.forms.template import template_of
from problems.noise import Cauchy, Gaussian, GemanMcClure, Huber, Loss, Tukey
from problems.problem import Problem
from problems.spaces import SE2, Space, Vector
from problems.spatial import SE3

gtsam = pytest.importorskip("gtsam")
noise = gtsam.noiseModel
NATIVE = [
    pytest.param(residual, spaces, id=f"{residual.__name__} {' '.join(space.name for space in spaces)}")
    for residual, spaces, _ in native_factors()
]


def measured(residual: Any, spaces: tuple[Space, ...], rng: np.random.Generator) -> np.ndarray:
    """A measurement of the size that the residual reads."""
    name, size = residual.__name__, {"SE2": 2, "SE3": 3}.get(spaces[0].name, spaces[0].dim)
    if name in ("orientation", "relative_orientation", "pose_log", "relative_pose_log"):
        return spaces[0].normalize_array(rng.normal(size=(1, spaces[0].ambient)))[0]
    return rng.normal(size={"position": size, "relative_position": size, "bearing_range": 2}.get(name, 1))


def random_values(problem: Problem, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {
        name: v.space.normalize_array(rng.normal(size=(v.count, v.space.ambient)))
        for name, v in problem.unknowns.items()
    }


def cost(problem: Problem, values: dict[str, np.ndarray]) -> float:
    layout = Layout(problem)
    return LeastSquares(problem, layout).bind(DataStore(layout)).cost(layout.point(values))


def problem_of(residual: Any, spaces: tuple[Space, ...], loss: Loss | None, rng: np.random.Generator) -> Problem:
    """Two instances of one term with correlated noise, and one of the other variable where spaces differ."""
    problem = Problem("one term")
    a = problem.variables("a", spaces[0], 3)
    if len(spaces) == 1:
        on: Any = a[:2]
    elif spaces[0] == spaces[1]:
        on = (a[:2], a[1:])
    else:
        on = (a[:2], problem.variables("b", spaces[1], 2))
    rows = np.array([measured(residual, spaces, rng) for _ in range(2)])
    data = problem.data("z", rows.shape[1], 2, rows)
    probe = Problem("probe")
    x = [probe.variables(f"x{k}", space) for k, space in enumerate(spaces)]
    probe.cost("r", residual, tuple(x), probe.data("z", rows.shape[1]), Gaussian(1.0))
    dim = template_of(probe.terms["r"]).dim
    root = rng.normal(size=(2, dim, dim)) + 2 * np.eye(dim)
    problem.cost("r", residual, on, data, Gaussian(information=root.swapaxes(1, 2) @ root), loss)
    return problem


@pytest.mark.parametrize("loss", [None, Huber(0.7), Cauchy(2.0), GemanMcClure(3.5), Tukey(40.0)], ids=str)
@pytest.mark.parametrize(("residual", "spaces"), NATIVE)
def test_there_and_back_costs_the_same_everywhere(residual: Any, spaces: tuple[Space, ...], loss: Loss | None) -> None:
    rng = np.random.default_rng(5)
    problem = problem_of(residual, spaces, loss, rng)
    graph, values, key = FactorGraph(problem).to_gtsam(values=random_values(problem, rng))
    found = from_gtsam(graph, values)
    (term,) = found.problem.terms.values()
    assert term.residual in (residual, meas.distance)  # a range to a point is the same from either end
    assert (term.count, term.loss) == (2, problem.terms["r"].loss)
    for _ in range(3):
        point = random_values(problem, rng)
        moved = {name: value.copy() for name, value in found.initial.items()}
        for name, rows in point.items():
            for index, row in enumerate(rows):
                if key(name, index) in found.keys:  # what no factor touches is no variable
                    variable, place = found.keys[key(name, index)]
                    moved[variable][place] = row
        assert cost(found.problem, moved) == pytest.approx(cost(problem, point), rel=1e-9)


def planar() -> tuple[Any, Any]:
    """A graph with everything at once: symbols, points, a fixed pose, robust and shared noise."""
    from gtsam.symbol_shorthand import L, X

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(1, 2, 0.5), noise.Constrained.All(3)))
    for k in range(3):
        step = gtsam.Pose2(1, 0.1, 0.3)
        graph.add(gtsam.BetweenFactorPose2(X(k), X(k + 1), step, noise.Diagonal.Sigmas([0.1, 0.2, 0.05])))
    fair = noise.Diagonal.Sigmas([0.1, 0.3])
    robust = noise.Robust.Create(noise.mEstimator.Huber.Create(1.345), fair)
    graph.add(gtsam.BearingRangeFactor2D(X(0), L(5), gtsam.Rot2(0.3), 2.0, fair))
    graph.add(gtsam.BearingRangeFactor2D(X(2), L(5), gtsam.Rot2(-0.5), 1.0, robust))
    graph.add(gtsam.RangeFactor2D(X(3), L(9), 1.5, noise.Isotropic.Sigma(1, 0.2)))
    graph.add(gtsam.PriorFactorPoint2(L(9), np.array([3.0, 4.0]), noise.Unit.Create(2)))
    for k in range(4):
        values.insert(X(k), gtsam.Pose2(1 + k, 2 + 0.3 * k, 0.3))
    values.insert(L(5), np.array([2.5, 3.5]))
    values.insert(L(9), np.array([3.5, 4.5]))
    return graph, values


def imported_poses(found: Imported, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Poses x of gtsam's values and of the initial ones, in the same order."""
    rows = [(key, place) for key, (name, place) in found.keys.items() if name == "x"]
    theirs = np.array([[p.x(), p.y(), p.theta()] for p in (values.atPose2(key) for key, _ in rows)])
    return theirs, found.initial["x"][[place for _, place in rows]]


def test_an_imported_graph_has_the_optimum_that_gtsam_finds() -> None:
    graph, values = planar()
    found = from_gtsam(graph, values)
    assert {name: v.count for name, v in found.problem.unknowns.items()} == {"x": 4, "l": 2}
    assert sorted(found.keys.values()) == [("l", 0), ("l", 1), *(("x", k) for k in range(4))]
    np.testing.assert_allclose(*imported_poses(found, values), atol=1e-12)
    assert {term.kind for term in found.problem.terms.values()} == {"cost", "equality"}
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    for solver in ("gauss-newton", "gtsam-lm", "ipopt"):
        solution = found.problem.compile(solver).solve(found.data, initial=found.initial)
        assert solution.solved
        assert solution.objective == pytest.approx(graph.error(best), rel=1e-7)
        for key, (name, place) in found.keys.items():
            if name == "x":
                pose = best.atPose2(key)
                np.testing.assert_allclose(solution["x"][place], [pose.x(), pose.y(), pose.theta()], atol=1e-4)
        np.testing.assert_allclose(solution["x"][0], [1.0, 2.0, 0.5], atol=1e-9)


def pose_graph(space: Space, rng: np.random.Generator) -> str:
    """Text of a small g2o file: a ring of poses with noisy steps and one vertex each."""
    planar = space == SE2
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if planar else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    poses = space.normalize_array(rng.normal(size=(6, space.ambient)))
    one = np.tile(space.identity(), (6, 1))
    step = space.retract_array(one, space.local_array(poses, np.roll(poses, -1, axis=0)))
    step = space.retract_array(step, 0.05 * rng.normal(size=(6, space.dim)))
    root = rng.normal(size=(space.dim, space.dim)) + 5 * np.eye(space.dim)
    weight = (root.T @ root)[np.triu_indices(space.dim)]
    text = [" ".join([vertex, str(k), *(repr(float(v)) for v in pose)]) for k, pose in enumerate(poses)]
    for k, row in enumerate(step):
        ends = (str(k), str((k + 1) % 6))
        text.append(" ".join([edge, *ends, *(repr(float(v)) for v in [*row, *weight])]))
    return "\n".join(text) + "\n"


@pytest.mark.parametrize("space", [SE2, SE3], ids=["2-D", "3-D"])
def test_g2o_goes_in_and_out_through_gtsam(space: Space, tmp_path: Path) -> None:
    path = tmp_path / "ring.g2o"
    path.write_text(pose_graph(space, np.random.default_rng(8)))
    problem, initial = graph_problem(g2o.read(path))
    lowered = FactorGraph(problem)
    assert {term.kind for term in lowered.terms} == {"native", "pinned"}
    graph, values, _ = lowered.to_gtsam(values=initial)
    best = problem.compile("gauss-newton").solve(initial=initial)
    assert best.solved

    gtsam.writeG2o(graph, values, str(tmp_path / "out.g2o"))
    again, start = gtsam.readG2o(str(tmp_path / "out.g2o"), space == SE3)
    found = from_gtsam(again, start)
    pose = next(iter(found.problem.unknowns.values()))
    assert (pose.space, pose.count) == (space, 6)
    held = found.problem.data("first", space.ambient, 1, initial["pose"][:1])
    templates = meas if space == SE2 else meas_3d
    found.problem.equality("first", templates.pose_log, pose[0], held)
    solution = found.problem.compile("gauss-newton").solve(initial=found.initial)
    assert solution.solved
    assert solution.objective == pytest.approx(best.objective, rel=1e-3)  # the file has six digits
    assert np.abs(space.local_array(solution[pose.name], best["pose"])).max() < 1e-3


def refused(factor: Any, match: str, values: Any = None) -> None:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    if values is None:
        values = gtsam.Values()
        for key in factor.keys():
            values.insert(key, gtsam.Pose2(1.0, 2.0, 0.5))
    with pytest.raises(FormError, match=match):
        from_gtsam(graph, values)


def test_what_cannot_be_read_says_so() -> None:
    origin = gtsam.Pose2()
    unit = noise.Unit.Create(3)
    refused(gtsam.PriorFactorPose2(0, origin, unit), "key 0 of the graph has no value", gtsam.Values())
    fair = noise.Robust.Create(noise.mEstimator.Fair.Create(1.0), unit)
    refused(gtsam.PriorFactorPose2(0, origin, fair), r"factor 0 \(PriorFactorPose2\): no loss Fair")
    partly = noise.Constrained.MixedSigmas(1000.0, np.array([0.0, 1.0, 1.0]))
    refused(gtsam.PriorFactorPose2(0, origin, partly), "constrained noise on some rows only")
    custom = gtsam.CustomFactor(unit, [0], lambda this, values, jacobians: np.zeros(3))
    refused(custom, r"factor 0 \(CustomFactor\): no template for it; templates exist for BearingFactor2D, ")
    values = gtsam.Values()
    values.insert(0, gtsam.Cal3_S2())
    refused(gtsam.PriorFactorCal3_S2(0, gtsam.Cal3_S2(), noise.Unit.Create(5)), "key 0 is on a space", values)


def test_a_loss_that_means_something_else_is_noticed() -> None:
    huber = noise.mEstimator.Huber
    by_components = huber.Create(0.5, huber.ReweightScheme.Scalar)
    model = noise.Robust.Create(by_components, noise.Unit.Create(3))
    refused(gtsam.PriorFactorPose2(0, gtsam.Pose2(), model), "the graph costs .* the problem read from it")


def test_keys_of_two_spaces_with_one_letter_are_two_variables() -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(gtsam.symbol("a", 3), gtsam.Pose2(), noise.Unit.Create(3)))
    graph.add(gtsam.PriorFactorPoint2(gtsam.symbol("a", 1), np.zeros(2), noise.Unit.Create(2)))
    values.insert(gtsam.symbol("a", 3), gtsam.Pose2(1, 0, 0))
    values.insert(gtsam.symbol("a", 1), np.ones(2))
    found = from_gtsam(graph, values)
    spaces = {variable.space for variable in found.problem.unknowns.values()}
    assert spaces == {SE2, Vector(2)}
    assert len(found.keys) == 2
