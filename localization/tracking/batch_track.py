"""All knots of a UWB recording at once (``ml``), and knot by knot without a motion model (``ls``)."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from localization.io.recording import TimeSeries, UwbRecording
from localization.tracking.multilateration import multilaterate, prepare
from localization.tracking.range_tracker import RangeTracker, RangeTrackerSettings, Track, arrivals, heights, track
from problems.solvers.base import Status


def batch_track(
    recording: UwbRecording,
    start: np.ndarray,
    settings: RangeTrackerSettings | None = None,
    fixes: TimeSeries | None = None,
    solver: str = "gauss-newton",
    **solver_settings: Any,
) -> Track:
    """The same problem as `track` with one window over the whole recording, started from the causal track.

    Not causal: every estimate uses all measurements. Arguments and errors as for `track`.
    """
    s = settings or RangeTrackerSettings()
    causal = track(recording, start, replace(s, delay=0.0), fixes)
    knots, steps = arrivals(recording, s, fixes)
    begin = time.perf_counter()
    whole = replace(s, horizon=len(knots) - 1, iterations=0, delay=0.0)
    tracker = RangeTracker(heights(recording.anchors, s), start, whole, solver, **solver_settings)
    compile_seconds = time.perf_counter() - begin
    for row, (ranges, fix) in enumerate(steps):
        tracker.enter(row, ranges, fix)
    position = causal.estimate.value - s.lag * causal.velocity
    states = np.hstack([position, causal.velocity])
    begin = time.perf_counter()
    solution = tracker.solve({"state": states, "bias": causal.bias[:, None]})
    seconds = np.array([time.perf_counter() - begin])
    states, bias = solution["state"], solution["bias"].ravel().copy()
    return Track(
        TimeSeries(knots, states[:, :2] + s.lag * states[:, 2:]),
        states[:, 2:].copy(),
        None,
        bias,
        seconds,
        compile_seconds,
        tracker.status,
        solution.iterations,
        solution.objective,
        max(solution.residuals.values()),
    )


def snapshot_track(
    recording: UwbRecording,
    start: np.ndarray,
    settings: RangeTrackerSettings | None = None,
    solver: str = "gauss-newton",
    memory: float = 0.5,
) -> Track:
    """Multilateration of the ranges of the last `memory` seconds at every knot; no motion model, no bias states.

    A knot that hears fewer than three anchors in that time keeps the last position and counts as failed.
    """
    s = settings or RangeTrackerSettings()
    knots, _ = arrivals(recording, s, None)
    anchors = heights(recording.anchors, s)
    last = np.searchsorted(recording.time, knots, side="right")
    first = np.searchsorted(recording.time, knots - memory, side="right")
    heard = [np.unique(recording.anchor[a:b]).size >= 3 for a, b in zip(first, last, strict=True)]
    compile_seconds = prepare((last - first)[heard], solver=solver)
    position, cost, iterations = np.asarray(start, dtype=float), 0.0, 0
    out, seconds, status = np.empty((len(knots), 2)), np.empty(len(knots)), Counter[str]()
    for j, (a, b) in enumerate(zip(first, last, strict=True)):
        begin = time.perf_counter()
        outcome = Status.FAILED
        if heard[j]:
            ranges = recording.ranges[a:b] - s.bias_mean * s.bias
            found = multilaterate(anchors[recording.anchor[a:b]], ranges, s.height, near=position, solver=solver)
            position, cost, outcome = found.position, found.cost, found.status
            iterations += found.iterations
        status[str(outcome)] += 1
        out[j], seconds[j] = position, time.perf_counter() - begin
    bias = np.full(len(anchors), s.bias_mean * s.bias)
    return Track(
        TimeSeries(knots, out), np.zeros_like(out), None, bias, seconds, compile_seconds, status, iterations, cost, None
    )
