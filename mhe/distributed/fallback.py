"""What a node estimates where its window has no solution: the prediction, or bounds relaxed by slacks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mhe.distributed.options import DistributedOptions
from mhe.distributed.pool import WindowPool
from mhe.polyhedron import Polyhedron
from problems.models import LinearModel
from problems.solvers.base import Status
from problems.solvers.session import Session, Solution

SOLVED = (Status.SOLVED, Status.INACCURATE)
STOPPED = (Status.ITERATION_LIMIT, Status.TIME_LIMIT)


def usable(solution: Solution) -> bool:
    """Whether the states of a solution are worth more than a prediction."""
    return solution.status in SOLVED or (solution.status in STOPPED and solution.iterations > 0)


def data_of(session: Session) -> dict[str, Any]:
    """All data that a session has, to give them to a relaxed one."""
    store, inputs = session.store, session.problem.inputs.items()
    return {name: store[name] for name, entry in inputs if entry.of is None}


def predicted(model: LinearModel, before: np.ndarray, inputs: np.ndarray, newest: int, slid: bool) -> np.ndarray:
    """The window before, moved on by the model without disturbance.

    Args:
        before: states (slots, n) of the step before.
        inputs: (slots, m), row k acted up to slot k.
        newest: slot of the newest instant.
        slid: whether the oldest instant left.
    """
    states = np.vstack([before[1:], before[-1:]]) if slid else before.copy()
    for k in range(newest, len(states)):
        states[k] = model.A @ states[k - 1] + model.B @ inputs[k]
    return states


class Fallback:
    """Answers infeasible windows of one local problem as ``options.infeasible`` says.

    Args:
        pool, model, gain, options, state_bounds, disturbance_bounds: as for `WindowPool.get`.
        bounds: names of the window's bounds.
    """

    def __init__(
        self,
        pool: WindowPool,
        model: LinearModel,
        gain: np.ndarray | None,
        options: DistributedOptions,
        state_bounds: Polyhedron | None,
        disturbance_bounds: Polyhedron | None,
        bounds: tuple[str, ...],
    ) -> None:
        self._pool = pool
        self._problem = model, gain, options, state_bounds, disturbance_bounds
        self._soft = options.infeasible == "soft"
        self._names = bounds
        self._session: Session | None = None

    def __call__(self, data: Mapping[str, Any], prediction: np.ndarray, newest: int) -> tuple[np.ndarray, list[str]]:
        """States (slots, n) and the names of the bounds that could not be met.

        Args:
            data: all data of the window that is infeasible.
            prediction: states (slots, n) where nothing better is found.
            newest: slot of the newest instant.
        """
        everything = [f"{name} bounds" for name in self._names]
        if not self._soft:
            return prediction, everything
        if self._session is None:
            self._window, session = self._pool.get(*self._problem, soft=True)[:2]
            self._session = session.fork()
        solution = self._session.solve(data)
        if solution.status not in SOLVED:
            return prediction, everything
        return solution["x"], list(self._window.unmet(solution, newest + 1))
