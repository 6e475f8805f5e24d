"""Causal moving horizon estimation of one tag from ranges to known anchors (spec ``recordings`` 1).

State: position and velocity in the plane (constant velocity, white acceleration) and one range bias per anchor. Ranges
are used at their own times: a range taken before a knot reads the position moved back along the velocity. The arrival
cost is the marginal of the oldest knot (``prior=filter``), biases included.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from localization.io.recording import TimeSeries, UwbRecording
from localization.tracking.multilateration import multilaterate, spread_of
from problems.errors import DataError, ModelWarning, SettingError
from problems.forms.marginal import Marginal
from problems.noise import L2, Cauchy, Gaussian
from problems.problem import Problem
from problems.solvers.session import Solution
from problems.spaces import Vector


@dataclass(frozen=True)
class RangeTrackerSettings:
    """One parameter set for a kind of recording; defaults are those of spec ``recordings`` 1.

    Attributes:
        horizon: transitions in the window.
        period: seconds between knots.
        acceleration: spectral density of the white acceleration, m^2/s^3.
        range_sigma: m.
        loss: scale of the Cauchy loss on ranges, in sigmas; 0 for plain least squares.
        height: of the tag, m.
        bias: estimate one range bias per anchor.
        bias_mean, bias_sigma: prior of each bias, m.
        bias_walk: random walk of each bias, m/sqrt(s).
        lag: the ranging latency by which outputs are advanced along the velocity, s.
        delay: report each knot only this much later, with the measurements in between (fixed-lag smoothing), s.
        gps_sigma: of coarse position fixes, m.
        start_sigma, speed_sigma: of the first position (m) and velocity (m/s).
        iterations: Gauss-Newton steps per knot; 0 iterates to convergence.
        capacity: ranges of one anchor that a knot can hold.

    Raises:
        SettingError: a value that has no meaning.
    """

    horizon: int = 20
    period: float = 0.1
    acceleration: float = 0.5
    range_sigma: float = 0.08
    loss: float = 2.0
    height: float = 1.0
    bias: bool = True
    bias_mean: float = 0.10
    bias_sigma: float = 0.05
    bias_walk: float = 0.001
    lag: float = 0.2
    delay: float = 0.0
    gps_sigma: float = 2.0
    start_sigma: float = 0.5
    speed_sigma: float = 2.0
    iterations: int = 3
    capacity: int = 2

    def __post_init__(self) -> None:
        positive = ("period", "acceleration", "range_sigma", "bias_sigma", "gps_sigma", "start_sigma", "speed_sigma")
        for name in ("horizon", "capacity"):
            if getattr(self, name) < 1:
                raise SettingError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        for name in positive:
            if not getattr(self, name) > 0:
                raise SettingError(f"{name} must be positive, got {getattr(self, name)!r}")
        for name in ("loss", "bias_walk", "lag", "delay", "iterations"):
            if not getattr(self, name) >= 0:
                raise SettingError(f"{name} must not be negative, got {getattr(self, name)!r}")
        if round(self.delay / self.period) > self.horizon:
            raise SettingError(
                f"delay {self.delay:g} s is longer than the window of {self.horizon * self.period:g} s; "
                "give a longer horizon or a shorter delay"
            )


def range_at_offset(x: Any, bias: Any, anchor: Any, z: Any, offset: Any, height: Any) -> Any:
    """Range (m) taken `offset` seconds from the knot with state x = (position, velocity)."""
    p = x[0:2] + offset * x[2:4]
    return ca.sqrt(ca.sumsqr(p - anchor[0:2]) + (height - anchor[2]) ** 2) + bias - z


def fix_at_offset(x: Any, z: Any, offset: Any) -> Any:
    """Position fix (m) taken `offset` seconds from the knot."""
    return x[0:2] + offset * x[2:4] - z


def _moves(x: Any, after: Any, period: Any) -> Any:
    return after - ca.vertcat(x[0:2] + period * x[2:4], x[2:4])


def _arrival(x: Any, *rest: Any) -> Any:
    return ca.vertcat(x, *rest[:-1]) - rest[-1]


class RangeTracker:
    """See the module. Knots are added one by one by `step`.

    Args:
        anchors: (k, 3) positions, m.
        start: (2,) or (4,) first position, and velocity if known.
        settings: see `RangeTrackerSettings`.
        solver: registered name of a solver for graphs.
        solver_settings: of that solver.
    """

    def __init__(
        self,
        anchors: np.ndarray,
        start: np.ndarray,
        settings: RangeTrackerSettings | None = None,
        solver: str = "gauss-newton",
        **solver_settings: Any,
    ) -> None:
        self.settings = s = settings or RangeTrackerSettings()
        self.anchors = np.asarray(anchors, dtype=float)
        if self.anchors.ndim != 2 or self.anchors.shape[1] != 3:
            raise DataError(f"anchors are (k, 3) positions in metres, got shape {self.anchors.shape}")
        k, slots = len(self.anchors), s.horizon + 1
        problem = self.problem = Problem("range tracking")
        self._state = state = problem.variables("state", Vector(4), slots)
        self._bias = bias = problem.variables("bias", Vector(1), k)
        # slot order: knot, anchor, place
        knots = np.repeat(np.arange(slots), k * s.capacity)
        which = np.tile(np.repeat(np.arange(k), s.capacity), slots)
        count = knots.size
        anchor = problem.data("anchor", 3, count, value=self.anchors[which])
        ranges, offset = problem.data("range", (), count), problem.data("range_offset", (), count)
        height = problem.data("height", value=s.height)
        fixes, fix_offset = problem.data("fix", 2, slots), problem.data("fix_offset", (), slots)
        period = problem.data("period", value=s.period)
        size = 4 + k
        reference = problem.data("reference", size)
        information, vector = problem.data("information", (size, size)), problem.data("vector", size)
        problem.cost(
            "arrival", _arrival, on=(state[0], *(bias[j] for j in range(k))), data=reference,
            noise=Gaussian(information=information), linear=vector,
        )  # fmt: skip
        dt, q = s.period, s.acceleration
        block = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        motion = np.kron(block, np.eye(2))
        problem.cost("motion", _moves, on=(state[:-1], state[1:]), data=period, noise=Gaussian(covariance=motion))
        problem.cost(
            "ranges", range_at_offset, on=(state[knots], bias[which]), data=(anchor, ranges, offset, height),
            noise=Gaussian(s.range_sigma), loss=Cauchy(s.loss) if s.loss > 0 else L2(),
        )  # fmt: skip
        problem.cost("fixes", fix_at_offset, on=state, data=(fixes, fix_offset), noise=Gaussian(s.gps_sigma))
        if s.iterations and solver == "gauss-newton":
            solver_settings = {"iterations": s.iterations, **solver_settings}
        self.session = problem.compile(solver, **solver_settings)
        self._ranges, self._offsets = np.full((slots, k, s.capacity), np.nan), np.zeros((slots, k, s.capacity))
        self._fixes, self._fix_offsets = np.full((slots, 2), np.nan), np.zeros(slots)
        self._knot = -1
        first = np.concatenate([np.asarray(start, dtype=float), np.zeros(4 - len(start))])
        spread = [s.start_sigma**-2] * 2 + [s.speed_sigma**-2] * 2
        bias_information = s.bias_sigma**-2 if s.bias else 1e12
        mean = s.bias_mean if s.bias else 0.0
        self._prior(
            np.concatenate([first, np.full(k, mean)]), np.diag([*spread, *[bias_information] * k]), np.zeros(size)
        )
        states = np.empty((slots, 4))
        for j in range(slots):
            states[j] = np.concatenate([first[:2] + j * dt * first[2:], first[2:]])
        self._guess = {"state": states, "bias": np.full((k, 1), mean)}
        self.status: Counter[str] = Counter()
        self.dropped = 0

    def _prior(self, reference: np.ndarray, information: np.ndarray, vector: np.ndarray) -> None:
        self.session.update(reference=reference, information=information, vector=vector)

    def step(self, ranges: tuple[np.ndarray, np.ndarray, np.ndarray], fixes: np.ndarray | None = None) -> np.ndarray:
        """Add a knot with what was measured in the period before it.

        Args:
            ranges: anchor indices (m,), ranges (m,) in metres, and offsets (m,) in seconds from the knot (<= 0).
            fixes: (x, y, offset) of a position fix, or None.

        Returns:
            State (4,) at the knot `delay` before this one: position (m), velocity (m/s), not advanced by the lag.
        """
        self._knot += 1
        if self._knot > self.settings.horizon:
            self._slide()
        self.enter(min(self._knot, self.settings.horizon), ranges, fixes)
        self.solve(self._guess)
        return self.solution["state"][self._row].copy()

    def enter(
        self, row: int, ranges: tuple[np.ndarray, np.ndarray, np.ndarray], fixes: np.ndarray | None = None
    ) -> None:
        """Put what was measured in the period before a knot into window slot `row`; arguments as for `step`.

        Of more ranges to an anchor than a knot can hold the newest are kept; `dropped` counts the others.
        """
        for anchor, value, offset in zip(*ranges, strict=True):
            held, offsets = self._ranges[row, anchor], self._offsets[row, anchor]
            free = np.flatnonzero(np.isnan(held))
            place = int(free[0]) if free.size else int(np.argmin(offsets))
            if not free.size:
                self.dropped += 1
                if offset <= offsets[place]:
                    continue
            held[place], offsets[place] = value, offset
        if fixes is not None:
            self._fixes[row], self._fix_offsets[row] = fixes[:2], fixes[2]

    def solve(self, initial: dict[str, np.ndarray]) -> Solution:
        """Solve the window as it is filled, from `initial` values by variable name."""
        data = {
            "range": self._ranges.ravel(), "range_offset": self._offsets.ravel(),
            "fix": self._fixes, "fix_offset": self._fix_offsets,
        }  # fmt: skip
        self.solution = self.session.solve(data, initial=initial)
        self.status[str(self.solution.status)] += 1
        self._guess = {"state": self.solution["state"].copy(), "bias": self.solution["bias"].copy()}
        return self.solution

    @property
    def _row(self) -> int:
        """Window slot of the reported knot."""
        return max(min(self._knot, self.settings.horizon) - round(self.settings.delay / self.settings.period), 0)

    def covariance(self) -> np.ndarray:
        """(4, 4) of the reported state."""
        return self.solution.covariance(self._state[self._row])

    def advanced(self, state: np.ndarray) -> np.ndarray:
        """Position (2,) of a state when the ranging latency has passed."""
        return state[:2] + self.settings.lag * state[2:]

    def advanced_covariance(self) -> np.ndarray:
        """(2, 2) of the reported position when the ranging latency has passed, m^2."""
        s = self.settings
        ahead = np.hstack([np.eye(2), s.lag * np.eye(2)])
        return ahead @ self.covariance() @ ahead.T + s.acceleration * s.lag**3 / 3 * np.eye(2)

    def _slide(self) -> None:
        """Integrate the oldest knot out and move everything one knot forward."""
        left = self.session.marginal(self._state[0], keep=[self._state[1], self._bias])
        self._prior(*self._walked(left))
        for array, empty in (
            (self._ranges, np.nan), (self._offsets, 0.0), (self._fixes, np.nan), (self._fix_offsets, 0.0),
        ):  # fmt: skip
            array[:-1] = array[1:]
            array[-1] = empty
        states = self._guess["state"]
        states[:-1] = states[1:]
        states[-1, :2] += self.settings.period * states[-1, 2:]

    def _walked(self, left: Marginal) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The marginal after one period of the biases' random walk: a spread added to their covariance."""
        k = len(self.anchors)
        reference = np.concatenate([part.ravel() for part in left.reference])
        M, m = left.information, left.vector
        spread = np.zeros(4 + k)
        if self.settings.bias:
            spread[4:] = self.settings.bias_walk**2 * self.settings.period
        # (M^-1 + S)^-1 = M (I + S M)^-1 keeps M^-1 m, without inverting M
        grown = np.linalg.solve(np.eye(4 + k) + M * spread, np.column_stack([M, m]))
        information = (grown[:, :-1] + grown[:, :-1].T) / 2
        return reference, information, -grown[:, -1]


