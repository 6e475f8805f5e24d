"""`StackedNetwork`: all nodes of a network, in many trials, as one batch of one compiled window.

What methods differ in (arrival costs, what neighbours send) is left to subclasses; they equal message passing over
ideal links to rounding.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from mhe.distributed.fallback import SOLVED, STOPPED, predicted
from mhe.distributed.summed import Outputs, Region, SummedWindow, Sums
from mhe.network import Infeasibility
from problems.errors import DataError, ShapeError
from problems.models import LinearModel
from problems.networks import Network
from problems.solvers.base import Status
from problems.solvers.batch import BatchSession


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
        phases: seconds by phase: ``update`` (sums, arrival weights, maps) and ``solve``.
        violated: local problems whose answer without bounds violated one.
    """

    states: np.ndarray
    status: np.ndarray
    infeasible: tuple[TrialInfeasibility, ...]
    seconds: float
    instant: int
    phases: dict[str, float] = field(default_factory=dict)
    violated: int = 0


@dataclass(frozen=True, eq=False)
class TrialRun:
    """All steps of all trials.

    Attributes:
        states: (trials, steps, count, n) estimates x_{t|t} of every node; step 0 is mu_0.
        status: steps by status, over trials and nodes.
        infeasible: what could not be met.
        seconds: (steps,) wall time of each step, all trials and nodes.
        phases: seconds by phase: ``precompute`` before the first step, ``update`` and ``solve`` over all steps.
        factorizations: local problems factorized, over all steps.
        nbytes: memory of the engine's arrays at the end.
    """

    states: np.ndarray
    status: Counter[Status]
    infeasible: tuple[TrialInfeasibility, ...]
    seconds: np.ndarray
    phases: dict[str, float]
    factorizations: int
    nbytes: int


