"""Graphs whose costs do not see some direction: solved where damping finds an optimum, and told."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, Gaussian, Problem, Vector
from problems.errors import DataError
from problems.solvers.base import Status

pytestmark = pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
STEP = [1.0, 0.0, 2 * np.pi / 6]


def loop(hold: str = "") -> tuple[Problem, dict[str, Any]]:
    p = Problem("loop")
    pose = p.variables("pose", SE2, 6)
    z = p.data("z", 3, value=STEP)
    ends = pose[:], pose[[1, 2, 3, 4, 5, 0]]
    p.cost("step", lambda a, b, z: a.between(b).log() - z, ends, z, Gaussian([0.05, 0.05, 0.02]))
    if hold == "weak prior":
        p.cost("prior", lambda T: ca.vertcat(T.translation, T.angle), pose[0], noise=Gaussian(sigma=30.0))
    if hold == "equality":
        p.equality("origin", lambda T: ca.vertcat(T.translation, T.angle), pose[0])
    start = [np.zeros(3)]
    for _ in range(5):
        start.append(SE2.retract_array(start[-1][None], np.array([STEP]))[0])
    noise = 0.05 * np.random.default_rng(0).normal(size=(6, 3))
    return p, {"pose": np.array(start) + noise}


@pytest.mark.parametrize("solver", ["gauss-newton", "gtsam-lm", "ipopt", "fatrop", "sqp:daqp"])
@pytest.mark.parametrize("hold", ["", "weak prior", "equality"])
def test_a_free_gauge_is_named(solver: str, hold: str) -> None:
    if solver.startswith("gtsam"):
        pytest.importorskip("gtsam")
    problem, start = loop(hold)
    session = problem.compile(solver)
    for _ in range(2):
        solution = session.solve(initial=start)
        assert solution.status is Status.SOLVED, solution.message
        assert ("one of many optima" in solution.message) == (hold == "")
        assert ("pose[0] and 5 more" in solution.message) == (hold == "")


def test_missing_data_can_free_a_gauge() -> None:
    p = Problem("pair")
    x, z, step = p.variables("x", Vector(1), 2), p.data("z", ()), p.data("step", ())
    p.cost("fix", lambda x, z: ca.sinh(x - z), x[0], z)
    p.cost("step", lambda a, b, z: ca.sinh(b - a - z), (x[0], x[1]), step)
    session = p.compile("gauss-newton")
    for z, free in ((1.0, False), (np.nan, True), (2.0, False)):
        solution = session.solve({"z": z, "step": 1.0})
        assert solution.status is Status.SOLVED
        assert ("x[0] and 1 more" in solution.message) == free


def test_long_chains_with_and_without_an_anchor() -> None:
    """Stretched directions of a long held chain are no gauge; the same chain held nowhere is found free."""
    count = 400
    for held in (True, False):
        p = Problem("chain")
        pose = p.variables("pose", SE2, count)
        before, after = np.append(np.arange(count - 1), 0), np.append(np.arange(1, count), 5)
        value = np.tile([1.0, 0.0, 0.01], (count, 1))
        value[-1] = [5.01, 0.1, 0.05]
        z = p.data("z", 3, count, value)
        p.cost("step", lambda a, b, z: a.between(b).local() - z, (pose[before], pose[after]), z, Gaussian(0.01))
        if held:
            p.equality("origin", lambda T: ca.vertcat(T.translation, T.angle), pose[0])
        start = [np.zeros(3)]
        for _ in range(count - 1):
            start.append(SE2.retract_array(start[-1][None], np.array([[1.0, 0.0, 0.01]]))[0])
        solution = p.compile("gauss-newton", linear_solver="qdldl").solve(initial={"pose": np.array(start)})
        assert solution.status is Status.SOLVED, solution.message
        assert ("one of many optima" in solution.message) == (not held)


def test_initial_values_after_a_preparation_are_refused() -> None:
    problem, start = loop("weak prior")
    session = problem.compile("gauss-newton")
    session.prepare(start)
    with pytest.raises(DataError, match="give initial to prepare"):
        session.solve(initial=start)
    assert "feedback" in session.solve().message  # still prepared
    assert "feedback" not in session.solve(initial=start).message
    session.prepare(start)
    session.reset()
    assert "feedback" not in session.solve(initial=start).message
