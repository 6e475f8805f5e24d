"""Methods of scenario ``recording`` for teams with known landmarks (MRCLAM folders; spec ``recordings`` 4)."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.io.poses import Poses
from localization.io.recording import TeamRecording
from localization.joining import fit_frame
from problems.bench.scenario import Outcome
from problems.errors import DataError, ModelWarning, SettingError
from problems.spaces import SE2

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from localization.scenarios.recording import Settings

ENOUGH = 6  # sightings of at least two landmarks that give a start
DRIFT = 0.2  # m, of a robot by odometry alone until then


class TeamMethods:
    """See the module."""

    what = "a team recording"
    methods = ("mhe",)
    settings = ("start", "sight_robots", "team_horizon", "team_period", "team_loss", "covariance")
    outputs = (".csv", ".tum")

    @classmethod
    def possible(cls, recording: TeamRecording) -> tuple[str, ...]:
        """Methods that fit."""
        del recording
        return cls.methods

    @staticmethod
    def prepare(settings: Settings, recording: TeamRecording, rng: np.random.Generator) -> None:
        """Raises SettingError for a start that this recording cannot have."""
        del rng
        if settings.start not in ("ranges", "truth"):
            raise SettingError(f"{settings.path}: start of a team is 'ranges' or 'truth', got {settings.start!r}")
        if settings.start == "truth" and recording.truth is None:
            raise SettingError(f"{settings.path}: start=truth needs truth, which this recording does not have")

    @staticmethod
    def run(settings: Settings, method: str, solver: str, recording: TeamRecording, prepared: None) -> Outcome:
        from localization.tracking.team_tracker import (
            TeamTrackerSettings,
            team_errors,
            track_start,
            track_team,
            true_poses,
        )

        del method, prepared
        tuned = TeamTrackerSettings(
            lag=settings.team_horizon, period=settings.team_period, loss=settings.team_loss,
            sight_robots=settings.sight_robots,
        )  # fmt: skip
        begin = track_start(recording)
        start = true_poses(recording, begin) if settings.start == "truth" else sighted_start(recording, begin)
        called = "gauss-newton" if solver == "auto" else solver
        made = track_team(recording, start, tuned, called, covariances=settings.covariance)
        if made.dropped:
            warnings.warn(f"{recording.name}: {made.dropped} sightings found no place", ModelWarning, stacklevel=2)
        metrics: dict[str, float | None] = {
            "objective": made.objective, "keyframes": float(made.time.size * len(recording.robots)),
            "measurements": float(len(recording.sighting_time)),
        }  # fmt: skip
        options: dict[str, Any] = {"prior": "filter", "start": settings.start, "unknown_barcodes": recording.dropped}
        if recording.truth is not None:
            errors = team_errors(recording, made)
            metrics["rmse_2d"] = float(errors.mean())
            options["rmse_2d_by_robot"] = {
                str(robot): float(error) for robot, error in zip(recording.robots, errors, strict=True)
            }
        return Outcome(
            metrics=metrics,
            options=options,
            times={"compile": made.compile_seconds, "solve": float(made.step_seconds.sum())},
            step_seconds=made.step_seconds,
            status=made.status,
            trace=made,
        )

    @staticmethod
    def plot(recording: TeamRecording, traces: dict[str, Any]) -> Figure:
        from localization.graph_plots import plot_team_tracks

        return plot_team_tracks(recording, traces)

    @staticmethod
    def tracks(recording: TeamRecording, poses: Poses) -> np.ndarray:
        """A trajectory per robot."""
        del recording
        return poses.keys

    @staticmethod
    def poses(recording: TeamRecording, made: Any) -> Poses:
        """Poses of all robots, robot after robot, with the recording's stamps; covariances in the world frame."""
        robots = len(recording.robots)
        stamps = np.tile(recording.start + made.time, robots)
        values = made.poses.swapaxes(0, 1).reshape(-1, 3)
        covariance = None
        if made.covariance is not None:
            c, s = np.cos(values[:, 2]), np.sin(values[:, 2])
            turn = np.tile(np.eye(3), (len(values), 1, 1))
            turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
            body = made.covariance.swapaxes(0, 1).reshape(-1, 3, 3)
            covariance = turn @ body @ turn.swapaxes(1, 2)
        keys = np.repeat([f"robot{robot}" for robot in recording.robots], made.time.size)
        return Poses(stamps, keys, values[:, :2], values[:, 2:], covariance)


def sighted_start(recording: TeamRecording, begin: float) -> np.ndarray:
    """Poses (robots, 3) at a time, from the next sightings of known landmarks and odometry in between.

    The first seconds of a track that begins there are not causal: it knows what is seen in them.

    Raises:
        DataError: a robot that sees fewer than two landmarks.
    """
    from localization.tracking.team_tracker import DeadReckoning

    robots, out = len(recording.robots), []
    for robot in range(robots):
        rows = np.flatnonzero(
            (recording.observer == robot) & (recording.subject >= robots) & (recording.sighting_time >= begin)
        )
        kinds = [len(np.unique(recording.subject[rows[: k + 1]])) for k in range(min(len(rows), 500))]
        last = next((k for k, count in enumerate(kinds) if count >= 2 and k + 1 >= ENOUGH), None)
        if last is None:
            raise DataError(
                f"{recording.name}: robot {recording.robots[robot]} sees fewer than two landmarks, which leaves its "
                "start open; give --set start=truth where there is truth"
            )
        rows = rows[: last + 1]
        reckoned = DeadReckoning(recording.odometry[robot])
        first = reckoned.at(np.array([begin]))[0]
        moved = SE2.local_array(np.broadcast_to(first, (len(rows), 3)), reckoned.at(recording.sighting_time[rows])[0])
        distance, bearing = recording.range_bearing[rows].T
        away = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.zeros(len(rows))])
        own = SE2.retract_array(moved, away)[:, :2]
        out.append(fit_frame(own, recording.landmarks[recording.subject[rows] - robots], DRIFT)[0])
    return np.array(out)
