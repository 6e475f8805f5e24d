"""A recorded pose graph as one `Problem` with starting values.

Relative poses, sightings of landmarks, ranges and priors become one term each, whatever their number. The gauge is
fixed exactly: poses the recording holds fixed, or the first one where nothing else is absolute, are equalities and not
strong priors. Source: specs ``recordings`` 3 and 5, ``gps-range-bearing-localization`` 10 (3-D).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any, Literal

import numpy as np

from localization import measurements, measurements_3d
from localization.io.recording import Edges, PoseGraph, Priors
from localization.starts import held_poses, ranges_by_ends, space_of, starting_values
from problems.errors import SettingError, UnknownNameError
from problems.noise import L2, Gaussian, Loss
from problems.problem import Problem
from problems.spaces import Vector

__all__ = ["TERMS", "evaluate", "graph_problem", "is_odometry", "starting_values"]

TERMS = (
    "relative_poses", "odometry", "loop_closures", "sightings", "ranges", "pose_priors", "landmark_priors",
)  # fmt: skip


def graph_problem(
    graph: PoseGraph,
    chart: Literal["log", "plain"] = "log",
    losses: Mapping[str, Loss] | None = None,
    first: Mapping[str, Any] | None = None,
    start: Mapping[str, np.ndarray] | None = None,
    odometry_scale: float = 1.0,
) -> tuple[Problem, dict[str, np.ndarray]]:
    """The problem of a pose graph and the values to start from.

    Args:
        graph: as read, values finite.
        chart: of relative poses and pose priors: ``log`` is the full logarithm (gtsam's), ``plain`` takes translation
            and rotation apart. The two have different optima (up to 10 % in cost).
        losses: robust losses by name of `TERMS`. ``odometry`` (relative poses of neighbours in the order of the file,
            same robot) and ``loop_closures`` (all others) say it apart for the two kinds of ``relative_poses``.
        first: poses by key to start chains of relative poses from; see `localization.starts.choose_start`.
        start: values to start from; by default those of `starting_values`.
        odometry_scale: factor of the standard deviations of odometry.

    Returns:
        The problem, with variables ``pose`` and ``landmark`` and all measurements as default data, and ``initial``.
        Relative poses are one term ``relative_poses`` unless the two kinds have different losses; then they are the
        terms ``odometry`` and ``loop_closures``.

    Raises:
        SettingError, UnknownNameError: no such chart, a scale that is not positive; a loss for no term.
        DataError: as `starting_values`.
    """
    if chart not in ("log", "plain"):
        raise SettingError(f"chart must be 'log' or 'plain', got {chart!r}")
    losses = {} if losses is None else dict(losses)
    for name in losses:
        if name not in TERMS:
            raise UnknownNameError("term of a pose graph", name, TERMS)
    if not odometry_scale > 0:
        raise SettingError(f"odometry_scale must be positive, got {odometry_scale!r}")
    initial = starting_values(graph, first) if start is None else dict(start)
    space, templates = space_of(graph), _templates(graph)
    relative, absolute = (
        (templates.relative_pose_log, templates.pose_log)
        if chart == "log"
        else (templates.relative_pose, templates.pose)
    )
    problem = Problem(graph.name)
    pose = problem.variables("pose", space, len(graph.keys))
    marks = len(graph.landmark_keys)
    mark = problem.variables("landmark", Vector(graph.dimension), marks) if marks else None

    def add(name: str, residual: Callable[..., Any], measured: Edges | Priors, ends: Any, loss: Loss | None) -> None:
        if not len(measured):
            return
        if isinstance(measured, Edges):
            on = (ends[0][measured.first], ends[1][measured.second])
        else:
            on = ends[measured.index]
        data = problem.data(f"{name}_measured", measured.value.shape[1], len(measured), measured.value)
        problem.cost(name, residual, on, data, _noise(measured.information), loss)

    for name, (edges, loss) in _relative_poses(graph, losses, odometry_scale).items():
        add(name, relative, edges, (pose, pose), loss)
    add("pose_priors", absolute, graph.pose_priors, pose, losses.get("pose_priors"))
    add("sightings", templates.landmark, graph.sightings, (pose, mark), losses.get("sightings"))
    add("landmark_priors", templates.position, graph.landmark_priors, mark, losses.get("landmark_priors"))
    for name, (edges, ends) in ranges_by_ends(graph).items():
        add(name, templates.distance, edges, tuple(mark if end else pose for end in ends), losses.get("ranges"))
    held = held_poses(graph)
    if held.size:
        value = problem.data("held_at", space.ambient, held.size, initial["pose"][held])
        problem.equality("held", templates.pose, pose[held], value)
    return problem, initial


def evaluate(problem: Problem, values: Mapping[str, Any]) -> tuple[float, float]:
    """Cost at some values by variable name, and the largest entry of its gradient on unknowns that are not held.

    The problem's data are their defaults.
    """
    from problems.forms.layout import DataStore, Layout
    from problems.forms.least_squares import LeastSquares
    from problems.forms.pins import Pins

    layout = Layout(problem)
    bound = LeastSquares(problem, layout).bind(DataStore(layout))
    cost, gradient, _ = bound.linearize(layout.point(values))
    gradient[Pins(layout).columns] = 0.0
    return cost, float(np.abs(gradient).max())


def is_odometry(graph: PoseGraph) -> np.ndarray:
    """Which relative poses (m,) join neighbours in the order of the file and of one robot."""
    edges = graph.relative_poses
    near = np.abs(edges.second - edges.first) == 1
    return near & (graph.robots[edges.first] == graph.robots[edges.second])


def _templates(graph: PoseGraph) -> ModuleType:
    return measurements if graph.dimension == 2 else measurements_3d


def _relative_poses(
    graph: PoseGraph, losses: Mapping[str, Loss], odometry_scale: float
) -> dict[str, tuple[Edges, Loss]]:
    """Relative poses in as many terms as they have losses, with the scale of odometry in their weights."""
    edges, odometry = graph.relative_poses, is_odometry(graph)
    if odometry_scale != 1:
        information = edges.information.copy()
        information[odometry] /= odometry_scale**2
        edges = replace(edges, information=information)
    common = losses.get("relative_poses", L2())
    first, second = losses.get("odometry", common), losses.get("loop_closures", common)
    if first == second:
        return {"relative_poses": (edges, first)}
    return {"odometry": (_chosen(edges, odometry), first), "loop_closures": (_chosen(edges, ~odometry), second)}


def _chosen(edges: Edges, rows: np.ndarray) -> Edges:
    return Edges(*(getattr(edges, field)[rows] for field in ("first", "second", "value", "information", "time")))


def _noise(information: np.ndarray) -> Gaussian:
    """The cheapest way to say it: one for all instances, standard deviations where nothing is correlated."""
    if (information == information[0]).all():
        information = information[:1]
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    if np.count_nonzero(information) == np.count_nonzero(diagonal):
        sigma = 1 / np.sqrt(diagonal)
        return Gaussian(sigma=sigma if len(sigma) > 1 else sigma[0])
    return Gaussian(information=information if len(information) > 1 else information[0])
