"""Quadratic programs whose weights differ much: scaled and centred for backends, judged by their own scale.

Backends stop, and residuals are called small, relative to the largest numbers. Where a sensor weighs 1e9 times another,
these hide what the other has to say: points metres off passed for solutions. So unknowns are scaled to a unit diagonal
and counted from the minimiser of the costs, short rows are scaled to unit length, and the verdict adds what the cost
may still fall by.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs  # type: ignore[attr-defined]

from problems.solvers.base import QPResult

# Measured: from such shares on, points of iterating backends are off by a hundredth of a standard deviation, and osqp
# takes thousands of steps.
EVEN = 1e-2
# From such shares on, residuals relative to the largest numbers hide what matters. Methods that end at a vertex lose
# their way far later.
MISLEADING = 1e-5
_NOTHING = 1e-15  # share of the largest diagonal entry that is no curvature
_SINGULAR = (1e-14, 1e-9)  # added to the unit diagonal, the second where the first does not make P definite

Warm = tuple[np.ndarray, np.ndarray]


class Scaling:
    """``x = S (v + v0)`` with powers of two in S and in the factors of rows and cost, so that nothing is rounded.

    The minimiser v0 of the costs, equality rows counting as costs of weight one, is worked out for each q.

    Args:
        P: positive semidefinite (n, n), dense or ``csc_array``.
        A: (m, n), dense or ``csc_array``.
        equal: (m,) whether a row is an equality.

    Attributes:
        P, A: the scaled matrices, stored as the given ones.
    """

    def __init__(self, P: Any, A: Any, equal: np.ndarray) -> None:
        diagonal = P.diagonal()
        curved = _curved(diagonal)
        # With a cost factor of at most one no unknown is stretched, and a bound is kept as closely as without scaling.
        cost = _power_of_two(np.sqrt(min(1.0, float(diagonal[curved].min()))))
        scales = np.full(diagonal.size, np.inf)
        scales[curved] = cost / np.sqrt(diagonal[curved])
        if equal.any():
            if not curved.all():
                scales = _joined(A, equal, scales)
            scales = _joined(A, equal, np.where(np.isfinite(scales), scales, cost))
        self._unknowns = _power_of_two(np.where(np.isfinite(scales), scales, cost))
        self._cost = cost * cost
        self.P = _times(self._unknowns / self._cost, P, self._unknowns)
        A = _times(None, A, self._unknowns)
        lengths = np.sqrt(_squared_rows(A))
        self._rows = _power_of_two(np.maximum(1.0, 1.0 / np.where(lengths > 0, lengths, 1.0)))
        self.A = _times(self._rows, A, None)
        self._multipliers = self._cost * self._rows
        self._gradients = self._unknowns / self._cost
        self._key: bytes | None = None
        self._centre = np.zeros(diagonal.size)
        self._last: tuple[np.ndarray | None, Warm | None] = None, None

    def given(
        self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Warm | None]:
        """Vectors and starting point of the scaled problem."""
        q, l, u = self._gradients * q, self._rows * l, self._rows * u
        equal = l == u
        if equal.tobytes() != self._key:
            self._key, self._equal = equal.tobytes(), np.flatnonzero(equal)
            self._solve = _solver(self.P, self.A[self._equal])
        pull = -q
        if self._equal.size:
            pull += self.A[self._equal].T @ l[self._equal]
        self._centre = v0 = self._solve(pull)
        offset = self.A @ v0
        if warm is not None:
            # From its own last point a backend goes on at the same distance from the centre.
            shown, last = self._last
            warm = last if last is not None and warm[1] is shown else self._inner(warm)
        return q + self.P @ v0, l - offset, u - offset, warm

    def _inner(self, warm: Warm) -> Warm:
        return warm[0] / self._unknowns - self._centre, warm[1] / self._multipliers

    def taken(self, result: QPResult) -> QPResult:
        """A result of the scaled problem in the original unknowns."""
        x, y = result.x, result.y
        if x is None:
            return result
        shown = None if y is None else self._multipliers * y
        self._last = shown, None if y is None else (x, y)
        return replace(result, x=self._unknowns * (x + self._centre), y=shown)


def scaled_tolerance(tolerance: float) -> float:
    """What residuals of the scaled problem have to keep, so that those of the given one keep `tolerance`.

    Gradients stretch on the way back, by the root of what weights differ by. Well conditioned as scaled problems mostly
    are, a hundredth takes few iterations.
    """
    return max(0.01 * tolerance, min(tolerance, 1e-12))


def uneven(P: Any, share: float, by_diagonal: bool = False) -> bool:
    """Whether weights differ by more than 1 / `share`.

    That is so where a diagonal entry of P is less than that share of the largest, or elimination leaves less than that
    share of it (dense, positive definite P). Otherwise, or `by_diagonal` (for methods that end at a vertex of their
    active set), the positive diagonal entries alone tell, and not before they differ by 1 / `MISLEADING`: where
    equalities hold an unknown, P need not.
    """
    diagonal = P.diagonal()
    if not diagonal.size:
        return False
    largest, smallest = np.maximum.reduce(diagonal), np.minimum.reduce(diagonal)
    if by_diagonal and smallest >= share * largest:
        return False
    if not by_diagonal and isinstance(P, np.ndarray) and smallest > _NOTHING * largest:
        factor, info = dpotrf(P, lower=1)
        if info == 0:
            left = factor.diagonal() ** 2
            return bool(smallest < share * largest or (left < share * diagonal).any())
    curved = diagonal[_curved(diagonal)]
    return bool(curved.size and curved.min() < min(share, MISLEADING) * largest)


def hidden_error(
    P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, x: np.ndarray, y: np.ndarray, tolerance: float
) -> float:
    """What the cost may still fall by at a point x with multipliers y, where weights are `uneven`; else zero.

    Half the Newton decrement of the gradient of the Lagrangian, active rows held, and the products of multipliers and
    distances to their bounds; a distance within tolerance is none.
    """
    if not uneven(P, MISLEADING):
        return 0.0
    P, A = (m if isinstance(m, np.ndarray) else m.tocsc() for m in (P, A))
    scaling = Scaling(P, A, l == u)
    s, c = scaling._unknowns, scaling._cost
    y = np.where(((y > 0) & (u == np.inf)) | ((y < 0) & (l == -np.inf)), 0.0, y)
    active = y.nonzero()[0]
    rows = (A @ x)[active]
    distance = np.where(y[active] > 0, u[active] - rows, rows - l[active]) - tolerance * np.maximum(1.0, np.abs(rows))
    gradient = s * (P @ x + q + A.T @ y) / c
    held = np.union1d(np.flatnonzero(l == u), active[distance <= 0])
    decrement = float(gradient @ _solver(scaling.P, scaling.A[held])(gradient))
    return 0.5 * c * decrement + float(np.abs(y[active]) @ np.maximum(distance, 0.0))


def _solver(P: Any, held: Any) -> Any:
    """Solves with ``P + E'E`` for rows E that hold with equality, made definite where it is not."""
    H = P + held.T @ held if held.shape[0] else P
    size = P.shape[0]
    if isinstance(H, np.ndarray):
        for shift in _SINGULAR:
            factor, info = dpotrf(H + shift * np.eye(size), lower=1)
            if info == 0:
                return lambda vector: dpotrs(factor, vector, lower=1)[0]
        return lambda vector: np.zeros(size)
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    shifted = sp.csc_matrix(H + _SINGULAR[1] * sp.eye_array(size))
    return splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve


