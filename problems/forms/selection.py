"""Positions of chosen variable instances in the tangent step."""

from __future__ import annotations

from typing import Any

import numpy as np

from problems.errors import DefinitionError
from problems.forms.layout import Layout
from problems.problem import Slot, Variable


def slots_of(layout: Layout, chosen: Any, what: str) -> list[Slot]:
    """Variables and slots as slots. Raises DefinitionError for anything else or of another problem."""
    out = []
    for entry in chosen if isinstance(chosen, (tuple, list)) else (chosen,):
        slot = entry[:] if isinstance(entry, Variable) else entry
        if not isinstance(slot, Slot) or slot.source.problem is not layout.problem:
            raise DefinitionError(f"{what}: expected variables of problem {layout.problem.name!r}, got {entry!r}")
        out.append(slot)
    return out


def columns_of(layout: Layout, chosen: Any, what: str = "covariance") -> np.ndarray:
    """Tangent positions of all instances of the slots, slot after slot."""
    return np.concatenate([layout.columns(slot).ravel() for slot in slots_of(layout, chosen, what)])
