"""Marginals of all poses from the factors, against the dense inverse; world frame; what alignment leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from localization.io.recording import PoseGraph
from localization.marginals import joint_covariance, marginal_covariances
from localization.pose_graph import graph_problem
from problems import SE2, Gaussian, Problem, Vector
from problems.errors import FormError, UnobservableError

Make = Callable[..., PoseGraph]


def solved(g: PoseGraph, **settings: Any) -> tuple[Any, Any]:
    problem, initial = graph_problem(g, **settings)
    session = problem.compile("gauss-newton")
    return session, session.solve(initial=initial)


def world_jacobian(g: PoseGraph, pose: np.ndarray) -> np.ndarray:
    """Positions and rotations in the world for tangent steps, by differences."""
    d, n = g.dimension, len(pose)
    from localization.starts import space_of

    space: Any = space_of(g)
    out, step = np.zeros((n, space.dim, space.dim)), 1e-6
    for k in range(space.dim):
        delta = np.zeros((n, space.dim))
        delta[:, k] = step
        after = space.retract_array(pose, delta)
        out[:, :d, k] = (after[:, :d] - pose[:, :d]) / step
        if d == 2:
            out[:, 2, k] = (after[:, 2] - pose[:, 2]) / step
        else:
            from scipy.spatial.transform import Rotation

            turned = Rotation.from_quat(after[:, 3:]) * Rotation.from_quat(pose[:, 3:]).inv()
            out[:, 3:, k] = turned.as_rotvec() / step
    return out


@pytest.mark.parametrize("dimension", [2, 3])
def test_marginals_are_blocks_of_the_inverse_in_the_world_frame(loop: Make, dimension: int) -> None:
    g = loop(dimension, np.random.default_rng(0), 0.05)
    session, solution = solved(g)
    found = marginal_covariances(session, solution)["pose"]
    body = solution.covariance(session.problem.unknowns["pose"])
    turn, dim = world_jacobian(g, solution["pose"]), body.shape[0] // len(g.keys)
    for k in range(len(g.keys)):
        block = body[k * dim : (k + 1) * dim, k * dim : (k + 1) * dim]
        np.testing.assert_allclose(found[k], turn[k] @ block @ turn[k].T, atol=1e-6 * max(np.abs(block).max(), 1e-9))
    np.testing.assert_array_equal(found[0], 0)  # held
    joint = joint_covariance(solution, session.problem.unknowns["pose"][[5, 30]])
    np.testing.assert_allclose(joint[:dim, :dim], found[5], atol=1e-9)
    np.testing.assert_allclose(joint[dim:, dim:], found[30], atol=1e-9)
    cross = body[5 * dim : 6 * dim, 30 * dim : 31 * dim]
    np.testing.assert_allclose(joint[:dim, dim:], turn[5] @ cross @ turn[30].T, atol=1e-6 * np.abs(cross).max())


def test_aligned_marginals_are_what_alignment_leaves_of_sampled_errors(team: Make) -> None:
    g = team(np.random.default_rng(1), False)
    session, solution = solved(g)
    unknowns = session.problem.unknowns
    found = marginal_covariances(session, solution, aligned=True)
    joint = joint_covariance(solution, unknowns["pose"], unknowns["landmark"])
    rng = np.random.default_rng(2)
    # errors small enough for the alignment to be linear
    draws = 1e-4 * rng.multivariate_normal(np.zeros(len(joint)), joint, 2500, method="svd")
    pose, mark = draws[:, :120].reshape(-1, 40, 3), draws[:, 120:].reshape(-1, 3, 2)
    from localization.io.scoring import align

    left = np.empty((len(draws), 43, 2))
    places, marks = solution["pose"][:, :2], solution["landmark"]
    for k in range(len(draws)):
        turn, shift = align(places + pose[k, :, :2], places)
        left[k, :40] = (places + pose[k, :, :2]) @ turn.T + shift - places
        left[k, 40:] = (marks + mark[k]) @ turn.T + shift - marks
    for k, expected in enumerate([*found["pose"][:, :2, :2], *found["landmark"]]):
        sampled = np.cov(1e4 * left[:, k].T)
        np.testing.assert_allclose(sampled, expected, atol=0.12 * np.trace(expected))
    world = marginal_covariances(session, solution)["pose"]
    assert np.trace(found["pose"][:, :2, :2].sum(axis=0)) < np.trace(world[:, :2, :2].sum(axis=0))


def test_what_has_no_marginals_says_so(loop: Make) -> None:
    g = loop(2, np.random.default_rng(3), 0.0)
    problem, initial = graph_problem(g)
    del problem.terms["held"]
    session = problem.compile("gauss-newton")
    with pytest.raises(UnobservableError, match="direction free"):
        marginal_covariances(session, session.solve(initial=initial))
    problem, initial = graph_problem(replace(g))
    pose = problem.unknowns["pose"]
    problem.equality("same heading", lambda a, b: a.angle - b.angle, on=(pose[3], pose[4]))
    session = problem.compile("gauss-newton")
    with pytest.raises(FormError, match="it has equalities"):
        marginal_covariances(session, session.solve(initial=initial))


def test_unknowns_that_nothing_joins_and_that_are_independent_have_marginals() -> None:
    problem = Problem()
    x = problem.variables("x", Vector(2), 3)
    pose = problem.variables("pose", SE2)
    problem.cost("a", lambda e: e, on=x, noise=Gaussian(sigma=[2.0, 3.0]))
    problem.cost("b", lambda e: e.local(), on=pose, noise=Gaussian(sigma=[1.0, 2.0, 0.5]))
    session = problem.compile("gauss-newton")
    found = marginal_covariances(session, session.solve())
    np.testing.assert_allclose(found["x"], np.tile(np.diag([4.0, 9.0]), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(found["pose"][0], np.diag([1.0, 4.0, 0.25]), atol=1e-12)
