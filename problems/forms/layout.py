"""Where everything of a problem stands in flat arrays, and the sticky data of a session.

A point is one array of stored coordinates, a step one array of tangent coordinates, all data one array of numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from problems.errors import DataError, EmptyConstraintError, ShapeError, UnknownNameError
from problems.noise import whitening
from problems.problem import Data, DataSlot, Problem, Slot, Term
from problems.spaces import Vector, points

INFINITE = 1e20  # stands for an infinite bound given as data, where 0 * inf must not become NaN


def data_rows(entry: Data, value: Any) -> np.ndarray:
    """`value` as (rows, size) numbers of `entry`; one row is repeated.

    Raises:
        ShapeError: it does not fit; names the data and both shapes.
    """
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise DataError(f"data {entry.name!r}: expected numbers, got {value!r}") from error
    shape, rows = entry.shape, entry.rows
    if array.size == rows * entry.size and array.shape in ((rows, *shape), shape if rows == 1 else ()):
        return array.reshape(rows, entry.size)
    if array.shape == shape:
        return np.broadcast_to(array.reshape(1, entry.size), (rows, entry.size))
    if array.shape == (rows,) and entry.size == 1:
        return array.reshape(rows, 1)
    if array.shape == (rows, entry.size):
        return array
    expected = f"{shape}" if entry.count is None else f"{(rows, *shape)}"
    raise ShapeError(f"data {entry.name!r}: expected shape {expected}, got {array.shape}")


_WHITENINGS: WeakKeyDictionary[Term, np.ndarray] = WeakKeyDictionary()


def check_numbers(term: Term, dim: int) -> None:
    """Weights, linear part, bounds and flags of a term with residuals of `dim` rows: shapes, NaN, crossing bounds.

    Raises:
        ShapeError, NoiseError, DataError, EmptyConstraintError: naming the term and what does not fit.
    """
    noise = term.noise
    if noise is not None and isinstance(noise.value, DataSlot):
        single = noise.kind == "sigma" or dim == 1
        allowed = {(dim,) if noise.kind == "sigma" else (dim, dim)} | ({(), (1,)} if single else set())
        _check_slot(noise.value, allowed, term, noise.kind)
    elif noise is not None:
        constant_whitening(term, dim)
    given = {}
    for key, size in (("linear", dim), ("lower", dim), ("upper", dim), ("active", 1)):
        value = getattr(term, key)
        if isinstance(value, DataSlot):
            _check_slot(value, {(), (1,), (size,)}, term, key)
        elif value is not None:
            given[key] = constant_rows(value, size, term.count, f"{term.what}: {key}")
            finite = ~np.isnan(given[key]) if key in ("lower", "upper") else np.isfinite(given[key])
            if not finite.all():
                hint = "; leave a bound out with an infinity" if key in ("lower", "upper") else ""
                raise DataError(f"{term.what}: instance {_first(~finite)} of {key} is not a number one can use{hint}")
    if "lower" in given and "upper" in given:
        # no number lies above an infinite lower bound or below an infinite upper one
        crossed = (given["lower"] > given["upper"]) | (given["lower"] == np.inf) | (given["upper"] == -np.inf)
        if crossed.any():
            row, part = np.argwhere(crossed)[0]
            raise EmptyConstraintError(
                f"{term.what}: no point satisfies instance {row}, row {part}: lower "
                f"{given['lower'][row, part]:g} is above upper {given['upper'][row, part]:g}"
            )


def constant_whitening(term: Term, dim: int) -> np.ndarray:
    """`problems.noise.whitening` of a noise model that is no data, worked out once for each term."""
    found = _WHITENINGS.get(term)
    if found is None:
        assert term.noise is not None
        found = _WHITENINGS[term] = whitening(term.noise.kind, term.noise.value, dim, term.count, term.what)
    return found


def noise_numbers(term: Term, dim: int, store: DataStore) -> Any:
    """The numbers of a term's noise model as `problems.noise` takes them: instances first where they are data."""
    assert term.noise is not None
    value = term.noise.value
    if not isinstance(value, DataSlot):
        return value
    rows = store[value.source.name][value.indices]
    if term.noise.kind == "sigma":
        return np.broadcast_to(rows, (rows.shape[0], dim))
    return rows.reshape(-1, dim, dim)


