"""Distributed estimators by the names they are registered under; each stands for one set of options."""

from __future__ import annotations

from typing import Any

from mhe.distributed import DistributedEstimator
from problems.models import Model
from problems.networks import Network


def dmhe_f(model: Model, network: Network, **options: Any) -> DistributedEstimator:
    """DMHE with estimated disturbances and uniform weights (`DMHE`, `DMHE_F` of the sources).

    Args:
        model, network, options: as for `DistributedEstimator`, which also says what is raised.
    """
    return DistributedEstimator(model, network, "dmhe_f", **options)


def dmhe_pre(model: Model, network: Network, **options: Any) -> DistributedEstimator:
    """DMHE with pre-estimation and uniform weights (`DMHE_pre`); arguments as for `dmhe_f`."""
    return DistributedEstimator(model, network, "dmhe_pre", **options)


def dmhe_w_pre(model: Model, network: Network, **options: Any) -> DistributedEstimator:
    """DMHE with pre-estimation and observability rank weights (`DMHE_w-pre`); arguments as for `dmhe_f`."""
    return DistributedEstimator(model, network, "dmhe_w_pre", **options)
