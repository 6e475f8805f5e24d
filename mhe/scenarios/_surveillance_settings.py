"""Settings of the scenario `surveillance`: what the source gives and what it leaves out, by case.

Source: dmhe-sporadic-fov 6.1 and 6.2; what is marked [proposed] there is a default here.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pydantic

from mhe.distributed.options import NetworkGrowthPrior
from mhe.sporadic.options import (
    DetectionPrior,
    DetectionUpdate,
    Disturbance,
    InfeasibleRows,
    ObserverData,
    PieceRule,
    RowScope,
)
from problems.networks import FusionRule

Case = Literal[1, 2, 3, "gazebo"]
PerCamera = float | tuple[float, ...]

# Narrower than the square of the formation, so that also where the road turns a camera never has more than three
# vehicles in view, as the source says; the spec's (0.325, 0.275) lets all five through at two corners.
HALF_ROAD = 0.285
ALTERNATING = tuple(-0.235 if camera % 2 == 0 else 0.235 for camera in range(11))
CASES: dict[Any, dict[str, Any]] = {
    1: {},
    2: {
        "cameras": 6,
        "along": (0.42,) * 5 + (0.62,),
        "across": (0.495,) * 5 + (0.66,),
        "sideways": (-0.35,) * 3 + (0.25,) * 2 + (0.0,),
        "detection_rate": 0.7,
    },
    3: {"across": (HALF_ROAD,) * 11 + (0.66,), "sideways": (*ALTERNATING, 0.0), "detection_rate": 0.7},
    "gazebo": {
        "centre_line": ((1.0, -2.0), (1.0, 4.0), (6.0, 4.0), (6.0, 8.0), (11.0, 8.0), (11.0, 11.0)),
        "half_width": 1.0,
        "cameras": 17,
        "across": 1.15,
        "stop": 110.0,
        "duration": 120.0,
        "half_side": 0.5,
        "noise": 0.5,
        "rotation_bias": 0.05,
        "radius": 2,
        "horizon": 4,
        "measurement_variance": 0.5,
    },
}


class Settings(pydantic.BaseModel, extra="forbid", frozen=True):
    """Settings of the scenario; the defaults are those of case 1, another case brings its own."""

    case: Case = pydantic.Field(1, description="1: 12 cameras, 2: 6, 3: 12 that see half the road; gazebo: 17")
    radius: int = pydantic.Field(1, ge=0, description="rho: cameras hear those whose number differs by no more")

    centre_line: tuple[tuple[float, float], ...] = pydantic.Field(
        ((-1.75, -3.25), (-1.75, 0.0), (0.75, 0.0), (0.75, 4.0)), min_length=2, description="of the road (m)"
    )
    half_width: float = pydantic.Field(0.55, gt=0, description="of the road (m)")
    extension: float = pydantic.Field(1.0, ge=0, description="of both ends of the road (m)")
    cameras: int = pydantic.Field(12, ge=2, le=1000, description="n_S, at equal distances along the road")
    overlap: float = pydantic.Field(0.62, gt=0, description="half length of a footprint per distance of the cameras")
    margin: float = pydantic.Field(0.30, ge=0, description="added to the half length (m)")
    along: PerCamera | None = pydantic.Field(
        None,
        description="half length of the footprints (m), one or one per camera; overlap * distance + margin if null",
    )
    across: PerCamera = pydantic.Field(0.66, description="half width of the footprints (m), one or one per camera")
    sideways: PerCamera = pydantic.Field(0.0, description="shift of the footprints to the left (m)")

    vehicles: int = pydantic.Field(5, ge=1, le=5, description="n_V: the leader and its followers at a square's corners")
    half_side: float = pydantic.Field(0.30, ge=0, description="of the square (m)")
    wobble: float = pydantic.Field(0.02, ge=0, description="of the vehicles while they move (m)")
    lag: float = pydantic.Field(2.0, ge=0, description="time constant of the leader (s)")
    stop: float = pydantic.Field(88.0, gt=0, description="when the vehicles reach the end of the road (s)")
    duration: float = pydantic.Field(100.0, gt=0, le=100_000, description="(s)")
    sampling: float = pydantic.Field(0.5, gt=0, description="T_s (s)")

    noise: float = pydantic.Field(0.15, ge=0, description="variance per axis of the readings (m^2)")
    bias: float = pydantic.Field(0.1, ge=0, description="variance per axis of the cameras' position (m^2)")
    rotation_bias: float = pydantic.Field(0.0, ge=0, description="standard deviation of the cameras' heading (rad)")
    detection_rate: float = pydantic.Field(0.8, ge=0, le=1, description="of vehicles in view")

    horizon: int = pydantic.Field(3, ge=1, le=100, description="N, transitions in the window")
    gain: float = pydantic.Field(0.3, gt=0, lt=2, description="l, the observer's gain is l times the identity")
    measurement_variance: float = pydantic.Field(1.0, gt=0, description="R / I of the estimators (m^2)")
    process_variance: float = pydantic.Field(1.0, gt=0, description="Q / I of the estimators (m^2)")
    initial: tuple[float, float] = pydantic.Field((0.0, 0.0), description="first estimate of all vehicles (m)")
    prior_variance: float = pydantic.Field(1e5, gt=0, description="Pi_0 / I (m^2)")

    disturbance: Disturbance | None = pydantic.Field(
        None, description="observer or process_noise for all methods; null: each method's own, as with the next ones"
    )
    observer: ObserverData = pydantic.Field("local", description="readings that observers are fed, local or regional")
    weights: Literal["rank", "uniform", "metropolis"] | None = pydantic.Field(None, description="consensus weights")
    weight_fusion: FusionRule | None = pydantic.Field(None, description="convex is (4.11), out_degree is (2.23)")
    pi_update: DetectionUpdate | None = pydantic.Field(None, description="arrival covariance, section 3.8")
    prior: DetectionPrior | None = pydantic.Field(None, description="arrival cost")
    growth_prior: NetworkGrowthPrior | None = pydantic.Field(None, description="reference while the window fills")
    rows: Literal["hard", "soft", "projected"] = pydantic.Field(
        "hard", description="of the methods with rows; projected concerns those with an observer, the others have hard"
    )
    row_scope: RowScope | None = pydantic.Field(None, description="detections that make rows, own or regional")
    pieces: PieceRule = pydantic.Field(
        "none",
        description="of methods with rows: the road itself instead of its hull where a vehicle is detected, the road "
        "nobody looks at where it is not (holds for detection_rate=1 only), or both",
    )
    unmet: InfeasibleRows | None = pydantic.Field(None, description="where hard rows contradict each other")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")

    score_from: float = pydantic.Field(0.0, ge=0, description="metrics count from here (s)")
    score_until: float | None = pydantic.Field(None, gt=0, description="and up to here (s)")
    instants: tuple[float, ...] | None = pydantic.Field(
        None, min_length=1, max_length=6, description="when the picture shows the scene (s)"
    )

    replay: str | None = pydantic.Field(
        None, description="CSV of readings instead of drawn ones: time,sensor,vehicle,x,y"
    )
    replay_truth: str | None = pydantic.Field(None, description="CSV of the truth of a replay: time,vehicle,x,y")

    @pydantic.model_validator(mode="before")
    @classmethod
    def _of_case(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        case = given.get("case", 1)
        return CASES[case] | given if isinstance(case, int | str) and case in CASES else given

    @pydantic.model_validator(mode="after")
    def _fit(self) -> Settings:
        for name in ("along", "across", "sideways"):
            values = getattr(self, name)
            if isinstance(values, tuple) and len(values) != self.cameras:
                raise ValueError(
                    f"{name} has {len(values)} numbers for cameras={self.cameras}; give one, or one per camera"
                )
            if name != "sideways" and values is not None and min(_all(values)) <= 0:
                raise ValueError(f"{name} must be positive, got {min(_all(values)):g} m")
        if self.score_from >= min(self.duration, np.inf if self.score_until is None else self.score_until):
            raise ValueError(f"score_from={self.score_from:g} leaves no instant to score")
        if self.replay_truth is not None and self.replay is None:
            raise ValueError("replay_truth belongs to replay=PATH")
        return self

    @property
    def steps(self) -> int:
        """Instants after the first one."""
        return round(self.duration / self.sampling)

    def per_camera(self, name: str, otherwise: float = 0.0) -> tuple[float, ...]:
        """A setting of the cameras, one number for each; `otherwise` where it is null."""
        values = getattr(self, name)
        return values if isinstance(values, tuple) else (otherwise if values is None else values,) * self.cameras


def _all(values: PerCamera) -> tuple[float, ...]:
    return values if isinstance(values, tuple) else (values,)
