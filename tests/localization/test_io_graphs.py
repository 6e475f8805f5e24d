"""g2o and PyFG files: counts and values against an independent reading, round trips, the formats' traps, bad lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localization.io import Edges, PoseGraph, Priors, g2o, pyfg
from localization.io.samples import loop_sample, range_graph_sample
from localization.io.scoring import ate
from problems.errors import DataError, ModelWarning, ReadError
from problems.spaces import SE2

Find = Callable[[str], Path]


def words(file: Path, tag: str) -> list[list[str]]:
    return [line.split() for line in file.read_text().splitlines() if line.split()[:1] == [tag]]


def assert_same(one: PoseGraph, other: PoseGraph) -> None:
    for name in ("keys", "landmark_keys", "robots", "fixed"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    for name in ("initial", "landmark_initial", "truth", "landmark_truth", "time"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12, err_msg=name)
    for name in ("relative_poses", "sightings", "ranges", "pose_priors", "landmark_priors"):
        a, b = getattr(one, name), getattr(other, name)
        for part in ("first", "second", "index", "value", "information", "time"):
            if hasattr(a, part):
                np.testing.assert_allclose(getattr(a, part), getattr(b, part), rtol=1e-12, err_msg=f"{name}.{part}")


@pytest.mark.parametrize("name", ["intel", "manhattan", "kitti_05", "sphere2500", "tinyGrid3D"])
def test_g2o_equals_the_file(real_data: Find, tmp_path: Path, name: str) -> None:
    file = real_data(f"g2o/{name}.g2o")
    graph = g2o.read(file)
    spatial = name in ("sphere2500", "tinyGrid3D")
    vertices = words(file, "VERTEX_SE3:QUAT" if spatial else "VERTEX_SE2")
    edges = words(file, "EDGE_SE3:QUAT" if spatial else "EDGE_SE2")
    assert graph.dimension == 2 + spatial and graph.truth is None
    assert graph.has_initial == (name not in ("manhattan", "kitti_05"))
    if vertices:
        assert graph.keys.tolist() == [row[1] for row in vertices]
        assert graph.initial is not None and graph.initial.shape == (len(vertices), 7 if spatial else 3)
        np.testing.assert_array_equal(graph.initial[:, :2], [[float(v) for v in row[2:4]] for row in vertices])
    else:
        assert graph.keys.tolist() == [str(k) for k in sorted({int(k) for row in edges for k in row[1:3]})]
    assert graph.keys[graph.relative_poses.first].tolist() == [row[1] for row in edges]
    assert graph.keys[graph.relative_poses.second].tolist() == [row[2] for row in edges]
    width, size = (7, 6) if spatial else (3, 3)
    value = np.array([[float(v) for v in row[3 : 3 + width]] for row in edges])
    np.testing.assert_allclose(graph.relative_poses.value, value, atol=2e-6)
    for k in (0, len(edges) // 2, len(edges) - 1):
        entries = iter(edges[k][3 + width :])
        for i in range(size):
            for j in range(i, size):
                entry = float(next(entries))
                assert graph.relative_poses.information[k, i, j] == entry == graph.relative_poses.information[k, j, i]
    g2o.write(tmp_path / "again.g2o", graph)
    assert_same(graph, g2o.read(tmp_path / "again.g2o"))


@pytest.mark.parametrize("name", ["small", "plaza1", "mrclam3b"])
def test_pyfg_equals_the_file(real_data: Find, tmp_path: Path, name: str) -> None:
    file = real_data(f"pyfg/{name}.pyfg")
    graph = pyfg.read(file)
    counts = Counter(line.split()[0] for line in file.read_text().splitlines())
    assert len(graph.keys) == counts["VERTEX_SE2"] and len(graph.landmark_keys) == counts["VERTEX_XY"]
    assert len(graph.relative_poses) == counts["EDGE_SE2"] and len(graph.sightings) == counts["EDGE_SE2_XY"]
    assert len(graph.ranges) == counts["EDGE_RANGE"] and not len(graph.pose_priors)
    assert graph.initial is None and graph.truth is not None and not graph.has_initial
    assert graph.robots.tolist() == [key[0] for key in graph.keys]
    nodes = np.concatenate([graph.keys, graph.landmark_keys])
    ranges = words(file, "EDGE_RANGE")
    assert nodes[graph.ranges.first].tolist() == [row[2] for row in ranges]
    assert nodes[graph.ranges.second].tolist() == [row[3] for row in ranges]
    variance = [float(row[5]) for row in ranges]
    np.testing.assert_allclose(1 / graph.ranges.information[:, 0, 0], variance, rtol=1e-12)
    for k, row in enumerate(words(file, "EDGE_SE2")[:50]):
        assert graph.relative_poses.time[k] == float(row[1])
        np.testing.assert_allclose(np.linalg.inv(graph.relative_poses.information[k])[2, 2], float(row[12]))
    assert (np.abs(graph.relative_poses.value[:, 2]) <= np.pi).all()
    pyfg.write(tmp_path / "again.pyfg", graph)
    assert_same(graph, pyfg.read(tmp_path / "again.pyfg"))


def test_odometry_of_plaza_agrees_with_its_truth(real_data: Find) -> None:
    graph = pyfg.read(real_data("pyfg/plaza1.pyfg"))
    assert graph.truth is not None
    edges, chain = graph.relative_poses, graph.truth.copy()
    for k in range(len(edges)):
        i, j = edges.first[k], edges.second[k]
        chain[j] = SE2.retract_array(chain[i : i + 1], edges.value[k : k + 1])[0]
    assert ate(chain[:, :2], graph.truth[:, :2]) < 3  # 1.5 m in the spec; a wrong angle or frame gives tens of metres


@pytest.mark.parametrize("dimension", [2, 3])
def test_samples_keep_everything_through_a_round_trip(tmp_path: Path, dimension: int) -> None:
    graph = range_graph_sample(np.random.default_rng(1), dimension)
    pyfg.write(tmp_path / "g.pyfg", graph)
    read = pyfg.read(tmp_path / "g.pyfg")
    assert_same(graph, read)
    assert len(read.sightings) and len(read.ranges) and len(read.pose_priors) and len(read.landmark_priors)
    assert (read.ranges.second >= len(read.keys)).any() and (read.ranges.second < len(read.keys)).any()
    loop = loop_sample(np.random.default_rng(1), dimension)
    g2o.write(tmp_path / "g.g2o", replace(loop, fixed=np.array([0])))
    assert_same(replace(loop, fixed=np.array([0])), g2o.read(tmp_path / "g.g2o"))
    # covariances in the one, information in the other
    line = words(tmp_path / "g.pyfg", "EDGE_RANGE")[0]
    assert float(line[5]) == pytest.approx(0.01)
    line = words(tmp_path / "g.g2o", "EDGE_SE2" if dimension == 2 else "EDGE_SE3:QUAT")[0]
    assert float(line[-1]) == pytest.approx(2500)


@pytest.mark.parametrize("dimension", [2, 3])
def test_sample_measurements_fit_their_poses(dimension: int) -> None:
    graph = range_graph_sample(np.random.default_rng(2), dimension)
    assert graph.truth is not None and graph.landmark_truth is not None
    points = np.vstack([graph.truth[:, :dimension], graph.landmark_truth])
    distance = np.linalg.norm(points[graph.ranges.first] - points[graph.ranges.second], axis=1)
    assert np.std(graph.ranges.value[:, 0] - distance) == pytest.approx(0.1, rel=0.5)
    norms = np.linalg.norm(graph.landmark_truth[graph.sightings.second] - points[graph.sightings.first], axis=1)
    assert np.abs(np.linalg.norm(graph.sightings.value, axis=1) - norms).max() < 0.25
    loop = loop_sample(np.random.default_rng(2), dimension)
    assert loop.initial is not None and len(loop.relative_poses) == 39 + 20
    start = loop.initial[loop.relative_poses.second, :dimension] - loop.initial[loop.relative_poses.first, :dimension]
    length = np.linalg.norm(loop.relative_poses.value[:, :dimension], axis=1)
    np.testing.assert_allclose(np.linalg.norm(start[:39], axis=1), length[:39], atol=1e-9)  # the chain


def test_edges_near_a_full_turn_are_wrapped(tmp_path: Path) -> None:
    (tmp_path / "a.pyfg").write_text(
        "VERTEX_SE2 0 A3 0 0 4.5\nVERTEX_SE2 1 A4 0 0 0\n\nEDGE_SE2 1 A3 A4 1 0 6.2831 1 0 0 1 0 1\r\n"
    )
    graph = pyfg.read(tmp_path / "a.pyfg")
    assert graph.relative_poses.value[0, 2] == pytest.approx(6.2831 - 2 * np.pi)
    assert graph.truth is not None and graph.truth[0, 2] == pytest.approx(4.5 - 2 * np.pi)


def test_g2o_landmarks_and_their_names(tmp_path: Path) -> None:
    text = "EDGE_SE2 10 2 1 0 0 1 0 0 1 0 1\nEDGE_SE2_XY 2 30 1 2 4 0 4\nFIX 2\n# note\n\n"
    file = tmp_path / "a.g2o"
    file.write_text(text)
    graph = g2o.read(file)
    assert graph.keys.tolist() == ["2", "10"] and graph.landmark_keys.tolist() == ["30"]
    assert graph.relative_poses.first.tolist() == [1] and graph.relative_poses.second.tolist() == [0]
    assert graph.sightings.second.tolist() == [0] and graph.fixed.tolist() == [0]
    file.write_text(text + "VERTEX_XY 30 5 6\n")
    graph = g2o.read(file)
    assert graph.landmark_initial is not None and graph.landmark_initial.tolist() == [[5, 6]]
    g2o.write(file, graph)
    assert_same(graph, g2o.read(file))


def test_what_a_format_cannot_hold_is_said(tmp_path: Path) -> None:
    graph = range_graph_sample(np.random.default_rng(1), 2)
    with pytest.warns(ModelWarning, match="24 of team left out"):
        without = replace(graph, pose_priors=Priors.none(3, 3), landmark_priors=Priors.none(2, 2))
        g2o.write(tmp_path / "a.g2o", replace(without, initial=graph.truth))
    read = g2o.read(tmp_path / "a.g2o")
    assert read.keys.tolist() == [str(k) for k in range(40)]
    np.testing.assert_allclose(read.relative_poses.value, graph.relative_poses.value)
    with pytest.raises(DataError, match="truth"):
        pyfg.write(tmp_path / "a.pyfg", replace(graph, truth=None))
    with pytest.raises(DataError, match="finite"):
        pyfg.write(tmp_path / "a.pyfg", replace(graph, time=np.full(40, np.nan)))
    with pytest.raises(DataError, match="letters"):
        pyfg.write(tmp_path / "a.pyfg", replace(graph, keys=np.arange(40).astype(str)))
    with pytest.raises(DataError, match=r"expected values \(40, 3\)"):
        g2o.write(tmp_path / "a.g2o", replace(without, initial=np.zeros((40, 2)), ranges=Edges.none(1, 1)))


G2O = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1
"""
G2O_3D = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
"""
PYFG = """VERTEX_SE2 0 A0 0 0 0
VERTEX_SE2 1 A1 1 0 0
VERTEX_XY L0 5 5
EDGE_SE2 1 A0 A1 1 0 0 1 0 0 1 0 1
EDGE_RANGE 1 A1 L0 6.4 0.1
"""


@pytest.mark.parametrize(
    ("text", "line", "old", "new", "expected"),
    [
        (G2O, 3, "EDGE_SE2 0", "EDGE_SE4 0", "a line starting with one of"),
        (G2O, 3, " 0 1\n", " 0\n", "9 numbers"),
        (G2O, 3, " 0 1\n", " 0 1 7\n", "9 numbers"),
        (G2O, 3, " 0 1\n", " 0 one\n", "a number"),
        (G2O, 3, " 0 1\n", " 0 nan\n", "finite"),
        (G2O, 3, " 0 1\n", " 0 -1\n", "positive definite"),
        (G2O, 3, " 0 1\n", " 0 0\n", "positive definite"),
        (G2O, 3, "EDGE_SE2 0 1", "EDGE_SE2 0 7", "a pose of this file; found '7'"),
        (G2O, 3, "EDGE_SE2 0 1", "EDGE_SE2 1 1", "two different"),
        (G2O, 3, "EDGE_SE2 0 1", "EDGE_SE2 0 x1", "whole number"),
        (G2O, 3, "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE2 0", "EDGE_SE2, 2 names, 3 value"),
        (G2O, 2, "VERTEX_SE2 1", "VERTEX_SE2 0", "also in line 1"),
        (G2O, 3, "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "FIX 9", "a pose of this file"),
        (G2O, 3, "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE2_XY 0 1 5 5 1 0 1", "the number of a landmark"),
        (G2O_3D, 2, "0 0 1\n", "0 0 2\n", "length 1"),
        (G2O_3D, 3, "0 1 0 1\n", "0 1 0 -1\n", "positive definite"),
        (G2O_3D, 2, "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1", "VERTEX_SE2 1 0 0 0", "one dimension"),
        (PYFG, 2, "A1", "A0", "also in line 1"),
        (PYFG, 3, "L0", "A0", "also in line 1"),
        (PYFG, 2, "A1", "7", "letters"),
        (PYFG, 4, "A0 A1", "A0 A2", "found 'A2'"),
        (PYFG, 4, "A0 A1", "A0 L0", "a pose of this file"),
        (PYFG, 5, "A1 L0", "A1 L9", "pose or landmark"),
        (PYFG, 5, "A1 L0", "A1 A1", "two different"),
        (PYFG, 5, " 0.1", " 0", "positive definite"),
        (PYFG, 5, " 0.1", " 1e-320", "can be inverted"),
        (PYFG, 5, " 0.1", "", "2 numbers"),
        (PYFG, 5, "EDGE_RANGE 1 ", "EDGE_RANGE ", r"a number \(time of EDGE_RANGE\)"),
        (PYFG, 5, "EDGE_RANGE 1 ", "EDGE_RANGE inf ", "finite"),
        (PYFG, 1, "VERTEX_SE2 0", "VERTEX_SE2 1_0", "a number"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, text: str, line: int, old: str, new: str, expected: str) -> None:
    rows = text.splitlines(keepends=True)
    assert old in rows[line - 1]
    rows[line - 1] = rows[line - 1].replace(old, new)
    module = pyfg if text is PYFG else g2o
    file = tmp_path / ("a.pyfg" if text is PYFG else "a.g2o")
    file.write_text(text)
    module.read(file)
    file.write_text("".join(rows))
    with pytest.raises(ReadError, match=expected) as caught:
        module.read(file)
    assert caught.value.line == line and caught.value.path == file


@pytest.mark.parametrize("module", [g2o, pyfg])
@pytest.mark.parametrize(
    ("content", "expected"), [(None, "existing file"), ("", "empty file"), ("# only\n", "comments"), (b"\xff", "UTF-8")]
)
def test_bad_files_are_named(tmp_path: Path, module: object, content: str | bytes | None, expected: str) -> None:
    file = tmp_path / "a.x"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        file.write_text(content)
    with pytest.raises(ReadError, match=expected):
        module.read(file)  # type: ignore[attr-defined]


def test_the_bad_matrix_is_found_among_good_ones(tmp_path: Path) -> None:
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0 1 {'2' if k == 7 else '0'} 0 1 0 1" for k in range(20)]
    (tmp_path / "a.g2o").write_text("\n".join(lines))
    with pytest.raises(ReadError, match="smallest eigenvalue -1") as caught:
        g2o.read(tmp_path / "a.g2o")
    assert caught.value.line == 8
