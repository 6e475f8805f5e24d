"""`SporadicEstimator`: the nodes of a network with detections run as one estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mhe.network import NetworkEstimate, NetworkRun, PlannedNodes
from mhe.sporadic.design import SporadicDesign
from mhe.sporadic.node import SporadicNode
from mhe.sporadic.options import SporadicOptions
from problems.models import Model
from problems.networks import Network


class SporadicEstimator(NetworkRun[SporadicDesign]):
    """A network of `SporadicNode` over a simulated transport; its nodes report `DetectionEstimate`.

    Args:
        model, network, method, design: see `SporadicDesign`, also for the errors and warnings.
        links, outages, rng, processes, record: see `mhe.network.NetworkRun`, which also has the attributes.
            ``infeasible`` counts steps whose rows had to be relaxed.

    Example:
        >>> estimator = SporadicEstimator(model, band(12, 1), "dmhe_w_pre_s", fields=sets, gains=0.3)
        >>> estimate = estimator.step(readings, flags)  # (nodes, vehicles, 2) and (nodes, vehicles)
        >>> estimate.states, estimate.nodes[3].detected
    """

    options: SporadicOptions

    def _designed(self, model: Model, network: Network, **design: Any) -> SporadicDesign:
        return SporadicDesign(model, network, **design)

    def _nodes(self) -> PlannedNodes:
        return PlannedNodes(SporadicNode, self.design.plans, self.design.pool)

    def step(
        self,
        values: Any,
        flags: Any = None,
        late: Sequence[tuple[float, Any, Any]] = (),
        time: float | None = None,
    ) -> NetworkEstimate:
        """Take what was detected at the next instant. The first step is instant 0: it reports mu_0 and solves nothing.

        Args:
            values: readings: an array (nodes, sensors per node, components) or (nodes, components), one entry or
                `Reading` per node, or the collective vector (p,); NaN where nothing was detected.
            flags: 1 or 0 per sensor, (nodes, sensors per node) or the like; by default, where the reading is there.
            late: (time, values, flags) of earlier instants, times counted from 0 in steps of the model's period.
            time: of the step (s), a label; counted on from the last one if None.

        Raises:
            ShapeError: readings or flags that do not fit.
            DataError: a flag that is neither 0 nor 1, a NaN under a flag 1, a time that does not advance.
        """
        return self._run(self.design.by_node(values, flags, late), time)
