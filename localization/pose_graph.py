"""A recorded pose graph as one `Problem` with starting values.

Relative poses, sightings of landmarks, ranges and priors become one term each, whatever their number. The gauge is
fixed exactly: poses the recording holds fixed, or the first one where nothing else is absolute, are equalities and not
strong priors. Source: specs ``recordings`` 3 and 5, ``gps-range-bearing-localization`` 10 (3-D).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, Literal

import numpy as np

from localization import measurements, measurements_3d
from localization.io.recording import Edges, PoseGraph, Priors
from problems.errors import DataError, SettingError, UnknownNameError
from problems.noise import Gaussian, Loss
from problems.problem import Problem
from problems.spaces import SE2, Space, Vector
from problems.spatial import SE3

DRIFT = 2.0  # m, of chained poses while a landmark is located by ranges from them

TERMS = ("relative_poses", "sightings", "ranges", "pose_priors", "landmark_priors")


def graph_problem(
    graph: PoseGraph,
    chart: Literal["log", "plain"] = "log",
    losses: Mapping[str, Loss] | None = None,
    first: Mapping[str, Any] | None = None,
) -> tuple[Problem, dict[str, np.ndarray]]:
    """The problem of a pose graph and the values to start from.

    Args:
        graph: as read, values finite.
        chart: of relative poses and pose priors: ``log`` is the full logarithm (gtsam's), ``plain`` takes translation
            and rotation apart. The two have different optima (up to 10 % in cost).
        losses: robust losses by name of `TERMS`.
        first: poses by key to start chains of relative poses from; see `starting_values`.

    Returns:
        The problem, with variables ``pose`` and ``landmark`` and all measurements as default data, and ``initial``.

    Raises:
        SettingError, UnknownNameError: no such chart; a loss for no term.
        DataError: as `starting_values`.
    """
    if chart not in ("log", "plain"):
        raise SettingError(f"chart must be 'log' or 'plain', got {chart!r}")
    losses = {} if losses is None else dict(losses)
    for name in losses:
        if name not in TERMS:
            raise UnknownNameError("term of a pose graph", name, TERMS)
    initial = starting_values(graph, first)
    space, templates = _dimension(graph)
    relative, absolute = (
        (templates.relative_pose_log, templates.pose_log)
        if chart == "log"
        else (templates.relative_pose, templates.pose)
    )
    problem = Problem(graph.name)
    pose = problem.variables("pose", space, len(graph.keys))
    marks = len(graph.landmark_keys)
    mark = problem.variables("landmark", Vector(graph.dimension), marks) if marks else None

    def add(name: str, residual: Callable[..., Any], measured: Edges | Priors, ends: Any, term: str = "") -> None:
        if not len(measured):
            return
        if isinstance(measured, Edges):
            on = (ends[0][measured.first], ends[1][measured.second])
        else:
            on = ends[measured.index]
        data = problem.data(f"{name}_measured", measured.value.shape[1], len(measured), measured.value)
        problem.cost(name, residual, on, data, _noise(measured.information), losses.get(term or name))

    add("relative_poses", relative, graph.relative_poses, (pose, pose))
    add("pose_priors", absolute, graph.pose_priors, pose)
    add("sightings", templates.landmark, graph.sightings, (pose, mark))
    add("landmark_priors", templates.position, graph.landmark_priors, mark)
    for name, (edges, ends) in _ranges(graph).items():
        add(name, templates.distance, edges, tuple(mark if end else pose for end in ends), "ranges")
    held = _held(graph)
    if held.size:
        value = problem.data("held_at", space.ambient, held.size, initial["pose"][held])
        problem.equality("held", templates.pose, pose[held], value)
    return problem, initial


def starting_values(graph: PoseGraph, first: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
    """Poses and landmarks to start from: the file's, else chained relative poses, first sightings and multilateration.

    A chain starts where a pose has a prior, at a pose of `first`, or, where the relative poses join all poses, at the
    identity in the first pose. It prefers relative poses between neighbours (odometry) over loop closures.

    Args:
        graph: a pose graph; its truth is never used.
        first: poses by key, (3,) or (7,), where chains start.

    Returns:
        ``pose`` (n, 3 | 7) and, where there are landmarks, ``landmark`` (l, 2 | 3).

    Raises:
        UnknownNameError: a key of `first` that is no pose.
        DataError: poses that the relative poses do not join and without a value to start from; a landmark that nothing
            locates.
    """
    space, _ = _dimension(graph)
    poses = _chained(graph, space, _roots(graph, first)) if graph.initial is None else graph.initial
    initial = {"pose": space.normalize_array(np.array(poses, dtype=float))}
    if len(graph.landmark_keys):
        marks = graph.landmark_initial
        initial["landmark"] = _located(graph, space, initial["pose"]) if marks is None else np.array(marks, float)
    return initial


def _dimension(graph: PoseGraph) -> tuple[Space, ModuleType]:
    return (SE2, measurements) if graph.dimension == 2 else (SE3, measurements_3d)


def _roots(graph: PoseGraph, first: Mapping[str, Any] | None) -> dict[int, np.ndarray]:
    if not first:
        return {}
    known = {str(key): row for row, key in enumerate(graph.keys)}
    for key in first:
        if key not in known:
            raise UnknownNameError("pose", key, known)
    return {known[key]: np.asarray(value, dtype=float) for key, value in first.items()}


def _held(graph: PoseGraph) -> np.ndarray:
    absolute = len(graph.pose_priors) or len(graph.landmark_priors)
    return np.unique(graph.fixed) if graph.fixed.size or absolute else np.zeros(1, np.intp)


def _noise(information: np.ndarray) -> Gaussian:
    """The cheapest way to say it: one for all instances, standard deviations where nothing is correlated."""
    if (information == information[0]).all():
        information = information[:1]
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    if np.count_nonzero(information) == np.count_nonzero(diagonal):
        sigma = 1 / np.sqrt(diagonal)
        return Gaussian(sigma=sigma if len(sigma) > 1 else sigma[0])
    return Gaussian(information=information if len(information) > 1 else information[0])


def _ranges(graph: PoseGraph) -> dict[str, tuple[Edges, tuple[int, int]]]:
    """Ranges by what they join: edges whose ends count poses (0) or landmarks (1), poses first."""
    poses, edges = len(graph.keys), graph.ranges
    low, high = np.minimum(edges.first, edges.second), np.maximum(edges.first, edges.second)
    parts = {"ranges": (0, 0), "ranges_to_landmarks": (0, 1), "ranges_between_landmarks": (1, 1)}
    found = {}
    for name, (a, b) in parts.items():
        pick = (low >= poses).astype(int) + (high >= poses) == a + b
        one, other = low[pick] - a * poses, high[pick] - b * poses
        found[name] = (Edges(one, other, edges.value[pick], edges.information[pick], edges.time[pick]), (a, b))
    return found


def _chained(graph: PoseGraph, space: Space, roots: dict[int, np.ndarray]) -> np.ndarray:
    """Poses composed along a tree of relative poses that prefers neighbours in the order of the file."""
    import scipy.sparse as sp
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    count, edges = len(graph.keys), graph.relative_poses
    low, high = np.minimum(edges.first, edges.second), np.maximum(edges.first, edges.second)
    pair, row = np.unique(low * count + high, return_index=True)  # the first of several between the same two
    gap = (high - low)[row].astype(float)
    tree = minimum_spanning_tree(sp.csr_array((gap, (low[row], high[row])), shape=(count, count)))
    parts, part = connected_components(tree, directed=False)
    for index, value in zip(graph.pose_priors.index, graph.pose_priors.value, strict=True):
        roots.setdefault(int(index), value)
    if parts == 1 and not roots:
        roots = {0: space.identity()}
    start: dict[int, int] = {}
    for pose in roots:
        start.setdefault(int(part[pose]), pose)
    if len(start) < parts:
        lost = [str(graph.keys[part == p][0]) for p in range(parts) if p not in start]
        raise DataError(
            f"{graph.name}: the relative poses join the poses in {parts} separate parts, and {len(lost)} of them have "
            f"no pose to start from; give one for each part in `first`, such as {', '.join(lost[:5])}"
        )
    parent = np.arange(count)
    for pose in start.values():
        order, before = breadth_first_order(tree, pose, directed=False)
        parent[order[1:]] = before[order[1:]]
    chosen = np.array(list(start.values()))
    poses = np.empty((count, space.ambient))
    poses[chosen] = space.normalize_array(np.array([roots[pose] for pose in chosen]))
    moving = np.flatnonzero(parent != np.arange(count))
    before = parent[moving]
    edge = row[np.searchsorted(pair, np.minimum(moving, before) * count + np.maximum(moving, before))]
    step = space.normalize_array(edges.value[edge])
    poses[moving] = np.where((edges.first[edge] == before)[:, None], step, _inverse(space, step))
    return _composed(space, poses, parent)


def _composed(space: Space, poses: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """Poses given in the frame of their parents, in the frame of the roots (their own parents), by pointer doubling."""
    parent = parent.copy()
    waiting = np.flatnonzero(parent != np.arange(len(parent)))
    settled = parent == np.arange(len(parent))
    while waiting.size:
        over = parent[waiting]
        poses[waiting] = _product(space, poses[over], poses[waiting])
        settled_now = settled[over]
        parent[waiting] = parent[over]
        settled[waiting[settled_now]] = True
        waiting = waiting[~settled_now]
    return poses


def _plain(space: Space, poses: np.ndarray) -> np.ndarray:
    return space.local_array(np.broadcast_to(space.identity(), poses.shape), poses)


def _product(space: Space, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return space.retract_array(a, _plain(space, b))


def _inverse(space: Space, poses: np.ndarray) -> np.ndarray:
    one = np.broadcast_to(space.identity(), poses.shape)
    return space.retract_array(one, space.local_array(poses, one))


def _located(graph: PoseGraph, space: Space, poses: np.ndarray) -> np.ndarray:
    """Landmarks from their first sighting, their prior, or the ranges to them."""
    size, count = graph.dimension, len(graph.landmark_keys)
    places = np.full((count, size), np.nan)
    seen, row = np.unique(graph.sightings.second, return_index=True)
    step = np.zeros((seen.size, space.dim))
    step[:, :size] = graph.sightings.value[row]
    places[seen] = space.retract_array(poses[graph.sightings.first[row]], step)[:, :size]
    places[graph.landmark_priors.index] = graph.landmark_priors.value
    edges = _ranges(graph)["ranges_to_landmarks"][0]
    for mark in np.flatnonzero(np.isnan(places[:, 0])):
        mine = edges.second == mark
        if size == 3 or mine.sum() < 3:
            raise DataError(
                f"{graph.name}: nothing locates landmark {graph.landmark_keys[mark]!s} (a sighting, a prior or, in the "
                "plane, three ranges from poses); give `landmark_initial` in the recording"
            )
        places[mark] = _multilaterated(poses[edges.first[mine], :2], edges.value[mine, 0])
    return places


def _multilaterated(poses: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    from localization.tracking.multilateration import multilaterate

    return multilaterate(np.column_stack([poses, np.zeros(len(poses))]), ranges, sigma=DRIFT).position
