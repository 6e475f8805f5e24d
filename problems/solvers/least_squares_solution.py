"""What a solution of a graph or nonlinear program tells on access, recomputed from the terms at the point."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from problems.forms.costs import Bound
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.pins import Pins
from problems.forms.selection import columns_of
from problems.solvers.active import active_rows
from problems.solvers.linear import covariance_blocks


class LeastSquaresCheck:
    """Implements `problems.solvers.session.Check` for every solver of nonlinear problems.

    Args:
        multipliers: of the rows of `constraints`, or None (estimated by least squares on the active rows).
    """

    def __init__(
        self,
        form: LeastSquares,
        constraints: Constraints,
        pins: Pins,
        bound: Bound,
        point: np.ndarray,
        multipliers: np.ndarray | None,
    ) -> None:
        self._form, self._constraints, self._pins = form, constraints, pins
        self._bound, self._point, self._given = bound, point, multipliers
        self._numbers = bound.numbers

    def objective(self) -> float:
        return self._bound.cost(self._point)

    @cached_property
    def _linearized(self) -> tuple[np.ndarray, np.ndarray]:
        _, gradient, hessian = self._bound.linearize(self._point)
        return gradient, hessian

    @cached_property
    def _rows(self) -> tuple[np.ndarray, Any, np.ndarray, np.ndarray]:
        """Values, Jacobian, bounds of the constraints."""
        c = self._constraints
        values, entries = c.evaluate(self._point, self._numbers, self._bound.flags)
        J = sp.csr_array(sp.coo_array((entries, (c.rows, c.columns)), shape=(c.size, self._form.pattern.size)))
        lower, upper = c.bounds(self._numbers, self._bound.flags)
        return values, J, lower, upper

    @cached_property
    def _multipliers(self) -> np.ndarray:
        if self._given is not None or not self._constraints.size:
            return np.zeros(0) if self._given is None else self._given
        values, J, lower, upper = self._rows
        held = active_rows(values, lower, upper, None)
        held[: self._constraints.equalities] = 1
        active = np.flatnonzero(held)
        y = np.zeros(values.size)
        if active.size:
            y[active] = spla.lsqr(J[active].T, -self._free_gradient, atol=1e-14, btol=1e-14)[0]
        return y

    @cached_property
    def _free_gradient(self) -> np.ndarray:
        g = self._linearized[0].copy()
        g[self._pins.columns] = 0.0
        return g

    def residuals(self) -> dict[str, float]:
        dual, gap = self._free_gradient, 0.0
        primal = self._pins.violation(self._point, self._numbers)
        if self._constraints.size:
            values, J, lower, upper = self._rows
            y = self._multipliers
            dual = dual + J.T @ y
            dual[self._pins.columns] = 0.0
            primal = max(primal, float(np.maximum(np.maximum(values - upper, lower - values), 0.0).max()))
            bound = np.where(y > 0, upper, np.where(y < 0, lower, values))
            gap = float(np.abs(y * np.where(np.isfinite(bound), bound - values, np.sign(y))).sum())
        out = {"primal": primal, "dual": float(np.abs(dual).max(initial=0.0))}
        out["gap"] = gap / max(1.0, abs(self.objective()))
        return out

    def multipliers(self) -> dict[str, np.ndarray]:
        dual, out = self._linearized[0], {}
        if self._constraints.size:
            dual, out = dual + self._rows[1].T @ self._multipliers, self._by_term(self._multipliers)
        return out | self._pins.multipliers(self._point, self._numbers, dual)

    def active_set(self) -> dict[str, np.ndarray]:
        if not self._constraints.size:
            return {}
        values, _, lower, upper = self._rows
        state = active_rows(values, lower, upper, self._multipliers)
        kinds = {e.term.name: e.term.kind for e in self._constraints.terms}
        return {name: v for name, v in self._by_term(state).items() if kinds[name] == "inequality"}

    def _by_term(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        c = self._constraints
        return {
            e.term.name: rows[c.starts[k] : c.starts[k + 1]].reshape(e.term.count, c.dims[k])
            for k, e in enumerate(c.terms)
        }

    def covariance(self, slots: tuple[Any, ...]) -> np.ndarray:
        columns = columns_of(self._form.layout, slots)
        hessian = self._linearized[1].copy()
        pattern = self._form.pattern
        self._pins.reduce(np.zeros(pattern.size), hessian, pattern)
        half = sp.csc_array((hessian, pattern.indices, pattern.indptr), shape=(pattern.size, pattern.size))
        full = half + half.T - sp.diags_array(hessian[pattern.diagonal])
        moving = np.ones(pattern.size)
        moving[self._pins.columns] = 0.0
        F = self._rows[1][: self._constraints.equalities] @ sp.diags_array(moving)
        block = covariance_blocks(self._form.layout, full, F, columns)
        return block * np.outer(moving[columns], moving[columns])
