"""`NetworkRun`: the nodes of a network run as one estimator, whatever family they are of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from mhe.estimate import Estimate
from mhe.options import MethodOptions
from problems.display import Table
from problems.errors import DataError, TopologyError
from problems.models import LinearModel, Model
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


@dataclass(frozen=True, eq=False, repr=False)
class NetworkEstimate:
    """Estimates of all nodes after one step.

    Attributes:
        labels: of the nodes.
        states: (count, n) of the newest state, NaN for nodes that are down.
        status: of every node, None for nodes that are down.
        seconds: (count,) wall time of the local problems, NaN for nodes that are down.
        infeasible: what could not be met.
        nodes: the `Estimate` of every node, None for nodes that are down.
        instant: time step, counted from 0.
        time: of the step (s).
    """

    labels: tuple[Hashable, ...]
    states: np.ndarray
    status: tuple[Status | None, ...]
    seconds: np.ndarray
    infeasible: tuple[Infeasibility, ...]
    nodes: tuple[Estimate | None, ...]
    instant: int
    time: float

    def table(self) -> Table:
        """Status, state and time of every node."""
        known = zip(self.labels, self.status, self.states, self.seconds, strict=True)
        rows = [
            (label, "down", None, None) if status is None else (label, status, state, f"{seconds * 1e6:.0f} us")
            for label, status, state, seconds in known
        ]
        notes = [f"{len(self.infeasible)} not met"] if self.infeasible else []
        caption = ", ".join([f"time step {self.instant}, {self.time:g} s: {len(self.labels)} nodes", *notes])
        return Table(f"{type(self).__name__} of {caption}", ("node", "status", "state", "time"), rows)

    def __repr__(self) -> str:
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


class Design(Protocol):
    """What all designs have: everything that is settled before the first measurement."""

    model: LinearModel
    network: Network

    @property
    def options(self) -> MethodOptions: ...


DesignT = TypeVar("DesignT", bound=Design)


class NetworkRun(ABC, Generic[DesignT]):
    """Nodes of a network run step by step over a simulated transport; base of the distributed estimators.

    Args:
        model, network, method, design: what the design is made of; errors and warnings are the design's.
        links: loss and delay; ideal by default.
        outages: when nodes are down, in time steps.
        rng: seeds loss and delay.
        processes: run every node in its own process; same results.
        record: keep a `Trace`.

    Attributes:
        design: what was settled before the run.
        options: of the method.
        status: steps by status, over all nodes.
    """

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | MethodOptions | None = None,
        *,
        links: Links | None = None,
        outages: Iterable[Outage] = (),
        rng: np.random.Generator | None = None,
        processes: bool = False,
        record: bool = False,
        **design: Any,
    ) -> None:
        chosen = {} if method is None else {"method": method}
        self.design = self._designed(model, network, **chosen, **design)
        self.model, self.options = self.design.model, self.design.options
        self._factory = self._nodes()
        self._transport = {"links": links, "outages": tuple(outages), "processes": processes, "record": record}
        self._rng = rng
        self.reset()

    @abstractmethod
    def _designed(self, model: Model, network: Network, **design: Any) -> DesignT:
        """The design of this family."""

    @abstractmethod
    def _nodes(self) -> Callable[[int], Any]:
        """Makes a node of the design from its index."""

    @property
    def network(self) -> Network:
        """The graph. Gains, weights and schedules belong to it, so it cannot be replaced during a run."""
        return self.design.network

    @network.setter
    def network(self, graph: Network) -> None:
        raise TopologyError(
            f"the graph is fixed for a run (gains and weights were worked out for {self.network!r}, got {graph!r}); "
            f"make a new {type(self).__name__}"
        )

    def reset(self) -> None:
        """Forget everything but the design: the next step is the first one. Loss and delay are drawn anew."""
        if "_simulation" in self.__dict__:
            self.close()
        self._simulation = Simulation(self.network, self._factory, rng=self._rng, **self._transport)
        self._last: float | None = None
        self.status: Counter[Status] = Counter()

    def _run(self, entries: Sequence[Any], time: float | None) -> NetworkEstimate:
        """One step of all nodes with one measurement each."""
        period = self.model.dt or 1.0
        if time is None:
            time = 0.0 if self._last is None else self._last + period
        elif self._last is not None and not time > self._last:
            raise DataError(f"time: expected a number later than the last step's {self._last}, got {time!r}")
        instant = self._simulation.steps
        nodes: list[Estimate | None] = self._simulation.step(entries, instant * period)
        self._last = float(time)
        return self._gathered(nodes, instant, self._last)

    def _gathered(self, nodes: Sequence[Estimate | None], instant: int, time: float) -> NetworkEstimate:
        labels = self.network.labels
        states = np.full((len(nodes), self.model.state_size), np.nan)
        seconds = np.full(len(nodes), np.nan)
        infeasible = []
        for k, node in enumerate(nodes):
            if node is not None:
                states[k], seconds[k] = node.state, node.seconds
                self.status[node.status] += 1
                # bounds that were relaxed may not be met although the relaxed problem was solved
                if node.status is Status.INFEASIBLE or node.infeasible:
                    infeasible.append(Infeasibility(labels[k], instant, node.infeasible))
        return NetworkEstimate(
            labels=labels,
            states=states,
            status=tuple(None if node is None else node.status for node in nodes),
            seconds=seconds,
            infeasible=tuple(infeasible),
            nodes=tuple(nodes),
            instant=instant,
            time=time,
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


class MeasuringDesign(Design, Protocol):
    """A design that knows which measurements belong to which node."""

    def by_node(self, measurements: Any) -> list[Any]: ...


MeasuringT = TypeVar("MeasuringT", bound=MeasuringDesign)


class MeasuringRun(NetworkRun[MeasuringT]):
    """A `NetworkRun` of nodes that take the measurements of every instant."""

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


class PlannedNodes:
    """Makes the nodes of a network from their plans, in any process.

    Args:
        kind: of the nodes, made from a plan and `compiled`.
        plans: of all nodes.
        compiled: windows that nodes with equal problems share.
    """

    def __init__(self, kind: Callable[[Any, Any], Any], plans: Iterable[Any], compiled: Any) -> None:
        self._kind, self._plans, self._compiled = kind, tuple(plans), compiled

    def __call__(self, node: int) -> Any:
        return self._kind(self._plans[node], self._compiled)
