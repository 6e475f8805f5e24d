"""Affine answers of many sets of weights, matrices and patterns of one quadratic program, by LAPACK on stacked arrays.

`StackedProgram` lowers a program once; `maps` then works out the answers of many sets of numbers without a Python loop
over them. Unknowns are condensed as in the program itself, so the answers are those of `DenseMap` to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from problems.forms.affine import Bounds, Rows
from problems.forms.layout import INFINITE, TermLayout
from problems.forms.quadratic import QuadraticProgram, clean
from problems.noise import information_matrix
from problems.problem import DataSlot
from problems.solvers.linear import FREE
from problems.solvers.qp_maps import INDEPENDENT, REFINEMENTS, WEAK

CHUNK_NUMBERS = 4_000_000  # of temporary arrays, roughly


@dataclass(eq=False)
class _Term:
    """Coefficients of a term for some sets: residual ``J z[columns] + E d + c``.

    J (sets or 1, count, dim, width), E (sets or 1, count, dim, vector data), c (sets or 1, count, dim).
    """

    layout: TermLayout
    J: np.ndarray
    E: np.ndarray
    c: np.ndarray


class StackedRows:
    """Rows of the inequalities of many sets, evaluated at their points.

    Attributes:
        count: bounded rows of one set.
    """

    def __init__(self, program: StackedProgram) -> None:
        self._program = program
        self._terms: list[list[_Term]] = [[] for _ in program.bounded]
        self._off: list[np.ndarray] = []
        self.count = program.lower.constant.size

    def add(self, terms: list[_Term], off: np.ndarray) -> None:
        """Take the coefficients of a chunk of sets, and (sets, rows) rows that are switched off."""
        for kept, term in zip(self._terms, terms, strict=True):
            if not kept or len(term.J) > 1 or len(term.E) > 1 or len(term.c) > 1:
                kept.append(term)
        self._off.append(off)

    @cached_property
    def _stacked(self) -> tuple[list[Any], np.ndarray | None]:
        def joined(parts: list[np.ndarray]) -> np.ndarray:
            return parts[0] if len(parts[0]) == 1 and len(parts) == 1 else np.concatenate(parts)

        found = []
        for kept in self._terms:
            J, E, c = (joined([getattr(term, name) for term in kept]) for name in ("J", "E", "c"))
            size, data = self._program.size, E.shape[-1]
            dense = None
            if len(J) == 1:  # the same in all sets: one matrix for all of them
                dense = np.zeros((J.shape[1] * J.shape[2], size))
                at = np.arange(len(dense)).reshape(J.shape[1:3] + (1,))
                np.add.at(dense, (at, kept[0].layout.columns[:, None]), J[0])
            E = E.reshape(len(E), -1, data)
            used = np.flatnonzero(E.any(axis=(0, 1)))
            found.append((kept[0].layout, J, dense, E[..., used], used, c.reshape(len(c), -1)))
        off = np.concatenate(self._off)
        return found, off if off.any() else None

    def values(self, sets: Any, z: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(m, rows) of points z (m, unknowns) for data d (m, vector data) of the sets numbered by `sets`."""
        out = []
        for layout, J, dense, E, used, c in self._stacked[0]:
            if dense is not None:
                rows = z @ dense.T
            else:
                at = z[:, layout.columns]
                rows = (J[sets] @ at[..., None])[..., 0].reshape(len(z), -1)
            if used.size:
                given = d[:, used]
                rows += given @ E[0].T if len(E) == 1 else (E[sets] @ given[..., None])[..., 0]
            if c.any():
                rows += c if len(c) == 1 else c[sets]
            out.append(rows)
        return out[0] if len(out) == 1 else np.hstack(out)

    def coefficients(self, sets: np.ndarray) -> np.ndarray:
        """(m, rows, unknowns) of some sets."""
        parts = []
        for layout, J, dense, *_ in self._stacked[0]:
            if dense is not None:
                parts.append(np.broadcast_to(dense, (len(sets), *dense.shape)))
                continue
            count, dim, _ = J.shape[1:]
            full = np.zeros((len(sets), count * dim, self._program.size))
            at = np.arange(count * dim).reshape(count, dim, 1)
            for place in range(layout.columns.shape[1]):  # columns of an instance may repeat
                full[:, at[..., 0], layout.columns[:, place, None]] += J[sets][..., place]
            parts.append(full)
        return np.concatenate(parts, axis=1)

    def bounds(self, sets: Any, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds (m or 1, rows) for all numbers (m, data), missing ones read as zero."""
        lower, upper = (_bound(bound, numbers) for bound in (self._program.lower, self._program.upper))
        off = self._stacked[1]
        if off is not None:
            lower, upper = np.where(off[sets], -np.inf, lower), np.where(off[sets], np.inf, upper)
        return lower, upper


def _bound(bound: Bounds, numbers: np.ndarray) -> np.ndarray:
    if not bound.index.size or bound.index.max() < 0:
        return bound.constant[None]
    given = np.where(bound.index >= 0, numbers[:, bound.index], bound.constant)
    return np.where(np.abs(given) >= INFINITE, np.copysign(np.inf, given), given)


@dataclass(eq=False)
class _Costs:
    """Rows of the costs of some sets: (R' W, R, E) of every term, and what linear costs add to the gradient."""

    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    linear: np.ndarray

    def refine(self, V: np.ndarray, P: np.ndarray, sets: np.ndarray) -> None:
        """Improve the answers V (sets, k, vector data and constant) of some sets by the gradient of the rows."""
        for _ in range(REFINEMENTS):
            gradient = self.linear[sets]
            for term in self.rows:
                WR, R, E = (part if len(part) == 1 else part[sets] for part in term)
                gradient = gradient + WR @ (R @ V[sets] + E)
            V[sets] -= np.linalg.solve(P[sets], gradient)


@dataclass(eq=False)
class StackedMaps:
    """Answers ``z = T d + t`` of many sets while no inequality is active.

    Attributes:
        T: (sets, unknowns, vector data).
        t: (sets, unknowns).
        half: (sets, unknowns, k) with ``half half'`` the covariance of the unknowns; None without inequalities.
        definite: (sets,) which of them have an answer.
        rows: their inequalities; None without.
    """

    T: np.ndarray
    t: np.ndarray
    half: np.ndarray | None
    definite: np.ndarray
    rows: StackedRows | None

    @property
    def nbytes(self) -> int:
        return self.T.nbytes + self.t.nbytes + (0 if self.half is None else self.half.nbytes)


class StackedProgram:
    """A dense program whose equalities all serve to eliminate unknowns.

    Attributes:
        columns: positions of vector data among all numbers.
        factorizations: matrices factorized so far.
    """

    def __init__(self, program: QuadraticProgram) -> None:
        layout = program.layout
        self.program, self.size = program, layout.size
        starts, inputs = layout.data_start, program.problem.inputs
        vector = [n for n, speed in program.speeds.items() if speed == "vector" and inputs[n].of is None]
        self.columns = np.concatenate(
            [np.zeros(0, np.intp), *(np.arange(starts[n], starts[n] + inputs[n].rows * inputs[n].size) for n in vector)]
        )
        self.columns = np.setdiff1d(self.columns, layout.bound_numbers)
        self._place = np.full(layout.data_size, -1)
        self._place[self.columns] = np.arange(self.columns.size)
        self.factorizations = 0
        parts = program.rows.parts
        self._costs = [p for p in parts if p[0].term.kind == "cost"]
        self._equalities = [p for p in parts if p[0].term.kind == "equality"]
        self.bounded = [p for p in parts if p[0].term.kind == "inequality"]
        rows: list[Rows] = [Rows(entry, code.dim, None, None, np.zeros(0)) for entry, code, _, _ in self.bounded]
        self.lower, self.upper = Bounds.of(layout, rows, "lower"), Bounds.of(layout, rows, "upper")
        columns = [layout.columns(slot).ravel() for slot in program.eliminated]
        self._eliminated = np.unique(np.concatenate([np.zeros(0, np.intp), *columns]))
        self._kept = np.setdiff1d(np.arange(self.size), self._eliminated)

    @classmethod
    def of(cls, program: QuadraticProgram) -> StackedProgram | None:
        """None where equalities remain after the elimination, or the program is sparse."""
        if not program.dense:
            return None
        found = cls(program)
        count = sum(entry.term.count * code.dim for entry, code, _, _ in found._equalities)
        return found if count == found._eliminated.size else None

    def maps(self, numbers: np.ndarray) -> StackedMaps:
        """Answers for (sets, data) numbers, missing ones NaN.

        Raises:
            DataError, NoiseError: as for a single solve; names the term.
        """
        bounded = bool(self.bounded)
        rows = StackedRows(self) if bounded else None
        sets, n, d, k = len(numbers), self.size, self.columns.size, self._kept.size
        T, t = np.empty((sets, n, d)), np.empty((sets, n))
        half = np.empty((sets, n, k)) if bounded else None
        definite = np.empty(sets, bool)
        tall = sum(entry.term.count * code.dim for entry, code, _, _ in (*self._costs, *self._equalities))
        chunk = max(1, CHUNK_NUMBERS // ((tall + 2 * n) * (n + d + 1)))
        for start in range(0, sets, chunk):
            part = slice(start, start + chunk)
            given = numbers[part]
            flags = self._flags(given)
            cleaned = clean(given)
            P, Q, Z, Y, costs = self._condensed(cleaned, flags)
            P, L, definite[part], weak = _factors(P)
            self.factorizations += len(given)
            V = -np.linalg.solve(P, Q)
            if weak.size:
                costs.refine(V, P, weak)
            answer = V if Z is None else Z @ V + Y
            T[part], t[part] = answer[..., :-1], answer[..., -1]
            definite[part] &= np.isfinite(answer).all(axis=(1, 2))
            if rows is not None and half is not None:
                inverse = np.swapaxes(np.linalg.inv(L), -1, -2)
                half[part] = inverse if Z is None else Z @ inverse
                terms = [self._term(p, cleaned) for p in self.bounded]
                off = [
                    np.zeros((len(given), entry.term.count * code.dim), bool)
                    if flags[id(entry)] is None
                    else np.repeat(~flags[id(entry)], code.dim, axis=1)
                    for entry, code, _, _ in self.bounded
                ]
                rows.add(terms, np.hstack(off))
        return StackedMaps(T, t, half, definite, rows)

    def _flags(self, numbers: np.ndarray) -> dict[int, Any]:
        """(sets, count) active instances of each term; None where all are."""
        flags = self.program.activity.flags(numbers)
        return {id(entry): on for entry, on in zip(self.program.layout.terms, flags, strict=True)}

    def _term(self, part: tuple[Any, ...], numbers: np.ndarray) -> _Term:
        entry, code, slow, fast = part
        sets, count = (1 if code.constant else len(numbers)), entry.term.count
        J, E, c = code(numbers[:sets, slow].reshape(sets * count, -1), sets * count)
        placed = np.zeros((sets, count, code.dim, self.columns.size))
        J, E, c = (
            np.broadcast_to(a, (sets * count, *a.shape[1:])).reshape(sets, count, *a.shape[1:]) for a in (J, E, c)
        )
        for place in range(fast.shape[1]):  # a number may be read twice
            placed[:, np.arange(count), :, self._place[fast[:, place]]] += np.moveaxis(E[..., place], 1, 0)
        return _Term(entry, J, placed, c)

    def _eliminate(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Z (sets or 1, unknowns, kept) and Y (sets or 1, unknowns, vector data and constant)."""
        terms = [self._term(p, numbers) for p in self._equalities]
        sets = max(len(term.J) for term in terms)
        blocks = []
        for term in terms:
            _, count, dim, _ = term.J.shape
            full = np.zeros((sets, count, dim, self.size))
            for place in range(term.layout.columns.shape[1]):
                full[:, np.arange(count), :, term.layout.columns[:, place]] += np.moveaxis(term.J[..., place], 1, 0)
            rest = np.concatenate([term.E, term.c[..., None]], axis=-1)
            blocks.append(
                np.concatenate([full, np.broadcast_to(rest, (sets, *rest.shape[1:]))], axis=-1).reshape(
                    sets, count * dim, -1
                )
            )
        R = np.concatenate(blocks, axis=1)
        right = np.concatenate([R[..., self._kept], R[..., self.size :]], axis=-1)
        solved = -np.linalg.solve(R[..., self._eliminated], right)
        k = self._kept.size
        Z, Y = np.zeros((sets, self.size, k)), np.zeros((sets, self.size, right.shape[-1] - k))
        Z[:, self._kept, np.arange(k)] = 1.0
        Z[:, self._eliminated], Y[:, self._eliminated] = solved[..., :k], solved[..., k:]
        return Z, Y

    def _condensed(self, numbers: np.ndarray, flags: dict[int, Any]) -> tuple[Any, ...]:
        """P (sets, k, k), Q (sets, k, vector data and constant) of the kept unknowns, the map to all, and the rows."""
        Z, Y = self._eliminate(numbers) if self._equalities else (None, None)
        k, d = self._kept.size, self.columns.size + 1
        P, Q = np.zeros((len(numbers), k, k)), np.zeros((len(numbers), k, d))
        costs = _Costs([], np.zeros_like(Q))
        for part in self._costs:
            entry, on = part[0], flags[id(part[0])]
            term = self._term(part, numbers)
            E = np.concatenate([term.E, term.c[..., None]], axis=-1)
            if Z is None or Y is None:
                R = np.zeros((len(term.J), *term.J.shape[1:3], k))
                for place in range(entry.columns.shape[1]):
                    at = entry.columns[:, place]
                    R[:, np.arange(entry.term.count), :, at] += np.moveaxis(term.J[..., place], 1, 0)
            else:
                R = term.J @ Z[:, entry.columns]
                E = E + term.J @ Y[:, entry.columns]
            W = self._information(entry, part[1].dim, numbers)
            if on is not None:
                W = W * on[..., None, None]
            WR = np.swapaxes(_flat(W @ R), -1, -2)
            P += WR @ _flat(R)
            Q += WR @ _flat(E)
            self._add_linear(entry, R, on, costs.linear)
            costs.rows.append((WR, _flat(R), _flat(E)))
        return P, Q + costs.linear, Z, Y, costs

    def _information(self, entry: TermLayout, dim: int, numbers: np.ndarray) -> np.ndarray:
        """(sets or 1, count or 1, dim, dim)."""
        term = entry.term
        assert term.noise is not None
        value = term.noise.value
        if not isinstance(value, DataSlot):
            return information_matrix(term.noise.kind, value, dim, term.count, term.what)[None]
        given = numbers[:, self.program.layout.numbers(value)]
        sets, rows = given.shape[:2]
        if term.noise.kind == "sigma":
            flat = np.broadcast_to(given, (sets, rows, dim)).reshape(sets * rows, dim)
        else:
            flat = given.reshape(sets * rows, dim, dim)
        found = information_matrix(term.noise.kind, flat, dim, sets * rows, term.what)
        return found.reshape(sets, rows, dim, dim)

    def _add_linear(self, entry: TermLayout, R: np.ndarray, on: Any, Q: np.ndarray) -> None:
        linear = entry.term.linear
        if linear is None:
            return
        if on is not None:
            R = R * on[..., None, None]
        if entry.linear is None:
            given = np.broadcast_to(np.asarray(linear, dtype=float), R.shape[1:3])
            Q[..., -1] += np.einsum("scdk,cd->sk", R, given)
            return
        index = self._place[np.broadcast_to(entry.linear, R.shape[1:3])]
        turned = np.moveaxis(R, -1, 1)  # (sets, k, count, dim)
        for instance in range(index.shape[0]):
            Q[:, :, index[instance]] += turned[:, :, instance]


def _flat(rows: np.ndarray) -> np.ndarray:
    """(sets, count, dim, width) as (sets, count * dim, width)."""
    return rows.reshape(len(rows), -1, rows.shape[-1])


def _factors(P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """P with what is not definite replaced by the identity, Cholesky factors, which sets are definite, weak sets."""
    definite = np.full(len(P), True)
    diagonal = np.einsum("sii->si", P)
    try:
        L = np.linalg.cholesky(P)
        share = (np.einsum("sii->si", L) ** 2 / diagonal).min(axis=1, initial=1.0)
    except np.linalg.LinAlgError:
        L, share = None, np.zeros(len(P))
    doubtful = np.flatnonzero(share <= INDEPENDENT)
    if doubtful.size:  # the scale-free test of `DenseMap`
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))[doubtful]
        smallest = np.linalg.eigvalsh(P[doubtful] * scale[:, :, None] * scale[:, None])[:, 0]
        definite[doubtful], share[doubtful] = smallest > FREE, smallest
        if L is None or not definite.all():
            P = np.where(definite[:, None, None], P, np.eye(P.shape[-1]))
            L = np.linalg.cholesky(P)
    assert L is not None
    return P, L, definite, np.flatnonzero(definite & (share < WEAK))
