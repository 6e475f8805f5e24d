"""Factorizations of KKT systems: where equalities remain, and wherever it must be known what is left undetermined."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg.lapack import dpbtrf, dpbtrs  # type: ignore[attr-defined]

from problems.errors import UnobservableError
from problems.forms.layout import Layout

FREE = 1e-12  # eigenvalue of a Hessian scaled to unit diagonal, below which a direction is free
NARROW = 2  # numbers within the band per entry, up to which the band is factorized as a whole
SHIFT = 1e-10  # added to a scaled singular system to find its free direction


def factorized_kkt(P: Any, A: Any) -> tuple[Callable[[np.ndarray], np.ndarray] | None, np.ndarray | None, float]:
    """Solver of ``[P A'; A 0]`` (sparse) for one or several right sides, or a direction of ``A d = 0`` that P misses.

    Last comes an estimate of the smallest eigenvalue of P on ``A d = 0``, scaled to unit diagonal.

    The direction comes from inverse iteration on the system scaled to unit diagonal. Rows of A may repeat.
    """
    n, m = P.shape[0], A.shape[0]
    diagonal = P.diagonal()
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    rows = spla.norm(A @ sp.diags_array(scale), axis=1) if m else np.zeros(0)
    scale = np.concatenate([scale, 1 / np.where(rows > 0, rows, 1.0)])
    D = sp.diags_array(scale)
    system = sp.csc_array(D @ sp.block_array([[P, A.T], [A, None]]) @ D) if m else sp.csc_array(D @ P @ D)
    # keeps repeated rows apart without moving the solution
    system = system - sp.diags_array(np.concatenate([np.zeros(n), np.full(m, 1e-14)]))
    try:
        factor = _symmetric_lu(system, bool(m))
    except RuntimeError:
        factor = None
    shift = SHIFT * sp.diags_array(np.concatenate([np.ones(n), -np.ones(m)]))
    shifted = factor or _symmetric_lu(system + shift, bool(m))
    direction, growth = np.cos(np.arange(n)), 0.0
    for _ in range(4):
        direction = shifted.solve(np.concatenate([direction, np.zeros(m)]))[:n]
        growth = np.linalg.norm(direction)
        direction = direction / max(growth, 1e-300)
    if factor is None or not growth < 1 / FREE:
        return None, scale[:n] * direction, 0.0
    return lambda right: (scale * factor.solve((scale * right.T).T).T).T, None, float(1 / max(growth, 1e-300))


class _Band:
    """Cholesky factor of a positive definite matrix with entries near the diagonal, as of states in a chain."""

    def __init__(self, factor: np.ndarray) -> None:
        self._factor = factor

    @classmethod
    def of(cls, system: Any) -> _Band | None:
        """None for another matrix."""
        entries = system.tocoo()
        below, size = entries.row - entries.col, system.shape[0]
        width = int(below.max(initial=0))
        if width * size > NARROW * entries.nnz:
            return None
        lower = below >= 0
        band = np.zeros((width + 1, size), order="F")
        band[below[lower], entries.col[lower]] = entries.data[lower]
        factor, info = dpbtrf(band, lower=1)
        return cls(factor) if info == 0 else None

    def solve(self, right: np.ndarray) -> np.ndarray:
        return dpbtrs(self._factor, right, lower=1)[0]


def _symmetric_lu(system: Any, indefinite: bool) -> Any:
    if indefinite:
        return spla.splu(sp.csc_matrix(system), permc_spec="COLAMD")
    band = _Band.of(system)
    if band is not None:
        return band
    options = {"SymmetricMode": True}
    return spla.splu(sp.csc_matrix(system), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def covariance_blocks(layout: Layout, hessian: Any, equalities: Any, columns: np.ndarray) -> np.ndarray:
    """Rows and columns `columns` of the inverse of `hessian` on the null space of the equality rows (both sparse).

    Raises:
        UnobservableError: a direction is free; names its variables.
    """
    solve, free, _ = factorized_kkt(hessian, equalities)
    if solve is None:
        assert free is not None
        raise UnobservableError(
            f"no covariance: the costs leave {layout.names_of(free)} free; add a prior or fix the gauge"
        )
    right = np.zeros((hessian.shape[0] + equalities.shape[0], columns.size))
    right[columns, np.arange(columns.size)] = 1.0
    block = solve(right)[columns]
    return (block + block.T) / 2
