"""The uncondensed rows of a quadratic program for one set of weights and one pattern of active instances.

Everything in a check of a solution that depends on neither the point nor the vector data is stacked here once, so that
a check costs a few matrix-vector products.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from problems.forms.affine import Bounds, Matrix, Rows, block_diagonal, information_of
from problems.forms.layout import INFINITE, DataStore, constant_rows
from problems.forms.quadratic import QuadraticProgram
from problems.problem import DataSlot
from problems.solvers.active import active_rows
from problems.solvers.linear import covariance_blocks
from problems.solvers.qp_maps import DenseMap


class StackedRows:
    """Gradient of the costs, equalities and inequalities as affine rows ``M z + D d + m``, one below the other.

    Args:
        store: the numbers of a solve, missing ones read as zero; its weights and matrices are taken.
        flags: active instances of each term by name, None where all are.

    Attributes:
        equalities, inequalities: name, place among the rows of its kind, and shape of each term.
    """

    def __init__(self, program: QuadraticProgram, store: DataStore, flags: dict[str, np.ndarray | None]) -> None:
        self._layout, self._dense = program.layout, program.dense
        size, data = program.layout.size, program.layout.data_size
        rows = program.rows.evaluate(store.numbers)
        costs, equal, bounded = (
            [r for r in rows if r.layout.term.kind == k] for k in ("cost", "equality", "inequality")
        )
        weighted = [_weighted(r, information_of(r, store, flags.get(r.layout.term.name))) for r in costs]
        self._costs, self._weighted = (
            _stacked(costs, size, data, self._dense),
            _stacked(weighted, size, data, self._dense),
        )
        self._linear = _linear(costs, flags, data)
        slope_d, slope = self._weighted[1] + self._linear[0], self._weighted[2] + self._linear[1]
        R = self._costs[0].T
        self._hessian = R @ self._weighted[0]
        others = _stacked([*equal, *bounded], size, data, self._dense)
        join: Any = np.vstack if self._dense else partial(sp.vstack, format="csr")
        self._M = join([self._hessian, others[0]])
        self._D = join([R @ slope_d, others[1]])
        self._m = np.concatenate([R @ slope, others[2]])
        self.equalities, self.inequalities = _named(equal), _named(bounded)
        middle = size + (self.equalities[-1][1].stop if equal else 0)
        self._gradient, self._equal, self._bounded = slice(0, size), slice(size, middle), slice(middle, None)
        self._equal_rows, self._bounded_rows = self._M[self._equal], self._M[self._bounded]
        self._off = np.concatenate([np.zeros(0, bool), *(_off(r, flags.get(r.layout.term.name)) for r in bounded)])
        self._limits = (Bounds.of(program.layout, bounded, "lower"), Bounds.of(program.layout, bounded, "upper"))
        self._fixed = None if any((b.index >= 0).any() for b in self._limits) else self._bounds(store.numbers)
        self._certificate: tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]] | None = None
        self._covariances: dict[bytes, np.ndarray] = {}

    def values(self, z: np.ndarray, d: np.ndarray) -> np.ndarray:
        """All rows at the point z (n,) for the data d."""
        out = self._M.dot(z)
        out += self._D.dot(d)
        out += self._m
        return out

    def objective(self, z: np.ndarray, d: np.ndarray) -> float:
        r, s = (R @ z + E @ d + c for R, E, c in (self._costs, self._weighted))
        return float(r @ (0.5 * s + (self._linear[0] @ d + self._linear[1])))

    def gradient(self, values: np.ndarray, mu: np.ndarray | None) -> np.ndarray:
        """Of costs and inequalities with multipliers `mu` (None: none is active)."""
        g = values[self._gradient]
        return g if mu is None else g + self._bounded_rows.T.dot(mu)

    @cached_property
    def _inverse(self) -> np.ndarray:
        return np.linalg.pinv(self._equal_rows.T, rcond=1e-12)

    @cached_property
    def _solve_normal(self) -> Any:
        return spla.factorized(sp.csc_matrix(self._equal_rows @ self._equal_rows.T))

    def equality_multipliers(self, gradient: np.ndarray) -> np.ndarray:
        """Least-squares multipliers: what remains of the stationarity condition is its residual."""
        if not self.equalities:
            return np.zeros(0)
        if self._dense:
            return -(self._inverse @ gradient)
        return self._solve_normal(-(self._equal_rows @ gradient))

    def residuals(
        self, values: np.ndarray, d: np.ndarray, mu: np.ndarray | None, gradient: np.ndarray, lam: np.ndarray
    ) -> tuple[float, float, float]:
        """``primal``, ``dual`` and the absolute gap."""
        primal, gap, dual = 0.0, 0.0, gradient
        if self.equalities:
            dual = gradient + self._equal_rows.T @ lam
            primal = float(np.abs(values[self._equal]).max())
        if self.inequalities:
            r = values[self._bounded]
            lower, upper = self.bounds(d)
            primal = max(primal, float(np.maximum.reduce(np.maximum(r - upper, lower - r))))
            if mu is not None:
                held = mu.nonzero()[0]
                force = mu[held]
                missed = np.where(force > 0, upper[held], lower[held]) - r[held]
                # a multiplier on a side without a bound is no certificate: let the gap show it
                missed[np.isinf(missed)] = 1.0
                gap = float(np.abs(force).dot(np.abs(missed)))
        return primal, float(np.maximum.reduce(np.abs(dual))), gap

    def certified(self, map_: DenseMap, d: np.ndarray, violation: float) -> dict[str, float]:
        """Bounds of the residuals of an answer of the affine map, whose largest violation of a bound is given.

        Residuals of that answer are affine in the data themselves, zero but for rounding; how far from it is worked
        out once for each map, the rounding of the product that gave the answer included.
        """
        if self._certificate is None:
            self._certificate = self._certify(map_)
        size = np.abs(d)
        (dual, dual_constant), (primal, primal_constant) = self._certificate
        equal = float(primal.dot(size)) + primal_constant if self.equalities else 0.0
        return {"primal": max(equal, violation, 0.0), "dual": float(dual.dot(size)) + dual_constant, "gap": 0.0}

    def _certify(self, map_: DenseMap) -> tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]:
        n = map_.size
        V = np.column_stack([map_.T[:n], map_.t[:n]])
        given = np.column_stack([self._D, self._m])
        values, sizes = self._M @ V + given, np.abs(self._M) @ np.abs(V) + np.abs(given)
        dual = values[self._gradient]
        if self.equalities:
            dual = dual - self._equal_rows.T @ (self._inverse @ dual)
        rounding = 2 * V.shape[1] * np.finfo(float).eps
        parts = ((dual, sizes[self._gradient]), (values[self._equal], sizes[self._equal]))
        largest = [(np.abs(exact) + rounding * size).max(axis=0, initial=0.0) for exact, size in parts]
        first, second = ((np.ascontiguousarray(part[:-1]), float(part[-1])) for part in largest)
        return first, second

    def bounds(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of all inequality rows, infinite where an instance is off."""
        return self._bounds(d) if self._fixed is None else self._fixed

    def _bounds(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = (bound(d) for bound in self._limits)
        lower = np.where(self._off | (lower <= -INFINITE), -np.inf, lower)
        return lower, np.where(self._off | (upper >= INFINITE), np.inf, upper)

    def active(self, values: np.ndarray, d: np.ndarray, mu: np.ndarray | None) -> np.ndarray:
        """1 at the upper bound, -1 at the lower, 0 between."""
        return active_rows(values[self._bounded], *self.bounds(d), mu)

    def covariance(self, columns: np.ndarray) -> np.ndarray:
        """Rows and columns `columns` of the covariance; it depends on no vector data, so it is kept."""
        key = columns.tobytes()
        found = self._covariances.get(key)
        if found is None:
            hessian, equal = sp.csr_array(self._hessian), sp.csr_array(self._equal_rows)
            found = self._covariances[key] = covariance_blocks(self._layout, hessian, equal, columns)
        return found.copy()


def _linear(costs: list[Rows], flags: dict[str, np.ndarray | None], data: int) -> tuple[Matrix, np.ndarray]:
    """Linear parts of all cost rows as an affine function of the data."""
    constants, at, index, start = [np.zeros(0)], [np.zeros(0, np.intp)], [np.zeros(0, np.intp)], 0
    for r in costs:
        term, size = r.layout.term, r.count * r.dim
        constant = np.zeros(size)
        if term.linear is not None:
            on = ~_off(r, flags.get(term.name))
            if isinstance(term.linear, DataSlot):
                assert r.layout.linear is not None
                at.append(start + np.flatnonzero(on))
                index.append(np.broadcast_to(r.layout.linear, (r.count, r.dim)).ravel()[on])
            else:
                constant = constant_rows(term.linear, r.dim, r.count, term.what).ravel() * on
        constants.append(constant)
        start += size
    rows, columns = np.concatenate(at), np.concatenate(index)
    taken = sp.csr_array((np.ones(rows.size), (rows, columns)), shape=(start, data))
    return taken, np.concatenate(constants)


def _weighted(rows: Rows, W: np.ndarray) -> Rows:
    W = np.broadcast_to(W, (rows.count, rows.dim, rows.dim))
    c = (W @ rows.c.reshape(rows.count, rows.dim, 1)).ravel()
    if isinstance(rows.R, np.ndarray):
        R, E = ((W @ m.reshape(rows.count, rows.dim, -1)).reshape(m.shape) for m in (rows.R, rows.E))
    else:
        blocks = block_diagonal(W, rows.count)
        R, E = blocks @ rows.R, blocks @ rows.E
    return Rows(rows.layout, rows.dim, R, E, c)


def _stacked(parts: list[Rows], size: int, data: int, dense: bool) -> tuple[Matrix, Matrix, np.ndarray]:
    """R, E and c of all terms, one below the other."""
    c = np.concatenate([np.zeros(0), *(r.c for r in parts)])
    if dense:
        R, E = (np.vstack([np.zeros((0, w)), *(m for m in ms)]) for w, ms in _columns(parts, size, data))
    else:
        R, E = (sp.vstack([sp.csr_array((0, w)), *ms], format="csr") for w, ms in _columns(parts, size, data))
    return R, E, c


def _columns(parts: list[Rows], size: int, data: int) -> tuple[tuple[int, list[Matrix]], tuple[int, list[Matrix]]]:
    return (size, [r.R for r in parts]), (data, [r.E for r in parts])


def _off(rows: Rows, on: np.ndarray | None) -> np.ndarray:
    return np.zeros(rows.count * rows.dim, bool) if on is None else np.repeat(~on, rows.dim)


def _named(rows: list[Rows]) -> list[tuple[str, slice, tuple[int, int]]]:
    """Name, place among the stacked rows of its kind, and shape of each term."""
    out, start = [], 0
    for r in rows:
        stop = start + r.count * r.dim
        out.append((r.layout.term.name, slice(start, stop), (r.count, r.dim)))
        start = stop
    return out
