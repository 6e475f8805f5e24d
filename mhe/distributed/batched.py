"""Many trials of a network at once, on a leading axis of the same compiled windows.

Equal to the nodes of `mhe.distributed.node` over ideal links to rounding: nodes with equal local problems form one
batch, whose entries are these nodes times the trials.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from mhe.arrival import inverse
from mhe.covariance import SETTLED_TOLERANCE
from mhe.distributed.design import NetworkDesign
from mhe.distributed.fallback import SOLVED, STOPPED, Fallback, predicted
from mhe.distributed.network import Infeasibility
from mhe.window import Window
from problems.errors import DataError, ShapeError
from problems.solvers.base import Status
from problems.solvers.batch import BatchSession
from problems.solvers.session import Session


@dataclass(frozen=True, eq=False)
class TrialInfeasibility(Infeasibility):
    """Bounds that a node's window could not meet in one trial.

    Attributes:
        trial: number of the trial.
    """

    trial: int = 0


@dataclass(frozen=True, eq=False)
class BatchEstimate:
    """Estimates of all nodes in all trials after one step.

    Attributes:
        states: (trials, count, n) of the newest state.
        status: (trials, count) of `Status`.
        infeasible: what could not be met.
        seconds: wall time of the step, all trials and nodes.
        instant: time step, counted from 0.
    """

    states: np.ndarray
    status: np.ndarray
    infeasible: tuple[TrialInfeasibility, ...]
    seconds: float
    instant: int


@dataclass(frozen=True, eq=False)
class TrialRun:
    """All steps of all trials.

    Attributes:
        states: (trials, steps, count, n) estimates x_{t|t} of every node; step 0 is mu_0.
        status: steps by status, over trials and nodes.
        infeasible: what could not be met.
        seconds: (steps,) wall time of each step, all trials and nodes.
    """

    states: np.ndarray
    status: Counter[Status]
    infeasible: tuple[TrialInfeasibility, ...]
    seconds: np.ndarray


class _Group:
    """Nodes with equal local problems, for all trials: entries are node after node, trials inside."""

    def __init__(self, design: NetworkDesign, nodes: list[int], window: Window, session: Session, trials: int) -> None:
        self.nodes, self.window = np.array(nodes), window
        self.batch: BatchSession = session.batch(len(nodes) * trials)
        self.rows = np.array([design.regional_rows[node] for node in nodes])
        gain = None if design.gains is None else design.gains[nodes[0]].gain
        bounds = design.state_bounds, design.disturbance_bounds
        self.fallback = Fallback(design.pool, design.regional[nodes[0]], gain, design.options, *bounds, window.bounds)
        self.fused: np.ndarray | None = None
        self.passed: np.ndarray | None = None


class BatchedNetwork:
    """A network of `DistributedNode` in many trials at once, over ideal links.

    Args:
        design: of the network.
        trials: how many.
        updates: of the arrival covariances; at least as many as there will be steps after the first N, or the default
            for a run of unknown length.

    Attributes:
        status: steps by status, over trials and nodes.
    """

    def __init__(self, design: NetworkDesign, trials: int, updates: int | None = None) -> None:
        if trials < 1:
            raise DataError(f"a batched network runs at least one trial, got {trials}")
        self.design, self.trials = design, trials
        options, model, network = design.options, design.model, design.network
        self._horizon = options.horizon
        known = design.covariances() if updates is None else design.covariances(updates)
        self._fused = known.fused
        groups: dict[int, list[int]] = {}
        compiled: dict[int, tuple[Window, Session]] = {}
        for node in range(network.count):
            gain = None if design.gains is None else design.gains[node].gain
            bounds = design.state_bounds, design.disturbance_bounds
            window, session = design.pool.get(design.regional[node], gain, options, *bounds)
            groups.setdefault(id(window), []).append(node)
            compiled[id(window)] = window, session
        self._groups = [_Group(design, nodes, *compiled[key], trials) for key, nodes in groups.items()]
        slots = self._horizon + 1
        self._y = np.full((slots, trials, model.measurement_size), np.nan)
        self._u = np.zeros((trials, slots, model.input_size))
        mean = model.prior()[0]
        self._states = np.broadcast_to(mean, (network.count, trials, slots, model.state_size)).copy()
        self._published = self._states[:, :, 0].copy()
        self._instant = -1
        self.status: Counter[Status] = Counter()

    def step(self, measurements: Any, inputs: Any = None) -> BatchEstimate:
        """Take the measurements of the next instant; the first step is instant 0.

        Args:
            measurements: (trials, p) of all sensors in the order of the model, NaN where a component is missing.
            inputs: u_{t-1} (m,) or (trials, m).

        Raises:
            ShapeError, DataError: they do not fit.
        """
        started = perf_counter()
        y = np.asarray(measurements, dtype=float)
        if y.shape != self._y.shape[1:]:
            raise ShapeError(f"measurements: expected shape {self._y.shape[1:]}, got {y.shape}")
        if np.isinf(y).any():
            raise DataError(f"measurements: an infinite value at time step {self._instant + 1}; a missing one is NaN")
        self._advance(y, self._input(inputs))
        count, newest = self.design.network.count, self._newest
        status = np.full((count, self.trials), Status.SOLVED, dtype=object)
        infeasible: list[TrialInfeasibility] = []
        if self._instant:
            reference = self._reference()
            for group in self._groups:
                self._solve(group, reference, status, infeasible)
            self._published = self._states[:, :, 1 if newest == self._horizon else 0].copy()
        self.status.update(status.ravel().tolist())
        return BatchEstimate(
            states=self._states[:, :, newest].swapaxes(0, 1).copy(),
            status=status.T,
            infeasible=tuple(infeasible),
            seconds=perf_counter() - started,
            instant=self._instant,
        )

    def _input(self, inputs: Any) -> np.ndarray:
        m, instant = self.design.model.input_size, self._instant + 1
        if inputs is None and (not m or not instant):
            return np.zeros(m)
        if inputs is None:
            raise DataError(f"inputs: the model needs {m} input(s) at time step {instant}")
        u = np.asarray(inputs, dtype=float)
        if u.shape not in ((m,), (self.trials, m)) or not np.isfinite(u).all():
            raise DataError(f"inputs: expected {m} finite number(s), or one row per trial, got shape {u.shape}")
        return u

    def _advance(self, y: np.ndarray, u: np.ndarray) -> None:
        self._instant += 1
        self._slid = self._instant > self._horizon
        self._newest = min(self._instant, self._horizon)
        if self._slid:
            self._y[:-1] = self._y[1:]
            self._u[:, :-1] = self._u[:, 1:]
        self._y[self._newest] = y
        self._u[:, self._newest] = u

    def _reference(self) -> np.ndarray:
        """(count, trials, n) reference of the arrival cost (2.22)."""
        rule = self.design.options.growth_prior
        if self._instant <= self._horizon and rule != "consensus":
            return (
                self._published
                if rule == "own"
                else np.broadcast_to(self.design.model.prior()[0], self._published.shape)
            )
        return self.design.weights.combine(self._published)

    def _solve(
        self,
        group: _Group,
        reference: np.ndarray,
        status: np.ndarray,
        infeasible: list[TrialInfeasibility],
    ) -> None:
        nodes, batch = group.nodes, group.batch
        data: dict[str, Any] = {"reference": reference[nodes].reshape(batch.count, -1)}
        if group.rows.shape[1]:
            # (slots, trials, nodes, p_bar) to entries and time-first rows
            data["y"] = self._y[:, :, group.rows].transpose(2, 1, 0, 3).reshape(batch.count, -1)
        data.update(self._information(group))
        if self._u.shape[2]:
            data["u"] = np.tile(self._u, (len(nodes), 1, 1))
        if group.window.bounds and not self._slid:
            data["filled"] = (np.arange(self._horizon + 1) <= self._newest).astype(float)
        solution = batch.solve(data)
        shape = (len(nodes), self.trials)
        outcome = solution.status.reshape(shape)
        before = self._states[nodes]
        self._states[nodes] = solution["x"].reshape(before.shape)
        if solution.solved:
            return
        good = np.isin(outcome, SOLVED) | (np.isin(outcome, STOPPED) & (solution.iterations.reshape(shape) > 0))
        status[nodes] = np.where(~good & np.isin(outcome, STOPPED), Status.FAILED, outcome)
        for place, trial in np.argwhere(~good):
            node = int(nodes[place])
            states = predicted(self.design.model, before[place, trial], self._u[trial], self._newest, self._slid)
            if status[node, trial] is Status.INFEASIBLE:
                one = batch.data_of(int(place) * self.trials + int(trial))
                states, unmet = group.fallback(one, states, self._newest)
                label = self.design.network.labels[node]
                infeasible.append(TrialInfeasibility(label, self._instant, tuple(unmet), int(trial)))
            self._states[node, trial] = states

    def _information(self, group: _Group) -> dict[str, Any]:
        entry = min(max(0, self._instant - self._horizon), len(self._fused) - 1)
        fused = self._fused[entry, group.nodes]
        if group.fused is not None and np.array_equal(fused, group.fused):
            return {}
        group.fused = fused
        matrix = inverse(fused)
        if group.passed is not None:
            change, size = (np.abs(part).max(axis=(1, 2)) for part in (matrix - group.passed, matrix))
            if (change <= SETTLED_TOLERANCE * size).all():
                return {}
        group.passed = matrix
        return {"information": matrix}


def run_trials(design: NetworkDesign, measurements: Any, inputs: Any = None) -> TrialRun:
    """Run a network over recorded or simulated trials.

    Args:
        design: of the network.
        measurements: (trials, steps, p) of all sensors in the order of the model, instant 0 first; NaN where missing.
        inputs: (steps - 1, m) or (trials, steps - 1, m); row k acts from instant k to k + 1.

    Raises:
        ShapeError, DataError: they do not fit.
    """
    y = np.asarray(measurements, dtype=float)
    if y.ndim != 3:
        raise ShapeError(f"measurements: expected shape (trials, steps, p), got {y.shape}")
    trials, steps = y.shape[:2]
    m = design.model.input_size
    u = None if inputs is None else np.asarray(inputs, dtype=float)
    if u is not None and u.shape not in ((steps - 1, m), (trials, steps - 1, m)):
        raise ShapeError(f"inputs: expected shape {(steps - 1, m)} or {(trials, steps - 1, m)}, got {u.shape}")
    network = BatchedNetwork(design, trials, updates=max(0, steps - 1 - design.options.horizon))
    states = np.empty((trials, steps, design.network.count, design.model.state_size))
    seconds = np.empty(steps)
    infeasible: list[TrialInfeasibility] = []
    for k in range(steps):
        estimate = network.step(y[:, k], None if u is None or not k else u[..., k - 1, :])
        states[:, k], seconds[k] = estimate.states, estimate.seconds
        infeasible += estimate.infeasible
    return TrialRun(states, network.status, tuple(infeasible), seconds)
