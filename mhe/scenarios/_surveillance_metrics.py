"""What the scenario `surveillance` measures.

Source: dmhe-sporadic-fov 3.11, E12, E13 and C15.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mhe.scenarios._surveillance_world import Drawn

if TYPE_CHECKING:
    from mhe.sporadic.geometry import FieldOfView

METRICS = ("rmse_all", "rmse_active", "rmse_detected", "infeasible_share", "outside_share")
OUTSIDE = 1e-6  # m beyond a row


def error_norms(estimates: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(instants, n_S) norms of the error of all vehicles together.

    Args:
        estimates: (instants, n_S, n_V, 2).
        positions: (instants, n_V, 2).
    """
    return np.linalg.norm(estimates - positions[:, None], axis=(2, 3))


def over_nodes(norms: np.ndarray, chosen: np.ndarray | None = None) -> np.ndarray:
    """(instants,) RMSE_t: the mean of norms (instants, n_S) over the chosen nodes; NaN where there are none."""
    if chosen is None:
        return norms.mean(axis=1)
    count = chosen.sum(axis=1)
    return np.where(count > 0, np.where(chosen, norms, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)


def errors_of(estimates: np.ndarray, drawn: Drawn, kept: np.ndarray) -> dict[str, float | None]:
    """The three errors of 3.11 (m); None where the truth is not known, or nobody was active.

    Args:
        estimates: (instants, n_S, n_V, 2).
        drawn: the trial.
        kept: (instants,) which ones count.
    """
    if drawn.positions is None:
        return dict.fromkeys(("rmse_all", "rmse_active", "rmse_detected"))
    norms = error_norms(estimates, drawn.positions)
    active = over_nodes(norms, drawn.active)[kept]
    found = drawn.detected & kept[:, None, None]
    squares = ((estimates - drawn.positions[:, None]) ** 2).sum(axis=-1)[found]
    return {
        "rmse_all": float(over_nodes(norms)[kept].mean()),
        "rmse_active": None if np.isnan(active).all() else float(np.nanmean(active)),
        "rmse_detected": float(np.sqrt(squares.mean())) if squares.size else None,
    }


def outside(estimates: np.ndarray, drawn: Drawn, views: Sequence[FieldOfView]) -> np.ndarray:
    """(instants, n_S, n_V) whether a vehicle is detected by a camera whose estimate is outside of its set S."""
    over = np.stack(
        [
            (estimates[:, i] @ view.rows.matrix.T - view.rows.upper).max(axis=-1) > OUTSIDE
            for i, view in enumerate(views)
        ],
        axis=1,
    )
    return over & drawn.detected


def share(chosen: np.ndarray, among: np.ndarray, kept: np.ndarray) -> float | None:
    """How many of the flags `among` (instants, ...) of the kept instants are chosen; None where there are none."""
    total = int(among[kept].sum())
    return int((chosen & among)[kept].sum()) / total if total else None


def in_window(detected: np.ndarray, horizon: int) -> np.ndarray:
    """(instants, ...) whether there is a detection in the window that ends there: its problem has rows."""
    rows = detected.copy()
    for age in range(1, min(horizon, len(detected) - 1) + 1):
        rows[age:] |= detected[:-age]
    return rows
