"""The picture of the scenario `sensor-field`: PRMSE over time, and the network by hops to the nearest sensor.

Source: dmhe-l-step figures 3.3 and 3.4, drawn anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from mhe.scenarios.sensor_field_world import SensorField
from problems.display import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#000000", "#d55e00", "#e69f00", "#009e73", "#0072b2", "#cc79a7", "#56b4e9")  # told apart by all
DASHES = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (6, 2, 1, 2)))  # curves of different methods may coincide
HOPS = ("#d55e00", "#440154", "#3b528b", "#21908c", "#5dc863", "#c8d92f")  # sensors, then dark to light
LINK, WAY = "#d0d0d0", "#cc0077"


def plot(field: SensorField, curves: Mapping[str, np.ndarray], states: np.ndarray, threshold: float) -> Figure:
    """Both pictures side by side.

    Args:
        field: the network.
        curves: PRMSE (steps,) by label, instant 0 first.
        states: (steps, 4) of the target.
        threshold: of convergence (m).
    """
    shown = new_figure(figsize=(13, 5.8), layout="constrained")
    left, right = shown.subplots(1, 2, width_ratios=(1.15, 1))
    draw_prmse(left, curves, threshold)
    draw_network(right, field, states)
    return shown


def draw_prmse(axes: Axes, curves: Mapping[str, np.ndarray], threshold: float | None = None) -> None:
    """PRMSE from t = 1 on, logarithmic.

    Args:
        axes: to draw on.
        curves: PRMSE (steps,) by label, instant 0 first.
        threshold: a line at the error below which a run has converged (m).
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for k, (label, values) in enumerate(curves.items()):
        style = {"color": COLOURS[k % len(COLOURS)], "linestyle": DASHES[k % len(DASHES)]}
        axes.semilogy(np.arange(1, len(values)), values[1:], label=label, linewidth=1.8, **style)
    if threshold is not None:
        axes.axhline(threshold, color="#888888", linewidth=0.8, label=f"converged below {threshold:g} m")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.set(xlabel="time (s)", ylabel="PRMSE (m)")
    axes.legend(fontsize=9)


def draw_network(axes: Axes, field: SensorField, states: np.ndarray | None = None) -> None:
    """Nodes by hops to the nearest sensor, and the way of the target.

    Args:
        axes: to draw on.
        field: the network.
        states: (steps, 4) of the target.
    """
    from matplotlib.collections import LineCollection

    count = field.network.count
    size = float(np.clip(3500 / count, 2, 36))
    links = field.network.edges
    links = links[links[:, 0] < links[:, 1]]
    axes.add_collection(
        LineCollection(list(field.positions[links]), colors=LINK, linewidths=np.clip(size / 60, 0.2, 0.6), zorder=0)
    )
    last = len(HOPS) - 1
    hops = np.minimum(field.hops, last)
    for distance in range(int(hops.max()) + 1):
        at, colour = field.positions[hops == distance], HOPS[distance]
        what = "sensor" if not distance else f"{distance}{'+' * (distance == last)} hop{'s' * (distance > 1)}"
        marker = {"marker": "^", "s": 2.2 * size, "edgecolors": "black"} if not distance else {"s": size}
        axes.scatter(
            *at.T, color=colour, linewidths=0.6, label=f"{what}: {len(at)}", zorder=2 + (not distance), **marker
        )
    if states is not None:
        axes.plot(*states[:, :2].T, color=WAY, linewidth=2, zorder=4, label="target")
        axes.plot(*states[0, :2], "o", color=WAY, markersize=5, zorder=4)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"{count} nodes by hops to the nearest sensor", fontsize=10)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
