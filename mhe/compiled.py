"""What is compiled once and shared by all whose problem is the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import numpy as np

from mhe.polyhedron import Polyhedron
from problems.models import LinearModel

T = TypeVar("T")


class CompiledOnce(Generic[T]):
    """Compiled things by the content of their problem; they are never solved themselves: take a fork or a batch."""

    def __init__(self) -> None:
        self._compiled: dict[tuple[Any, ...], T] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"_compiled": {}}  # compiled code does not travel between processes

    def _once(self, key: tuple[Any, ...], make: Callable[[], T]) -> T:
        found = self._compiled.get(key)
        if found is None:
            found = self._compiled[key] = make()
        return found


def content(item: LinearModel | Polyhedron | np.ndarray | Mapping[str, Any] | None) -> Any:
    """What tells a model, bounds, a matrix or settings of a solver from others."""
    if item is None:
        return None
    if isinstance(item, np.ndarray):
        return item.tobytes()
    if isinstance(item, Polyhedron):
        return tuple(part.tobytes() for part in (item.matrix, item.lower, item.upper))
    if isinstance(item, LinearModel):
        matrices = tuple(matrix.tobytes() for matrix in (item.A, item.B, item.G, item.Q, item.C, item.R))
        return matrices, tuple(item.rows(sensor.name).stop for sensor in item.sensors)
    return repr(sorted(item.items()))
