"""`RelayEstimator`: the nodes of an l-step neighbourhood method run as one estimator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from mhe.distributed import DistributedEstimator, Infeasibility, NetworkEstimate
from mhe.estimate import Estimate
from mhe.relay.design import RelayDesign
from mhe.relay.node import RelayEstimate, RelayNodeFactory
from mhe.relay.options import RelayOptions
from mhe.relay.plan import plan_of
from mhe.relay.windows import RelayWindows
from problems.errors import TopologyError
from problems.models import Model
from problems.networks import Network
from problems.runtime import Links, Outage, Simulation
from problems.solvers.base import Status


class RelayEstimator(DistributedEstimator):
    """A network of `RelayNode` over a simulated transport; steps, counters and trace as for `DistributedEstimator`.

    Args:
        model, network, method, design: see `RelayDesign`, also for the errors and warnings.
        links: loss and delay; ideal by default.
        outages: when nodes are down, in time steps.
        rng: seeds loss and delay.
        processes: run every node in its own process; same results.
        record: keep a `Trace`.
        windows: compiled windows to share with other estimators.

    Attributes:
        design: what was settled before the run.
        options: of the method.
        status: steps by status, over all nodes.
        factorizations: local problems whose matrices changed, over all steps and nodes. Without losses there are none
            once the arrival weights have settled.
    """

    design: RelayDesign  # type: ignore[assignment]
    options: RelayOptions  # type: ignore[assignment]

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | RelayOptions = "dmhe_l_pre",
        *,
        links: Links | None = None,
        outages: Iterable[Outage] = (),
        rng: np.random.Generator | None = None,
        processes: bool = False,
        record: bool = False,
        windows: RelayWindows | None = None,
        **design: Any,
    ) -> None:
        self.design = RelayDesign(model, network, method, **design)
        self.model, self.options = self.design.model, self.design.options
        self.windows = RelayWindows() if windows is None else windows
        self._plans = tuple(plan_of(self.design, node) for node in range(network.count))
        self._transport = {"links": links, "outages": tuple(outages), "processes": processes, "record": record}
        self._rng = rng
        self.reset()

    @property
    def network(self) -> Network:  # type: ignore[override]
        """The graph. Gains, weights and schedules belong to it, so it cannot be replaced during a run."""
        return self.design.network

    @network.setter
    def network(self, graph: Network) -> None:
        raise TopologyError(
            f"the graph is fixed for a run (gains and arrival weights were worked out for {self.network!r}, got "
            f"{graph!r}); make a new RelayEstimator"
        )

    def reset(self) -> None:
        """Forget everything but the design: the next step is the first one. Loss and delay are drawn anew."""
        if "_simulation" in self.__dict__:
            self.close()
        factory = RelayNodeFactory(self._plans, self.windows)
        self._simulation = Simulation(self.network, factory, rng=self._rng, **self._transport)
        self._last: float | None = None
        self.status: Counter[Status] = Counter()
        self.factorizations = 0

    def _gathered(self, nodes: list[Estimate | None], instant: int) -> NetworkEstimate:
        found = super()._gathered(nodes, instant)
        here = [(k, node) for k, node in enumerate(nodes) if isinstance(node, RelayEstimate)]
        self.factorizations += sum(node.factorized for _, node in here)
        # soft bounds that were relaxed are reported too, although their problems were solved
        labels = self.network.labels
        unmet = tuple(Infeasibility(labels[k], instant, node.infeasible) for k, node in here if node.infeasible)
        return replace(found, infeasible=unmet)
