"""Causal localization of a team from odometry and sightings of known landmarks and of each other (MRCLAM folders).

Keyframes come at a fixed period and hold the poses of all robots. A sighting is used at its own time: the motion that
odometry gives between keyframe and sighting is part of the reading. Odometry of these robots is scaled (spec
``recordings`` 4), so two scales per robot, of speed and of turn rate, are estimated along with the poses.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from localization.io.recording import TeamRecording, TimeSeries
from localization.smoothing import FixedLagSmoother, Kind, Lasting, Readings
from problems.errors import DataError, SettingError
from problems.noise import L2, Cauchy, Gaussian
from problems.spaces import SE2, Vector, wrap


@dataclass(frozen=True)
class TeamTrackerSettings:
    """One parameter set for a kind of recording.

    Attributes:
        lag: keyframes in the window before the newest one.
        period: seconds between keyframes.
        distance_sigma: of odometry, m per square root of a metre driven; `drift_sigma`: m per sqrt(s), also at rest.
        turn_sigma: rad per square root of a radian turned; `turn_drift_sigma`: rad per sqrt(s).
        range_sigma, bearing_sigma: of sightings, m and rad.
        loss: scale of the Cauchy loss on sightings, in sigmas; 0 for plain least squares.
        speed_scale, turn_scale: expected true over measured speed and turn rate; `scale_sigma` of both.
        sight_robots: use what robots see of each other.
        start_sigma: of the first poses (m, m, rad).
        iterations: Gauss-Newton steps per keyframe.
        capacity: sightings of landmarks by one robot that a keyframe holds; `pair_capacity`: of one robot by another.

    Raises:
        SettingError: a value that has no meaning.
    """

    lag: int = 2
    period: float = 0.5
    distance_sigma: float = 0.05
    drift_sigma: float = 0.02
    turn_sigma: float = 0.1
    turn_drift_sigma: float = 0.02
    range_sigma: float = 0.15
    bearing_sigma: float = 0.05
    loss: float = 1.0
    speed_scale: float = 1.0
    turn_scale: float = 1.0
    scale_sigma: float = 0.1
    sight_robots: bool = True
    start_sigma: tuple[float, float, float] = (0.3, 0.3, 0.1)
    iterations: int = 1
    capacity: int = 10
    pair_capacity: int = 2

    def __post_init__(self) -> None:
        for name in ("period", "drift_sigma", "turn_drift_sigma", "range_sigma", "bearing_sigma", "scale_sigma"):
            if not getattr(self, name) > 0:
                raise SettingError(f"{name} must be positive, got {getattr(self, name)!r}")
        for name in ("loss", "distance_sigma", "turn_sigma"):
            if not getattr(self, name) >= 0:
                raise SettingError(f"{name} must not be negative, got {getattr(self, name)!r}")


def _scaled(u: Any, scale: Any) -> Any:
    return SE2(ca.vertcat(scale[0] * u[0], scale[0] * u[1], scale[1] * u[2]))


def odometry(before: Any, pose: Any, scale: Any, u: Any) -> Any:
    """Relative pose u (3,) of odometry whose speed and turn rate are to be multiplied by `scale` (2,)."""
    return _scaled(u, scale).between(before.between(pose)).local()


def _seen(pose: Any, target: Any, z: Any) -> Any:
    body = pose.transform_to(target)
    return ca.vertcat(wrap(ca.atan2(body[1], body[0]) - z[1]), ca.norm_2(body) - z[0])


def sees_mark(pose: Any, scale: Any, z: Any, u: Any, mark: Any) -> Any:
    """Bearing (rad) and range (m) error of z = (range, bearing) of a known `mark` (2,), taken u after the keyframe."""
    return _seen(pose @ _scaled(u, scale), mark, z)


def sees_robot(pose: Any, other: Any, scale: Any, z: Any, u: Any, v: Any) -> Any:
    """As `sees_mark`, of another robot that has moved by v since the keyframe."""
    return _seen(pose @ _scaled(u, scale), (other @ SE2(v)).translation, z)


class DeadReckoning:
    """Poses by odometry alone, held between its stamps.

    Args:
        series: forward velocity (m/s) and turn rate (rad/s) over time.
    """

    def __init__(self, series: TimeSeries) -> None:
        self._time, (self._v, self._w) = series.time, series.value.T
        dt = np.diff(self._time, append=self._time[-1])
        turned = np.concatenate([[0.0], np.cumsum(self._w * dt)])
        middle = turned[:-1] + self._w * dt / 2
        path = (self._v * dt)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
        self._heading = turned[:-1]
        self._place = np.vstack([np.zeros(2), np.cumsum(path, axis=0)[:-1]])
        self._driven = np.concatenate([[0.0], np.cumsum(np.abs(self._v) * dt)[:-1]])
        self._spun = np.concatenate([[0.0], np.cumsum(np.abs(self._w) * dt)[:-1]])

    def at(self, when: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses (m, 3) since the start, metres driven (m,) and radians turned (m,), by what was measured until then."""
        k = np.searchsorted(self._time, when, side="right") - 1
        dt, known = when - self._time[k], k >= 0
        dt = np.where(known, dt, 0.0)
        v, w = np.where(known, self._v[k], 0.0), np.where(known, self._w[k], 0.0)
        k = np.maximum(k, 0)
        middle = self._heading[k] + w * dt / 2
        place = self._place[k] + (v * dt)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
        poses = np.column_stack([place, self._heading[k] + w * dt])
        return poses, self._driven[k] + np.abs(v) * dt, self._spun[k] + np.abs(w) * dt


