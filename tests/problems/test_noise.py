"""Noise models, losses and the cost kernels made of them, against plain NumPy."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems import L2, SE2, Cauchy, Gaussian, GemanMcClure, Huber, Problem, Tukey, Vector, wrap
from problems.errors import NoiseError, SettingError
from problems.forms.kernels import cost_kernel
from problems.forms.template import template_of
from problems.noise import information_matrix, whitening

LOSSES = [L2(), Huber(), Huber(0.4), Cauchy(1.3), GemanMcClure(0.8), Tukey(2.5)]


def spd(rng: np.random.Generator, dim: int, count: int | None = None) -> np.ndarray:
    """Random symmetric positive definite matrices."""
    root = rng.normal(size=(count or 1, dim, dim))
    out = root @ root.swapaxes(1, 2) + 0.1 * np.eye(dim)
    return out if count else out[0]


def squares(root: np.ndarray) -> np.ndarray:
    """Information matrices from what `whitening` returns."""
    if root.ndim == 2:
        root = root[:, :, None] * np.eye(root.shape[1])
    return root.swapaxes(1, 2) @ root


@pytest.mark.parametrize("given_noise", [{}, {"sigma": 1.0, "covariance": np.eye(2)}])
def test_noise_is_stated_in_exactly_one_way(given_noise: dict[str, Any]) -> None:
    with pytest.raises(NoiseError, match="exactly one of sigma, covariance, information"):
        Gaussian(**given_noise)


@pytest.mark.parametrize(
    ("value", "dim", "expected"),
    [
        (2.0, 3, np.full((1, 3), 0.5)),
        ([2.0], 3, np.full((1, 3), 0.5)),
        ([1.0, 2.0, 4.0], 3, [[1.0, 0.5, 0.25]]),
        ([[1.0, 2.0, 4.0]], 3, [[1.0, 0.5, 0.25]]),
        ([[1.0, 2.0], [4.0, 5.0], [8.0, 10.0], [0.5, 0.1]], 2, [[1, 0.5], [0.25, 0.2], [0.125, 0.1], [2, 10]]),
        ([1.0, 2.0, 4.0, 5.0], 1, [[1], [0.5], [0.25], [0.2]]),
    ],
)
def test_sigma_in_every_shape(value: Any, dim: int, expected: Any) -> None:
    np.testing.assert_allclose(whitening("sigma", value, dim, 4, "t"), expected)
    W = information_matrix("sigma", value, dim, 4, "t")
    np.testing.assert_allclose(W, squares(np.asarray(expected, float)))


@pytest.mark.parametrize("kind", ["covariance", "information"])
@pytest.mark.parametrize("count", [None, 6])
@pytest.mark.parametrize("dim", [1, 2, 4])
def test_matrices_become_upper_triangular_roots(kind: Any, count: int | None, dim: int) -> None:
    value = spd(np.random.default_rng(3), dim, count)
    information = np.linalg.inv(value) if kind == "covariance" else value
    root = whitening(kind, value, dim, 6, "t")
    assert root.shape == (count or 1, dim, dim)
    np.testing.assert_array_equal(root, np.triu(root))
    assert (np.diagonal(root, axis1=1, axis2=2) > 0).all()
    np.testing.assert_allclose(squares(root), information.reshape(-1, dim, dim), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(
        information_matrix(kind, value, dim, 6, "t"), information.reshape(-1, dim, dim), rtol=1e-9, atol=1e-10
    )


def test_information_may_be_semidefinite() -> None:
    a = np.array([[1.0, 2.0, -1.0]])
    stack = np.stack([a.T @ a, np.zeros((3, 3)), np.diag([1.0, 0, 4.0])])
    root = whitening("information", stack, 3, 3, "t")
    np.testing.assert_array_equal(root, np.triu(root))
    np.testing.assert_allclose(squares(root), stack, atol=1e-12)
    np.testing.assert_array_equal(information_matrix("information", stack, 3, 3, "t"), stack)


@pytest.mark.parametrize("maker", [whitening, information_matrix])
@pytest.mark.parametrize(
    ("kind", "value", "text"),
    [
        ("sigma", [1.0, 0.0], r"cost 'gps': sigma must be positive and finite; instance 0 has \[1. 0.\]"),
        ("sigma", [[1.0, 1.0], [1.0, 1.0], [np.nan, 1.0]], "instance 2"),
        ("sigma", -1.0, "positive"),
        ("sigma", np.inf, "finite"),
        ("sigma", np.ones((2, 2)), r"\(2,\) or \(3, 2\); got shape \(2, 2\)"),
        ("sigma", np.ones(3), r"got shape \(3,\)"),
        ("sigma", [[1.0], [1.0, 2.0]], "sigma must be numbers"),
        ("covariance", np.diag([1.0, -1.0]), "covariance of instance 0 is not positive definite .*-1"),
        ("covariance", np.diag([1.0, 0.0]), "not positive definite"),
        ("covariance", [[1.0, 0.5], [0.4, 1.0]], "instance 0 is not symmetric"),
        ("covariance", [np.eye(2), np.eye(2), [[1, 0], [0, np.nan]]], "covariance of instance 2 is not finite"),
        ("covariance", np.eye(3), r"must be \(2, 2\) or \(3, 2, 2\); got shape \(3, 3\)"),
        ("covariance", [1.0, 1.0], r"got shape \(2,\)"),
        (
            "information",
            [np.eye(2), np.diag([1.0, -1e-3]), np.eye(2)],
            "information of instance 1 is not positive semi",
        ),
        ("information", [[np.nan, 0.0], [0.0, 1.0]], "not finite"),
    ],
)
def test_useless_noise_is_named(maker: Any, kind: Any, value: Any, text: str) -> None:
    with pytest.raises(NoiseError, match=text):
        maker(kind, value, 2, 3, "cost 'gps'")


@pytest.mark.parametrize("loss", LOSSES, ids=repr)
@given(st.floats(0, 1e4))
def test_weight_is_twice_the_slope_of_rho(loss: Any, s: float) -> None:
    x = ca.SX.sym("s")
    slope = ca.Function("f", [x], [ca.jacobian(ca.SX(loss.rho(x)), x)])
    assert float(loss.weight(s)) == pytest.approx(2 * float(slope(s)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("loss", LOSSES, ids=repr)
def test_losses_start_quadratic_and_never_fall(loss: Any) -> None:
    s = np.linspace(0, 60, 400)
    values = np.array([float(loss.rho(v)) for v in s])
    assert values[0] == 0.0
    assert float(loss.rho(1e-6)) == pytest.approx(5e-7, rel=1e-4)
    assert float(loss.weight(0.0)) == 1.0
    assert (np.diff(values) >= -1e-12).all()
    assert (values <= s / 2 + 1e-12).all()


def test_losses_follow_their_definitions() -> None:
    assert float(Huber(2.0).rho(3.9)) == pytest.approx(1.95)
    assert float(Huber(2.0).rho(25.0)) == pytest.approx(2 * (5 - 1))
    assert float(Huber(2.0).weight(25.0)) == pytest.approx(0.4)
    assert float(Cauchy(2.0).rho(12.0)) == pytest.approx(2 * np.log(4))
    assert float(GemanMcClure(2.0).rho(4.0)) == pytest.approx(1.0)
    assert float(Tukey(2.0).rho(5.0)) == pytest.approx(4 / 6)
    assert float(Tukey(2.0).weight(4.0)) == 0.0
    assert float(Tukey(2.0).weight(2.0)) == pytest.approx(0.25)


@pytest.mark.parametrize("kind", [Huber, Cauchy, GemanMcClure, Tukey])
@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_scales_are_positive(kind: Any, scale: float) -> None:
    with pytest.raises(SettingError, match=f"{kind.__name__} needs a positive scale"):
        kind(scale)


def bend(x: Any, pose: Any, z: Any) -> Any:
    """A residual with structural zeros: its second row does not read x."""
    local = pose.transform_to(x)
    return ca.vertcat(ca.sin(local[0]) * local[1] - z[0], wrap(pose.angle - z[1]))


def template() -> Any:
    p = Problem()
    x, pose = p.variables("x", Vector(2)), p.variables("pose", SE2)
    return template_of(p.cost("c", bend, on=(x, pose), data=p.data("z", 2)))


def tangent(point: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual and its Jacobian in tangent coordinates by central differences."""

    def residual(d: np.ndarray) -> np.ndarray:
        x, pose = point[:2] + d[:2], SE2.retract_array(point[None, 2:], d[None, 2:])[0]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        u, v = x - pose[:2]
        local = np.array([c * u + s * v, c * v - s * u])
        return np.array([np.sin(local[0]) * local[1] - z[0], wrap(pose[2] - z[1])])

    h = 1e-6
    J = [(residual(h * e) - residual(-h * e)) / (2 * h) for e in np.eye(5)]
    return residual(np.zeros(5)), np.column_stack(J)


