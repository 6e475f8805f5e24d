"""Marginalization: variables integrated out together with every cost and equality that touches them.

What remains is a quadratic in the unknowns they shared terms with, ``1/2 d'Md - m'd`` with ``d = local(reference, x)``:
exactly the data of an arrival cost, stated as a cost on ``local(reference, x)`` with ``information=M, linear=-m``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpotrf, dtrtrs  # type: ignore[attr-defined]

from problems.errors import DefinitionError, UnobservableError
from problems.forms.layout import DataStore, Layout
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.selection import slots_of
from problems.forms.subproblem import Subproblem
from problems.problem import Slot


@dataclass(frozen=True, eq=False)
class Marginal:
    """Quadratic information on the kept instances.

    Attributes:
        on: the kept slots, in the order of rows and columns.
        information: M (k, k), symmetric positive semidefinite, in tangent coordinates.
        vector: m (k,).
        reference: stored coordinates of the kept instances, one array (instances, ambient) per slot.
    """

    on: tuple[Slot, ...]
    information: np.ndarray
    vector: np.ndarray
    reference: tuple[np.ndarray, ...]


def schur(H: np.ndarray, G: np.ndarray, F: np.ndarray, E: np.ndarray, drop: int) -> tuple[np.ndarray, np.ndarray]:
    """Minimize ``1/2 z'Hz + z'G`` subject to ``F z + E = 0`` over the first `drop` unknowns.

    G and E may have several columns (an affine dependence on data).

    Returns:
        Hessian and linear part in the remaining unknowns.

    Raises:
        UnobservableError: the costs and equalities leave a dropped unknown free.
    """
    m = F.shape[0]
    found = None if m else _definite(H, G, drop)
    if found is not None:
        return found
    K = np.zeros((drop + m, drop + m))
    K[:drop, :drop] = H[:drop, :drop]
    K[:drop, drop:], K[drop:, :drop] = F[:, :drop].T, F[:, :drop]
    cross = np.vstack([H[:drop, drop:], F[:, drop:]])
    largest = np.abs(K).max(axis=1, initial=0.0)
    scale = 1 / np.sqrt(np.where(largest > 0, largest, 1.0))
    if K.size and np.linalg.cond(K * np.outer(scale, scale)) > 1e12:
        raise UnobservableError("marginal: the costs leave a dropped variable free, or its equalities clash")
    solved = np.linalg.solve(K, np.column_stack([cross, np.vstack([G[:drop], E])]))
    k = cross.shape[1]
    M = H[drop:, drop:] - cross.T @ solved[:, :k]
    return (M + M.T) / 2, G[drop:] - cross.T @ solved[:, k:]


class MarginalPlan:
    """What of a marginal does not depend on data or point: which instances leave, which stay, and the part of the
    problem between them.

    Attributes:
        part: the terms that touch a dropped instance, as a problem of their own.
        slots: the kept slots of the whole problem.
        drop: number of dropped tangent coordinates; they come first in `columns`, the kept ones after them.
        columns: tangent positions in the part.

    Raises:
        DefinitionError: `keep` leaves out an instance that shares a term with a dropped one, or names one twice.
    """

    def __init__(self, layout: Layout, drop: Any, keep: Any) -> None:
        dropped_slots = slots_of(layout, drop, "marginal")
        dropped = np.unique(_blocks(layout, dropped_slots))
        shared = np.setdiff1d(_shared(layout, dropped), dropped)
        if keep is None:
            self.slots = _as_slots(layout, shared)
        else:
            self.slots = slots_of(layout, keep, "marginal")
        kept = _blocks(layout, self.slots)
        if np.setdiff1d(shared, kept).size:
            raise DefinitionError("marginal: `keep` leaves out variables that share a term with dropped ones")
        if np.unique(np.concatenate([dropped, kept])).size < dropped.size + kept.size:
            raise DefinitionError("marginal: `keep` names an instance twice, or one that is dropped")
        self.part = Subproblem(layout, dropped, kept)
        drop_columns = np.concatenate([self.part.columns(slot) for slot in _as_slots(layout, dropped)])
        keep_columns = [self.part.columns(slot) for slot in self.slots]
        self.drop = drop_columns.size
        self.columns = np.concatenate([drop_columns, *keep_columns])
        self._values = [layout.stored(slot) for slot in self.slots]

    def references(self, point: np.ndarray) -> tuple[np.ndarray, ...]:
        """Stored coordinates of the kept slots at a point of the whole problem."""
        return tuple(point[index] for index in self._values)


def _blocks(layout: Layout, slots: list[Slot]) -> np.ndarray:
    """Numbers of the variable instances of slots."""
    parts = [layout.block_start[slot.source.name] + slot.indices for slot in slots]
    return np.concatenate(parts) if parts else np.zeros(0, np.intp)


def _shared(layout: Layout, dropped: np.ndarray) -> np.ndarray:
    """Instances that share a cost or equality with a dropped one."""
    mask = np.zeros(layout.block_dims.size, bool)
    mask[dropped] = True
    found = [dropped]
    for entry in layout.terms:
        if entry.term.kind != "inequality":
            found.append(entry.blocks[mask[entry.blocks].any(axis=1)].ravel())
    return np.unique(np.concatenate(found))


def _as_slots(layout: Layout, blocks: np.ndarray) -> list[Slot]:
    slots = []
    for variable in layout.problem.unknowns.values():
        start = layout.block_start[variable.name]
        inside = blocks[(blocks >= start) & (blocks < start + variable.count)] - start
        if inside.size:
            slots.append(variable[inside])
    return slots


class NonlinearMarginal:
    """Marginals linearized at a point, robust weights included; made once for each choice of `drop` and `keep`."""

    def __init__(self, layout: Layout, drop: Any, keep: Any) -> None:
        self.plan = MarginalPlan(layout, drop, keep)
        part = self.plan.part
        self._form = LeastSquares(part.problem, part.layout)
        self._constraints = Constraints(part.layout)
        pattern, size = self._form.pattern, part.layout.size
        place = np.empty(size, np.intp)  # dropped unknowns first, then the kept ones in their order
        place[self.plan.columns] = np.arange(size)
        rows, columns = place[pattern.indices], place[pattern.columns]
        self._upper, self._lower = rows * size + columns, columns * size + rows

    def __call__(self, store: DataStore, point: np.ndarray) -> Marginal:
        plan, size = self.plan, self.plan.part.layout.size
        bound = self._form.bind(store)
        at = point[plan.part.stored]
        _, gradient, entries = bound.linearize(at)
        H = np.empty((size, size)) if entries.size == size * (size + 1) // 2 else np.zeros((size, size))
        flat, order = H.ravel(), plan.columns
        flat[self._upper] = flat[self._lower] = entries
        gradient = gradient[order]
        found = None if self._constraints.size else _definite(H, gradient, plan.drop)
        if found is None:
            values, jacobian = self._constraints.evaluate(at, bound.numbers, bound.flags)
            shape = (self._constraints.size, size)
            F = sp.coo_array((jacobian, (self._constraints.rows, self._constraints.columns)), shape=shape).toarray()
            M, linear = schur(H, gradient[:, None], F[:, order], values[:, None], plan.drop)
            found = M, linear[:, 0]
        return Marginal(tuple(plan.slots), found[0], -found[1], plan.references(point))


def _definite(H: np.ndarray, gradient: np.ndarray, drop: int) -> tuple[np.ndarray, np.ndarray] | None:
    """`schur` without equalities by Cholesky; None where the dropped part is not well definite."""
    diagonal = H.diagonal()[:drop]
    if not drop or not diagonal.min() > 0:
        return None
    scale = 1 / np.sqrt(diagonal)
    root, info = dpotrf(H[:drop, :drop] * (scale[:, None] * scale), lower=1)
    # the smallest pivot of a matrix with unit diagonal bounds its condition well enough to leave doubtful ones alone
    if info != 0 or not root.diagonal().min() > 1e-4:
        return None
    kept = H.shape[0] - drop
    right = np.empty((drop, kept + (1 if gradient.ndim == 1 else gradient.shape[1])))
    right[:, :kept] = H[:drop, drop:]
    right[:, kept:] = gradient[:drop, None] if gradient.ndim == 1 else gradient[:drop]
    carried = dtrtrs(root, scale[:, None] * right, lower=1)[0]
    cross, moved = carried[:, :kept], carried[:, kept:]
    return H[drop:, drop:] - cross.T @ cross, gradient[drop:] - cross.T @ (moved[:, 0] if gradient.ndim == 1 else moved)
