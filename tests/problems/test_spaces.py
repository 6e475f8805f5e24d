"""Spaces: charts and their inverses, symbols against arrays, SE(2) against matrix exponentials."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from problems import SE2, SO2, Pose2, Rotation2, Vector, wrap
from problems.errors import DataError, DefinitionError
from problems.spaces import Space, points

SPACES = [Vector(1), Vector(4), SO2, SE2]
angles = st.floats(-50, 50, allow_nan=False)
lengths = st.floats(-100, 100, allow_nan=False)


def evaluate(expression: Any) -> np.ndarray:
    """A constant CasADi expression as numbers."""
    return np.asarray(ca.DM(ca.evalf(ca.SX(expression)))).ravel()


def numeric(function: Any, *arguments: np.ndarray) -> np.ndarray:
    """`function` of symbols evaluated at numbers."""
    symbols = [ca.SX.sym(f"s{k}", len(a)) for k, a in enumerate(arguments)]
    return np.asarray(ca.Function("f", symbols, [ca.SX(function(*symbols))])(*arguments)).ravel()


def draw(space: Any, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the space and tangent steps whose angles stay inside (-pi, pi)."""
    x = rng.normal(scale=3.0, size=(count, space.ambient))
    d = rng.normal(scale=3.0, size=(count, space.dim))
    if not isinstance(space, Vector):
        x[:, -1] = rng.uniform(-3 * np.pi, 3 * np.pi, count)
        d[:, -1] = rng.uniform(-3.1, 3.1, count)
    return x, d


def matrix(pose: np.ndarray) -> np.ndarray:
    """Homogeneous matrix of (x, y, theta)."""
    x, y, t = pose
    return np.array([[math.cos(t), -math.sin(t), x], [math.sin(t), math.cos(t), y], [0, 0, 1.0]])


