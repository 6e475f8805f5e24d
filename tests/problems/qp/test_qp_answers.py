"""Every QP backend against references: active sets enumerated, KKT conditions checked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from qp_problems import QP, UNRELIABLE, backend_class, random_qp, window_qp

from problems.solvers.base import Options, Status


def test_tiny_problems_match_enumerated_active_sets(cls: type[Any]) -> None:
    rng = np.random.default_rng(1)
    solved = total = 0
    while total < 25:
        n, m = int(rng.integers(1, 4)), int(rng.integers(1, 6))
        qp = random_qp(rng, n, m, int(rng.integers(0, min(n, m + 1))))
        reference = qp.enumerated()
        if reference is None:
            continue
        total += 1
        status, result = qp.judged(qp.backend(cls))
        if status is Status.SOLVED:
            solved += 1
            assert result.x is not None
            np.testing.assert_allclose(result.x, reference, atol=2e-4)
        else:
            assert status in (Status.INACCURATE, Status.ITERATION_LIMIT, Status.FAILED), result.message
    assert solved >= (0.5 if cls.name in UNRELIABLE else 0.96) * total


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_solved_means_small_residuals(cls: type[Any], tolerance: float) -> None:
    rng = np.random.default_rng(2)
    solved = 0
    for _ in range(12):
        n = int(rng.integers(4, 16))
        qp = random_qp(rng, n, int(rng.integers(n, 2 * n)), n // 3, pull=10.0)
        status, result = qp.judged(qp.backend(cls, tolerance=tolerance), tolerance)
        if status is not Status.SOLVED:
            assert status in (Status.INACCURATE, Status.ITERATION_LIMIT, Status.FAILED), result.message
            continue
        solved += 1
        x, y = result.x, result.y
        assert x is not None and y is not None
        r, scale = qp.A @ x, max(1, np.abs(qp.P @ x).max(), np.abs(qp.A.T @ y).max(), np.abs(qp.q).max())
        assert max(np.max(r - qp.u), np.max(qp.l - r)) <= tolerance * max(1, np.abs(r).max())
        kept = np.where((y > 0) & np.isinf(qp.u) | (y < 0) & np.isinf(qp.l), 0, y)
        assert np.abs(qp.P @ x + qp.q + qp.A.T @ kept).max() <= tolerance * scale
    assert solved >= (5 if cls.name in UNRELIABLE else 11)


def test_tight_solutions_satisfy_the_kkt_conditions(cls: type[Any]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(10):
        qp = random_qp(rng, 8, 14, 2, pull=10.0)
        status, result = qp.judged(qp.backend(cls, tolerance=1e-9), 1e-9)
        if status is Status.SOLVED:
            assert result.x is not None and result.y is not None
            assert qp.violation(result.x, result.y) < 2e-4


@pytest.mark.parametrize(
    ("q", "l", "u", "x", "y"),
    [
        (-3.0, -np.inf, 1.0, 1.0, 2.0),
        (3.0, -1.0, np.inf, -1.0, -2.0),
        (-3.0, 1.0, 1.0, 1.0, 2.0),
        (3.0, 1.0, 1.0, 1.0, -4.0),
    ],
)
def test_multipliers_are_positive_at_the_upper_bound(
    cls: type[Any], q: float, l: float, u: float, x: float, y: float
) -> None:
    qp = QP(np.eye(2), [q, 0.5], [[1.0, 0.0], [0.3, 1.0]], [l, -50.0], [u, 50.0])
    status, result = qp.judged(qp.backend(cls))
    assert status is Status.SOLVED, result.message
    assert result.x is not None and result.y is not None
    assert result.x[0] == pytest.approx(x, abs=1e-6)
    assert result.y == pytest.approx([y, 0.0], abs=1e-6)


def test_no_rows_and_free_rows(cls: type[Any]) -> None:
    rng = np.random.default_rng(4)
    qp = random_qp(rng, 5, 4, 0)
    minimiser = -np.linalg.solve(qp.P, qp.q)
    for rows in (0, 4):
        loose = QP(qp.P, qp.q, qp.A[:rows], np.full(rows, -np.inf), np.full(rows, np.inf))
        status, result = loose.judged(loose.backend(cls))
        assert status is Status.SOLVED, result.message
        np.testing.assert_allclose(result.x, minimiser, atol=1e-5)
        assert result.y is not None and result.y.shape == (rows,)
        np.testing.assert_allclose(result.y, 0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["daqp", "quadprog", "osqp", "proxqp", "piqp", "clarabel", "highs", "qpoases"])
def test_hessian_that_is_definite_on_the_equalities_only(name: str) -> None:
    cls = backend_class(name)
    for seed in range(5):
        qp = window_qp(np.random.default_rng(seed))
        assert np.linalg.eigvalsh(qp.P)[0] < 1e-10
        backend = qp.backend(cls)
        for scale in (1.0, 0.6):
            moved = QP(qp.P, scale * qp.q, qp.A, qp.l, qp.u)
            moved.l[:3] += 0.05 * scale
            moved.u[:3] += 0.05 * scale
            status, result = moved.judged(backend)
            assert status is Status.SOLVED, result.message
            assert result.x is not None and result.y is not None
            assert moved.violation(result.x, result.y) < 1e-4


def test_semidefinite_without_equalities_goes_through_daqps_proximal_iterations() -> None:
    cls = backend_class("daqp")
    rng = np.random.default_rng(5)
    M = rng.normal(size=(2, 5))
    qp = QP(M.T @ M, rng.normal(size=5), np.eye(5), np.full(5, -1.0), np.full(5, 1.0))
    status, result = qp.judged(qp.backend(cls), 1e-7)
    assert status is Status.SOLVED, result.message


def test_either_storage_is_taken(cls: type[Any]) -> None:
    qp = random_qp(np.random.default_rng(6), 5, 7, 1)
    expected = qp.judged(qp.backend(cls))[1].x
    for P, A in ((qp.P, qp.A), (sp.csc_array(qp.P), sp.csc_array(qp.A)), (sp.csr_matrix(qp.P), sp.csr_matrix(qp.A))):
        backend = cls(P, qp.q, A, qp.l, qp.u, Options())
        np.testing.assert_allclose(backend.solve(qp.q, qp.l, qp.u).x, expected, atol=1e-5)
        backend.update(qp.P, qp.A)
        np.testing.assert_allclose(backend.solve(qp.q, qp.l, qp.u).x, expected, atol=1e-5)
