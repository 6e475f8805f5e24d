"""Local problems of many parts at once: a window per part, node and trial, as entries of compiled batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mhe.distributed.fallback import SOLVED, STOPPED
from mhe.sporadic.local import RELAXED, row_data
from mhe.sporadic.options import SporadicOptions
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.pool import DetectionPool
from mhe.sporadic.window import DetectionWindow, WindowShape
from problems.solvers.base import Status
from problems.solvers.batch import BatchSession
from problems.solvers.session import Session


@dataclass(frozen=True, eq=False)
class Found:
    """Solutions, with leading axes (trials, nodes, parts).

    Attributes:
        states: (..., slots, m); NaN where nothing was found.
        status: (...) of `Status`.
        unmet: (...) whether rows contradict each other.
    """

    states: np.ndarray
    status: np.ndarray
    unmet: np.ndarray


class _Group:
    """Parts with the same disturbances, which share a compiled problem."""

    def __init__(self, plans: Sequence[SporadicPlan], parts: np.ndarray, trials: int, pool: DetectionPool) -> None:
        first = plans[0]
        self.parts, self.options = parts, first.options
        shape: WindowShape = replace(first.shape, parts=1)
        gain, noise = first.noise_gain[parts[:1]], first.noise[parts[:1]]
        window = DetectionWindow(shape, *((gain, noise) if shape.disturbances else (None, None)))
        options = first.options
        session = window.problem.compile(
            options.solver, eliminate=[window.later], tolerance=options.tolerance, **options.settings
        )
        self.slots, self.sets, self.size = shape.horizon + 1, shape.sets, shape.size
        self.batch: BatchSession = session.batch(trials * len(plans) * len(parts))
        self._rows = self._row_data(plans, shape, trials)
        if self._rows:
            self.batch.update(**self._rows)
        self._single = _Single(lambda soft: pool.get(shape, gain, noise, options, soft=soft), options)

    def _row_data(self, plans: Sequence[SporadicPlan], shape: WindowShape, trials: int) -> dict[str, np.ndarray]:
        """Row matrices and bounds of every entry."""
        if not shape.sets:
            return {}
        found: dict[str, list[np.ndarray]] = {}
        for plan in plans:
            for name, values in row_data(plan).items():
                by_part = values.reshape(self.slots, plan.shape.parts, shape.sets, *values.shape[1:])[:, self.parts]
                found.setdefault(name, []).append(np.moveaxis(by_part, 1, 0))
        return {
            name: np.tile(np.concatenate(parts), (trials,) + (1,) * (parts[0].ndim - 1)).reshape(
                -1, self.slots * shape.sets, *parts[0].shape[3:]
            )
            for name, parts in found.items()
        }

    def solve(self, data: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States (entries, slots, m), status and unmet of all entries from data (entries, ...)."""
        solution = self.batch.solve(data)
        states = solution["x"].reshape(-1, self.slots, self.size)
        status, unmet = solution.status.copy(), np.zeros(len(states), dtype=bool)
        again = np.array([one is Status.INFEASIBLE for one in status])
        if self.options.rows == "soft":
            again |= solution.method != "linear"
        for entry in np.flatnonzero(again).tolist():
            own = {name: values[entry] for name, values in (data | self._rows).items()}
            found, status[entry], unmet[entry] = self._single(own, hard=status[entry] is not Status.INFEASIBLE)
            states[entry] = np.nan if found is None else found
        known = np.array([one in SOLVED or one in STOPPED or one is Status.INFEASIBLE for one in status])
        states[~known] = np.nan
        return states, status, unmet


class _Single:
    """One entry alone, where its rows contradict each other or are soft."""

    def __init__(self, compiled: Callable[[bool], Session], options: SporadicOptions) -> None:
        self._compiled, self._options = compiled, options
        self._sessions: dict[bool, Session] = {}

    def _session(self, soft: bool) -> Session:
        if soft not in self._sessions:
            self._sessions[soft] = self._compiled(soft).fork()
        return self._sessions[soft]

    def __call__(self, data: dict[str, Any], *, hard: bool) -> tuple[np.ndarray | None, Status, bool]:
        """States (slots, m) or None, status, and whether rows are not met."""
        options = self._options
        if hard:
            session = self._session(False)
            solution = session.solve(data)
            last: Any = getattr(session, "last", None)
            if solution.method == "linear" or (
                solution.status in SOLVED and last is not None and np.abs(last[1]).max(initial=0.0) <= options.penalty
            ):
                return solution["x"], solution.status, False
        elif options.rows != "soft" and options.unmet != "soft":
            return None, Status.INFEASIBLE, True
        solution = self._session(True).solve(data)
        if solution.status not in SOLVED:
            return None, solution.status, False
        slack = solution["field of view slack"].max(axis=1)
        unmet = bool((slack[data["row active"].ravel() != 0] > RELAXED).any())
        return solution["x"], Status.INFEASIBLE if unmet else solution.status, unmet


class PartProblems:
    """The windows of all parts at all nodes in all trials.

    Args:
        plans: of all nodes.
        trials: how many.
        pool: where the windows of single entries are compiled.
    """

    def __init__(self, plans: Sequence[SporadicPlan], trials: int, pool: DetectionPool) -> None:
        first = plans[0]
        self._lead = trials, len(plans), first.shape.parts
        kinds: dict[bytes, list[int]] = {}
        for part in range(first.shape.parts):
            content = first.noise_gain[part].tobytes() + first.noise[part].tobytes()
            kinds.setdefault(content, []).append(part)
        self._groups = [_Group(plans, np.array(parts), trials, pool) for parts in kinds.values()]

    def solve(self, data: dict[str, np.ndarray]) -> Found:
        """Solve all windows.

        Args:
            data: of `DetectionWindow` for one part, by name, each (trials, nodes, parts, ...).
        """
        group = self._groups[0]
        states = np.empty((*self._lead, group.slots, group.size))
        status = np.empty(self._lead, dtype=object)
        unmet = np.zeros(self._lead, dtype=bool)
        for group in self._groups:
            own = {name: values[:, :, group.parts] for name, values in data.items()}
            lead = next(iter(own.values())).shape[:3]
            found = group.solve({name: values.reshape(-1, *values.shape[3:]) for name, values in own.items()})
            for into, values in zip((states, status, unmet), found, strict=True):
                into[:, :, group.parts] = values.reshape(*lead, *values.shape[1:])
        return Found(states, status, unmet)
