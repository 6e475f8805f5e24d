"""What a solution of a quadratic program tells on access, recomputed from the uncondensed rows of the problem.

Nothing here depends on the form that was solved or on what the solver claimed: objective, residuals and multipliers
come from the terms, the data of that solve and the point.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from problems.forms.layout import DataStore
from problems.forms.quadratic import QuadraticProgram
from problems.forms.selection import columns_of
from problems.solvers.qp_maps import DenseMap, SparseMap
from problems.solvers.qp_rows import StackedRows

NEGLIGIBLE = 1e-13  # a gap so small needs no comparison with the objective


class Pattern:
    """What a check keeps of one solve: the active instances, worked out on access."""

    def __init__(self, program: QuadraticProgram, numbers: np.ndarray, flags: dict[str, Any] | None) -> None:
        self._program, self._numbers, self._flags = program, numbers, flags
        self.rows: StackedRows | None = None

    @property
    def flags(self) -> dict[str, Any]:
        return self._program.flags(self._numbers) if self._flags is None else self._flags


class QPCheck:
    """Implements `problems.solvers.session.Check`.

    Args:
        numbers: data of the solve, missing ones read as zero.
        map_: for the weights and the pattern of that solve, or its pattern alone; keeps the stacked rows for all its
            solutions.
        z: all unknowns.
        mu: multipliers of all inequality rows; None where no row was active.
        violation: largest violation of a bound where `map_` itself gave the answer, else None.
    """

    __slots__ = ("_found", "_map", "_mu", "_numbers", "_program", "_store", "_violation", "_z")

    def __init__(
        self,
        program: QuadraticProgram,
        store: DataStore,
        numbers: np.ndarray,
        map_: DenseMap | SparseMap | Pattern,
        z: np.ndarray,
        mu: np.ndarray | None,
        violation: float | None = None,
    ) -> None:
        self._program, self._store, self._numbers = program, store, numbers
        self._map, self._z, self._mu, self._violation = map_, z, mu, violation
        self._found: tuple[np.ndarray, tuple[float, float, float]] | None = None

    @property
    def rows(self) -> StackedRows:
        """Stacked rows of the pattern and weights."""
        rows = self._map.rows
        if rows is None:
            rows = self._map.rows = StackedRows(self._program, self._store.copy(self._numbers), self._map.flags)
        return rows

    def _optimality(self) -> tuple[np.ndarray, tuple[float, float, float]]:
        """Multipliers of the equalities; ``primal``, ``dual`` and the absolute gap."""
        if self._found is None:
            rows = self.rows
            values = rows.values(self._z, self._mu, self._numbers)
            multipliers = rows.equality_multipliers(values)
            self._found = multipliers, rows.residuals(values, self._mu, multipliers)
        return self._found

    def within(self, tolerance: float) -> bool:
        """Whether all residuals are at most `tolerance` even without their sizes."""
        primal, dual, gap = self._optimality()[1]
        return primal <= tolerance and dual <= tolerance and gap <= tolerance

    def objective(self) -> float:
        return self.rows.objective(self._z, self._numbers)

    def residuals(self) -> dict[str, float]:
        if self._violation is not None and isinstance(self._map, DenseMap) and self._map.exact:
            return self.rows.certified(self._map, self._numbers, self._violation)
        primal, dual, gap = self._optimality()[1]
        if gap > NEGLIGIBLE:
            gap /= max(1.0, abs(self.objective()))
        return {"primal": primal, "dual": dual, "gap": gap}

    def multipliers(self) -> dict[str, np.ndarray]:
        rows = self.rows
        if self._mu is None and not rows.equalities:
            return {name: np.zeros(shape) for name, _, shape in rows.inequalities}
        held = self._optimality()[0]
        out = {name: held[part].reshape(shape) for name, part, shape in rows.equalities}
        for name, part, shape in rows.inequalities:
            out[name] = np.zeros(shape) if self._mu is None else self._mu[part].reshape(shape)
        return out

    def active_set(self) -> dict[str, np.ndarray]:
        rows = self.rows
        active = rows.active(self._z, self._numbers, self._mu)
        return {name: active[part].reshape(shape) for name, part, shape in rows.inequalities}

    def covariance(self, slots: tuple[Any, ...]) -> np.ndarray:
        return self.rows.covariance(columns_of(self._program.layout, slots))
