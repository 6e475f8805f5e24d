"""Marginalization: variables integrated out together with every cost and equality that touches them.

What remains is a quadratic in the unknowns they shared terms with, ``1/2 d'Md - m'd`` with ``d = local(reference, x)``:
exactly the data of an arrival cost, stated as a cost on ``local(reference, x)`` with ``information=M, linear=-m``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.errors import DefinitionError, UnobservableError
from problems.forms.layout import Activity, DataStore, Layout, constant_rows
from problems.forms.least_squares import whitening_numbers
from problems.forms.residual_code import residual_code
from problems.forms.selection import columns_of, slots_of
from problems.forms.template import template_of
from problems.problem import DataSlot, Problem, Slot


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


def selection(layout: Layout, drop: Any, keep: Any) -> tuple[np.ndarray, list[Slot], np.ndarray]:
    """Columns dropped, slots kept, their columns.

    Kept are the slots in `keep`, or all instances that share a cost or equality with a dropped one.

    Raises:
        DefinitionError: `keep` leaves out an instance that shares a term with a dropped one, or names one twice.
    """
    dropped = np.unique(columns_of(layout, drop, "marginal"))
    touched = []
    for entry in layout.terms:
        if entry.term.kind in ("cost", "equality"):
            rows = np.isin(entry.columns, dropped).any(axis=1)
            touched.append(entry.columns[rows].ravel())
    shared = np.setdiff1d(np.concatenate(touched) if touched else np.zeros(0, np.intp), dropped)
    if keep is None:
        slots = []
        for variable in layout.problem.unknowns.values():
            start, dim = layout.start[variable.name], variable.space.dim
            inside = shared[(shared >= start) & (shared < start + variable.count * dim)]
            if inside.size:
                slots.append(variable[np.unique((inside - start) // dim)])
    else:
        slots = slots_of(layout, keep, "marginal")
    columns = np.concatenate([layout.columns(s).ravel() for s in slots]) if slots else np.zeros(0, np.intp)
    if np.setdiff1d(shared, columns).size:
        raise DefinitionError("marginal: `keep` leaves out variables that share a cost or equality with dropped ones")
    if np.unique(np.concatenate([dropped, columns])).size < dropped.size + columns.size:
        raise DefinitionError("marginal: `keep` names an instance twice, or one that is dropped")
    return dropped, slots, columns


def schur(H: np.ndarray, G: np.ndarray, F: np.ndarray, E: np.ndarray, drop: int) -> tuple[np.ndarray, np.ndarray]:
    """Minimize ``1/2 z'Hz + z'G`` subject to ``F z + E = 0`` over the first `drop` unknowns.

    G and E may have several columns (an affine dependence on data).

    Returns:
        Hessian and linear part in the remaining unknowns.

    Raises:
        UnobservableError: the costs and equalities leave a dropped unknown free.
    """
    m = F.shape[0]
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


def marginal(problem: Problem, layout: Layout, store: DataStore, drop: Any, keep: Any, point: np.ndarray) -> Marginal:
    """The marginal linearized at `point` (robust weights included). See `Session.marginal`."""
    dropped, slots, kept = selection(layout, drop, keep)
    involved = np.concatenate([dropped, kept])
    place = np.full(layout.size, -1, np.intp)
    place[involved] = np.arange(involved.size)
    H, g = np.zeros((involved.size, involved.size)), np.zeros(involved.size)
    F, f = [np.zeros((0, involved.size))], [np.zeros(0)]
    numbers = np.where(np.isnan(store.numbers), 0.0, store.numbers)
    flags = Activity(layout).flags(store.numbers)
    for entry, on in zip(layout.terms, flags, strict=True):
        term = entry.term
        if term.kind == "inequality":
            continue
        touching = np.isin(entry.columns, dropped).any(axis=1)
        rows = np.flatnonzero(touching if on is None else touching & on)
        if not rows.size:
            continue
        inputs = [*point[entry.stored[rows]].T, *numbers[entry.numbers[rows]].T]
        r, J = residual_code(term).residual_and_jacobian([np.ascontiguousarray(v) for v in inputs], rows.size)
        at = place[entry.columns[rows]]
        if term.kind == "equality":
            for k in range(rows.size):
                full = np.zeros((r.shape[1], involved.size))
                np.add.at(full.T, at[k], J[k].T)
                F.append(full)
                f.append(r[k])
            continue
        white = whitening_numbers(entry, template_of(term).dim, store)
        for k, row in enumerate(rows):
            U = _factor(white[:, row if white.shape[1] > 1 else 0], r.shape[1])
            e, Je = U @ r[k], U @ J[k]
            w = float(term.loss.weight(float(e @ e)))
            np.add.at(H, (at[k][:, None], at[k][None]), w * Je.T @ Je)
            np.add.at(
                g, at[k], w * Je.T @ e + J[k].T @ _linear(layout, entry.linear, term, numbers, int(row), r.shape[1])
            )
    M, gradient = schur(H, g[:, None], np.vstack(F), np.concatenate(f)[:, None], dropped.size)
    reference = tuple(_stored(layout, point, slot) for slot in slots)
    return Marginal(tuple(slots), M, -gradient[:, 0], reference)


def _stored(layout: Layout, point: np.ndarray, slot: Slot) -> np.ndarray:
    return layout.value(point, slot.source.name)[slot.indices]


def _factor(numbers: np.ndarray, dim: int) -> np.ndarray:
    if numbers.size == dim:
        return np.diag(numbers)
    U = np.zeros((dim, dim))
    U[np.triu_indices(dim)] = numbers
    return U


def _linear(layout: Layout, index: Any, term: Any, numbers: np.ndarray, row: int, dim: int) -> np.ndarray:
    if term.linear is None:
        return np.zeros(dim)
    if isinstance(term.linear, DataSlot):
        return np.broadcast_to(numbers[index], (term.count, dim))[row]
    return constant_rows(term.linear, dim, term.count, term.what)[row]
