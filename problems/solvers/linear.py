"""Factorizations of symmetric positive definite matrices given by the upper triangle of a fixed pattern.

Dense Cholesky for small systems, else LDL' with the symbolic part kept from one factorization to the next.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpotrf, dpotrs

from problems.forms.sparsity import HessianPattern

DENSE_SIZE = 120  # unknowns up to which dense Cholesky is faster (measured)


class SingularError(ArithmeticError):
    """The matrix is not positive definite to working precision."""


class Factorization(Protocol):
    def factor(self, values: np.ndarray) -> None: ...
    def solve(self, right: np.ndarray) -> np.ndarray: ...


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

    def solve(self, right: np.ndarray) -> np.ndarray:
        return dpotrs(self._factor, right, lower=0)[0]


class SparseLDL:
    """QDLDL with a fill-reducing order found once."""

    def __init__(self, pattern: HessianPattern) -> None:
        shape = (pattern.size, pattern.size)
        self._matrix = sp.csc_matrix((np.ones(pattern.nonzeros), pattern.indices, pattern.indptr), shape=shape)
        self._solver: Any = None

    def factor(self, values: np.ndarray) -> None:
        import qdldl

        self._matrix.data = values
        if not np.isfinite(values).all():
            raise SingularError("the matrix is not finite")
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
