"""Our own verdict on what a QP backend claims.

Residuals are recomputed from the problem and the point. A claim of infeasibility or unboundedness comes without a
point; it is checked by a small linear program where that is cheap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_scaling import hidden_error

_CHEAP = 200_000  # numbers in the linear program of a certificate
_EXACT = 1e-7  # what the linear program itself is good for


@dataclass(frozen=True)
class QPResiduals:
    """How far (x, y) is from optimal for ``min 1/2 x'Px + q'x, l <= Ax <= u``; largest components, and the gap.

    A multiplier on a side without a bound counts as zero, so what it hid appears in `dual`.

    Attributes:
        primal: largest violation of a row.
        dual: largest component of ``Px + q + A'y``.
        gap: ``|x'Px + q'x + sum(u y+) + sum(l y-)|``.
        primal_size: ``max(1, |Ax|)``; bounds are left out, a large one somewhere would excuse a violation elsewhere.
        dual_size: ``max(1, |Px|, |A'y|, |q|)``.
        gap_size: ``max(1, x'Px, |q'x|, |sum(u y+) + sum(l y-)|)``.
    """

    primal: float
    dual: float
    gap: float
    primal_size: float
    dual_size: float
    gap_size: float

    def within(self, tolerance: float) -> bool:
        """Whether all three are at most `tolerance` times their size; NaN is not."""
        return (
            self.primal <= tolerance * self.primal_size
            and self.dual <= tolerance * self.dual_size
            and self.gap <= tolerance * self.gap_size
        )

    @property
    def worst(self) -> float:
        """Largest of the three relative to its size."""
        return float(np.max([self.primal / self.primal_size, self.dual / self.dual_size, self.gap / self.gap_size]))


def residuals(P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, x: np.ndarray, y: np.ndarray) -> QPResiduals:
    """Residuals of the point x (n,) with multipliers y (m,); P (n, n) and A (m, n) dense or sparse."""
    if y.size:
        y = np.where(((y > 0) & (u == np.inf)) | ((y < 0) & (l == -np.inf)), 0.0, y)
    Px, Ax, Ay = P @ x, A @ x, A.T @ y
    finite_l, finite_u = np.where(l > -np.inf, l, 0.0), np.where(u < np.inf, u, 0.0)
    support = float(np.maximum(y, 0.0) @ finite_u + np.minimum(y, 0.0) @ finite_l)
    quadratic, linear = float(x @ Px), float(q @ x)
    return QPResiduals(
        primal=max(0.0, _largest(Ax - u), _largest(l - Ax)) if l.size else 0.0,
        dual=_size(Px + q + Ay),
        gap=abs(quadratic + linear + support),
        primal_size=max(1.0, _size(Ax)),
        dual_size=max(1.0, _size(Px), _size(Ay), _size(q)),
        gap_size=max(1.0, abs(quadratic), abs(linear), abs(support)),
    )


def judge(
    result: QPResult, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, tolerance: float
) -> tuple[Status, QPResult]:
    """What `result` is worth, by our residuals.

    A point within `tolerance` is solved, whatever the backend says of it, unless weights differ so much that relative
    residuals hide a larger share of the cost (`hidden_error`). A point beyond it that was claimed to be a solution is
    inaccurate. Bounds that cross are infeasible at once. Claims of infeasibility and unboundedness are believed unless
    a linear program finds the contrary; and where a backend failed or gave up far from a solution, a linear program
    says whether the problem is to blame.

    Args:
        result: what the backend returned.
        P: (n, n), dense or sparse.
        q: (n,).
        A: (m, n), dense or sparse.
        l: (m,), -inf for none.
        u: (m,), inf for none.
        tolerance: allowed residuals, relative to their sizes (`QPResiduals`).

    Returns:
        The status and the result with it; a point that is not finite or means nothing is removed.
    """
    x, y, claim, message = result.x, result.y, result.status, result.message
    ordered = np.count_nonzero(np.less_equal(l, u)) == l.size
    if ordered and x is not None and y is not None and _clearly_solved(P, q, A, l, u, x, y, tolerance):
        return Status.SOLVED, result if claim is Status.SOLVED else replace(result, status=Status.SOLVED)
    if not ordered and (l - u > tolerance * np.maximum(1.0, np.abs(u))).any():
        return _without_point(result, Status.INFEASIBLE, "" if claim is Status.INFEASIBLE else "bounds cross")
    if x is None:
        return _claim_without_point(result, P, q, A, l, u)
    if not np.isfinite(x).all() or (y is not None and not np.isfinite(y).all()):
        return _without_point(result, Status.FAILED, "the point is not finite")
    claimed = claim in (Status.SOLVED, Status.INACCURATE)
    found = residuals(P, q, A, l, u, x, np.zeros(l.size) if y is None else y)
    hidden = 0.0
    if y is not None and found.within(tolerance):
        hidden = hidden_error(P, q, A, l, u, x, y, tolerance)
        if hidden <= tolerance:
            return Status.SOLVED, replace(result, status=Status.SOLVED)
    if not np.isfinite(found.worst):
        return _without_point(result, Status.FAILED, "the residuals are not finite")
    if found.primal > max(tolerance, 1e-6) * found.primal_size and is_infeasible(A, l, u):
        return _without_point(result, Status.INFEASIBLE, "no point satisfies all rows")
    if found.dual > max(tolerance, 1e-6) * found.dual_size and is_unbounded(P, q, A, l, u):
        return _without_point(result, Status.UNBOUNDED, "the cost has no lower bound")
    if not claimed:
        return claim, result
    if y is None:
        message = _joined("no multipliers to judge the point by", message)
    elif hidden:
        message = _joined(f"weights differ much; the cost may be {hidden:.1e} too high", message)
    else:
        message = _joined(f"largest relative residual {found.worst:.1e}, asked for {tolerance:.1e}", message)
    return Status.INACCURATE, replace(result, status=Status.INACCURATE, message=message)


def _clearly_solved(
    P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, x: np.ndarray, y: np.ndarray, tolerance: float
) -> bool:
    """Whether the residuals are within `tolerance` even without their sizes: a third of the work, and mostly enough."""
    Px = P.dot(x)
    dual = Px + q
    if l.size:
        Ax = A.dot(x)
        if not np.maximum.reduce(np.maximum(Ax - u, l - Ax)) <= tolerance:
            return False
        active = y.nonzero()[0]
        multipliers = y[active]
        dual += A.T.dot(y)
        gap = multipliers.dot(np.where(multipliers > 0, u[active], l[active]))
    else:
        gap = 0.0
    return bool(dual.dot(dual) <= tolerance * tolerance and abs(x.dot(Px) + q.dot(x) + gap) <= tolerance)


def _claim_without_point(
    result: QPResult, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray
) -> tuple[Status, QPResult]:
    claim = result.status
    if claim in (Status.SOLVED, Status.INACCURATE):
        return _without_point(result, Status.FAILED, "claimed solved, but gave no point")
    if claim is Status.INFEASIBLE:
        if is_infeasible(A, l, u) is False:
            return _without_point(result, Status.FAILED, "claimed infeasible, but a feasible point exists")
    elif claim is Status.UNBOUNDED:
        if is_unbounded(P, q, A, l, u) is False:
            return _without_point(result, Status.FAILED, "claimed unbounded, but the cost is bounded")
    elif claim in (Status.FAILED, Status.ITERATION_LIMIT) and np.isfinite(q).all() and (l <= u).all():
        if is_infeasible(A, l, u):
            return _without_point(result, Status.INFEASIBLE, "no point satisfies all rows")
        if is_unbounded(P, q, A, l, u):
            return _without_point(result, Status.UNBOUNDED, "the cost has no lower bound")
    return _without_point(result, claim, "")


def _without_point(result: QPResult, status: Status, verdict: str) -> tuple[Status, QPResult]:
    message = _joined(verdict, result.message) if verdict else result.message
    return status, replace(result, x=None, y=None, status=status, message=message)


def is_infeasible(A: Any, l: np.ndarray, u: np.ndarray) -> bool | None:
    """Whether no x has ``l <= Ax <= u``; None when the check is too large or fails.

    Minimizes the largest violation, relative to ``max(1, |bound|)`` of each row, by a linear program.
    """
    import scipy.sparse as sp
    from scipy.optimize import linprog

    m, n = A.shape
    if (A.size if isinstance(A, np.ndarray) else A.nnz) > _CHEAP:
        return None
    if not m:
        return False
    upper, lower = np.flatnonzero(u < np.inf), np.flatnonzero(l > -np.inf)
    rows = sp.csr_array(A)
    bounds = np.concatenate([u[upper], -l[lower]])
    if not bounds.size:
        return False
    if not np.isfinite(bounds).all():
        return True
    sizes = np.maximum(1.0, np.abs(bounds))
    G = sp.hstack([sp.vstack([rows[upper], -rows[lower]]), -sizes[:, None]], format="csc")
    cost = np.zeros(n + 1)
    cost[-1] = 1.0
    limits = [(None, None)] * n + [(0.0, None)]
    found = linprog(cost, A_ub=G, b_ub=bounds, bounds=limits, method="highs")
    if found.status != 0:
        return None
    return bool(found.fun > _EXACT)


def is_unbounded(P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray) -> bool | None:
    """Whether the cost falls for ever along some direction; None when the check is too large or fails.

    Looks for d in the unit box with ``Pd = 0``, ``q'd < 0`` and ``Ad`` that leaves no bound, by a linear program.
    """
    import scipy.sparse as sp
    from scipy.optimize import linprog

    n = P.shape[0]
    numbers = sum(matrix.size if isinstance(matrix, np.ndarray) else matrix.nnz for matrix in (P, A))
    if numbers > _CHEAP:
        return None
    rows = sp.csr_array(A)
    upper, lower = np.flatnonzero(u < np.inf), np.flatnonzero(l > -np.inf)
    G: Any = sp.vstack([rows[upper], -rows[lower]], format="csc")
    size = max(1.0, _size(q))
    found = linprog(
        q / size,
        A_ub=G if G.shape[0] else None,
        b_ub=np.zeros(G.shape[0]) if G.shape[0] else None,
        A_eq=sp.csc_array(P),
        b_eq=np.zeros(n),
        bounds=[(-1.0, 1.0)] * n,
        method="highs",
    )
    if found.status != 0:
        return None
    return bool(found.fun < -_EXACT)


def _joined(verdict: str, message: str) -> str:
    return f"{verdict} ({message})" if message else verdict


def _size(vector: np.ndarray) -> float:
    return float(np.abs(vector).max()) if vector.size else 0.0


def _largest(vector: np.ndarray) -> float:
    return float(vector.max())
