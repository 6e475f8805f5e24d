"""Pose graphs in g2o text files, 2-D and 3-D, read and written.

Source: spec recordings 5. Matrices are information matrices (upper triangle, translation first). Quaternions are
x y z w. As in gtsam, the rotation block of a 3-D matrix weighs the rotation vector (rad).
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from localization.io.recording import Edges, PoseGraph, Priors
from localization.io.records import (
    Block,
    Record,
    format_records,
    nodes,
    numbered,
    read_records,
    require_two_ends,
)
from problems.errors import DataError, ModelWarning, ReadError

layout = "g2o: a .g2o file of VERTEX_SE2 / EDGE_SE2 or VERTEX_SE3:QUAT / EDGE_SE3:QUAT lines"

RECORDS = {
    record.tag: record
    for record in (
        Record("VERTEX_SE2", keys=1, value=3, dimension=2),
        Record("VERTEX_XY", keys=1, value=2, dimension=2),
        Record("EDGE_SE2", keys=2, value=3, weight=3, dimension=2),
        Record("EDGE_SE2_XY", keys=2, value=2, weight=2, dimension=2),
        Record("VERTEX_SE3:QUAT", keys=1, value=7, dimension=3),
        Record("EDGE_SE3:QUAT", keys=2, value=7, weight=6, dimension=3),
        Record("FIX", keys=1),
    )
}


def matches(path: str | Path) -> bool:
    """Whether `path` looks like a file of this format."""
    return Path(path).suffix.lower() == ".g2o"


def read(path: str | Path) -> PoseGraph:
    """Read a g2o file.

    Vertices become starting values. Where a file has no vertex of a kind (pose or landmark), its edges say which there
    are, in ascending order, and there are no starting values.

    Raises:
        ReadError: malformed line, number defined twice, edge to a number without vertex (in a file that has vertices of
            that kind) or from a pose to itself, matrix not positive definite; names file, line and what was expected.
    """
    path = Path(path)
    blocks = read_records(path, tuple(RECORDS.values()))
    for block in blocks.values():
        _whole_numbers(block)
    dimension = 3 if len(blocks["VERTEX_SE3:QUAT"]) or len(blocks["EDGE_SE3:QUAT"]) else 2
    vertex, edge = (
        blocks[t] for t in (("VERTEX_SE2", "EDGE_SE2"), ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"))[dimension - 2]
    )
    point, sight, fix = blocks["VERTEX_XY"], blocks["EDGE_SE2_XY"], blocks["FIX"]
    poses: dict[str, int] = {}
    marks: dict[str, int] = {}
    if len(vertex):
        numbered(vertex, poses, {})
    else:
        poses = _ascending([name for names in edge.keys for name in names] + [names[0] for names in sight.keys])
    if len(point):
        numbered(point, marks, {})
    else:
        marks = _ascending([names[1] for names in sight.keys])
    for block, place in ((point, 0), (sight, 1)):
        for row, names in enumerate(block.keys):
            if names[place] in poses:
                raise block.rows.error(row, "the number of a landmark", f"{names[place]!r}, which is a pose")
    if not poses:
        raise ReadError(path, None, "at least one pose", "none")
    first, second = nodes(edge, 0, poses, "pose"), nodes(edge, 1, poses, "pose")
    require_two_ends(edge, first, second)
    return PoseGraph(
        name=path.stem,
        dimension=dimension,
        keys=np.array(list(poses), dtype=str),
        time=np.full(len(poses), np.nan),
        robots=np.full(len(poses), "", dtype="U1"),
        landmark_keys=np.array(list(marks), dtype=str),
        relative_poses=Edges(first, second, edge.value, edge.weight, edge.time),
        sightings=Edges(
            nodes(sight, 0, poses, "pose"), nodes(sight, 1, marks, "landmark"), sight.value, sight.weight, sight.time
        )
        if dimension == 2
        else Edges.none(3, 3),
        ranges=Edges.none(1, 1),
        pose_priors=Priors.none(*((3, 3) if dimension == 2 else (7, 6))),
        landmark_priors=Priors.none(dimension, dimension),
        initial=vertex.value if len(vertex) else None,
        landmark_initial=point.value if len(point) else None,
        fixed=nodes(fix, 0, poses, "pose"),
    )


def _whole_numbers(block: Block) -> None:
    for row, names in enumerate(block.keys):
        for place, name in enumerate(names):
            if not (name.isascii() and name.isdigit()):
                raise block.rows.error(row, "a whole number as name", repr(name))
            names[place] = name.lstrip("0") or "0"


def _ascending(names: list[str]) -> dict[str, int]:
    return {name: row for row, name in enumerate(sorted(set(names), key=lambda name: (len(name), name)))}


def write(path: str | Path, graph: PoseGraph) -> None:
    """Write a graph; its starting values become vertices.

    Names that are whole numbers are kept; otherwise nodes are numbered, poses first. The format has no ranges, priors
    and 3-D landmarks: they are left out with a warning.

    Raises:
        DataError: starting values of the wrong shape.
    """
    planar = graph.dimension == 2
    poses, marks = len(graph.keys), len(graph.landmark_keys) if planar else 0
    lost = {"ranges": len(graph.ranges), "priors": len(graph.pose_priors) + len(graph.landmark_priors)}
    lost["3-D landmark sightings"] = 0 if planar else len(graph.sightings)
    for what, count in lost.items():
        if count:
            warnings.warn(f"g2o has no line for {what}: {count} of {graph.name} left out", ModelWarning, stacklevel=2)
    names = [*graph.keys.tolist(), *graph.landmark_keys.tolist()[:marks]]
    if not all(name.isascii() and name.isdigit() for name in names):
        names = [str(node) for node in range(poses + marks)]
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if planar else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    lines = _vertices(RECORDS[vertex], names[:poses], graph.initial)
    if planar:
        lines += _vertices(RECORDS["VERTEX_XY"], names[poses:], graph.landmark_initial)
    lines += [f"FIX {names[pose]}" for pose in graph.fixed]
    lines += _edges(RECORDS[edge], names, names, graph.relative_poses)
    if planar:
        lines += _edges(RECORDS["EDGE_SE2_XY"], names, names[poses:], graph.sightings)
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _vertices(record: Record, names: list[str], values: np.ndarray | None) -> list[str]:
    if values is None:
        return []
    if values.shape != (len(names), record.value):
        raise DataError(f"{record.tag}: expected values ({len(names)}, {record.value}), got {values.shape}")
    absent = np.full(len(names), np.nan)
    return format_records(record, [(name,) for name in names], absent, values, np.zeros((len(names), 0, 0)))


def _edges(record: Record, first: list[str], second: list[str], edges: Edges) -> list[str]:
    ends = [(first[i], second[j]) for i, j in zip(edges.first, edges.second, strict=True)]
    return format_records(record, ends, edges.time, edges.value, edges.information)
