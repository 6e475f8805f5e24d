"""Parts of a planar pose graph that no relative poses join, placed by shared landmarks and by ranges between them.

A robot's chain is rigid while it is placed: its frame is one pose, found from what the part and those already placed
have in common, from several starts. Ranges alone leave mirror images; the costs of all minima found are kept, so that
they can be compared after the whole graph was solved. Source: spec ``recordings`` 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from localization.io.recording import PoseGraph
from problems.errors import DataError
from problems.noise import Cauchy, Gaussian
from problems.problem import Problem
from problems.spaces import SE2

DRIFT = 1.0  # m, sigma of what a chain that drifts has in common with others
LEAST = 3  # ranges, or two landmarks, that place a part
TURNS, STARTS = 8, 6
OTHERS = 4  # minima kept beside the best
APART = 0.5  # m between two minima that are different


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a part was put.

    Attributes:
        key: its first pose. robot: its robot, "" where unknown.
        frame: (3,) pose of the part's frame in that of the parts placed before, with the lowest cost.
        cost: of that placement.
        others: (frame (3,), cost) of the other minima found, best first.
        by: ``landmarks``, ``ranges`` or ``landmarks+ranges``.
        poses: (m,) the poses of the part.
    """

    key: str
    robot: str
    frame: np.ndarray
    cost: float
    others: tuple[tuple[np.ndarray, float], ...]
    by: str
    poses: np.ndarray


def join(
    graph: PoseGraph, poses: np.ndarray, part: np.ndarray, known: set[int]
) -> tuple[np.ndarray, tuple[Placement, ...]]:
    """Move the parts that have no place of their own next to those that have.

    Args:
        poses: (n, 3) each part chained in a frame of its own.
        part: (n,) number of the part of each pose.
        known: parts whose frame is known; where there is none, the part with most sightings stays where it is.

    Returns:
        Poses (n, 3), and the placements in the order they were found.

    Raises:
        DataError: parts that landmarks and ranges do not place; names a pose of each.
    """
    poses, parts, rooted, known = poses.copy(), int(part.max()) + 1, set(known), set(known)
    if not known and graph.dimension == 2:
        known = {int(np.argmax(np.bincount(part[graph.sightings.first], minlength=parts)))}
    placements: list[Placement] = []
    while len(known) < parts and graph.dimension == 2:
        links = {p: _links(graph, poses, part, p, known) for p in range(parts) if p not in known}
        best = max(links, key=lambda p: links[p].strength)
        if links[best].strength == 0:
            break
        placements.append(_placed(graph, links[best], np.flatnonzero(part == best)))
        _move(poses, placements[-1].poses, placements[-1].frame)
        known.add(best)
    if len(known) < parts:
        base = known - rooted if not placements else set()  # chosen here, and nothing could be placed beside it
        lost = [str(graph.keys[part == p][0]) for p in range(parts) if p not in known or p in base]
        raise DataError(
            f"{graph.name}: the relative poses join the poses in {parts} separate parts, and {len(lost)} of them "
            "have no pose to start from and share too few landmarks and ranges with the others; give one for each part "
            f"in `first`, such as {', '.join(lost[:5])}"
        )
    return poses, tuple(placements)


def moved(poses: np.ndarray, placement: Placement, choice: int) -> np.ndarray:
    """The poses (n, 3) with one part at another of its minima."""
    out = poses.copy()
    frame = np.broadcast_to(placement.frame, (len(placement.poses), 3))
    out[placement.poses] = SE2.local_array(frame, out[placement.poses])
    _move(out, placement.poses, placement.others[choice][0])
    return out


def _move(poses: np.ndarray, chosen: np.ndarray, frame: np.ndarray) -> None:
    poses[chosen] = SE2.retract_array(np.broadcast_to(frame, (chosen.size, 3)), poses[chosen])


@dataclass(frozen=True, eq=False)
class _Links:
    """What a part has in common with those placed: matched points (k, 2), and ranges (m,) from points to points."""

    own: np.ndarray
    other: np.ndarray
    start: np.ndarray
    end: np.ndarray
    ranges: np.ndarray
    landmarks: int

    @property
    def strength(self) -> int:
        enough = self.landmarks >= 2 or len(self.ranges) >= LEAST
        return (1000 * self.landmarks + len(self.own) + len(self.ranges)) if enough else 0


