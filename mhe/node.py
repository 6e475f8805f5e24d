"""What nodes that send one message per step have in common."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any

import numpy as np

from problems.errors import DataError, ShapeError
from problems.runtime import Message, Outgoing


class OneMessageNode:
    """A node whose step has no exchange beyond the one message that `measure` gives.

    Attributes:
        rounds: none.
    """

    rounds = 0

    def exchange(self, index: int, inbox: list[Message]) -> Iterable[Outgoing]:
        """Never called: the node speaks once per step."""
        return ()


def own_reading(
    measurement: Any, size: int, inputs: int, instant: int, label: Hashable
) -> tuple[np.ndarray, np.ndarray | None]:
    """What `measure` is given, as y (size,) and u (inputs,); None for u at instant 0 and where the model has no inputs.

    Args:
        measurement: y, NaN where a component is missing, None where all are; (y, u) where the model has inputs.
        size, inputs: how many numbers are expected.
        instant, label: time step and node, for messages.

    Raises:
        ShapeError: another number of measurements.
        DataError: infinite measurements; inputs that are missing or not finite.
    """
    given, acted = measurement if inputs and measurement is not None else (measurement, None)
    y = np.full(size, np.nan) if given is None else np.asarray(given, dtype=float)
    if y.shape != (size,):
        if y.size != size:
            raise ShapeError(f"node {label}: expected {size} measurement(s), got shape {y.shape}")
        y = y.reshape(size)
    if np.isinf(y).any():
        raise DataError(f"node {label}: an infinite measurement at time step {instant}; a missing one is NaN")
    if not inputs or (acted is None and not instant):
        return y, None
    u = np.full(inputs, np.nan) if acted is None else np.asarray(acted, dtype=float)
    if u.shape != (inputs,) or not np.isfinite(u).all():
        raise DataError(
            f"node {label}: the model needs {inputs} input(s) at time step {instant}, finite numbers; got {acted!r}"
        )
    return y, u
