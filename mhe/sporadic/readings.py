"""Sporadic readings with their detection flags: what a node is given, and the slots they are kept in by time stamp.

A reading that was not detected is zero in a slot and its flag too, so nothing of it enters any product.

Source: dmhe-sporadic-fov 3.3 and section 10 (delayed, out-of-order, lost data).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from problems.errors import DataError, ShapeError


class Reading(NamedTuple):
    """What the sensors of one node deliver at one instant.

    Attributes:
        values: readings of its sensors one after the other, any shape of that size; NaN where nothing was detected;
            None: nothing at all.
        flags: 1 or 0 per sensor; by default 1 where every component of a reading is there.
        late: readings of earlier instants that come only now, as (time, values, flags).
    """

    values: Any
    flags: Any = None
    late: Sequence[tuple[float, Any, Any]] = ()


class Sensors:
    """Sizes of some sensors, and their readings as one array filled up to the largest size.

    Args:
        names: of the sensors.
        sizes: components of each.
        width: components of the largest sensor of the network.
    """

    def __init__(self, names: Sequence[str], sizes: Sequence[int], width: int) -> None:
        self.names, self.width = tuple(names), width
        self.count, self.size = len(sizes), int(sum(sizes))
        # a sensor's missing components point behind the last number, where a zero stands
        self._places = np.full((self.count, width), self.size)
        start = 0
        for sensor, size in enumerate(sizes):
            self._places[sensor, :size] = np.arange(start, start + size)
            start += size
        self._taken = self._places < self.size

    def read(self, values: Any, flags: Any, what: str) -> tuple[np.ndarray, np.ndarray]:
        """Readings (count, width), zero where not detected, and flags (count,).

        Raises:
            ShapeError: another number of components or flags.
            DataError: a flag other than 0 and 1; an infinite number, or NaN where the flag is 1.
        """
        numbers = np.full(self.size, np.nan) if values is None else np.asarray(values, dtype=float).ravel()
        if numbers.size != self.size:
            raise ShapeError(f"{what}: expected {self.size} component(s) of {self.count} sensor(s), got {numbers.size}")
        filled = np.append(numbers, 0.0)[self._places]
        there: Any = ~np.isnan(filled).any(axis=1)
        on = there
        if flags is not None:
            given = np.asarray(flags, dtype=float).ravel()
            if given.size != self.count:
                raise ShapeError(f"{what}: expected one flag for each of {self.count} sensor(s), got {given.size}")
            on = given == 1
            if not (on | (given == 0)).all():
                raise DataError(f"{what}: detection flags are 1 or 0, got {given}")
            if (on & ~there).any():
                wrong = self.names[int(np.flatnonzero(on & ~there)[0])]
                raise DataError(
                    f"{what}: sensor {wrong!r} has flag 1 and a reading with NaN; set its flag to 0 where nothing was "
                    "detected"
                )
        filled = np.where(on[:, None], filled, 0.0)
        if not np.isfinite(filled).all():
            wrong = self.names[int(np.flatnonzero(~np.isfinite(filled).all(axis=1))[0])]
            raise DataError(f"{what}: sensor {wrong!r} has an infinite reading")
        return filled, on.astype(float)

    def flat(self, readings: np.ndarray) -> np.ndarray:
        """(size,) numbers of readings (count, width)."""
        return readings[self._taken]

    def filled(self, numbers: np.ndarray) -> np.ndarray:
        """(count, width) from (size,) numbers."""
        return np.append(numbers, 0.0)[self._places]


class Slots:
    """Readings of a region for the instants t-N-1..t, the oldest first; the first one has left the window.

    While the window fills, the later positions are empty: position 1 is always the first instant of the window.

    Args:
        horizon: N.
        sensors: number of sensors.
        width: components of a reading.

    Attributes:
        flags: (N + 2, sensors).
        values: (N + 2, sensors, width), zero where the flag is 0.
        fed: what an observer is fed, `values` or their projections.
        instant: t, -1 before the first.
    """

    def __init__(self, horizon: int, sensors: int, width: int) -> None:
        self._horizon = horizon
        self.flags = np.zeros((horizon + 2, sensors))
        self.values = np.zeros((horizon + 2, sensors, width))
        self.fed = np.zeros((horizon + 2, sensors, width))
        self.instant = -1

    @property
    def first(self) -> int:
        """First instant of the window."""
        return max(0, self.instant - self._horizon)

    @property
    def newest(self) -> int:
        """Position of the newest instant among those of the window."""
        return self.instant - self.first

    def advance(self, instant: int) -> None:
        """Make room up to an instant; a slot that leaves is final."""
        before, self.instant = self.first, instant
        moved = min(self.first - before, len(self.flags))
        if moved:
            for array in (self.flags, self.values, self.fed):
                array[:-moved] = array[moved:]
                array[-moved:] = 0.0

    def enter(self, instant: int, sensors: slice, values: np.ndarray, fed: np.ndarray, flags: np.ndarray) -> bool:
        """Write what was detected and is not known yet; False where the instant has left the window.

        A reading that comes twice does no harm, whatever the order.
        """
        position = instant - self.first + 1
        if not 1 <= position < len(self.flags):
            return False
        new = (flags > self.flags[position, sensors]).nonzero()[0]
        if new.size:
            self.flags[position, sensors][new] = 1.0
            self.values[position, sensors][new] = values[new]
            self.fed[position, sensors][new] = fed[new]
        return True
