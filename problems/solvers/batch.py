"""The same session on a leading axis: many nodes or many trials at once.

On the quadratic form, entries with equal weights, matrices and pattern of missing data share one affine map and are
answered by one matrix product; only entries that violate a row go to the QP backend, one by one. Other forms run one
fork per entry behind the same interface.
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
from problems.solvers.qp_maps import DenseMap, SparseMap
from problems.solvers.session import Session, Solution

if TYPE_CHECKING:
    from problems.solvers.qp_session import QPSession


class BatchSolution:
    """Solutions of all entries. Index it by variable name: (entries, count, stored coordinates).

    Attributes:
        point: (entries, all stored coordinates).
        status, method, iterations: one per entry (object, object and int arrays).
        messages: by entry, where there is something to say.
        seconds: ``{"solve"}`` of the whole batch.
    """

    def __init__(self, layout: Layout, point: np.ndarray, method: str) -> None:
        self._layout, self.point = layout, point
        entries = point.shape[0]
        self.status = np.full(entries, Status.SOLVED, dtype=object)
        self.method = np.full(entries, method, dtype=object)
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
    """

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
        for name, value in data.items():
            self._set(name, value)

    def solve(self, data: Mapping[str, Any] | None = None) -> BatchSolution:
        """Solve all entries. Data are sticky as in `Session.solve`."""
        start = time.perf_counter()
        for name, value in (data or {}).items():
            self._set(name, value)
        missing = [name for name, given in self.given.items() if not given]
        if missing:
            raise DataError(f"data never given and without default: {', '.join(missing)}; pass them to solve or update")
        solution = self._solve()
        solution.seconds = {"solve": time.perf_counter() - start}
        return solution

    def data_of(self, entry: int) -> dict[str, np.ndarray]:
        """Data of one entry by name, as `Session.solve` takes them."""
        store = self._store(entry)
        return {name: store[name].copy() for name, datum in self.layout.problem.inputs.items() if datum.of is None}

    def _store(self, entry: int) -> DataStore:
        raise NotImplementedError

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
    """Affine maps on the leading axis, QPs for violators."""

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
        self._groups: list[Group] | None = None
        self._stacked: StackedMaps | None = None
        self._forks: list[Any] = []
        self._last: dict[int, Any] = {}

    def _set(self, name: str, value: Any) -> None:
        rows = self._rows(name, value)
        blocks, part = rows.shape[0], self._slices[name]
        self._require_finite(name, rows)
        view = self.numbers[:, part].reshape(blocks, self.count // blocks, -1)
        given = rows[:, None]
        if name in self._slow_names:
            self._blocks[name] = blocks
            if not np.array_equal(view, np.broadcast_to(given, view.shape), equal_nan=True):
                self._groups = None
        if self._note_missing(name, rows):
            self._groups = None
        view[...] = given
        self.given[name] = True
        if name in self._presence:
            entry = self.layout.problem.inputs[name]
            flags = ~np.isnan(self.numbers[:, part].reshape(self.count, entry.rows, entry.size)).any(axis=2)
            self.numbers[:, self._slices[self._presence[name]]] = flags

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

    def _solve(self) -> BatchSolution:
        groups = self._grouped()
        numbers = clean(self.numbers) if self._missing or self._infinite else self.numbers
        out = BatchSolution(self.layout, np.empty((self.count, self.layout.size)), "linear")
        tolerance = self.session.options.tolerance
        if self._stacked is not None:
            entries, violated = self._stacked(numbers, out.point, tolerance)
            for place in violated:
                group = groups[place // entries.shape[1]]
                self._one(group, int(entries.flat[place]), out)
            return out
        for group in groups:
            map_, entries = group.map, group.entries
            if map_.definite and group.session.screens:
                z, excess = map_.many(numbers[entries])
                out.point[entries] = z
                if not excess.shape[1]:
                    continue
                entries = entries[excess.max(axis=1) > tolerance]
            for entry in entries:
                self._one(group, int(entry), out)
        return out

    def _one(self, group: Group, entry: int, out: BatchSolution) -> None:
        """Solve one entry by the backend."""
        session = group.session
        session.adopt(self.numbers[entry], same_map=True)
        session.last = self._last.get(entry)
        out.take(entry, session.solve_screened_out())
        self._last[entry] = session.last

    def _grouped(self) -> list[Group]:
        """Entries that share a map."""
        if self._groups is None:
            parts = self._parts()
            while len(self._forks) < len(parts):
                self._forks.append(self.session.fork())
            groups = []
            for entries, fork in zip(parts, self._forks, strict=False):
                fork.adopt(self.numbers[entries[0]])
                groups.append(Group(entries, fork, fork.current_map()))
            self._groups, self._stacked = groups, StackedMaps.of(groups)
        return self._groups

    def _parts(self) -> list[np.ndarray]:
        blocks = math.lcm(*self._blocks.values()) if self._blocks else 1
        patterns = math.lcm(*(missing.shape[0] for missing in self._missing.values())) if self._missing else 1
        if blocks < self.count or self.count == 1:
            uniform = all((missing == missing[0]).all() for missing in self._missing.values())
            if uniform or not blocks % patterns:
                return list(np.arange(self.count).reshape(blocks, -1))
        key = self.numbers[:, self._slow]
        if self._missing:
            key = np.hstack([key, np.isnan(self.numbers)])
        _, inverse = np.unique(key, axis=0, return_inverse=True)
        inverse = inverse.ravel()
        order = np.argsort(inverse, kind="stable")
        return np.split(order, np.cumsum(np.bincount(inverse))[:-1])


class StackedMaps:
    """Affine maps of groups of equal size, applied by one stacked product.

    Attributes:
        entries: (groups, entries per group).
    """

    def __init__(self, groups: list[Group], maps: list[DenseMap]) -> None:
        self.entries = np.array([group.entries for group in groups])
        self._size = maps[0].size
        self._T = np.array([map_.T for map_ in maps]) if len(maps) > 1 else maps[0].T[None]
        self._t = np.array([map_.t for map_ in maps])[:, None]
        self._in_order = bool((self.entries.ravel() == np.arange(self.entries.size)).all())

    @classmethod
    def of(cls, groups: list[Group]) -> StackedMaps | None:
        """None where the groups are unequal or have no affine answer."""
        maps = [group.map for group in groups if isinstance(group.map, DenseMap) and group.map.definite]
        if len(maps) < len(groups) or not groups[0].session.screens:
            return None
        alike = len({group.entries.size for group in groups}) == len({map_.T.shape for map_ in maps}) == 1
        return cls(groups, maps) if alike else None

    def __call__(self, numbers: np.ndarray, point: np.ndarray, tolerance: float) -> tuple[np.ndarray, list[int]]:
        """Fill `point`; the entries and the flat places among them that violate a row."""
        rows = numbers if self._in_order else numbers[self.entries.ravel()]
        out = rows.reshape(*self.entries.shape, -1) @ self._T.transpose(0, 2, 1)
        out += self._t
        flat = out.reshape(self.entries.size, -1)
        if self._in_order:
            point[...] = flat[:, : self._size]
        else:
            point[self.entries.ravel()] = flat[:, : self._size]
        if flat.shape[1] == self._size:
            return self.entries, []
        excess = flat[:, self._size :].max(axis=1)
        return self.entries, np.flatnonzero(excess > tolerance).tolist()
