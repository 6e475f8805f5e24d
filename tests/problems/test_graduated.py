"""Graduated non-convexity finds the consensus that plain robust iterations miss from a bad start."""

from __future__ import annotations

import numpy as np
import pytest

from problems import SE2, Gaussian, GemanMcClure, Problem, Tukey, Vector
from problems.forms.graduated import ladder
from problems.noise import Loss

rng = np.random.default_rng(5)
LANDMARKS = rng.uniform(-20, 20, (60, 2))
POSE = np.array([3.0, -2.0, 0.7])


def registration(loss: Loss | None) -> tuple[Problem, np.ndarray]:
    """One pose from 60 points seen in its frame, half of which are wrong."""
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    seen = (LANDMARKS - POSE[:2]) @ np.array([[c, -s], [s, c]])
    seen += np.random.default_rng(1).normal(scale=0.05, size=seen.shape)
    seen[::2] = np.random.default_rng(2).uniform(-20, 20, (30, 2))
    problem = Problem("registration")
    pose = problem.variables("pose", SE2)
    places, z = problem.data("places", 2, 60), problem.data("seen", 2, 60)
    problem.cost(
        "points", lambda T, p, z: T.transform_to(p) - z, on=pose, data=(places, z), noise=Gaussian(0.05), loss=loss
    )
    return problem, seen


@pytest.mark.parametrize("loss", [GemanMcClure(3.0), Tukey(5.0)])
def test_half_of_the_points_may_be_wrong(loss: Loss) -> None:
    problem, seen = registration(loss)
    data = {"places": LANDMARKS, "seen": seen}
    away = {"pose": np.array([-5.0, 6.0, -1.0])}
    graduated = problem.compile("gauss-newton", graduated=True).solve(data, initial=away)
    plain = problem.compile("gauss-newton").solve(data, initial=away)
    assert graduated.solved
    np.testing.assert_allclose(graduated["pose"][0], POSE, atol=0.05)
    assert graduated.objective < 0.9 * plain.objective


def test_the_last_rung_is_the_problem_itself() -> None:
    problem, seen = registration(GemanMcClure(3.0))
    data = {"places": LANDMARKS, "seen": seen}
    graduated = problem.compile("gauss-newton", graduated=True).solve(data, initial={"pose": POSE})
    plain = problem.compile("gauss-newton").solve(data, initial={"pose": POSE})
    assert graduated.objective == pytest.approx(plain.objective, rel=1e-9)
    assert graduated.iterations > plain.iterations


def test_nothing_to_graduate() -> None:
    problem, _ = registration(None)
    assert ladder(problem) == []
    widened = ladder(registration(Tukey(4.0))[0])
    assert [rung.terms["points"].loss.scale for rung in widened] == [4.0 * 2.0**k for k in range(12, 0, -1)]  # type: ignore[union-attr]
    convex = Problem("convex")
    x = convex.variables("x", Vector(1))
    convex.cost("pull", lambda x: x - 1, on=x)
    assert convex.compile("gauss-newton", graduated=True).solve()["x"][0, 0] == pytest.approx(1.0)
