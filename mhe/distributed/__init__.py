"""Distributed moving horizon estimation over a network, with and without pre-estimation."""

from mhe.distributed.batched import BatchedNetwork, BatchEstimate, TrialInfeasibility, TrialRun, run_trials
from mhe.distributed.design import NetworkDesign
from mhe.distributed.network import DistributedEstimator
from mhe.distributed.node import DistributedNode
from mhe.distributed.options import LITERAL, METHODS, DistributedOptions, options_of
from mhe.distributed.plan import NodePlan
from mhe.distributed.pool import WindowPool
from mhe.network import Infeasibility, NetworkEstimate

__all__ = [
    "LITERAL",
    "METHODS",
    "BatchEstimate",
    "BatchedNetwork",
    "DistributedEstimator",
    "DistributedNode",
    "DistributedOptions",
    "Infeasibility",
    "NetworkDesign",
    "NetworkEstimate",
    "NodePlan",
    "TrialInfeasibility",
    "TrialRun",
    "WindowPool",
    "options_of",
    "run_trials",
]
