"""The answer of a quadratic program while no inequality is active: one affine map of the vector data.

``[z; rows - upper; lower - rows] = T d + t`` gives all unknowns and all row violations by one product. `DenseMap` holds
T; `SparseMap` (large problems) keeps the factorized KKT system instead. Where weights differ so much that the Hessian
has lost digits of the small ones, the answer is refined: steps by the gradient that the rows of the costs give at it,
as iterations of Gauss-Newton would.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs  # type: ignore[attr-defined]

from problems.errors import UnobservableError
from problems.forms.affine import Bounds
from problems.forms.layout import DataStore
from problems.forms.quadratic import QuadraticProgram, Reduced
from problems.solvers.linear import FREE, factorized_kkt

if TYPE_CHECKING:
    from problems.solvers.qp_rows import StackedRows

WEAK = 1e-6  # the same share, or an eigenvalue of the scaled Hessian, below which answers are refined
REFINEMENTS = 2
FEW = 20_000  # numbers of a table that are multiplied within a few microseconds
INDEPENDENT = 1e-13  # share of a Hessian diagonal left after elimination, below which a direction may be free

Vectors = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class DenseMap:
    """See the module; also P, Q, q0 of the quadratic program in the coordinates of `reduced`.

    Attributes:
        free: a direction in all unknowns that no cost sees, or None.
        rows: the uncondensed rows with these weights, once a solution was checked.
        definite: there is an affine answer. Where only linear costs and inequalities hold an unknown (exact penalties),
            neither is it free nor is there one.
        exact: answers are T d + t, without refinement.
    """

    def __init__(
        self, program: QuadraticProgram, reduced: Reduced, store: DataStore, flags: dict[str, Any], pattern: bytes
    ) -> None:
        self.reduced, self.flags = reduced, flags
        self.rows: StackedRows | None = None
        self.size = program.layout.size
        self.P, self.Q, self.q0 = reduced.weighted(store, flags, pattern)
        self._given = reduced.given(flags, pattern)
        inner = reduced.inner
        if inner is None:
            H, G, g = self.P, self.Q, self.q0
        else:
            NP = inner.Z.T @ self.P
            H, G, g = NP @ inner.Z, inner.Z.T @ self.Q + NP @ inner.Y, inner.Z.T @ self.q0 + NP @ inner.z0
        self._linear = G, g
        self._factor, flat, share = _factored(H)
        self.free, self.definite = None, flat is None
        self.exact = flat is not None or share >= WEAK
        self._gradient = None if self.exact else reduced.gradient(store, flags)
        if flat is not None:
            unseen = flat[:, :1] if not reduced.bounded else _unseen(flat, np.column_stack([G, g]))
            if unseen.size:
                direction = unseen[:, 0]
                self.free = reduced.map.Z @ (direction if inner is None else inner.Z @ direction)

    @cached_property
    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """T and t."""
        return self._tables[0], self._tables[1]

    @property
    def linear(self) -> bool:
        """Whether answers are T d + t."""
        return self.definite and self.exact

    @property
    def excesses(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows of T and t that are excesses over bounds."""
        T, t = self.table
        return T[self.size :], t[self.size :]

    def affine(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T and t of ``wanted z`` (rows, n)."""
        T, t = self.table
        return wanted @ T[: self.size], wanted @ t[: self.size]

    @cached_property
    def _sides(self) -> list[tuple[float, Bounds, np.ndarray]]:
        """Sign, bounds and inequality rows of both sides' excesses, in their order."""
        if not self.reduced.bounded:
            return []
        off = self.reduced.off_rows(self.flags)
        sides = ((1.0, self.reduced.upper), (-1.0, self.reduced.lower))
        return [(sign, bound, bound.used if off is None else bound.used & ~off) for sign, bound in sides]

    @cached_property
    def _spread(self) -> np.ndarray:
        """(n + excesses, k) how answer and excesses move with the unknowns that equalities leave."""
        reduced = self.reduced
        N = np.eye(reduced.size) if reduced.inner is None else reduced.inner.Z
        held = reduced.A[reduced.equalities :] @ N
        return np.vstack([reduced.map.Z @ N, *(sign * held[used] for sign, _, used in self._sides)])

    @cached_property
    def lift(self) -> np.ndarray:
        """(n + excesses, k) the same with whitened steps: s costs ``1/2 |s|^2``."""
        if self._factor is None:  # nothing is left to choose
            return self._spread
        return np.ascontiguousarray(dtrtrs(self._factor, self._spread.T, lower=1)[0].T)

    @cached_property
    def signs(self) -> np.ndarray:
        """(rows, excesses): multipliers of the inequality rows, positive at upper bounds, by those of the excesses."""
        used = [np.flatnonzero(rows) for _, _, rows in self._sides]
        signs = [np.full(rows.size, sign) for (sign, _, _), rows in zip(self._sides, used, strict=True)]
        rows = np.concatenate([np.zeros(0, np.intp), *used])
        out = np.zeros((len(self.reduced.A) - self.reduced.equalities, rows.size))
        out[rows, np.arange(rows.size)] = np.concatenate([np.zeros(0), *signs])
        return out

    @cached_property
    def pull(self) -> np.ndarray:
        """(n, excesses) how multipliers of the excesses move the answer."""
        return -self.lift[: self.size] @ self.lift[self.size :].T

    @cached_property
    def _tables(self) -> tuple[np.ndarray, np.ndarray, _Refinement | None]:
        reduced, factor = self.reduced, self._factor
        inner, outer = reduced.inner, reduced.map
        right = np.column_stack(self._linear)
        K = right if factor is None else dpotrs(factor, right, lower=1)[0]
        V, v = -K[:, :-1], -K[:, -1]
        if inner is not None:
            V, v = inner.Z @ V + inner.Y, inner.Z @ v + inner.z0
        blocks, constants = [outer.Z @ V + outer.Y], [outer.Z @ v + outer.z0]
        m = reduced.equalities
        if reduced.bounded:
            G, g = reduced.A[m:] @ V + reduced.E[m:], reduced.A[m:] @ v + reduced.c[m:]
            for sign, bound, used in self._sides:
                rows, constant = sign * G[used], sign * (g[used] - bound.constant[used])
                index = bound.index[used]
                by_data = np.flatnonzero(index >= 0)
                rows[by_data, index[by_data]] -= sign
                blocks.append(rows)
                constants.append(constant)
        refine = None
        if self._gradient is not None and factor is not None:
            N = np.eye(len(factor)) if inner is None else inner.Z
            refine = _Refinement(self._gradient, V, v, N, factor, self._spread)
        return np.ascontiguousarray(np.vstack(blocks)), np.concatenate(constants), refine

    def outputs(self, numbers: np.ndarray) -> np.ndarray:
        """All unknowns (n,), then the excesses over all bounds (<= 0 where they hold)."""
        T, t, refine = self._tables
        out = T.dot(numbers)  # half the overhead of the operator
        out += t
        if refine is not None:
            out += refine(numbers)
        return out

    def __call__(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, apart."""
        out = self.outputs(numbers)
        return out[: self.size], out[self.size :]

    def once(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same without T, which costs as much as a dozen answers: for weights that may not come again."""
        reduced, factor = self.reduced, self._factor
        if factor is None or not self.exact or reduced.equalities:
            return self(numbers)
        q = self.Q.dot(numbers)
        q += self.q0
        v = -dpotrs(factor, q, lower=1)[0]
        l, u, z = self._given(numbers)
        z += reduced.map.Z.dot(v)
        if not l.size:
            return z, l
        rows = reduced.A.dot(v)
        return z, np.maximum(rows - u, l - rows)

    def many(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for many rows of numbers (count, data): (count, n) and (count, bounds)."""
        T, t, refine = self._tables
        out = numbers @ T.T
        out += t
        if refine is not None:
            out += refine(numbers.T).T
        return out[:, : self.size], out[:, self.size :]

    @cached_property
    def _stacked(self) -> tuple[np.ndarray, np.ndarray]:
        given = self._given
        return np.ascontiguousarray(np.vstack([self.Q, given.D])), np.concatenate([self.q0, given.d])

    def vectors(self, numbers: np.ndarray) -> Vectors:
        """q, l, u of the program, and the offset in ``z = Z v + offset``."""
        D, d = self._stacked
        out = D.dot(numbers)
        out += d
        size = self.q0.size
        return out[:size], *self._given.split(out[size:], numbers)


class _Refinement:
    """What steps by the gradient of the rows add to an answer, a matrix of columns included."""

    def __init__(
        self,
        gradient: Callable[[np.ndarray, np.ndarray], np.ndarray],
        V: np.ndarray,
        v: np.ndarray,
        N: np.ndarray,
        factor: np.ndarray,
        lift: np.ndarray,
    ) -> None:
        self._gradient, self._V, self._v, self._N, self._factor, self._lift = gradient, V, v, N, factor, lift

    def __call__(self, numbers: np.ndarray) -> np.ndarray:
        v = self._V @ numbers + (self._v if numbers.ndim == 1 else self._v[:, None])
        total: Any = 0.0
        for _ in range(REFINEMENTS):
            step = -dpotrs(self._factor, self._N.T @ self._gradient(v, numbers), lower=1)[0]
            v, total = v + self._N @ step, total + step
        return self._lift @ total


def _factored(H: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None, float]:
    """Lower factor of H, None where it has no size or is not positive definite (scale-free test).

    Then its directions (n, k) without curvature, None where there are none; and the smallest share of a diagonal entry
    that elimination leaves, 0 where H is not definite.
    """
    if not H.size:
        return None, None, 1.0
    factor, info = dpotrf(H, lower=1)
    share = float((np.diagonal(factor) ** 2 / np.diagonal(H)).min()) if info == 0 else 0.0
    if share > INDEPENDENT:
        return factor, None, share
    diagonal = np.diagonal(H)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    flat = values <= FREE
    if not flat.any():
        return factor, None, share
    return None, vectors[:, flat] / scale[:, None], share


def _unseen(flat: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Directions among the columns of `flat` on which no column of the linear cost acts."""
    seen = flat.T @ linear
    sizes = np.linalg.norm(flat, axis=0)[:, None] * np.linalg.norm(linear, axis=0).max(initial=0.0)
    U, values, _ = np.linalg.svd(seen / np.maximum(sizes, 1e-300))
    rank = int((values > 1e-9).sum())
    return flat @ U[:, rank:]


class SparseMap:
    """The same through a sparse factorization of the KKT system, for large problems."""

    exact = False  # nothing is T d + t, as there is no T

    def __init__(
        self, program: QuadraticProgram, reduced: Reduced, store: DataStore, flags: dict[str, Any], pattern: bytes
    ) -> None:
        self.reduced, self.flags = reduced, flags
        self.rows: StackedRows | None = None
        self.P, self.Q, self.q0 = reduced.weighted(store, flags, pattern)
        self._lifts = bool(program.eliminated)
        m = reduced.equalities
        self._right = sp.vstack([self.Q, reduced.E[:m]], format="csr"), np.concatenate([self.q0, reduced.c[:m]])
        self._limits = None if reduced.bounds_vary else reduced.limits(np.zeros(program.layout.data_size), flags)
        solver, flat, smallest = factorized_kkt(self.P, reduced.A[: reduced.equalities])
        self.free, self.definite = None, flat is None
        self._solve: Any = solver
        self._gradient = reduced.gradient(store, flags) if solver is not None and smallest < WEAK else None
        if flat is not None:
            linear = np.append(abs(self.Q.T @ flat), abs(self.q0 @ flat)).max()
            size = np.linalg.norm(flat) * max(spla.norm(self.Q), float(np.linalg.norm(self.q0)))
            if not reduced.bounded or linear <= 1e-9 * size:
                self.free = reduced.map.Z @ flat

    def __call__(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reduced = self.reduced
        v = self._unbounded(numbers)
        z = reduced.map.at(v, numbers) if self._lifts else v
        if not reduced.bounded:
            return z, v[:0]
        l, u = reduced.limits(numbers, self.flags) if self._limits is None else self._limits
        R, E, c = self._bounded
        rows = R @ z
        rows += c
        if E.nnz:
            rows += E @ numbers
        return z, np.concatenate([rows - u, l - rows])

    @cached_property
    def _bounded(self) -> tuple[Any, Any, np.ndarray]:
        """The inequality rows in all unknowns, few numbers each however much was eliminated."""
        rows = self.reduced.bounded
        R, E = (sp.vstack([getattr(r, part) for r in rows], format="csr") for part in ("R", "E"))
        return R, E, np.concatenate([r.c for r in rows])

    def _unbounded(self, numbers: np.ndarray) -> np.ndarray:
        """The coordinates v of the answer."""
        reduced, (D, d) = self.reduced, self._right
        table = self._table
        if table is not None:
            return table[0].dot(numbers) + table[1]
        size = reduced.size
        right = D @ numbers
        right += d
        found = self._solve(-right)
        if self._gradient is not None:
            E = reduced.A[: reduced.equalities]
            for _ in range(REFINEMENTS):
                v, y = found[:size], found[size:]
                missed = E @ v + right[size:]
                found = found - self._solve(np.concatenate([self._gradient(v, numbers) + E.T @ y, missed]))
        return found[:size]

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray] | None:
        """``v = V d + v0`` where few unknowns are left, so that V multiplies less than a solve."""
        D, d = self._right
        size = self.reduced.size
        if self._gradient is not None or size * self.Q.shape[1] > FEW:
            return None
        found = self._solve(-np.column_stack([D.toarray(), d]))[:size]
        return np.ascontiguousarray(found[:, :-1]), found[:, -1]

    once = __call__

    @property
    def linear(self) -> bool:
        """Whether answers are affine in the numbers."""
        return self.definite and self._gradient is None

    @property
    def excesses(self) -> tuple[np.ndarray, np.ndarray]:
        """T and t of the excesses over bounds: none, as they would be large matrices."""
        assert not self.reduced.bounded
        return np.zeros((0, self.Q.shape[1])), np.zeros(0)

    def affine(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T and t of ``wanted z`` (rows, n), by one solve with a column for each of the rows."""
        reduced, m = self.reduced, self.reduced.equalities
        by_v = reduced.map.Z.T @ wanted.T
        by_row = -self._solve(np.vstack([by_v, np.zeros((m, len(wanted)))]))
        on_q, on_shift = by_row[: reduced.size].T, by_row[reduced.size :].T
        T = on_q @ self.Q + on_shift @ reduced.E[:m] + wanted @ reduced.map.Y
        return T, on_q @ self.q0 + on_shift @ reduced.c[:m] + wanted @ reduced.map.z0

    def many(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for many rows of numbers."""
        answers = [self(row) for row in numbers]
        return np.array([z for z, _ in answers]), np.array([excess for _, excess in answers])

    def vectors(self, numbers: np.ndarray) -> Vectors:
        """q, l, u of the program, and the offset in ``z = Z v + offset``."""
        reduced = self.reduced
        l, u = reduced.bounds(numbers, self.flags)
        return self.Q @ numbers + self.q0, l, u, reduced.map.Y @ numbers + reduced.map.z0


def require_observable(program: QuadraticProgram, free: np.ndarray) -> None:
    """Raises UnobservableError naming the unknowns that the costs leave free."""
    names = program.layout.names_of(free) or "all unknowns"
    raise UnobservableError(
        f"the costs of problem {program.problem.name!r} do not determine {names}; add a prior or a measurement that "
        "sees them"
    )
