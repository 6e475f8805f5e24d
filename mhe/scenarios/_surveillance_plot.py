"""The picture of the scenario `surveillance`: the scene at chosen instants, and errors over time.

Source: dmhe-sporadic-fov figures 4.7, 4.14-4.22, drawn anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from mhe.scenarios._surveillance_metrics import error_norms, over_nodes
from mhe.scenarios._surveillance_world import Drawn, World
from problems.display import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#d55e00", "#0072b2", "#cc79a7", "#009e73", "#e69f00", "#56b4e9")  # told apart without colour vision
SIGNS = ("X", "^", "v", "s", "D", "h")
ROAD, ACTIVE = "#e4e4e4", "#ffd34d"
MARGIN = 0.6  # m around the road
CLOSE = 1.6  # m around the middle of the vehicles
PANELS = 4


def chosen_instants(drawn: Drawn, count: int = PANELS) -> list[int]:
    """Instants at equal distances, each moved to the next one at which somebody is active."""
    active = np.flatnonzero(drawn.active.any(axis=1))
    wanted = np.linspace(0, len(drawn.times) - 1, count + 1)[1:]
    return sorted({int(active[np.abs(active - k).argmin()]) if active.size else round(k) for k in wanted})


def draw_scene(
    axes: Axes, world: World, drawn: Drawn, k: int, estimates: Mapping[str, np.ndarray], *, close: bool = False
) -> None:
    """The scene at instant k.

    Args:
        axes: to draw on.
        world: road and cameras.
        drawn: the trial.
        k: instant.
        estimates: (instants, n_S, n_V, 2) by label. Those of active cameras are drawn as signs, those of the others as
            dots.
        close: only the surroundings of what is detected, with the readings, each estimate joined to its vehicle.
    """
    _fill(axes, world.road, facecolor=ROAD, edgecolor="#9a9a9a", linewidth=0.8, zorder=0)
    active = drawn.active[k]
    for number, (view, on) in enumerate(zip(world.views, active, strict=True)):
        if on:
            _fill(axes, view.hull, facecolor=ACTIVE, alpha=0.4, edgecolor="none", zorder=1)
        style: dict[str, Any] = (
            {"edgecolor": "#b07d00", "linewidth": 1.4, "zorder": 3}
            if on
            else {"edgecolor": "#8a8a8a", "linewidth": 0.5, "linestyle": (0, (4, 3)), "zorder": 2}
        )
        _fill(axes, view.footprint, facecolor="none", **style)
        if not close:
            _number(axes, world, number, on)
    for place, (label, values) in enumerate(estimates.items()):
        colour, sign = COLOURS[place % len(COLOURS)], SIGNS[place % len(SIGNS)]
        quiet, loud = values[k][~active].reshape(-1, 2), values[k][active]
        if close and drawn.positions is not None:
            ends = np.stack(np.broadcast_arrays(drawn.positions[k], loud)).reshape(2, -1, 2)
            axes.plot(ends[..., 0], ends[..., 1], "-", color=colour, linewidth=0.6, alpha=0.6, zorder=4)
        if not close:
            axes.plot(*quiet.T, ".", color=colour, markersize=2.5, alpha=0.5, zorder=4)
        edge = {"markeredgecolor": "white", "markeredgewidth": 0.4}
        size = 6 if close else 4
        axes.plot(*loud.reshape(-1, 2).T, sign, color=colour, markersize=size, zorder=6, label=label, **edge)
    if close:
        readings = drawn.readings[k][drawn.detected[k]]
        axes.plot(*readings.T, "+", color="#333333", markersize=6, markeredgewidth=1.0, zorder=5)
    if drawn.positions is not None:
        for number, (x, y) in enumerate(drawn.positions[k].tolist(), start=1):
            axes.plot(x, y, "o", color="black", markersize=10 if close else 4.5, zorder=7)
            if close:
                style = {"color": "white", "fontsize": 7, "weight": "bold", "zorder": 8}
                axes.annotate(str(number), (x, y), ha="center", va="center_baseline", **style)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    if close:
        x, y = _middle(drawn, k)
        axes.set(xlim=(x - CLOSE, x + CLOSE), ylim=(y - CLOSE, y + CLOSE))
        axes.set_xlabel("x (m)", fontsize=8)
    else:
        x0, y0, x1, y1 = world.road.bounds
        axes.set(xlim=(x0 - MARGIN, x1 + MARGIN), ylim=(y0 - MARGIN, y1 + MARGIN))
        axes.set_title(f"t = {drawn.times[k]:g} s, {int(active.sum())} of {active.size} cameras active", fontsize=9)


def _middle(drawn: Drawn, k: int) -> np.ndarray:
    if drawn.positions is not None:
        return drawn.positions[k].mean(axis=0)
    found = drawn.readings[k][drawn.detected[k]]
    return found.mean(axis=0) if len(found) else np.zeros(2)


def plot(world: World, drawn: Drawn, estimates: Mapping[str, np.ndarray], instants: Sequence[int] = ()) -> Figure:
    """The scene at instants (by default four), as a whole and from close by, and the errors of all methods over time.

    Args:
        world: road and cameras.
        drawn: the trial.
        estimates: (instants, n_S, n_V, 2) by label.
        instants: which ones are drawn.
    """
    from matplotlib.lines import Line2D

    instants = list(instants) or chosen_instants(drawn)
    x0, y0, x1, y1 = world.road.bounds
    tall = (y1 - y0 + 2 * MARGIN) / (x1 - x0 + 2 * MARGIN)
    columns = len(instants)
    heights = 2.9 * tall + 0.4, 2.9 + 0.4, 1.6 if drawn.positions is None else 5.6
    figure = new_figure(figsize=(max(3.1 * columns, 8.0), sum(heights) + 0.5), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(heights[0] + heights[1], heights[2]))
    upper, lower = parts
    panels = upper.subplots(2, columns, squeeze=False, height_ratios=(heights[0], heights[1]))
    for column, k in enumerate(instants):
        for row in (0, 1):
            draw_scene(panels[row, column], world, drawn, k, estimates, close=row == 1)
    for row in (0, 1):
        panels[row, 0].set_ylabel("y (m)", fontsize=8)
    handles, labels = panels[1, 0].get_legend_handles_labels()
    dots: dict[str, Any] = {"linestyle": "none", "color": "#555555"}
    handles += [
        Line2D([], [], marker=".", markersize=4, **dots),
        Line2D([], [], marker="+", markersize=6, **dots),
    ]
    labels = [f"{label} (active cameras)" for label in labels] + ["estimates of the other cameras", "readings"]
    if drawn.positions is not None:
        handles.append(Line2D([], [], marker="o", markersize=7, linestyle="none", color="black"))
        labels.append("vehicles")
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 4), fontsize=9)
    _curves(lower, drawn, estimates, instants)
    return figure


def _curves(figure: Any, drawn: Drawn, estimates: Mapping[str, np.ndarray], instants: Sequence[int]) -> None:
    count = 1 if drawn.positions is None else 3
    ratios = (1.0,) if count == 1 else (2.0, 2.0, 1.3)
    panels = figure.subplots(count, 1, sharex=True, squeeze=False, height_ratios=ratios).ravel()
    if drawn.positions is not None:
        norms = {label: error_norms(values, drawn.positions) for label, values in estimates.items()}
        for axes, chosen, what in ((panels[0], None, "all cameras"), (panels[1], drawn.active, "active cameras")):
            top = 0.0
            for place, (label, values) in enumerate(norms.items()):
                curve = over_nodes(values, chosen)
                style = {"color": COLOURS[place % len(COLOURS)], "linestyle": "--" if label.endswith("_s") else "-"}
                axes.plot(drawn.times, curve, linewidth=1.2, label=label, **style)
                # the first seconds, when nothing was seen yet, would press everything else flat
                top = max(top, float(np.nanquantile(curve, 0.97)) if not np.isnan(curve).all() else 0.0)
            axes.set_ylim(0, 1.15 * top or None)
            axes.set_ylabel(f"RMSE (m)\n{what}", fontsize=8)
    axes = panels[-1]
    seen = np.asarray(drawn.detected.any(axis=1))
    for vehicle in range(seen.shape[1]):
        at = drawn.times[seen[:, vehicle]]
        axes.plot(at, np.full(at.size, vehicle + 1), "|", color="black", markersize=5, markeredgewidth=0.8)
    axes.set_yticks(range(1, seen.shape[1] + 1))
    axes.set_ylim(0.4, seen.shape[1] + 0.6)
    axes.set_ylabel("vehicle seen\nby any camera", fontsize=8)
    axes.set_xlabel("time (s)", fontsize=8)
    axes.set_xlim(drawn.times[0], drawn.times[-1])
    for axes in panels:
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
        for k in instants:
            axes.axvline(drawn.times[k], color="#8a8a8a", linewidth=0.8, linestyle=":")


def _number(axes: Axes, world: World, camera: int, on: bool) -> None:
    """The camera's number beside its footprint, on the outer side of the road."""
    outline = shapely.get_coordinates(world.views[camera].footprint)[:-1]
    middle = outline.mean(axis=0)
    sides = (outline + np.roll(outline, -1, axis=0)) / 2
    free = [shapely.distance(world.road.centroid, shapely.Point(side)) for side in sides]
    off = [side for side in sides if not shapely.contains_xy(world.road, *(middle + 1.15 * (side - middle)))]
    spot = off[0] if off else sides[int(np.argmax(free))]
    x, y = middle + (spot - middle) * (1 + 0.22 / max(float(np.linalg.norm(spot - middle)), 0.1))
    axes.annotate(
        str(camera + 1),
        (x, y),
        ha="center",
        va="center",
        fontsize=6.5 if on else 5.5,
        weight="bold" if on else "normal",
        color="#8a6200" if on else "#707070",
        zorder=4,
    )


def _fill(axes: Axes, area: Any, **style: Any) -> None:
    for part in shapely.get_parts(area):
        axes.fill(*shapely.get_coordinates(part.exterior).T, **style)
