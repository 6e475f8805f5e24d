"""Pictures of localized graphs (from above, and from the side where they are in space) and of teams that move."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.ellipses import draw_ellipses
from localization.io.recording import PoseGraph, TeamRecording
from localization.io.scoring import align
from localization.plots import COLORS, MARKERS, STYLES
from problems.display import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from localization.scenarios._recording_graph import GraphTrace

ELLIPSES = 40  # poses that get one
MARKED = 10  # worst measurements that are drawn
UNLIKELY = 1e-3  # p-value below which they are


def plot_graph(graph: PoseGraph, traces: Mapping[str, GraphTrace]) -> Figure:
    """Start, estimates with 95 % ellipses, landmarks, truth moved onto the first estimate, worst measurements.

    Where there is truth, the error of every pose is drawn below.

    Args:
        traces: by label, the first one with start, ellipses and worst measurements.
    """
    spatial, scored = graph.dimension == 3, graph.truth is not None
    figure = new_figure(figsize=(13 if spatial else 10, 10 if scored else 8), layout="constrained")
    rows: Any = figure.subfigures(2, 1, height_ratios=[3, 1]) if scored else [figure]
    views = rows[0].subplots(1, 2 if spatial else 1, squeeze=False)[0]
    for axes, plane in zip(views, ((0, 1), (0, 2)), strict=False):
        _draw_view(axes, graph, traces, plane)
    views[0].legend(loc="best", fontsize=9)
    edges = len(graph.relative_poses) + len(graph.sightings) + len(graph.ranges)
    figure.suptitle(f"{graph.name}: {len(graph.keys)} poses, {edges} measurements", fontsize=12)
    if scored:
        _draw_errors(rows[1].subplots(), graph, traces)
    return figure


def _aligned_truth(graph: PoseGraph, trace: GraphTrace) -> tuple[np.ndarray, np.ndarray | None]:
    """Truth of poses and landmarks in the frame of an estimate."""
    assert graph.truth is not None
    d = graph.dimension
    turn, shift = align(graph.truth[:, :d], trace.pose[:, :d])
    marks = graph.landmark_truth
    return graph.truth[:, :d] @ turn.T + shift, None if marks is None else marks @ turn.T + shift


def _draw_view(axes: Axes, graph: PoseGraph, traces: Mapping[str, GraphTrace], plane: tuple[int, int]) -> None:
    first = next(iter(traces.values()))
    names = np.unique(graph.robots)
    at = list(plane)
    if graph.truth is not None:
        truth, marks = _aligned_truth(graph, first)
        _draw_lines(axes, graph, truth[:, at], {"color": "0.7", "lw": 3.5, "zorder": 1}, "truth (moved rigidly)")
        if marks is not None:
            axes.plot(*marks[:, at].T, "o", mfc="none", mec="0.45", ms=11, label="landmarks, truth", zorder=1)
    _draw_lines(axes, graph, first.start[:, at], {"color": "0.55", "lw": 0.7, "ls": ":", "zorder": 0}, "start")
    for k, (label, trace) in enumerate(traces.items()):
        if len(traces) == 1 and len(names) > 1:
            for r, robot in enumerate(names):
                mine = graph.robots == robot
                style = {"color": COLORS[r % len(COLORS)], "lw": 1.1, "zorder": 3}
                axes.plot(*trace.pose[mine][:, at].T, label=f"{label}, robot {robot}", **style)
        else:
            style = {"color": COLORS[k % len(COLORS)], "lw": 1.1, "ls": STYLES[k % len(STYLES)], "zorder": 3}
            _draw_lines(axes, graph, trace.pose[:, at], style, label)
        if trace.landmark is not None:
            style = {"marker": MARKERS[(k + 4) % len(MARKERS)], "ls": "none", "color": "black", "zorder": 4}
            axes.plot(*trace.landmark[:, at].T, label=f"landmarks, {label}", **style)
    limits = _limits(graph, traces, plane)
    _draw_worst(axes, graph, first, at)
    if first.aligned is not None:
        chosen = np.unique(np.linspace(0, len(graph.keys) - 1, ELLIPSES).astype(int))
        block = np.ix_(at, at)
        blocks = first.aligned["pose"][chosen][(slice(None), *block)]
        draw_ellipses(axes, first.pose[chosen][:, at], blocks, "#d55e00", "95 % ellipses after alignment")
        if first.landmark is not None:
            draw_ellipses(axes, first.landmark[:, at], first.aligned["landmark"][(slice(None), *block)], "black")
    axes.set_aspect("equal", adjustable="datalim" if graph.dimension == 3 else "box")
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])
    axes.set_xlabel(f"{'xyz'[plane[0]]} (m)")
    axes.set_ylabel(f"{'xyz'[plane[1]]} (m)")
    axes.grid(alpha=0.2)


def _draw_lines(axes: Axes, graph: PoseGraph, place: np.ndarray, style: dict[str, Any], label: str) -> None:
    """One line through all poses that breaks between robots."""
    breaks = np.flatnonzero(graph.robots[1:] != graph.robots[:-1]) + 1
    axes.plot(*np.insert(place, breaks, np.nan, axis=0).T, label=label, **style)


def _draw_worst(axes: Axes, graph: PoseGraph, trace: GraphTrace, at: list[int]) -> None:
    row = {str(key): place for key, place in zip(graph.keys, trace.pose[:, at], strict=True)}
    if trace.landmark is not None:
        row |= {str(key): place for key, place in zip(graph.landmark_keys, trace.landmark[:, at], strict=True)}
    unlikely = [e for e in trace.edges if e["p_against_others"] is not None and e["p_against_others"] < UNLIKELY]
    for k, edge in enumerate(unlikely[:MARKED]):
        ends = np.array([row[name] for name in edge["between"]])
        label = f"measurements with p < {UNLIKELY:g}" if k == 0 else None
        axes.plot(*ends.T, color="#cc79a7", lw=2.2, marker=".", alpha=0.9, zorder=5, label=label)


def _limits(graph: PoseGraph, traces: Mapping[str, GraphTrace], plane: tuple[int, int]) -> list[tuple[float, float]]:
    """Of estimates and truth; a start that drifted away does not count."""
    shown = [trace.pose[:, plane] for trace in traces.values()]
    shown += [trace.landmark[:, plane] for trace in traces.values() if trace.landmark is not None]
    if graph.truth is not None:
        shown.append(_aligned_truth(graph, next(iter(traces.values())))[0][:, plane])
    every = np.vstack(shown)
    margin = 0.05 * max(float(np.ptp(every, axis=0).max()), 1e-3)
    low, high = every.min(axis=0) - margin, every.max(axis=0) + margin
    return [(float(low[k]), float(high[k])) for k in (0, 1)]


def _draw_errors(axes: Axes, graph: PoseGraph, traces: Mapping[str, GraphTrace]) -> None:
    timed = bool(np.isfinite(graph.time).all())
    moment = graph.time - graph.time.min() if timed else np.arange(len(graph.keys))
    several = len(traces) == 1 and len(np.unique(graph.robots)) > 1
    for k, (label, trace) in enumerate(traces.items()):
        error = np.linalg.norm(_aligned_truth(graph, trace)[0] - trace.pose[:, : graph.dimension], axis=1)
        for r, robot in enumerate(np.unique(graph.robots) if several else [None]):
            mine = graph.robots == robot if several else np.full(len(error), True)
            color = COLORS[(r if several else k) % len(COLORS)]
            named = f"{label}, robot {robot}" if several else label
            axes.plot(moment[mine], error[mine], color=color, ls=STYLES[k % len(STYLES)], lw=0.9, label=named)
    axes.set_xlabel("time (s)" if timed else "pose")
    axes.set_ylabel("error after\nrigid alignment (m)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)


def plot_team_tracks(recording: TeamRecording, traces: Mapping[str, Any]) -> Figure:
    """Robots of a team from above with 95 % ellipses where there are covariances; below, errors over time.

    Args:
        traces: `localization.tracking.team_tracker.TeamTrack` by label; the first one is drawn.
    """
    label, made = next(iter(traces.items()))
    figure = new_figure(figsize=(10, 10), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=[3, 1])
    for r, robot in enumerate(recording.robots):
        color, xy = COLORS[r % len(COLORS)], made.poses[:, r, :2]
        above.plot(*xy.T, color=color, lw=0.9, label=f"{label}, robot {robot}", zorder=2)
        if made.covariance is not None:
            chosen = np.unique(np.linspace(0, len(xy) - 1, ELLIPSES // 2).astype(int))
            c, s = np.cos(made.poses[chosen, r, 2]), np.sin(made.poses[chosen, r, 2])
            turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=1)
            blocks = turn @ made.covariance[chosen, r, :2, :2] @ turn.swapaxes(1, 2)
            draw_ellipses(above, xy[chosen], blocks, color)
        if recording.truth is not None:
            truth = recording.truth[r]
            above.plot(*truth.value[:, :2].T, color="0.8", lw=2.5, zorder=1, label="truth" if r == 0 else None)
            inside = (made.time >= truth.time[0]) & (made.time <= truth.time[-1])
            at = np.column_stack([np.interp(made.time[inside], truth.time, truth.value[:, k]) for k in (0, 1)])
            error = np.linalg.norm(xy[inside] - at, axis=1)
            below.plot(made.time[inside], error, color=color, lw=0.7)
    above.plot(*recording.landmarks.T, "k^", ms=8, label="landmarks", zorder=3)
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("x (m)")
    above.set_ylabel("y (m)")
    above.set_title(f"{recording.name}: {len(recording.robots)} robots, {len(recording.sighting_time)} sightings")
    above.legend(loc="best", fontsize=9)
    below.set_xlabel("time (s)")
    below.set_ylabel("horizontal error (m)")
    below.grid(alpha=0.3)
    return figure
