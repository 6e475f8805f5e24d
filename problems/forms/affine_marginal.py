"""Marginals of affine problems: the information matrix is fixed by the weights, the vector is affine in the data."""

from __future__ import annotations

import numpy as np

from problems.forms.layout import DataStore, Layout
from problems.forms.marginal import Marginal, MarginalPlan, schur
from problems.forms.quadratic import PATTERNS, QuadraticProgram


class AffineMarginalPlan:
    """The part of an affine problem between dropped and kept instances; made once for each choice of them."""

    def __init__(self, layout: Layout, drop: object, keep: object) -> None:
        self.plan = MarginalPlan(layout, drop, keep)
        self.program = QuadraticProgram(self.plan.part.problem, dense=True)
        self._flags: dict[bytes, dict[str, np.ndarray | None]] = {}

    def flags(self, store: DataStore, pattern: bytes) -> dict[str, np.ndarray | None]:
        """Active instances of the part; `pattern` identifies those of the whole problem."""
        found = self._flags.get(pattern)
        if found is None:
            if len(self._flags) >= PATTERNS:
                self._flags.pop(next(iter(self._flags)))
            found = self._flags[pattern] = self.program.flags(store.numbers)
        return found


class AffineMarginal:
    """``M`` and ``gradient = G d + g`` at zero for one set of weights, matrices and missing data.

    Attributes:
        M: (k, k) information on the kept coordinates.
        G, g: (k, data) and (k,).
    """

    def __init__(self, plan: AffineMarginalPlan, store: DataStore, numbers: np.ndarray, pattern: bytes) -> None:
        program, self._plan = plan.program, plan.plan
        order = self._plan.columns
        reduced = program.reduced(numbers)
        P, Q, q0 = reduced.weighted(store, plan.flags(store, pattern), pattern)
        gradient = np.column_stack([Q, q0])[order]
        E = np.column_stack([reduced.E, reduced.c])
        self.M, linear = schur(P[order[:, None], order], gradient, reduced.A[:, order], E, self._plan.drop)
        self.G, self.g = np.ascontiguousarray(linear[:, :-1]), linear[:, -1].copy()

    def __call__(self, numbers: np.ndarray, point: np.ndarray) -> Marginal:
        reference = self._plan.references(point)
        x = np.concatenate([part.ravel() for part in reference])
        vector = self.G.dot(numbers)
        vector += self.M.dot(x)
        vector += self.g
        np.negative(vector, out=vector)
        return Marginal(tuple(self._plan.slots), self.M, vector, reference)