def _power_of_two(values: Any) -> Any:
    return np.exp2(np.rint(np.log2(values)))


def _times(left: np.ndarray | None, matrix: Any, right: np.ndarray | None) -> Any:
    """Rows times `left`, columns times `right`; a sparse matrix keeps its pattern."""
    if isinstance(matrix, np.ndarray):
        matrix = matrix if left is None else left[:, None] * matrix
        return matrix if right is None else matrix * right
    out = matrix.copy()
    if left is not None:
        out.data *= left[out.indices]
    if right is not None:
        out.data *= np.repeat(right, np.diff(out.indptr))
    return out


def _curved(diagonal: np.ndarray) -> np.ndarray:
    """Where a diagonal has more than rounding."""
    return diagonal > _NOTHING * np.maximum.reduce(diagonal)


def _joined(A: Any, equal: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Scales no larger than equalities leave them: in a row an unknown varies no more than the others do.

    States that no cost sees, or hardly, have theirs from the process equations. Where a scale is not known yet
    (infinite), it alone is found: beside it others are not held.
    """
    import scipy.sparse as sp

    rows = abs(sp.coo_array(A))
    kept = equal[rows.row] & (rows.data > 0)
    row, column, size = rows.row[kept], rows.col[kept], rows.data[kept]
    varies = np.where(np.isfinite(scales[column]), size * scales[column], 0.0)
    order = np.lexsort((varies, row))
    last = np.flatnonzero(np.diff(row[order], append=-1))
    largest, second = np.zeros(equal.size), np.zeros(equal.size)
    largest[row[order][last]] = varies[order][last]
    before = last[(last > 0) & (row[order][last - 1] == row[order][last])]
    second[row[order][before]] = varies[order][before - 1]
    others = np.where(varies == largest[row], second[row], largest[row])
    unknown = np.isinf(scales)
    held = (others > 0) & (unknown[column] | ~unknown.any())
    scales = scales.copy()
    np.minimum.at(scales, column[held], (others / size)[held])
    return scales


def _squared_rows(matrix: Any) -> np.ndarray:
    if isinstance(matrix, np.ndarray):
        return np.einsum("ij,ij->i", matrix, matrix)
    return np.bincount(matrix.indices, matrix.data**2, matrix.shape[0])
