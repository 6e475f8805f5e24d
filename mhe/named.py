"""Distributed estimators by the names they are registered under; each stands for one set of options."""

from __future__ import annotations

from typing import Any

from mhe.distributed import DistributedEstimator
from mhe.relay import RelayEstimator
from mhe.sporadic import SporadicEstimator
from problems.models import Model
from problems.networks import Network


def dmhe_f(
    model: Model, network: Network, *, detections: bool = False, **options: Any
) -> DistributedEstimator | SporadicEstimator:
    """DMHE with estimated disturbances and uniform weights (`DMHE`, `DMHE_F` of the sources).

    Args:
        model, network, options: as for `DistributedEstimator`, which also says what is raised; with `detections` as for
            `SporadicEstimator`.
        detections: readings come with detection flags, and covariances follow them.
    """
    if detections:
        return SporadicEstimator(model, network, "dmhe_f", **options)
    return DistributedEstimator(model, network, "dmhe_f", **options)


def dmhe_f_s(model: Model, network: Network, **options: Any) -> SporadicEstimator:
    """`dmhe_f` with detections and field-of-view rows (`DMHE_F^S`).

    Args:
        model, network, options: as for `SporadicEstimator`, which also says what is raised.
    """
    return SporadicEstimator(model, network, "dmhe_f_s", **options)


def dmhe_pre(model: Model, network: Network, **options: Any) -> DistributedEstimator:
    """DMHE with pre-estimation and uniform weights (`DMHE_pre`); arguments as for `dmhe_f`."""
    return DistributedEstimator(model, network, "dmhe_pre", **options)


def dmhe_w_pre(
    model: Model, network: Network, *, detections: bool = False, **options: Any
) -> DistributedEstimator | SporadicEstimator:
    """DMHE with pre-estimation and observability rank weights (`DMHE_w-pre`; with detections `DMHE` of chapter 4).

    Arguments as for `dmhe_f`.
    """
    if detections:
        return SporadicEstimator(model, network, "dmhe_w_pre", **options)
    return DistributedEstimator(model, network, "dmhe_w_pre", **options)


def dmhe_w_pre_s(model: Model, network: Network, **options: Any) -> SporadicEstimator:
    """`dmhe_w_pre` with detections and field-of-view rows (`DMHE^S`); arguments as for `dmhe_f_s`."""
    return SporadicEstimator(model, network, "dmhe_w_pre_s", **options)


def dmhe_l_pre(model: Model, network: Network, **options: Any) -> RelayEstimator:
    """Pre-estimation with measurements relayed over `l` hops (N by default) and fused arrival costs (`DMHE_pre^l`).

    Args:
        model, network, options: as for `RelayEstimator`, which also says what is raised.
    """
    return RelayEstimator(model, network, "dmhe_l_pre", **options)


def dmhe_1_pre(model: Model, network: Network, **options: Any) -> RelayEstimator:
    """`dmhe_l_pre` with the measurements of direct neighbours only (`DMHE_pre^1`); arguments as there."""
    return RelayEstimator(model, network, "dmhe_1_pre", **options)


def dmhe_b(model: Model, network: Network, **options: Any) -> RelayEstimator:
    """Estimated disturbances, data of direct neighbours and fused arrival costs (`DMHE_B`, Battistelli 2018).

    Args:
        model, network, options: as for `RelayEstimator`, which also says what is raised.
    """
    return RelayEstimator(model, network, "dmhe_b", **options)
