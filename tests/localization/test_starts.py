"""Chordal and linear starts, and parts of a graph that landmarks and ranges join."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.io import PoseGraph, open_recording
from localization.io.recording import Edges, Priors
from localization.joining import moved
from localization.pose_graph import evaluate, graph_problem
from localization.starts import choose_start
from problems import SE2, SE3
from problems.errors import DataError, SettingError

Make = Callable[..., PoseGraph]
SPACES: dict[int, Any] = {2: SE2, 3: SE3}


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("initial", ["chordal", "ls"])
def test_linear_starts_are_exact_without_noise(loop: Make, dimension: int, initial: Any) -> None:
    g = loop(dimension, np.random.default_rng(0), 0.0)
    start = choose_start(g, initial)
    assert start.poses == initial and start.placed == ()
    np.testing.assert_allclose(SPACES[dimension].local_array(g.truth, start.values["pose"]), 0, atol=1e-8)


@pytest.mark.parametrize("dimension", [2, 3])
def test_chordal_starts_are_nearer_the_optimum_than_the_chain(loop: Make, dimension: int) -> None:
    g = loop(dimension, np.random.default_rng(1), 0.15)
    problem, _ = graph_problem(g)
    session = problem.compile("gauss-newton", iteration_limit=300)

    def cost(initial: Any) -> float:
        return evaluate(problem, choose_start(g, initial).values)[0]

    best = session.solve(initial=choose_start(g, "chordal").values).objective
    assert best <= cost("chordal") < 6 * best
    assert cost("chordal") < 0.1 * cost("odometry")


def test_chordal_starts_keep_priors_and_unequal_weights(loop: Make) -> None:
    g = loop(2, np.random.default_rng(2), 0.0)
    truth = g.truth
    assert truth is not None
    away = SE2.retract_array(np.tile([5.0, -2.0, 1.0], (len(truth), 1)), truth)
    prior = Priors(np.array([3, 20]), away[[3, 20]], np.tile(np.eye(3), (2, 1, 1)), np.full(2, np.nan))
    wrong = replace(
        g.relative_poses, value=g.relative_poses.value.copy(), information=g.relative_poses.information.copy()
    )
    wrong.value[-1] += 1.0
    wrong.information[-1] *= 1e-12
    found = choose_start(replace(g, pose_priors=prior, relative_poses=wrong), "chordal").values["pose"]
    np.testing.assert_allclose(SE2.local_array(away, found), 0, atol=1e-5)


def test_linear_solvers_of_quadratic_programs_give_the_same_start(loop: Make) -> None:
    g = loop(2, np.random.default_rng(3), 0.1)
    own, other = (choose_start(g, "chordal", solver=name).values["pose"] for name in ("gauss-newton", "proxqp"))
    np.testing.assert_allclose(own, other, atol=1e-5)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return SE2.retract_array(np.zeros_like(a), SE2.local_array(a, b))


@pytest.mark.parametrize("ranges_only", [False, True])
def test_robots_are_joined_by_landmarks_and_by_ranges(team: Make, ranges_only: bool) -> None:
    g = team(np.random.default_rng(4), ranges_only)
    start = choose_start(g)
    assert g.truth is not None
    (placed,) = start.placed
    assert (placed.robot, placed.key, placed.by) == ("B", "B0", "ranges" if ranges_only else "landmarks")
    assert placed.cost < 1e-9
    inside = between(np.broadcast_to(start.values["pose"][0], (40, 3)), start.values["pose"])
    np.testing.assert_allclose(inside, between(np.broadcast_to(g.truth[0], (40, 3)), g.truth), atol=1e-4)
    if ranges_only:  # the mirror image is kept, and costs more
        assert placed.others and placed.others[0][1] > 0.1
        other = moved(start.values["pose"], placed, 0)
        np.testing.assert_array_equal(other[:20], start.values["pose"][:20])
        assert np.abs(other[20:, :2] - start.values["pose"][20:, :2]).max() > 0.5


def test_what_cannot_be_started_is_said(loop: Make, team: Make) -> None:
    g = loop(2, np.random.default_rng(5), 0.0)
    with pytest.raises(SettingError, match="no starting values; start at odometry or chordal"):
        choose_start(g, "file")
    with pytest.raises(SettingError, match="initial must be one of.*'chain'"):
        choose_start(g, "chain")  # type: ignore[arg-type]
    apart = team(np.random.default_rng(4), False)
    with pytest.raises(SettingError, match="2 separate parts; start at odometry"):
        choose_start(apart, "chordal")
    few = replace(apart, sightings=Edges.none(2, 2), landmark_keys=np.zeros(0, str))
    with pytest.raises(DataError, match="2 separate parts.*A0, B0"):
        choose_start(few)


@pytest.mark.parametrize("name", ["manhattan", "tinyGrid3D"])
def test_recordings_reach_one_optimum_from_all_starts(name: str, real_data: Callable[[str], Path]) -> None:
    g = open_recording(real_data(f"g2o/{name}.g2o"))
    problem, _ = graph_problem(g)
    session = problem.compile("gauss-newton")
    costs = [session.solve(initial=choose_start(g, initial).values).objective for initial in ("odometry", "chordal")]
    assert costs[1] == pytest.approx(costs[0], rel=1e-8)