def _links(graph: PoseGraph, poses: np.ndarray, part: np.ndarray, p: int, known: set[int]) -> _Links:
    placed = np.isin(part, list(known))
    sight = graph.sightings
    seen = SE2.retract_array(poses[sight.first], np.column_stack([sight.value, np.zeros(len(sight))]))[:, :2]
    marks = len(graph.landmark_keys)
    theirs = placed[sight.first]
    times = np.bincount(sight.second[theirs], minlength=marks)
    place = np.full((marks, 2), np.nan)
    for axis in (0, 1):
        total = np.bincount(sight.second[theirs], seen[theirs, axis], minlength=marks)
        place[times > 0, axis] = total[times > 0] / times[times > 0]
    mine = (part[sight.first] == p) & (times[sight.second] > 0)
    nodes = np.vstack([poses[:, :2], place])
    inside = np.concatenate([part == p, np.zeros(marks, bool)])
    outside = np.concatenate([placed, times > 0])
    edges = graph.ranges
    forth, back = inside[edges.first] & outside[edges.second], inside[edges.second] & outside[edges.first]
    start = np.concatenate([edges.first[forth], edges.second[back]])
    end = np.concatenate([edges.second[forth], edges.first[back]])
    z = np.concatenate([edges.value[forth, 0], edges.value[back, 0]])
    common = np.unique(sight.second[mine]).size
    return _Links(seen[mine], place[sight.second[mine]], nodes[start], nodes[end], z, common)


def _matched(frame: Any, own: Any, other: Any) -> Any:
    return frame.transform_from(own) - other


def _ranged(frame: Any, start: Any, end: Any, z: Any) -> Any:
    return ca.norm_2(frame.transform_from(start) - end) - z


def fit_frame(own: np.ndarray, other: np.ndarray, drift: float = DRIFT) -> tuple[np.ndarray, float]:
    """The pose (3,) that brings points `own` (m, 2) onto `other` (m, 2), robustly, and its cost; `drift`: sigma, m.

    Raises:
        DataError: fewer than two different points, which leave the heading open.
    """
    if len(np.unique(other, axis=0)) < 2:
        raise DataError(f"a frame needs at least two different points, got {len(np.unique(other, axis=0))}")
    none = np.zeros((0, 2))
    found = _minima(_Links(own, other, none, none, np.zeros(0), len(np.unique(other, axis=0))), drift)
    return found[0][1], found[0][0]


def _placed(graph: PoseGraph, links: _Links, chosen: np.ndarray) -> Placement:
    found = _minima(links, DRIFT)
    if not found:
        raise DataError(f"{graph.name}: no frame found for the part of {graph.keys[chosen[0]]}; look at its ranges")
    by = "+".join(["landmarks"] * bool(len(links.own)) + ["ranges"] * bool(len(links.ranges)))
    others = tuple((x, cost) for cost, x in found[1 : 1 + OTHERS])
    key, robot = str(graph.keys[chosen[0]]), str(graph.robots[chosen[0]])
    return Placement(key, robot, found[0][1], found[0][0], others, by, chosen)


def _minima(links: _Links, drift: float) -> list[tuple[float, np.ndarray]]:
    """Costs and frames of all minima found, best first."""
    problem = Problem("frame of a part")
    frame = problem.variables("frame", SE2)
    if len(links.own):
        count = len(links.own)
        own, other = problem.data("own", 2, count, links.own), problem.data("other", 2, count, links.other)
        problem.cost("landmarks", _matched, frame, (own, other), Gaussian(drift), Cauchy(2.0))
    if len(links.ranges):
        count = len(links.ranges)
        start, end = problem.data("start", 2, count, links.start), problem.data("end", 2, count, links.end)
        z = problem.data("ranges", (), count, links.ranges)
        problem.cost("ranges", _ranged, frame, (start, end, z), Gaussian(drift), Cauchy(2.0))
    session = problem.compile("gauss-newton")
    found: list[tuple[float, np.ndarray]] = []
    for guess in _guesses(links):
        session.reset()
        solution = session.solve(initial={"frame": guess})
        x = solution["frame"][0].copy()
        if np.isfinite(solution.objective) and all(_gap(links, x, other) > APART for _, other in found):
            found.append((float(solution.objective), x))
    return sorted(found, key=lambda entry: entry[0])


def _gap(links: _Links, one: np.ndarray, other: np.ndarray) -> float:
    """How far two frames put what the part has in common with others apart, m; a part that stands may turn."""
    points = np.vstack([links.own, links.start])
    places = []
    for x, y, heading in (one, other):
        c, s = np.cos(heading), np.sin(heading)
        places.append(points @ np.array([[c, s], [-s, c]]) + (x, y))
    return float(np.linalg.norm(places[0] - places[1], axis=1).mean())


def _guesses(links: _Links) -> list[np.ndarray]:
    """Frames to start from: every heading, with the centre of the part on or around that of its counterparts."""
    here = np.vstack([links.own, links.start]).mean(axis=0)
    there = np.vstack([links.other, links.end]).mean(axis=0)
    reach = float(np.median(links.ranges)) if len(links.ranges) and links.landmarks < 2 else 0.0
    ring = 2 * np.pi * np.arange(STARTS) / STARTS
    centers = there + (reach * np.column_stack([np.cos(ring), np.sin(ring)]) if reach else np.zeros((1, 2)))
    out = []
    for heading in 2 * np.pi * np.arange(TURNS) / TURNS:
        c, s = np.cos(heading), np.sin(heading)
        turned = np.array([[c, -s], [s, c]]) @ here
        out += [np.array([*(center - turned), heading]) for center in centers]
    return out
