"""Pictures of a report, as matplotlib figures that can be told apart without colours."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from problems.bench.curves import Band, Claim
from problems.bench.scenario import DISTANCE
from problems.bench.summary import TRADE_OFFS, Summary
from problems.display import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, distinguishable with any colour vision; the yellow is left out on white paper.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
SHAPES = "osD^vP*X<>ph"
LINES = ("-", "--", "-.", ":")
ROUNDING = 1e-16  # distances of answers below it are drawn at it: nobody computes them better


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


@dataclass(frozen=True)
class Cost:
    """What accuracy costs.

    Attributes:
        name: of the axis.
        of: the value of a summary; None where it has none.
        unit: of the axis.
    """

    name: str
    of: Callable[[Summary], float | None]
    unit: str = ""


ITERATIONS = Cost("solver iterations of a trial", lambda summary: summary.iterations)
_STEP = Cost("median time of a step", lambda summary: summary.time["step_median"], "s")
_SOLVE = Cost("solve time of a trial", lambda summary: summary.time["solve"], "s")


def time_of(summaries: Sequence[Summary]) -> Cost:
    """The time by which all summaries can be compared: of a step where all have steps, else of solving a trial."""
    finished = [summary for summary in summaries if summary.time["solve"] is not None]
    return _STEP if all(summary.time["step_median"] is not None for summary in finished) else _SOLVE


@dataclass(frozen=True, eq=False)
class Marked:
    """A figure whose SVG groups can be found again.

    Attributes:
        figure: artists that belong to a label have the gid ``{prefix}-{part}-{number}``.
        groups: the summaries behind the points of each number, in the order they are drawn.
    """

    figure: Figure
    groups: list[list[Summary]]


def accuracy_against(summaries: Sequence[Summary], metric: str, prefix: str, cost: Cost) -> Marked:
    """The metric (mean ± standard error) against what it costs, points of one method and solver joined by tolerance.

    Args:
        summaries: of one scenario.
        metric: vertical axis; smaller is better where a front is drawn.
        prefix: of the groups; their parts are ``points`` (one marker each), ``bars`` and ``line``.
        cost: horizontal axis.
    """
    figure, axes = _figure()
    shown = [each for each in summaries if cost.of(each) and each.metrics.get(metric) is not None]
    looks = _styles(list(dict.fromkeys(summary.label for summary in summaries)))  # the same in all pictures
    styles = {label: looks[label] for label in dict.fromkeys(summary.label for summary in shown)}
    groups = []
    for number, (label, style) in enumerate(styles.items()):
        own = [summary for summary in shown if summary.label == label]
        x, y, errors = np.array([(cost.of(s), s.metrics[metric], s.metrics_se.get(metric) or 0.0) for s in own]).T
        y = np.maximum(y, ROUNDING) if metric == DISTANCE else y
        if errors.any():
            bars = axes.errorbar(x, y, yerr=errors, fmt="none", color=style["color"], linewidth=1)
            for part in bars.get_children():
                part.set_gid(f"{prefix}-bars-{number}")
        joined = _joined(own, x, y)
        if joined.size:
            line = axes.plot(*joined.T, **style | {"marker": ""}, alpha=0.6)
            line[0].set_gid(f"{prefix}-line-{number}")
        points = axes.plot(x, y, **style | {"linestyle": "none"}, markersize=8, zorder=3)
        points[0].set_gid(f"{prefix}-points-{number}")
        groups.append(own)
    _scale_of_costs(axes, cost, [cost.of(summary) or 1.0 for summary in shown])
    floor = ROUNDING if metric == DISTANCE else -np.inf
    _scale_of_values(axes, [max(summary.metrics[metric] or 0.0, floor) for summary in shown])
    axes.set_xlabel(cost.name)
    axes.set_ylabel(metric)
    _legend(figure, styles)
    return Marked(figure, groups)


def _joined(summaries: Sequence[Summary], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Corners (k, 2) of the lines through points that differ in tolerance or limit only, NaN between two lines."""
    lines: dict[str, list[int]] = {}
    for number, summary in enumerate(summaries):
        others = {key: value for key, value in summary.settings.items() if key not in TRADE_OFFS}
        lines.setdefault(json.dumps([others, summary.seed], sort_keys=True), []).append(number)
    corners = [np.r_[np.c_[x[line], y[line]], [[np.nan, np.nan]]] for line in lines.values() if len(line) > 1]
    return np.concatenate(corners) if corners else np.empty((0, 2))