@dataclass(frozen=True, eq=False)
class Track:
    """A causal track of a recording.

    Attributes:
        estimate: (time, position (m, 2)) of each knot, advanced by the lag.
        velocity: (m, 2) m/s.
        covariance: (m, 2, 2) of the positions, m^2, or None.
        bias: (k,) last biases, m.
        step_seconds: (m,) computing time of each knot.
        compile_seconds: of the session. status: solves by status. iterations: in total.
        objective: cost of the last window.
        residual: worst of its recomputed residuals.
    """

    estimate: TimeSeries
    velocity: np.ndarray
    covariance: np.ndarray | None
    bias: np.ndarray
    step_seconds: np.ndarray
    compile_seconds: float
    status: Counter[str]
    iterations: int
    objective: float
    residual: float | None


def first_position(recording: UwbRecording, settings: RangeTrackerSettings, seconds: float = 1.0) -> np.ndarray:
    """Position (2,) at the start, from the ranges of the first seconds alone.

    Raises:
        DataError: the anchors heard in that time leave the position open.
    """
    early = recording.time <= recording.time[0] + seconds
    anchors = heights(recording.anchors, settings)
    heard = np.unique(recording.anchor[early])
    if spread_of(anchors[heard]) < 2:
        names = ", ".join(recording.anchor_names[k] for k in heard)
        raise DataError(
            f"{recording.name}: in its first {seconds:g} s only {names} are heard; a start needs three anchors that "
            "are not on one line. Give it: --set 'start=[x, y]' (m), or start=truth where there is truth"
        )
    found = multilaterate(
        anchors[recording.anchor[early]],
        recording.ranges[early] - settings.bias_mean * settings.bias,
        settings.height,
    )
    return found.position


