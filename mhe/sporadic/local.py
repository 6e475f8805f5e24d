"""The local problem of a node, (4.14)-(4.17), and what to do where its rows contradict each other (C7)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mhe.distributed.fallback import SOLVED, STOPPED, usable
from mhe.sporadic.numbers import RegionNumbers
from mhe.sporadic.pieces import PieceSearch
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.pool import DetectionPool
from mhe.sporadic.readings import Slots
from mhe.sporadic.rows import padded_rows
from problems.forms.layout import INFINITE
from problems.solvers.base import Status
from problems.solvers.session import Session

RELAXED = 1e-6  # slack (unit of the rows) beyond which a row counts as not met


class LocalProblem:
    """Solves the window of one node.

    Args:
        plan: of the node.
        pool: where windows are compiled.
        numbers: of the node's slots.
    """

    def __init__(self, plan: SporadicPlan, pool: DetectionPool, numbers: RegionNumbers) -> None:
        self._plan, self._pool, self._numbers = plan, pool, numbers
        self._session = pool.get(plan.shape, plan.noise_gain, plan.noise, plan.options).fork()
        self._relaxed: Session | None = None
        self._shape = plan.shape.horizon + 1, plan.blocks.count, plan.blocks.size
        self._rows = row_data(plan)
        if self._rows:
            self._session.update(**self._rows)
        self._row_sensors = plan.row_sensors.ravel()
        self._makes_rows = (self._row_sensors >= 0).astype(float)
        self._pieces = None
        if plan.unseen_pieces or any(plan.pieces):
            self._pieces = PieceSearch(plan, self._session, self._rows)

    def solve(
        self, slots: Slots, reference: np.ndarray, information: np.ndarray, predict: Callable[[], np.ndarray]
    ) -> tuple[np.ndarray, Status, tuple[str, ...]]:
        """States of all slots, status, and sensors whose rows are not met.

        Args:
            slots: readings of the region.
            reference, information: of the arrival cost, (parts, m) and (parts, m, m).
            predict: states (slots, parts, m) for where nothing better is found.
        """
        plan, numbers = self._plan, self._numbers
        m, flags = plan.blocks.size, slots.flags[1:]
        data: dict[str, Any] = {
            "reference": reference,
            "arrival information": information.reshape(-1, m * m),
            "reading information": numbers.information(flags).reshape(-1, m * m),
            "reading linear": numbers.linear(slots.values[1:]).reshape(-1, m),
            "transition": numbers.transitions(flags[:-1]).reshape(-1, m * m),
            "moved": numbers.moved(slots.fed[1:-1]).reshape(-1, m),
        }
        active = None
        if self._makes_rows.any():
            active = flags[:, self._row_sensors] * self._makes_rows
            data["row active"] = active.reshape(-1, 1)
        solution = self._session.solve(data)
        status = solution.status
        if usable(solution):
            if plan.options.rows == "soft" and status in SOLVED and solution.method != "linear" and self._too_dear():
                return self._soft(data, predict)
            if self._pieces is None or active is None or status is not Status.SOLVED:
                return solution["x"].reshape(self._shape), status, ()
            solution, unmet = self._pieces.refine(solution, flags, active, slots.newest)
            return solution["x"].reshape(self._shape), Status.INFEASIBLE if unmet else solution.status, unmet
        if status is not Status.INFEASIBLE:
            return predict(), Status.FAILED if status in STOPPED else status, ()
        if plan.options.rows == "soft" or plan.options.unmet == "soft":
            return self._soft(data, predict)
        assert active is not None
        concerned = np.unique(self._row_sensors[active.any(axis=0)])
        return predict(), status, tuple(plan.names[sensor] for sensor in concerned)

    def _too_dear(self) -> bool:
        """Whether meeting the rows costs more than the penalty, so that the soft problem differs from the hard one."""
        last: Any = getattr(self._session, "last", None)
        return last is None or np.abs(last[1]).max(initial=0.0) > self._plan.options.penalty

    def _soft(
        self, data: dict[str, Any], predict: Callable[[], np.ndarray]
    ) -> tuple[np.ndarray, Status, tuple[str, ...]]:
        plan = self._plan
        if self._relaxed is None:
            self._relaxed = self._pool.get(plan.shape, plan.noise_gain, plan.noise, plan.options, soft=True).fork()
            self._relaxed.update(**self._rows)
        solution = self._relaxed.solve(data)
        if solution.status not in SOLVED:
            return predict(), solution.status, ()
        slack = solution["field of view slack"].max(axis=1).reshape(self._shape[0], -1)
        slack[data["row active"].reshape(slack.shape) == 0] = 0.0
        concerned = np.unique(self._row_sensors[(slack > RELAXED).any(axis=0)])
        unmet = tuple(plan.names[sensor] for sensor in concerned)
        return solution["x"].reshape(self._shape), Status.INFEASIBLE if unmet else solution.status, unmet


def row_data(plan: SporadicPlan) -> dict[str, np.ndarray]:
    """H = G C and h of every instance of the rows; the same at every instant."""
    shape = plan.shape
    if not shape.sets:
        return {}
    H = np.zeros((*plan.row_sensors.shape, shape.rows, shape.size))
    h = np.full((*plan.row_sensors.shape, shape.rows), INFINITE)
    for place in np.argwhere(plan.row_sensors >= 0):
        sensor = plan.row_sensors[tuple(place)]
        polyhedron = plan.sets[sensor]
        assert polyhedron is not None
        H[tuple(place)], h[tuple(place)] = padded_rows(polyhedron, plan.outputs[sensor], shape.rows)
    slots = shape.horizon + 1
    return {
        "row matrix": np.tile(H.reshape(-1, shape.rows, shape.size), (slots, 1, 1)),
        "row bound": np.tile(h.reshape(-1, shape.rows), (slots, 1)),
    }
