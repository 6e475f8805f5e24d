"""Field-of-view rows (4.17): a detected vehicle lies in the set of the sensor that detected it, at that instant.

No flag, no row: not being seen says nothing, and a vehicle seen before and lost since keeps its row at the instant it
was seen. Sets are convex; they come as `Polyhedron` on the output of a sensor.

Source: dmhe-sporadic-fov 3.4, 3.5; projection section 10.
"""

from __future__ import annotations

import numpy as np

from mhe.polyhedron import Polyhedron
from problems.errors import DefinitionError
from problems.forms.layout import INFINITE
from problems.problem import Problem, Variable
from problems.soft import Soft

SLACK_CURVATURE = 1.0  # makes the Hessian of slacks definite; an exact penalty stays exact with it
OUTSIDE = 1e-9  # violation (unit of the rows) up to which a reading counts as inside


def state_rows(problem: Problem, x: Variable, sets: int, rows: int, penalty: float | None) -> None:
    """State ``H x <= h`` on every instance of `x`, `sets` times, with H, h and the flags as data.

    Args:
        problem: of the window.
        x: its states, slot after slot.
        sets: sets of rows on one instance.
        rows: rows of a set; those a set does not need have zeros in H and the bound `INFINITE` in h.
        penalty: price of slacks, None for hard rows.
    """
    count = x.count * sets
    H = problem.data("row matrix", (rows, x.space.dim), count, value=np.zeros((count, rows, x.space.dim)))
    h = problem.data("row bound", rows, count, value=np.full((count, rows), INFINITE))
    problem.inequality(
        "field of view",
        lambda x, H: H @ x,
        on=x[np.repeat(np.arange(x.count), sets)],
        data=H,
        upper=h,
        active=problem.data("row active", (), count, value=np.zeros(count)),
        soft=None if penalty is None else Soft(penalty, SLACK_CURVATURE),
    )


def half_planes(polyhedron: Polyhedron) -> tuple[np.ndarray, np.ndarray]:
    """G (rows, size) and h (rows,) of ``G z <= h``, one row per finite bound."""
    upper, lower = np.isfinite(polyhedron.upper), np.isfinite(polyhedron.lower)
    G = np.vstack([polyhedron.matrix[upper], -polyhedron.matrix[lower]])
    return G, np.concatenate([polyhedron.upper[upper], -polyhedron.lower[lower]])


def padded_rows(polyhedron: Polyhedron, output: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """H = G C (rows, m) and h (rows,) of ``G C x <= h``, filled up with rows that say nothing."""
    G, bound = half_planes(polyhedron)
    H, h = np.zeros((rows, output.shape[1])), np.full(rows, INFINITE)
    H[: len(G)], h[: len(G)] = G @ output, bound
    return H, h


def require_bounded(polyhedron: Polyhedron, what: str) -> None:
    """Raises DefinitionError where a set reaches to infinity."""
    from scipy.optimize import linprog

    G, _ = half_planes(polyhedron)
    for direction in np.vstack([np.eye(polyhedron.size), -np.eye(polyhedron.size)]):
        found = linprog(-direction, A_ub=G, b_ub=np.zeros(len(G)), bounds=(-1, 1), method="highs")
        if found.status == 0 and -found.fun > 1e-9:
            raise DefinitionError(
                f"the set of {what} is unbounded; a field of view ends somewhere, add the rows that say where"
            )


class Projection:
    """Nearest point of a convex set, in Euclidean distance."""

    def __init__(self, polyhedron: Polyhedron) -> None:
        self._G, self._h = half_planes(polyhedron)

    def __call__(self, point: np.ndarray) -> np.ndarray:
        """The point (size,) itself where it is inside.

        Raises:
            RuntimeError: the solver found none, which a set with points excludes.
        """
        if not point.size or (self._G @ point - self._h).max(initial=-np.inf) <= OUTSIDE:
            return point
        import daqp

        lower = np.full(self._h.size, -1e30)
        sense = np.zeros(self._h.size, dtype=np.intc)
        nearest, _, flag, _ = daqp.solve(np.eye(point.size), -point, self._G, self._h, lower, sense)
        if flag != 1:
            raise RuntimeError(f"projection onto a set of {self._h.size} rows failed with flag {flag}")
        return nearest
