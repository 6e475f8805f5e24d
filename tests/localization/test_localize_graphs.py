"""`horizonet localize` on graphs: every format in and out, starts, solvers, basins, worst measurements, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from localization.io import PoseGraph, g2o, open_recording, pyfg
from localization.io.poses import read_poses, read_tum
from localization.io.recording import Edges
from localization.io.scoring import ate
from localization.scenarios.recording import scenario
from problems.cli.main import app

Make = Callable[..., PoseGraph]


def localize(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["localize", *map(str, words)])


def answer(*words: str | Path, code: int = 0) -> dict:
    result = localize(*words, "--json")
    assert result.exit_code == code, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def files(loop: Make, team: Make, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same kinds of graphs as files: a planar and a spatial loop, two robots, and a loop with a wrong closure."""
    folder = tmp_path_factory.mktemp("graphs")
    rng = np.random.default_rng(0)
    plane, space = loop(2, rng, 0.05), loop(3, rng, 0.05)
    e = plane.relative_poses
    wrong = Edges(
        np.r_[e.first, 4], np.r_[e.second, 35], np.vstack([e.value, [0.3, -0.2, 2.0]]),
        np.concatenate([e.information, e.information[:1]]), np.r_[e.time, np.nan],
    )  # fmt: skip
    graphs = {"plane": plane, "space": space, "wrong": replace(plane, relative_poses=wrong)}
    for name, graph in graphs.items():
        g2o.write(folder / f"{name}.g2o", graph)
    for name, ranges in (("sighted", False), ("ranged", True)):
        two = team(rng, ranges)
        timed = {
            field: replace(getattr(two, field), time=np.zeros(len(getattr(two, field))))
            for field in ("relative_poses", "sightings", "ranges")
        }
        marks = {} if ranges else {"landmark_truth": np.array([[1.0, 2.0], [4.0, 0.0], [2.0, -2.0]])}
        pyfg.write(folder / f"{name}.pyfg", replace(two, **timed, **marks))
    return {path.stem: path for path in folder.iterdir()}


@pytest.mark.parametrize("name", ["plane", "space", "sighted", "ranged"])
@pytest.mark.parametrize("solver", ["gauss-newton", "gtsam-lm"])
def test_every_kind_of_graph_is_localized_by_every_solver(files: dict[str, Path], name: str, solver: str) -> None:
    found = answer(files[name], "--solver", solver, "--set", "edges=2")
    assert list(found) == ["scenario", "seed", "trials", "settings", "rows", "edges"]
    (row,) = found["rows"]
    assert (row["method"], row["solver"]) == ("ml", solver)
    assert row["status"]["solved"] == 1
    metrics = row["metrics"]
    assert list(metrics) == list(scenario.metrics)
    assert metrics["keyframes"] == 40 and metrics["measurements"] >= 50
    assert metrics["objective"] <= metrics["start_objective"] * (1 + 1e-9) + 1e-9
    assert row["options"]["initial"] == "odometry"
    if name in ("sighted", "ranged"):
        assert metrics["ate"] < 1e-3
        assert row["options"]["placed"] == {"B": "landmarks" if name == "sighted" else "ranges"}
        assert row["options"]["landmarks"] == ("sightings" if name == "sighted" else None)
    else:
        assert metrics["ls_objective"] >= metrics["objective"]
        assert metrics["ate"] is None
    assert len(found["edges"]) == 2
    assert found["edges"][0].keys() >= {"method", "term", "between", "p_value", "redundancy", "p_against_others"}


def test_solvers_and_starts_reach_one_optimum(files: dict[str, Path]) -> None:
    words = [
        ("--solver", "gtsam-lm"),
        ("--solver", "gauss-newton"),
        ("--set", "initial=chordal"),
        ("--set", "initial=ls"),
    ]
    costs = [answer(files["space"], *pair)["rows"][0]["metrics"]["objective"] for pair in words]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-6)
    plain = answer(files["space"], "--set", "chart=plain")["rows"][0]["metrics"]["objective"]
    assert abs(plain / costs[0] - 1) > 1e-5


def test_linear_method_is_the_chordal_start(files: dict[str, Path]) -> None:
    rows = answer(files["plane"], "--method", "ml", "--method", "ls")["rows"]
    ml, ls = (row["metrics"] for row in rows)
    assert ls["objective"] == pytest.approx(ml["ls_objective"], rel=1e-9)
    assert ls["gradient_norm"] > 1e3 * ml["gradient_norm"]