def bands(curves: Sequence[tuple[str, Band]], name: str, prefix: str, claim: Sequence[Claim] = ()) -> Marked:
    """Means of curves over the trials, with the percentiles of `problems.bench.curves.OUTER` around them.

    Args:
        curves: with their labels.
        name: vertical axis.
        prefix: of the groups, whose parts are ``band``, ``line`` and ``points``.
        claim: of each curve when the curves are squared normalized errors: they are drawn per degree of freedom, and
            instead of bands the interval they should lie in.
    """
    figure, axes = _figure()
    styles = _styles([label for label, _ in curves])
    for number, (label, band) in enumerate(curves):
        style, scale = styles[label], 1.0 / claim[number].degrees if claim else 1.0
        if not claim and band.trials > 1:
            around = axes.fill_between(band.at, band.lower, band.upper, color=style["color"], alpha=0.13, linewidth=0)
            around.set_gid(f"{prefix}-band-{number}")
        # few markers tell lines apart; they start at different places so that they do not cover each other
        every = max(1, band.at.size // 7)
        marks = {"markevery": (number * 2 % every, every), "markersize": 6}
        line = axes.plot(band.at, band.mean * scale, **style | marks, linewidth=1.6)
        line[0].set_gid(f"{prefix}-line-{number}")
    for lower, upper in dict.fromkeys((item.lower, item.upper) for item in claim):
        axes.axhspan(lower, upper, color="#666666", alpha=0.15, linewidth=0, zorder=0)
    if claim:
        axes.axhline(1.0, color="#333333", linewidth=1)
    _scale_of_values(axes, np.concatenate([band.mean for _, band in curves]).tolist())
    axes.set_xlabel(" / ".join(dict.fromkeys(band.over for _, band in curves)))
    axes.set_ylabel(f"{name} / degrees of freedom" if claim else name)
    _legend(figure, {label: style | {"linewidth": 1.6} for label, style in styles.items()})
    return Marked(figure, [[band.summary] for _, band in curves])


def profile(profiles: Mapping[str, tuple[np.ndarray, np.ndarray]], prefix: str) -> Figure:
    """Performance profile: share of the instances a solver finishes within a factor of the fastest.

    Args:
        profiles: by solver.
        prefix: the line of a solver is the SVG group ``{prefix}-line-{number}``.
    """
    figure, axes = _figure()
    styles = _styles(list(profiles))
    widest = max((float(factors[-1]) for factors, _ in profiles.values() if factors.size), default=1.0)
    for number, (label, (factors, shares)) in enumerate(profiles.items()):
        factors, shares = np.r_[factors, widest * 1.1], np.r_[shares, shares[-1:] if shares.size else [0.0]]
        if factors[0] > 1:
            factors, shares = np.r_[1.0, factors], np.r_[0.0, shares]
        marks = {"markevery": max(1, factors.size // 6), "markersize": 6}
        line = axes.step(factors, shares, where="post", linewidth=1.8, **styles[label] | marks)
        line[0].set_gid(f"{prefix}-line-{number}")
    axes.set_xscale("log")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("time as a multiple of the fastest solver's")
    axes.set_ylabel("share of trials")
    _legend(figure, styles)
    return figure


def _figure() -> tuple[Figure, Axes]:
    figure = new_figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(True, which="major", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _scale_of_costs(axes: Axes, cost: Cost, values: Sequence[float]) -> None:
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    close = max(values, default=1.0) < 100 * min(values, default=1.0)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if close else (1.0,), numticks=12))
    axes.xaxis.set_major_formatter(EngFormatter(cost.unit))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _scale_of_values(axes: Axes, values: Sequence[float]) -> None:
    if values and min(values) > 0 and max(values) / min(values) > 10:
        axes.set_yscale("log")


def _legend(figure: Figure, styles: Mapping[str, Any]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    if handles:
        figure.set_figheight(max(figure.get_figheight(), 0.215 * len(handles) + 0.3))  # or the last ones are cut off
        figure.legend(handles=handles, loc="outside right upper", frameon=False)