def heights(anchors: np.ndarray, settings: RangeTrackerSettings) -> np.ndarray:
    """Anchors (k, 3); planar ones are put at the tag's height."""
    if anchors.shape[1] == 3:
        return anchors
    return np.column_stack([anchors, np.full(len(anchors), settings.height)])


Step = tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray | None]


def arrivals(
    recording: UwbRecording, settings: RangeTrackerSettings, fixes: TimeSeries | None
) -> tuple[np.ndarray, list[Step]]:
    """Times of the knots (count,), and for each what arrived in the period that ends there, as `RangeTracker.step`
    takes it."""
    first, period = recording.time[0], settings.period
    count = int(np.ceil((recording.time[-1] - first) / period)) + 1
    knots = first + period * np.arange(count)

    def owner(stamp: np.ndarray) -> np.ndarray:
        return np.ceil((stamp - first) / period - 1e-9).astype(int)

    bounds = np.searchsorted(owner(recording.time), np.arange(count + 1))
    fix_of = {} if fixes is None else dict(zip(owner(fixes.time).tolist(), range(len(fixes)), strict=True))
    steps: list[Step] = []
    for j, knot in enumerate(knots):
        part = slice(bounds[j], bounds[j + 1])
        fix, row = None, fix_of.get(j)
        if fixes is not None and row is not None:
            fix = np.array([*fixes.value[row, :2], fixes.time[row] - knot])
        steps.append(((recording.anchor[part], recording.ranges[part], recording.time[part] - knot), fix))
    return knots, steps