def _check_slot(slot: DataSlot, allowed: set[tuple[int, ...]], term: Term, key: str) -> None:
    source, rows = slot.source, len(slot.indices)
    if source.shape not in allowed:
        shapes = " or ".join(str(shape) for shape in sorted(allowed))
        raise ShapeError(f"{term.what}: {key} needs data with rows of shape {shapes}, got {source!r}")
    if rows not in (1, term.count):
        raise ShapeError(f"{term.what}: {key} needs data with 1 or {term.count} row(s), got {rows} of {source!r}")


def _first(bad: np.ndarray) -> int:
    return int(np.flatnonzero(bad.any(axis=1))[0])


def constant_rows(value: Any, dim: int, count: int, what: str) -> np.ndarray:
    """A number, (dim,), (count,) for dim 1, or (count, dim) as (count, dim)."""
    expected = f"{what} must be a number, ({dim},) or ({count}, {dim})"
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f"{expected}; got {value!r}") from None
    if array.shape == (count,) and dim == 1:
        array = array[:, None]
    try:
        return np.broadcast_to(array, (count, dim))
    except ValueError:
        raise ShapeError(f"{expected}; got shape {array.shape}") from None


@dataclass(frozen=True, eq=False)
class TermLayout:
    """Where the instances of a term read and write.

    Attributes:
        stored: (count, all stored coordinates of its slots) positions in the point.
        columns: (count, width) positions in the tangent step.
        blocks: (count, slots) numbers of the variable instances.
        numbers: (count, all numbers of its data) positions in the data.
        linear: (1 or count, size) positions of the linear part given as data, or None.
    """

    term: Term
    stored: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray
    numbers: np.ndarray
    linear: np.ndarray | None


