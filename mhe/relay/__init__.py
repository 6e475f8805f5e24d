"""Moving horizon estimation with measurements relayed over l hops and fused arrival costs (dmhe-l-step)."""

from mhe.relay.design import RelayDesign
from mhe.relay.engine import RelayNetwork, run_relay_trials
from mhe.relay.network import RelayEstimator
from mhe.relay.node import RelayEstimate, RelayNode
from mhe.relay.options import RELAY_METHODS, RelayOptions, relay_options_of
from mhe.relay.report import RelayReport
from mhe.relay.rule import held, reach
from mhe.relay.schedule import RelaySchedule
from mhe.relay.windows import RelayWindows

__all__ = [
    "RELAY_METHODS",
    "RelayDesign",
    "RelayEstimate",
    "RelayEstimator",
    "RelayNetwork",
    "RelayNode",
    "RelayOptions",
    "RelayReport",
    "RelaySchedule",
    "RelayWindows",
    "held",
    "reach",
    "relay_options_of",
    "run_relay_trials",
]
