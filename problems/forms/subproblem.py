"""The part of a problem that touches chosen variable instances, as a problem of its own.

It has the terms' instances that read a chosen instance (costs and equalities; inequalities are left out), the variable
instances these share, and the same data under the same names, so a session's data serve it as they are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from problems.forms.layout import Layout, TermLayout, constant_rows
from problems.forms.template import template_of
from problems.noise import chosen_rows
from problems.problem import DataSlot, Problem, Slot, Term


class Subproblem:
    """See the module.

    Attributes:
        problem: the part.
        layout: its layout; data stand where they stand in the whole problem.
        stored: positions of its stored coordinates among those of the whole problem.
    """

    def __init__(self, layout: Layout, touched: np.ndarray, shared: np.ndarray) -> None:
        """`touched` and `shared` are numbers of variable instances (`TermLayout.blocks`)."""
        self._whole = layout
        self._place = np.full(layout.block_dims.size, -1, np.intp)
        self.problem = Problem(f"part of {layout.problem.name}")
        stored = []
        blocks = np.union1d(touched, shared)
        for variable in layout.problem.unknowns.values():
            start = layout.block_start[variable.name]
            inside = blocks[(blocks >= start) & (blocks < start + variable.count)]
            if inside.size:
                self.problem.variables(variable.name, variable.space, inside.size)
                self._place[inside] = np.arange(inside.size)
                at = layout.stored_start[variable.name] + (inside - start)[:, None] * variable.space.ambient
                stored.append((at + np.arange(variable.space.ambient)).ravel())
        self.stored = np.concatenate(stored)
        self.problem.inputs = layout.problem.inputs
        mask = np.zeros(layout.block_dims.size, bool)
        mask[touched] = True
        for entry in layout.terms:
            rows = np.flatnonzero(mask[entry.blocks].any(axis=1))
            if entry.term.kind != "inequality" and rows.size:
                self.problem.terms[entry.term.name] = self._restricted(entry, rows)
        self.layout = Layout(self.problem)

    def columns(self, slot: Slot) -> np.ndarray:
        """Tangent positions in the part of a slot of the whole problem."""
        blocks = self._whole.block_start[slot.source.name] + slot.indices
        mine = self.problem.unknowns[slot.source.name]
        return self.layout.columns(Slot(mine, self._place[blocks])).ravel()

    def _restricted(self, entry: TermLayout, rows: np.ndarray) -> Term:
        term, dim = entry.term, template_of(entry.term).dim

        def numbers(value: Any, what: str) -> Any:
            if isinstance(value, DataSlot):
                return DataSlot(value.source, _pick(value.indices, rows))
            return None if value is None else constant_rows(value, dim, term.count, f"{term.what}: {what}")[rows]

        active = term.active
        if isinstance(active, DataSlot):
            active = DataSlot(active.source, _pick(active.indices, rows))
        elif active is not None:
            active = np.broadcast_to(np.asarray(active, dtype=bool), (term.count,))[rows]
        slots = []
        for k, slot in enumerate(term.slots):
            blocks = entry.blocks[rows, k] if len(slot.indices) > 1 else entry.blocks[:1, k]
            slots.append(Slot(self.problem.unknowns[slot.source.name], self._place[blocks]))
        noise = term.noise
        if noise is not None and isinstance(noise.value, DataSlot):
            noise = type(noise)(**{noise.kind: DataSlot(noise.value.source, _pick(noise.value.indices, rows))})
        elif noise is not None:
            noise = chosen_rows(noise, dim, term.count, rows, term.what)
        return replace(
            term,
            slots=tuple(slots),
            data=tuple(DataSlot(s.source, _pick(s.indices, rows)) for s in term.data),
            count=rows.size,
            noise=noise,
            linear=numbers(term.linear, "linear"),
            active=active,
        )


def _pick(indices: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The chosen ones of per-instance indices; a single index serves all."""
    return indices[rows] if len(indices) > 1 else indices
