"""What trials followed, put together: bands of curves, and whether covariances told the truth."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.bench.metrics import chi_square_interval, mean_and_error
from problems.bench.rows import Row
from problems.bench.summary import TRADE_OFFS, Summary

OUTER = (10.0, 90.0)  # percentiles of the trials a band reaches between


@dataclass(frozen=True, eq=False)
class Band:
    """One curve over all trials of a configuration.

    Attributes:
        summary: of the configuration.
        over: what `at` is.
        at: (points,).
        mean, lower, upper: (points,) over the trials; lower and upper are the percentiles `OUTER`.
        trials: how many there are.
    """

    summary: Summary
    over: str
    at: np.ndarray
    mean: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    trials: int


def band(name: str, rows: Sequence[Row], summary: Summary) -> Band | None:
    """The band of the curve `name`; trials whose points lie elsewhere than those of the first are left out.

    Args:
        name: of the curve.
        rows: the trials of `summary`.
        summary: their configuration.
    """
    curves = [row.curves[name] for row in rows if name in row.curves and row.curves[name]["values"]]
    if not curves:
        return None
    same = [curve["values"] for curve in curves if curve["at"] == curves[0]["at"]]
    values = np.array(same, dtype=float)
    known = np.isfinite(values).any(axis=0)
    if not known.any():
        return None
    values = values[:, known]
    lower, upper = np.nanpercentile(values, OUTER, axis=0)
    at = np.array(curves[0]["at"], dtype=float)[known]
    return Band(summary, curves[0]["over"], at, np.nanmean(values, axis=0), lower, upper, len(same))


def representatives(summaries: Iterable[Summary]) -> list[Summary]:
    """One configuration for each method and set of settings: the first solver, at the tightest tolerance and largest
    limit, for there the solvers agree and what is left is the method's own error."""
    best: dict[tuple[Any, ...], Summary] = {}
    for summary in summaries:
        others = {key: value for key, value in summary.settings.items() if key not in TRADE_OFFS}
        key = summary.scenario, summary.method, json.dumps(others, sort_keys=True), summary.seed
        found = best.get(key)
        if found is None or (found.solver == summary.solver and _effort(summary) > _effort(found)):
            best[key] = summary
    return list(best.values())


def _effort(summary: Summary) -> tuple[float, float]:
    limit = summary.settings.get("iteration_limit")
    return -float(summary.settings.get("tolerance") or 0.0), float("inf") if limit is None else float(limit)


@dataclass(frozen=True)
class Claim:
    """How true the covariances of one configuration are.

    Attributes:
        name: of the squared normalized error.
        degrees: of freedom.
        trials: number of trials.
        mean, error: mean per degree of freedom over all steps and trials, 1 where the covariance is right, and its
            standard error over the trials (steps of one trial depend on each other).
        inside: share of all squares in the interval that holds 95 % of them where the covariance is right.
        lower, upper: interval that holds the mean of the trials at one step, per degree of freedom, with 95 %.
        steps_inside: share of the kept steps at which it does.
    """

    name: str
    degrees: int
    trials: int
    mean: float
    error: float | None
    inside: float
    lower: float
    upper: float
    steps_inside: float


def claims(rows: Sequence[Row], summary: Summary) -> list[Claim]:
    """All squared normalized errors of one configuration; see `problems.bench.scenario.Consistency`."""
    found = []
    for name in dict.fromkeys(name for row in rows for name in row.consistency):
        have = [row for row in rows if row.consistency.get(name, {}).get("samples")]
        followed = band(name, have, summary)
        if not have or followed is None:
            continue
        each = [row.consistency[name] for row in have]
        degrees = int(each[0]["degrees"])
        mean, error = mean_and_error([item["mean"] for item in each])
        samples = sum(item["samples"] for item in each)
        lower, upper = (end / (followed.trials * degrees) for end in chi_square_interval(followed.trials * degrees))
        mean_per_step = followed.mean / degrees
        assert mean is not None
        found.append(
            Claim(
                name=name,
                degrees=degrees,
                trials=len(have),
                mean=mean,
                error=error,
                inside=sum(item["inside"] * item["samples"] for item in each) / samples,
                lower=lower,
                upper=upper,
                steps_inside=float(((lower <= mean_per_step) & (mean_per_step <= upper)).mean()),
            )
        )
    return found
