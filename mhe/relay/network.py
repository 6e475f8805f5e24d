"""`RelayEstimator`: the nodes of an l-step neighbourhood method run as one estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mhe.estimate import Estimate
from mhe.network import MeasuringRun, NetworkEstimate, PlannedNodes
from mhe.relay.design import RelayDesign
from mhe.relay.node import RelayEstimate, RelayNode
from mhe.relay.options import RelayOptions
from mhe.relay.plan import plan_of
from mhe.relay.windows import RelayWindows
from problems.models import Model
from problems.networks import Network


class RelayEstimator(MeasuringRun[RelayDesign]):
    """A network of `RelayNode` over a simulated transport.

    Args:
        model, network, method, design: see `RelayDesign`, also for the errors and warnings.
        windows: compiled windows to share with other estimators.
        links, outages, rng, processes, record: see `mhe.network.NetworkRun`, which also has the other attributes.

    Attributes:
        windows: as given, or new ones.
        factorizations: local problems whose matrices changed, over all steps and nodes. Without losses there are none
            once the arrival weights have settled.
    """

    options: RelayOptions

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | RelayOptions | None = None,
        *,
        windows: RelayWindows | None = None,
        **others: Any,
    ) -> None:
        self.windows = RelayWindows() if windows is None else windows
        super().__init__(model, network, method, **others)

    def _designed(self, model: Model, network: Network, **design: Any) -> RelayDesign:
        return RelayDesign(model, network, **design)

    def _nodes(self) -> PlannedNodes:
        plans = [plan_of(self.design, node) for node in range(self.network.count)]
        return PlannedNodes(RelayNode, plans, self.windows)

    def reset(self) -> None:
        """Forget everything but the design: the next step is the first one. Loss and delay are drawn anew."""
        super().reset()
        self.factorizations = 0

    def _gathered(self, nodes: Sequence[Estimate | None], instant: int, time: float) -> NetworkEstimate:
        self.factorizations += sum(isinstance(node, RelayEstimate) and node.factorized for node in nodes)
        return super()._gathered(nodes, instant, time)
