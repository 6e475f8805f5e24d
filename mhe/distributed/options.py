"""What a distributed method is made of: independent options, and the named combinations of them.

Source: dmhe-pre-estimation 3.3, 3.6, 4.2 and errata E1-E3; design section 3.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from mhe.covariance import CovarianceUpdate
from mhe.options import MethodOptions
from mhe.window import WindowForm
from problems.errors import SettingError
from problems.networks import FusionRule

Disturbance = Literal["process_noise", "observer"]
WeightRule = Literal["given", "uniform", "metropolis", "rank", "mixed"]
Reference = Literal["given", "uniform", "metropolis"]
NetworkGrowthPrior = Literal["consensus", "own", "mean"]
CovarianceExchange = Literal["offline", "online"]
Infeasible = Literal["predict", "soft"]


@dataclass(frozen=True)
class DistributedOptions(MethodOptions):
    """Options of a distributed moving horizon estimator, each of them independent of the others.

    Attributes:
        disturbance: ``process_noise`` estimates the disturbances; ``observer`` replaces them by L v (pre-estimation).
        weights: consensus weights K: ``given`` as a matrix, ``uniform``, ``metropolis`` (2.33), ``rank`` (2.36) or
            ``mixed`` (2.38).
        share: share of the rank weights in ``mixed`` (epsilon).
        reference: the other weights in ``mixed``.
        weight_fusion: fused arrival covariance: ``out_degree`` (2.23) as corrected in E1, ``convex`` (4.11),
            ``in_degree`` (2.23) as printed.
        pi_update: local arrival covariance: ``seed`` (2.30) as printed, ``exact`` (E2).
        growth_prior: reference while the window fills (E3): ``consensus`` of the neighbours' first states, ``own``
            first state (Algorithm 1, line 12, as printed), ``mean`` mu_0.
        covariances: ``offline``: worked out before the run, messages carry measurement and state; ``online``: exchanged
            in every step (Algorithm 1 as printed).
        horizon: N >= 1 transitions.
        form: of the window, see `mhe.window.Window`; None lets it choose.
        infeasible: where no sequence meets the bounds, ``predict`` gives the prediction, ``soft`` relaxes the bounds by
            slacks with an exact penalty; the status is infeasible in both cases.
        penalty: weight of the slacks, per unit of violation.
        forget_after: a neighbour not heard for more steps than this is left out; N if None.
        solver: name of a registered solver.
        tolerance: of the solver.
        settings: further settings of the solver, by name.

    Raises:
        UnknownNameError: a name that is none of those above.
        SettingError: a number outside its range.
    """

    kind: ClassVar[str] = "a distributed method"

    disturbance: Disturbance = "process_noise"
    weights: WeightRule = "uniform"
    share: float = 1.0
    reference: Reference = "uniform"
    weight_fusion: FusionRule = "out_degree"
    pi_update: CovarianceUpdate = "seed"
    growth_prior: NetworkGrowthPrior = "consensus"
    covariances: CovarianceExchange = "offline"
    horizon: int = 5
    form: WindowForm | None = None
    infeasible: Infeasible = "predict"
    penalty: float = 1e4
    forget_after: int | None = None
    solver: str = "auto"
    tolerance: float = 1e-8
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.share <= 1:
            raise SettingError(f"share: expected a number in [0, 1], got {self.share!r}")


METHODS: dict[str, DistributedOptions] = {
    "dmhe_f": DistributedOptions(disturbance="process_noise", weights="uniform"),
    "dmhe_pre": DistributedOptions(disturbance="observer", weights="uniform"),
    "dmhe_w_pre": DistributedOptions(disturbance="observer", weights="rank"),
}

LITERAL: dict[str, Any] = {"weight_fusion": "in_degree", "growth_prior": "own", "covariances": "online"}
"""Overrides that give Algorithm 1 and (2.23) as printed, errata E1 and E3 undone; ``pi_update`` is so by default."""


def options_of(method: str | DistributedOptions, **overrides: Any) -> DistributedOptions:
    """The options a method stands for, with some of them replaced.

    Args:
        method: ``dmhe_f``, ``dmhe_pre`` or ``dmhe_w_pre``, or options to start from.
        overrides: options by name.

    Raises:
        UnknownNameError: no such method or option.
        SettingError: a value outside its range.
    """
    return DistributedOptions.of(METHODS, method, overrides)
