"""Settings of the scenario `sensor-field`."""

from __future__ import annotations

from typing import Any, Literal

import pydantic

from mhe.arrival import Prior
from mhe.relay.options import GainRule, Omega, Startup
from mhe.scenarios.sensor_field_world import DENSITY, NOISE, RADIUS

CASES: dict[int, dict[str, Any]] = {1: {"duration": 40}, 2: {"duration": 20}}
CONNECTED_UNTIL = 500  # nodes; larger graphs of this density are hardly ever connected


class Settings(pydantic.BaseModel, extra="forbid", frozen=True):
    """Settings of the scenario; those of ``case`` are defaults for the others."""

    case: Literal[1, 2] = pydantic.Field(
        1, description="1: over time, 40 s; 2: over the horizon, 20 s each, with --set horizon=2,3,...,10 and l = N"
    )
    duration: int = pydantic.Field(40, ge=4, le=10_000, description="t_f (s), which are steps")
    horizon: int = pydantic.Field(4, ge=1, le=100, description="N, transitions in the window")
    l: int | None = pydantic.Field(None, ge=1, description="hops that measurements travel in dmhe_l_pre; N if null")
    latency: Literal[0, 1] = pydantic.Field(
        0, description="0: what neighbours measure is used in the same step (Table 3.1); 1: as (3.2) prints it"
    )

    nodes: int = pydantic.Field(100, ge=2, le=100_000, description="drawn over the field")
    network_seed: int = pydantic.Field(1, ge=0, description="of the positions; 1 is the reference network")
    density: float = pydantic.Field(DENSITY, gt=0, description="nodes per square kilometre")
    radius: float = pydantic.Field(RADIUS, gt=0, description="nodes closer than this hear each other (m)")
    share: float = pydantic.Field(0.1, gt=0, le=1, description="of the nodes that have a position sensor")
    largest: bool | None = pydantic.Field(
        None,
        description="keep the largest component instead of drawing seeds until the graph is connected; "
        f"null: from {CONNECTED_UNTIL} nodes on",
    )

    startup: Startup = pydantic.Field(
        "fuse", description="while windows fill: fuse arrival costs, or keep the prior of instant 0 (literal)"
    )
    omega: Omega = pydantic.Field(
        "seed", description="arrival weights from the node's own data (3.15), or all data of its window (hessian)"
    )
    alpha: float = pydantic.Field(0.99, gt=0, lt=1, description="discount of the arrival cost")
    arrival_divisor: float = pydantic.Field(8.0, ge=1, description="what alpha is divided by in (3.16)")
    S: float | None = pydantic.Field(None, gt=0, description="design matrix of (3.16) / I; 12 as Q if null")
    gains: GainRule = pydantic.Field("joint", description="of the observers of several sensors, errata 4")
    weights: Literal["metropolis", "uniform"] = pydantic.Field("metropolis", description="of fusion and consensus")
    bounds: Literal["none", "soft", "hard"] = pydantic.Field(
        "none", description="on the residuals (3.5) of dmhe_l_pre, dmhe_1_pre and dmhe_b"
    )
    width: float = pydantic.Field(NOISE, gt=0, description="largest modulus of a bounded residual (m)")
    prior: Prior = pydantic.Field("seed", description="arrival cost of mhe; filter makes it the Kalman filter")

    threshold: float = pydantic.Field(10.0, gt=0, description="PRMSE below which a run has converged (m)")
    engine: Literal["arrays", "messages"] = pydantic.Field(
        "arrays",
        description="arrays: all nodes at once, times are shares of a node; messages: node by node, same estimates",
    )
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")

    @pydantic.model_validator(mode="before")
    @classmethod
    def _of_case(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        case = given.get("case", 1)
        number = int(case) if str(case).isdigit() else 0
        return CASES.get(number, {}) | given

    @pydantic.model_validator(mode="after")
    def _fit(self) -> Settings:
        if self.l is not None and self.l > self.horizon:
            raise ValueError(
                f"l={self.l} exceeds horizon={self.horizon}; measurements older than the window are dropped, give l "
                "between 1 and the horizon"
            )
        return self

    @property
    def keeps_largest(self) -> bool:
        """Whether the largest component is taken; see `largest`."""
        return self.nodes >= CONNECTED_UNTIL if self.largest is None else self.largest
