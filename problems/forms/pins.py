"""Equalities that fix one variable instance entirely, such as the first pose of a graph.

They are not handed to any constraint handling: the instance is moved onto its value once and its step is then exactly
zero, which removes a gauge freedom without touching the rest of the Hessian.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from problems.forms.layout import Layout, TermLayout
from problems.forms.residual_code import ResidualCode, residual_code
from problems.forms.sparsity import HessianPattern
from problems.forms.template import Template, template_of


class Pins:
    """Fixed instances of a problem.

    Attributes:
        names: equality terms that are handled here.
        columns: tangent positions whose step is zero.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._terms: list[TermLayout] = []
        self.columns = np.zeros(0, np.intp)
        for entry in layout.terms:
            columns = np.concatenate([self.columns, entry.columns.ravel()])
            if _fixes(entry) and np.unique(columns).size == columns.size:
                self._terms.append(entry)
                self.columns = columns
        self.columns = np.sort(self.columns)
        self.names = frozenset(e.term.name for e in self._terms)
        self._entries: np.ndarray | None = None

    def apply(self, point: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """The point with every fixed instance on its value, by Newton on the equality; `violation` tells success."""
        for e in self._terms:
            for _ in range(20):
                r, J = _rows(e, point, numbers)
                if np.abs(r).max() <= 1e-14 or not (np.isfinite(r).all() and np.isfinite(J).all()):
                    break
                step = np.zeros(self._layout.size)
                step[e.columns] = -(np.linalg.pinv(J) @ r[:, :, None])[:, :, 0]
                point = self._layout.retract(point, step)
        return point

    def violation(self, point: np.ndarray, numbers: np.ndarray) -> float:
        """Largest residual of the equalities handled here; NaN where one is not finite."""
        if not self._terms:
            return 0.0
        return float(np.max([np.abs(_rows(e, point, numbers)[0]).max() for e in self._terms], initial=0.0))

    def multipliers(self, point: np.ndarray, numbers: np.ndarray, dual: np.ndarray) -> dict[str, np.ndarray]:
        """(count, dim) by term, from the gradient of everything else in the Lagrangian."""
        out = {}
        for e in self._terms:
            J = _rows(e, point, numbers)[1]
            out[e.term.name] = -np.linalg.solve(J.swapaxes(1, 2), dual[e.columns][:, :, None])[:, :, 0]
        return out

    def reduce(self, gradient: np.ndarray, hessian: np.ndarray, pattern: HessianPattern) -> None:
        """Make rows and columns of fixed coordinates those of the identity (in place), so that their step is zero."""
        if not self.columns.size:
            return
        if self._entries is None:
            fixed = np.zeros(pattern.size, bool)
            fixed[self.columns] = True
            own = [np.arange(pattern.indptr[c], pattern.indptr[c + 1]) for c in self.columns]
            self._entries = np.concatenate([np.flatnonzero(fixed[pattern.indices]), *own])
        gradient[self.columns] = 0.0
        hessian[self._entries] = 0.0
        hessian[pattern.diagonal[self.columns]] = 1.0


def _fixes(entry: TermLayout) -> bool:
    """Does the term determine its only slot by itself? Tried at one general point."""
    term, template = entry.term, template_of(entry.term)
    if term.kind != "equality" or len(term.slots) != 1 or template.dim != template.width:
        return False
    if any(slot.source.of is not None for slot in term.data):
        return False
    return _determines(template, residual_code(term), entry.stored.shape[1] + entry.numbers.shape[1])


@lru_cache(maxsize=1024)
def _determines(template: Template, code: ResidualCode, inputs: int) -> bool:
    J = code.residual_and_jacobian(list(np.cos(np.arange(1.0, inputs + 1.0))), 1)[1][0]
    return bool(np.isfinite(J).all()) and int(np.linalg.matrix_rank(J)) == template.width


def _rows(entry: TermLayout, point: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inputs = [np.ascontiguousarray(v) for v in (*point[entry.stored].T, *numbers[entry.numbers].T)]
    return residual_code(entry.term).residual_and_jacobian(inputs, entry.term.count)
