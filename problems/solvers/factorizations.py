"""Factorizations of positive definite matrices given by the upper triangle of a fixed pattern.

Every class finds its order of elimination once and keeps it from one `factor` to the next. Where all variable instances
have the same dimension, our Cholesky by blocks of it wins from some thousand unknowns until the factor fills in heavily
(`HessianPattern.work`), where Pardiso does. Of mixed dimensions scalar LDL' wins on trees and plane graphs, SuperLU
where the factor fills in.
"""

from __future__ import annotations

import copy
import weakref
from functools import cache
from importlib.util import find_spec
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg.lapack import dpbtrf, dpbtrs, dpotrf, dpotrs  # type: ignore[attr-defined]

from problems.errors import MissingExtraError
from problems.forms.sparsity import HessianPattern

DENSE_SIZE = 120  # unknowns up to which dense Cholesky is faster (measured)
BAND_WIDTH = 32  # entries above the diagonal up to which banded Cholesky is faster, if it is much less than all
BLOCK_DIM = 6  # largest dimension of instances for Cholesky by blocks, whose code grows with its square
BLOCK_SIZE = 2000  # unknowns from which it repays its compilation, 20 ms once, in 8 to 20 solves (at 3000: in 4 to 7)
BLOCK_WORK = 5e8  # work from which Pardiso is faster than it (measured on grids: equal at 3e8, half the time at 1e9)
FILLED_WORK = 2e8  # work from which SuperLU is faster than QDLDL (measured on graphs in the plane and in space)
HEAVY_WORK = 2e7  # work from which Pardiso is, whose import takes a second once
MESH_PAIRS = 1.75  # pairs of instances with a common term, per instance, from which a graph is much more than a tree
MESH_SIZE = 20_000  # unknowns from which such graphs fill in heavily, and below which others never do

LinearSolver = Literal["auto", "dense", "banded", "qdldl", "superlu", "pardiso", "cholmod", "schur", "block"]


class SingularError(ArithmeticError):
    """The matrix is not positive definite to working precision."""


class Factorization(Protocol):
    name: ClassVar[str]

    def __init__(self, pattern: HessianPattern) -> None: ...

    def factor(self, values: np.ndarray) -> None:
        """Take the entries in the order of the pattern. Raises SingularError."""
        ...

    def solve(self, right: np.ndarray) -> np.ndarray:
        """For one right side (size,) or several (size, k)."""
        ...


class DenseCholesky:
    """LAPACK Cholesky of the entries scattered into a full matrix."""

    name: ClassVar[str] = "dense"

    def __init__(self, pattern: HessianPattern) -> None:
        self._matrix = np.zeros((pattern.size, pattern.size))
        # transposed view: LAPACK reads columns, so the lower triangle of the row-major array is its upper one
        self._flat = pattern.columns * pattern.size + pattern.indices
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


class BandedCholesky:
    """LAPACK Cholesky of a band: for chains, such as the states of a window, in the order of time.

    Attributes:
        width: diagonals above the main one.
        places: of the entries of the pattern in the band as LAPACK reads it, (width + 1, size) by columns.
    """

    name: ClassVar[str] = "banded"

    def __init__(self, pattern: HessianPattern) -> None:
        columns, self.width = pattern.columns, pattern.bandwidth
        self.places = columns * (self.width + 1) + self.width + pattern.indices - columns
        self._band = np.zeros((self.width + 1) * pattern.size)
        # its transpose is what LAPACK reads by columns
        self._matrix = self._band.reshape(pattern.size, self.width + 1).T
        self._factor: Any = None

    def factor(self, values: np.ndarray) -> None:
        self._band[self.places] = values
        self._factor, info = dpbtrf(self._matrix)
        if info != 0:
            raise SingularError(f"leading minor {info} is not positive")
        diagonal = self._factor[self.width]
        if not diagonal.dot(diagonal) < np.inf:
            raise SingularError("the matrix is not finite")

    def solve(self, right: np.ndarray) -> np.ndarray:
        return dpbtrs(self._factor, right)[0]