def test_poses_go_to_every_format(files: dict[str, Path], tmp_path: Path) -> None:
    for name, size in (("plane", 3), ("space", 6)):
        answer(files[name], "--out", tmp_path / "p.csv")
        poses = read_poses(tmp_path / "p.csv")
        assert poses.keys.tolist() == [str(k) for k in range(40)]
        np.testing.assert_array_equal(poses.time, np.arange(40.0))
        assert poses.covariance is not None and poses.covariance.shape == (40, size, size)
        np.testing.assert_array_equal(poses.covariance[0], 0)
        assert (np.linalg.eigvalsh(poses.covariance[1:]) > 0).all()
        answer(files[name], "--out", tmp_path / "p.g2o")
        again = g2o.read(tmp_path / "p.g2o")
        assert again.initial is not None
        np.testing.assert_allclose(again.initial[:, : again.dimension], poses.position, atol=1e-12)
        better = answer(tmp_path / "p.g2o")["rows"][0]
        assert better["options"]["initial"] == "file"
        assert better["metrics"]["start_objective"] == pytest.approx(better["metrics"]["objective"], rel=1e-6)
        answer(files[name], "--out", tmp_path / "p.tum")
        tum = read_tum(tmp_path / "p.tum")
        np.testing.assert_allclose(tum.position[:, : again.dimension], poses.position, atol=1e-12)


def test_landmarks_and_robots_of_a_team_are_written(files: dict[str, Path], tmp_path: Path) -> None:
    result = localize(files["sighted"], "--out", tmp_path / "p.csv")
    assert result.exit_code == 0, result.output
    poses = read_poses(tmp_path / "p.csv")
    assert poses.keys.tolist()[-3:] == ["L0", "L1", "L2"] and np.isnan(poses.orientation[-3:]).all()
    assert poses.covariance is not None and (np.linalg.eigvalsh(poses.covariance[-3:, :2, :2]) > 0).all()
    result = localize(files["sighted"], "--out", tmp_path / "p.tum")
    assert result.exit_code == 0, result.output
    truth = open_recording(files["sighted"]).truth
    parts = [read_tum(tmp_path / f"p-{robot}.tum") for robot in "AB"]
    assert not (tmp_path / "p.tum").exists()
    assert ate(np.vstack([part.position[:, :2] for part in parts]), truth[:, :2]) < 1e-3


@pytest.mark.parametrize("name", ["plane", "space", "sighted"])
def test_pictures_hold_ellipses_starts_and_truth(files: dict[str, Path], tmp_path: Path, name: str) -> None:
    result = localize(files[name], "--plot", tmp_path / "p.svg")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "p.svg").read_bytes().startswith(b"<?xml")
    values = scenario.settings(path=str(files[name]), covariance=True)
    drawn = scenario.draw(values, np.random.default_rng(0))
    axes = scenario.plot(values, drawn, {"ml": scenario.run(values, "ml", "auto", drawn)}).axes
    labels = " ".join(axes[0].get_legend_handles_labels()[1])
    assert "start" in labels and "95 % ellipses" in labels
    assert ("truth" in labels) == (name == "sighted")
    assert len(axes) == 2 - (name == "plane")


def test_a_wrong_closure_is_listed_first_and_robust_losses_cure_it(files: dict[str, Path]) -> None:
    found = answer(files["wrong"])
    assert found["edges"][0]["between"] == ["4", "35"] and found["edges"][0]["p_against_others"] < 1e-9
    assert found["rows"][0]["options"]["p_value"] < 1e-9
    clean = answer(files["plane"])
    assert clean["edges"][0]["p_against_others"] > 1e-4
    robust = ("--set", "robust=geman_mcclure", "--set", "robust_on=loop_closures", "--set", "robust_scale=3")
    for words in (("--set", "graduated=on"), ("--solver", "gtsam-gnc")):
        cured = answer(files["wrong"], *robust, *words)
        assert cured["edges"][0]["between"] == ["4", "35"] and cured["edges"][0]["weight"] < 1e-3
        assert cured["rows"][0]["metrics"]["objective"] < clean["rows"][0]["metrics"]["objective"] + 4.5 + 1e-6
    people = localize(files["wrong"], "--set", "edges=3")
    assert "measurements that contradict the others most" in people.stdout and "4 35" in people.stdout


