"""Statistics of a benchmark. Plain arrays in, numbers out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from problems.errors import ShapeError


def mean_and_error(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Mean and its standard error over the values that exist; None where there are too few of them (0 and 1)."""
    known = np.array([value for value in values if value is not None], dtype=float)
    if known.size == 0:
        return None, None
    error = float(known.std(ddof=1) / math.sqrt(known.size)) if known.size > 1 else None
    return float(known.mean()), error


def shifted_geometric_mean(values: Sequence[float | None], shift: float, limit: float) -> float:
    """exp(mean(log(value + shift))) - shift, the usual mean of solve times over several orders of magnitude.

    Args:
        values: times; None is a failure and counts as `limit`, as does a larger value.
        shift: added before the logarithm, so that times far below it matter little.
        limit: what a failure costs.
    """
    times = np.array([limit if value is None else min(value, limit) for value in values], dtype=float)
    return float(np.exp(np.log(times + shift).mean()) - shift)


def performance_profile(times: Mapping[str, Sequence[float | None]]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Dolan and More: the share of instances a solver finishes within a factor of the fastest.

    Args:
        times: time of each instance by solver, in the same order for all; None is a failure.

    Returns:
        By solver the factors (k,), ascending, and the share of instances (k,) finished within each.

    Raises:
        ShapeError: the solvers have different numbers of instances.
    """
    if len({len(values) for values in times.values()}) != 1:
        raise ShapeError(f"profiles need the same instances for all, got {[len(v) for v in times.values()]} of them")
    table = np.array([[np.inf if value is None else value for value in values] for values in times.values()])
    best = table.min(axis=0)
    solvable = np.isfinite(best)
    profile = {}
    for name, row in zip(times, table, strict=True):
        factors = np.sort(row[solvable] / best[solvable])
        factors = factors[np.isfinite(factors)]
        profile[name] = factors, np.arange(1, factors.size + 1) / best.size
    return profile


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences with its confidence interval."""

    mean: float
    lower: float
    upper: float
    pairs: int

    @property
    def significant(self) -> bool:
        """Whether the interval leaves out zero."""
        return self.lower > 0 or self.upper < 0


def paired_difference(
    values: Sequence[float | None], baseline: Sequence[float | None], confidence: float = 0.95
) -> Difference | None:
    """How much larger `values` are than `baseline`, trial by trial (Student's t).

    Args:
        values: by trial; None where there is none.
        baseline: of the same trials.
        confidence: of the interval.

    Returns:
        None with fewer than two complete pairs.
    """
    from scipy.special import stdtrit

    pairs = [(a, b) for a, b in zip(values, baseline, strict=True) if a is not None and b is not None]
    if len(pairs) < 2:
        return None
    differences = np.array([a - b for a, b in pairs])
    mean, count = float(differences.mean()), len(pairs)
    half = float(stdtrit(count - 1, 0.5 + confidence / 2) * differences.std(ddof=1) / math.sqrt(count))
    return Difference(mean, mean - half, mean + half, count)


def chi_square_interval(degrees: float, confidence: float = 0.95) -> tuple[float, float]:
    """The interval that holds a chi-square variable with this probability, equal tails outside.

    Where the covariance is right, the mean of a squared normalized error with d degrees of freedom over m independent
    trials lies in ``chi_square_interval(m * d)`` divided by m.
    """
    from scipy.special import chdtri

    tail = (1 - confidence) / 2
    return float(chdtri(degrees, 1 - tail)), float(chdtri(degrees, tail))


def solved_share(status: Mapping[str, int]) -> float | None:
    """Share of steps that were solved to the tolerance asked for; None without steps."""
    steps = sum(status.values())
    return status.get("solved", 0) / steps if steps else None
