"""What an l-step neighbourhood method is made of: independent options, and the named combinations of them.

Source: dmhe-l-step, Models and equations, Algorithms, errata 1, 4-8; design section 3.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from mhe.options import MethodOptions
from mhe.window import WindowForm
from problems.errors import SettingError

RelayDisturbance = Literal["observer", "process_noise"]
FusionWeights = Literal["given", "uniform", "metropolis"]
Startup = Literal["literal", "fuse"]
Omega = Literal["seed", "hessian"]
GainRule = Literal["joint", "mean", "sum"]
Relaying = Literal["incremental", "batch"]
Hardness = Literal["hard", "soft"]
WeightExchange = Literal["offline", "online"]


@dataclass(frozen=True)
class RelayOptions(MethodOptions):
    """Options of an l-step neighbourhood estimator, each of them independent of the others.

    Attributes:
        disturbance: ``observer`` replaces the disturbances by L v (pre-estimation); ``process_noise`` estimates them.
        l: path length 1 <= l <= N that measurements travel; N if None.
        latency: 0: what neighbours measure is used in the same step (Table 3.1); 1: (3.2)-(3.7) as printed.
        weights: of the fused arrival cost: ``metropolis`` (2.33), ``uniform`` or ``given`` as a matrix.
        startup: while the window fills, ``fuse`` fuses what the windows found (errata 8); ``literal`` keeps the prior
            of instant 0.
        omega: ``seed`` (3.15): arrival weights from the node's own data; ``hessian``: from all data of its window, with
            the second state of the window before as prediction (errata 7).
        alpha: discount in (0, 1) of the arrival cost.
        arrival_divisor: what alpha is divided by in (3.16), at least 1.
        S: design matrix of (3.16), an information matrix (n, n) or a multiple of the identity; the information of the
            disturbance if None.
        gains: L_k^j of a set of sensors: ``joint``: one observer designed for all of them; ``mean``: L^j over their
            number; ``sum``: L^j as printed, which can be unstable (errata 4).
        relay: ``incremental`` sends on what arrived in the step before, ``batch`` the whole batch.
        exchange: ``offline``: arrival weights are worked out before the run; ``online``: neighbours send them until
            they have settled.
        bounds: on states and residuals: ``hard`` ones are reported where infeasible, and the prediction is the
            estimate; ``soft`` ones are relaxed there by slacks with an exact penalty.
        penalty: weight of the slacks, per unit of violation.
        forget_after: the last word of a neighbour not heard for more steps than this is not used; N if None.
        horizon: N >= 1 transitions.
        form: of the window, see `mhe.window.Window`; None lets it choose.
        solver: name of a registered solver.
        tolerance: of the solver.
        settings: further settings of the solver, by name.

    Raises:
        UnknownNameError: a name that is none of those above.
        SettingError: a number outside its range.
    """

    kind: ClassVar[str] = "an l-step method"

    disturbance: RelayDisturbance = "observer"
    l: int | None = None
    latency: int = 0
    weights: FusionWeights = "metropolis"
    startup: Startup = "fuse"
    omega: Omega = "seed"
    alpha: float = 0.99
    arrival_divisor: float = 8.0
    S: Any = None
    gains: GainRule = "joint"
    relay: Relaying = "incremental"
    exchange: WeightExchange = "offline"
    bounds: Hardness = "hard"
    penalty: float = 1e4
    forget_after: int | None = None
    horizon: int = 4
    form: WindowForm | None = None
    solver: str = "auto"
    tolerance: float = 1e-8
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.l is not None and (isinstance(self.l, bool) or self.l not in range(1, self.horizon + 1)):
            raise SettingError(
                f"l: expected a path length between 1 and the horizon N={self.horizon} (measurements older than the "
                f"window are dropped), got {self.l!r}"
            )
        if self.latency not in (0, 1):
            raise SettingError(f"latency: expected 0 or 1 steps, got {self.latency!r}")
        if not 0 < self.alpha < 1:
            raise SettingError(f"alpha: expected a discount between 0 and 1, both excluded, got {self.alpha!r}")
        if not 1 <= self.arrival_divisor < float("inf"):
            raise SettingError(
                f"arrival_divisor: expected a number of at least 1 (8 in the source), got {self.arrival_divisor!r}"
            )
        if not 0 < self.penalty < float("inf"):
            raise SettingError(f"penalty: expected a positive number, got {self.penalty!r}")

    @property
    def steps(self) -> int:
        """l, with the horizon for None."""
        return self.horizon if self.l is None else self.l


RELAY_METHODS: dict[str, RelayOptions] = {
    "dmhe_l_pre": RelayOptions(),
    "dmhe_1_pre": RelayOptions(l=1),
    "dmhe_b": RelayOptions(disturbance="process_noise", l=1),
}


def relay_options_of(method: str | RelayOptions, **overrides: Any) -> RelayOptions:
    """The options a method stands for, with some of them replaced.

    Args:
        method: ``dmhe_l_pre``, ``dmhe_1_pre`` or ``dmhe_b``, or options to start from.
        overrides: options by name.

    Raises:
        UnknownNameError: no such method or option.
        SettingError: a value outside its range.
    """
    return RelayOptions.of(RELAY_METHODS, method, overrides)
