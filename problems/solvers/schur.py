"""Schur complement: many instances that share no term with each other are eliminated first, block by block.

The classical way for few poses that see many landmarks: what remains is a matrix of the size of the poses alone. Where
landmarks are few and poses many the remainder fills in completely; a fill-reducing order is then far better.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpotrf, dpotrs  # type: ignore[attr-defined]

from problems.forms.sparsity import HessianPattern
from problems.solvers.factorizations import SingularError, check_values


class SchurComplement:
    """Dense Cholesky of ``A - B C^-1 B'`` with C block diagonal; see `problems.solvers.factorizations`."""

    name: ClassVar[str] = "schur"

    def __init__(self, pattern: HessianPattern) -> None:
        self._pattern = pattern
        blocks = pattern.independent_blocks()
        inside = np.zeros(pattern.size, bool)
        inside[np.concatenate([part.ravel() for part in blocks])] = True
        self._rest, self._gone = np.flatnonzero(~inside), np.flatnonzero(inside)
        place = np.empty(pattern.size, np.intp)
        place[self._rest], place[self._gone] = np.arange(self._rest.size), np.arange(self._gone.size)
        rows, columns = pattern.indices, pattern.columns
        kept = ~inside[rows] & ~inside[columns]
        self._a = (np.flatnonzero(kept), place[rows[kept]], place[columns[kept]])
        mixed = np.flatnonzero(inside[rows] ^ inside[columns])
        first, second = rows[mixed], columns[mixed]
        swap = inside[first]
        ends = (place[np.where(swap, second, first)], place[np.where(swap, first, second)])
        shape = (self._rest.size, self._gone.size)
        order = sp.csr_matrix((np.arange(mixed.size) + 1.0, ends), shape=shape)
        self._B, self._b = order, mixed[order.data.astype(np.intp) - 1]
        self._c = [self._positions(part, rows, columns) for part in blocks]
        self._local = [place[part] for part in blocks]
        self._factor: Any = None

    def _positions(self, part: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Position in the pattern of every entry of diagonal blocks: (count, dim, dim)."""
        size = self._pattern.size
        keys = rows * size + columns
        order = np.argsort(keys)
        low, high = np.minimum(part[:, :, None], part[:, None]), np.maximum(part[:, :, None], part[:, None])
        return order[np.searchsorted(keys[order], low * size + high)]

    def factor(self, values: np.ndarray) -> None:
        check_values(values, self._pattern)
        n = self._rest.size
        S = np.zeros((n, n))
        at, rows, columns = self._a
        S[rows, columns] = S[columns, rows] = values[at]
        self._B.data = values[self._b]
        entries, ends = [], ([], [])
        try:
            for local, positions in zip(self._local, self._c, strict=True):
                inverse = np.linalg.inv(values[positions])
                entries.append(inverse.ravel())
                ends[0].append(np.broadcast_to(local[:, :, None], inverse.shape).ravel())
                ends[1].append(np.broadcast_to(local[:, None], inverse.shape).ravel())
        except np.linalg.LinAlgError as error:
            raise SingularError("an eliminated block is singular") from error
        size = self._gone.size
        index = (np.concatenate(ends[0]), np.concatenate(ends[1]))
        self._inverse = sp.csr_matrix((np.concatenate(entries), index), shape=(size, size))
        S -= (self._B @ self._inverse @ self._B.T).toarray()
        self._factor, info = dpotrf(S, lower=1)
        if info != 0:
            raise SingularError(f"leading minor {info} of the Schur complement is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        out = np.empty_like(right)
        carried = self._inverse @ right[self._gone]
        x = dpotrs(self._factor, right[self._rest] - self._B @ carried, lower=1)[0]
        out[self._rest] = x
        out[self._gone] = carried - self._inverse @ (self._B.T @ x)
        return out
