"""Scenario ``recording``: localization of what a recording holds, by every method that fits (spec ``recordings``)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pydantic

from localization.io.detect import open_recording
from localization.io.recording import TimeSeries, UwbRecording
from localization.io.scoring import scoring_window, uwb_scores
from localization.tracking.batch_track import batch_track, snapshot_track
from localization.tracking.range_tracker import RangeTrackerSettings, Track, first_position, track
from problems.bench.scenario import Outcome
from problems.errors import DataError, FormError, ModelWarning, SettingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRACKER = (
    "horizon", "period", "acceleration", "range_sigma", "loss", "height", "bias", "bias_mean", "bias_sigma", "lag",
    "gps_sigma", "iterations", "capacity",
)  # fmt: skip


class Settings(pydantic.BaseModel):
    """Settings of the scenario; those of the tracker are explained at `RangeTrackerSettings`."""

    model_config = pydantic.ConfigDict(extra="forbid")

    path: str = pydantic.Field(description="folder or file in a known layout")
    trajectory: Literal["A", "B"] | None = pydantic.Field(
        None, description="published scoring window; by default from the folder's name, else the whole truth"
    )
    start: Literal["ranges", "truth"] | tuple[float, float] = pydantic.Field(
        "ranges", description="first position: from the first ranges, from truth, or [x, y] in m"
    )
    horizon: int = pydantic.Field(20, ge=1, le=1000, description="transitions in the window")
    period: float = pydantic.Field(0.1, gt=0, description="between knots, s")
    acceleration: float = pydantic.Field(0.5, gt=0, description="spectral density of the acceleration, m^2/s^3")
    range_sigma: float = pydantic.Field(0.08, gt=0, description="of a range, m")
    loss: float = pydantic.Field(2.0, ge=0, description="scale of the Cauchy loss on ranges, sigmas; 0 for L2")
    height: float = pydantic.Field(1.0, description="of the tag in the anchors' frame, m")
    bias: bool = pydantic.Field(True, description="estimate one range bias per anchor (mhe, fixed_lag, ml)")
    bias_mean: float = pydantic.Field(0.10, description="expected bias, m; not used with bias=off")
    bias_sigma: float = pydantic.Field(0.05, gt=0, description="of the biases around it, m")
    lag: float = pydantic.Field(0.2, ge=0, description="latency by which positions are advanced, s")
    delay: float = pydantic.Field(1.0, ge=0, description="of fixed_lag, s")
    iterations: int = pydantic.Field(
        3, ge=0, description="gauss-newton steps per knot; 0, and any other solver, iterates to convergence"
    )
    capacity: int = pydantic.Field(2, ge=1, description="ranges of one anchor that a knot can hold")
    gps_rate: float = pydantic.Field(0.0, ge=0, description="coarse fixes drawn around the truth, Hz; 0 for none")
    gps_sigma: float = pydantic.Field(2.0, gt=0, description="of those fixes, m per axis")
    covariance: bool = pydantic.Field(False, description="compute the covariance of every position (mhe, fixed_lag)")

    @pydantic.model_validator(mode="after")
    def _one_fix_per_knot(self) -> Settings:
        if self.gps_rate * self.period > 1:
            raise ValueError(f"gps_rate {self.gps_rate:g} Hz: a knot every {self.period:g} s holds one fix")
        return self


@dataclass(frozen=True, eq=False)
class Drawn:
    """A recording and the coarse fixes drawn for it."""

    recording: UwbRecording
    fixes: TimeSeries | None


class RecordingScenario:
    """See the module."""

    name = "recording"
    source = "spec recordings 1 and 6"
    methods = ("mhe", "fixed_lag", "ls", "ml")
    metrics = ("rmse_2d", "ratio_to_eskf", "ratio_to_ls", "objective", "keyframes", "measurements")
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        recording = open_recording(settings.path, **_given(trajectory=settings.trajectory))
        if not isinstance(recording, UwbRecording):
            raise FormError(
                f"{settings.path}: read as {type(recording).__name__}; only UWB recordings can be localized so far"
            )
        if recording.truth is None and (settings.start == "truth" or settings.gps_rate > 0):
            key = "start=truth" if settings.start == "truth" else "gps_rate"
            raise SettingError(f"{settings.path}: {key} needs truth, which this recording does not have")
        if settings.trajectory is not None and recording.truth is not None:
            scoring_window(recording)  # the other trajectory is noticed before any work
        return Drawn(recording, coarse_fixes(recording, settings.gps_rate, settings.gps_sigma, rng))

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        recording, fixes = drawn.recording, drawn.fixes
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

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        from localization.plots import plot_tracks

        return plot_tracks(drawn.recording, {label: o.trace for label, o in outcomes.items()})


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
    out: dict[str, float | None] = dict.fromkeys(RecordingScenario.metrics)
    out |= {"objective": made.objective, "keyframes": float(count), "measurements": float(measured)}
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
        if f"ratio_to_{method}" in out and "rmse_2d" in figures:
            out[f"ratio_to_{method}"] = scored / figures["rmse_2d"]
    return out


def _given(**settings: Any) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if value is not None}


scenario = RecordingScenario()
