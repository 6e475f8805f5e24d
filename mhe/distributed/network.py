"""`DistributedEstimator`: the nodes of a network run as one estimator."""

from __future__ import annotations

from typing import Any

from mhe.distributed.design import NetworkDesign
from mhe.distributed.node import DistributedNode
from mhe.distributed.options import DistributedOptions
from mhe.network import MeasuringRun, PlannedNodes
from problems.models import Model
from problems.networks import Network


class DistributedEstimator(MeasuringRun[NetworkDesign]):
    """A network of `DistributedNode` over a simulated transport.

    Args:
        model, network, method, design: see `NetworkDesign`, also for the errors and warnings.
        links, outages, rng, processes, record: see `mhe.network.NetworkRun`, which also has the attributes.
    """

    options: DistributedOptions

    def _designed(self, model: Model, network: Network, **design: Any) -> NetworkDesign:
        return NetworkDesign(model, network, **design)

    def _nodes(self) -> PlannedNodes:
        return PlannedNodes(DistributedNode, self.design.plans, self.design.pool)
