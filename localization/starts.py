"""Starting values of pose graphs: the file's, chained odometry, linear least squares, chordal initialization.

Chordal initialization relaxes orientations to matrices, solves for them by linear least squares, projects them back and
then solves for positions, linear as well (Martinec and Pajdla 2007; Carlone et al. 2015). Recorded truth is never used.
Source: specs ``recordings`` 3 and 5, ``gps-range-bearing-localization`` 10.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from localization import measurements
from localization.io.recording import Edges, PoseGraph
from localization.joining import Placement, join
from problems.errors import DataError, SettingError, UnknownNameError
from problems.noise import Gaussian
from problems.problem import Problem
from problems.solvers.session import Solution
from problems.spaces import SE2, Space, Vector
from problems.spatial import SE3, quaternion_product, rotate_array

DRIFT = 2.0  # m, of chained poses while a landmark is located by ranges from them

Initial = Literal["auto", "file", "odometry", "chordal", "ls"]


@dataclass(frozen=True, eq=False)
class Start:
    """Values to start from and how they were made.

    Attributes:
        values: ``pose`` (n, 3 | 7) and, where there are landmarks, ``landmark`` (l, 2 | 3).
        poses: ``file``, ``odometry``, ``chordal`` or ``ls``.
        landmarks: how landmarks were found: ``file``, ``sightings``, ``priors``, ``multilateration``, joined by ``+``;
            empty without.
        placed: parts of the graph that relative poses do not join to the rest, and where they were put.
    """

    values: dict[str, np.ndarray]
    poses: str
    landmarks: str
    placed: tuple[Placement, ...] = ()


def starting_values(graph: PoseGraph, first: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
    """The values of `choose_start` with ``initial="auto"``."""
    return choose_start(graph, first=first).values


def choose_start(
    graph: PoseGraph, initial: Initial = "auto", first: Mapping[str, Any] | None = None, solver: str = "gauss-newton"
) -> Start:
    """Poses and landmarks to start from.

    A chain starts where a pose has a prior, at a pose of `first`, or at the identity. It prefers relative poses between
    neighbours (odometry) over loop closures. Parts that relative poses do not join are placed, in the plane, by the
    landmarks they share and the ranges between them (`localization.joining`).

    Args:
        graph: a pose graph; its truth is never used.
        initial: ``file``: its vertices; ``odometry``: chained relative poses; ``chordal``: orientations and positions
            by linear least squares over all relative poses; ``ls``: positions by linear least squares under the
            orientations of the file, else of the chain; ``auto``: the file's where there are any, else the chain.
        first: poses by key, (3,) or (7,), where chains start.
        solver: of the linear problems.

    Raises:
        UnknownNameError: a key of `first` that is no pose.
        SettingError: no such start, or one the graph cannot give.
        DataError: poses that nothing joins and without a value to start from; a landmark that nothing locates.
    """
    if initial not in get_args(Initial):
        raise SettingError(f"initial must be one of {', '.join(get_args(Initial))}, got {initial!r}")
    if initial == "file" and graph.initial is None:
        raise SettingError(f"{graph.name} has no starting values; start at odometry or chordal")
    space = space_of(graph)
    placed: tuple[Placement, ...] = ()
    name = ("odometry" if graph.initial is None else "file") if initial == "auto" else initial
    if graph.initial is None or initial in ("odometry", "chordal"):
        poses, placed = _chained(graph, space, _roots(graph, first))
    else:
        poses = graph.initial
    poses = space.normalize_array(np.array(poses, dtype=float))
    if name in ("chordal", "ls"):
        _require_joined(graph, name)
        base = poses if graph.initial is None else space.normalize_array(np.array(graph.initial, dtype=float))
        turned = _chordal_orientations(graph, base, solver) if name == "chordal" else orientations_of(graph, poses)
        poses = _stored(graph, _linear_positions(graph, turned, base, solver), turned)
    values, found = {"pose": poses}, ""
    if len(graph.landmark_keys):
        if graph.landmark_initial is not None and name == "file":
            values["landmark"], found = np.array(graph.landmark_initial, dtype=float), "file"
        else:
            values["landmark"], found = _located(graph, space, poses)
    return Start(values, name, found, placed)


def space_of(graph: PoseGraph) -> Space:
    """SE2 or SE3."""
    return SE2 if graph.dimension == 2 else SE3


def held_poses(graph: PoseGraph) -> np.ndarray:
    """Poses that are held to fix the gauge: those of the file, else the first one where nothing else is absolute."""
    absolute = len(graph.pose_priors) or len(graph.landmark_priors)
    return np.unique(graph.fixed) if graph.fixed.size or absolute else np.zeros(1, np.intp)


def ranges_by_ends(graph: PoseGraph) -> dict[str, tuple[Edges, tuple[int, int]]]:
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


def _roots(graph: PoseGraph, first: Mapping[str, Any] | None) -> dict[int, np.ndarray]:
    if not first:
        return {}
    known = {str(key): row for row, key in enumerate(graph.keys)}
    for key in first:
        if key not in known:
            raise UnknownNameError("pose", key, known)
    return {known[key]: np.asarray(value, dtype=float) for key, value in first.items()}


def _chained(graph: PoseGraph, space: Space, roots: dict[int, np.ndarray]) -> tuple[np.ndarray, tuple[Placement, ...]]:
    """Poses composed along a tree of relative poses that prefers neighbours in the order of the file."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    count, edges = len(graph.keys), graph.relative_poses
    low, high = np.minimum(edges.first, edges.second), np.maximum(edges.first, edges.second)
    pair, row = np.unique(low * count + high, return_index=True)  # the first of several between the same two
    gap = (high - low)[row].astype(float)
    tree = minimum_spanning_tree(csr_array((gap, (low[row], high[row])), shape=(count, count)))
    parts, part = connected_components(tree, directed=False)
    for index, value in zip(graph.pose_priors.index, graph.pose_priors.value, strict=True):
        roots.setdefault(int(index), value)
    start: dict[int, int] = {}
    for pose in roots:
        start.setdefault(int(part[pose]), pose)
    known = set(start)
    for p in range(parts):
        start.setdefault(p, int(np.argmax(part == p)))
    parent = np.arange(count)
    for pose in start.values():
        order, before = breadth_first_order(tree, pose, directed=False)
        parent[order[1:]] = before[order[1:]]
    chosen = np.array(list(start.values()))
    poses = np.empty((count, space.ambient))
    poses[chosen] = space.normalize_array(np.array([roots.get(int(pose), space.identity()) for pose in chosen]))
    moving = np.flatnonzero(parent != np.arange(count))
    before = parent[moving]
    edge = row[np.searchsorted(pair, np.minimum(moving, before) * count + np.maximum(moving, before))]
    step = space.normalize_array(edges.value[edge])
    back = edges.first[edge] != before
    step[back] = _inverse(space, step[back])
    poses[moving] = step
    poses = _composed(space, poses, parent)
    return (poses, ()) if parts == 1 else join(graph, poses, part, known)