class StackedNetwork(ABC):
    """See the module.

    Args:
        model: of the network.
        network: who hears whom.
        mean: (n,) estimate of x_0.
        horizon: N.
        trials: how many.
        window: of any node.
        regions: what the nodes use of an instant.
        reach: (N + 1,) region of every age t - k.
        outputs: of the model.
        solver, settings: of the window.

    Attributes:
        status: steps by status, over trials and nodes.
        phases: seconds by phase so far: ``precompute``, ``update``, ``solve``.
    """

    def __init__(
        self,
        model: LinearModel,
        network: Network,
        mean: np.ndarray,
        horizon: int,
        trials: int,
        window: SummedWindow,
        regions: list[Region],
        reach: np.ndarray,
        outputs: Outputs,
        solver: str,
        settings: dict[str, Any],
    ) -> None:
        self.model, self.network, self.trials = model, network, trials
        self._horizon, self._window, slots = horizon, window, horizon + 1
        self._batch: BatchSession = window.compile(solver, **settings).batch(network.count * trials)
        self._sums = Sums(regions, reach, outputs, trials, observer=window.gain is not None)
        self._u = np.zeros((trials, slots, model.input_size))
        shape = network.count, trials, slots, model.state_size
        self._states = np.broadcast_to(mean, shape).copy()
        self._instant = -1
        self._filled = -1
        self.status: Counter[Status] = Counter()
        self.phases = {"precompute": 0.0, "update": 0.0, "solve": 0.0}

    @property
    def factorizations(self) -> int:
        """Local problems factorized so far; none are added once arrival weights and patterns have settled."""
        return self._batch.factorizations

    @property
    def nbytes(self) -> int:
        """Memory of all arrays that grow with the network, in bytes."""
        return self._batch.nbytes + self._sums.nbytes + self._states.nbytes

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
        if y.shape != self._sums.y.shape[1:]:
            raise ShapeError(f"measurements: expected shape {self._sums.y.shape[1:]}, got {y.shape}")
        if np.isinf(y).any():
            raise DataError(f"measurements: an infinite value at time step {self._instant + 1}; a missing one is NaN")
        self._advance(y, self._input(inputs))
        status = np.empty((self.network.count, self.trials), dtype=object)
        status[...] = Status.SOLVED  # numpy.full would turn it into a plain string
        infeasible: list[TrialInfeasibility] = []
        spent, violated = 0.0, 0
        if self._instant:
            spent, violated = self._solve(status, infeasible)
        self._publish()
        self._count(status)
        seconds = perf_counter() - started
        phases = {"update": seconds - spent, "solve": spent}
        for name, value in phases.items():
            self.phases[name] += value
        states = self._states[:, :, self._newest].swapaxes(0, 1).copy()
        return BatchEstimate(states, status.T, tuple(infeasible), seconds, self._instant, phases, violated)

    def run(self, measurements: Any, inputs: Any = None) -> TrialRun:
        """All steps of recorded or simulated trials.

        Args:
            measurements: (trials, steps, p) of all sensors, instant 0 first; NaN where missing.
            inputs: (steps - 1, m) or (trials, steps - 1, m); row k acts from instant k to k + 1.

        Raises:
            ShapeError, DataError: they do not fit.
        """
        y, u = series(self.model, measurements, inputs)
        steps = y.shape[1]
        states = np.empty((self.trials, steps, self.network.count, self.model.state_size))
        seconds = np.empty(steps)
        infeasible: list[TrialInfeasibility] = []
        for k in range(steps):
            estimate = self.step(y[:, k], None if u is None or not k else u[..., k - 1, :])
            states[:, k], seconds[k] = estimate.states, estimate.seconds
            infeasible += estimate.infeasible
        counts = dict(self.phases), self.factorizations, self.nbytes
        return TrialRun(states, self.status, tuple(infeasible), seconds, *counts)

    @abstractmethod
    def _arrival(self) -> dict[str, Any]:
        """Data of the arrival cost, by node and trial; information by node and only where it changed."""

    @abstractmethod
    def _publish(self) -> None:
        """Note what the neighbours are sent for the next step."""

    @abstractmethod
    def _relaxed(self, node: int, trial: int, data: dict[str, Any]) -> tuple[np.ndarray | None, tuple[str, ...], bool]:
        """Where a window has no solution: states (slots, n) or None for the prediction, what could not be met, and
        whether the problem counts as solved.

        Args:
            data: ``y`` (slots, p) of all sensors, ``u`` and ``filled`` as for `Window`, and the arrival cost.
        """

    def _more(self) -> dict[str, Any]:
        """Further data of the window."""
        return {}

    def _count(self, status: np.ndarray) -> None:
        self.status.update(status.ravel().tolist())

    def _input(self, inputs: Any) -> np.ndarray:
        m, instant = self.model.input_size, self._instant + 1
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
            self._u[:, :-1] = self._u[:, 1:]
        self._u[:, self._newest] = u
        self._sums.advance(y, self._newest, self._slid)

    def _solve(self, status: np.ndarray, infeasible: list[TrialInfeasibility]) -> tuple[float, int]:
        """Solve all local problems; seconds that took beyond new maps, and violators."""
        batch, sums = self._batch, self._sums
        shape = status.shape
        slow = sums.matrices()
        fast = {"heard": sums.heard.reshape(batch.count, *sums.heard.shape[2:])}
        if sums.push is not None:
            fast["push"] = sums.push.reshape(batch.count, *sums.push.shape[2:])
        if self._u.shape[2]:
            fast["u"] = np.tile(self._u, (self.network.count, 1, 1))
        arrival = self._arrival()
        if "filled" in batch.given and self._filled != self._newest:
            slow["filled"] = (np.arange(self._horizon + 1) <= self._newest).astype(float)
            self._filled = self._newest
        slow |= {name: arrival.pop(name) for name in ("information",) if name in arrival}
        solution = batch.solve(slow | fast | arrival | self._more())
        before = self._states
        self._states = solution["x"].reshape(before.shape)
        spent, violated = solution.seconds["solve"], int(np.count_nonzero(solution.method != "linear"))
        if not violated:
            return spent, 0
        outcome, iterations = solution.status.reshape(shape), solution.iterations.reshape(shape)
        good = np.isin(outcome, SOLVED) | (np.isin(outcome, STOPPED) & (iterations > 0))
        status[...] = np.where(~good & np.isin(outcome, STOPPED), Status.FAILED, outcome)
        for node, trial in np.argwhere(~good).tolist():
            states = predicted(self.model, before[node, trial], self._u[trial], self._newest, self._slid)
            if status[node, trial] is Status.INFEASIBLE:
                given = batch.data_of(node * self.trials + trial)
                names = ("reference", "information", "linear", "u", "filled")
                data = {"y": sums.y[:, trial]} | {name: given[name] for name in names if name in given}
                found, unmet, solved = self._relaxed(node, trial, data)
                states = states if found is None else found
                status[node, trial] = Status.SOLVED if solved else Status.INFEASIBLE
                infeasible.append(TrialInfeasibility(self.network.labels[node], self._instant, unmet, trial))
            self._states[node, trial] = states
        return spent, violated


def series(model: LinearModel, measurements: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Measurements (trials, steps, p) and inputs of a run, checked. Raises ShapeError."""
    y = np.asarray(measurements, dtype=float)
    if y.ndim != 3:
        raise ShapeError(f"measurements: expected shape (trials, steps, p), got {y.shape}")
    trials, steps = y.shape[:2]
    m = model.input_size
    u = None if inputs is None else np.asarray(inputs, dtype=float)
    if u is not None and u.shape not in ((steps - 1, m), (trials, steps - 1, m)):
        raise ShapeError(f"inputs: expected shape {(steps - 1, m)} or {(trials, steps - 1, m)}, got {u.shape}")
    return y, u
