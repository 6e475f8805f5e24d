"""Our own verdict on what a backend claims."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from qp_problems import QP, random_qp

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_check import QPResiduals, is_infeasible, is_unbounded, judge, residuals


def solution() -> tuple[QP, np.ndarray, np.ndarray]:
    qp = QP(np.eye(2), [-3.0, 0.5], np.eye(2), [-np.inf, -1.0], [1.0, np.inf])
    return qp, np.array([1.0, -0.5]), np.array([2.0, 0.0])


def verdict(qp: QP, result: QPResult, tolerance: float = 1e-8, sparse: bool = False) -> tuple[Status, Any]:
    P, A = (sp.csc_array(qp.P), sp.csc_array(qp.A)) if sparse else (qp.P, qp.A)
    return judge(result, P, qp.q, A, qp.l, qp.u, tolerance)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    "claim", [Status.SOLVED, Status.INACCURATE, Status.ITERATION_LIMIT, Status.TIME_LIMIT, Status.FAILED]
)
def test_a_good_point_is_solved_whatever_is_claimed(claim: Status, sparse: bool) -> None:
    qp, x, y = solution()
    status, result = verdict(qp, QPResult(x, y, claim), sparse=sparse)
    assert status is result.status is Status.SOLVED


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    ("x", "y"),
    [
        ([1.0, -0.5 + 1e-4], [2.0, 0.0]),  # dual
        ([1.0 + 1e-4, -0.5], [2.0, 0.0]),  # primal and dual
        ([0.9, -0.5], [2.1, 0.0]),  # only the gap: inside, with a multiplier
        ([3.0, -0.5], [0.0, 0.0]),  # only primal
        ([1.0, 0.3], [2.0, -0.8]),  # the multiplier of a bound that is not active
    ],
)
def test_a_point_beyond_the_tolerance_is_inaccurate(x: list[float], y: list[float], sparse: bool) -> None:
    qp, *_ = solution()
    status, result = verdict(qp, QPResult(np.array(x), np.array(y), Status.SOLVED), sparse=sparse)
    assert status is result.status is Status.INACCURATE
    assert "largest relative residual" in result.message
    assert result.x is not None
    assert verdict(qp, QPResult(np.array(x), np.array(y), Status.TIME_LIMIT))[0] is Status.TIME_LIMIT


def test_a_multiplier_without_a_bound_is_no_certificate() -> None:
    qp, *_ = solution()
    # Stationary only thanks to a multiplier on the upper side of the second row, which has no upper bound.
    found = residuals(qp.P, qp.q, qp.A, qp.l, qp.u, np.array([1.0, -0.9]), np.array([2.0, 0.4]))
    assert found.dual == pytest.approx(0.4)
    assert verdict(qp, QPResult(np.array([1.0, -0.9]), np.array([2.0, 0.4]), Status.SOLVED))[0] is Status.INACCURATE


def test_residuals_are_relative_to_the_size_of_the_problem() -> None:
    qp, x, y = solution()
    big = QP(qp.P, 1e6 * qp.q, qp.A, 1e6 * qp.l, 1e6 * qp.u)
    off = QPResult(1e6 * x + 1e-3, 1e6 * y, Status.SOLVED)
    assert verdict(big, off)[0] is Status.SOLVED
    assert verdict(qp, QPResult(x + 1e-3, y, Status.SOLVED))[0] is Status.INACCURATE
    # A huge bound elsewhere excuses nothing.
    wide = QP(qp.P, qp.q, qp.A, [-1e9, -1.0], [1.0, 1e9])
    assert verdict(wide, QPResult(np.array([3.0, -0.5]), np.zeros(2), Status.SOLVED))[0] is Status.INACCURATE


def test_dense_and_sparse_residuals_agree() -> None:
    rng = np.random.default_rng(20)
    qp = random_qp(rng, 5, 8, 1)
    x, y = rng.normal(size=5), rng.normal(size=8)
    one = residuals(qp.P, qp.q, qp.A, qp.l, qp.u, x, y)
    other = residuals(sp.csc_array(qp.P), qp.q, sp.csc_array(qp.A), qp.l, qp.u, x, y)
    for field in ("primal", "dual", "gap", "primal_size", "dual_size", "gap_size"):
        assert getattr(one, field) == pytest.approx(getattr(other, field), rel=1e-12)
    kept = np.where((y > 0) & np.isinf(qp.u) | (y < 0) & np.isinf(qp.l), 0, y)
    assert one.dual == pytest.approx(np.abs(qp.P @ x + qp.q + qp.A.T @ kept).max())
    assert one.primal == pytest.approx(max(np.max(qp.A @ x - qp.u), np.max(qp.l - qp.A @ x)))
    assert not QPResiduals(np.nan, 0, 0, 1, 1, 1).within(1e-3)


def test_nonsense_is_failed() -> None:
    qp, x, y = solution()
    for result in (
        QPResult(np.array([np.nan, 0.0]), y, Status.SOLVED),
        QPResult(x, np.array([np.nan, 0.0]), Status.SOLVED),
        QPResult(None, None, Status.SOLVED),
    ):
        status, judged = verdict(qp, result)
        assert status is judged.status is Status.FAILED
        assert judged.x is None and judged.message
    assert verdict(qp, QPResult(x, None, Status.SOLVED))[0] is Status.INACCURATE


def test_false_claims_of_no_solution_are_found_out() -> None:
    qp, *_ = solution()
    status, result = verdict(qp, QPResult(None, None, Status.INFEASIBLE))
    assert status is Status.FAILED and "feasible point exists" in result.message
    status, result = verdict(qp, QPResult(None, None, Status.UNBOUNDED))
    assert status is Status.FAILED and "bounded" in result.message
    impossible = QP(np.eye(2), qp.q, [[1, 0], [0, 1], [1, 1]], [-1, -1, 3], [1, 1, 4])
    falling = QP(np.diag([1.0, 0.0]), [0.0, -1.0], np.eye(2), [-1, -1], [1, np.inf])
    assert verdict(impossible, QPResult(None, None, Status.INFEASIBLE))[0] is Status.INFEASIBLE
    assert verdict(impossible, QPResult(None, None, Status.ITERATION_LIMIT))[0] is Status.INFEASIBLE
    assert verdict(impossible, QPResult(np.zeros(2), np.zeros(3), Status.ITERATION_LIMIT))[0] is Status.INFEASIBLE
    assert verdict(falling, QPResult(None, None, Status.UNBOUNDED))[0] is Status.UNBOUNDED
    assert verdict(falling, QPResult(np.zeros(2), np.zeros(2), Status.SOLVED))[0] is Status.UNBOUNDED
    assert verdict(impossible, QPResult(None, None, Status.TIME_LIMIT))[0] is Status.TIME_LIMIT


def test_crossed_bounds_are_infeasible_at_once() -> None:
    qp, x, y = solution()
    crossed = QP(qp.P, qp.q, qp.A, [2.0, -1.0], [1.0, np.inf])
    status, result = verdict(crossed, QPResult(x, y, Status.SOLVED))
    assert status is Status.INFEASIBLE and "cross" in result.message and result.x is None


def test_certificates() -> None:
    A = np.array([[1.0, 1.0], [1.0, -1.0]])
    free = np.full(2, np.inf)
    assert is_infeasible(A, -free, free) is False
    assert is_infeasible(A, np.zeros(2), np.ones(2)) is False
    assert is_infeasible(np.vstack([A, A[:1]]), np.array([0, 0, 2.0]), np.array([1.0, 1, 3])) is True
    assert is_infeasible(np.zeros((0, 2)), np.zeros(0), np.zeros(0)) is False
    assert is_unbounded(np.eye(2), np.ones(2), A, -free, free) is False
    assert is_unbounded(np.zeros((2, 2)), np.ones(2), A, -free, free) is True
    assert is_unbounded(np.zeros((2, 2)), np.array([1.0, 0]), A, np.array([0.0, -np.inf]), free) is True
    assert is_unbounded(np.zeros((2, 2)), np.array([1.0, 1]), A, np.array([0.0, -np.inf]), free) is False
    large = sp.csc_array(np.ones((500, 500)))
    assert is_infeasible(large, np.zeros(500), np.ones(500)) is None
