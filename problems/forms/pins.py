"""Equalities that fix one variable instance entirely, such as the first pose of a graph.

They are not handed to any constraint handling: the instance is moved onto its value once and its step is then exactly
zero, which removes a gauge freedom without touching the rest of the Hessian.
"""

from __future__ import annotations

import numpy as np

from problems.forms.layout import Layout
from problems.forms.residual_code import residual_code
from problems.forms.sparsity import HessianPattern
from problems.forms.template import template_of


class Pins:
    """Fixed instances of a problem.

    Attributes:
        names: equality terms that are handled here.
        columns: tangent positions whose step is zero.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._terms = [
            e
            for e in layout.terms
            if e.term.kind == "equality"
            and len(e.term.slots) == 1
            and template_of(e.term).dim == template_of(e.term).width
        ]
        self.names = frozenset(e.term.name for e in self._terms)
        columns = [e.columns.ravel() for e in self._terms]
        self.columns = np.unique(np.concatenate(columns)) if columns else np.zeros(0, np.intp)
        self._mask: np.ndarray | None = None

    def apply(self, point: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """The point with every fixed instance on its value (Newton on the equality itself)."""
        for e in self._terms:
            code = residual_code(e.term)
            for _ in range(20):
                inputs = [np.ascontiguousarray(v) for v in (*point[e.stored].T, *numbers[e.numbers].T)]
                r, J = code.residual_and_jacobian(inputs, e.term.count)
                if np.abs(r).max() <= 1e-14:
                    break
                step = np.zeros(self._layout.size)
                step[e.columns] = -np.linalg.solve(J, r[:, :, None])[:, :, 0]
                point = self._layout.retract(point, step)
        return point

    def reduce(self, gradient: np.ndarray, hessian: np.ndarray, pattern: HessianPattern) -> None:
        """Make rows and columns of fixed coordinates those of the identity (in place), so that their step is zero."""
        if not self.columns.size:
            return
        if self._mask is None:
            fixed = np.zeros(pattern.size, bool)
            fixed[self.columns] = True
            column = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
            self._mask = fixed[column] | fixed[pattern.indices]
        gradient[self.columns] = 0.0
        hessian[self._mask] = 0.0
        hessian[pattern.diagonal[self.columns]] = 1.0
