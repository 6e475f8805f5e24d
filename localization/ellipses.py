"""Covariance ellipses in pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CONFIDENCE = 5.991  # 95 % quantile of chi-square with two degrees of freedom


def draw_ellipses(
    axes: Axes, places: np.ndarray, covariances: np.ndarray, color: str, label: str | None = None
) -> None:
    """Ellipses that hold 95 % around places (m, 2), from covariances (m, 2, 2); rows with NaN are left out."""
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = np.sqrt(CONFIDENCE) * np.column_stack([np.cos(angle), np.sin(angle)])
    known = np.isfinite(covariances).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(covariances[known])
    roots = vectors * np.sqrt(np.maximum(values, 0))[:, None]
    curves = places[known][:, None] + circle @ roots.swapaxes(1, 2)
    gap = np.full((len(curves), 1, 2), np.nan)
    axes.plot(*np.concatenate([curves, gap], axis=1).reshape(-1, 2).T, color=color, lw=0.9, zorder=4, label=label)
