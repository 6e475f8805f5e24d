"""iSAM2 as a batch solver: the optimum of the others, honest where its settings stop it short."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, Gaussian, Huber, Problem, Vector
from problems.errors import FormError, SettingError, SlowPathWarning
from problems.solvers.base import Status

gtsam = pytest.importorskip("gtsam")


def circle(poses: int = 12, seed: int = 0) -> tuple[Problem, dict[str, Any], dict[str, Any]]:
    """A loop that is driven twice, as a pose graph of custom factors, from chained odometry."""
    rng = np.random.default_rng(seed)
    p = Problem("circle")
    pose, count = p.variables("pose", SE2, 2 * poses), 2 * poses
    step, closed, first = p.data("step", 3, count - 1), p.data("closed", 3, poses), p.data("first", 3)
    noise = Gaussian([0.05, 0.05, 0.02])
    p.cost("first", lambda T, z: ca.vertcat(T.translation, T.angle) - z, pose[0], first, noise)
    p.cost("step", lambda a, b, z: a.between(b).log() - z, (pose[:-1], pose[1:]), step, noise)
    p.cost("closed", lambda a, b, z: a.between(b).log() - z, (pose[:poses], pose[poses:]), closed, noise, Huber())
    turn = np.array([1.0, 0.0, 2 * np.pi / poses])
    steps = turn + [0.05, 0.05, 0.02] * rng.normal(size=(count - 1, 3))
    start = [np.zeros(3)]
    for z in steps:
        start.append(SE2.retract_array(start[-1][None], z[None])[0])
    data = {"step": steps, "closed": 0.05 * rng.normal(size=(poses, 3)), "first": np.zeros(3)}
    return p, data, {"pose": np.array(start)}


@pytest.mark.parametrize(
    "settings",
    [{}, {"optimizer": "dogleg"}, {"factorization": "QR"}],
    ids=str,
)
def test_the_optimum_of_gauss_newton(settings: dict[str, Any]) -> None:
    problem, data, start = circle()
    ours = problem.compile("gauss-newton", tolerance=1e-12).solve(data, initial=start)
    with pytest.warns(SlowPathWarning):
        session = problem.compile("gtsam-isam2", **settings)
    solution = session.solve(data, initial=start)
    assert solution.status is Status.SOLVED, solution.message
    assert solution.objective == pytest.approx(ours.objective, rel=1e-8)
    assert abs(SE2.local_array(ours["pose"], solution["pose"])).max() < 1e-4
    assert session.solve(data).iterations == 1  # it is there already
    other = session.solve(data | {"first": [1.0, 2.0, 0.5]})
    np.testing.assert_allclose(other["pose"][0], [1.0, 2.0, 0.5], atol=1e-6)


def test_a_coarse_threshold_is_not_called_solved() -> None:
    problem, data, start = circle()
    with pytest.warns(SlowPathWarning):
        session = problem.compile("gtsam-isam2", relinearize_threshold=1e3)
    solution = session.solve(data, initial=start)
    assert solution.status is Status.INACCURATE and "decrement" in solution.message


def test_limits() -> None:
    problem, data, start = circle()
    with pytest.warns(SlowPathWarning):
        few = problem.compile("gtsam-isam2", iteration_limit=1).solve(data, initial=start)
    assert few.status is Status.ITERATION_LIMIT and few.iterations == 1
    with pytest.warns(SlowPathWarning):
        short = problem.compile("gtsam-isam2", time_limit=1e-9).solve(data, initial=start)
    assert short.status is Status.TIME_LIMIT


def test_settings_are_checked() -> None:
    with pytest.raises(SettingError, match="relinearize_threshold must be positive"):
        circle()[0].compile("gtsam-isam2", relinearize_threshold=-1.0)
    with pytest.raises(SettingError, match="optimizer"):
        circle()[0].compile("gtsam-isam2", optimizer="lm")


def test_equalities_that_are_not_affine_need_gauss_newton_steps() -> None:
    p = Problem("circle")
    x = p.variables("x", Vector(2))
    p.cost("near", lambda x: x - ca.vertcat(0.66, 0.88), x)
    p.equality("on", lambda x: ca.sumsqr(x) - 1, x)
    with pytest.warns(SlowPathWarning):
        solution = p.compile("gtsam-isam2").solve(initial={"x": [[1.0, 0.0]]})
    assert solution.status is Status.SOLVED, solution.message
    np.testing.assert_allclose(solution["x"], [[0.6, 0.8]], atol=1e-6)
    with pytest.warns(SlowPathWarning), pytest.raises(FormError, match="not affine"):
        p.compile("gtsam-isam2", optimizer="dogleg")
