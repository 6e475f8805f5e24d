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
        dims, start = layout.block_dims, layout.block_columns[:-1]
        every = np.concatenate([np.arange(blocks) * (blocks + 1), *(_links(entry, blocks) for entry, _ in terms)])
        every.sort()
        fresh = np.ones(every.size, bool)
        np.not_equal(every[1:], every[:-1], out=fresh[1:])
        unique = every[fresh]
        col = unique // blocks  # sorted by column, then row; the diagonal block is last
        row = unique - col * blocks
        last = np.flatnonzero(row == col)
        first = np.concatenate([[0], last + 1])[:blocks]
        height = dims[row]
        before = np.cumsum(height) - height
        above = before - before[first][col]  # rows of the column above this block
        off = above[last]
        length = _spread(off, dims) + _ramp(dims) + 1
        self.size = int(dims.sum())
        self.indptr = np.concatenate([[0], np.cumsum(length)]).astype(np.intp)
        self.diagonal = self.indptr[1:] - 1
        rows = _ramp(height) + _spread(start[row], height)
        # the columns of one instance have the same rows, only that each ends at its own diagonal
        shift = _spread(before[first], dims) - self.indptr[:-1]
        self.indices = rows[np.arange(self.nonzeros) + np.repeat(shift, length)]
        self._unique, self._start = unique, start
        self._corners, self._last, self._off = self.indptr[start[col]] + above, last, off
        self._graph = (row, col, dims)
        self.blocks, self.pairs = blocks, int(unique.size) - blocks
        self.positions = [self._positions(entry, pairs) for entry, pairs in terms]

    @property
    def nonzeros(self) -> int:
        return int(self.indptr[-1])

    @cached_property
    def columns(self) -> np.ndarray:
        """Column of every entry."""
        return np.repeat(np.arange(self.size), np.diff(self.indptr))

    @property
    def bandwidth(self) -> int:
        """Entries above the diagonal in the longest column, zeros between them included."""
        height = np.arange(self.size) - self.indices[self.indptr[:-1]]
        return int(height.max(initial=0))

    @cached_property
    def common_dim(self) -> int | None:
        """Dimension of the variable instances where all have the same."""
        return _common(self._graph[2])

    @property
    def dims(self) -> list[int]:
        """Dimensions of variable instances that occur."""
        return np.unique(self._graph[2]).tolist()

    @property
    def block_places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Instances of row and column of every block (row <= column), where it begins, entries above its diagonal.

        Entry (a, b) of a block stands at ``begin + b above + b (b + 1) / 2 + a``.
        """
        row, col, _ = self._graph
        return row, col, self._corners, self._off[col]

    @cached_property
    def elimination(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The factor of the graph of instances in an approximate minimum degree order, 32-bit integers.

        Returns:
            Starts of its columns; their rows, below the diagonal and ascending; the order (instances as they come).
        """
        import qdldl
        import scipy.sparse as sp

        row, col, _ = self._graph
        degree = np.bincount(np.concatenate([row, col]), minlength=self.blocks) + 1.0
        graph = sp.csc_matrix((self.blocks, self.blocks))
        # as it stands sorted by columns
        graph.indptr, graph.indices = np.concatenate([[0], self._last + 1]), row
        graph.data = np.where(row == col, degree[col], -1.0)
        L, _, order = qdldl.Solver(graph, upper=True).factors()
        return L.indptr, L.indices, order.astype(np.int32)

    @cached_property
    def work(self) -> float:
        """Operations of a factorization in the order of `elimination`."""
        indptr, indices, order = self.elimination
        size = self._graph[2][order].astype(float)
        rows = size + np.bincount(np.repeat(np.arange(self.blocks), np.diff(indptr)), size[indices], self.blocks)
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

    def _positions(self, entry: TermLayout, pairs: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions (pairs, count) of the entries; those that count twice (one instance in two slots), if any."""
        slot_dims = np.array([s.source.space.dim for s in entry.term.slots])
        slot_of = np.repeat(np.arange(slot_dims.size), slot_dims)
        local = _ramp(slot_dims)
        out = np.empty((len(pairs), entry.term.count), np.intp)
        twice = None
        groups: dict[tuple[int, int], list[int]] = {}
        for k, (p, q) in enumerate(pairs):
            groups.setdefault((slot_of[p], slot_of[q]), []).append(k)
        for (s, t), group in groups.items():
            a, b = local[np.array([pairs[k] for k in group]).T]
            i, j = entry.blocks[:, s], entry.blocks[:, t]
            if s == t:
                out[group] = _within(self._corners[self._last[i]], self._off[i], a, b)
                continue
            high = np.maximum(i, j)
            corner = self._corners[np.searchsorted(self._unique, _key(i, j, self.blocks))]
            found, off = _within(corner, self._off[high], a, b), self._off[high]
            swap, same = np.flatnonzero(i > j), np.flatnonzero(i == j)
            found[:, swap] = _within(corner[swap], off[swap], b, a)
            if same.size:
                found[:, same] = _within(corner[same], off[same], np.minimum(a, b), np.maximum(a, b))
                twice = np.full(out.shape, -1) if twice is None else twice
                twice[np.ix_(np.array(group)[a == b], same)] = found[np.ix_(a == b, same)]
            out[group] = found
        return out, twice


def _links(entry: TermLayout, blocks: int) -> np.ndarray:
    """Keys of all pairs of instances that the term joins."""
    slots = entry.blocks.shape[1]
    ends = [(entry.blocks[:, a], entry.blocks[:, b]) for a in range(slots) for b in range(a + 1, slots)]
    return np.concatenate([np.zeros(0, np.intp), *(_key(a, b, blocks) for a, b in ends)])


def _key(a: np.ndarray, b: np.ndarray, blocks: int) -> np.ndarray:
    return np.maximum(a, b) * blocks + np.minimum(a, b)


def _within(corner: np.ndarray, off: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Positions (entries, blocks) of entries `row`, `column` of blocks that begin at `corner`.

    The first column of the instance has `off` entries above its diagonal and each one after it has one more.
    """
    out = column[:, None] * off
    out += corner
    out += (column * (column + 1) // 2 + row)[:, None]
    return out


def _ramp(dims: np.ndarray) -> np.ndarray:
    """0..d-1 for every d, one after the other."""
    size = _common(dims)
    if size is not None:
        return np.tile(np.arange(size), dims.size)
    return np.arange(int(dims.sum())) - np.repeat(np.cumsum(dims) - dims, dims)


def _spread(values: np.ndarray, dims: np.ndarray) -> np.ndarray:
    """Each value d times; three times as fast where all d are equal."""
    size = _common(dims)
    return np.repeat(values, dims if size is None else size)


def _common(dims: np.ndarray) -> int | None:
    return int(dims[0]) if dims.size and (dims == dims[0]).all() else None
