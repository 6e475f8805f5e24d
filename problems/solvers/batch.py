"""The same session on a leading axis: many nodes or many trials at once.

On the quadratic form, entries with equal weights, matrices and pattern of missing data share one affine map and are
answered by one matrix product; only entries that violate a row go to the QP backend, one by one. Other forms run one
fork per entry behind the same interface.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from problems.errors import DataError, ShapeError, UnknownNameError
from problems.forms.layout import Layout, data_rows
from problems.forms.quadratic import clean
from problems.solvers.base import Status
from problems.solvers.session import Session, Solution

if TYPE_CHECKING:
    from problems.solvers.qp_session import QPSession

Maps = "DenseMap | SparseMap"


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


class BatchSession:
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
        """Take data of all entries: with a leading axis (count, ...), or one value shared by all."""
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

    def _rows(self, name: str, value: Any) -> np.ndarray:
        """(count or 1, numbers of the datum)."""
        entry = self.layout.problem.inputs.get(name)
        if entry is None:
            raise UnknownNameError("data", name, self.layout.problem.inputs)
        array = np.asarray(value, dtype=float)
        full = (self.count, *(() if entry.count is None else (entry.count,)), *entry.shape)
        if array.shape == full:
            return array.reshape(self.count, entry.rows * entry.size)
        try:
            return np.array(data_rows(entry, array)).reshape(1, -1)
        except ShapeError:
            raise ShapeError(
                f"data {name!r}: expected shape {full} (one per entry) or {full[1:]} (shared), got {array.shape}"
            ) from None

    def _set(self, name: str, value: Any) -> None:
        raise NotImplementedError

    def _solve(self) -> BatchSolution:
        raise NotImplementedError


class ForkBatch(BatchSession):
    """One fork per entry; for forms without an affine answer."""

    def __init__(self, session: Session, count: int) -> None:
        super().__init__(session, count)
        self.forks = [session.fork() for _ in range(count)]

    def _set(self, name: str, value: Any) -> None:
        rows = self._rows(name, value)
        entry = self.layout.problem.inputs[name]
        for k, fork in enumerate(self.forks):
            fork.update(**{name: rows[k % rows.shape[0]].reshape(entry.rows, entry.size)})
        self.given[name] = True

    def _solve(self) -> BatchSolution:
        out = BatchSolution(self.layout, np.empty((self.count, self.layout.stored_size)), self.session.solver)
        for k, fork in enumerate(self.forks):
            out.take(k, fork.solve())
        return out


class QPBatch(BatchSession):
    """Affine maps on the leading axis, QPs for violators."""

    session: QPSession

    def __init__(self, session: QPSession, count: int) -> None:
        super().__init__(session, count)
        self.numbers = np.tile(session.store.numbers, (count, 1))
        program = session.program
        starts, inputs = self.layout.data_start, self.layout.problem.inputs
        self._slices = {n: slice(starts[n], starts[n] + e.rows * e.size) for n, e in inputs.items()}
        slow = [np.arange(self._slices[n].start, self._slices[n].stop) for n in session.slow]
        self._slow = np.concatenate([*slow, program.activity.switches]) if slow else program.activity.switches
        self._presence = {e.of.name: n for n, e in inputs.items() if e.of is not None}
        self._groups: list[tuple[np.ndarray, QPSession, Any]] | None = None
        self._last: dict[int, Any] = {}
        self._missing = False

    def _set(self, name: str, value: Any) -> None:
        rows = self._rows(name, value)
        part = self._slices[name]
        entry = self.layout.problem.inputs[name]
        missing = bool(np.isnan(rows).any())
        slow = name in self.session.slow or name in self.session.switching
        if self._groups is not None and (missing or self._missing or slow):
            before = self.numbers[:, part]
            if slow and not np.array_equal(before, np.broadcast_to(rows, before.shape), equal_nan=True):
                self._groups = None
            elif not np.array_equal(np.isnan(before), np.broadcast_to(np.isnan(rows), before.shape)):
                self._groups = None
        self.numbers[:, part] = rows
        self.given[name] = True
        if name in self._presence:
            flags = ~np.isnan(self.numbers[:, part].reshape(self.count, entry.rows, entry.size)).any(axis=2)
            self.numbers[:, self._slices[self._presence[name]]] = flags
        self._missing = self._missing or missing

    def _grouped(self) -> list[tuple[np.ndarray, QPSession, Any]]:
        """Entries that share a map: their numbers, a session holding their weights, the map."""
        if self._groups is not None:
            return self._groups
        self._missing = bool(np.isnan(self.numbers).any())
        keys = [np.ascontiguousarray(self.numbers[:, self._slow])]
        if self._missing:
            keys.append(np.isnan(self.numbers).astype(float))
        key = np.ascontiguousarray(np.hstack(keys))
        if key.shape[1]:
            _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
            inverse = inverse.ravel()
        else:
            first, inverse = np.zeros(1, int), np.zeros(self.count, int)
        order = np.argsort(inverse, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(inverse))[:-1])
        groups = []
        for entries, k in zip(parts, first, strict=True):
            fork = self.session.fork()
            fork.adopt(self.numbers[k])
            groups.append((entries, fork, fork.current_map()))
        self._groups = groups
        return groups

    def _solve(self) -> BatchSolution:
        groups = self._grouped()
        finite = np.isfinite(self.numbers).all()
        numbers = self.numbers if finite else clean(self.numbers)
        out = BatchSolution(self.layout, np.empty((self.count, self.layout.size)), "linear")
        for entries, fork, map_ in groups:
            whole = entries.size == self.count
            rows = numbers if whole else numbers[entries]
            if not (map_.definite and fork.screens):
                violated = np.arange(entries.size)
            else:
                z, excess = map_.many(rows)
                out.point[slice(None) if whole else entries] = z
                if not excess.shape[1]:
                    continue
                violated = np.flatnonzero(excess.max(axis=1) > self.session.options.tolerance)
            for v in violated:
                entry = int(entries[v])
                out.take(entry, self._one(fork, entry))
        return out

    def _one(self, fork: QPSession, entry: int) -> Solution:
        fork.adopt(self.numbers[entry], same_map=True)
        fork.last = self._last.get(entry)
        solution = fork.solve_screened_out()
        self._last[entry] = fork.last
        return solution
