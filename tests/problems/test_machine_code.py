"""Machine code: numbers and special values, sums with flags and repeated targets, steps of chains."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import Problem, Vector
from problems.forms.loops import Program, address, column_loop, summing_loop
from problems.forms.machine_code import caller, number
from problems.solvers.chain_steps import ChainSteps


def evaluated(function: ca.Function, inputs: np.ndarray) -> np.ndarray:
    """(outputs, count) of a function of one column at (inputs, count)."""
    inputs = np.ascontiguousarray(inputs, dtype=float)
    out = np.empty((function.size1_out(0), inputs.shape[1]))
    task = [inputs.shape[1], address(out)]
    for row in inputs:
        task += [address(row), row.strides[0]]
    given = np.array(task)
    caller(column_loop(function).address)(address(given))
    return out


@pytest.mark.parametrize("value", [0.0, 1 / 3, 5e-324, 1e308, math.inf, -math.inf, math.nan])
def test_constants_arrive_bit_by_bit(value: float) -> None:
    x = ca.SX.sym("x")
    got = evaluated(ca.Function("f", [x], [ca.vertcat(x, value)]), np.zeros((1, 1)))[1]
    assert got.tobytes() == np.array([value]).tobytes()
    assert number(value).startswith("0x")


def test_special_values_go_through_as_in_casadi() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    outputs = ca.vertcat(
        ca.sign(x), ca.fmin(x, y), ca.fmax(x, y), ca.if_else(x > y, x, y), ca.if_else(x, y, 0), ca.fabs(x), ca.sqrt(x),
        ca.atan2(x, y), ca.floor(x), x / y, ca.logic_and(x, y), ca.logic_or(x, y), ca.logic_not(x),
    )  # fmt: skip
    function = ca.Function("f", [ca.vertcat(x, y)], [outputs])
    values = [0.0, -0.0, 1.5, -2.5, math.inf, -math.inf, math.nan]
    grid = np.array(np.meshgrid(values, values)).reshape(2, -1)
    with np.errstate(all="ignore"):
        want = np.asarray(function.map(grid.shape[1])(grid))
    np.testing.assert_array_equal(evaluated(function, grid), want)


def test_sums_leave_out_what_is_off_and_take_targets_that_repeat() -> None:
    rng, count = np.random.default_rng(3), 50
    x = ca.SX.sym("x", 3)
    function = ca.Function("f", [x], [ca.vertcat(x[0] * x[1], ca.sin(x[2]), 2.0)])
    point, values = rng.normal(size=7), rng.normal(size=5)
    index = np.column_stack([rng.integers(0, 7, (count, 2)), rng.integers(0, 5, count)]).astype(np.int32)
    outputs = (0, 1, 2, 1)
    targets, on = rng.integers(0, 4, (count, 4)).astype(np.int32), rng.random(count) < 0.6
    code = summing_loop(function, 2, outputs)
    for flags in (None, on):
        sums = np.zeros(4)
        where = 0 if flags is None else address(flags)
        tasks = np.array([[count, where, *map(address, (index, targets)), 4, *map(address, (point, values, sums))]] * 2)
        Program([code, code], tasks)()
        want = np.zeros(4)
        for k in range(count) if flags is None else np.flatnonzero(on):
            a, b = point[index[k, :2]]
            results = [a * b, np.sin(values[index[k, 2]]), 2.0]
            for output, target in zip(outputs, targets[k], strict=True):
                want[target] += 2 * results[output]
        np.testing.assert_allclose(sums, want, rtol=1e-13)


def test_the_same_text_is_compiled_once() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    one, other = (ca.Function("f", [s], [ca.sin(s) + 1]) for s in (x, y))
    assert column_loop(one) is column_loop(other)


# --- steps of chains -------------------------------------------------------------------------------------------------


def chain(scale: float = 1.0) -> Problem:
    p = Problem("chain")
    x, z = p.variables("x", Vector(2), 12), p.data("z", 2, 12)
    p.cost("move", lambda a, b: b - ca.vertcat(a[0] + ca.sin(a[1]), a[1]), on=(x[:-1], x[1:]))
    p.cost("seen", lambda x, z: ca.atan(scale * (x - z)), on=x, data=z)
    return p


def solved(scale: float = 1.0, start: float = 0.0, **settings: Any) -> Any:
    z = np.random.default_rng(4).normal(size=(12, 2))
    session: Any = chain(scale).compile("gauss-newton", **settings)
    return session, session.solve({"z": z}, initial={"x": np.full((12, 2), start)})


def test_a_chain_steps_to_the_optimum_of_the_general_search(monkeypatch: pytest.MonkeyPatch) -> None:
    session, got = solved(linear_solver="banded", tolerance=1e-14)
    assert isinstance(session._chain, ChainSteps)
    other, want = solved(linear_solver="dense", tolerance=1e-14)
    assert other._chain is None
    assert got.status == want.status == "solved" and got.iterations == want.iterations
    np.testing.assert_allclose(got["x"], want["x"], atol=1e-9)
    assert got.objective == pytest.approx(want.objective, rel=1e-12)
    # the chain alone came there
    monkeypatch.setattr("problems.solvers.gauss_newton._Search.run", None)
    assert solved(linear_solver="banded")[1].solved


def test_what_does_not_go_down_is_damped() -> None:
    # arc tangents far out are flat, so that undamped steps overshoot
    for scale, start in ((3.0, 4.0), (2.0, -6.0)):
        got, want = (solved(scale, start, linear_solver=name, tolerance=1e-12)[1] for name in ("banded", "dense"))
        assert got.status == want.status
        assert got.objective == pytest.approx(want.objective, rel=1e-6)


def test_limits_hold_for_chains() -> None:
    _, got = solved(linear_solver="banded", iteration_limit=1)
    assert got.status == "iteration_limit" and got.iterations == 1
    _, got = solved(linear_solver="banded", time_limit=1e-9)
    assert got.status == "time_limit"


def test_a_chain_with_a_free_direction_says_so() -> None:
    p = Problem()
    x = p.variables("x", Vector(2), 12)
    p.cost("move", lambda a, b: b[0] - a[0], on=(x[:-1], x[1:]))
    p.cost("first", lambda x: x[0] - 1, on=x[0])
    got = p.compile("gauss-newton", linear_solver="banded").solve()
    assert got.status == "unbounded" and "x[0]" in got.message
