"""The uncondensed rows of a quadratic program for one set of weights and one pattern of active instances.

Everything in a check of a solution that depends on neither the point nor the vector data is stacked here once, so that
a check costs a few matrix-vector products.
"""

from __future__ import annotations

from functools import cached_property
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


class StackedRows:
    """Rows ``R z + E d + c`` of costs, the same weighted, of equalities and of inequalities, one below the other.

    Args:
        store: the numbers of a solve, missing ones read as zero; its weights and matrices are taken.
        flags: active instances of each term by name, None where all are.
    """

    def __init__(self, program: QuadraticProgram, store: DataStore, flags: dict[str, np.ndarray | None]) -> None:
        self._layout, self._dense = program.layout, program.dense
        size, data = program.layout.size, program.layout.data_size
        rows = program.rows.evaluate(store.numbers)
        costs, equal, bounded = (
            [r for r in rows if r.layout.term.kind == k] for k in ("cost", "equality", "inequality")
        )
        weighted = [_weighted(r, information_of(r, store, flags.get(r.layout.term.name))) for r in costs]
        parts = [*costs, *weighted, *equal, *bounded]
        self._R = _stacked([r.R for r in parts], size, program.dense)
        self._E = _stacked([r.E for r in parts], data, program.dense)
        self._c = np.concatenate([np.zeros(0), *(r.c for r in parts)])
        ends = np.cumsum([0, *(sum(r.count * r.dim for r in part) for part in (costs, costs, equal, bounded))])
        self._costs, self._weighted, self._equal, self._bounded = (
            slice(a, b) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
        )
        self._linear(costs, flags)
        self.equalities, self.inequalities = _named(equal), _named(bounded)
        off = [_off(r, flags.get(r.layout.term.name)) for r in bounded]
        self._off = np.concatenate([np.zeros(0, bool), *off])
        self._limits = (Bounds.of(program.layout, bounded, "lower"), Bounds.of(program.layout, bounded, "upper"))
        self._fixed = None if any((b.index >= 0).any() for b in self._limits) else self._bounds(store.numbers)
        self._gradient_rows = self._R[self._costs].T
        self._equal_rows, self._bounded_rows = self._R[self._equal], self._R[self._bounded]
        self._covariances: dict[bytes, np.ndarray] = {}

    def _linear(self, costs: list[Rows], flags: dict[str, np.ndarray | None]) -> None:
        """Linear parts of all cost rows: constants, and where which data go."""
        constants, at, index = [np.zeros(0)], [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
        start, self._has_linear = 0, False
        for r in costs:
            term, size = r.layout.term, r.count * r.dim
            constant = np.zeros(size)
            if term.linear is not None:
                self._has_linear = True
                on = ~_off(r, flags.get(term.name))
                if isinstance(term.linear, DataSlot):
                    assert r.layout.linear is not None
                    at.append(start + np.flatnonzero(on))
                    index.append(np.broadcast_to(r.layout.linear, (r.count, r.dim)).ravel()[on])
                else:
                    constant = constant_rows(term.linear, r.dim, r.count, term.what).ravel() * on
            constants.append(constant)
            start += size
        self._linear_constant = np.concatenate(constants)
        self._linear_at, self._linear_index = np.concatenate(at), np.concatenate(index)

    def values(self, z: np.ndarray, d: np.ndarray) -> np.ndarray:
        """All rows at the point z (n,) for the vector data d."""
        return self._R @ z + self._E @ d + self._c

    def _slope(self, values: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, float]:
        """Derivative of the cost with respect to its rows, and the cost."""
        r, s = values[self._costs], values[self._weighted]
        if not self._has_linear:
            return s, 0.5 * float(r @ s)
        linear = self._linear_constant.copy()
        linear[self._linear_at] = d[self._linear_index]
        return s + linear, 0.5 * float(r @ s) + float(linear @ r)

    def objective(self, values: np.ndarray, d: np.ndarray) -> float:
        return self._slope(values, d)[1]

    def gradient(self, values: np.ndarray, d: np.ndarray, mu: np.ndarray | None) -> np.ndarray:
        """Of costs and inequalities with multipliers `mu` (None: none is active)."""
        g = self._gradient_rows @ self._slope(values, d)[0]
        return g if mu is None else g + self._bounded_rows.T @ mu

    @cached_property
    def _inverse(self) -> np.ndarray:
        return np.linalg.pinv(self._equal_rows.T, rcond=1e-12)

    @cached_property
    def _solve_normal(self) -> Any:
        normal = self._equal_rows @ self._equal_rows.T
        # rows that repeat or are empty share their multiplier instead of making the system singular
        ridge = 1e-14 * max(float(normal.diagonal().max(initial=0.0)), 1e-300)
        return spla.factorized(sp.csc_matrix(normal + ridge * sp.eye_array(normal.shape[0])))

    def equality_multipliers(self, gradient: np.ndarray) -> np.ndarray:
        """Least-squares multipliers: what remains of the stationarity condition is its residual."""
        if not self._equal_rows.shape[0]:
            return np.zeros(0)
        if self._dense:
            return -(self._inverse @ gradient)
        return self._solve_normal(-(self._equal_rows @ gradient))

    def residuals(
        self, values: np.ndarray, d: np.ndarray, mu: np.ndarray | None, gradient: np.ndarray, lam: np.ndarray
    ) -> dict[str, float]:
        """``primal``, ``dual`` and ``gap``."""
        dual = gradient + self._equal_rows.T @ lam if lam.size else gradient
        primal = float(np.abs(values[self._equal]).max()) if lam.size else 0.0
        gap = 0.0
        r = values[self._bounded]
        if r.size:
            lower, upper = self.bounds(d)
            primal = max(primal, float((r - upper).max()), float((lower - r).max()))
            if mu is not None:
                bound = np.where(mu > 0, upper, np.where(mu < 0, lower, r))
                # a multiplier on a side without a bound is no certificate: let the gap show it
                missed = np.abs(mu * np.where(np.isfinite(bound), bound - r, np.sign(mu))).sum()
                gap = float(missed) / max(1.0, abs(self.objective(values, d)))
        return {"primal": primal, "dual": float(np.abs(dual).max()) if dual.size else 0.0, "gap": gap}

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
            P = self._R[self._costs].T @ self._R[self._weighted]
            found = covariance_blocks(self._layout, sp.csr_array(P), sp.csr_array(self._equal_rows), columns)
            self._covariances[key] = found
        return found.copy()


def _weighted(rows: Rows, W: np.ndarray) -> Rows:
    W = np.broadcast_to(W, (rows.count, rows.dim, rows.dim))
    c = (W @ rows.c.reshape(rows.count, rows.dim, 1)).ravel()
    if isinstance(rows.R, np.ndarray):
        R, E = ((W @ m.reshape(rows.count, rows.dim, -1)).reshape(m.shape) for m in (rows.R, rows.E))
    else:
        blocks = block_diagonal(W, rows.count)
        R, E = blocks @ rows.R, blocks @ rows.E
    return Rows(rows.layout, rows.dim, R, E, c)


def _stacked(parts: list[Matrix], width: int, dense: bool) -> Matrix:
    if dense:
        return np.ascontiguousarray(np.vstack([np.zeros((0, width)), *parts]))
    return sp.vstack([sp.csr_array((0, width)), *parts], format="csr")


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
