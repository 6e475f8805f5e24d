"""Marginals of affine problems: the information matrix is fixed by the weights, the vector is affine in the data."""

from __future__ import annotations

import numpy as np

from problems.forms.layout import DataStore, Layout
from problems.forms.marginal import Marginal, MarginalPlan, schur
from problems.forms.quadratic import QuadraticProgram


class AffineMarginalPlan:
    """The part of an affine problem between dropped and kept instances; made once for each choice of them."""

    def __init__(self, layout: Layout, drop: object, keep: object) -> None:
        self.plan = MarginalPlan(layout, drop, keep)
        self.program = QuadraticProgram(self.plan.part.problem, dense=True)


class AffineMarginal:
    """``M`` and ``gradient = G d + g`` at zero for one set of weights, matrices and missing data."""

    def __init__(self, plan: AffineMarginalPlan, store: DataStore, numbers: np.ndarray) -> None:
        program, self._plan = plan.program, plan.plan
        order = self._plan.columns
        reduced = program.reduced(numbers)
        pattern = program.activity.key(store.numbers)
        P, Q, q0 = reduced.weighted(store, program.flags(store.numbers), pattern)
        gradient = np.column_stack([Q, q0])[order]
        E = np.column_stack([reduced.E, reduced.c])
        self.M, linear = schur(P[np.ix_(order, order)], gradient, reduced.A[:, order], E, self._plan.drop)
        self._G, self._g = np.ascontiguousarray(linear[:, :-1]), linear[:, -1].copy()

    def __call__(self, numbers: np.ndarray, point: np.ndarray) -> Marginal:
        reference = self._plan.references(point)
        x = np.concatenate([part.ravel() for part in reference])
        vector = self._G.dot(numbers)
        vector += self.M.dot(x)
        vector += self._g
        np.negative(vector, out=vector)
        return Marginal(tuple(self._plan.slots), self.M, vector, reference)