def test_the_mirror_image_is_told_apart_by_its_cost(files: dict[str, Path]) -> None:
    found = answer(files["ranged"], "--set", "starts=4")["rows"][0]
    costs = found["options"]["costs_from"]
    assert len(costs) >= 2 and any("B at its minimum" in name for name in costs)
    assert found["metrics"]["objective"] == pytest.approx(min(costs.values()), abs=1e-9)
    assert found["metrics"]["ate"] < 1e-3


def test_wrong_basins_are_warned_of(tmp_path: Path, loop: Make) -> None:
    g = loop(2, np.random.default_rng(3), 0.02, 60)
    assert g.truth is not None
    turned = g.truth.copy()
    turned[:, 2] = 0.0
    turned[:, :2] *= -1.0
    turned[20:40] = 0.0
    g2o.write(tmp_path / "far.g2o", replace(g, initial=turned))
    result = localize(tmp_path / "far.g2o", "--set", "iteration_limit=3")
    assert "wrong basin: the linear start alone costs" in result.stderr
    assert "--set initial=chordal" in result.stderr
    best = answer(tmp_path / "far.g2o", "--set", "initial=chordal")["rows"][0]["metrics"]
    several = answer(tmp_path / "far.g2o", "--set", "starts=3")["rows"][0]
    assert several["metrics"]["objective"] == pytest.approx(best["objective"], rel=1e-6)


def test_a_fence_holds(files: dict[str, Path], tmp_path: Path) -> None:
    free = answer(files["plane"], "--out", tmp_path / "free.csv")["rows"][0]["metrics"]["objective"]
    place = read_poses(tmp_path / "free.csv").position
    high = place[:, 0].max() - 0.05
    fence = f"fence=[-100, -100, {high}, 100]"
    held = answer(files["plane"], "--set", fence, "--out", tmp_path / "held.csv")["rows"][0]
    assert held["metrics"]["objective"] > free
    assert read_poses(tmp_path / "held.csv").position[:, 0].max() <= high + 1e-6
    refused = localize(files["plane"], "--set", fence, "--solver", "gtsam-lm")
    assert refused.exit_code == 1
    assert "fence" in refused.stderr


@pytest.mark.parametrize(
    ("name", "words", "told"),
    [
        ("plane", ["--method", "mhe"], "method 'mhe' cannot localize a pose graph (plane); possible: ml, ls"),
        ("ranged", ["--method", "ls"], "method 'ls' cannot localize a pose graph (ranged); possible: ml"),
        ("plane", ["--set", "horizon=3"], "setting horizon means nothing for a pose graph; those that do: chart"),
        ("plane", ["--set", "start=truth"], "start=truth needs truth"),
        ("plane", ["--set", "graduated=on"], "graduated non-convexity needs a robust loss"),
        ("plane", ["--set", "robust_on=ranges"], "belong to a robust loss"),
        ("plane", ["--set", "chart=full"], "chart of recording cannot be 'full'"),
        ("space", ["--set", "fence=[0, 0, 1, 1]"], "fence is for graphs in the plane"),
    ],
)
def test_what_has_no_meaning_ends_with_code_2(files: dict[str, Path], name: str, words: list[str], told: str) -> None:
    result = localize(files[name], *words)
    assert result.exit_code == 2
    assert told in " ".join(result.stderr.split())
    assert result.stdout == ""


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("EDGE_SE2 0 99 1 0 0 1 0 0 1 0 1", "expected the name of a pose of this file; found '99'"),
        ("EDGE_SE2 0 1 1 0 0 1 2 0 1 0 1", "expected a positive definite matrix"),
        ("EDGE_SE2 0 1 1 nan 0 1 0 0 1 0 1", "expected finite numbers"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0", "expected 9 numbers"),
        ("VERTEX_SE2 1 0 0 0", "expected a name not used before; found '1', also in line 2"),
    ],
)
def test_bad_lines_end_with_code_2_and_are_named(tmp_path: Path, line: str, told: str) -> None:
    path = tmp_path / "bad.g2o"
    path.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n{line}\n")
    result = localize(path)
    assert result.exit_code == 2
    assert f"{path}:4: {told}" in " ".join(result.stderr.split())


def test_parts_that_nothing_joins_are_named(tmp_path: Path) -> None:
    path = tmp_path / "parts.g2o"
    path.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 5 6 1 0 0 1 0 0 1 0 1\n")
    result = localize(path)
    assert result.exit_code == 1
    assert "in 2 separate parts" in result.stderr and "such as 0, 5" in result.stderr
