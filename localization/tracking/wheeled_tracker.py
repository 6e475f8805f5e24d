"""Localization of one robot from wheel odometry and ranges to known anchors (labyrinth folders), causal or not.

Ranges are too long by a bias that all anchors share; it is estimated along with the poses. Each range is a keyframe.
Source: spec ``recordings`` 2.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from localization import measurements
from localization.io.recording import TimeSeries, UwbRecording
from localization.smoothing import FixedLagSmoother, Kind, Lasting, Readings, TeamEstimate
from localization.tracking.multilateration import multilaterate
from problems.errors import DataError, SettingError
from problems.noise import Cauchy, Gaussian, Loss
from problems.spaces import SE2, Vector

FIXED = 1e-6  # m, of a bias that is not estimated


@dataclass(frozen=True)
class WheeledTrackerSettings:
    """One parameter set for a kind of recording.

    Attributes:
        lag: keyframes in the window before the newest one.
        range_sigma: m. loss: on ranges.
        bias: estimate the common bias of the ranges; else it is `bias_mean`.
        bias_mean, bias_sigma: its prior, m.
        speed_sigma, slip_sigma, turn_sigma: of odometry per step: m/s forward, m/s sideways, rad/s.
        start_sigma: of the first pose (m, m, rad).
        iterations: Gauss-Newton steps per keyframe; None iterates to convergence.

    Raises:
        SettingError: a value that has no meaning.
    """

    lag: int = 20
    range_sigma: float = 0.1
    loss: Loss = Cauchy(1.0)
    bias: bool = True
    bias_mean: float = 0.0
    bias_sigma: float = 0.3
    speed_sigma: float = 0.03
    slip_sigma: float = 0.02
    turn_sigma: float = 0.1
    start_sigma: tuple[float, float, float] = (0.3, 0.3, 2.0)
    iterations: int | None = 3

    def __post_init__(self) -> None:
        for name in ("range_sigma", "bias_sigma", "speed_sigma", "slip_sigma", "turn_sigma"):
            if not getattr(self, name) > 0:
                raise SettingError(f"{name} must be positive, got {getattr(self, name)!r}")


def biased_range(pose: Any, bias: Any, z: Any, anchor: Any) -> Any:
    """Range (m) to an anchor (2,) with a bias."""
    return ca.norm_2(pose.translation - anchor) + bias - z


@dataclass(frozen=True, eq=False)
class WheeledTrack:
    """Estimated poses of a recording.

    Attributes:
        estimate: (time, pose (m, 3)) of each keyframe.
        bias: last estimate, m. bias_over_time: (m,).
        step_seconds: (m,) or one entry. status: solves by status. objective: cost of the last window.
        last: estimate of the last window, with covariances.
    """

    estimate: TimeSeries
    bias: float
    bias_over_time: np.ndarray
    step_seconds: np.ndarray
    status: Counter[str]
    objective: float
    last: TeamEstimate


def start_pose(recording: UwbRecording, seconds: float = 1.0) -> np.ndarray:
    """Pose (3,) to start from: the position that the ranges of the first seconds give, heading zero (it is unknown).

    Raises:
        DataError: as `multilaterate`.
    """
    early = recording.time <= recording.time[0] + seconds
    anchors = np.column_stack([recording.anchors[:, :2], np.zeros(len(recording.anchors))])
    found = multilaterate(anchors[recording.anchor[early]], recording.ranges[early])
    return np.array([*found.position, 0.0])


def track_wheels(
    recording: UwbRecording,
    start: np.ndarray | None = None,
    settings: WheeledTrackerSettings | None = None,
    batch: bool = False,
    solver: str = "gauss-newton",
    **solver_settings: Any,
) -> WheeledTrack:
    """Estimate the poses of a recording with odometry, from what was measured until each keyframe.

    Args:
        start: first pose (3,); by default `start_pose`.
        batch: use all measurements for every pose (not causal), iterated to convergence.

    Raises:
        DataError: the recording has no odometry, or anchors with heights.
    """
    s = settings or WheeledTrackerSettings()
    if recording.odometry is None or recording.anchors.shape[1] != 2:
        raise DataError(
            f"{recording.name}: needs wheel odometry and anchors in the plane; use `track` without odometry"
        )
    if batch and solver in ("auto", "gauss-newton"):  # a handful of robust ranges bends the first windows strongly
        solver_settings = {"iteration_limit": 500} | solver_settings
    T, first = recording.time, start_pose(recording) if start is None else start
    smoother = _smoother(s, first, len(T) if batch else s.lag, None if batch else s.iterations, solver, solver_settings)
    moves, sigma = _moves(recording, s)
    poses, bias, seconds = np.empty((len(T), 3)), np.empty(len(T)), np.empty(len(T))
    status: Counter[str] = Counter()
    robot, began = np.array([0]), time.perf_counter()
    for k in range(len(T)):
        z = np.array([[recording.ranges[k], *recording.anchors[recording.anchor[k]]]])
        given = {"range": Readings(z, np.array([[0, 0]]))}
        if k:
            given["odometry"] = Readings(moves[k - 1 : k], robot, sigma[k - 1 : k])
        estimate = smoother.step(given, time=float(T[k]))
        poses[k], bias[k], seconds[k] = estimate.state[0], estimate.lasting["bias"][0, 0], estimate.seconds
        status[str(estimate.status)] += 1
    if batch:
        poses, seconds = estimate.window[:, 0], np.array([time.perf_counter() - began])
    return WheeledTrack(
        TimeSeries(T, poses), float(bias[-1]), bias, seconds, status, estimate.solution.objective, estimate
    )


def _moves(recording: UwbRecording, s: WheeledTrackerSettings) -> tuple[np.ndarray, np.ndarray]:
    """Relative poses (m - 1, 3) between ranges and their standard deviations; a twist holds until the next one."""
    odometry, T = recording.odometry, recording.time
    assert odometry is not None
    dt = np.diff(T)[:, None]
    at = np.clip(np.searchsorted(odometry.time, T[:-1], side="right") - 1, 0, None)
    moved = odometry.value[at] * dt
    half = moved[:, 2] / 2
    c, d = np.cos(half), np.sin(half)
    u = np.column_stack([c * moved[:, 0] - d * moved[:, 1], d * moved[:, 0] + c * moved[:, 1], moved[:, 2]])
    return u, np.array([s.speed_sigma, s.slip_sigma, s.turn_sigma]) * dt


def _smoother(
    s: WheeledTrackerSettings,
    start: np.ndarray,
    lag: int,
    iterations: int | None,
    solver: str,
    solver_settings: dict[str, Any],
) -> FixedLagSmoother:
    def predict(states: np.ndarray, given: Any) -> np.ndarray:
        return SE2.retract_array(states, given["odometry"].values)

    return FixedLagSmoother(
        SE2,
        lag,
        {
            "odometry": Kind(measurements.relative_pose, ("before", "pose"), (3,)),
            "range": Kind(biased_range, ("pose", "bias"), (1, 2), Gaussian(s.range_sigma), s.loss),
        },
        start=start,
        start_sigma=s.start_sigma,
        lasting={"bias": Lasting(Vector(1), 1, [s.bias_mean], s.bias_sigma if s.bias else FIXED)},
        predict=predict,
        iterations=iterations,
        solver=solver,
        **solver_settings,
    )
