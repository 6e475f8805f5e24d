"""What a solution of a quadratic program tells on access, recomputed from the uncondensed rows of the problem.

Nothing here depends on the form that was solved or on what the solver claimed: objective, residuals and multipliers
come from the terms, the data of that solve and the point.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from problems.forms.affine import Rows, information_of, weigh
from problems.forms.layout import DataStore, constant_rows
from problems.forms.quadratic import QuadraticProgram
from problems.forms.selection import columns_of
from problems.problem import DataSlot
from problems.solvers.linear import covariance_blocks


class QPCheck:
    """Implements `problems.solvers.session.Check`.

    Args:
        numbers: data of the solve, missing ones read as zero.
        flags: instances that were switched on.
        z: all unknowns.
        mu: multipliers of all inequality rows; None where no row was active.
    """

    __slots__ = ("__dict__", "_flags", "_mu", "_numbers", "_program", "_store", "_z")

    def __init__(
        self,
        program: QuadraticProgram,
        store: DataStore,
        numbers: np.ndarray,
        flags: dict[str, np.ndarray | None],
        z: np.ndarray,
        mu: np.ndarray | None,
    ) -> None:
        self._program, self._store, self._numbers = program, store, numbers
        self._flags, self._z, self._mu = flags, z, mu

    @cached_property
    def _data(self) -> DataStore:
        return self._store.copy(self._numbers)

    @cached_property
    def _rows(self) -> list[Rows]:
        return self._program.rows.evaluate(self._numbers)

    def _kind(self, kind: str) -> list[Rows]:
        return [r for r in self._rows if r.layout.term.kind == kind]

    def _value(self, rows: Rows) -> np.ndarray:
        return rows.R @ self._z + rows.E @ self._numbers + rows.c

    def _cost(self, rows: Rows) -> tuple[float, np.ndarray]:
        """Value of a cost term and its derivative with respect to the residual rows."""
        term = rows.layout.term
        on = self._flags.get(term.name)
        W = information_of(rows, self._data, on)
        r = self._value(rows).reshape(rows.count, rows.dim)
        slope = (W @ r[:, :, None])[:, :, 0]
        value = 0.5 * float((slope * r).sum())
        if term.linear is not None:
            linear = (
                self._numbers[rows.layout.linear]
                if isinstance(term.linear, DataSlot)
                else constant_rows(term.linear, rows.dim, rows.count, term.what)
            )
            linear = np.broadcast_to(linear, r.shape) * (1.0 if on is None else on[:, None])
            value += float((linear * r).sum())
            slope = slope + linear
        return value, slope.ravel()

    def objective(self) -> float:
        return sum(self._cost(rows)[0] for rows in self._kind("cost"))

    @cached_property
    def _gradient(self) -> np.ndarray:
        """Of costs and active inequalities with respect to all unknowns."""
        g = np.zeros(self._z.size)
        for rows in self._kind("cost"):
            g += rows.R.T @ self._cost(rows)[1]
        if self._mu is not None:
            start = 0
            for rows in self._kind("inequality"):
                stop = start + rows.count * rows.dim
                g += rows.R.T @ self._mu[start:stop]
                start = stop
        return g

    @cached_property
    def _equality_multipliers(self) -> np.ndarray:
        """Least-squares multipliers of all equalities: what remains of the stationarity condition is its residual."""
        equal = self._kind("equality")
        if not equal:
            return np.zeros(0)
        if isinstance(equal[0].R, np.ndarray):
            F = np.vstack([r.R for r in equal])
            return np.linalg.lstsq(F.T, -self._gradient, rcond=None)[0]
        F = sp.vstack([r.R for r in equal], format="csr")
        return spla.spsolve(sp.csc_matrix(F @ F.T), -(F @ self._gradient))

    def residuals(self) -> dict[str, float]:
        dual = self._gradient.copy()
        primal, start = 0.0, 0
        for rows in self._kind("equality"):
            stop = start + rows.count * rows.dim
            dual += rows.R.T @ self._equality_multipliers[start:stop]
            primal = max(primal, float(np.abs(self._value(rows)).max()))
            start = stop
        gap = 0.0
        for rows, lower, upper, mu in self._inequalities():
            r = self._value(rows)
            primal = max(primal, float(np.maximum(r - upper, lower - r).max(initial=0.0)))
            bound = np.where(mu > 0, upper, np.where(mu < 0, lower, r))
            # a multiplier on a side without a bound is no certificate: let the gap show it
            gap += float(np.abs(mu * np.where(np.isfinite(bound), bound - r, np.sign(mu))).sum())
        scale = max(1.0, abs(self.objective()))
        return {"primal": primal, "dual": float(np.abs(dual).max(initial=0.0)), "gap": gap / scale}

    def _inequalities(self) -> list[tuple[Rows, np.ndarray, np.ndarray, np.ndarray]]:
        out, start = [], 0
        for rows in self._kind("inequality"):
            stop = start + rows.count * rows.dim
            mu = np.zeros(stop - start) if self._mu is None else self._mu[start:stop]
            lower, upper = (self._bound(rows, key) for key in ("lower", "upper"))
            on = self._flags.get(rows.layout.term.name)
            if on is not None:
                off = np.repeat(~on, rows.dim)
                lower, upper = np.where(off, -np.inf, lower), np.where(off, np.inf, upper)
            out.append((rows, lower, upper, mu))
            start = stop
        return out

    def _bound(self, rows: Rows, key: str) -> np.ndarray:
        value = getattr(rows.layout.term, key)
        if isinstance(value, DataSlot):
            numbers = self._numbers[self._program.layout.numbers(value)]
            return np.broadcast_to(numbers, (rows.count, rows.dim)).ravel()
        return constant_rows(value, rows.dim, rows.count, rows.layout.term.what).ravel()

    def multipliers(self) -> dict[str, np.ndarray]:
        out, start = {}, 0
        for rows in self._kind("equality"):
            stop = start + rows.count * rows.dim
            out[rows.layout.term.name] = self._equality_multipliers[start:stop].reshape(rows.count, rows.dim)
            start = stop
        for rows, _, _, mu in self._inequalities():
            out[rows.layout.term.name] = mu.reshape(rows.count, rows.dim)
        return out

    def active_set(self) -> dict[str, np.ndarray]:
        out = {}
        for rows, lower, upper, _ in self._inequalities():
            r = self._value(rows)
            near = 1e-7 * np.maximum(1.0, np.abs(r))
            active = np.where(r >= upper - near, 1, np.where(r <= lower + near, -1, 0))
            out[rows.layout.term.name] = active.reshape(rows.count, rows.dim)
        return out

    def covariance(self, slots: tuple[Any, ...]) -> np.ndarray:
        program = self._program
        columns = columns_of(program.layout, slots)
        P = 0
        for rows in self._kind("cost"):
            W = information_of(rows, self._data, self._flags.get(rows.layout.term.name))
            P = P + weigh(rows, W).T @ rows.R
        F = sp.vstack([sp.csr_array((0, self._z.size)), *(r.R for r in self._kind("equality"))], format="csr")
        return covariance_blocks(program.layout, sp.csr_array(P), F, columns)
