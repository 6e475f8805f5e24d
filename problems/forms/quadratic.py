"""`QuadraticProgram`: an affine problem as ``1/2 v'Pv + q'v`` subject to ``l <= A v <= u``, as a function of the data.

P and A change with weight and matrix data only; q, l, u are affine in the vector data. `condense` gives the same
problem in fewer unknowns (windows F1, F2, F3, P1, P2 of the spec ``dmhe-pre-estimation`` 3.4 are one definition each).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from problems.errors import DefinitionError
from problems.forms.affine import (
    AffineRows,
    Bounds,
    Matrix,
    Rows,
    data_speeds,
    information_of,
    require_affine,
    weigh,
)
from problems.forms.condensing import AffineMap, eliminate, null_space
from problems.forms.layout import INFINITE, Activity, DataStore, Layout, constant_rows
from problems.forms.template import template_of
from problems.problem import DataSlot, Problem, Slot, Variable

DENSE_LIMIT = 150_000  # numbers in the largest matrices of the dense form; beyond, matrices are sparse
PATTERNS = 64  # patterns of missing data whose matrices are kept
MATRICES = 16  # sets of matrix data whose condensed programs are kept


@dataclass(eq=False)
class QPMatrices:
    """Numbers of a quadratic program. Rows of A: equalities first, then inequalities."""

    P: Matrix
    q: np.ndarray
    A: Matrix
    l: np.ndarray
    u: np.ndarray


@dataclass(eq=False)
class CostTerm:
    """A cost in the unknowns v: rows, their whitened share if the weights are constant, the linear part."""

    rows: Rows
    constant: bool
    linear: np.ndarray | None
    linear_data: Matrix | None

    @property
    def name(self) -> str:
        return self.rows.layout.term.name


class Reduced:
    """A quadratic program for given matrix data, in the coordinates v of `map`.

    Attributes:
        map: all unknowns z from v and the vector data.
        A, E, c: rows ``A v + E d + c``, the first `equalities` of them required to be zero, the others bounded.
    """

    def __init__(
        self,
        rows: list[Rows],
        lower: Bounds,
        upper: Bounds,
        map_: AffineMap,
        equality: tuple[Matrix, Matrix, np.ndarray],
    ) -> None:
        self.map, self.lower, self.upper = map_, lower, upper
        self._original = rows
        self.costs = [_cost(r, map_) for r in rows if r.layout.term.kind == "cost"]
        bounded = [r for r in rows if r.layout.term.kind == "inequality"]
        self.bounded = bounded
        R = _stack([equality[0] @ map_.Z, *(r.R @ map_.Z for r in bounded)])
        E = _stack([equality[1] + equality[0] @ map_.Y, *(r.E + r.R @ map_.Y for r in bounded)])
        c = np.concatenate([equality[2] + equality[0] @ map_.z0, *(r.c + r.R @ map_.z0 for r in bounded)])
        self.A, self.E, self.c = R, E, c
        self.equalities = equality[0].shape[0]
        self._constants: dict[bytes, tuple[Matrix, Matrix, np.ndarray]] = {}
        self._given: dict[bytes, Given] = {}

    @property
    def size(self) -> int:
        return self.map.Z.shape[1]

    @property
    def dense(self) -> bool:
        return isinstance(self.map.Z, np.ndarray)

    @property
    def bounds_vary(self) -> bool:
        """Whether data are bounds."""
        return bool((self.lower.index >= 0).any() or (self.upper.index >= 0).any())

    @cached_property
    def inner(self) -> AffineMap | None:
        """v from coordinates on the solutions of the remaining equalities; None where there are none (dense only)."""
        m = self.equalities
        return null_space(self.A[:m], self.E[:m], self.c[:m]) if m else None

    @cached_property
    def without_equalities(self) -> Reduced:
        """The same program on the solutions of its equalities (dense only)."""
        if self.inner is None:
            return self
        none = (np.zeros((0, self.map.Z.shape[0])), np.zeros((0, self.E.shape[1])), np.zeros(0))
        return Reduced(self._original, self.lower, self.upper, self.map.then(self.inner), none)

    def weighted(
        self, store: DataStore, flags: dict[str, np.ndarray | None], pattern: bytes = b""
    ) -> tuple[Matrix, Matrix, np.ndarray]:
        """P, and Q, q0 with ``q = Q d + q0``, for the weights and the active instances of `store`.

        `pattern` identifies `flags`; what constant weights contribute is kept per pattern.

        Raises:
            DataError, NoiseError: coefficients or weights of an active instance that cannot be used; names the term.
        """
        for rows in self._original:
            rows.require_finite(flags.get(rows.layout.term.name))
        fixed = self._constants.get(pattern)
        if fixed is None:
            parts = [_contribution(t, store, flags.get(t.name)) for t in self.costs if t.constant]
            fixed = _sum(parts, self.size, self.E.shape[1], self.dense)
            if len(self._constants) >= PATTERNS:
                self._constants.pop(next(iter(self._constants)))
            self._constants[pattern] = fixed
        P, Q, q0 = fixed
        for term in self.costs:
            if not term.constant:
                more = _contribution(term, store, flags.get(term.name))
                P, Q, q0 = P + more[0], Q + more[1], q0 + more[2]
        return P, Q, q0

    def gradient(
        self, store: DataStore, flags: dict[str, np.ndarray | None]
    ) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Gradient of the costs at (v, data), each (n,) or a matrix of columns, for the weights of `store`.

        It comes from the rows and not from P: where weights differ much, P has lost the digits of the small ones.
        """
        parts = []
        for term in self.costs:
            rows, on = term.rows, flags.get(term.name)
            WR = weigh(rows, information_of(rows, store, on)).T
            zero = np.zeros((self.size, rows.E.shape[1])) if self.dense else sp.csr_array((self.size, rows.E.shape[1]))
            parts.append((WR, rows, *_linear(term, on, zero, np.zeros(self.size))))

        def gradient(v: np.ndarray, d: np.ndarray) -> np.ndarray:
            down = (slice(None), *[None] * (d.ndim - 1))
            return sum(
                (WR @ (r.R @ v + r.E @ d + r.c[down]) + (Q @ d + q0[down]) for WR, r, Q, q0 in parts), np.zeros(v.shape)
            )

        return gradient

    def given(self, flags: dict[str, np.ndarray | None], pattern: bytes) -> Given:
        """What the data give whatever the weights, kept per pattern (dense only)."""
        found = self._given.get(pattern)
        if found is None:
            if len(self._given) >= PATTERNS:
                self._given.pop(next(iter(self._given)))
            found = self._given[pattern] = Given(self, flags)
        return found

    def bounds(self, numbers: np.ndarray, flags: dict[str, np.ndarray | None]) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the rows ``A v`` for given data."""
        shift = self.E @ numbers + self.c
        lower, upper = self.limits(numbers, flags)
        zero = np.zeros(self.equalities)
        return np.concatenate([zero, lower]) - shift, np.concatenate([zero, upper]) - shift

    def limits(self, numbers: np.ndarray, flags: dict[str, np.ndarray | None]) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the inequalities themselves, infinite where there is none or an instance is off."""
        lower, upper = self.lower(numbers), self.upper(numbers)
        if self.bounded:
            off = self.off_rows(flags)
            if off is not None:
                lower, upper = np.where(off, -np.inf, lower), np.where(off, np.inf, upper)
        lower = np.where(lower <= -INFINITE, -np.inf, lower)
        upper = np.where(upper >= INFINITE, np.inf, upper)
        return lower, upper

    def off_rows(self, flags: dict[str, np.ndarray | None]) -> np.ndarray | None:
        """Inequality rows of instances that are switched off, or None."""
        states = [flags.get(r.layout.term.name) for r in self.bounded]
        if all(s is None for s in states):
            return None
        return np.concatenate(
            [
                np.zeros(r.count * r.dim, bool) if on is None else np.repeat(~on, r.dim)
                for r, on in zip(self.bounded, states, strict=True)
            ]
        )


