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
from problems.solvers.qp_maps import DenseMap

_ONE, _NONE = np.ones(1), np.zeros(0)
_MISSED = 1.0  # distance to a bound that is not there: a multiplier on it is no certificate, and the gap shows it


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
        self.equalities, self.inequalities = _named(equal), _named(bounded)
        (E, F, e), (G, H, g) = (_stacked(part, size, data, self._dense) for part in (equal, bounded))
        self._equal, self._bounded = E, (G, H, g)
        off = np.concatenate([np.zeros(0, bool), *(_off(r, flags.get(r.layout.term.name)) for r in bounded)])
        self._limits = [
            _limit(Bounds.of(program.layout, bounded, side), none, off, data)
            for side, none in (("lower", -np.inf), ("upper", np.inf))
        ]
        self._from_data = any(taken.nnz for taken, _ in self._limits)
        self._rows = _joined(
            [
                [self._hessian, G.T, R @ slope_d, (R @ slope)[:, None]],
                [E, None, F, e[:, None]],
                _excess(1.0, self._bounded, self._limits[1]),
                _excess(-1.0, self._bounded, self._limits[0]),
            ],
            [size, E.shape[0], g.size, g.size],
            [size, g.size, data, 1],
            self._dense,
        )
        first, second = size + e.size, size + e.size + g.size
        self._gradient, self._missed = slice(0, size), slice(size, first)
        self._excess, self._above, self._below = slice(first, None), slice(first, second), slice(second, None)
        self._free = np.zeros(g.size)
        self._certificate: tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]] | None = None
        self._covariances: dict[bytes, np.ndarray] = {}

    def values(self, z: np.ndarray, mu: np.ndarray | None, d: np.ndarray) -> np.ndarray:
        """All rows at the point z (n,) with multipliers `mu` (None: none is active) for the data d, by one product.

        They are the gradient of costs and inequalities, the equalities, and all excesses over bounds: over upper ones
        and then below lower ones.
        """
        return self._rows.dot(np.concatenate((z, self._free if mu is None else mu, d, _ONE)))

    def objective(self, z: np.ndarray, d: np.ndarray) -> float:
        r, s = (R @ z + E @ d + c for R, E, c in (self._costs, self._weighted))
        return float(r @ (0.5 * s + (self._linear[0] @ d + self._linear[1])))

    @cached_property
    def _inverse(self) -> np.ndarray:
        return np.linalg.pinv(self._equal.T, rcond=1e-12)

    @cached_property
    def _solve_normal(self) -> Any:
        return spla.factorized(sp.csc_matrix(self._equal @ self._equal.T))

    def equality_multipliers(self, values: np.ndarray) -> np.ndarray:
        """Least-squares multipliers: what remains of the stationarity condition is its residual."""
        if not self.equalities:
            return _NONE
        gradient = values[self._gradient]
        return -(self._inverse @ gradient) if self._dense else self._solve_normal(-(self._equal @ gradient))

    def residuals(self, values: np.ndarray, mu: np.ndarray | None, lam: np.ndarray) -> tuple[float, float, float]:
        """``primal``, ``dual`` and the absolute gap."""
        primal, gap, dual = 0.0, 0.0, values[self._gradient]
        if self.equalities:
            dual = dual + self._equal.T.dot(lam)
            primal = float(np.abs(values[self._missed]).max())
        if self.inequalities:
            primal = max(primal, float(np.maximum.reduce(values[self._excess])))
            if mu is not None:
                missed = np.abs(np.where(mu > 0, values[self._above], values[self._below]))
                if self._from_data:
                    missed[missed >= 0.5 * INFINITE] = _MISSED
                gap = float(np.abs(mu).dot(missed))
        return primal, float(np.maximum.reduce(np.abs(dual))), gap

    def certified(self, map_: DenseMap, d: np.ndarray, violation: float) -> dict[str, float]:
        """Bounds of the residuals of an answer of the affine map, whose largest violation of a bound is given.

        Residuals of that answer are affine in the data themselves, zero but for rounding; how far from it is worked
        out once for each map, the rounding of the product that gave the answer included.
        """
        size = np.abs(d)
        (dual, dual_constant), (primal, primal_constant) = self.certificate(map_)
        equal = float(primal.dot(size)) + primal_constant if self.equalities else 0.0
        return {"primal": max(equal, violation, 0.0), "dual": float(dual.dot(size)) + dual_constant, "gap": 0.0}

    def certificate(self, map_: DenseMap) -> tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]:
        """Weights of the sizes of all data, and a constant, that bound the dual and the primal residual."""
        if self._certificate is None:
            self._certificate = self._certify(map_)
        return self._certificate

    def _certify(self, map_: DenseMap) -> tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]:
        n = map_.size
        T, t = map_.table
        V = np.column_stack([T[:n], t[:n]])
        rows = self._rows[: self._missed.stop]
        M, given = rows[:, :n], rows[:, n + self._free.size :]
        values, sizes = M @ V + given, np.abs(M) @ np.abs(V) + np.abs(given)
        largest = self._bounds(values, sizes, V.shape[1])
        first, second = ((np.ascontiguousarray(part[:-1]), float(part[-1])) for part in largest)
        return first, second

    def certificate_held(self, map_: DenseMap) -> tuple[np.ndarray, np.ndarray]:
        """Weights (excesses,) of the sizes of their multipliers that bound what these add to dual and primal residual
        of an answer of the map that they move by ``map_.pull``.
        """
        n, V, S = map_.size, map_.pull, map_.signs
        rows = self._rows[: self._missed.stop]
        M, held = rows[:, :n], rows[:, n : n + self._free.size]
        return self._bounds(M @ V + held @ S, np.abs(M) @ np.abs(V) + np.abs(held) @ np.abs(S), sum(map_.lift.shape))

    def _bounds(self, values: np.ndarray, sizes: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
        """Largest entry of every column of gradient and equalities, rounding of sums of `length` included."""
        dual = values[self._gradient]
        if self.equalities:
            dual = dual - self._equal.T @ (self._inverse @ dual)
        rounding = 2 * length * np.finfo(float).eps
        parts = ((dual, sizes[self._gradient]), (values[self._missed], sizes[self._missed]))
        first, second = ((np.abs(exact) + rounding * size).max(axis=0, initial=0.0) for exact, size in parts)
        return first, second

    def active(self, z: np.ndarray, d: np.ndarray, mu: np.ndarray | None) -> np.ndarray:
        """1 at the upper bound, -1 at the lower, 0 between."""
        G, H, g = self._bounded
        lower, upper = (taken @ d + constant for taken, constant in self._limits)
        return active_rows(G @ z + H @ d + g, lower, upper, mu)

    def covariance(self, columns: np.ndarray) -> np.ndarray:
        """Rows and columns `columns` of the covariance; it depends on no vector data, so it is kept."""
        key = columns.tobytes()
        found = self._covariances.get(key)
        if found is None:
            hessian, equal = sp.csr_array(self._hessian), sp.csr_array(self._equal)
            found = self._covariances[key] = covariance_blocks(self._layout, hessian, equal, columns)
        return found.copy()


def _limit(bounds: Bounds, none: float, off: np.ndarray, data: int) -> tuple[Any, np.ndarray]:
    """One side's bounds of all inequality rows as an affine function of the data, none where an instance is off."""
    rows = np.flatnonzero((bounds.index >= 0) & ~off)
    taken = sp.csr_array((np.ones(rows.size), (rows, bounds.index[rows])), shape=(off.size, data))
    return taken, np.where(off, none, bounds.constant)


def _excess(sign: float, rows: tuple[Any, Any, np.ndarray], limit: tuple[Any, np.ndarray]) -> list[Any]:
    """Blocks of rows that tell how far one side's bounds are exceeded."""
    (G, H, g), (taken, constant) = rows, limit
    there = np.isfinite(constant)
    keep = sp.diags_array(sign * there)
    excess = np.where(there, sign * (g - np.where(there, constant, 0.0)), -_MISSED)
    return [keep @ G, None, keep @ (H - taken), excess[:, None]]


def _joined(blocks: list[list[Any]], heights: list[int], widths: list[int], dense: bool) -> Matrix:
    """A matrix of blocks, None for zeros."""
    if not dense:
        shapes = [[(height, width) for width in widths] for height in heights]
        filled = [
            [sp.csr_array(shape if block is None else block) for block, shape in zip(*row, strict=True)]
            for row in zip(blocks, shapes, strict=True)
        ]
        return sp.block_array(filled, format="csr")
    out = np.zeros((sum(heights), sum(widths)))
    tops, lefts = np.cumsum([0, *heights]), np.cumsum([0, *widths])
    for i, row in enumerate(blocks):
        for j, block in enumerate(row):
            if block is not None:
                out[tops[i] : tops[i + 1], lefts[j] : lefts[j + 1]] = block.toarray() if sp.issparse(block) else block
    return out


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
