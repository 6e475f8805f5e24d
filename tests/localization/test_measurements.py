"""Measurement templates in the plane: formulas in NumPy, tangent Jacobians by differences, what angles do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from localization import measurements as meas
from problems import SE2, Problem, Vector, wrap
from problems.forms.residual_code import ResidualCode, residual_code

POINT = Vector(2)
Numbers = np.ndarray


def turn(angle: float) -> Numbers:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def seen(T: Numbers, p: Numbers) -> Numbers:
    """World point or pose position in the frame of T."""
    return turn(T[2]).T @ (p[:2] - T[:2])


def angle(T: Numbers, p: Numbers) -> float:
    u = seen(T, p)
    return float(np.arctan2(u[1], u[0]))


def between(a: Numbers, b: Numbers) -> Numbers:
    return np.array([*seen(a, b), wrap(b[2] - a[2])])


def chord(e: Any) -> Any:
    return 2 * np.sin(e / 2)


def logarithm(T: Numbers) -> Numbers:
    """From the matrix logarithm."""
    M = np.eye(3)
    M[:2, :2], M[:2, 2] = turn(T[2]), T[:2]
    L = np.real(scipy.linalg.logm(M))
    return np.array([L[0, 2], L[1, 2], L[1, 0]])


Case = tuple[Callable[..., Any], tuple[Any, ...], int, Callable[..., Any]]
CASES: dict[str, Case] = {
    "position of a pose": (meas.position, (SE2,), 2, lambda T, z: T[:2] - z),
    "position of a point": (meas.position, (POINT,), 2, lambda p, z: p - z),
    "heading": (meas.heading, (SE2,), 1, lambda T, z: wrap(T[2] - z)),
    "heading, chordal": (meas.heading_chordal, (SE2,), 1, lambda T, z: chord(T[2] - z)),
    "distance of poses": (meas.distance, (SE2, SE2), 1, lambda a, b, z: np.linalg.norm(b[:2] - a[:2]) - z),
    "distance to a point": (meas.distance, (SE2, POINT), 1, lambda a, b, z: np.linalg.norm(b - a[:2]) - z),
    "bearing of a pose": (meas.bearing, (SE2, SE2), 1, lambda a, b, z: wrap(angle(a, b) - z)),
    "bearing of a point": (meas.bearing, (SE2, POINT), 1, lambda a, b, z: wrap(angle(a, b) - z)),
    "bearing, chordal": (meas.bearing_chordal, (SE2, SE2), 1, lambda a, b, z: chord(angle(a, b) - z)),
    "bearing and range": (
        meas.bearing_range, (SE2, SE2), 2,
        lambda a, b, z: [wrap(angle(a, b) - z[0]), np.linalg.norm(b[:2] - a[:2]) - z[1]],
    ),
    "bearing and range, chordal": (
        meas.bearing_range_chordal, (SE2, POINT), 2,
        lambda a, b, z: [chord(angle(a, b) - z[0]), np.linalg.norm(b - a[:2]) - z[1]],
    ),
    "relative position": (meas.relative_position, (SE2, SE2), 2, lambda a, b, z: b[:2] - a[:2] - z),
    "landmark": (meas.landmark, (SE2, POINT), 2, lambda a, b, z: seen(a, b) - z),
    "relative pose": (meas.relative_pose, (SE2, SE2), 3, lambda a, b, z: between(z, between(a, b))),
    "relative pose, log": (meas.relative_pose_log, (SE2, SE2), 3, lambda a, b, z: logarithm(between(z, between(a, b)))),
    "pose": (meas.pose, (SE2,), 3, lambda T, z: between(z, T)),
    "pose, log": (meas.pose_log, (SE2,), 3, lambda T, z: logarithm(between(z, T))),
}  # fmt: skip


def code_of(name: str) -> ResidualCode:
    residual, spaces, size, _ = CASES[name]
    p = Problem()
    slots = tuple(p.variables(f"x{k}", space) for k, space in enumerate(spaces))
    return residual_code(p.cost("term", residual, on=slots, data=p.data("z", size)))


def draw(name: str, seed: int, count: int) -> tuple[list[Numbers], Numbers]:
    """Points of every slot and data, angles beyond one turn included."""
    rng = np.random.default_rng(seed)
    _, spaces, size, _ = CASES[name]
    points = [rng.normal(scale=3.0, size=(count, space.ambient)) for space in spaces]
    for space, x in zip(spaces, points, strict=True):
        if space is SE2:
            x[:, 2] = rng.uniform(-9, 9, count)
    z = rng.normal(scale=2.0, size=(count, size))
    return points, z


def columns(points: list[Numbers], z: Numbers) -> list[Numbers]:
    return list(np.ascontiguousarray(np.hstack([*points, z]).T))


@pytest.mark.parametrize("name", CASES)
def test_residuals_follow_their_formulas(name: str) -> None:
    points, z = draw(name, 1, 60)
    got = code_of(name).residual(columns(points, z), 60)
    formula = CASES[name][3]
    want = np.array([np.atleast_1d(np.squeeze(formula(*(x[k] for x in points), z[k]))) for k in range(60)])
    np.testing.assert_allclose(got, want, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_jacobians_are_those_of_tangent_coordinates(name: str) -> None:
    points, z = draw(name, 2, 60)
    code, spaces = code_of(name), CASES[name][1]
    # moved poses come back wrapped, and a chordal error changes its sign with a whole turn
    points = [space.normalize_array(x) for space, x in zip(spaces, points, strict=True)]
    _, J = code.residual_and_jacobian(columns(points, z), 60)
    h, at = 1e-6, 0
    for s, space in enumerate(spaces):
        for k in range(space.dim):
            moved = []
            for sign in (1.0, -1.0):
                step = np.zeros((60, space.dim))
                step[:, k] = sign * h
                x = list(points)
                x[s] = space.retract_array(points[s], step)
                moved.append(code.residual(columns(x, z), 60))
            difference = (moved[0] - moved[1]) / (2 * h)
            smooth = np.abs(moved[0] - moved[1]) < 0.1  # not across the cut of an angle
            np.testing.assert_allclose(J[:, :, at][smooth], difference[smooth], atol=2e-6)
            assert smooth.mean() > 0.98
            at += 1
    assert at == J.shape[2]


@pytest.mark.parametrize("name", CASES)
def test_exact_measurements_leave_nothing(name: str) -> None:
    points, z = draw(name, 3, 20)
    code = code_of(name)
    if name.startswith(("relative pose", "pose")):
        pairs = [between(a, b) for a, b in zip(*points, strict=True)] if len(points) == 2 else points[0]
        exact = np.array(pairs)
    elif name.startswith("heading"):
        exact = points[0][:, 2:]
    else:
        exact = code.residual(columns(points, 0 * z), 20).copy()
        if "chordal" in name:
            exact[:, 0] = 2 * np.arcsin(exact[:, 0] / 2)
    np.testing.assert_allclose(code.residual(columns(points, exact), 20), 0.0, atol=1e-9)


@pytest.mark.parametrize("name", [n for n, (_, spaces, *_) in CASES.items() if SE2 in spaces])
def test_whole_turns_change_no_cost(name: str) -> None:
    points, z = draw(name, 4, 30)
    code = code_of(name)
    before = code.residual(columns(points, z), 30)
    for s, space in enumerate(CASES[name][1]):
        if space is SE2:
            x = [p.copy() for p in points]
            x[s][:, 2] += 2 * np.pi
            np.testing.assert_allclose(code.residual(columns(x, z), 30) ** 2, before**2, atol=1e-8)


@pytest.mark.parametrize("kind", ["heading", "bearing"])
def test_chordal_and_geodesic_errors_agree_to_third_order(kind: str) -> None:
    geodesic = "heading" if kind == "heading" else "bearing of a pose"
    points, z = draw(geodesic, 5, 1)
    base = code_of(geodesic).residual(columns(points, 0 * z), 1)
    for e in (1e-1, 1e-2):
        args = columns(points, base - e)
        one, two = code_of(geodesic).residual(args, 1), code_of(f"{kind}, chordal").residual(args, 1)
        assert one.item() == pytest.approx(e, rel=1e-9)
        assert abs(one.item()) - abs(two.item()) == pytest.approx(e**3 / 24, rel=1e-2)


def test_far_errors_stay_bounded() -> None:
    """The geodesic error is at most pi, the chordal one at most 2 (its cost is that of von Mises)."""
    points, z = draw("heading", 6, 200)
    args = columns(points, z)
    error = code_of("heading").residual(args, 200)
    assert np.abs(error).max() <= np.pi
    chordal_error = code_of("heading, chordal").residual(args, 200)
    np.testing.assert_allclose(chordal_error**2 / 2, 1 - np.cos(error), atol=1e-12)
