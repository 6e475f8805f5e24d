"""Sessions: different ways to the same answer."""

from __future__ import annotations

import numpy as np
import pytest
from session_problems import (
    ALL,
    equal,
    outputs,
    sequence,
    window,
)

from problems import Problem, Vector
from problems.solvers.base import Status


@pytest.mark.parametrize("solver", ALL)
def test_update_and_solve_are_one(solver: str) -> None:
    p = window()
    one, two = p.compile(solver), p.compile(solver)
    for data in sequence(1):
        a = one.solve(data)
        two.update(**{k: v for k, v in data.items() if k != "y"})
        two.update(y=data["y"])
        b = two.solve()
        equal(a.point, b.point, solver)
        assert a.status is b.status


@pytest.mark.parametrize("solver", ALL)
def test_a_session_equals_a_new_one_at_every_step(solver: str) -> None:
    p = window()
    session, known = p.compile(solver), {}
    for data in sequence(2, 9):
        known |= data
        a, b = session.solve(data), p.compile(solver).solve(known)
        assert a.solved and b.solved
        np.testing.assert_allclose(a.point, b.point, atol=1e-6)
        assert a.objective == pytest.approx(b.objective, rel=1e-7)


@pytest.mark.parametrize("solver", ["daqp", "proxqp", "osqp", "piqp"])
def test_warm_and_cold_starts_find_the_same(solver: str) -> None:
    p = window()
    warm, cold = p.compile(solver), p.compile(solver, warm=False)
    for data in sequence(3, 8):
        a, b = warm.solve(data), cold.solve(data)
        assert a.solved and b.solved
        np.testing.assert_allclose(a.point, b.point, atol=1e-6)


@pytest.mark.parametrize("solver", ALL)
def test_all_solvers_agree(solver: str) -> None:
    p = window()
    reference, session = p.compile("daqp", tolerance=1e-10), p.compile(solver)
    for data in sequence(4, 8):
        a, b = reference.solve(data), session.solve(data)
        assert b.solved
        np.testing.assert_allclose(b.point, a.point, atol=1e-6)
        np.testing.assert_array_equal(b.active_set["box"], a.active_set["box"])
        for name, y in a.multipliers.items():
            np.testing.assert_allclose(b.multipliers[name], y, atol=1e-5 * max(1.0, np.abs(y).max()))


@pytest.mark.parametrize("solver", ["auto", "daqp", "gauss-newton"])
def test_equalities_may_come_and_go_with_the_data_under_active_rows(solver: str) -> None:
    p = Problem()
    x, y = p.variables("x", Vector(1), 3), p.data("y", 1, 3)
    p.cost("level", lambda x: x - 1, on=x)
    p.equality("seen", lambda x, y, there: there * (x - y), on=x, data=(y, p.presence(y)))
    p.inequality("top", lambda x: x, on=x, upper=0.5)
    session = p.compile(solver)
    for y in ([0.0, np.nan, 0.2], [np.nan] * 3, [0.1, 0.2, np.nan], [0.0, 0.1, 0.2], [0.3, np.nan, np.nan]):
        got = session.solve({"y": y})
        assert got.solved
        np.testing.assert_allclose(got["x"].ravel(), np.where(np.isnan(y), 0.5, y), atol=1e-7)
    assert session.solve({"y": [0.0, 0.7, 0.2]}).status is Status.INFEASIBLE


def test_auto_answers_linearly_until_a_row_is_violated_and_a_named_solver_is_always_called() -> None:
    p = window()
    auto, named = p.compile(), p.compile("daqp")
    small, large = {"y": 0.01 * outputs(0)}, {"y": 3 * outputs(0)}
    assert (auto.solve(small).method, auto.solve(large).method) == ("linear", "auto")
    assert auto.solve(small).iterations == 0
    assert named.solve(small).method == named.solve(large).method == "daqp"
    np.testing.assert_allclose(auto.solve(small).point, named.solve(small).point, atol=1e-9)
    np.testing.assert_allclose(auto.solve(large).point, named.solve(large).point, atol=1e-7)
    assert not auto.solve(small).active_set["box"].any()
