"""Affine problems whose weights differ by many orders of magnitude: the linear answer keeps the digits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from problems import Gaussian, Problem, Vector
from problems.solvers.base import Status
from problems.solvers.qp_session import QPSession


def network(count: int, sigma: float, kind: str = "") -> tuple[Problem, dict[str, Any], np.ndarray]:
    """Positions by precise differences and coarse fixes; the optimum by orthogonal factorization and refinement."""
    rng = np.random.default_rng(count)
    place = rng.uniform(0, 100, (count, 2))
    i = np.concatenate([np.arange(count - 1), rng.choice(count, count)])
    j = np.concatenate([np.arange(1, count), (i[count - 1 :] + 1 + rng.integers(0, count - 1, count)) % count])
    p = Problem("network")
    x, fix, step = p.variables("x", Vector(2), count), p.data("fix", 2, count), p.data("step", 2, len(i))
    p.cost("fix", lambda x, z: x - z, x, fix, linear=[0.5, -0.25] if kind == "linear" else None)
    p.cost("step", lambda a, b, z: b - a - z, (x[i], x[j]), step, Gaussian(sigma))
    if kind == "box":
        p.inequality("box", lambda x: x, x, lower=-1e3, upper=1e3)
    if kind == "equality":
        p.equality("sum", lambda a, b: a + b - 1, (x[0], x[1]))
    data = {
        "fix": place + rng.normal(size=place.shape),
        "step": place[j] - place[i] + sigma * rng.normal(size=(i.size, 2)),
    }
    A = np.zeros((count + i.size, count))
    A[np.arange(count), np.arange(count)] = 1
    A[count + np.arange(i.size), j] += 1 / sigma
    A[count + np.arange(i.size), i] -= 1 / sigma
    N, start = np.eye(count), np.zeros(count)
    if kind == "equality":
        N = np.delete(N, 0, axis=1)
        N[0, 0], start[0] = -1.0, 1.0
    Q, R = np.linalg.qr(A @ N)
    shift = np.array([0.5, -0.25]) if kind == "linear" else np.zeros(2)
    b = np.vstack([data["fix"] - shift, data["step"] / sigma]).astype(np.longdouble)
    v = np.zeros((N.shape[1], 2), np.longdouble)
    for _ in range(6):
        rest = b - A.astype(np.longdouble) @ (N.astype(np.longdouble) @ v + start[:, None])
        v = v + np.linalg.solve(R, Q.T @ rest.astype(float))
    return p, data, np.asarray(N @ v + start[:, None], float)


@pytest.mark.parametrize("kind", ["", "linear", "box", "equality"])
@pytest.mark.parametrize(("count", "sigma"), [(20, 1e-4), (20, 1e-6), (150, 1e-5)])
def test_the_small_weights_keep_their_digits(count: int, sigma: float, kind: str) -> None:
    problem, data, exact = network(count, sigma, kind)
    session = problem.compile()
    assert isinstance(session, QPSession)
    assert session.program.dense == (count == 20)
    solution = session.solve(data)
    assert solution.status is Status.SOLVED and solution.method == "linear"
    np.testing.assert_allclose(solution["x"], exact, atol=1e-8)
    if kind != "equality":  # there the sum anchors the network, and the residual is a bound worked out ahead
        assert solution.residuals["dual"] < 1e-12 / sigma**2  # what rounding of the solution leaves in the gradient
    if kind == "box":
        map_ = session.current_map()
        numbers = np.stack([session.store.numbers, 0.5 * session.store.numbers])
        z, excess = map_.many(numbers)
        np.testing.assert_allclose(z[0], exact.ravel(), atol=1e-8)
        np.testing.assert_allclose(z[1], map_(numbers[1])[0], atol=1e-8)
        np.testing.assert_allclose(excess[0], np.concatenate([z[0] - 1e3, -1e3 - z[0]]), atol=1e-9)


def test_moderate_weights_cost_nothing_more() -> None:
    session = network(20, 1e-2)[0].compile()
    assert isinstance(session, QPSession)
    assert session.current_map().exact