@dataclass(frozen=True, eq=False)
class TeamTrack:
    """A causal track of a team.

    Attributes:
        time: (k,) of the keyframes, s from the recording's start.
        poses: (k, robots, 3), each estimated with what was measured until its keyframe.
        covariance: (k, robots, 3, 3) in the body frame, or None.
        scale: (robots, 2) last scales of speed and turn rate.
        step_seconds: (k,). compile_seconds: of the window. status: solves by status.
        dropped: sightings that found no place. objective: cost of the last window.
    """

    time: np.ndarray
    poses: np.ndarray
    covariance: np.ndarray | None
    scale: np.ndarray
    step_seconds: np.ndarray
    compile_seconds: float
    status: Counter[str]
    dropped: int
    objective: float


def track_team(
    recording: TeamRecording,
    start: np.ndarray,
    settings: TeamTrackerSettings | None = None,
    solver: str = "gauss-newton",
    covariances: bool = False,
    **solver_settings: Any,
) -> TeamTrack:
    """Run a fixed-lag smoother over a recording with known landmarks.

    Args:
        start: (robots, 3) poses when the last robot's odometry begins; see `track_start`.
        covariances: also compute the covariance of every pose.

    Raises:
        DataError: a start of another shape.
    """
    s = settings or TeamTrackerSettings()
    robots = len(recording.robots)
    if np.shape(start) != (robots, 3):
        raise DataError(f"{recording.name}: start is one pose (x, y, theta) per robot, got shape {np.shape(start)}")
    reckoned = [DeadReckoning(series) for series in recording.odometry]
    begin, end = track_start(recording), max(series.time[-1] for series in recording.odometry)
    knots = begin + s.period * np.arange(int((end - begin) / s.period) + 1)
    states = [one.at(knots) for one in reckoned]
    dead = np.stack([pose for pose, _, _ in states], axis=1)  # (k, robots, 3)
    began = time.perf_counter()
    smoother = _smoother(s, robots, start, solver, solver_settings)
    compile_seconds = time.perf_counter() - began
    sighted = _sightings(recording, s, reckoned, knots, dead)
    poses, seconds, status, dropped = np.empty((len(knots), robots, 3)), np.empty(len(knots)), Counter[str](), 0
    P = np.empty((len(knots), robots, 3, 3)) if covariances else None
    each = np.arange(robots)
    for k in range(len(knots)):
        given = dict(sighted[k])
        if k:
            u = SE2.local_array(dead[k - 1], dead[k])
            driven = np.array([d[k] - d[k - 1] for _, d, _ in states])
            spun = np.array([t[k] - t[k - 1] for _, _, t in states])
            along = np.sqrt(s.distance_sigma**2 * driven + s.drift_sigma**2 * s.period)
            turn = np.sqrt(s.turn_sigma**2 * spun + s.turn_drift_sigma**2 * s.period)
            given["odometry"] = Readings(u, each, np.column_stack([along, along, turn]))
        estimate = smoother.step(given, time=float(knots[k]))
        poses[k], seconds[k] = estimate.state, estimate.seconds
        status[str(estimate.status)] += 1
        dropped += estimate.dropped
        if P is not None:
            joint = estimate.covariance.reshape(robots, 3, robots, 3)
            P[k] = joint[each, :, each]
    return TeamTrack(
        knots,
        poses,
        P,
        estimate.lasting["scale"],
        seconds,
        compile_seconds,
        status,
        dropped,
        estimate.solution.objective,
    )


def track_start(recording: TeamRecording) -> float:
    """When the odometry of all robots has begun, s."""
    return float(max(series.time[0] for series in recording.odometry))


