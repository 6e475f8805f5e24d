"""All nodes of a network with detections in many trials at once, on arrays.

Equal to the nodes of `mhe.sporadic.node` over ideal links to rounding. Every window falls apart into the parts of the
model that nothing couples (vehicles), so that the local problems of all parts, nodes and trials are one batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from mhe.arrival import inverse
from mhe.covariance import capped, conditioned, detection_update, symmetrized
from mhe.distributed.fallback import STOPPED
from mhe.sporadic.design import SporadicDesign
from mhe.sporadic.maps import NetworkMaps
from mhe.sporadic.parts import PartProblems
from mhe.sporadic.ranks import WindowRank
from mhe.sporadic.readings import Sensors
from mhe.sporadic.rows import Projection
from problems.errors import DataError, SettingError, ShapeError
from problems.networks.weights import normalize_rows
from problems.solvers.base import Status


@dataclass(frozen=True, eq=False)
class DetectionBatch:
    """Estimates of all nodes in all trials after one step.

    Attributes:
        states: (trials, nodes, n) of the newest state.
        status: (trials, nodes) of `Status`; ``infeasible`` where rows of any part contradict each other.
        unmet: (trials, nodes, parts) whose rows do.
        seconds: wall time of the step, all trials and nodes.
        instant: time step, counted from 0.
    """

    states: np.ndarray
    status: np.ndarray
    unmet: np.ndarray
    seconds: float
    instant: int


class BatchedDetections:
    """A network of `SporadicNode` in many trials at once, over ideal links and without late readings.

    Args:
        design: of the network.
        trials: how many.

    Raises:
        DataError: no trials.
        SettingError: sets that are not convex (``pieces``), whose search is one node's own.
    """

    def __init__(self, design: SporadicDesign, trials: int) -> None:
        if trials < 1:
            raise DataError(f"a batched network runs at least one trial, got {trials}")
        if design.options.pieces != "none":
            raise SettingError(
                f"pieces={design.options.pieces!r} are searched node by node; run a SporadicEstimator, or set "
                "pieces='none'"
            )
        self.design, self.trials = design, trials
        plans = design.plans
        self._plan, self._options = plans[0], design.options
        self._count, self._horizon = design.network.count, design.options.horizon
        names = [sensor.name for sensor in design.model.sensors]
        sizes = [len(range(design.model.measurement_size)[design.model.rows(name)]) for name in names]
        self._sensors = Sensors(names, sizes, self._plan.width)
        self._sizes = sizes
        self._maps = NetworkMaps(plans, names)
        self._problems = PartProblems(plans, trials, design.pool)
        place = {name: number for number, name in enumerate(names)}
        self._regions = [np.array([place[name] for name in plan.names], dtype=np.intp) for plan in plans]
        # a sensor that makes no rows points behind the last one, where the flag is 0
        self._row_sensors = np.array(
            [
                np.where(plan.row_sensors < 0, len(names), np.append(region, 0)[plan.row_sensors])
                for plan, region in zip(plans, self._regions, strict=True)
            ]
        )
        self._ranks = None
        if design.options.weights == "rank":
            self._ranks = [WindowRank(plan.transition, plan.parts, plan.outputs) for plan in plans]
        self._weights = _by_link([plan.weights for plan in plans])
        self._listeners = _by_link([plan.listeners for plan in plans])
        self._projections = self._projected_sensors()
        self.reset()

    def _projected_sensors(self) -> dict[int, Projection]:
        """What the readings of a sensor are projected with before they feed observers."""
        design = self.design
        if design.options.rows != "projected":
            return {}
        pairs = zip(design.own_sensors, design.fields, strict=True)
        return {int(s): Projection(field) for own, field in pairs if field is not None for s in own}

    def reset(self) -> None:
        """Forget everything but the design: the next step is instant 0."""
        plan, slots, S = self._plan, self._horizon + 2, self._sensors.count
        V, m = plan.blocks.count, plan.blocks.size
        self._flags = np.zeros((slots, self.trials, S))
        self._values = np.zeros((slots, self.trials, S, plan.width))
        self._fed = self._values.copy()
        lead = self.trials, self._count, V
        self._states = np.broadcast_to(plan.mean[:, None], (*lead, self._horizon + 1, m)).copy()
        self._published = np.broadcast_to(plan.mean, (*lead, m)).copy()
        self._reference = self._published
        self._fused = np.broadcast_to(plan.start, (*lead, m, m)).copy()
        self._instant = -1

    def step(self, values: Any, flags: Any = None) -> DetectionBatch:
        """Take what was detected at the next instant; the first step is instant 0.

        Args:
            values: (trials, ...) readings of all sensors in the order of the model, (p,) or any shape of that size.
            flags: (trials, ...) 1 or 0 per sensor; by default, where the reading is there.

        Raises:
            ShapeError, DataError: they do not fit, see `mhe.sporadic.readings.Sensors`.
        """
        started = perf_counter()
        self._enter(values, flags)
        plan, newest = self._plan, min(self._instant, self._horizon)
        shape = self.trials, self._count
        status = np.full(shape, Status.SOLVED, dtype=object)
        unmet = np.zeros((*shape, plan.blocks.count), dtype=bool)
        if self._instant:
            self._arrival()
            status, unmet = self._solve()
            self._published = self._states[..., 1 if newest == self._horizon else 0, :].copy()
        states = plan.blocks.together(self._states[..., newest, :])
        return DetectionBatch(states, status, unmet, perf_counter() - started, self._instant)

    def _enter(self, values: Any, flags: Any) -> None:
        if len(values) != self.trials or (flags is not None and len(flags) != self.trials):
            raise ShapeError(f"expected readings and flags of {self.trials} trial(s), got {len(values)}")
        self._instant += 1
        newest = min(self._instant, self._horizon) + 1
        if self._instant > self._horizon:
            for array in (self._flags, self._values, self._fed):
                array[:-1] = array[1:]
        for trial in range(self.trials):
            given = None if flags is None else flags[trial]
            what = f"trial {trial}, time step {self._instant}"
            self._values[newest, trial], self._flags[newest, trial] = self._sensors.read(values[trial], given, what)
        fed = self._fed[newest]
        fed[...] = self._values[newest]
        if self._projections:
            for trial, sensor in np.argwhere(self._flags[newest] > 0).tolist():
                size = self._sizes[sensor]
                if sensor in self._projections:
                    fed[trial, sensor, :size] = self._projections[sensor](fed[trial, sensor, :size])

    # Arrival cost

    def _arrival(self) -> None:
        plan, options = self._plan, self._options
        own, start = self._published, np.broadcast_to(plan.start, self._fused.shape)
        if self._instant <= self._horizon:
            self._fused = start
            if options.growth_prior == "consensus":
                said = np.broadcast_to(plan.mean, own.shape) if options.prior == "filter" else own
                self._reference = self._over_neighbours(self._link_weights(), said)
            else:
                self._reference = own if options.growth_prior == "own" else np.broadcast_to(plan.mean, own.shape)
            return
        informations = self._maps.information(self._flags[:-1])
        A = plan.transition
        covariance = detection_update(self._fused, A, plan.disturbance, informations, options.pi_update)
        if options.prior == "filter":
            left = informations[0]
            innovation = -self._maps.linear(self._values[0]) - np.einsum("...ij,...j->...i", left, self._reference)
            correction = np.einsum("...ij,...j->...i", conditioned(self._fused, left), innovation)
            own = np.einsum("...ij,...j->...i", A, self._reference + correction)
        weights = self._link_weights()
        self._reference = self._over_neighbours(weights, own)
        factors = weights if self._listeners is None else self._listeners * weights**2
        self._fused = capped(symmetrized(self._over_neighbours(factors, covariance)), options.covariance_cap)

    def _over_neighbours(self, factors: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Sums (trials, nodes, ...) of what neighbours said, with a factor for every link."""
        network = self.design.network
        spread = values[:, network.senders] * factors.reshape(*factors.shape, *(1,) * (values.ndim - 2))
        return np.add.reduceat(spread, network.offsets[:-1], axis=1)

    def _link_weights(self) -> np.ndarray:
        """(trials or 1, links) consensus weights."""
        if self._ranks is None:
            assert self._weights is not None
            return self._weights[None]
        start = 1 if self._instant < self._horizon else 2
        ranks = np.array(
            [
                [
                    rank(self._flags[start:, trial, region])
                    for rank, region in zip(self._ranks, self._regions, strict=True)
                ]
                for trial in range(self.trials)
            ],
            dtype=float,
        )
        network = self.design.network
        return normalize_rows(np.maximum(ranks, self._options.rank_floor)[:, network.senders], network.offsets)

    # Local problems

    def _solve(self) -> tuple[np.ndarray, np.ndarray]:
        flags = self._flags[1:]
        data = {
            "reference": self._reference[..., None, :],
            "arrival information": inverse(self._fused)[..., None, :, :],
            "reading information": np.moveaxis(self._maps.information(flags), 0, 3),
            "reading linear": np.moveaxis(self._maps.linear(self._values[1:]), 0, 3),
            "transition": np.moveaxis(self._maps.transitions(flags[:-1]), 0, 3),
            "moved": np.moveaxis(self._maps.moved(self._fed[1:-1]), 0, 3),
        }
        active = np.zeros(self._states.shape[:3], dtype=bool)
        if self._plan.shape.sets:
            known = np.concatenate([flags, np.zeros((*flags.shape[:2], 1))], axis=2)
            rows = np.moveaxis(known[:, :, self._row_sensors], 0, 3)
            data["row active"] = rows.reshape(*rows.shape[:3], -1)
            active = data["row active"].any(axis=3)
        found = self._problems.solve(data)
        before = self._predicted()
        lost: Any = np.isnan(found.states).any(axis=(3, 4))
        unmet = found.unmet
        worst = np.full(active.shape[:2], Status.SOLVED, dtype=object)
        for kind in (Status.INACCURATE, *STOPPED, Status.FAILED, Status.UNBOUNDED, Status.INFEASIBLE):
            worst[(found.status == kind).any(axis=2)] = kind
        infeasible = np.equal(worst, Status.INFEASIBLE).astype(bool)[..., None]
        if self._options.rows != "soft" and self._options.unmet == "predict":
            lost |= infeasible  # a node solves its parts together
            unmet = active & infeasible
        self._states = np.where(lost[..., None, None], before, found.states)
        return worst, unmet

    def _predicted(self) -> np.ndarray:
        """The windows of the step before, moved on by the model."""
        states, newest = self._states, min(self._instant, self._horizon)
        if self._instant > self._horizon:
            states = np.concatenate([states[..., 1:, :], states[..., -1:, :]], axis=-2)
        else:
            states = states.copy()
        for k in range(newest, self._horizon + 1):
            states[..., k, :] = np.einsum("vij,...vj->...vi", self._plan.transition, states[..., k - 1, :])
        return states


def _by_link(rows: list[np.ndarray | None]) -> np.ndarray | None:
    """(links,) from what every node knows of its in-neighbours."""
    known = [row for row in rows if row is not None]
    return np.concatenate(known) if known else None
