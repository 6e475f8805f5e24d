"""Where a tag is, from ranges to known anchors alone: robust least squares from several starts.

Ranges to anchors near one line have two answers; the one with the lower cost is returned, so a mirror image can only
be told apart by the ranges themselves (spec ``recordings`` 1).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DataError
from problems.noise import Cauchy, Gaussian
from problems.problem import Problem
from problems.solvers.session import Session
from problems.spaces import Vector

STARTS = 12
REACH = 30.0  # m, how far around the anchors the starts lie


def slant_range(p: Any, anchor: Any, z: Any, height: Any) -> Any:
    """Range (m) from (p, height) to an anchor (3,)."""
    return ca.sqrt(ca.sumsqr(p - anchor[0:2]) + (height - anchor[2]) ** 2) - z


@lru_cache(maxsize=32)
def _session(count: int, sigma: float, solver: str) -> Session:
    problem = Problem("multilateration")
    p = problem.variables("position", Vector(2))
    anchor, z = problem.data("anchor", 3, count), problem.data("range", (), count)
    height = problem.data("height")
    problem.cost("ranges", slant_range, on=p, data=(anchor, z, height), noise=Gaussian(sigma), loss=Cauchy(2.0))
    return problem.compile(solver)


def multilaterate(
    anchors: np.ndarray,
    ranges: np.ndarray,
    height: float = 0.0,
    sigma: float = 0.2,
    near: np.ndarray | None = None,
    solver: str = "gauss-newton",
) -> tuple[np.ndarray, float]:
    """Position (2,) in metres that fits the ranges best, and its cost.

    Args:
        anchors: (m, 3) anchor of each range, m.
        ranges: (m,) m.
        height: of the tag, m.
        sigma: of a range, m.
        near: (2,) start from here only.

    Raises:
        DataError: fewer than three ranges, or shapes that do not fit.
    """
    anchors, ranges = np.asarray(anchors, dtype=float), np.asarray(ranges, dtype=float)
    if anchors.shape != (ranges.size, 3) or ranges.size < 3:
        raise DataError(
            f"multilateration needs at least three ranges with an anchor (3,) each, got {ranges.size} ranges and "
            f"anchors of shape {anchors.shape}"
        )
    session = _session(ranges.size, sigma, solver)
    data = {"anchor": anchors, "range": ranges, "height": height}
    middle = anchors[:, :2].mean(axis=0)
    angles = 2 * np.pi * np.arange(STARTS) / STARTS
    spread = min(float(np.median(ranges)), REACH)
    starts = middle + spread * np.column_stack([np.cos(angles), np.sin(angles)]) if near is None else [near]
    found = []
    for start in starts:
        solution = session.solve(data, initial={"position": start})
        if np.isfinite(solution.objective):
            found.append((float(solution.objective), solution["position"][0].copy()))
    session.reset()
    if not found:
        raise DataError("no start of the multilateration led to a finite cost; look at the ranges")
    cost, position = min(found, key=lambda f: f[0])
    return position, cost
