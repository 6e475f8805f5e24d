"""Sparsity of the Gauss-Newton Hessian of all costs, and where each term adds its entries.

The matrix is stored by columns, upper triangle (what LDL' factorizations take). The pattern is found once on pairs of
variable instances; an assembly is one weighted count per term.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from problems.forms.layout import Layout, TermLayout


class HessianPattern:
    """Upper triangle of the Hessian by columns.

    Attributes:
        size: unknowns.
        indptr, indices: compressed columns.
        diagonal: position of every diagonal entry.
        blocks, pairs: variable instances, and how many pairs of them share a term.
    """

    def __init__(self, layout: Layout, terms: Sequence[tuple[TermLayout, Sequence[tuple[int, int]]]]) -> None:
        blocks = layout.block_dims.size
        dims, start = layout.block_dims, layout.block_columns
        keys = [np.arange(blocks) * blocks + np.arange(blocks)]
        for entry, _ in terms:
            slots = entry.blocks.shape[1]
            for a in range(slots):
                for b in range(a + 1, slots):
                    keys.append(_key(entry.blocks[:, a], entry.blocks[:, b], blocks))
        every = np.concatenate(keys)
        every.sort()
        fresh = np.ones(every.size, bool)
        np.not_equal(every[1:], every[:-1], out=fresh[1:])
        unique = every[fresh]
        col, row = unique // blocks, unique % blocks  # sorted by column, then row; the diagonal block is last
        height = dims[row]
        first = np.searchsorted(col, np.arange(blocks))
        before = np.cumsum(height) - height
        above = before - before[first][col]  # rows of the column above this block
        off = np.zeros(blocks, np.intp)
        np.add.at(off, col[row != col], height[row != col])
        length = np.repeat(off, dims) + _ramp(dims) + 1
        self.size = int(dims.sum())
        self.indptr = np.concatenate([[0], np.cumsum(length)]).astype(np.intp)
        self.diagonal = self.indptr[1:] - 1
        self._unique, self._above, self._start = unique, above, start
        self._graph = (row, col, dims)
        self.blocks, self.pairs = blocks, int(unique.size) - blocks
        self.indices = self._row_indices(col, row, dims)
        self.positions = [self._positions(entry, pairs) for entry, pairs in terms]

    @property
    def nonzeros(self) -> int:
        return int(self.indptr[-1])

    @property
    def bandwidth(self) -> int:
        """Entries above the diagonal in the longest column, zeros between them included."""
        height = np.arange(self.size) - self.indices[self.indptr[:-1]]
        return int(height.max(initial=0))

    @cached_property
    def work(self) -> float:
        """Operations of a factorization in an approximate minimum degree order of the variable instances."""
        import qdldl
        import scipy.sparse as sp

        row, col, dims = self._graph
        degree = np.bincount(np.concatenate([row, col]), minlength=self.blocks) + 1.0
        values = np.where(row == col, degree[col], -1.0)
        graph = sp.csc_matrix((values, (row, col)), shape=(self.blocks, self.blocks))
        L, _, order = qdldl.Solver(graph, upper=True).factors()
        size = dims[order].astype(float)
        rows = size + np.bincount(np.repeat(np.arange(self.blocks), np.diff(L.indptr)), size[L.indices], self.blocks)
        return float((size * rows**2).sum())

    def independent_blocks(self) -> list[np.ndarray]:
        """Variable instances of which no two share a term, chosen from the fewest neighbours up.

        Returns:
            Their columns (count, dim), one array for each dimension that occurs.
        """
        row, col, dims = self._graph
        off = row != col
        ends = np.concatenate([row[off], col[off]]), np.concatenate([col[off], row[off]])
        order = np.argsort(ends[0], kind="stable")
        degree = np.bincount(ends[0], minlength=self.blocks)
        neighbors = np.split(ends[1][order], np.cumsum(degree)[:-1])
        free = np.ones(self.blocks, bool)
        chosen = []
        for block in np.argsort(degree, kind="stable"):
            if free[block]:
                chosen.append(block)
                free[neighbors[block]] = False
        picked = np.array(chosen)
        return [
            self._start[part][:, None] + np.arange(dim)
            for dim in np.unique(dims[picked])
            if (part := picked[dims[picked] == dim]).size
        ]

    def _row_indices(self, col: np.ndarray, row: np.ndarray, dims: np.ndarray) -> np.ndarray:
        indices = np.empty(self.nonzeros, np.intp)
        for width in np.unique(dims):
            for height in np.unique(dims):
                pick = np.flatnonzero((dims[col] == width) & (dims[row] == height))
                c, r, up = col[pick], row[pick], self._above[pick]
                if not pick.size:
                    continue
                a, b = np.arange(height), np.arange(width)
                at = (self.indptr[self._start[c][:, None] + b] + up[:, None])[:, :, None] + a
                rows = np.broadcast_to(self._start[r][:, None, None] + a, at.shape)
                use = (c != r)[:, None, None] | (a <= b[:, None])
                indices[at[use]] = rows[use]
        return indices

    def _positions(self, entry: TermLayout, pairs: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions (pairs, count) of the entries; those that count twice (one instance in two slots), if any."""
        slot_dims = [int(s.source.space.dim) for s in entry.term.slots]
        slot_of = np.repeat(np.arange(len(slot_dims)), slot_dims)
        local = _ramp(np.array(slot_dims))
        out = np.empty((len(pairs), entry.term.count), np.intp)
        twice = np.full(out.shape, -1) if _repeats(entry) else None
        groups: dict[tuple[int, int], list[int]] = {}
        for k, (p, q) in enumerate(pairs):
            groups.setdefault((slot_of[p], slot_of[q]), []).append(k)
        for (s, t), group in groups.items():
            p, q = np.array([pairs[k] for k in group]).T[:, :, None]
            bi, bj = entry.blocks[:, s], entry.blocks[:, t]
            up = self._above[np.searchsorted(self._unique, _key(bi, bj, self.blocks))]
            ci, cj = self._start[bi] + local[p], self._start[bj] + local[q]
            at = self.indptr[cj] + local[p]
            if s != t:
                at = np.where(ci > cj, self.indptr[ci] + local[q], at)
            out[group] = at + up
            if twice is not None and s != t:
                twice[group] = np.where(ci == cj, out[group], -1)
        return out, twice


def _repeats(entry: TermLayout) -> bool:
    """Whether one instance fills two slots of the term."""
    blocks = np.sort(entry.blocks, axis=1)
    return bool((blocks[:, 1:] == blocks[:, :-1]).any())


def _key(a: np.ndarray, b: np.ndarray, blocks: int) -> np.ndarray:
    return np.maximum(a, b) * blocks + np.minimum(a, b)


def _ramp(dims: np.ndarray) -> np.ndarray:
    """0..d-1 for every d, one after the other."""
    total = int(dims.sum())
    return np.arange(total) - np.repeat(np.cumsum(dims) - dims, dims)