class Layout:
    """Positions of variables, data and terms of a problem.

    Attributes:
        flat: all variables are vectors, so that a point moves by addition.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.stored_start: dict[str, int] = {}
        self.start: dict[str, int] = {}
        self.block_start: dict[str, int] = {}
        stored = tangent = block = 0
        dims: list[np.ndarray] = []
        for variable in problem.unknowns.values():
            self.stored_start[variable.name] = stored
            self.start[variable.name] = tangent
            self.block_start[variable.name] = block
            stored += variable.count * variable.space.ambient
            tangent += variable.count * variable.space.dim
            block += variable.count
            dims.append(np.full(variable.count, variable.space.dim))
        self.stored_size, self.size = stored, tangent
        self.flat = all(isinstance(variable.space, Vector) for variable in problem.unknowns.values())
        self.block_dims = np.concatenate(dims) if dims else np.zeros(0, int)
        self.block_columns = np.concatenate([[0], np.cumsum(self.block_dims)]).astype(np.intp)
        self._alike = all(v.space.ambient == v.space.dim for v in problem.unknowns.values())
        self.data_start: dict[str, int] = {}
        numbers = 0
        for entry in problem.inputs.values():
            self.data_start[entry.name] = numbers
            numbers += entry.rows * entry.size
        self.data_size = numbers
        self.terms = [self._term(term) for term in problem.terms.values()]

    @cached_property
    def bound_numbers(self) -> np.ndarray:
        """Positions of data that are bounds and nothing else, the only ones that may be infinite."""
        bounds, others = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
        for term in (entry.term for entry in self.terms):
            weights = term.noise.value if term.noise else None
            bounds += [self.numbers(v).ravel() for v in (term.lower, term.upper) if isinstance(v, DataSlot)]
            others += [
                self.numbers(v).ravel()
                for v in (*term.data, weights, term.linear, term.active)
                if isinstance(v, DataSlot)
            ]
        found = np.concatenate(bounds)
        return np.setdiff1d(found, np.concatenate(others)) if found.size else found

    def columns(self, slot: Slot) -> np.ndarray:
        """(instances, dim) positions of a slot's tangent coordinates."""
        dim = slot.source.space.dim
        return self.start[slot.source.name] + slot.indices[:, None] * dim + np.arange(dim)

    def numbers(self, slot: DataSlot) -> np.ndarray:
        """(rows, size) positions of a data slot's numbers."""
        size = slot.source.size
        return self.data_start[slot.source.name] + slot.indices[:, None] * size + np.arange(size)

    def stored(self, slot: Slot) -> np.ndarray:
        """(instances, ambient) positions of a slot's stored coordinates."""
        ambient = slot.source.space.ambient
        return self.stored_start[slot.source.name] + slot.indices[:, None] * ambient + np.arange(ambient)

    def _term(self, term: Term) -> TermLayout:
        def rows(parts: list[np.ndarray]) -> np.ndarray:
            if not parts:
                return np.zeros((term.count, 0), np.intp)
            if len(parts) == 1 and len(parts[0]) == term.count:
                return parts[0]
            return np.hstack([np.broadcast_to(p, (term.count, p.shape[1])) for p in parts])

        stored = rows([self.stored(s) for s in term.slots])
        return TermLayout(
            term,
            stored,
            stored if self._alike else rows([self.columns(s) for s in term.slots]),
            rows([self.block_start[s.source.name] + s.indices[:, None] for s in term.slots]),
            rows([self.numbers(s) for s in term.data]),
            self.numbers(term.linear) if isinstance(term.linear, DataSlot) else None,
        )

    def point(self, values: Mapping[str, Any], base: np.ndarray | None = None) -> np.ndarray:
        """Values by variable name as one array of stored coordinates; others from `base` or the identity.

        Raises:
            UnknownNameError, DataError: a name that is no variable; a wrong shape or a value that is not finite.
        """
        for name in values:
            if name not in self.problem.unknowns:
                raise UnknownNameError("variable", name, self.problem.unknowns)
        point = self.identity() if base is None else base.copy()
        for name, value in values.items():
            variable = self.problem.unknowns[name]
            start = self.stored_start[name]
            array = points(variable.space, value, variable.count, f"value of {name!r}")
            point[start : start + array.size] = array.ravel()
        return point

    def identity(self) -> np.ndarray:
        parts = [np.tile(v.space.identity(), v.count) for v in self.problem.unknowns.values()]
        return np.concatenate(parts) if parts else np.zeros(0)

    def values(self, point: np.ndarray) -> dict[str, np.ndarray]:
        """Views (count, ambient) into `point` by variable name."""
        return {name: self.value(point, name) for name in self.problem.unknowns}

    def value(self, point: np.ndarray, name: str) -> np.ndarray:
        variable = self.problem.unknowns[name]
        start, ambient = self.stored_start[name], variable.space.ambient
        return point[..., start : start + variable.count * ambient].reshape(*point.shape[:-1], variable.count, ambient)

    def names_of(self, direction: np.ndarray) -> str:
        """Variables with a share in a tangent direction, for messages; empty where it is zero."""
        largest = np.abs(direction).max(initial=0.0)
        names = []
        for name, variable in self.problem.unknowns.items():
            start, dim = self.start[name], variable.space.dim
            part = np.abs(direction[start : start + variable.count * dim]).reshape(variable.count, dim)
            rows = np.flatnonzero((part > 1e-3 * largest).any(axis=1))
            if rows.size:
                names.append(f"{name}[{rows[0]}]" + (f" and {rows.size - 1} more" if rows.size > 1 else ""))
        return ", ".join(names)

    def retract(self, point: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The point moved by a tangent step."""
        if self.flat:
            return point + step
        out = np.empty_like(point)
        for name, variable in self.problem.unknowns.items():
            s, t = self.stored_start[name], self.start[name]
            ambient, dim = variable.space.ambient, variable.space.dim
            x = point[s : s + variable.count * ambient].reshape(-1, ambient)
            d = step[t : t + variable.count * dim].reshape(-1, dim)
            out[s : s + variable.count * ambient] = variable.space.retract_array(x, d).ravel()
        return out


class DataStore:
    """The numbers a session was given so far; names keep their values until they are given anew."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.numbers = np.full(layout.data_size, np.nan)
        self.given = {name: False for name in layout.problem.inputs}
        self._views: dict[str, np.ndarray] = {}
        inputs = layout.problem.inputs
        self._flags = {d.of.name: d.name for d in inputs.values() if d.of is not None}
        self._derived = frozenset(self._flags.values())
        for name, entry in inputs.items():
            start = layout.data_start[name]
            self._views[name] = self.numbers[start : start + entry.rows * entry.size].reshape(entry.rows, entry.size)
            if entry.of is not None:
                self._views[name][...], self.given[name] = 1.0, True
        for name, entry in inputs.items():
            if entry.of is None and entry.value is not None:
                self.set(name, entry.value)

    def copy(self, numbers: np.ndarray | None = None) -> DataStore:
        """An independent store with the same numbers, or with others."""
        other = DataStore(self.layout)
        other.numbers[:] = self.numbers if numbers is None else numbers
        other.given = dict(self.given)
        return other

    def set(self, name: str, value: Any) -> None:
        """Take new numbers. Raises UnknownNameError, ShapeError or DataError."""
        view = self._views.get(name)
        if view is None or name in self._derived:
            raise UnknownNameError("data", name, [n for n in self._views if n not in self._derived])
        if type(value) is np.ndarray and value.shape == view.shape and value.dtype == float:
            view[...] = value
        else:
            view[...] = data_rows(self.layout.problem.inputs[name], value)
        self.given[name] = True
        if name in self._flags:
            self._views[self._flags[name]][:, 0] = ~np.isnan(view).any(axis=1)

    def __getitem__(self, name: str) -> np.ndarray:
        """(rows, size) view of the numbers of `name`."""
        return self._views[name]

    def require_finite(self) -> None:
        """Raises DataError naming data that are infinite and more than a bound."""
        infinite = np.isinf(self.numbers)
        infinite[self.layout.bound_numbers] = False
        if infinite.any():
            at = int(np.flatnonzero(infinite)[0])
            name = max((start, name) for name, start in self.layout.data_start.items() if start <= at)[1]
            raise DataError(f"data {name!r} have an infinite value; only bounds may be infinite")

    def require_all(self) -> None:
        """Raises DataError naming data that were never given."""
        missing = [name for name, given in self.given.items() if not given]
        if missing:
            raise DataError(f"data never given and without default: {', '.join(missing)}; pass them to solve or update")


class Activity:
    """Which instances of costs and inequalities are switched on: no NaN among the data they read, `active` not 0."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._terms: list[tuple[TermLayout, np.ndarray | None]] = []
        for entry in layout.terms:
            switch = None
            if isinstance(entry.term.active, DataSlot):
                switch = np.broadcast_to(layout.numbers(entry.term.active), (entry.term.count, 1))[:, 0]
            self._terms.append((entry, switch))
        self.switches = np.unique(np.concatenate([s for _, s in self._terms if s is not None] or [np.zeros(0, int)]))
        self.constant = [
            None
            if term.term.active is None or isinstance(term.term.active, DataSlot)
            else constant_rows(term.term.active, 1, term.term.count, f"{term.term.what}: active")[:, 0] != 0
            for term, _ in self._terms
        ]

    @cached_property
    def _reads(self) -> list[np.ndarray]:
        """(count, numbers) positions of the data each term reads; found where some are missing."""
        found = []
        for term in (entry.term for entry, _ in self._terms):
            # weights and flags are checked where they are used, so a NaN there is an error and not a pattern
            flagged = {s.source.of.name for s in term.data if s.source.of is not None}
            slots = [s for s in term.data if s.source.of is None and s.source.name not in flagged]
            slots += [v for v in (term.linear, term.lower, term.upper) if isinstance(v, DataSlot)]
            parts = [np.zeros((term.count, 0), np.intp), *map(self._layout.numbers, slots)]
            found.append(np.hstack([np.broadcast_to(part, (term.count, part.shape[1])) for part in parts]))
        return found

    def key(self, numbers: np.ndarray, finite: bool = False) -> bytes:
        """Identifies the pattern; equal keys give equal `flags`. `finite` numbers are not searched for NaN."""
        missing = None if finite else np.isnan(numbers)
        head = missing.tobytes() if missing is not None and missing.any() else b""
        return head + b"|" + numbers[self.switches].tobytes() if self.switches.size else head

    def flags(self, numbers: np.ndarray) -> list[np.ndarray | None]:
        """For each term (..., count) booleans for numbers (..., data), or None where all are on.

        Raises:
            DataError: an equality reads missing data without their presence flags; a switch is NaN.
        """
        out: list[np.ndarray | None] = []
        missing = np.isnan(numbers)
        complete = not missing.any()
        for k, ((entry, switch), constant) in enumerate(zip(self._terms, self.constant, strict=True)):
            on: Any = (
                np.ones((*numbers.shape[:-1], entry.term.count), bool)
                if complete
                else ~missing[..., self._reads[k]].any(axis=-1)
            )
            if entry.term.kind == "equality":
                if not on.all():
                    raise DataError(
                        f"{entry.term.what}: instance {int(np.argwhere(~on)[0, -1])} reads missing data; let it read "
                        "presence(data) too and say what holds without them"
                    )
                out.append(None)
                continue
            if switch is not None:
                if np.isnan(numbers[..., switch]).any():
                    raise DataError(f"{entry.term.what}: its active flags contain a NaN; use 1 and 0")
                on &= numbers[..., switch] != 0
            if constant is not None:
                on &= constant
            out.append(None if on.all() else on)
        return out
