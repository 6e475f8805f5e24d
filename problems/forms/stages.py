"""Stages of a quadratic program: a chain ``x_0 u_0, x_1 u_1, ...`` joined by ``x_{k+1} = A_k x_k + B_k u_k + b_k``.

Found from the pattern alone, whatever the order of unknowns and rows. An equality row either stays within a stage or
defines one unknown of the next stage from unknowns of its own. Unknowns that P or an inequality joins share a stage,
and so do two that occur together in two equality rows (neither can be defined twice). What this leaves open is chosen
and propagated; a choice that leads to a contradiction is taken back.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

OPEN, LOCAL = -2, -1  # states of a row besides the unknown it defines


@dataclass(frozen=True, eq=False)
class Stages:
    """Order and sizes of the stages.

    Attributes:
        unknowns: (n,) their order: stage after stage, of each the states and then the controls.
        rows: (m,) their order: stage after stage, of each those that define the next states (in the order of these),
            then the others.
        states: (N + 1,) unknowns of each stage that a row of the stage before defines.
        controls: (N + 1,) the other unknowns of each stage; 0 in the last.
        others: (N + 1,) rows of each stage that define no state.
        defining: (m,) by row as given, the unknown it defines or -1.
    """

    unknowns: np.ndarray
    rows: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    others: np.ndarray
    defining: np.ndarray


def find_stages(P: Any, A: Any, equal: np.ndarray) -> Stages | None:
    """The stages of ``min 1/2 x'Px + q'x, l <= Ax <= u``, or None where there is no chain of at least two.

    Args:
        P: (n, n), dense or sparse; numbers that are zero do not count.
        A: (m, n).
        equal: (m,) whether a row is an equality.
    """
    A = _pattern(A)
    chain = _Chain(_pattern(P), A, np.flatnonzero(equal), np.flatnonzero(~equal))
    if not chain.solve():
        return None
    unknowns = np.arange(A.shape[1])
    lowest = np.zeros(unknowns.size, int)
    np.minimum.at(lowest, chain.part, chain.level)
    level = chain.level - lowest[chain.part]
    if not level.any():
        return None
    defining = np.full(A.shape[0], LOCAL)
    defining[np.flatnonzero(equal)] = chain.defines
    is_state = np.zeros(unknowns.size, bool)
    is_state[defining[defining >= 0]] = True
    last = int(level.max())
    # controls of the last stage need one after it, which may be empty
    count = last + 1 + int((~is_state & (level == last)).any())
    first = np.full(A.shape[0], count)
    np.minimum.at(first, np.repeat(np.arange(A.shape[0]), np.diff(A.indptr)), level[A.indices])
    first[first == count] = 0  # empty rows
    order, rows = [unknowns[~is_state & (level == 0)]], []
    for k in range(count):
        dynamics = np.flatnonzero((defining >= 0) & (first == k))
        rows += [dynamics, np.flatnonzero((defining < 0) & (first == k))]
        order += [defining[dynamics], unknowns[~is_state & (level == k + 1)]]
    return Stages(
        np.concatenate(order),
        np.concatenate(rows),
        np.bincount(level[is_state], minlength=count),
        np.bincount(level[~is_state], minlength=count),
        np.bincount(first[defining < 0], minlength=count),
        defining,
    )


def _pattern(matrix: Any) -> Any:
    matrix = sp.csr_array(matrix, copy=True)
    matrix.eliminate_zeros()
    matrix.sum_duplicates()
    return matrix


class _Chain:
    """Levels of the unknowns, known up to a constant in each part, and what the equality rows define."""

    def __init__(self, P: Any, A: Any, equal: np.ndarray, others: np.ndarray) -> None:
        n = P.shape[0]
        ones = sp.csr_array((np.ones(A.nnz, np.int32), A.indices, A.indptr), shape=A.shape)
        E, G = ones[equal], ones[others]
        together = sp.coo_array(E.T @ E)
        twice = (together.data >= 2) & (together.row != together.col)
        # an inequality joins each of its unknowns to its first
        ends = np.repeat(G.indices[G.indptr[:-1][np.diff(G.indptr) > 0]], np.diff(G.indptr)[np.diff(G.indptr) > 0])
        p = sp.coo_array(P)
        rows = np.concatenate([p.row, together.row[twice], ends])
        columns = np.concatenate([p.col, together.col[twice], G.indices])
        joined = sp.coo_array((np.ones(rows.size), (rows, columns)), shape=(n, n))
        self.part = connected_components(joined, directed=False)[1].astype(np.intp)
        self.level = np.zeros(n, int)
        self.defines = np.full(equal.size, OPEN)
        self._defined = np.zeros(n, bool)
        self._of = [part.tolist() for part in np.split(E.indices, E.indptr[1:-1])] if equal.size else []
        by_unknown = sp.csc_array(E)
        self._with = [part.tolist() for part in np.split(by_unknown.indices, by_unknown.indptr[1:-1])]
        self._uses = np.diff(by_unknown.indptr)

    def solve(self) -> bool:
        """Find levels; whether there are any."""
        if not len(self._of) or not self._propagate(range(len(self._of))):
            return False
        # rows with fewer options first, since their choice is safer; then the newest, to go on along the chain
        age = itertools.count(0, -1)
        waiting = [(len(self._options(k)), next(age), k) for k in np.flatnonzero(self.defines == OPEN).tolist()]
        heapq.heapify(waiting)
        while waiting:
            row = heapq.heappop(waiting)[2]
            if self.defines[row] != OPEN:
                continue
            before = self.defines.copy()
            if not self._choose(row):
                return False
            settled = np.flatnonzero((before == OPEN) & (self.defines != OPEN)).tolist()
            near = {other for k in settled for other in self._near(k) if self.defines[other] == OPEN}
            for other in sorted(near):
                heapq.heappush(waiting, (len(self._options(other)), next(age), other))
        return True

    def _choose(self, row: int) -> bool:
        """Settle an open row by the first choice that contradicts nothing yet."""
        # what other rows build on continues the chain; then, what more rows use
        known = {v for k in self._near(row) if self.defines[k] >= 0 for v in self._of[k]}
        candidates = sorted(self._options(row), key=lambda v: (v == LOCAL, v not in known, -self._uses[v]))
        for chosen in candidates:
            kept = self.part.copy(), self.level.copy(), self.defines.copy(), self._defined.copy()
            if self._propagate(self._settle(row, chosen)):
                return True
            self.part, self.level, self.defines, self._defined = kept
        return False

    def _near(self, row: int) -> set[int]:
        return {other for v in self._of[row] for other in self._with[v]}

    def _propagate(self, rows: Any) -> bool:
        """Settle all rows that have one option; False on a contradiction."""
        waiting = list(rows)
        while waiting:
            row = waiting.pop()
            options = self._options(row)
            if self.defines[row] != OPEN:
                if self.defines[row] not in options:
                    return False
            elif not options:
                return False
            elif len(options) == 1:
                waiting += self._settle(row, options[0])
        return True

    def _options(self, row: int) -> list[int]:
        """Unknowns that a row may define (or LOCAL) by the levels known so far."""
        by_part: dict[int, list[tuple[int, int]]] = {}
        unknowns = self._of[row]
        for v, part, level in zip(unknowns, self.part[unknowns].tolist(), self.level[unknowns].tolist(), strict=True):
            by_part.setdefault(part, []).append((level, v))
        uneven = []
        for inside in by_part.values():
            lowest = min(inside)[0]
            above = [(level, v) for level, v in inside if level > lowest]
            if len(above) > 1 or (above and above[0][0] != lowest + 1):
                return []
            uneven += above
        if len(uneven) > 1:
            return []
        free = [uneven[0][1]] if uneven else [inside[0][1] for inside in by_part.values() if len(inside) == 1]
        options = [v for v in free if not self._defined[v] or self.defines[row] == v] if len(unknowns) > 1 else []
        return options if uneven else [*options, LOCAL]

    def _settle(self, row: int, chosen: int) -> list[int]:
        """Take an option; the rows it may concern."""
        self.defines[row] = chosen
        unknowns = self._of[row]
        touched: list[int] = []
        if chosen >= 0:
            self._defined[chosen] = True
            touched += self._with[chosen]
        anchor = next((v for v in unknowns if v != chosen), -1)
        for v in unknowns:
            if self.part[v] == self.part[anchor]:
                continue
            shift = self.level[anchor] + (v == chosen) - self.level[v]
            one, other = (np.flatnonzero(self.part == self.part[x]) for x in (anchor, v))
            moved, part = (other, self.part[anchor]) if other.size <= one.size else (one, self.part[v])
            self.level[moved] += shift if moved is other else -shift
            self.part[moved] = part
            touched += [k for x in moved.tolist() for k in self._with[x]]
        return [k for k in dict.fromkeys(touched) if k != row]