def _smoother(
    s: TeamTrackerSettings, robots: int, start: np.ndarray, solver: str, solver_settings: dict[str, Any]
) -> FixedLagSmoother:
    noise = Gaussian(sigma=[s.bearing_sigma, s.range_sigma])
    loss = Cauchy(s.loss) if s.loss > 0 else L2()
    kinds = {
        "odometry": Kind(odometry, ("before", "pose", "scale"), (3,)),
        "marks": Kind(sees_mark, ("pose", "scale"), (2, 3, 2), noise, loss, capacity=s.capacity),
    }
    if s.sight_robots and robots > 1:
        kinds["robots"] = Kind(sees_robot, ("pose", "other", "scale"), (2, 3, 3), noise, loss, capacity=s.pair_capacity)
    scale = Lasting(Vector(2), robots, [s.speed_scale, s.turn_scale], s.scale_sigma, own=True)

    def predict(states: np.ndarray, given: Any) -> np.ndarray:
        return SE2.retract_array(states, given["odometry"].values)

    return FixedLagSmoother(
        SE2,
        s.lag,
        kinds,
        start=start,
        start_sigma=s.start_sigma,
        robots=robots,
        lasting={"scale": scale},
        predict=predict,
        iterations=s.iterations,
        solver=solver,
        **solver_settings,
    )


def _sightings(
    recording: TeamRecording,
    s: TeamTrackerSettings,
    reckoned: list[DeadReckoning],
    knots: np.ndarray,
    dead: np.ndarray,
) -> list[dict[str, Readings]]:
    """Readings of what was seen in the period that ends at each keyframe."""
    robots, count = len(reckoned), len(knots)
    when = recording.sighting_time
    owner = np.ceil((when - knots[0]) / s.period - 1e-9).astype(int)
    moved = np.empty((len(when), robots, 3))
    inside = (owner >= 0) & (owner < count)
    k = np.where(inside, owner, 0)
    for robot, one in enumerate(reckoned):
        moved[:, robot] = SE2.local_array(dead[k, robot], one.at(when)[0])
    out: list[dict[str, Readings]] = [{} for _ in knots]
    mark = recording.subject >= robots
    own = moved[np.arange(len(when)), recording.observer]
    if s.sight_robots and robots > 1:
        rows = np.flatnonzero(inside & ~mark)
        values = np.hstack([recording.range_bearing[rows], own[rows], moved[rows, recording.subject[rows]]])
        at = np.column_stack([recording.observer[rows], recording.subject[rows]])
        _share(out, "robots", owner[rows], values, at)
    rows = np.flatnonzero(inside & mark)
    places = recording.landmarks[recording.subject[rows] - robots]
    values = np.hstack([recording.range_bearing[rows], own[rows], places])
    _share(out, "marks", owner[rows], values, recording.observer[rows, None])
    return out


def _share(out: list[dict[str, Readings]], kind: str, owner: np.ndarray, values: np.ndarray, at: np.ndarray) -> None:
    edges = np.searchsorted(owner, np.arange(len(out) + 1))  # sightings are sorted by time
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        if b > a:
            out[k][kind] = Readings(values[a:b], at[a:b])


def team_errors(recording: TeamRecording, track: TeamTrack) -> np.ndarray:
    """(robots,) root mean square horizontal distance (m) of all keyframes to truth interpolated to them.

    Raises:
        DataError: the recording has no truth.
    """
    if recording.truth is None:
        raise DataError(f"{recording.name}: scoring needs truth, and the recording has none")
    errors = []
    for robot, truth in enumerate(recording.truth):
        inside = (track.time >= truth.time[0]) & (track.time <= truth.time[-1])
        when = track.time[inside]
        place = np.column_stack([np.interp(when, truth.time, truth.value[:, k]) for k in (0, 1)])
        errors.append(np.sqrt(np.mean(np.sum((track.poses[inside, robot, :2] - place) ** 2, axis=1))))
    return np.array(errors)


def true_poses(recording: TeamRecording, when: float) -> np.ndarray:
    """(robots, 3) true poses at a time, for starts and tests.

    Raises:
        DataError: the recording has no truth.
    """
    if recording.truth is None:
        raise DataError(f"{recording.name}: it has no truth to start from; give start poses")
    return np.array(
        [
            [
                *(np.interp(when, t.time, t.value[:, k]) for k in (0, 1)),
                wrap(np.interp(when, t.time, np.unwrap(t.value[:, 2]))),
            ]
            for t in recording.truth
        ]
    )
