"""`Slots`: measurements, inputs and times of the instants in a window, checked as they come in."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from problems.errors import DataError, ShapeError
from problems.models import Model

Late = Iterable[tuple[float, Any]]
Amendments = list[tuple[float, np.ndarray]]


class Slots:
    """The newest N + 1 instants, oldest first; while the window fills, later slots are empty.

    Attributes:
        measurements: (N + 1, p), NaN where missing.
        inputs: (N + 1, m); row k acted up to slot k.
        times: (s) of the slots that are filled.
        filled: slots that hold an instant.
        slid: the last `advance` pushed the oldest instant out.
    """

    def __init__(self, model: Model, horizon: int) -> None:
        self._model, self._count = model, horizon + 1
        self._period = model.dt or 1.0
        # a hair above one half, so that no time between two regular instants is without one
        self._reach = 0.5 * self._period * (1 + 1e-9)
        self.measurements = np.empty((self._count, model.measurement_size))
        self.column = self.measurements.reshape(-1, 1)  # the same numbers, shaped as the window's data
        self.inputs = np.empty((self._count, model.input_size))
        self.times: deque[float] = deque(maxlen=self._count)
        self.clear()

    def clear(self) -> None:
        """Forget all instants."""
        self.measurements[:] = np.nan
        self.inputs[:] = 0.0
        self.times.clear()
        self.filled = 0
        self.slid = False

    @property
    def full(self) -> bool:
        return self.filled == self._count

    @property
    def newest(self) -> int:
        """Slot of the newest instant."""
        return self.filled - 1

    def flags(self) -> np.ndarray:
        """(N + 1,) 1 where a slot is filled."""
        return (np.arange(self._count) < self.filled).astype(float)

    def advance(self, u: np.ndarray) -> None:
        """Make room for an instant, up to which the input `u` acted."""
        self.slid = self.full
        if self.slid:
            self.measurements[:-1] = self.measurements[1:]
            if u.size:
                self.inputs[:-1] = self.inputs[1:]
        else:
            self.filled += 1
        if u.size:
            self.inputs[self.newest] = u

    def enter(self, y: np.ndarray, time: float) -> None:
        """Write the newest measurement."""
        self.times.append(time)
        self.measurements[self.newest] = y

    def restore(self, records: np.ndarray) -> None:
        """Take over rows [y, u] of all slots."""
        self.measurements[:], self.inputs[:] = np.hsplit(records, [self.measurements.shape[1]])

    def amend(self, amendments: Amendments, used: list[float]) -> Amendments:
        """Write late measurements into their slots and their times into `used`; returns those of no slot."""
        left = []
        times = np.array(self.times)
        for when, y in amendments:
            slot = int(np.abs(times - when).argmin())
            if abs(times[slot] - when) <= self._reach:
                there = ~np.isnan(y)
                self.measurements[slot, there] = y[there]
                used.append(when)
            else:
                left.append((when, y))
        return left

    def measurement(self, value: Any) -> tuple[np.ndarray, tuple[int, ...]]:
        """y (p,) and its missing components; None means all of them. Raises ShapeError, DataError."""
        size = self.measurements.shape[1]
        y = np.full(size, np.nan) if value is None else np.asarray(value, dtype=float)
        if y.shape != (size,):
            raise ShapeError(f"measurements: expected shape ({size},), got {y.shape}")
        if y.dot(y) < np.inf:
            return y, ()
        infinite = np.isinf(y)
        if infinite.any():
            raise DataError(f"measurements: component {int(np.argmax(infinite))} is infinite; a missing one is NaN")
        return y, tuple(np.flatnonzero(np.isnan(y)).tolist())

    def input(self, value: Any) -> np.ndarray:
        """u (m,); may be left out at the first instant unless an output depends on it. Raises ShapeError, DataError."""
        size = self.inputs.shape[1]
        if value is None:
            if size and (self.filled or self._model.feedthrough):
                raise DataError(f"inputs: the model needs {size} component(s) and got none")
            return np.zeros(size)
        return finite(value, size, "inputs")

    def instant(self, time: float | None) -> float:
        """Time of the next instant, counted on if None. Raises DataError where it does not advance."""
        times = self.times
        if time is None:
            return times[-1] + self._period if times else 0.0
        last = times[-1] if times else None
        if not np.isfinite(time) or (last is not None and time <= last):
            raise DataError(f"time: expected a number later than the last step's {last}, got {time!r}")
        return float(time)

    def late(self, late: Late, instant: float) -> Amendments:
        """Late measurements as (time, y), of an instant of the window or of one before it. Raises as `measurement`."""
        checked = [(float(when), self.measurement(value)[0]) for when, value in late]
        times = np.array([*self.times, instant])
        for when, _ in checked:
            if when > times[0] and np.abs(times - when).min() > self._reach:
                known = np.round(times, 6).tolist()
                raise DataError(f"late: {when:g} s is within {self._reach:g} s of none of the instants {known}")
        return checked


def finite(value: Any, size: int, what: str) -> np.ndarray:
    """`value` as (size,) finite numbers. Raises ShapeError, DataError."""
    array = np.asarray(value, dtype=float)
    if array.shape == (size,) and array.dot(array) < np.inf:
        return array
    array = np.atleast_1d(array)
    if array.shape != (size,):
        raise ShapeError(f"{what}: expected shape ({size},), got {array.shape}")
    if not np.isfinite(array).all():
        raise DataError(f"{what}: every number must be finite, got {array}")
    return array
