"""Scenario ``recording``: localization of whatever a recording holds, by every method that fits (spec ``recordings``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pydantic

from localization.io.detect import open_recording
from localization.io.recording import TimeSeries, UwbRecording
from localization.io.scoring import uwb_scores
from localization.tracking.batch_track import batch_track, snapshot_track
from localization.tracking.range_tracker import RangeTrackerSettings, Track, first_position, track
from problems.bench.scenario import Outcome
from problems.errors import FormError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRACKER = ("horizon", "loss", "bias", "lag", "gps_sigma", "iterations", "height", "range_sigma", "acceleration")


class Settings(pydantic.BaseModel):
    """Settings of the scenario; those of the tracker are explained at `RangeTrackerSettings`."""

    model_config = pydantic.ConfigDict(extra="forbid")

    path: str
    trajectory: Literal["A", "B"] | None = None
    start: Literal["ranges", "truth"] = "ranges"
    horizon: int = pydantic.Field(20, ge=1, le=1000)
    loss: float = pydantic.Field(2.0, ge=0)
    bias: bool = True
    lag: float = pydantic.Field(0.2, ge=0)
    delay: float = pydantic.Field(1.0, ge=0, description="of fixed_lag, s")
    iterations: int = pydantic.Field(3, ge=0, description="per knot; 0 iterates to convergence")
    height: float = 1.0
    range_sigma: float = pydantic.Field(0.08, gt=0)
    acceleration: float = pydantic.Field(0.5, gt=0)
    gps_rate: float = pydantic.Field(0.0, ge=0, description="coarse fixes drawn around the truth, Hz; 0 for none")
    gps_sigma: float = pydantic.Field(2.0, gt=0)
    covariance: bool = False


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
        return Drawn(recording, coarse_fixes(recording, settings.gps_rate, settings.gps_sigma, rng))

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        recording, fixes = drawn.recording, drawn.fixes
        values = {key: getattr(settings, key) for key in TRACKER}
        tuned = RangeTrackerSettings(**values, delay=settings.delay if method == "fixed_lag" else 0.0)
        chosen = "gauss-newton" if solver == "auto" else solver
        start = first_position(recording, tuned)
        if settings.start == "truth" and recording.truth is not None:
            start = recording.truth.value[0, :2]
        if method == "ls":
            made = snapshot_track(recording, start, tuned)
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
            trace=made,
        )

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        from localization.plots import plot_tracks

        return plot_tracks(drawn.recording, {label: o.trace for label, o in outcomes.items()}, settings.height)


def coarse_fixes(recording: UwbRecording, rate: float, sigma: float, rng: np.random.Generator) -> TimeSeries | None:
    """Position fixes (m, 2) at `rate` (Hz): truth plus white noise of `sigma` (m); None without rate or truth."""
    truth = recording.truth
    if rate <= 0 or truth is None:
        return None
    times = np.arange(truth.time[0], truth.time[-1], 1.0 / rate)
    places = np.column_stack([np.interp(times, truth.time, truth.value[:, k]) for k in (0, 1)])
    return TimeSeries(times, places + sigma * rng.normal(size=places.shape))


def _metrics(
    recording: UwbRecording, made: Track, tuned: RangeTrackerSettings, fixes: TimeSeries | None
) -> dict[str, float | None]:
    count = len(made.estimate)
    measured = len(recording.time) + (2 * len(fixes) if fixes is not None else 0)
    out: dict[str, float | None] = dict.fromkeys(RecordingScenario.metrics)
    out |= {"objective": made.objective, "keyframes": float(count), "measurements": float(measured)}
    if recording.truth is not None:
        position = np.column_stack([made.estimate.value, np.full(count, tuned.height)])
        out["rmse_2d"] = scored = uwb_scores(recording, TimeSeries(made.estimate.time, position))["rmse_2d"]
        for method, figures in recording.figures.items():
            if f"ratio_to_{method}" in out and "rmse_2d" in figures:
                out[f"ratio_to_{method}"] = scored / figures["rmse_2d"]
    return out


def _given(**settings: Any) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if value is not None}


scenario = RecordingScenario()
