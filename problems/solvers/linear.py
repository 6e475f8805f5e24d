"""Factorizations of positive definite matrices given by the upper triangle of a fixed pattern, and of KKT systems.

Dense Cholesky for small systems, else LDL' with the symbolic part kept from one factorization to the next. KKT systems
are factorized where equalities remain, and wherever it must be known what is left undetermined.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg.lapack import dpotrf, dpotrs

from problems.errors import UnobservableError
from problems.forms.layout import Layout
from problems.forms.sparsity import HessianPattern

DENSE_SIZE = 120  # unknowns up to which dense Cholesky is faster (measured)
FREE = 1e-12  # eigenvalue of a Hessian scaled to unit diagonal, below which a direction is free
SHIFT = 1e-10  # added to a scaled singular system to find its free direction


class SingularError(ArithmeticError):
    """The matrix is not positive definite to working precision."""


class Factorization(Protocol):
    def factor(self, values: np.ndarray) -> None:
        """Take the entries of the upper triangle; raises SingularError."""
        ...

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution for one right side (n,) or several (n, k)."""
        ...


class DenseCholesky:
    """LAPACK Cholesky of the entries scattered into a full matrix."""

    def __init__(self, pattern: HessianPattern) -> None:
        self._matrix = np.zeros((pattern.size, pattern.size))
        columns = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
        # transposed view: LAPACK reads columns, so the lower triangle of the row-major array is its upper one
        self._flat = columns * pattern.size + pattern.indices
        self._factor: Any = None

    def factor(self, values: np.ndarray) -> None:
        self._matrix.ravel()[self._flat] = values
        self._factor, info = dpotrf(self._matrix.T, lower=0)
        if info != 0:
            raise SingularError(f"leading minor {info} is not positive")
        if np.isnan(self._factor.diagonal()).any():
            raise SingularError("the matrix is not finite")

    def solve(self, right: np.ndarray) -> np.ndarray:
        return dpotrs(self._factor, right, lower=0)[0]


class SparseLDL:
    """QDLDL with a fill-reducing order found once."""

    def __init__(self, pattern: HessianPattern) -> None:
        shape = (pattern.size, pattern.size)
        self._matrix = sp.csc_matrix((np.ones(pattern.nonzeros), pattern.indices, pattern.indptr), shape=shape)
        self._diagonal = pattern.diagonal
        self._solver: Any = None

    def factor(self, values: np.ndarray) -> None:
        import qdldl

        self._matrix.data = values
        if not np.isfinite(values).all():
            raise SingularError("the matrix is not finite")
        if (values[self._diagonal] <= 0).any():
            raise SingularError("a diagonal entry is not positive")
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(self._matrix, upper=True)
            else:
                self._solver.update(self._matrix, upper=True)
        except RuntimeError as error:
            self._solver = None
            raise SingularError(str(error)) from error

    def solve(self, right: np.ndarray) -> np.ndarray:
        if right.ndim == 1:
            return self._solver.solve(right)
        return np.column_stack([self._solver.solve(np.ascontiguousarray(column)) for column in right.T])


def factorization(pattern: HessianPattern) -> Factorization:
    """The faster one for this size."""
    return DenseCholesky(pattern) if pattern.size <= DENSE_SIZE else SparseLDL(pattern)


def factorized_kkt(P: Any, A: Any) -> tuple[Callable[[np.ndarray], np.ndarray] | None, np.ndarray | None]:
    """Solver of ``[P A'; A 0]`` (sparse) for one or several right sides, or a direction of ``A d = 0`` that P misses.

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
        return None, scale[:n] * direction
    return lambda right: (scale * factor.solve((scale * right.T).T).T).T, None


def _symmetric_lu(system: Any, indefinite: bool) -> Any:
    if indefinite:
        return spla.splu(sp.csc_matrix(system), permc_spec="COLAMD")
    options = {"SymmetricMode": True}
    return spla.splu(sp.csc_matrix(system), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def covariance_blocks(layout: Layout, hessian: Any, equalities: Any, columns: np.ndarray) -> np.ndarray:
    """Rows and columns `columns` of the inverse of `hessian` on the null space of the equality rows (both sparse).

    Raises:
        UnobservableError: a direction is free; names its variables.
    """
    solve, free = factorized_kkt(hessian, equalities)
    if solve is None:
        raise UnobservableError(
            f"no covariance: the costs leave {layout.names_of(free)} free; add a prior or fix the gauge"
        )
    right = np.zeros((hessian.shape[0] + equalities.shape[0], columns.size))
    right[columns, np.arange(columns.size)] = 1.0
    block = solve(right)[columns]
    return (block + block.T) / 2
