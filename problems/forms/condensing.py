"""Eliminating unknowns through equalities: ``z = Z v + Y d + z0``.

`eliminate` solves chosen unknowns from the equalities that define them (condensed windows); `null_space` removes all
equalities at once. Both give the same kind of map, so whatever is expressed in z can be expressed in v.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg.lapack import dtbtrs  # type: ignore[attr-defined]
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from problems.errors import EmptyConstraintError, FormError

Matrix = Any
SOLVED = 2.0  # numbers of a map per number in its equalities, beyond which they are solved at each point
NARROW = 4  # numbers within a band per entry, up to which it is solved as a whole
SINGULAR = 1e12  # condition number from which equalities do not determine unknowns


@dataclass(eq=False)
class AffineMap:
    """All unknowns as an affine function of fewer: ``z = Z v + Y d + z0``."""

    Z: Matrix
    Y: Matrix
    z0: np.ndarray

    @classmethod
    def identity(cls, size: int, data: int, dense: bool) -> AffineMap:
        if dense:
            return cls(np.eye(size), np.zeros((size, data)), np.zeros(size))
        return cls(sp.eye_array(size, format="csr"), sp.csr_array((size, data)), np.zeros(size))

    def at(self, v: np.ndarray, d: np.ndarray) -> np.ndarray:
        """z (n,)."""
        return self.Z @ v + self.Y @ d + self.z0

    def then(self, inner: AffineMap) -> AffineMap:
        """This map with its v given by `inner`."""
        return AffineMap(self.Z @ inner.Z, self.Y + self.Z @ inner.Y, self.z0 + self.Z @ inner.z0)


@dataclass(eq=False)
class SolvedMap(AffineMap):
    """The same through the equalities, where a solve multiplies fewer numbers than Z and Y hold (long windows).

    Attributes:
        places: in z, of v and of the unknowns that `block` solves from ``right (v, d) + c``.
    """

    places: tuple[Any, Any]
    block: Any
    right: Matrix
    c: np.ndarray

    def at(self, v: np.ndarray, d: np.ndarray) -> np.ndarray:
        z = np.empty(self.z0.size)
        z[self.places[0]] = v
        b = self.right @ np.concatenate((v, d))
        b += self.c
        z[self.places[1]] = self.block.solve(b)
        return z


class BandedTriangle:
    """Solver of a lower triangular matrix whose entries are near the diagonal, as of states that follow each other."""

    def __init__(self, band: np.ndarray) -> None:
        self._band = band

    @classmethod
    def of(cls, block: sp.csr_array) -> BandedTriangle | None:
        """None for another matrix."""
        entries, size = block.tocoo(), len(block.indptr) - 1
        below = entries.row - entries.col
        width = int(below.max())
        if below.min() < 0 or width * size > NARROW * entries.nnz:
            return None
        band = np.zeros((width + 1, size), order="F")
        band[below, entries.col] = entries.data
        return cls(band)

    def solve(self, right: np.ndarray) -> np.ndarray:
        solution: Any = dtbtrs(self._band, right, uplo="L")
        return solution[0]


def defining_rows(R: Matrix, columns: np.ndarray) -> np.ndarray:
    """Rows that contain any of `columns`."""
    part = abs(R[:, columns])
    return np.flatnonzero(np.asarray(part.sum(axis=1)).ravel() > 0)


def eliminate(R: Matrix, E: Matrix, c: np.ndarray, columns: np.ndarray, names: str) -> tuple[AffineMap, np.ndarray]:
    """Solve the unknowns in `columns` from equalities ``R z + E d + c = 0`` that contain them.

    Where more rows contain them than there are unknowns, rows that determine them are chosen; the others stay, with the
    unknowns replaced.

    Returns:
        The map, whose v are the other unknowns in their order, and the rows that were used up.

    Raises:
        FormError: the equalities containing them are fewer than the unknowns, or do not determine them.
    """
    used = defining_rows(R, columns)
    size = R.shape[1]
    kept = np.setdiff1d(np.arange(size), columns)
    if used.size < columns.size:
        raise FormError(
            f"cannot eliminate {names}: {columns.size} unknowns appear in {used.size} equality rows, too few to define "
            "them"
        )
    if used.size > columns.size:
        used = used[_determining(R[used][:, columns], names)]
    dense = isinstance(R, np.ndarray)
    block = R[used][:, columns]
    right = [R[used][:, kept], E[used], c[used][:, None]]
    if dense:
        if not _condition(block) < SINGULAR:
            raise FormError(f"cannot eliminate {names}: the equalities do not determine them (singular)")
        solved = [-np.linalg.solve(block, b) for b in right]
        Z, Y = np.zeros((size, kept.size)), np.zeros((size, E.shape[1]))
        Z[kept, np.arange(kept.size)] = 1.0
        Z[columns], Y[columns] = solved[0], solved[1]
    else:
        try:
            factor: Any = spla.splu(sp.csc_matrix(block))
        except RuntimeError as error:
            raise FormError(f"cannot eliminate {names}: the equalities do not determine them (singular)") from error
        linear_operator: Any = spla.LinearOperator
        inverse = linear_operator(block.shape, factor.solve, lambda v: factor.solve(v, "T"))
        size_of_inverse: Any = spla.onenormest(inverse)
        if not size_of_inverse * spla.norm(block, 1) < SINGULAR:
            raise FormError(f"cannot eliminate {names}: the equalities do not determine them (singular)")
        solved = [-factor.solve(b.toarray() if sp.issparse(b) else b) for b in right]
        place: Any = sp.csr_array(
            (np.ones(columns.size), (columns, np.arange(columns.size))), shape=(size, columns.size)
        )
        stay: Any = sp.csr_array((np.ones(kept.size), (kept, np.arange(kept.size))), shape=(size, kept.size))
        Z: Any = (stay + place @ sp.csr_array(solved[0])).tocsr()
        Y: Any = (place @ sp.csr_array(solved[1])).tocsr()
    z0 = np.zeros(size)
    z0[columns] = np.asarray(solved[2]).ravel()
    if not dense and Z.nnz + Y.nnz > SOLVED * (block.nnz + right[0].nnz + right[1].nnz):
        solver, numbers = BandedTriangle.of(block) or factor, sp.hstack(right[:2], format="csr")
        return SolvedMap(Z, Y, z0, (_places(kept), _places(columns)), solver, -numbers, -c[used]), used
    return AffineMap(Z, Y, z0), used


def _places(index: np.ndarray) -> Any:
    """A slice where the places follow each other, which is read and written faster."""
    start = int(index[0]) if index.size else 0
    return slice(start, start + index.size) if (np.diff(index) == 1).all() else index


def _condition(block: np.ndarray) -> float:
    """Condition number, whatever the units of rows and columns."""
    rows = np.abs(block).max(axis=1, keepdims=True)
    scaled = block / np.where(rows > 0, rows, 1.0)
    columns = np.abs(scaled).max(axis=0)
    return float(np.linalg.cond(scaled / np.where(columns > 0, columns, 1.0)))


def _determining(block: Matrix, names: str) -> np.ndarray:
    """As many rows of `block` as it has columns, chosen so that they determine the columns."""
    wide = block.shape[1]
    if isinstance(block, np.ndarray):
        _, pivots = la.qr(block.T, mode="r", pivoting=True)  # type: ignore[misc]
        return np.sort(pivots[:wide])
    # the matching with the largest product of entries
    cost = sp.csr_array(block)
    cost.data = 1.0 + np.log(np.abs(cost.data).max()) - np.log(np.abs(cost.data))
    try:
        return np.sort(min_weight_full_bipartite_matching(cost)[0])
    except ValueError as error:
        raise FormError(f"cannot eliminate {names}: the equalities do not determine them (singular)") from error


def null_space(R: np.ndarray, E: np.ndarray, c: np.ndarray) -> AffineMap:
    """Coordinates v on the solutions of ``R z + E d + c = 0`` (dense; orthonormal Z, least-norm particular part).

    Raises:
        EmptyConstraintError: the rows contradict each other whatever the data are.
    """
    size = R.shape[1]
    if not R.shape[0]:
        return AffineMap.identity(size, E.shape[1], True)
    units = np.linalg.norm(R, axis=1)
    units[units == 0] = 1.0
    R, E, c = R / units[:, None], E / units[:, None], c / units
    U, s, Vt = la.svd(R)
    rank = int((s > 1e-11).sum())
    null = U[:, rank:]
    if np.abs(null.T @ np.column_stack([E, c])).max(initial=0.0) > 1e-9:
        if np.abs(null.T @ E).max(initial=0.0) <= 1e-9:
            raise EmptyConstraintError("the equalities contradict each other; no point satisfies all of them")
        raise FormError("some equality rows are combinations of others, so they restrict the data; remove them")
    inverse = Vt[:rank].T @ (U[:, :rank] / s[:rank]).T
    return AffineMap(Vt[rank:].T.copy(), -inverse @ E, -inverse @ c)
