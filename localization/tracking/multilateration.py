"""Where a tag is, from ranges to known anchors alone: robust least squares from several starts.

Ranges to anchors on one line have two answers, mirror images with the same cost; which one is returned is chance unless
`near` says where to look (spec ``recordings`` 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DataError
from problems.noise import Cauchy, Gaussian
from problems.problem import Problem
from problems.solvers.base import Status
from problems.solvers.session import Session
from problems.spaces import Vector

STARTS = 12
REACH = 30.0  # m, how far around the anchors the starts lie
SIGMA = 0.2  # m, of a range with the bias and motion that are not modelled here
BLOCK = 32  # ranges by which the size of sessions grows


def slant_range(p: Any, anchor: Any, z: Any, height: Any) -> Any:
    """Range (m) from (p, height) to an anchor (3,)."""
    return ca.sqrt(ca.sumsqr(p - anchor[0:2]) + (height - anchor[2]) ** 2) - z


@dataclass(frozen=True, eq=False)
class Multilateration:
    """The best fit found.

    Attributes:
        position: (2,) m.
        cost: at the position; losses included.
        status: of the solve that led there.
        iterations: of all starts.
    """

    position: np.ndarray
    cost: float
    status: Status
    iterations: int


@lru_cache(maxsize=32)
def _session(count: int, sigma: float, solver: str) -> Session:
    """For up to `count` ranges; unused ones are NaN."""
    problem = Problem("multilateration")
    p = problem.variables("position", Vector(2))
    anchor, z = problem.data("anchor", 3, count), problem.data("range", (), count)
    height = problem.data("height")
    problem.cost("ranges", slant_range, on=p, data=(anchor, z, height), noise=Gaussian(sigma), loss=Cauchy(2.0))
    return problem.compile(solver)


def _size(ranges: int) -> int:
    return BLOCK * -(-ranges // BLOCK)


def prepare(counts: np.ndarray, sigma: float = SIGMA, solver: str = "gauss-newton") -> float:
    """Compile what `multilaterate` needs for these numbers of ranges, once in a process.

    Returns:
        Seconds that compiling it takes or took.

    Raises:
        FormError: the solver takes quadratic programs only.
    """
    sizes = {_size(int(count)) for count in counts}
    return sum(_session(size, sigma, solver).compile_seconds for size in sizes)


def multilaterate(
    anchors: np.ndarray,
    ranges: np.ndarray,
    height: float = 0.0,
    sigma: float = SIGMA,
    near: np.ndarray | None = None,
    solver: str = "gauss-newton",
) -> Multilateration:
    """Position (2,) in metres that fits the ranges best.

    Args:
        anchors: (m, 3) anchor of each range, m.
        ranges: (m,) m.
        height: of the tag, m.
        sigma: of a range, m.
        near: (2,) start from here only.
        solver: registered name of a solver for graphs or nonlinear programs.

    Raises:
        DataError: fewer than three ranges, all to one place, or shapes that do not fit.
    """
    anchors, ranges = np.asarray(anchors, dtype=float), np.asarray(ranges, dtype=float)
    if anchors.shape != (ranges.size, 3) or ranges.size < 3:
        raise DataError(
            f"multilateration needs at least three ranges with an anchor (3,) each, got {ranges.size} ranges and "
            f"anchors of shape {anchors.shape}"
        )
    if spread_of(anchors) == 0:
        raise DataError(f"multilateration needs anchors at different places, got all of them at {anchors[0, :2]}")
    size = _size(ranges.size)
    session = _session(size, sigma, solver)
    data = {"anchor": np.zeros((size, 3)), "range": np.full(size, np.nan), "height": height}
    data["anchor"][: ranges.size], data["range"][: ranges.size] = anchors, ranges
    middle = anchors[:, :2].mean(axis=0)
    angles = 2 * np.pi * np.arange(STARTS) / STARTS
    reach = min(float(np.median(ranges)), REACH)
    starts = middle + reach * np.column_stack([np.cos(angles), np.sin(angles)]) if near is None else [near]
    found, iterations = [], 0
    for start in starts:
        solution = session.solve(data, initial={"position": start})
        iterations += solution.iterations
        if np.isfinite(solution.objective):
            found.append((float(solution.objective), solution["position"][0].copy(), solution.status))
    session.reset()
    if not found:
        raise DataError("no start of the multilateration led to a finite cost; look at the ranges")
    cost, position, status = min(found, key=lambda f: f[0])
    return Multilateration(position, cost, status, iterations)


def spread_of(anchors: np.ndarray) -> int:
    """In how many horizontal directions anchors (m, 2 or 3) differ: 2 fixes a position, 1 leaves it and its mirror
    image, 0 a circle."""
    centered = anchors[:, :2] - anchors[:, :2].mean(axis=0)
    return int(np.linalg.matrix_rank(centered, tol=1e-3))  # 1 mm