class SparseLDL:
    """QDLDL: scalar LDL' in an approximate minimum degree order."""

    name: ClassVar[str] = "qdldl"

    def __init__(self, pattern: HessianPattern) -> None:
        self._pattern = pattern
        self._matrix = sp.csc_matrix((pattern.size, pattern.size))
        # set one by one: what the constructor checks is known to hold, and takes it a tenth of a factorization
        self._matrix.indices, self._matrix.indptr = pattern.indices, pattern.indptr
        self._solver: Any = None

    def factor(self, values: np.ndarray) -> None:
        import qdldl

        check_values(values, self._pattern)
        self._matrix.data = values
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


class SuperLU:
    """SciPy's LU by blocks of columns, on the diagonal only, in a multiple minimum degree order."""

    name: ClassVar[str] = "superlu"

    def __init__(self, pattern: HessianPattern) -> None:
        self._pattern = pattern
        self._arrange(np.arange(pattern.size))
        self._arranged = False
        self._factor: tuple[Any, np.ndarray]  # and the order of its rows

    def factor(self, values: np.ndarray) -> None:
        check_values(values, self._pattern)
        self._matrix.data = values[self._source]
        try:
            found = _eliminated(self._matrix, "NATURAL" if self._arranged else "MMD_AT_PLUS_A")
        except RuntimeError as error:
            raise SingularError(str(error)) from error
        self._factor = (found, self._order)
        if not self._arranged:
            self._arrange(np.argsort(found.perm_c))
            self._arranged = True

    def solve(self, right: np.ndarray) -> np.ndarray:
        factor, order = self._factor
        out = np.empty_like(right)
        out[order] = factor.solve(right[order])
        return out

    def _arrange(self, order: np.ndarray) -> None:
        """Both triangles in this order of elimination, and where their entries stand in the pattern."""
        pattern, n = self._pattern, self._pattern.size
        place = np.empty(n, np.intp)
        place[order] = np.arange(n)
        rows = place[pattern.indices]
        columns = place[pattern.columns]
        off = np.flatnonzero(rows != columns)
        entries = np.concatenate([np.arange(rows.size), off]) + 1.0
        ends = (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]]))
        self._matrix = sp.csc_matrix((entries, ends), shape=(n, n))
        self._source = self._matrix.data.astype(np.intp) - 1
        self._order = order


class Pardiso:
    """MKL's supernodal Cholesky (extra ``pardiso``), its three phases called one by one."""

    name: ClassVar[str] = "pardiso"

    def __init__(self, pattern: HessianPattern) -> None:
        entries, shape = np.arange(pattern.nonzeros) + 1.0, (pattern.size, pattern.size)
        self._pattern = pattern
        self._matrix = sp.csc_matrix((entries, pattern.indices, pattern.indptr), shape=shape).tocsr()
        self._source = self._matrix.data.astype(np.intp) - 1
        self._solver: Any = None

    def factor(self, values: np.ndarray) -> None:
        check_values(values, self._pattern)
        self._matrix.data = values[self._source]
        if self._solver is None:
            solver = _pardiso()
            weakref.finalize(self, solver.free_memory, True)
            self._call(solver, 11)
            self._solver = solver
        self._call(self._solver, 22)

    def solve(self, right: np.ndarray) -> np.ndarray:
        return self._call(self._solver, 33, right)

    def _call(self, solver: Any, phase: int, right: np.ndarray | None = None) -> np.ndarray:
        from pypardiso.pardiso_wrapper import PyPardisoError

        solver.set_phase(phase)
        columns = np.zeros(self._pattern.size) if right is None else np.asfortranarray(right)
        try:
            return solver._call_pardiso(self._matrix, columns)
        except PyPardisoError as error:
            raise SingularError(f"pardiso error {error.value}") from error


