"""Templates (residual, tangent Jacobian, how data enter) and their array code, against CasADi and differences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, SO2, Problem, Vector, wrap
from problems.errors import DefinitionError, ShapeError
from problems.forms.residual_code import LOOP_COUNT, ArrayCode, residual_code
from problems.forms.template import is_affine_in, template_of


def inside(x: Any) -> Any:
    """Into (-1, 1)."""
    return x / (1 + ca.fabs(x))


OPERATIONS = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / (1 + y**2),
    "neg": lambda x, y: -x,
    "inv": lambda x, y: 1 / (1.5 + inside(x)),
    "twice": lambda x, y: 2 * x,
    "square": lambda x, y: x**2,
    "constant power": lambda x, y: (1 + x**2) ** 1.7,
    "negative base": lambda x, y: x**3,
    "power": lambda x, y: (1 + x**2) ** inside(y),
    "sqrt": lambda x, y: ca.sqrt(1 + ca.fabs(x)),
    "exp": lambda x, y: ca.exp(inside(x)),
    "expm1": lambda x, y: ca.expm1(inside(x)),
    "log": lambda x, y: ca.log(1 + x**2),
    "log1p": lambda x, y: ca.log1p(ca.fabs(x)),
    "sin": lambda x, y: ca.sin(x),
    "cos": lambda x, y: ca.cos(x),
    "tan": lambda x, y: ca.tan(inside(x)),
    "asin": lambda x, y: ca.asin(inside(x)),
    "acos": lambda x, y: ca.acos(inside(x)),
    "atan": lambda x, y: ca.atan(x),
    "atan2": lambda x, y: ca.atan2(x, y),
    "sinh": lambda x, y: ca.sinh(inside(x)),
    "cosh": lambda x, y: ca.cosh(inside(x)),
    "tanh": lambda x, y: ca.tanh(x),
    "asinh": lambda x, y: ca.asinh(x),
    "acosh": lambda x, y: ca.acosh(1.1 + x**2),
    "atanh": lambda x, y: ca.atanh(inside(x)),
    "erf": lambda x, y: ca.erf(x),
    "hypot": lambda x, y: ca.hypot(x, y),
    "floor": lambda x, y: ca.floor(x),
    "ceil": lambda x, y: ca.ceil(x),
    "fabs": lambda x, y: ca.fabs(x),
    "sign": lambda x, y: ca.sign(x),
    "fmod": lambda x, y: ca.fmod(x, 1 + ca.fabs(y)),
    "copysign": lambda x, y: ca.copysign(x, y),
    "fmin": lambda x, y: ca.fmin(x, y),
    "fmax": lambda x, y: ca.fmax(x, y),
    "less": lambda x, y: x < y,
    "less or equal": lambda x, y: x <= y,
    "equal": lambda x, y: ca.floor(x) == ca.floor(y),
    "not equal": lambda x, y: ca.floor(x) != ca.floor(y),
    "and": lambda x, y: ca.logic_and(x > 0, y > 0),
    "or": lambda x, y: ca.logic_or(x > 0, y > 0),
    "not": lambda x, y: ca.logic_not(x > 0),
    "if else": lambda x, y: ca.if_else(x > y, x**2, y - 3),
    "if else zero": lambda x, y: ca.if_else(x > 0, y, 0),
    "constant": lambda x, y: 0.25,
    "infinity": lambda x, y: ca.fmin(x, ca.inf),
    "norm": lambda x, y: ca.norm_2(ca.vertcat(x, y, 0.1)),
    "wrap": lambda x, y: wrap(3 * x),
}


def reference(code: ArrayCode, values: list[Any], count: int) -> np.ndarray:
    """The same outputs from CasADi itself, instance by instance."""
    columns = np.array([np.broadcast_to(v, count) for v in values])
    return np.asarray(code.function.map(count)(columns))


def check(inputs: ca.SX, outputs: ca.SX, values: list[Any], count: int, tolerance: float = 1e-12) -> None:
    code = ArrayCode(inputs, outputs)
    expected = reference(code, values, count)
    size = np.maximum(1.0, np.abs(np.where(np.isfinite(expected), expected, 1.0)))
    got = code(values, count)
    np.testing.assert_array_less(np.abs(got - expected)[np.isfinite(expected)] / size[np.isfinite(expected)], tolerance)
    np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))


@pytest.mark.parametrize("name", OPERATIONS)
def test_every_operation_and_its_derivative(name: str) -> None:
    x = ca.SX.sym("x", 2)
    value = ca.SX(OPERATIONS[name](x[0], x[1]))
    outputs = ca.vertcat(value, ca.jacobian(value, x).T)
    for count in (50, LOOP_COUNT + 1):  # by CasADi's loop and by machine code
        a, b = np.random.default_rng(5).normal(scale=2.0, size=(2, count))
        for values in ([a, b], [a, 0.7], [-1.3, b], [-1.3, 0.7]):
            check(x, outputs, values, count)


def random_function(rng: np.random.Generator, inputs: int, outputs: int, depth: int) -> tuple[ca.SX, ca.SX]:
    """A random graph of operations that reuses its intermediate values."""
    x = ca.SX.sym("x", inputs)
    nodes = [*ca.vertsplit(x), ca.SX(rng.normal())]
    names = list(OPERATIONS)
    for _ in range(depth):
        i, j = rng.integers(len(nodes), size=2)
        nodes.append(ca.SX(OPERATIONS[names[rng.integers(len(names))]](inside(nodes[i]) * 2, inside(nodes[j]) * 2)))
    picks = rng.integers(inputs, len(nodes), size=outputs)
    return x, ca.vertcat(*(nodes[k] for k in picks))


@pytest.mark.parametrize("count", [1, 2, LOOP_COUNT, LOOP_COUNT + 1, 3000])
def test_random_functions_on_any_mix_of_arrays_and_numbers(count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(6):
        inputs = int(rng.integers(1, 7))
        x, outputs = random_function(rng, inputs, int(rng.integers(1, 9)), 40)
        values = [rng.normal(size=count) if rng.random() < 0.6 else float(rng.normal()) for _ in range(inputs)]
        check(x, outputs, values, count, 1e-11)


def test_one_code_serves_patterns_and_counts() -> None:
    rng = np.random.default_rng(0)
    x, outputs = random_function(rng, 3, 4, 30)
    code = ArrayCode(x, outputs)
    for count in (5, 1, LOOP_COUNT + 5, 7):
        for values in ([rng.normal(size=count) for _ in range(3)], [rng.normal(size=count), 0.1, -0.4]):
            np.testing.assert_allclose(code(values, count), reference(code, values, count), atol=1e-12)


def test_strided_inputs_and_inputs_left_alone() -> None:
    rng = np.random.default_rng(1)
    x, outputs = random_function(rng, 2, 3, 30)
    table = rng.normal(size=(2000, 2))
    before = table.copy()
    code = ArrayCode(x, outputs)
    np.testing.assert_allclose(code(list(table.T), 2000), reference(code, list(table.T), 2000), atol=1e-12)
    np.testing.assert_array_equal(table, before)


# --- templates -----------------------------------------------------------------------------------------------------


def mixed(x: Any, angle: Any, pose: Any, C: Any, z: Any) -> Any:
    local = pose.transform_to(x[0:2])
    return ca.vertcat(C @ x - z, ca.sin(angle.angle) * local[0], wrap(pose.angle - angle.angle), local[1] * x[2])


def test_tangent_jacobians_equal_differences_for_all_spaces_and_matrix_data_are_row_major() -> None:
    p, rng = Problem(), np.random.default_rng(2)
    count = 40
    x, angle, pose = p.variables("x", Vector(3), count), p.variables("angle", SO2, count), p.variables("pose", SE2)
    term = p.cost("c", mixed, on=(x, angle, pose), data=(p.data("C", (2, 3)), p.data("z", 2, count)))
    X, A, T = rng.normal(size=(count, 3)), rng.normal(size=(count, 1)), rng.normal(size=(1, 3))
    C, z = rng.normal(size=(2, 3)), rng.normal(size=(count, 2))
    code = residual_code(term)

    def residual(d: np.ndarray) -> np.ndarray:
        pose_ = np.broadcast_to(SE2.retract_array(T, d[None, 4:]), (count, 3))
        point = [(X + d[:3]), SO2.retract_array(A, np.broadcast_to(d[3:4], A.shape)), pose_]
        columns = np.hstack([*point, np.broadcast_to(C.ravel(), (count, 6)), z])
        return code.residual(list(columns.T), count)

    r, J = code.residual_and_jacobian(
        list(np.hstack([X, A, np.tile(T, (count, 1)), np.tile(C.ravel(), (count, 1)), z]).T), count
    )
    assert r.shape == (count, 5) and J.shape == (count, 5, 7)
    np.testing.assert_allclose(r[:, :2], X @ C.T - z, atol=1e-13)
    np.testing.assert_allclose(residual(np.zeros(7)), r, atol=1e-13)
    h = 1e-6
    for k, e in enumerate(np.eye(7)):
        difference = (residual(h * e) - residual(-h * e)) / (2 * h)
        np.testing.assert_allclose(J[:, :, k], difference, atol=1e-8)


def test_templates_are_made_once_per_function_spaces_and_shapes() -> None:
    p = Problem()
    x, y = p.variables("x", Vector(2), 3), p.variables("y", Vector(2), 3)

    def residual(x: Any) -> Any:
        return 2 * x

    a, b = p.cost("a", residual, on=x), p.cost("b", residual, on=y[1:])
    c = p.cost("c", residual, on=p.variables("z", Vector(3)))
    assert template_of(a) is template_of(b) and residual_code(a) is residual_code(b)
    assert template_of(c) is not template_of(a)


def cost(residual: Any, size: int = 2, data: tuple[Any, ...] = ()) -> Any:
    p = Problem()
    x = p.variables("x", Vector(size))
    return p.cost("c", residual, on=x, data=tuple(p.data(f"d{k}", shape) for k, shape in enumerate(data)))


@pytest.mark.parametrize(
    ("residual", "affine"),
    [
        (lambda x: 3 * x - 1, True),
        (lambda x: ca.vertcat(x[0], 5.0), True),
        (lambda x: x[0] * x[1], False),
        (lambda x: x**2, False),
        (lambda x: ca.fabs(x), False),
        (lambda x: wrap(x[0]), False),
        (lambda x: ca.floor(x), False),
        (lambda x: ca.sign(x), False),
        (lambda x: x + (x > 0), False),
        (lambda x: ca.fmin(x, 1), False),
        (lambda x: ca.if_else(x[0] > 0, 1, 0), False),
        (lambda x: ca.if_else(x[0] > 0, x[1], 0), False),
        (lambda x: ca.fmod(x, 2), False),
    ],
)
def test_affine_residuals_are_told_from_others(residual: Any, affine: bool) -> None:
    assert template_of(cost(residual)).affine is affine


def test_coefficients_may_depend_on_data_and_poses_are_never_affine() -> None:
    assert template_of(cost(lambda x, C, z: ca.sin(C) @ x - wrap(z[0]), data=((2, 2), 2))).affine
    p = Problem()
    term = p.cost("c", lambda T: T.translation, on=p.variables("T", SE2))
    assert not template_of(term).affine


@pytest.mark.parametrize(
    ("residual", "hard"),
    [
        (lambda x, d: x - d, False),
        (lambda x, d: 2 * d + 1, False),
        (lambda x, d: d[0] * x, True),
        (lambda x, d: x - d**2, True),
        (lambda x, d: x - d[0] * d[1], True),
        (lambda x, d: x - wrap(d), True),
        (lambda x, d: x - ca.fmax(d, 0), True),
        (lambda x, d: x - ca.floor(d), True),
        (lambda x, d: ca.if_else(d[0] > 0, x, 0), True),
    ],
)
def test_how_data_enter(residual: Any, hard: bool) -> None:
    assert template_of(cost(residual, data=(2,))).nonlinear_data == (hard,)


def test_data_that_multiply_each_other() -> None:
    t = template_of(cost(lambda x, a, b, c: x - a * b + c, data=((), 2, 2)))
    assert t.nonlinear_data == (False, False, False)
    assert t.products == ((0, 1),)


# --- bad residuals -------------------------------------------------------------------------------------------------


def raising(x: Any) -> Any:
    raise ZeroDivisionError("by design")


@dataclass
class Unhashable:
    gain: float

    def __call__(self, x: Any) -> Any:
        return self.gain * x


@pytest.mark.parametrize(
    ("residual", "error", "text"),
    [
        (
            lambda x: ca.SX.eye(2) @ np.ones((2, 3)),
            ShapeError,
            r"cost 'c': the residual must be one column, got shape \(2, 3\)",
        ),
        (lambda x: np.array([1.0, 2.0, 3.0]) @ x, DefinitionError, "cost 'c': the residual <lambda> failed .*columns"),
        (
            raising,
            DefinitionError,
            r"cost 'c': the residual raising failed .*\(column of 2\): ZeroDivisionError: by design",
        ),
        (lambda x: x - ca.SX.sym("ghost"), DefinitionError, "cost 'c': .*neither slots nor data: ghost"),
        (lambda x: x[5], DefinitionError, "cost 'c': the residual <lambda> failed"),
        (lambda x: "text", DefinitionError, "cost 'c': .*got str"),
        (lambda x: None, DefinitionError, "cost 'c': .*NoneType"),
        (lambda x: [], ShapeError, "cost 'c': .*one column"),
        (lambda x: ca.MX.sym("m"), DefinitionError, "cost 'c': .*got MX"),
        (lambda: 0, DefinitionError, "cost 'c': .*failed"),
        (Unhashable(2.0), DefinitionError, "cost 'c': .*must be hashable"),
        (lambda x: ca.remainder(x, 2), DefinitionError, "cost 'c': .*OP_REMAINDER"),
        (3.0, DefinitionError, "cost 'c': the residual must be a function of symbols, got 3.0"),
    ],
)
def test_bad_residuals_are_named_at_definition(residual: Any, error: Any, text: str) -> None:
    with pytest.raises(error, match=text):
        cost(residual)


def test_rows_lists_and_numbers_become_columns() -> None:
    assert template_of(cost(lambda x: x.T)).dim == 2
    assert template_of(cost(lambda x: [x[0], 1.0, x[1]])).dim == 3
    assert template_of(cost(lambda x: x[0])).dim == 1
    assert template_of(cost(lambda x: np.eye(2) @ x)).dim == 2
    np.testing.assert_array_equal(residual_code(cost(lambda x: 7.0)).residual([0.0, 0.0], 3), [[7.0]] * 3)


def test_is_affine_in_looks_at_the_named_symbols_only() -> None:
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    assert is_affine_in(ca.sin(y) * x, x)
    assert is_affine_in(ca.if_else(y > 0, x, 2 * x), x)
    assert not is_affine_in(ca.sin(y) * x, y)
