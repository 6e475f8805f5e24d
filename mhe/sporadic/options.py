"""What a distributed estimator with detections is made of: independent options, and the named combinations of them.

Source: dmhe-sporadic-fov 1, 3 and section 10; design section 3.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from mhe.covariance import DetectionUpdate
from mhe.distributed.options import Disturbance, NetworkGrowthPrior
from mhe.options import MethodOptions
from problems.errors import SettingError
from problems.networks import FusionRule

ObserverData = Literal["local", "regional"]
DetectionWeights = Literal["rank", "uniform", "metropolis", "given"]
DetectionPrior = Literal["seed", "filter"]
RowRule = Literal["none", "hard", "soft", "projected"]
RowScope = Literal["own", "regional"]
PieceRule = Literal["none", "detected", "unseen", "both"]
InfeasibleRows = Literal["soft", "predict"]


@dataclass(frozen=True)
class SporadicOptions(MethodOptions):
    """Options of a distributed estimator with detections, each of them independent of the others.

    Attributes:
        disturbance: ``observer`` (pre-estimation, (4.7)) or ``process_noise``, the disturbances estimated.
        observer: data the observer is fed: the node's own, ``local`` (4.7), or its neighbourhood's, ``regional``
            (2.17).
        weights: consensus weights K: ``rank`` follows the detections in the window, (4.12)-(4.13), with an exchange
            round of its own; ``uniform``, ``metropolis``, ``given`` as a matrix.
        rank_floor: rank of a node that saw nothing (eps), between 0 and 1.
        weight_fusion: fused arrival covariance: ``convex`` (4.11), ``out_degree`` (2.23), ``in_degree`` (2.23) printed.
        pi_update: local arrival covariance, with the detections of each instant: ``literal`` (2.29)-(2.30), ``exact``
            (E8) or ``onestep`` (section 3.8).
        prior: reference of the arrival cost: ``seed``, the neighbours' estimates of x_{t-N} found at t - 1; ``filter``,
            what readings before the window told, so that readings up to N steps late change nothing (section 10).
        growth_prior: reference while the window fills: ``own`` first state (Algorithm 3), ``consensus`` of the
            neighbours' ones, ``mean`` mu_0.
        rows: field-of-view rows (4.17): ``none``, ``hard``, ``soft`` (exact penalty), or ``projected``: hard rows and
            an observer fed with readings projected onto them (feasible by construction where A = C = I).
        row_scope: detections that make rows: the node's ``own``, or ``regional`` with the neighbours' sets.
        pieces: sets that are not convex, as convex pieces given to the design (`mhe.sporadic.pieces`): ``detected``, of
            the own sensors' sets at every detection; ``unseen``, of where a vehicle is now that nobody of the
            neighbourhood detects (holds only where detection in view is certain); ``both``; ``none``.
        unmet: where hard rows contradict each other: ``soft`` relaxes them by slacks, ``predict`` moves the last window
            on; the status is infeasible in both cases.
        penalty: price of a slack, per unit of violation.
        covariance_cap: largest eigenvalue of fused covariances; (2.23) makes unseen directions grow without bound.
        horizon: N >= 1 transitions.
        forget_after: a neighbour not heard for more steps than this is left out; never if None.
        solver: name of a registered QP solver.
        tolerance: of the solver.
        settings: further settings of the solver, by name.

    Raises:
        UnknownNameError: a name that is none of those above.
        SettingError: a number outside its range, or ``prior="filter"`` with options it excludes.
    """

    kind: ClassVar[str] = "a method with detections"

    disturbance: Disturbance = "observer"
    observer: ObserverData = "local"
    weights: DetectionWeights = "rank"
    rank_floor: float = 0.5
    weight_fusion: FusionRule = "convex"
    pi_update: DetectionUpdate = "literal"
    prior: DetectionPrior = "seed"
    growth_prior: NetworkGrowthPrior = "own"
    rows: RowRule = "none"
    row_scope: RowScope = "own"
    pieces: PieceRule = "none"
    unmet: InfeasibleRows = "soft"
    penalty: float = 1e4
    covariance_cap: float = 1e8
    horizon: int = 3
    forget_after: int | None = None
    solver: str = "auto"
    tolerance: float = 1e-8
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.rank_floor < 1:
            raise SettingError(f"rank_floor: expected a number between 0 and 1, got {self.rank_floor!r}")
        for name in ("penalty", "covariance_cap"):
            if not 0 < getattr(self, name) < float("inf"):
                raise SettingError(f"{name}: expected a positive number, got {getattr(self, name)!r}")
        if self.prior == "filter" and (self.pi_update, self.growth_prior) != ("onestep", "mean"):
            raise SettingError(
                "prior='filter' carries the filter's own mean and covariance, so it needs pi_update='onestep' and "
                f"growth_prior='mean'; got {self.pi_update!r} and {self.growth_prior!r}"
            )
        if self.rows == "projected" and self.disturbance != "observer":
            raise SettingError("rows='projected' feeds an observer; with process noise use rows='hard' or 'soft'")

        if self.pieces != "none" and self.rows == "none":
            raise SettingError(f"pieces={self.pieces!r} refine the rows of the sensors' sets; set rows='hard' too")


_PRE = SporadicOptions()
_NOISE = SporadicOptions(disturbance="process_noise", weights="uniform", weight_fusion="out_degree")
METHODS: dict[str, SporadicOptions] = {
    "dmhe_w_pre": _PRE,
    "dmhe_w_pre_s": replace(_PRE, rows="hard"),
    "dmhe_f": _NOISE,
    "dmhe_f_s": replace(_NOISE, rows="hard"),
}


def options_of(method: str | SporadicOptions, **overrides: Any) -> SporadicOptions:
    """The options a method stands for, with some of them replaced.

    Args:
        method: ``dmhe_w_pre``, ``dmhe_w_pre_s``, ``dmhe_f`` or ``dmhe_f_s``, or options to start from.
        overrides: options by name.

    Raises:
        UnknownNameError: no such method or option.
        SettingError: values that do not fit.
    """
    return SporadicOptions.of(METHODS, method, overrides)