@pytest.mark.parametrize(("loss", "linear"), [(L2(), True), *((loss, False) for loss in LOSSES)], ids=repr)
@pytest.mark.parametrize("full", [False, True])
def test_kernels_give_value_gradient_and_gauss_newton_hessian(loss: Any, full: bool, linear: bool) -> None:
    t, rng = template(), np.random.default_rng(8)
    kernel = cost_kernel(t, full, linear, loss)
    U = np.triu(rng.normal(size=(2, 2))) if full else np.diag([0.7, 2.0])
    numbers = U[np.triu_indices(2)] if full else np.diag(U)
    for size in (0.3, 3.0):
        point, z = size * rng.normal(size=5), rng.normal(size=2)
        lam = rng.normal(size=2) if linear else np.zeros(0)
        r, J = tangent(point, z)
        e, Je = U @ r, U @ J
        s = e @ e
        w = float(loss.weight(s))
        value, gradient, H = float(loss.rho(s)), w * Je.T @ e, w * Je.T @ Je
        if linear:
            value, gradient = value + lam @ r, gradient + J.T @ lam
        given = np.concatenate([point, z, numbers, lam])
        out = np.ravel(kernel.function(given))
        assert out[0] == pytest.approx(value, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(out[1:6], gradient, atol=1e-7)
        filled = np.zeros((5, 5))
        for (a, b), h in zip(kernel.pairs, out[6:], strict=True):
            assert a <= b
            filled[a, b] = filled[b, a] = h
        np.testing.assert_allclose(filled, H, atol=1e-7)
        assert float(kernel.value_function(given)) == out[0]


def test_switched_kernels_give_exact_zeros_even_for_nan() -> None:
    kernel = cost_kernel(template(), True, True, L2(), True)
    values = [0.3, 0.1, 1.0, 2.0, 0.4, np.nan, np.nan, 1.0, 0.5, 2.0, 1.0, np.nan]
    np.testing.assert_array_equal(np.ravel(kernel.function(np.array([*values, 0.0]))), 0.0)
    assert np.isnan(float(kernel.function(np.array([*values, 1.0]))[0]))


def test_structural_zeros_are_not_computed() -> None:
    assert len(cost_kernel(template(), False, False, L2()).pairs) == 15
    p = Problem()
    a, b = p.variables("a", Vector(2)), p.variables("b", Vector(2))
    t = template_of(p.cost("c", lambda a, b: a - b, on=(a, b)))
    assert cost_kernel(t, False, False, L2()).pairs == ((0, 0), (0, 2), (1, 1), (1, 3), (2, 2), (3, 3))
