"""`Polyhedron`: a set of states or disturbances given by linear rows, boxes included."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from problems.errors import DataError, EmptyConstraintError, ModelWarning, ShapeError


class Polyhedron:
    """``lower <= matrix @ x <= upper``, convex by construction (X and W of dmhe-pre-estimation section 2).

    Args:
        matrix: (rows, size).
        upper: (rows,) or a number; infinite where a row has no upper bound.
        lower: the same; no lower bounds if None.

    Raises:
        ShapeError: shapes do not fit.
        DataError: a NaN, or a matrix that is not finite.
        EmptyConstraintError: no point satisfies all rows.

    Attributes:
        matrix, lower, upper: (rows, size), (rows,) and (rows,); rows without any bound are left out.
        components: for a box the bounded components, one per row; else None.
    """

    def __init__(self, matrix: Any, upper: Any = np.inf, lower: Any = None) -> None:
        rows = np.asarray(matrix, dtype=float)
        if rows.ndim != 2:
            raise ShapeError(f"a polyhedron needs a matrix (rows, size), got shape {rows.shape}")
        try:
            above = np.broadcast_to(np.asarray(upper, dtype=float), (rows.shape[0],))
            below = np.broadcast_to(np.asarray(-np.inf if lower is None else lower, dtype=float), (rows.shape[0],))
        except ValueError:
            raise ShapeError(
                f"a polyhedron with {rows.shape[0]} rows needs bounds of shape ({rows.shape[0]},), got shapes "
                f"{np.asarray(upper).shape} (upper) and {np.asarray(lower).shape} (lower)"
            ) from None
        if not np.isfinite(rows).all() or np.isnan(above).any() or np.isnan(below).any():
            raise DataError("a polyhedron needs finite rows and bounds that are numbers or infinite, got a NaN or inf")
        bounded = np.isfinite(above) | np.isfinite(below)
        self.matrix, self.lower, self.upper = rows[bounded], below[bounded], above[bounded]
        self.components = self._box()
        self._require_points()

    @classmethod
    def box(cls, lower: Any, upper: Any) -> Polyhedron:
        """Bounds (size,) on the components themselves, infinite where there are none."""
        below, above = np.atleast_1d(np.asarray(lower, dtype=float)), np.atleast_1d(np.asarray(upper, dtype=float))
        if below.shape != above.shape or below.ndim != 1:
            raise ShapeError(f"a box needs two bounds of one shape (size,), got {below.shape} and {above.shape}")
        return cls(np.eye(below.size), above, below)

    @property
    def size(self) -> int:
        """Components of the points."""
        return self.matrix.shape[1]

    def __repr__(self) -> str:
        kind = "box" if self.components is not None else "polyhedron"
        return f"<{kind} of {self.matrix.shape[0]} row(s) on {self.size} component(s)>"

    def violation(self, points: np.ndarray) -> float:
        """Largest violation of a row by points (..., size); 0 where all are inside."""
        values = points @ self.matrix.T
        return float(np.maximum(values - self.upper, self.lower - values).max(initial=0.0))

    def warn_without_origin(self, what: str) -> None:
        """Warns with `ModelWarning` if 0 is outside (a disturbance set should contain it)."""
        if self.violation(np.zeros(self.size)) > 0:
            warnings.warn(f"{what} do not contain 0, the most likely value", ModelWarning, stacklevel=2)

    def _box(self) -> np.ndarray | None:
        single = (self.matrix != 0).sum(axis=1) == 1
        if not single.all():
            return None
        components = np.abs(self.matrix).argmax(axis=1)
        ones = self.matrix[np.arange(components.size), components] == 1.0
        return components if ones.all() and np.unique(components).size == components.size else None

    def _require_points(self) -> None:
        crossed = np.flatnonzero(self.lower > self.upper)
        if crossed.size:
            row = int(crossed[0])
            raise EmptyConstraintError(
                f"no point satisfies row {row}: lower {self.lower[row]:g} is above upper {self.upper[row]:g}"
            )
        if self.components is not None or not self.matrix.shape[0]:
            return
        from scipy.optimize import linprog

        rows = np.vstack([self.matrix, -self.matrix])
        bounds = np.concatenate([self.upper, -self.lower])
        finite = np.isfinite(bounds)
        found = linprog(
            np.zeros(self.size), A_ub=rows[finite], b_ub=bounds[finite], bounds=(None, None), method="highs"
        )
        if found.status == 2:
            raise EmptyConstraintError(f"no point satisfies all {self.matrix.shape[0]} rows of the polyhedron")
