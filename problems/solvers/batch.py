"""The same session on a leading axis: many nodes or many trials at once.

On the quadratic form, entries with equal weights, matrices and pattern of missing data share one affine map. The maps
of all entries are worked out and applied on stacked arrays, entries that violate a row are solved together by a dual
active-set method, and only what that leaves goes to the QP backend, one by one. Other forms run one fork per entry
behind the same interface.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from problems.errors import DataError, ShapeError, UnknownNameError
from problems.forms.layout import DataStore, Layout, data_rows
from problems.forms.quadratic import clean
from problems.solvers.base import Status
from problems.solvers.qp_dual import nearest_points
from problems.solvers.qp_maps import DenseMap, SparseMap
from problems.solvers.qp_stacked import StackedMaps, StackedProgram
from problems.solvers.session import Session, Solution

if TYPE_CHECKING:
    from problems.solvers.qp_session import QPSession


class BatchSolution:
    """Solutions of all entries. Index it by variable name: (entries, count, stored coordinates).

    Attributes:
        point: (entries, all stored coordinates).
        status, method, iterations: one per entry (object, object and int arrays).
        messages: by entry, where there is something to say.
        seconds: of the whole batch: ``update`` for new weights, matrices and patterns, ``solve`` for the rest.
    """

    def __init__(self, layout: Layout, point: np.ndarray, method: str) -> None:
        self._layout, self.point = layout, point
        entries = point.shape[0]
        self.status, self.method = np.empty(entries, dtype=object), np.empty(entries, dtype=object)
        self.status[:], self.method[:] = Status.SOLVED, method  # numpy.full would turn the status into a plain string
        self.iterations = np.zeros(entries, dtype=int)
        self.messages: dict[int, str] = {}
        self.seconds: dict[str, float] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        return self._layout.value(self.point, name)

    @property
    def values(self) -> dict[str, np.ndarray]:
        return self._layout.values(self.point)

    @property
    def solved(self) -> bool:
        return bool((self.status == Status.SOLVED).all())

    def take(self, entry: int, solution: Solution) -> None:
        """Store the solution of one entry."""
        self.point[entry] = solution.point
        self.status[entry], self.method[entry] = solution.status, solution.method
        self.iterations[entry] = solution.iterations
        if solution.message:
            self.messages[entry] = solution.message


class BatchSession(ABC):
    """Data with a leading axis over `count` entries of one compiled session.

    Raises:
        ShapeError, UnknownNameError, DataError: as for `Session`, with the name of the data.

    Attributes:
        factorizations: matrices factorized so far to answer without active rows.
        update_seconds: spent on weights, matrices and patterns since the last solve.
    """

    factorizations = 0
    update_seconds = 0.0

    def __init__(self, session: Session, count: int) -> None:
        if count < 1:
            raise DataError(f"a batch has at least one entry, got {count}")
        self.session, self.count = session, count
        self.layout = session.layout
        self.given = dict(session.store.given)

    def update(self, **data: Any) -> None:
        """Take data with a leading axis (count, ...), or one value shared by all entries.

        A leading axis (b, ...) with b a divisor of the count gives one value to each of b blocks of consecutive
        entries. Weights and matrices of few blocks are cheaper than the same ones entry by entry.
        """
        start = time.perf_counter()
        for name, value in data.items():
            self._set(name, value)
        if all(self.given.values()):
            self._prepare()
        self.update_seconds += time.perf_counter() - start

    @property
    def nbytes(self) -> int:
        """Memory of the data and of what was worked out from them, in bytes."""
        return 0

    def _prepare(self) -> None:
        return

    def solve(self, data: Mapping[str, Any] | None = None) -> BatchSolution:
        """Solve all entries. Data are sticky as in `Session.solve`."""
        start = time.perf_counter()
        for name, value in (data or {}).items():
            self._set(name, value)
        missing = [name for name, given in self.given.items() if not given]
        if missing:
            raise DataError(f"data never given and without default: {', '.join(missing)}; pass them to solve or update")
        before = self.update_seconds
        solution = self._solve()
        update, self.update_seconds = self.update_seconds, 0.0
        solution.seconds = {"update": update, "solve": time.perf_counter() - start - (update - before)}
        return solution

    def data_of(self, entry: int) -> dict[str, np.ndarray]:
        """Data of one entry by name, as `Session.solve` takes them."""
        store = self._store(entry)
        return {name: store[name].copy() for name, datum in self.layout.problem.inputs.items() if datum.of is None}

    @abstractmethod
    def _store(self, entry: int) -> DataStore: ...

    def _rows(self, name: str, value: Any) -> np.ndarray:
        """(blocks, numbers of the datum), blocks = 1 where all entries share it."""
        entry = self.layout.problem.inputs.get(name)
        if entry is None:
            raise UnknownNameError("data", name, self.layout.problem.inputs)
        array = np.asarray(value, dtype=float)
        one = (*(() if entry.count is None else (entry.count,)), *entry.shape)
        if array.shape[1:] == one and array.ndim == len(one) + 1 and array.shape[0] and not self.count % array.shape[0]:
            return array.reshape(array.shape[0], entry.rows * entry.size)
        try:
            return np.array(data_rows(entry, array)).reshape(1, -1)
        except ShapeError:
            raise ShapeError(
                f"data {name!r}: expected shape {(self.count, *one)} (one per entry), {one} (shared) or a first axis "
                f"that divides {self.count} (one per block), got {array.shape}"
            ) from None

    @abstractmethod
    def _set(self, name: str, value: Any) -> None: ...

    @abstractmethod
    def _solve(self) -> BatchSolution: ...


class ForkBatch(BatchSession):
    """One fork per entry; for forms without an affine answer."""

    def __init__(self, session: Session, count: int) -> None:
        super().__init__(session, count)
        self.forks = [session.fork() for _ in range(count)]

    def _set(self, name: str, value: Any) -> None:
        rows = self._rows(name, value)
        entry = self.layout.problem.inputs[name]
        for k, fork in enumerate(self.forks):
            fork.update(**{name: rows[k * rows.shape[0] // self.count].reshape(entry.rows, entry.size)})
        self.given[name] = True

    def _store(self, entry: int) -> DataStore:
        return self.forks[entry].store

    def _solve(self) -> BatchSolution:
        out = BatchSolution(self.layout, np.empty((self.count, self.layout.stored_size)), self.session.solver)
        for k, fork in enumerate(self.forks):
            out.take(k, fork.solve())
        return out


@dataclass(eq=False)
class Group:
    """Entries with equal weights, matrices and pattern: a session that holds these, and the map."""

    entries: np.ndarray
    session: QPSession
    map: DenseMap | SparseMap


class QPBatch(BatchSession):
    """Affine maps on the leading axis; see the module."""

    session: QPSession

    def __init__(self, session: QPSession, count: int) -> None:
        super().__init__(session, count)
        self.numbers = np.tile(session.store.numbers, (count, 1))
        program = session.program
        starts, inputs = self.layout.data_start, self.layout.problem.inputs
        self._slices = {n: slice(starts[n], starts[n] + e.rows * e.size) for n, e in inputs.items()}
        self._slow_names = session.slow | session.switching
        slow = [np.arange(self._slices[n].start, self._slices[n].stop) for n in session.slow]
        self._slow = np.concatenate([*slow, program.activity.switches]) if slow else program.activity.switches
        self._presence = {e.of.name: n for n, e in inputs.items() if e.of is not None}
        # numbers of blocks that weights and matrices came in; what is not finite, by name
        self._blocks = dict.fromkeys(self._slow_names, 1)
        self._missing: dict[str, np.ndarray] = {}
        self._infinite: set[str] = set()
        for name, part in self._slices.items():
            self._note_missing(name, self.numbers[:1, part])
        self._program = StackedProgram.of(program) if session.screens else None
        self._applied: Applied | None = None
        self._groups: list[Group] | None = None
        self._forks: list[Any] = []
        self._last: dict[int, Any] = {}

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes + (0 if self._applied is None else self._applied.nbytes)

    def _set(self, name: str, value: Any) -> None:
        rows = self._rows(name, value)
        blocks, part = rows.shape[0], self._slices[name]
        self._require_finite(name, rows)
        view = self.numbers[:, part].reshape(blocks, self.count // blocks, -1)
        given = rows[:, None]
        if name in self._slow_names:
            self._blocks[name] = blocks
            if not np.array_equal(view, np.broadcast_to(given, view.shape), equal_nan=True):
                self._changed()
        if self._note_missing(name, rows):
            self._changed()
        view[...] = given
        self.given[name] = True
        if name in self._presence:
            entry = self.layout.problem.inputs[name]
            flags = ~np.isnan(self.numbers[:, part].reshape(self.count, entry.rows, entry.size)).any(axis=2)
            self.numbers[:, self._slices[self._presence[name]]] = flags

    def _changed(self) -> None:
        self._groups = self._applied = None

    def _store(self, entry: int) -> DataStore:
        return self.session.store.copy(self.numbers[entry])

    def _require_finite(self, name: str, rows: np.ndarray) -> None:
        if np.vdot(rows, rows) < np.inf:  # cheap, and silent about what is not finite
            return
        infinite = self._slices[name].start + np.flatnonzero(np.isinf(rows).any(axis=0))
        if np.setdiff1d(infinite, self.layout.bound_numbers).size:
            raise DataError(f"data {name!r} have an infinite value; only bounds may be infinite")

    def _note_missing(self, name: str, rows: np.ndarray) -> bool:
        """Keep track of numbers that are not finite; whether the pattern of missing ones changed."""
        known = self._missing.pop(name, None)
        self._infinite.discard(name)
        if np.vdot(rows, rows) < np.inf:
            return known is not None
        missing = np.isnan(rows)
        if np.isinf(rows).any():
            self._infinite.add(name)
        if not missing.any():
            return known is not None
        self._missing[name] = missing
        return known is None or known.shape != missing.shape or not np.array_equal(known, missing)

    def _prepare(self) -> None:
        """Work out the maps of the data given so far, unless they are known."""
        if self._program is not None and self._applied is None:
            per, sets, first = self._sets()
            maps = self._program.maps(self.numbers[first])
            self.factorizations += len(first)
            self._applied = Applied(maps, self._program.columns, per, sets)
        elif self._program is None and self._groups is None:
            _, sets, first = self._sets()
            while len(self._forks) < len(first):
                self._forks.append(self.session.fork())
            groups = []
            for number, (entry, fork) in enumerate(zip(first, self._forks, strict=False)):
                fork.adopt(self.numbers[entry])
                groups.append(Group(np.flatnonzero(sets == number), fork, fork.current_map()))
            self.factorizations += len(groups)
            self._groups = groups

    def _solve(self) -> BatchSolution:
        start = time.perf_counter()
        self._prepare()
        self.update_seconds += time.perf_counter() - start
        numbers = clean(self.numbers) if self._missing or self._infinite else self.numbers
        out = BatchSolution(self.layout, np.empty((self.count, self.layout.size)), "linear")
        if self._applied is not None:
            self._solve_stacked(self._applied, numbers, out)
            return out
        for group in self._groups or []:
            map_, entries = group.map, group.entries
            if map_.definite and group.session.screens:
                z, excess = map_.many(numbers[entries])
                out.point[entries] = z
                if not excess.shape[1]:
                    continue
                entries = entries[excess.max(axis=1) > self.session.options.tolerance]
            for entry in entries:
                self._one(group.session, int(entry), out, same_map=True)
        return out

    def _solve_stacked(self, applied: Applied, numbers: np.ndarray, out: BatchSolution) -> None:
        tolerance = self.session.options.tolerance
        violated = applied(numbers, out.point, tolerance)
        left = np.flatnonzero(~applied.definite)
        if violated.size:
            solved, iterations = applied.nearest(numbers, out.point, violated, tolerance)
            done = violated[solved]
            out.method[done], out.iterations[done] = self.session.solver, iterations[solved]
            left = np.concatenate([left, violated[~solved]])
        if not left.size:
            return
        if not self._forks:
            self._forks.append(self.session.fork())
        for entry in left.tolist():
            self._one(self._forks[0], entry, out, same_map=False)

    def _one(self, session: QPSession, entry: int, out: BatchSolution, *, same_map: bool) -> None:
        """Solve one entry by the backend."""
        session.adopt(self.numbers[entry], same_map=same_map)
        session.last = self._last.get(entry)
        out.take(entry, session.solve_screened_out())
        self._last[entry] = session.last

    def _sets(self) -> tuple[int, np.ndarray, np.ndarray]:
        """Which entries share a map.

        Returns:
            Size of the blocks of consecutive entries that certainly do, the set (count,) of every entry, and the first
            entry of every set.
        """
        blocks = math.lcm(*self._blocks.values()) if self._blocks else 1
        patterns = math.lcm(*(missing.shape[0] for missing in self._missing.values())) if self._missing else 1
        uniform = all((missing == missing[0]).all() for missing in self._missing.values())
        if blocks >= self.count or not (uniform or not blocks % patterns):
            blocks = self.count
        per = self.count // blocks
        key = self.numbers[::per, self._slow]
        if self._missing:
            key = np.hstack([key, np.isnan(self.numbers[::per])])
        numbered: dict[bytes, int] = {}
        first: list[int] = []
        found = np.empty(blocks, np.intp)
        for block, row in enumerate(key):
            number = numbered.setdefault(row.tobytes(), len(numbered))
            if number == len(first):
                first.append(block * per)
            found[block] = number
        return per, np.repeat(found, per), np.array(first)


LOOPED = 16  # sets of entries up to which each is answered by a product of its own


class Applied:
    """Maps of a batch applied to all its entries.

    Args:
        maps: of the sets.
        columns: of the numbers that the maps take.
        per: size of the blocks of consecutive entries with one set.
        sets: (count,) set of every entry.
    """

    def __init__(self, maps: StackedMaps, columns: np.ndarray, per: int, sets: np.ndarray) -> None:
        self._maps, self._per, self._sets = maps, per, sets
        ordered = columns.size and (np.diff(columns) == 1).all()
        self._columns: Any = slice(int(columns[0]), int(columns[-1]) + 1) if ordered else columns
        known = len(maps.T)
        blocks = sets[::per]
        self._looped = known <= LOOPED
        self._all: Any = slice(None) if known == len(sets) and (np.diff(sets) == 1).all() else sets
        if self._looped:
            self._entries: list[Any] = (
                [slice(None)] if known == 1 else [np.flatnonzero(sets == k) for k in range(known)]
            )
        else:
            same = known == len(blocks) and (np.diff(blocks) == 1).all()
            self._T = maps.T if same else maps.T[blocks]
            self._t = (maps.t if same else maps.t[blocks])[:, None] if maps.t.any() else None
        self.definite = maps.definite[sets]

    @property
    def nbytes(self) -> int:
        copied = 0 if self._looped or self._T is self._maps.T else self._T.nbytes
        return self._maps.nbytes + copied

    def __call__(self, numbers: np.ndarray, point: np.ndarray, tolerance: float) -> np.ndarray:
        """Fill `point`; the entries that violate a row."""
        data = numbers[:, self._columns]
        maps = self._maps
        if self._looped:
            for k, entries in enumerate(self._entries):
                point[entries] = data[entries] @ maps.T[k].T + maps.t[k]
        else:
            shape = len(self._T), self._per, -1
            out = point.reshape(shape)
            np.matmul(data.reshape(shape), self._T.transpose(0, 2, 1), out=out)
            if self._t is not None:
                out += self._t
        rows = maps.rows
        if rows is None or not rows.count:
            return np.zeros(0, np.intp)
        values = rows.values(self._all, point, data)
        lower, upper = rows.bounds(self._all, numbers)
        inside = (values <= upper + tolerance) & (values >= lower - tolerance)
        return np.flatnonzero(~inside.all(axis=1) & self.definite)

    def nearest(
        self, numbers: np.ndarray, point: np.ndarray, entries: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Answer some entries with their rows; which of them were solved, and in how many steps."""
        rows, half, sets = self._maps.rows, self._maps.half, self._sets[entries]
        assert rows is not None and half is not None
        half = half[sets]
        A = rows.coefficients(sets) @ half
        values = rows.values(sets, point[entries], numbers[entries][:, self._columns])
        lower, upper = rows.bounds(sets, numbers[entries])
        with np.errstate(invalid="ignore"):
            b = np.concatenate([upper - values, values - lower], axis=1)
        found = nearest_points(np.concatenate([A, -A], axis=1), b, 0.1 * tolerance)
        solved = found.solved
        point[entries[solved]] += (half[solved] @ found.point[solved][..., None])[..., 0]
        return solved, found.iterations
