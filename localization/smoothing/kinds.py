"""What a team measures and knows: kinds of measurements, lasting unknowns, fences, and the readings of one keyframe."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.errors import DataError, DefinitionError, SettingError, ShapeError
from problems.noise import L2, Gaussian, Loss
from problems.spaces import Space

POSE, BEFORE, OTHER = "pose", "before", "other"


@dataclass(frozen=True, eq=False)
class Lasting:
    """Unknowns that do not change: landmarks, biases, calibration.

    Attributes:
        space: of each of them.
        count: how many.
        mean: (count, ambient) or (ambient,); prior and first point to linearize at.
        sigma: prior standard deviation in tangent coordinates, a number or (dim,).
        own: one for each robot, read by that robot alone (a scale of its odometry); readings do not name it.
    """

    space: Space
    count: int
    mean: Any
    sigma: Any
    own: bool = False


@dataclass(frozen=True, eq=False)
class Kind:
    """One kind of measurement: a residual template and where it reads.

    Attributes:
        residual: takes the elements that `on` names, then the parts of a reading; see `problems.problem.Problem.cost`.
        on: ``pose`` of a robot at the keyframe, ``before`` (the same robot at the keyframe before), ``other`` (another
            robot at the keyframe), or names of lasting unknowns, in the order of the residual's arguments.
        parts: sizes of the data that the residual takes, side by side in a reading.
        noise: of every reading; None where each reading brings standard deviations.
        loss: robust loss.
        gate: probability of a good reading to be used; readings whose squared Mahalanobis distance to the prediction
            exceeds that quantile of chi-square are left out. None uses all.
        capacity: readings of the same places that a keyframe can hold.

    Raises:
        DefinitionError, SettingError: a combination that has no meaning.
    """

    residual: Callable[..., Any]
    on: tuple[str, ...]
    parts: tuple[int, ...]
    noise: Gaussian | None = None
    loss: Loss = L2()
    gate: float | None = None
    capacity: int = 1

    def __post_init__(self) -> None:
        if POSE not in self.on or len(set(self.on)) < len(self.on):
            raise DefinitionError(f"a kind reads {POSE!r} once and nothing twice, got on={self.on}")
        if not self.parts or any(size < 1 for size in self.parts):
            raise DefinitionError(f"parts are sizes of the data of one reading, got {self.parts}")
        if self.gate is not None and not 0 < self.gate < 1:
            raise SettingError(f"gate is a probability between 0 and 1, got {self.gate!r}")
        if self.gate is not None and BEFORE in self.on:
            raise DefinitionError("what moves a robot on has no prediction to be gated against; give it a loss instead")
        if self.capacity < 1:
            raise SettingError(f"capacity must be at least 1, got {self.capacity!r}")


@dataclass(frozen=True, eq=False)
class Fence:
    """Bounds on every pose of the window: ``lower <= residual(pose) <= upper``."""

    residual: Callable[..., Any]
    lower: Any = -np.inf
    upper: Any = 0.0


@dataclass(frozen=True, eq=False)
class Readings:
    """Measurements of one kind at one keyframe.

    Attributes:
        values: (m, sum of parts); a row with NaN is missing.
        at: (m, axes) who measured (robot), then the other robot and lasting unknowns in the order of ``on``; (m,) where
            there is only the robot.
        sigma: (m, dim) standard deviations, for kinds without noise of their own.
    """

    values: np.ndarray
    at: np.ndarray
    sigma: np.ndarray | None = None


Measurements = Mapping[str, Readings]


class Places:
    """Where readings of a kind stand in the window: every combination of robot, other robot and lasting unknowns.

    Attributes:
        kind: see `Kind`. name: of it.
        axes: what the rows of a reading's ``at`` name.
        own: lasting unknowns that go with the robot.
        combinations: (c, axes).
        values: (slots, c, capacity, width) NaN where nothing is held. sigma: of the same shape with dim columns.
    """

    def __init__(self, name: str, kind: Kind, robots: int, lasting: Mapping[str, Lasting], slots: int) -> None:
        unknown = set(kind.on) - {POSE, BEFORE, OTHER} - set(lasting)
        if unknown:
            raise DefinitionError(
                f"kind {name!r} reads {sorted(unknown)}, which is neither {POSE}, {BEFORE}, {OTHER} nor a lasting "
                f"unknown ({sorted(lasting) or 'none'})"
            )
        self.name, self.kind = name, kind
        self.own = {role for role in kind.on if role in lasting and lasting[role].own}
        self.axes = [POSE, *(role for role in kind.on if role not in (POSE, BEFORE) and role not in self.own)]
        sizes = [robots if role in (POSE, OTHER) else lasting[role].count for role in self.axes]
        rows = list(itertools.product(*(range(size) for size in sizes)))
        if OTHER in self.axes:
            one = self.axes.index(OTHER)
            rows = [row for row in rows if row[0] != row[one]]
        if not rows:
            raise DefinitionError(f"kind {name!r} reads another robot, and the team has one")
        self.combinations = np.array(rows, dtype=np.intp)
        self._number = np.full(sizes, -1, dtype=np.intp)
        self._number[tuple(self.combinations.T)] = np.arange(len(rows))
        self.values = np.full((slots, len(rows), kind.capacity, sum(kind.parts)), np.nan)
        self.sigma: np.ndarray | None = None
        edges = np.cumsum([0, *kind.parts]).tolist()
        self._parts = {f"{name} {k}": slice(a, b) for k, (a, b) in enumerate(itertools.pairwise(edges))}
        self.first = 1 if BEFORE in kind.on else 0

    @property
    def per_slot(self) -> int:
        return len(self.combinations) * self.kind.capacity

    def combination(self, readings: Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Combination numbers (m,), values (m, width) and standard deviations of readings.

        Raises:
            ShapeError, DataError: rows that do not fit the kind or name what does not exist.
        """
        values = np.atleast_2d(np.asarray(readings.values, dtype=float))
        at = np.asarray(readings.at)
        at = at.reshape(-1, 1) if at.ndim < 2 else at
        if values.shape != (len(at), self.values.shape[-1]) or at.shape[1] != len(self.axes):
            raise ShapeError(
                f"readings {self.name!r}: expected values (m, {self.values.shape[-1]}) at (m, {len(self.axes)}) "
                f"({', '.join(self.axes)}), got {values.shape} at {at.shape}"
            )
        inside = np.all((at >= 0) & (at < np.array(self._number.shape)), axis=1)
        number = self._number[tuple(np.where(inside[:, None], at, 0).T)]
        if not inside.all() or bool((number < 0).any()):
            row = int(np.flatnonzero(~inside | (number < 0))[0])
            raise DataError(f"readings {self.name!r}: row {row} names {self.axes} = {at[row].tolist()}")
        if np.isinf(values).any():
            raise DataError(f"readings {self.name!r}: values must be finite, or NaN where missing")
        sigma = None
        if self.sigma is not None:
            if readings.sigma is None:
                raise DataError(f"readings {self.name!r}: the kind has no noise of its own; give sigma (m, dim)")
            sigma = np.broadcast_to(np.asarray(readings.sigma, dtype=float), (len(at), self.sigma.shape[-1]))
            if not (sigma > 0).all():
                raise DataError(f"readings {self.name!r}: standard deviations must be positive")
        elif readings.sigma is not None:
            raise DataError(f"readings {self.name!r}: the kind has its own noise, so readings bring no sigma")
        return number, values, sigma

    def owners(self, combination: np.ndarray) -> dict[str, np.ndarray]:
        """Indices (m,) of what combinations read, by role; `BEFORE` counts robots."""
        at = dict(zip(self.axes, self.combinations[combination].T, strict=True))
        return at | {role: at[POSE] for role in (BEFORE, *self.own)}

    def enter(self, slot: int, number: np.ndarray, values: np.ndarray, sigma: np.ndarray | None) -> int:
        """Put readings into free places of a slot; the number of those left out, as all their places are taken."""
        dropped = 0
        for row, combination in enumerate(number):
            if np.isnan(values[row]).any():
                continue
            free = np.flatnonzero(np.isnan(self.values[slot, combination, :, 0]))
            if not free.size:
                dropped += 1
                continue
            self.values[slot, combination, free[0]] = values[row]
            if self.sigma is not None and sigma is not None:
                self.sigma[slot, combination, free[0]] = sigma[row]
        return dropped

    def slide(self) -> None:
        """Forget the oldest slot and make room for a new one."""
        self.values[:-1] = self.values[1:]
        self.values[-1] = np.nan
        if self.first:
            self.values[0] = np.nan
        if self.sigma is not None:
            self.sigma[:-1] = self.sigma[1:]
            self.sigma[-1] = 1.0

    def clear(self) -> None:
        self.values[:] = np.nan
        if self.sigma is not None:
            self.sigma[:] = 1.0

    def data(self) -> dict[str, np.ndarray]:
        """Data of the window's problem by name."""
        rows = self.values[self.first :].reshape(-1, self.values.shape[-1])
        out = {name: rows[:, part] for name, part in self._parts.items()}
        if self.sigma is not None:
            out[f"{self.name} sigma"] = self.sigma[self.first :].reshape(-1, self.sigma.shape[-1])
        return out