class CHOLMOD:
    """CHOLMOD's supernodal Cholesky through cvxopt (extra ``gpl``)."""

    name: ClassVar[str] = "cholmod"

    def __init__(self, pattern: HessianPattern) -> None:
        try:
            import cvxopt
        except ModuleNotFoundError as error:
            raise MissingExtraError("linear solver cholmod", "cvxopt", "gpl") from error
        self._pattern = pattern
        ends = (pattern.indices.tolist(), pattern.columns.tolist())
        self._matrix = cvxopt.spmatrix(1.0, *ends, (pattern.size, pattern.size))
        self._factor: Any = None

    def factor(self, values: np.ndarray) -> None:
        import cvxopt
        import cvxopt.cholmod

        check_values(values, self._pattern)
        self._matrix.V = cvxopt.matrix(values)
        if self._factor is None:
            self._factor = cvxopt.cholmod.symbolic(self._matrix, uplo="U")
        try:
            cvxopt.cholmod.numeric(self._matrix, self._factor)
        except ArithmeticError as error:
            raise SingularError(f"leading minor {error} is not positive") from error

    def solve(self, right: np.ndarray) -> np.ndarray:
        import cvxopt
        import cvxopt.cholmod

        out: Any = cvxopt.matrix(np.ascontiguousarray(right))
        cvxopt.cholmod.solve(self._factor, out)
        return np.array(out).reshape(right.shape)


CLASSES: dict[str, type[Factorization]] = {
    cls.name: cls for cls in (DenseCholesky, BandedCholesky, SparseLDL, SuperLU, Pardiso, CHOLMOD)
}


def factorization(pattern: HessianPattern, solver: LinearSolver = "auto") -> Factorization:
    """The factorization called `solver`, or the one that is fastest for this pattern among what is installed.

    Raises:
        MissingExtraError: its package is not installed.
        SettingError: it does not take this pattern.
    """
    if solver == "auto":
        # the work takes an order of elimination to know; where no block method is sure to need it, it is known without
        mesh = pattern.pairs > MESH_PAIRS * pattern.blocks
        if pattern.bandwidth <= min(BAND_WIDTH, pattern.size // 4):
            solver = "banded"
        elif pattern.size <= DENSE_SIZE:
            solver = "dense"
        elif pattern.size >= BLOCK_SIZE and 1 < (pattern.common_dim or 0) <= BLOCK_DIM:
            solver = "pardiso" if find_spec("pypardiso") and pattern.work >= BLOCK_WORK else "block"
        elif not mesh and pattern.size < MESH_SIZE:
            solver = "qdldl"
        elif find_spec("pypardiso") and (mesh and pattern.size >= MESH_SIZE or pattern.work >= HEAVY_WORK):
            solver = "pardiso"
        else:
            solver = "superlu" if pattern.work >= FILLED_WORK else "qdldl"
    elif solver == "pardiso" and find_spec("pypardiso") is None:
        raise MissingExtraError("linear solver pardiso", "pypardiso", "pardiso")
    elif solver == "schur":
        from problems.solvers.schur import SchurComplement

        return SchurComplement(pattern)
    if solver == "block":
        from problems.solvers.block_cholesky import BlockCholesky

        return BlockCholesky(pattern)
    return CLASSES[solver](pattern)


def check_values(values: np.ndarray, pattern: HessianPattern) -> None:
    """Raises SingularError where no factorization could succeed."""
    if not values.dot(values) < np.inf and not np.isfinite(values).all():
        raise SingularError("the matrix is not finite")
    if (values[pattern.diagonal] <= 0).any():
        raise SingularError("a diagonal entry is not positive")


def _eliminated(matrix: Any, order: str) -> Any:
    return spla.splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


@cache
def _pardiso_template() -> Any:
    # constructing one searches the whole environment for the library (0.25 s), so all are copies of the first
    import pypardiso

    return pypardiso.PyPardisoSolver(mtype=2)


def _pardiso() -> Any:
    solver = copy.copy(_pardiso_template())
    solver.pt, solver.iparm = np.zeros_like(solver.pt), np.zeros_like(solver.iparm)
    # own parameters: minimum degree (its analysis takes a third of METIS's) and no refinement of every solve
    solver.iparm[0] = 1
    return solver
