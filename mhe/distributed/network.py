"""`DistributedEstimator`: the nodes of a network run as one estimator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from mhe.distributed.design import NetworkDesign
from mhe.distributed.node import NodeFactory
from mhe.distributed.options import DistributedOptions
from mhe.estimate import Estimate
from problems.errors import DataError
from problems.models import Model
from problems.networks import Network
from problems.runtime import Counters, Links, Outage, Simulation, Trace
from problems.solvers.base import Status


@dataclass(frozen=True, eq=False)
class Infeasibility:
    """Bounds that a node's window could not meet.

    Attributes:
        node: label.
        instant: time step.
        bounds: names of those that the estimate of the step does not meet; none where slacks below 1e-6 were enough.
    """

    node: Any
    instant: int
    bounds: tuple[str, ...]

    def __str__(self) -> str:
        what = " and ".join(self.bounds) or "bounds to the last digit"
        return f"node {self.node}, time step {self.instant}: no sequence meets the {what}"


@dataclass(frozen=True, eq=False)
class NetworkEstimate:
    """Estimates of all nodes after one step.

    Attributes:
        states: (count, n) of the newest state, NaN for nodes that are down.
        status: of every node, None for nodes that are down.
        seconds: (count,) wall time of the local problems, NaN for nodes that are down.
        infeasible: what could not be met.
        nodes: the `Estimate` of every node, None for nodes that are down.
        instant: time step, counted from 0.
        time: of the step (s).
    """

    states: np.ndarray
    status: tuple[Status | None, ...]
    seconds: np.ndarray
    infeasible: tuple[Infeasibility, ...]
    nodes: tuple[Estimate | None, ...]
    instant: int
    time: float


class NetworkRun:
    """Nodes of a network run step by step over a simulated transport; base of the distributed estimators.

    Args:
        model, network: of the nodes.
        factory: makes a node from its index.
        links: loss and delay; ideal by default.
        outages: when nodes are down, in time steps.
        rng: seeds loss and delay.
        processes: run every node in its own process; same results.
        record: keep a `Trace`.

    Attributes:
        status: steps by status, over all nodes.
    """

    def __init__(
        self,
        model: Model,
        network: Network,
        factory: Callable[[int], Any],
        *,
        links: Links | None = None,
        outages: Iterable[Outage] = (),
        rng: np.random.Generator | None = None,
        processes: bool = False,
        record: bool = False,
    ) -> None:
        self.model, self.network = model, network
        self._factory = factory
        self._transport = {
            "links": links,
            "outages": tuple(outages),
            "processes": processes,
            "record": record,
        }
        self._rng = rng
        self.reset()

    def reset(self) -> None:
        """Forget everything but the design: the next step is the first one. Loss and delay are drawn anew."""
        if "_simulation" in self.__dict__:
            self.close()
        self._simulation = Simulation(self.network, self._factory, rng=self._rng, **self._transport)
        self._last: float | None = None
        self.status: Counter[Status] = Counter()

    def _run(self, entries: list[Any], time: float | None) -> NetworkEstimate:
        """One step of all nodes with one measurement each."""
        period = self.model.dt or 1.0
        if time is None:
            time = 0.0 if self._last is None else self._last + period
        elif self._last is not None and not time > self._last:
            raise DataError(f"time: expected a number later than the last step's {self._last}, got {time!r}")
        instant = self._simulation.steps
        nodes: list[Estimate | None] = self._simulation.step(entries, instant * period)
        self._last = float(time)
        return self._gathered(nodes, instant)

    def _gathered(self, nodes: list[Estimate | None], instant: int) -> NetworkEstimate:
        states = np.full((len(nodes), self.model.state_size), np.nan)
        seconds = np.full(len(nodes), np.nan)
        infeasible = []
        for k, node in enumerate(nodes):
            if node is not None:
                states[k], seconds[k] = node.state, node.seconds
                self.status[node.status] += 1
                if node.status is Status.INFEASIBLE:
                    infeasible.append(Infeasibility(self.network.labels[k], instant, node.infeasible))
        return NetworkEstimate(
            states=states,
            status=tuple(None if node is None else node.status for node in nodes),
            seconds=seconds,
            infeasible=tuple(infeasible),
            nodes=tuple(nodes),
            instant=instant,
            time=self._last if self._last is not None else 0.0,
        )

    @property
    def counters(self) -> Counters:
        """Messages, floats and bytes of every link."""
        return self._simulation.counters

    @property
    def trace(self) -> Trace | None:
        """What happened, with ``record=True``."""
        return self._simulation.trace

    def close(self) -> None:
        """End all nodes (and their processes)."""
        self._simulation.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class DistributedEstimator(NetworkRun):
    """A network of `DistributedNode` over a simulated transport.

    Args:
        model, network, method, design: see `NetworkDesign`, also for the errors and warnings.
        links, outages, rng, processes, record: see `NetworkRun`.

    Attributes:
        design: what was settled before the run.
        options: of the method.
        status: steps by status, over all nodes.
    """

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | DistributedOptions = "dmhe_f",
        *,
        links: Links | None = None,
        outages: Iterable[Outage] = (),
        rng: np.random.Generator | None = None,
        processes: bool = False,
        record: bool = False,
        **design: Any,
    ) -> None:
        self.design = NetworkDesign(model, network, method, **design)
        self.options = self.design.options
        super().__init__(
            self.design.model,
            network,
            NodeFactory(self.design.plans, self.design.pool),
            links=links,
            outages=outages,
            rng=rng,
            processes=processes,
            record=record,
        )

    def step(self, measurements: Any, inputs: Any = None, time: float | None = None) -> NetworkEstimate:
        """Take the measurements of the next instant. The first step is instant 0: it reports mu_0 and solves nothing.

        Args:
            measurements: one entry (p_i,) or None per node, a matrix (count, p), or the collective vector (p,).
            inputs: u_{t-1} (m,), which acted since the previous instant, known to all nodes.
            time: of the step (s), a label; the model's sampling time is counted on from the last one if None.

        Raises:
            ShapeError, DataError: measurements or inputs that do not fit; a time that does not advance.
        """
        entries = self.design.by_node(measurements)
        if self.model.input_size:
            entries = [(entry, inputs) for entry in entries]
        return self._run(entries, time)
