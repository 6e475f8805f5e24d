"""Pictures of a report, as matplotlib figures that can be told apart without colours."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from problems.bench.summary import Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, distinguishable with any colour vision; the yellow is left out on white paper.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
SHAPES = "osD^vP*X<>ph"
LINES = ("-", "--", "-.", ":")
TRADE_OFFS = ("tolerance", "iteration_limit")  # settings that trade accuracy for time: their points are joined


def _styles(labels: Sequence[str]) -> dict[str, Any]:
    """Each label its own shape (open or filled), colour and line."""
    shapes = [(shape, filled) for filled, shape in product((True, False), SHAPES)]
    styles: dict[str, Any] = {}
    for number, label in enumerate(labels):
        colour = COLOURS[number % len(COLOURS)]
        shape, filled = shapes[number % len(shapes)]
        line = LINES[number % len(LINES)]
        styles[label] = {"color": colour, "marker": shape, "linestyle": line, "mfc": colour if filled else "white"}
    return styles


def time_of(summary: Summary) -> tuple[float | None, str]:
    """The time a picture shows for a summary, and what it is."""
    step = summary.time["step_median"]
    return (step, "median time of a step") if step is not None else (summary.time["solve"], "solve time of a trial")


def accuracy_against_time(summaries: Sequence[Summary], metric: str, prefix: str) -> Figure:
    """The metric (mean ± standard error) against time, points of one method and solver joined along the tolerance.

    Args:
        summaries: of one scenario.
        metric: vertical axis.
        prefix: each point is an SVG group with the id ``{prefix}-point-{index in summaries}``, each line one with
            ``{prefix}-line-{index of its first point}``.
    """
    figure, axes = _figure()
    shown = [
        (number, summary, seconds, value)
        for number, summary in enumerate(summaries)
        if (seconds := time_of(summary)[0]) and (value := summary.metrics.get(metric)) is not None
    ]
    styles = _styles(list(dict.fromkeys(summary.label for _, summary, _, _ in shown)))
    lines: dict[tuple[str, str], list[tuple[int, float, float]]] = {}
    for number, summary, seconds, value in shown:
        style = styles[summary.label]
        point = axes.errorbar(
            [seconds],
            [value],
            yerr=[summary.metrics_se.get(metric) or 0.0],
            color=style["color"],
            linewidth=1,
            capsize=2,
        )
        for part in point.get_children():
            part.set_gid(f"{prefix}-point-{number}")
        marker = axes.plot([seconds], [value], **style | {"linestyle": "none"}, markersize=8, zorder=3)
        marker[0].set_gid(f"{prefix}-point-{number}")
        others = {key: setting for key, setting in summary.settings.items() if key not in TRADE_OFFS}
        lines.setdefault((summary.label, json.dumps(others, sort_keys=True)), []).append((number, seconds, value))
    for (label, _), points in lines.items():
        line = axes.plot(
            *zip(*[point[1:] for point in points], strict=True), **styles[label] | {"marker": ""}, alpha=0.6
        )
        line[0].set_gid(f"{prefix}-line-{points[0][0]}")
    axes.set_xscale("log")
    _scale_of_values(axes, [value for _, _, _, value in shown])
    axes.set_xlabel(" / ".join(dict.fromkeys(time_of(summary)[1] for _, summary, _, _ in shown)) + " in s")
    axes.set_ylabel(metric)
    _legend(figure, styles)
    return figure


def profile(profiles: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Performance profile: share of the instances a solver finishes within a factor of the fastest."""
    figure, axes = _figure()
    styles = _styles(list(profiles))
    widest = max((float(factors[-1]) for factors, _ in profiles.values() if factors.size), default=1.0)
    for label, (factors, shares) in profiles.items():
        factors, shares = np.r_[factors, widest * 1.1], np.r_[shares, shares[-1:] if shares.size else [0.0]]
        if factors[0] > 1:
            factors, shares = np.r_[1.0, factors], np.r_[0.0, shares]
        style = {key: styles[label][key] for key in ("color", "linestyle")}
        axes.step(factors, shares, where="post", label=label, linewidth=2, **style)
    axes.set_xscale("log")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("time as a multiple of the fastest solver's")
    axes.set_ylabel("share of trials")
    _legend(figure, {label: style | {"marker": ""} for label, style in styles.items()})
    return figure


def _figure() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(True, which="major", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _scale_of_values(axes: Axes, values: Sequence[float]) -> None:
    if values and min(values) > 0 and max(values) / min(values) > 10:
        axes.set_yscale("log")


def _legend(figure: Figure, styles: Mapping[str, Any]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    if handles:
        figure.legend(handles=handles, loc="outside right upper", frameon=False)
