"""Projections of affine answers onto their rows."""

from __future__ import annotations

import numpy as np
import pytest

from problems.solvers.base import Options
from problems.solvers.qp_daqp import DAQP
from problems.solvers.qp_projection import Projection


def program(seed: int, size: int = 6, rows: int = 15) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size), rng.normal(size=(rows, size))


def projection(H: np.ndarray, A: np.ndarray) -> Projection:
    lift = np.linalg.solve(np.linalg.cholesky(H), np.vstack([np.eye(len(H)), A]).T).T
    return Projection(lift, slice(len(H), None), Options())


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_optimum(seed: int) -> None:
    H, A = program(seed)
    n, rng = len(H), np.random.default_rng(seed)
    projected = projection(H, A)
    for _ in range(10):
        q, b = rng.normal(size=n) * 3, rng.uniform(0, 1, len(A))
        free = -np.linalg.solve(H, q)
        found = projected(np.concatenate([free, A @ free - b]))
        want = DAQP(H, q, A, np.full(len(A), -np.inf), b, Options()).solve(q, np.full(len(A), -np.inf), b)
        assert found is not None and want.x is not None and want.y is not None
        np.testing.assert_allclose(found.outputs[:n], want.x, atol=1e-8)
        np.testing.assert_allclose(found.outputs[n:], A @ want.x - b, atol=1e-8)
        np.testing.assert_allclose(found.multipliers, want.y, atol=1e-7)
        assert found.violation <= 1e-8 and found.gap <= 1e-8


def test_what_has_no_answer_is_none_and_the_next_one_is_right() -> None:
    H, A = np.eye(2), np.array([[1.0, 0.0], [-1.0, 0.0]])
    projected = projection(H, A)
    for bad in ([0.0, 0.0, 1.0, 1.0], [np.nan] * 4):  # x <= -1 and x >= 1; not finite
        assert projected(np.array(bad)) is None
        found = projected(np.array([0.0, 3.0, 2.0, -4.0]))
        assert found is not None
        np.testing.assert_allclose(found.outputs, [-2.0, 3.0, 0.0, -2.0], atol=1e-12)


def test_rows_that_nothing_moves_are_left_to_the_backend() -> None:
    assert projection(np.eye(2), np.array([[1.0, 0.0], [0.0, 0.0]]))(np.array([0.0, 0.0, 1.0, 1.0])) is None