def track(
    recording: UwbRecording,
    start: np.ndarray,
    settings: RangeTrackerSettings | None = None,
    fixes: TimeSeries | None = None,
    solver: str = "gauss-newton",
    covariances: bool = False,
    progress: Any = None,
    **solver_settings: Any,
) -> Track:
    """Run a `RangeTracker` over a recording, knot by knot.

    Args:
        start: first position (2,), m.
        fixes: coarse position fixes in the anchors' frame.
        covariances: also compute the covariance of every knot.
        progress: called with the number of finished knots and of all.

    Warns (`ModelWarning`) where knots cannot hold all ranges.
    """
    s = settings or RangeTrackerSettings()
    anchors = heights(recording.anchors, s)
    begin = time.perf_counter()
    tracker = RangeTracker(anchors, start, s, solver, **solver_settings)
    compile_seconds = time.perf_counter() - begin
    knots, steps = arrivals(recording, s, fixes)
    count = len(knots)
    states, position = np.empty((count, 4)), np.empty((count, 2))
    seconds, iterations = np.empty(count), 0
    P = np.empty((count, 2, 2)) if covariances else None
    for j in range(count):
        begin = time.perf_counter()
        states[j] = tracker.step(*steps[j])
        seconds[j] = time.perf_counter() - begin
        position[j] = tracker.advanced(states[j])
        iterations += tracker.solution.iterations
        if P is not None:
            P[j] = tracker.advanced_covariance()
        if progress is not None:
            progress(j + 1, count)
    if tracker.dropped:
        warnings.warn(
            f"{recording.name}: {tracker.dropped} of {len(recording.time)} ranges are left out, as a knot holds "
            f"{s.capacity} of each anchor; set a larger capacity or a shorter period",
            ModelWarning,
            stacklevel=2,
        )
    keep = slice(round(s.delay / s.period), None)  # before, the reported knot stood still
    return Track(
        TimeSeries(knots[keep] - s.delay, position[keep]),
        states[keep, 2:],
        None if P is None else P[keep],
        tracker.solution["bias"].ravel().copy(),
        seconds,
        compile_seconds,
        tracker.status,
        iterations,
        tracker.solution.objective,
        max(tracker.solution.residuals.values()),
    )
