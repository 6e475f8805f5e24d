"""Range-aided pose graphs in PyFG text files, 2-D and 3-D, read and written.

Source: spec recordings 3. Matrices in the file are covariances (upper triangle, translation first), here information
matrices. Vertices hold the recorded truth, never a starting value.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from localization.io.recording import Edges, PoseGraph, Priors
from localization.io.records import (
    Block,
    Record,
    format_records,
    inverse,
    nodes,
    numbered,
    read_records,
    require_two_ends,
)
from problems.errors import DataError, ReadError

layout = "pyfg: a .pyfg file of VERTEX_SE2, VERTEX_XY, EDGE_SE2, EDGE_SE2_XY, EDGE_RANGE lines or their 3-D forms"

_NAME = re.compile(r"([A-Za-z]+)\d+", re.ASCII)

# by dimension: pose, landmark, pose prior, landmark prior, relative pose, sighting
_TAGS = {
    2: ("VERTEX_SE2", "VERTEX_XY", "VERTEX_SE2:PRIOR", "VERTEX_XY:PRIOR", "EDGE_SE2", "EDGE_SE2_XY"),
    3: (
        "VERTEX_SE3:QUAT",
        "VERTEX_XYZ",
        "VERTEX_SE3:QUAT:PRIOR",
        "VERTEX_XYZ:PRIOR",
        "EDGE_SE3:QUAT",
        "EDGE_SE3_XYZ",
    ),
}


def _records(dimension: int) -> tuple[Record, ...]:
    pose, tangent = ((3, 3), (7, 6))[dimension - 2]
    tags = _TAGS[dimension]
    return (
        Record(tags[0], keys=1, value=pose, timed=True, dimension=dimension),
        Record(tags[1], keys=1, value=dimension, dimension=dimension),
        Record(tags[2], keys=1, value=pose, weight=tangent, timed=True, dimension=dimension),
        Record(tags[3], keys=1, value=dimension, weight=dimension, timed=True, dimension=dimension),
        Record(tags[4], keys=2, value=pose, weight=tangent, timed=True, dimension=dimension),
        Record(tags[5], keys=2, value=dimension, weight=dimension, timed=True, dimension=dimension),
    )


RANGE = Record("EDGE_RANGE", keys=2, value=1, weight=1, timed=True)


def matches(path: str | Path) -> bool:
    """Whether `path` looks like a file of this format."""
    return Path(path).suffix.lower() == ".pyfg"


def read(path: str | Path) -> PoseGraph:
    """Read a PyFG file.

    Raises:
        ReadError: malformed line, name that is not letters and a number, name defined twice or not at all, edge from a
            node to itself, covariance not positive definite; names file, line and what was expected.
    """
    path = Path(path)
    blocks = read_records(path, (*_records(2), *_records(3), RANGE))
    dimension = 3 if any(len(blocks[tag]) for tag in _TAGS[3]) else 2
    pose, mark, pose_prior, mark_prior, relative, sight = (blocks[tag] for tag in _TAGS[dimension])
    distance = blocks[RANGE.tag]
    if not len(pose):
        raise ReadError(path, None, f"at least one {_TAGS[dimension][0]} line", "none")
    both: dict[str, int] = {}
    where: dict[str, int] = {}
    numbered(pose, both, where)
    poses = dict(both)
    numbered(mark, both, where, offset=len(poses))
    marks = {name: row for row, (name,) in enumerate(mark.keys)}
    return PoseGraph(
        name=path.stem,
        dimension=dimension,
        keys=np.array(list(poses), dtype=str),
        time=pose.time,
        robots=np.array(_letters(pose), dtype=str),
        landmark_keys=np.array(list(marks), dtype=str),
        relative_poses=_edges(relative, poses, poses, "pose"),
        sightings=_edges(sight, poses, marks, "landmark"),
        ranges=_edges(distance, both, both, "pose or landmark"),
        pose_priors=_priors(pose_prior, poses, "pose"),
        landmark_priors=_priors(mark_prior, marks, "landmark"),
        truth=pose.value,
        landmark_truth=mark.value if len(mark) else None,
    )


def _letters(block: Block) -> list[str]:
    letters = []
    for row, (name,) in enumerate(block.keys):
        match = _NAME.fullmatch(name)
        if match is None:
            raise block.rows.error(row, "a name of letters (the robot) and a number", repr(name))
        letters.append(match[1])
    return letters


def _edges(block: Block, first: dict[str, int], second: dict[str, int], what: str) -> Edges:
    one = nodes(block, 0, first, "pose" if what != "pose or landmark" else what)
    other = nodes(block, 1, second, what)
    if first is second:
        require_two_ends(block, one, other)
    return Edges(one, other, block.value, inverse(block.rows, block.weight, "covariance"), block.time)


def _priors(block: Block, known: dict[str, int], what: str) -> Priors:
    index = nodes(block, 0, known, what)
    return Priors(index, block.value, inverse(block.rows, block.weight, "covariance"), block.time)


def write(path: str | Path, graph: PoseGraph) -> None:
    """Write a graph with its truth as vertices.

    Raises:
        DataError: the graph has no truth (the format has nothing else for vertices), a time is missing, or a pose is
            not named by letters and a number.
    """
    if graph.truth is None or (len(graph.landmark_keys) and graph.landmark_truth is None):
        raise DataError(f"{graph.name}: PyFG vertices hold the recorded truth, and this graph has none")
    poses, marks = graph.keys.tolist(), graph.landmark_keys.tolist()
    wrong = next((name for name in poses if not _NAME.fullmatch(name)), None)
    if wrong is not None:
        raise DataError(f"{graph.name}: PyFG names poses by letters and a number, got {wrong!r}")
    pose, mark, pose_prior, mark_prior, relative, sight = _records(graph.dimension)
    lines = format_records(pose, [(name,) for name in poses], graph.time, graph.truth, np.zeros((len(poses), 0, 0)))
    if graph.landmark_truth is not None:
        absent = np.zeros(len(marks))
        lines += format_records(
            mark, [(name,) for name in marks], absent, graph.landmark_truth, np.zeros((len(marks), 0, 0))
        )
    for record, priors, names in ((pose_prior, graph.pose_priors, poses), (mark_prior, graph.landmark_priors, marks)):
        keys = [(names[node],) for node in priors.index]
        lines += format_records(record, keys, priors.time, priors.value, np.linalg.inv(priors.information))
    both = poses + marks
    for record, edges, names in (
        (relative, graph.relative_poses, poses),
        (sight, graph.sightings, marks),
        (RANGE, graph.ranges, both),
    ):
        keys = [(both[i], names[j]) for i, j in zip(edges.first, edges.second, strict=True)]
        lines += format_records(record, keys, edges.time, edges.value, np.linalg.inv(edges.information))
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
