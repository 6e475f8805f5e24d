"""Methods of scenario ``recording`` for UWB recordings: one tag, ranges to anchors (spec ``recordings`` 1 and 2)."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.io.poses import Poses
from localization.io.recording import TimeSeries, UwbRecording
from localization.io.scoring import scoring_window, uwb_scores
from localization.tracking.batch_track import batch_track, snapshot_track
from localization.tracking.range_tracker import RangeTrackerSettings, Track, first_position, track
from problems.bench.scenario import Outcome
from problems.errors import DataError, ModelWarning, SettingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from localization.scenarios.recording import Settings

TRACKER = (
    "horizon", "period", "acceleration", "range_sigma", "loss", "height", "bias", "bias_mean", "bias_sigma", "lag",
    "gps_sigma", "iterations", "capacity",
)  # fmt: skip


class _OneTag:
    """What all methods of a recording with one tag have in common."""

    @staticmethod
    def plot(recording: UwbRecording, traces: dict[str, Any]) -> Figure:
        from localization.plots import plot_tracks

        return plot_tracks(recording, traces)

    @staticmethod
    def tracks(recording: UwbRecording, poses: Poses) -> np.ndarray:
        """One trajectory."""
        del recording
        return np.full(len(poses), "tag")


class WheelMethods(_OneTag):
    """A tag on a robot with wheel odometry and anchors in the plane (labyrinth folders); see `wheeled_tracker`."""

    what = "a UWB recording with wheel odometry"
    methods = ("mhe", "ml")
    settings = ("horizon", "bias", "odometry", "start", "covariance")
    outputs = (".csv", ".tum")

    @classmethod
    def possible(cls, recording: UwbRecording) -> tuple[str, ...]:
        """Methods that fit."""
        del recording
        return cls.methods

    @staticmethod
    def prepare(settings: Settings, recording: UwbRecording, rng: np.random.Generator) -> None:
        """Raises SettingError for a start that needs truth which is not there."""
        del rng
        if settings.start == "truth" and recording.truth is None:
            raise SettingError(f"{settings.path}: start=truth needs truth, which this recording does not have")

    @staticmethod
    def run(settings: Settings, method: str, solver: str, recording: UwbRecording, prepared: None) -> Outcome:
        from localization.tracking.wheeled_tracker import WheeledTrackerSettings, track_wheels

        del prepared
        start = None
        if settings.start == "truth":
            assert recording.truth is not None
            start = np.r_[recording.truth.value[0, :2], 0.0]
        elif settings.start != "ranges":
            start = np.r_[settings.start, 0.0]
        tuned = WheeledTrackerSettings(lag=settings.horizon, bias=settings.bias)
        made = track_wheels(
            recording, start, tuned, batch=method == "ml", solver="gauss-newton" if solver == "auto" else solver
        )
        metrics: dict[str, float | None] = {
            "objective": made.objective, "keyframes": float(len(made.estimate)),
            "measurements": float(len(recording.time)),
        }  # fmt: skip
        if recording.truth is not None:
            position = TimeSeries(made.estimate.time, made.estimate.value[:, :2])
            metrics["rmse_2d"] = uwb_scores(recording, position)["rmse_2d"]
        return Outcome(
            metrics=metrics,
            options={"prior": "filter", "horizon": "all" if method == "ml" else tuned.lag, "bias": made.bias},
            times={"solve": float(made.step_seconds.sum())},
            step_seconds=made.step_seconds,
            status=made.status,
            trace=made,
        )

    @staticmethod
    def poses(recording: UwbRecording, made: Any) -> Poses:
        """Poses with the recording's stamps."""
        count, value = len(made.estimate), made.estimate.value
        stamps = recording.start * 1e-9 + made.estimate.time
        return Poses(stamps, np.full(count, "tag"), value[:, :2], value[:, 2:])


