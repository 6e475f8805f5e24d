"""Which inequality rows are active at a point: one rule for the solutions of all forms."""

from __future__ import annotations

import numpy as np

EXACT = 1e-7  # relative distance to a bound at which a row is active whatever its multiplier
NEAR = 1e-4  # up to which the multiplier decides, for points of solvers that stop at a coarse tolerance


def active_rows(values: np.ndarray, lower: np.ndarray, upper: np.ndarray, multipliers: np.ndarray | None) -> np.ndarray:
    """1 at the upper bound, -1 at the lower, 0 between.

    A row is active on its bound, and near it where its relative multiplier is larger than its relative distance (strict
    complementarity). Where both bounds are that near, the sign of the multiplier tells them apart.

    Args:
        values, lower, upper: of all rows (m,).
        multipliers: (m,), positive at an upper bound; None where no row pushes.
    """
    y = np.zeros(values.size) if multipliers is None else multipliers
    push = np.abs(y) / max(1.0, float(np.abs(y).max(initial=0.0)))
    size = np.maximum(1.0, np.abs(values))
    above, below = (upper - values) / size, (values - lower) / size
    at_upper = (above <= EXACT) | ((y > 0) & (above <= NEAR) & (above < push))
    at_lower = (below <= EXACT) | ((y < 0) & (below <= NEAR) & (below < push))
    return np.where(at_upper & ~(at_lower & (y < 0)), 1, np.where(at_lower, -1, 0))
