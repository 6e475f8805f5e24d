"""Failures of a session are statuses, and the next solve works."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from session_problems import (
    ALL,
    outputs,
    team,
    team_data,
    window,
)

from problems import Problem, Vector, registry
from problems.errors import MissingExtraError
from problems.solvers.base import Status
from problems.solvers.qp_projection import Projection


@pytest.mark.parametrize("solver", ALL)
def test_a_pattern_that_hides_a_variable_is_a_status_and_the_session_goes_on(solver: str) -> None:
    p = Problem()
    x, z = p.variables("x", Vector(1), 2), p.data("z", (), 2)
    p.cost("see", lambda x, z: x - z, on=x, data=z)
    session = p.compile(solver)
    assert session.solve({"z": [1.0, 2.0]}).solved
    hidden = session.solve({"z": [3.0, np.nan]})
    assert hidden.status is Status.UNBOUNDED and "determine" in hidden.message or "x[1]" in hidden.message
    got = session.solve({"z": [4.0, 5.0]})
    assert got.solved
    np.testing.assert_allclose(got["x"].ravel(), [4.0, 5.0], atol=1e-7)


@pytest.mark.parametrize("solver", ALL)
def test_rows_that_cannot_hold_are_a_status_and_the_session_goes_on(solver: str) -> None:
    p = Problem()
    x, top = p.variables("x", Vector(2)), p.data("top", ())
    p.cost("pull", lambda x: x - 1, on=x)
    p.inequality("low", lambda x: x[0] + x[1], on=x, lower=0.5, upper=np.inf)
    p.inequality("high", lambda x: x[0] + x[1], on=x, upper=top)
    session = p.compile(solver)
    assert session.solve({"top": 1.0}).solved
    bad = session.solve({"top": 0.0})
    assert bad.status is Status.INFEASIBLE and bad.message
    got = session.solve({"top": 0.8})
    assert got.solved
    np.testing.assert_allclose(got["x"], [[0.4, 0.4]], atol=1e-6)


def test_limits_are_statuses_and_the_session_goes_on() -> None:
    p, *_ = team()
    data, initial = team_data()
    slow = p.compile("gauss-newton", time_limit=1e-9).solve(data, initial)
    assert slow.status is Status.TIME_LIMIT and slow.iterations == 0
    session = p.compile("gauss-newton", iteration_limit=1)
    short = session.solve(data, initial)
    assert short.status is Status.ITERATION_LIMIT and short.iterations == 1
    for _ in range(20):  # each solve starts where the last one stopped
        last = session.solve()
    exact = p.compile("gauss-newton").solve(data, initial)
    np.testing.assert_allclose(last["robot"], exact["robot"], atol=1e-4)
    qp = window().compile("osqp", iteration_limit=1)
    assert qp.solve({"y": outputs(0)}).status in (Status.ITERATION_LIMIT, Status.INACCURATE)


def test_a_cost_that_is_not_finite_is_a_status() -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    p.cost("c", lambda x: ca.log(x), on=x)
    session = p.compile("gauss-newton")
    assert session.solve(initial={"x": [[-1.0]]}).status is Status.FAILED
    got = session.solve(initial={"x": [[0.5]]})
    assert got.solved and got["x"].item() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("solver", ["auto", "daqp"])
def test_a_backend_that_breaks_is_a_status_and_the_next_solve_starts_afresh(
    solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = registry.load("solvers", "daqp")
    session = window().compile(solver)
    want = session.solve({"y": outputs(0)}).point

    def broken(*_: Any) -> Any:
        raise RuntimeError("the library crashed")

    with monkeypatch.context() as patch:
        patch.setattr(kind, "solve", broken)
        patch.setattr(Projection, "__call__", lambda *_: None)  # which would answer without the backend
        failed = session.solve({"y": outputs(1)})
        assert failed.status is Status.FAILED and "the library crashed" in failed.message
    np.testing.assert_allclose(session.solve({"y": outputs(0)}).point, want, atol=1e-9)


def test_a_backend_whose_package_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.load("solvers", "daqp"), "module", "no_such_package")
    with pytest.raises(MissingExtraError, match="solver daqp needs the package daqp"):
        window().compile("daqp").solve({"y": outputs(0)})