def _composed(space: Space, poses: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """Poses given in the frame of their parents, in the frame of the roots (their own parents).

    Orientations first: with them known, positions are sums along the tree.
    """
    size, count = (2, 3)[space is SE3], len(poses)
    above = np.append(np.where(parent == np.arange(count), count, parent), count)  # the last one stands for the world
    if size == 2:
        angle = _along(above, np.append(poses[:, 2], 0.0)[:, None], np.add)
    else:
        angle = _along(above, np.vstack([poses[:, 3:], [0, 0, 0, 1]]), quaternion_product)
    turned = space.normalize_array(np.column_stack([np.zeros((count + 1, size)), angle]))
    step = np.zeros((count, space.dim))
    step[:, :size] = poses[:, :size]
    moved = space.retract_array(turned[above[:-1]], step)[:, :size]
    turned[:, :size] = _along(above, np.vstack([moved, np.zeros(size)]), np.add)
    return turned[:-1]


def _along(parent: np.ndarray, values: np.ndarray, product: Callable[[Any, Any], np.ndarray]) -> np.ndarray:
    """Products of values from the last one, the root, to each, by pointer doubling."""
    root = len(parent) - 1
    while (parent != root).any():
        values, parent = product(values.take(parent, axis=0), values), parent.take(parent)
    return values


def _inverse(space: Space, poses: np.ndarray) -> np.ndarray:
    one = np.broadcast_to(space.identity(), poses.shape)
    return space.retract_array(one, space.local_array(poses, one))


def _located(graph: PoseGraph, space: Space, poses: np.ndarray) -> tuple[np.ndarray, str]:
    """Landmarks from their first sighting, their prior, or the ranges to them; and which of these were used."""
    size, count = graph.dimension, len(graph.landmark_keys)
    places = np.full((count, size), np.nan)
    seen, row = np.unique(graph.sightings.second, return_index=True)
    step = np.zeros((seen.size, space.dim))
    step[:, :size] = graph.sightings.value[row]
    places[seen] = space.retract_array(poses[graph.sightings.first[row]], step)[:, :size]
    places[graph.landmark_priors.index] = graph.landmark_priors.value
    used = ["sightings"] * bool(np.setdiff1d(seen, graph.landmark_priors.index).size)
    used += ["priors"] * bool(len(graph.landmark_priors))
    edges = ranges_by_ends(graph)["ranges_to_landmarks"][0]
    left = np.flatnonzero(np.isnan(places[:, 0]))
    for mark in left:
        mine = edges.second == mark
        if size == 3 or mine.sum() < 3:
            raise DataError(
                f"{graph.name}: nothing locates landmark {graph.landmark_keys[mark]!s} (a sighting, a prior or, in the "
                "plane, three ranges from poses); give `landmark_initial` in the recording"
            )
        places[mark] = _multilaterated(poses[edges.first[mine], :2], edges.value[mine, 0])
    return places, "+".join(used + ["multilateration"] * bool(left.size))


def _multilaterated(poses: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    from localization.tracking.multilateration import multilaterate

    return multilaterate(np.column_stack([poses, np.zeros(len(poses))]), ranges, sigma=DRIFT).position


def _require_joined(graph: PoseGraph, name: str) -> None:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends, count = (graph.relative_poses.first, graph.relative_poses.second), len(graph.keys)
    parts = connected_components(coo_array((np.ones(len(ends[0])), ends), shape=(count, count)), directed=False)[0]
    if parts > 1:
        raise SettingError(
            f"{graph.name}: initial={name} needs relative poses that join all poses, and they join them in {parts} "
            "separate parts; start at odometry"
        )


def orientations_of(graph: PoseGraph, poses: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, d, d), body to world."""
    if graph.dimension == 2:
        c, s = np.cos(poses[:, -1]), np.sin(poses[:, -1])
        return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=1)
    axes = [rotate_array(poses[:, 3:], np.tile(axis, (len(poses), 1))) for axis in np.eye(3)]
    return np.stack(axes, axis=2)


def _turned_row(before: Any, after: Any, turn: Any) -> Any:
    """A row of the orientation `before`, turned, is that row of `after`."""
    return turn.T @ before - after


def _held_at(element: Any, value: Any) -> Any:
    return element - value


def _chordal_orientations(graph: PoseGraph, poses: np.ndarray, solver: str) -> np.ndarray:
    """Orientations (n, d, d): linear least squares over matrices, projected to rotations.

    Rows of the matrices do not interact: the problem has one variable per pose and row.
    """
    d, count, edges, priors = graph.dimension, len(graph.keys), graph.relative_poses, graph.pose_priors
    problem = Problem("chordal orientations")
    row = problem.variables("row", Vector(d), d * count)

    def rows_of(nodes: np.ndarray) -> np.ndarray:
        return (d * nodes[:, None] + np.arange(d)).ravel()

    turn = problem.data("turn", (d, d), len(edges), orientations_of(graph, edges.value))
    spread = np.repeat(_angular_sigma(edges.information, d), d)[:, None]
    problem.cost(
        "relative", _turned_row, (row[rows_of(edges.first)], row[rows_of(edges.second)]),
        turn[np.repeat(np.arange(len(edges)), d)], Gaussian(np.broadcast_to(spread, (spread.size, d))),
    )  # fmt: skip
    if len(priors):
        known = problem.data("known", d, d * len(priors), orientations_of(graph, priors.value).reshape(-1, d))
        spread = np.repeat(_angular_sigma(priors.information, d), d)[:, None]
        noise = Gaussian(np.broadcast_to(spread, (spread.size, d)))
        problem.cost("priors", _held_at, row[rows_of(priors.index)], known, noise)
    held = held_poses(graph)
    start = orientations_of(graph, poses)
    if held.size:
        value = problem.data("held_at", d, d * held.size, start[held].reshape(-1, d))
        problem.equality("held", _held_at, row[rows_of(held)], value)
    solution = _solved(problem, {"row": start.reshape(-1, d)}, graph, solver)
    left, _, right = np.linalg.svd(solution["row"].reshape(count, d, d))
    proper = np.ones((count, d))
    proper[:, -1] = np.linalg.det(left @ right)
    return (left * proper[:, None]) @ right


def _angular_sigma(information: np.ndarray, d: int) -> np.ndarray:
    return 1 / np.sqrt(np.trace(information[:, d:, d:], axis1=1, axis2=2) / (information.shape[1] - d))


def _linear_positions(graph: PoseGraph, turned: np.ndarray, poses: np.ndarray, solver: str) -> np.ndarray:
    """Positions (n, d) by linear least squares under known orientations (n, d, d)."""
    d, edges, priors = graph.dimension, graph.relative_poses, graph.pose_priors
    problem = Problem("positions under known orientations")
    place = problem.variables("place", Vector(d), len(graph.keys))
    away = turned[edges.first] @ edges.value[:, :d, None]
    frame = turned[edges.first] @ orientations_of(graph, edges.value)
    weight = frame @ edges.information[:, :d, :d] @ frame.swapaxes(1, 2)
    displacement = problem.data("displacement", d, len(edges), away[:, :, 0])
    problem.cost(
        "relative", measurements.relative_position, (place[edges.first], place[edges.second]), displacement,
        Gaussian(information=(weight + weight.swapaxes(1, 2)) / 2),
    )  # fmt: skip
    if len(priors):
        frame = orientations_of(graph, priors.value)
        weight = frame @ priors.information[:, :d, :d] @ frame.swapaxes(1, 2)
        known = problem.data("known", d, len(priors), priors.value[:, :d])
        noise = Gaussian(information=(weight + weight.swapaxes(1, 2)) / 2)
        problem.cost("priors", measurements.position, place[priors.index], known, noise)
    held = held_poses(graph)
    if held.size:
        value = problem.data("held_at", d, held.size, poses[held, :d])
        problem.equality("held", _held_at, place[held], value)
    return _solved(problem, {"place": poses[:, :d]}, graph, solver)["place"]


def _solved(problem: Problem, initial: dict[str, np.ndarray], graph: PoseGraph, solver: str) -> Solution:
    solution = problem.compile(solver).solve(initial=initial)
    if not np.isfinite(solution.point).all() or str(solution.status) in ("failed", "unbounded", "infeasible"):
        raise DataError(f"{graph.name}: {problem.name} not found: {solution.status}, {solution.message}")
    return solution


def _stored(graph: PoseGraph, places: np.ndarray, turned: np.ndarray) -> np.ndarray:
    if graph.dimension == 2:
        return np.column_stack([places, np.arctan2(turned[:, 1, 0], turned[:, 0, 0])])
    from scipy.spatial.transform import Rotation

    return np.column_stack([places, Rotation.from_matrix(turned).as_quat()])