class Given:
    """Bounds of the rows and the offset in ``z = Z v + offset``, ``D d + d`` but for bounds that are data."""

    def __init__(self, reduced: Reduced, flags: dict[str, np.ndarray | None]) -> None:
        self._reduced, self._flags = reduced, flags
        self.D: np.ndarray = np.ascontiguousarray(_stack([reduced.E, reduced.map.Y]))
        self.d = np.concatenate([reduced.c, reduced.map.z0])
        self._fixed = None
        if not reduced.bounds_vary:
            l, u = reduced.bounds(np.zeros(reduced.E.shape[1]), flags)
            self._fixed = l + reduced.c, u + reduced.c

    def __call__(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """l, u and the offset."""
        out = self.D.dot(numbers)
        out += self.d
        return self.split(out, numbers)

    def split(self, values: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same from ``D numbers + d``."""
        size = self._reduced.c.size
        if self._fixed is None:
            l, u = self._reduced.bounds(numbers, self._flags)
        else:
            shift = values[:size]
            l, u = self._fixed[0] - shift, self._fixed[1] - shift
        return l, u, values[size:]


def _cost(rows: Rows, map_: AffineMap) -> CostTerm:
    term = rows.layout.term
    inner = Rows(rows.layout, rows.dim, rows.R @ map_.Z, rows.E + rows.R @ map_.Y, rows.c + rows.R @ map_.z0)
    linear = linear_data = None
    if isinstance(term.linear, DataSlot):
        index = rows.layout.linear
        assert index is not None
        index = np.broadcast_to(index, (term.count, rows.dim)).ravel()
        ones, at = np.ones(index.size), np.arange(index.size)
        linear_data = sp.csr_array((ones, (at, index)), shape=(index.size, rows.E.shape[1]))
        if isinstance(rows.R, np.ndarray):
            linear_data = linear_data.toarray()
    elif term.linear is not None:
        linear = constant_rows(term.linear, rows.dim, rows.count, f"{term.what}: linear").ravel()
    assert term.noise is not None
    return CostTerm(inner, not isinstance(term.noise.value, DataSlot), linear, linear_data)


def _contribution(term: CostTerm, store: DataStore, on: np.ndarray | None) -> tuple[Matrix, Matrix, np.ndarray]:
    rows = term.rows
    WR = weigh(rows, information_of(rows, store, on)).T
    return WR @ rows.R, *_linear(term, on, WR @ rows.E, WR @ rows.c)


def _linear(term: CostTerm, on: np.ndarray | None, Q: Matrix, q0: np.ndarray) -> tuple[Matrix, np.ndarray]:
    """Q and q0 with the linear part of the cost."""
    if term.linear is None and term.linear_data is None:
        return Q, q0
    R = term.rows.R
    if on is not None:
        keep = np.repeat(on, term.rows.dim).astype(float)
        R = R * keep[:, None] if isinstance(R, np.ndarray) else sp.diags_array(keep) @ R
    return (Q, q0 + R.T @ term.linear) if term.linear is not None else (Q + R.T @ term.linear_data, q0)


def _sum(parts: list[Any], size: int, data: int, dense: bool) -> tuple[Matrix, Matrix, np.ndarray]:
    P: Any = np.zeros((size, size)) if dense else sp.csr_array((size, size))
    Q: Any = np.zeros((size, data)) if dense else sp.csr_array((size, data))
    q0 = np.zeros(size)
    for p in parts:
        P, Q, q0 = P + p[0], Q + p[1], q0 + p[2]
    return P, Q, q0


def _stack(parts: list[Matrix]) -> Matrix:
    return np.vstack(parts) if isinstance(parts[0], np.ndarray) else sp.vstack(parts, format="csr")


class QuadraticProgram:
    """A problem lowered to a quadratic program.

    Args:
        problem: with variables on Vector spaces, affine residuals and no losses.
        eliminate: variables or slots to condense away through the equalities that define them.
        dense: matrices as arrays instead of sparse ones; by default, where the problem is small.

    Raises:
        FormError, NotAffineError: naming the term; unknowns that the equalities do not define.
    """

    def __init__(self, problem: Problem, eliminate: Sequence[Any] = (), dense: bool | None = None) -> None:
        require_affine(problem)
        self.problem, self.layout = problem, Layout(problem)
        self.speeds = data_speeds(problem)
        self.eliminated = [_slot(entry, problem) for entry in eliminate]
        places = [self.layout.columns(slot).ravel() for slot in self.eliminated]
        self._columns = np.unique(np.concatenate([np.zeros(0, np.intp), *places]))
        self.dense = self._dense_numbers() <= DENSE_LIMIT if dense is None else dense
        self.activity = Activity(self.layout)
        self.rows = AffineRows(self.layout, self.speeds, self.dense)
        self._names = [entry.term.name for entry in self.layout.terms]
        self._reduced: dict[bytes, Reduced] = {}
        starts, inputs = self.layout.data_start, problem.inputs
        matrix = [n for n, speed in self.speeds.items() if speed == "matrix"]
        at = [np.arange(starts[n], starts[n] + inputs[n].rows * inputs[n].size) for n in matrix]
        self._matrix = np.concatenate([np.zeros(0, np.intp), *at])

    @property
    def remaining(self) -> int:
        """How many unknowns elimination leaves."""
        return self.layout.size - self._columns.size

    def _dense_numbers(self) -> int:
        """Numbers in the largest matrices that the dense form holds.

        Every solve multiplies the map from the data to unknowns and bounded rows. Set-up factorizes the Hessian of the
        unknowns that elimination leaves and the block of those it solves, or a basis of all where equalities remain.
        """
        rows = {"cost": 0, "equality": 0, "inequality": 0}
        for term in self.problem.terms.values():
            rows[term.kind] += term.count * template_of(term).dim
        size, solved = self.layout.size, self._columns.size
        square = size**2 if rows["equality"] > solved else solved**2 + self.remaining**2
        return (size + rows["inequality"]) * self.layout.data_size + square

    def condense(self, eliminate: Sequence[Any]) -> QuadraticProgram:
        """The same program with further unknowns condensed away. Raises FormError."""
        return QuadraticProgram(self.problem, [*self.eliminated, *eliminate], self.dense)

    def __repr__(self) -> str:
        reduced = None if self._matrix.size else self.reduced(DataStore(self.layout).numbers)
        shape = f", {reduced.size} unknowns, {reduced.A.shape[0]} rows" if reduced else ""
        return f"<QuadraticProgram of {self.problem.name!r}{shape}, {'dense' if self.dense else 'sparse'}>"

    def _repr_html_(self) -> str:
        from problems.display import Table

        rows = [(name, self.speeds[name], ", ".join(parts)) for name, parts in self.changes.items()]
        return Table(repr(self).strip("<>"), ("data", "speed", "changes"), rows)._repr_html_()

    @property
    def changes(self) -> dict[str, tuple[str, ...]]:
        """Which of P, q, A, l, u change with each datum."""
        out: dict[str, tuple[str, ...]] = {}
        for name, speed in self.speeds.items():
            touched: set[str] = set()
            for term in self.problem.terms.values():
                reads = any(slot.source.name == name for slot in term.data)
                if term.kind == "cost":
                    weighs = term.noise is not None and _is(term.noise.value, name) or _is(term.active, name)
                    if weighs or (reads and speed == "matrix"):
                        touched |= {"P", "q"}
                    elif reads or _is(term.linear, name):
                        touched.add("q")
                elif reads or any(_is(v, name) for v in (term.lower, term.upper, term.active)):
                    touched |= {"l", "u"} | ({"A"} if reads and speed == "matrix" else set())
                    if self.eliminated and term.kind == "equality":
                        touched |= {"q"} | ({"P", "A"} if speed == "matrix" else set())
            out[name] = tuple(k for k in "PqAlu" if k in touched)
        return out

    def reduced(self, numbers: np.ndarray) -> Reduced:
        """The program for the matrix data in `numbers`, with the chosen unknowns eliminated."""
        key = numbers[self._matrix].tobytes()
        found = self._reduced.get(key)
        if found is None:
            if len(self._reduced) >= MATRICES:
                self._reduced.pop(next(iter(self._reduced)))
            found = self._reduced[key] = self._reduce(numbers)
        return found

    def _reduce(self, numbers: np.ndarray) -> Reduced:
        rows = self.rows.evaluate(numbers)
        equal = [r for r in rows if r.layout.term.kind == "equality"]
        bounded = [r for r in rows if r.layout.term.kind == "inequality"]
        lower, upper = Bounds.of(self.layout, bounded, "lower"), Bounds.of(self.layout, bounded, "upper")
        size, data = self.layout.size, self.layout.data_size
        map_ = AffineMap.identity(size, data, self.dense)
        if equal:
            R, E, c = _stack([r.R for r in equal]), _stack([r.E for r in equal]), np.concatenate([r.c for r in equal])
        else:
            R, E, c = map_.Z[:0], map_.Y[:0], np.zeros(0)
        if self.eliminated:
            names = ", ".join(s.source.name for s in self.eliminated)
            map_, used = eliminate(R, E, c, self._columns, names)
            rest = np.setdiff1d(np.arange(R.shape[0]), used)
            R, E, c = R[rest], E[rest], c[rest]
        return Reduced(rows, lower, upper, map_, (R, E, c))

    def flags(self, numbers: np.ndarray) -> dict[str, np.ndarray | None]:
        """Active instances (count,) of each term by name; None where all are."""
        return dict(zip(self._names, self.activity.flags(numbers), strict=True))

    def matrices(self, data: Mapping[str, Any] | None = None) -> QPMatrices:
        """P, q, A, l, u for given data (defaults where left out)."""
        store = DataStore(self.layout)
        for name, value in (data or {}).items():
            store.set(name, value)
        store.require_all()
        flags = self.flags(store.numbers)
        numbers = clean(store.numbers)
        reduced = self.reduced(numbers)
        P, Q, q0 = reduced.weighted(store, flags)
        l, u = reduced.bounds(numbers, flags)
        return QPMatrices(P, Q @ numbers + q0, reduced.A, l, u)


def clean(numbers: np.ndarray) -> np.ndarray:
    """Missing numbers read as zero and infinite bounds as large ones, so that affine maps stay finite."""
    return np.nan_to_num(numbers, nan=0.0, posinf=INFINITE, neginf=-INFINITE)


def _is(value: Any, name: str) -> bool:
    return isinstance(value, DataSlot) and value.source.name == name


def _slot(entry: Any, problem: Problem) -> Slot:
    slot = entry[:] if isinstance(entry, Variable) else entry
    if not isinstance(slot, Slot) or slot.source.problem is not problem:
        raise DefinitionError(f"eliminate takes variables of problem {problem.name!r}, got {entry!r}")
    return slot