def same_pose(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(matrix(a), matrix(b), atol=tolerance * max(1.0, np.abs(a[:2]).max()))


@given(st.floats(-1e4, 1e4, allow_nan=False))
def test_wrap_stays_in_its_interval_and_keeps_the_angle(angle: float) -> None:
    wrapped = wrap(angle)
    assert -np.pi - 1e-11 < wrapped <= np.pi + 1e-11  # rounding of the angle itself
    turns = (angle - wrapped) / (2 * np.pi)
    assert abs(turns - round(turns)) < 1e-9
    assert evaluate(wrap(ca.SX(angle)))[0] == wrapped
    assert wrap(np.array([angle, 0.25]))[0] == wrapped


def test_wrap_at_the_ends() -> None:
    assert wrap(np.pi) == np.pi
    assert wrap(-np.pi) == np.pi
    assert wrap(0.0) == 0.0
    assert -np.pi < wrap(np.pi + 1e-14) < -3.14
    assert -np.pi < wrap(-np.pi + 1e-14) < -3.14


def test_wrap_does_not_change_the_derivative() -> None:
    t = ca.SX.sym("t")
    slope = ca.Function("slope", [t], [ca.jacobian(wrap(t), t)])
    assert [float(slope(v)) for v in (-7.0, 0.0, 2.0, 9.0)] == [1.0] * 4


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_local_inverts_retract_on_arrays(space: Any) -> None:
    x, d = draw(space, np.random.default_rng(1), 200)
    moved = space.retract_array(x, d)
    np.testing.assert_allclose(space.local_array(x, moved), d, atol=1e-12)
    back = space.retract_array(x, space.local_array(x, moved))
    np.testing.assert_allclose(space.normalize_array(back), space.normalize_array(moved), atol=1e-12)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_symbols_and_arrays_are_one_chart(space: Any) -> None:
    rng = np.random.default_rng(2)
    x, d = draw(space, rng, 20)
    y, _ = draw(space, rng, 20)
    for k in range(20):
        symbolic = numeric(space.retract, x[k], d[k])
        np.testing.assert_allclose(
            space.normalize_array(symbolic[None]), space.retract_array(x[k : k + 1], d[k : k + 1]), atol=1e-12
        )
        np.testing.assert_allclose(
            numeric(space.local, x[k], y[k]), space.local_array(x[k : k + 1], y[k : k + 1])[0], atol=1e-12
        )
        np.testing.assert_allclose(numeric(space.local, x[k], symbolic), d[k], atol=1e-12)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_zero_step_and_identity(space: Any) -> None:
    x, _ = draw(space, np.random.default_rng(3), 5)
    zero = np.zeros((5, space.dim))
    np.testing.assert_allclose(space.retract_array(x, zero), space.normalize_array(x), atol=1e-13)
    np.testing.assert_array_equal(space.local_array(x, x), zero)
    assert space.identity().shape == (space.ambient,)
    assert isinstance(space, Space)


def test_se2_steps_are_in_the_body_frame_translation_first() -> None:
    start = np.array([[2.0, 1.0, np.pi / 2]])
    np.testing.assert_allclose(SE2.retract_array(start, np.array([[3.0, 0.0, 0.0]])), [[2.0, 4.0, np.pi / 2]])
    np.testing.assert_allclose(SE2.retract_array(start, np.array([[0.0, 0.0, 0.5]])), [[2.0, 1.0, np.pi / 2 + 0.5]])


def test_arrays_are_left_alone() -> None:
    for space in SPACES:
        x, d = draw(space, np.random.default_rng(4), 4)
        before = x.copy(), d.copy()
        space.retract_array(x, d), space.local_array(x, x + 1.0), space.normalize_array(x)
        np.testing.assert_array_equal(x, before[0])
        np.testing.assert_array_equal(d, before[1])


@given(st.tuples(lengths, lengths, angles), st.tuples(lengths, lengths, angles), st.tuples(lengths, lengths, angles))
def test_se2_is_a_group(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> None:
    A, B, C = (SE2(ca.DM(p)) for p in (a, b, c))

    def numbers(pose: Pose2) -> np.ndarray:
        return evaluate(pose.coordinates)

    np.testing.assert_allclose(matrix(numbers(A @ B)), matrix(np.array(a)) @ matrix(np.array(b)), atol=1e-9)
    same_pose(numbers((A @ B) @ C), numbers(A @ (B @ C)), 1e-10)
    same_pose(numbers(A @ A.inverse()), np.zeros(3), 1e-10)
    same_pose(numbers(A.inverse() @ A), np.zeros(3), 1e-10)
    same_pose(numbers(A.between(B)), numbers(A.inverse() @ B), 1e-10)
    same_pose(numbers(A @ A.between(B)), np.array(b), 1e-10)
    same_pose(numbers(A @ Pose2(ca.DM.zeros(2), 0.0)), np.array(a), 1e-10)


@given(st.tuples(lengths, lengths, angles), st.tuples(lengths, lengths))
def test_poses_move_points(a: tuple[float, ...], p: tuple[float, float]) -> None:
    A, point = SE2(ca.DM(a)), ca.DM(p)
    world = evaluate(A.transform_from(point))
    np.testing.assert_allclose(world, (matrix(np.array(a)) @ [*p, 1.0])[:2], atol=1e-10)
    np.testing.assert_allclose(evaluate(A.transform_to(ca.DM(world))), p, atol=1e-10)


@given(angles, angles, st.tuples(lengths, lengths))
def test_so2_is_a_group(a: float, b: float, v: tuple[float, float]) -> None:
    A, B = Rotation2(ca.SX(a)), Rotation2(ca.SX(b))
    R = np.array(ca.evalf(A.matrix))
    np.testing.assert_allclose(R @ R.T, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(np.array(ca.evalf((A @ B).matrix)), R @ np.array(ca.evalf(B.matrix)), atol=1e-13)
    np.testing.assert_allclose(evaluate(A.rotate(ca.DM(v))), R @ v, atol=1e-12)
    np.testing.assert_allclose(evaluate(A.unrotate(ca.DM(v))), R.T @ v, atol=1e-12)
    assert abs(evaluate((A @ A.inverse()).log())[0]) < 1e-12
    assert abs(np.exp(1j * evaluate(A.between(B).log())[0]) - np.exp(1j * (b - a))) < 1e-12


def hat(xi: np.ndarray) -> np.ndarray:
    return np.array([[0, -xi[2], xi[0]], [xi[2], 0, xi[1]], [0, 0, 0.0]])


@pytest.mark.parametrize("theta", [0.0, 1e-9, 1e-4, 9.9e-4, 1.01e-3, 0.02, 1.0, -2.5, 3.1, np.pi])
def test_se2_log_inverts_the_matrix_exponential(theta: float) -> None:
    xi = np.array([1.3, -0.7, theta])
    group = la.expm(hat(xi))
    pose = np.array([group[0, 2], group[1, 2], math.atan2(group[1, 0], group[0, 0])])
    np.testing.assert_allclose(evaluate(SE2(ca.SX(pose)).log()), xi, atol=1e-12)
    if abs(theta) < 3:
        general = np.real(la.logm(group))
        np.testing.assert_allclose(evaluate(SE2(ca.SX(pose)).log()), [general[0, 2], general[1, 2], theta], atol=1e-9)


@pytest.mark.parametrize("theta", [0.0, 1e-5, 9.99e-4, 1.001e-3, 0.3, -2.0])
def test_se2_log_has_the_right_derivatives_also_at_zero(theta: float) -> None:
    p = ca.SX.sym("p", 3)
    log = ca.Function("log", [p], [SE2(p).log()])
    slope = np.asarray(ca.Function("slope", [p], [ca.jacobian(SE2(p).log(), p)])(ca.DM([1.5, -2.0, theta])))
    h = 1e-5
    steps = [np.array([1.5, -2.0, theta]) + h * e for e in (*np.eye(3), *-np.eye(3))]
    f = [np.asarray(log(s)).ravel() for s in steps]
    np.testing.assert_allclose(slope, np.column_stack([(f[k] - f[k + 3]) / (2 * h) for k in range(3)]), atol=1e-8)


def test_points_repeat_normalize_and_copy() -> None:
    one = points(SE2, [1.0, 2.0, 3 * np.pi], 3, "start")
    np.testing.assert_allclose(one, [[1.0, 2.0, np.pi]] * 3)
    given_array = np.array([[0.1], [7.0]])
    angles_ = points(SO2, given_array, 2, "start")
    np.testing.assert_allclose(angles_, [[0.1], [7.0 - 2 * np.pi]])
    angles_[:] = 0.0
    assert given_array[1, 0] == 7.0
    np.testing.assert_array_equal(points(Vector(1), [1.0, 2.0], 2, "start"), [[1.0], [2.0]])


@pytest.mark.parametrize(
    ("space", "value", "count", "text"),
    [
        (SE2, np.zeros((2, 2)), 2, r"start: expected shape \(2, 3\) .* SE2, got \(2, 2\)"),
        (Vector(2), np.zeros(3), 2, r"expected shape \(2, 2\)"),
        (Vector(2), [[0.0, 1.0], [np.nan, 0.0]], 2, "instance 1 is not finite"),
        (SE2, [np.inf, 0, 0], 1, "instance 0 is not finite"),
    ],
)
def test_points_refuse_what_is_no_point(space: Any, value: Any, count: int, text: str) -> None:
    with pytest.raises(DataError, match=text):
        points(space, value, count, "start")


@pytest.mark.parametrize("size", [0, -1, 1.5])
def test_vectors_have_a_positive_size(size: Any) -> None:
    with pytest.raises(DefinitionError, match="positive whole number"):
        Vector(size)


def test_vectors_of_equal_size_are_one_space() -> None:
    assert Vector(3) == Vector(3) and hash(Vector(3)) == hash(Vector(3))
    assert Vector(3) != Vector(2)