class UwbMethods(_OneTag):
    """See the module."""

    what = "a UWB recording"
    methods = ("mhe", "fixed_lag", "ls", "ml")
    settings = (*TRACKER, "trajectory", "start", "delay", "gps_rate", "covariance", "odometry")
    outputs = (".csv", ".tum")

    @classmethod
    def possible(cls, recording: UwbRecording) -> tuple[str, ...]:
        """Methods that fit."""
        del recording
        return cls.methods

    @staticmethod
    def prepare(settings: Settings, recording: UwbRecording, rng: np.random.Generator) -> TimeSeries | None:
        """Coarse fixes; raises where the settings need truth that is not there."""
        if recording.truth is None and (settings.start == "truth" or settings.gps_rate > 0):
            key = "start=truth" if settings.start == "truth" else "gps_rate"
            raise SettingError(f"{settings.path}: {key} needs truth, which this recording does not have")
        if settings.trajectory is not None and recording.truth is not None:
            scoring_window(recording)  # the other trajectory is noticed before any work
        return coarse_fixes(recording, settings.gps_rate, settings.gps_sigma, rng)

    @staticmethod
    def run(settings: Settings, method: str, solver: str, recording: UwbRecording, fixes: TimeSeries | None) -> Outcome:
        values = {key: getattr(settings, key) for key in TRACKER}
        tuned = RangeTrackerSettings(**values, delay=settings.delay if method == "fixed_lag" else 0.0)
        chosen = "gauss-newton" if solver == "auto" else solver
        start = _start(settings, recording, tuned)
        if method == "ls":
            made = snapshot_track(recording, start, tuned, chosen)
        elif method == "ml":
            made = batch_track(recording, start, tuned, fixes, chosen)
        else:
            made = track(recording, start, tuned, fixes, chosen, covariances=settings.covariance)
        return Outcome(
            metrics=_metrics(recording, made, tuned, fixes),
            options={"prior": "filter" if method in ("mhe", "fixed_lag") else "none", "delay": tuned.delay},
            times={"compile": made.compile_seconds, "solve": float(made.step_seconds.sum())},
            step_seconds=made.step_seconds,
            status=made.status,
            iterations=made.iterations,
            residual=made.residual,
            trace=made,
        )

    @staticmethod
    def poses(recording: UwbRecording, made: Track) -> Poses:
        """Poses of a planar track with the recording's stamps; a tag has no heading."""
        count = len(made.estimate)
        covariance = None
        if made.covariance is not None:
            covariance = np.full((count, 3, 3), np.nan)
            covariance[:, :2, :2] = made.covariance
        stamps = recording.start * 1e-9 + made.estimate.time
        return Poses(stamps, np.full(count, "tag"), made.estimate.value, np.full((count, 1), np.nan), covariance)


def coarse_fixes(recording: UwbRecording, rate: float, sigma: float, rng: np.random.Generator) -> TimeSeries | None:
    """Position fixes (m, 2) at `rate` (Hz): truth plus white noise of `sigma` (m); None without rate or truth."""
    truth = recording.truth
    if rate <= 0 or truth is None:
        return None
    first, last = max(truth.time[0], recording.time[0]), min(truth.time[-1], recording.time[-1])
    times = np.arange(first, last, 1.0 / rate)
    places = np.column_stack([np.interp(times, truth.time, truth.value[:, k]) for k in (0, 1)])
    return TimeSeries(times, places + sigma * rng.normal(size=places.shape))


def _start(settings: Settings, recording: UwbRecording, tuned: RangeTrackerSettings) -> np.ndarray:
    if settings.start == "ranges":
        return first_position(recording, tuned)
    if settings.start == "truth":
        assert recording.truth is not None
        return recording.truth.value[0, :2]
    return np.array(settings.start)


def _metrics(
    recording: UwbRecording, made: Track, tuned: RangeTrackerSettings, fixes: TimeSeries | None
) -> dict[str, float | None]:
    count = len(made.estimate)
    measured = len(recording.time) + (2 * len(fixes) if fixes is not None else 0)
    out: dict[str, float | None] = {
        "objective": made.objective,
        "keyframes": float(count),
        "measurements": float(measured),
    }
    if recording.truth is None:
        return out
    position = np.column_stack([made.estimate.value, np.full(count, tuned.height)])
    try:
        out["rmse_2d"] = scored = uwb_scores(recording, TimeSeries(made.estimate.time, position))["rmse_2d"]
    except DataError as error:  # the track is worth having without a score
        warnings.warn(f"not scored: {error}", ModelWarning, stacklevel=2)
        return out
    if recording.figures and recording.trajectory is None:
        warnings.warn(
            f"{recording.name}: scored over all of its truth and not compared with the published figures, which count "
            "inside a window; choose it by --set trajectory=A or B",
            ModelWarning,
            stacklevel=2,
        )
        return out
    for method, figures in recording.figures.items():
        if method in ("ls", "eskf") and "rmse_2d" in figures:
            out[f"ratio_to_{method}"] = scored / figures["rmse_2d"]
    return out
