"""Nonlinear programs in stages: what fatrop is handed, and that it finds the same optimum and multipliers."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import Gaussian, Problem, Vector
from problems.forms.nonlinear import NonlinearProgram
from problems.solvers.nlp import FATROP
from problems.solvers.nlp_stages import StagedProgram

STEPS = 6


def moved(x: Any) -> Any:
    return ca.vertcat(x[0] + 0.2 * ca.sin(x[1]), 0.9 * x[1] - 0.05 * x[0] ** 2)


def window(scale: Any = 1.0, bounded: bool = True) -> tuple[Problem, dict[str, np.ndarray]]:
    """A window in form F1 whose variables come in an order that is not that of time."""
    rng = np.random.default_rng(4)
    p = Problem("window")
    w, x = p.variables("w", Vector(2), STEPS), p.variables("x", Vector(2), STEPS + 1)
    y, gain = p.data("y", 1, STEPS + 1), p.data("gain", (), STEPS, value=np.full(STEPS, 1.5))
    if bounded:
        p.inequality("box", lambda x: x[0], on=x, lower=-0.3, upper=0.45)
    p.cost("prior", lambda x: x - np.array([0.3, 0.2]), on=x[0])
    p.cost("output", lambda x, y: y - x[0] ** 2 - x[1], on=x, data=y, noise=Gaussian(0.3))
    p.cost("effort", lambda w: w, on=w, noise=Gaussian(0.2))
    on = (x[:-1], w, x[1:])
    if scale == "data":
        p.equality("dynamics", lambda x, w, ahead, s: s * ahead - moved(x) - w, on=on, data=gain)
    elif scale == "state":
        p.equality("dynamics", lambda x, w, ahead: ahead + 0.01 * ahead**3 - moved(x) - w, on=on)
    else:
        p.equality("dynamics", lambda x, w, ahead: scale * (ahead - moved(x) - w), on=on)
    return p, {"y": rng.normal(0.3, 0.4, size=(STEPS + 1, 1))}


@pytest.mark.parametrize("scale", [1.0, -2.5])
@pytest.mark.parametrize("bounded", [False, True])
def test_windows_are_solved_in_their_stages(scale: float, bounded: bool) -> None:
    problem, data = window(scale, bounded)
    session = problem.compile("fatrop")
    assert isinstance(session, FATROP)
    staged = session._staged
    assert staged is not None
    assert staged.options["nx"] == [0] + [2] * STEPS and staged.options["nu"] == [4] + [2] * (STEPS - 1) + [0]
    assert sum(staged.options["ng"]) == bounded * (STEPS + 1) and max(staged.options["ng"]) <= 2 * bounded
    got, want = session.solve(data), problem.compile("ipopt").solve(data)
    assert got.solved and want.solved
    assert not bounded or np.abs(want.active_set["box"]).any()
    for name in ("x", "w"):
        np.testing.assert_allclose(got[name], want[name], atol=1e-6)
    for name, y in want.multipliers.items():
        np.testing.assert_allclose(got.multipliers[name], y, atol=1e-5)
    assert got.objective == pytest.approx(want.objective, rel=1e-9)


@pytest.mark.parametrize("scale", ["data", "state"])
def test_states_without_a_constant_factor_are_no_stages_for_fatrop(scale: str) -> None:
    problem, data = window(scale, bounded=False)
    assert StagedProgram.of(NonlinearProgram(problem)) is None
    got, want = problem.compile("fatrop").solve(data), problem.compile("ipopt").solve(data)
    assert got.solved
    np.testing.assert_allclose(got["x"], want["x"], atol=1e-6)


def test_a_cost_across_stages_leaves_no_chain() -> None:
    problem, _ = window()
    x = problem.unknowns["x"]
    problem.cost("ends", lambda a, b: a - b, on=(x[0], x[STEPS]))
    assert StagedProgram.of(NonlinearProgram(problem)) is None


def test_long_windows_stay_sparse_expressions(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, data = window()
    short = problem.compile("fatrop").solve(data)
    monkeypatch.setattr("problems.solvers.nlp_stages.EXPANDED", 0)
    session = problem.compile("fatrop")
    assert isinstance(session, FATROP) and session._staged is not None and not session._staged.options["expand"]
    np.testing.assert_allclose(session.solve(data)["x"], short["x"], atol=1e-9)
