"""Pictures of localized recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from localization.io.recording import UwbRecording
from localization.tracking.range_tracker import Track

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")  # told apart without colour vision
STYLES = ("-", "--", "-.", ":", "-")


def plot_tracks(recording: UwbRecording, tracks: Mapping[str, Track], height: float) -> Figure:
    """Anchors, truth and tracks from above; horizontal error over time below.

    Args:
        tracks: by label.
        height: of the tag, m (title only).
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 8), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=[2, 1])
    truth = recording.truth
    if truth is not None:
        above.plot(truth.value[:, 0], truth.value[:, 1], color="0.6", lw=4, label="truth", solid_capstyle="round")
    peaks = []
    for k, (label, made) in enumerate(tracks.items()):
        color, style = COLORS[k % len(COLORS)], STYLES[k % len(STYLES)]
        xy = made.estimate.value
        above.plot(xy[:, 0], xy[:, 1], color=color, ls=style, lw=1.2, label=label)
        if truth is not None:
            time = made.estimate.time
            inside = (time >= truth.time[0]) & (time <= truth.time[-1])
            at = np.column_stack([np.interp(time[inside], truth.time, truth.value[:, j]) for j in (0, 1)])
            error = np.linalg.norm(xy[inside] - at, axis=1)
            peaks.append(float(error.max()))
            below.plot(time[inside], error, color=color, ls=style, lw=1.0, label=label)
    above.plot(recording.anchors[:, 0], recording.anchors[:, 1], "k^", ms=8, label="anchors")
    shown = np.vstack(
        [xy for xy in [recording.anchors[:, :2], None if truth is None else truth.value[:, :2]] if xy is not None]
    )
    if truth is not None:  # a track that left the scene must not hide the others
        low, high = shown.min(axis=0) - 5, shown.max(axis=0) + 5
        above.set_xlim(low[0], high[0])
        above.set_ylim(low[1], high[1])
    above.set_aspect("equal", adjustable="box")
    above.set_xlabel("x (m)")
    above.set_ylabel("y (m)")
    above.set_title(f"{recording.name}: {len(recording.time)} ranges to {len(recording.anchors)} anchors")
    above.legend(loc="best", fontsize=9)
    below.set_xlabel("time (s)")
    below.set_ylabel("horizontal error (m)")
    below.set_ylim(0, 3 * min(peaks) if peaks else None)  # outbreaks of a bad track must not flatten the others
    below.grid(alpha=0.3)
    return figure
