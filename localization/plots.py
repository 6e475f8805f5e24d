"""Pictures of localized recordings and teams."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.ellipses import draw_ellipses
from localization.io.recording import UwbRecording
from localization.lattice import Fence, Measurements
from localization.tracking.range_tracker import Track
from problems.display import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")  # told apart without colour vision
STYLES = ("-", "--", "-.", ":", "-")
MARKERS = ("o", "s", "D", "^", "v")
ELLIPSES = 40  # knots of a track that get one


def plot_tracks(recording: UwbRecording, tracks: Mapping[str, Track]) -> Figure:
    """Anchors, truth and tracks from above, with 95 % ellipses where a track has covariances; where there is truth,
    horizontal error over time below.

    Args:
        tracks: by label.
    """
    truth = recording.truth
    figure = new_figure(figsize=(10, 8 if truth is not None else 5.5), layout="constrained")
    if truth is not None:
        above, below = figure.subplots(2, 1, height_ratios=[2, 1])
        above.plot(truth.value[:, 0], truth.value[:, 1], color="0.6", lw=4, label="truth", solid_capstyle="round")
    else:  # nothing to compare with
        above, below = figure.subplots(), None
    peaks = []
    for k, (label, made) in enumerate(tracks.items()):
        color, style = COLORS[k % len(COLORS)], STYLES[k % len(STYLES)]
        xy = made.estimate.value[:, :2]
        above.plot(xy[:, 0], xy[:, 1], color=color, ls=style, lw=1.2, label=label)
        covariance = getattr(made, "covariance", None)  # tracks with wheel odometry have none
        if covariance is not None:
            chosen = np.unique(np.linspace(0, len(xy) - 1, ELLIPSES).astype(int))
            draw_ellipses(above, xy[chosen], covariance[chosen], color)
        if truth is not None and below is not None:
            time = made.estimate.time
            inside = (time >= truth.time[0]) & (time <= truth.time[-1])
            if not inside.any():
                continue
            at = np.column_stack([np.interp(time[inside], truth.time, truth.value[:, j]) for j in (0, 1)])
            error = np.linalg.norm(xy[inside] - at, axis=1)
            peaks.append(float(error.max()))
            below.plot(time[inside], error, color=color, ls=style, lw=1.0, label=label)
    above.plot(recording.anchors[:, 0], recording.anchors[:, 1], "k^", ms=8, label="anchors")
    if truth is not None:  # a track that left the scene must not hide the others
        shown = np.vstack([recording.anchors[:, :2], truth.value[:, :2]])
        margin = 0.1 * np.ptp(shown, axis=0).max()
        low, high = shown.min(axis=0) - margin, shown.max(axis=0) + margin
        above.set_xlim(low[0], high[0])
        above.set_ylim(low[1], high[1])
    above.set_aspect("equal", adjustable="box")
    above.set_xlabel("x (m)")
    above.set_ylabel("y (m)")
    above.set_title(f"{recording.name}: {len(recording.time)} ranges to {len(recording.anchors)} anchors")
    above.legend(loc="best", fontsize=9)
    if below is not None:
        below.set_xlabel("time (s)")
        below.set_ylabel("horizontal error (m)")
        if peaks:  # outbreaks of a bad track must not flatten the others
            below.set_ylim(0, min(3 * min(peaks), 1.05 * max(peaks)))
        below.grid(alpha=0.3)
    return figure


def plot_team(
    team: Measurements, estimates: Mapping[str, tuple[np.ndarray, np.ndarray | None]], fence: Fence | None = None
) -> Figure:
    """A team from above: truth, GPS fixes, estimates with 95 % ellipses; beside it how many robots are how far off.

    Args:
        team: with truth.
        estimates: by label, positions (n, 2) or poses (n, 3), and covariances (n, 2, 2) of the positions or None.
        fence: lowest and highest position (2,), m.
    """
    truth = team.truth
    assert truth is not None
    figure = new_figure(figsize=(13, 7.5), layout="constrained")
    above, beside = figure.subplots(1, 2, width_ratios=[1.9, 1])
    ends = truth[np.column_stack([team.observer, team.target]), :2]
    gap = np.full((len(ends), 1, 2), np.nan)
    edges = np.concatenate([ends, gap], axis=1).reshape(-1, 2)
    above.plot(*edges.T, color="0.85", lw=1, zorder=0, label="range and bearing")
    for fix, place in zip(team.gps, truth, strict=True):
        above.plot([place[0], fix[0]], [place[1], fix[1]], color="0.75", lw=0.8, ls=":", zorder=1)
    above.plot(*team.gps.T, "x", color="0.45", ms=6, label="GPS fix", zorder=2)
    above.plot(*truth[:, :2].T, "o", mfc="none", mec="black", ms=9, label="truth", zorder=3)
    errors = {"GPS fix": np.linalg.norm(team.gps - truth[:, :2], axis=1)}
    for k, (label, (robot, covariance)) in enumerate(estimates.items()):
        color = COLORS[k % len(COLORS)]
        size = max(7.5 - 2.5 * k, 2.5)  # later ones lie on earlier ones
        _draw_estimate(
            above, robot, covariance, label, {"color": color, "marker": MARKERS[k % len(MARKERS)], "ms": size}
        )
        errors[label] = np.linalg.norm(robot[:, :2] - truth[:, :2], axis=1)
    margin = 4.0  # m; far outliers of GPS must not shrink the team
    low, high = truth[:, :2].min(axis=0) - margin, truth[:, :2].max(axis=0) + margin
    if fence is not None:
        corners = np.array([fence[0], (fence[1][0], fence[0][1]), fence[1], (fence[0][0], fence[1][1]), fence[0]])
        above.plot(*corners.T, color="black", lw=1.2, ls="--", label="fence")
        low, high = np.minimum(low, fence[0] - 1), np.maximum(high, fence[1] + 1)
    above.set_xlim(low[0], high[0])
    above.set_ylim(low[1], high[1])
    above.set_aspect("equal", adjustable="box")
    above.set_xlabel("x (m)")
    above.set_ylabel("y (m)")
    above.set_title(f"{team.robots} robots, {len(team.observer)} ranges and bearings; ellipses hold 95 %")
    above.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=4, frameon=False)
    share = np.arange(1, team.robots + 1) / team.robots
    for k, (label, error) in enumerate(errors.items()):
        color, style = ("0.45", ":") if k == 0 else (COLORS[(k - 1) % len(COLORS)], STYLES[(k - 1) % len(STYLES)])
        beside.step(np.sort(error), share, where="post", color=color, ls=style, lw=2, label=label)
    beside.set_xscale("log")
    beside.set_ylim(0, 1.02)
    beside.set_xlabel("position error (m)")
    beside.set_ylabel("share of robots with at most this error")
    beside.grid(alpha=0.3, which="both")
    beside.legend(loc="best", frameon=False)
    return figure


def _draw_estimate(
    axes: Axes, robot: np.ndarray, covariance: np.ndarray | None, label: str, style: dict[str, Any]
) -> None:
    """Positions, ellipses, and a line along each heading where there are any."""
    color = style["color"]
    axes.plot(*robot[:, :2].T, ls="none", label=label, zorder=5, **style)
    if robot.shape[1] == 3:
        tips = robot[:, :2] + np.column_stack([np.cos(robot[:, 2]), np.sin(robot[:, 2])])
        for start, tip in zip(robot, tips, strict=True):
            axes.plot([start[0], tip[0]], [start[1], tip[1]], color=color, lw=1.2, zorder=4)
    if covariance is not None:
        draw_ellipses(axes, robot[:, :2], covariance, color)
