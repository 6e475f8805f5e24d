"""Scenario ``recording``: localization of what a recording holds, by every method that fits (spec ``recordings``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import pydantic

from localization.io.detect import open_recording
from localization.io.poses import Poses
from localization.io.recording import PoseGraph, TeamRecording, UwbRecording
from localization.scenarios._recording_graph import GraphMethods
from localization.scenarios._recording_team import TeamMethods
from localization.scenarios._recording_uwb import UwbMethods, WheelMethods, coarse_fixes
from problems.bench.scenario import Outcome
from problems.errors import FormError, SettingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Drawn", "Kind", "RecordingScenario", "Settings", "coarse_fixes", "scenario"]


class Settings(pydantic.BaseModel):
    """Settings of the scenario; those of the tracker are explained at `RangeTrackerSettings`."""

    model_config = pydantic.ConfigDict(extra="forbid")

    path: str = pydantic.Field(description="folder or file in a known layout")
    trajectory: Literal["A", "B"] | None = pydantic.Field(
        None, description="published scoring window; by default from the folder's name, else the whole truth"
    )
    start: Literal["ranges", "truth"] | tuple[float, float] = pydantic.Field(
        "ranges",
        description="UWB: first position from the first ranges, from truth, or [x, y] in m; graphs: truth puts the "
        "first pose of every robot at its recorded place; teams: from the first sightings, or from truth",
    )
    horizon: int = pydantic.Field(20, ge=1, le=1000, description="transitions in the window")
    period: float = pydantic.Field(0.1, gt=0, description="between knots, s")
    acceleration: float = pydantic.Field(0.5, gt=0, description="spectral density of the acceleration, m^2/s^3")
    range_sigma: float = pydantic.Field(0.08, gt=0, description="of a range, m")
    loss: float = pydantic.Field(2.0, ge=0, description="scale of the Cauchy loss on ranges, sigmas; 0 for L2")
    height: float = pydantic.Field(1.0, description="of the tag in the anchors' frame, m")
    bias: bool = pydantic.Field(True, description="estimate one range bias per anchor (mhe, fixed_lag, ml)")
    bias_mean: float = pydantic.Field(0.10, description="expected bias, m; not used with bias=off")
    bias_sigma: float = pydantic.Field(0.05, gt=0, description="of the biases around it, m")
    lag: float = pydantic.Field(0.2, ge=0, description="latency by which positions are advanced, s")
    delay: float = pydantic.Field(1.0, ge=0, description="of fixed_lag, s")
    iterations: int = pydantic.Field(
        3, ge=0, description="gauss-newton steps per knot; 0, and any other solver, iterates to convergence"
    )
    capacity: int = pydantic.Field(2, ge=1, description="ranges of one anchor that a knot can hold")
    gps_rate: float = pydantic.Field(0.0, ge=0, description="coarse fixes drawn around the truth, Hz; 0 for none")
    gps_sigma: float = pydantic.Field(2.0, gt=0, description="of those fixes, m per axis")
    covariance: bool = pydantic.Field(False, description="compute the covariance of every pose (not by ls)")
    odometry: bool = pydantic.Field(True, description="UWB: use wheel odometry where the recording has it (mhe, ml)")
    team_horizon: int = pydantic.Field(4, ge=1, le=1000, description="teams: keyframes in the window before the last")
    team_period: float = pydantic.Field(0.5, gt=0, description="teams: between keyframes, s")
    team_loss: float = pydantic.Field(1.0, ge=0, description="teams: scale of the Cauchy loss on sightings; 0 for L2")
    sight_robots: bool = pydantic.Field(True, description="teams: use what robots see of each other")
    chart: Literal["gtsam", "plain"] = pydantic.Field(
        "gtsam", description="graphs: residual of relative poses; gtsam is the full logarithm. Their optima differ"
    )
    initial: Literal["auto", "file", "odometry", "chordal", "ls"] = pydantic.Field(
        "auto", description="graphs: start at the file's vertices, chained odometry, or linear least squares"
    )
    starts: int = pydantic.Field(
        1, ge=1, le=20, description="graphs: solve from so many different starts and keep the cheapest optimum"
    )
    robust: Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"] = pydantic.Field(
        "none", description="graphs: loss on what robust_on says"
    )
    robust_on: Literal["all", "odometry", "loop_closures", "sightings", "ranges"] = pydantic.Field(
        "all", description="graphs: measurements that get the robust loss"
    )
    robust_scale: float | None = pydantic.Field(None, gt=0, description="graphs: of that loss, sigmas")
    graduated: bool = pydantic.Field(False, description="graphs: graduated non-convexity (gauss-newton)")
    odometry_scale: float = pydantic.Field(1.0, gt=0, description="graphs: factor of the sigmas of odometry")
    fence: tuple[float, float, float, float] | None = pydantic.Field(
        None, description="graphs: [x, y] lowest and [x, y] highest position of every pose, m"
    )
    edges: int = pydantic.Field(10, ge=0, description="graphs: how many of the worst measurements are listed")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="graphs: of the solver")
    iteration_limit: int = pydantic.Field(1000, ge=1, description="graphs: of the solver")
    time_limit: float = pydantic.Field(60.0, gt=0, description="graphs: of one solve, s")

    @pydantic.model_validator(mode="after")
    def _one_fix_per_knot(self) -> Settings:
        if self.gps_rate * self.period > 1:
            raise ValueError(f"gps_rate {self.gps_rate:g} Hz: a knot every {self.period:g} s holds one fix")
        return self


class Kind(Protocol):
    """Methods for one kind of recording.

    Attributes:
        what: the kind, for messages. methods: their names, the default one first.
        settings: names of settings that mean something. outputs: suffixes that poses can be written with.
    """

    what: str
    methods: tuple[str, ...]
    settings: tuple[str, ...]
    outputs: tuple[str, ...]

    def possible(self, recording: Any) -> tuple[str, ...]: ...
    def prepare(self, settings: Any, recording: Any, rng: np.random.Generator) -> Any: ...
    def run(self, settings: Any, method: str, solver: str, recording: Any, prepared: Any) -> Outcome: ...
    def plot(self, recording: Any, traces: dict[str, Any]) -> Figure: ...
    def poses(self, recording: Any, made: Any) -> Poses: ...
    def tracks(self, recording: Any, poses: Poses) -> np.ndarray: ...


KINDS: dict[type, Any] = {UwbRecording: UwbMethods, PoseGraph: GraphMethods, TeamRecording: TeamMethods}


def kind_of(recording: Any, settings: Settings) -> Any:
    """Methods for a recording, or None."""
    if isinstance(recording, UwbRecording) and settings.odometry:
        if recording.odometry is not None and recording.anchors.shape[1] == 2:
            return WheelMethods
    return KINDS.get(type(recording))


@dataclass(frozen=True, eq=False)
class Drawn:
    """A recording, its kind, and what its kind prepared for all methods (coarse fixes of UWB recordings)."""

    recording: Any
    kind: Any
    prepared: Any

    @property
    def fixes(self) -> Any:
        """Coarse fixes, where there are any."""
        return self.prepared


class RecordingScenario:
    """See the module. Which methods there are depends on the recording; the first one of its kind is the default."""

    name = "recording"
    source = "spec recordings 1 to 6"
    methods = ("mhe", "fixed_lag", "ls", "ml")
    metrics = (
        "rmse_2d", "ratio_to_eskf", "ratio_to_ls", "ate", "objective", "start_objective", "ls_objective",
        "gradient_norm", "keyframes", "measurements",
    )  # fmt: skip
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        given = {} if settings.trajectory is None else {"trajectory": settings.trajectory}
        recording = open_recording(settings.path, **given)
        kind = kind_of(recording, settings)
        if kind is None:
            known = ", ".join(each.what for each in KINDS.values())
            raise FormError(f"{settings.path}: read as {type(recording).__name__}; what can be localized: {known}")
        self._require_meaning(settings, kind)
        return Drawn(recording, kind, kind.prepare(settings, recording, rng))

    def require_method(self, drawn: Drawn, method: str) -> None:
        """Raises FormError where the method does not fit the recording; names those that do."""
        possible = drawn.kind.possible(drawn.recording)
        if method not in possible:
            what = f"{drawn.kind.what} ({drawn.recording.name})"
            raise FormError(f"method {method!r} cannot localize {what}; possible: {', '.join(possible)}")

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        self.require_method(drawn, method)
        outcome = drawn.kind.run(settings, method, solver, drawn.recording, drawn.prepared)
        return replace(outcome, metrics=dict.fromkeys(self.metrics) | dict(outcome.metrics))

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        return drawn.kind.plot(drawn.recording, {label: o.trace for label, o in outcomes.items()})

    @staticmethod
    def _require_meaning(settings: Settings, kind: Any) -> None:
        """Raises SettingError for a setting that is not its default and that the kind of recording does not know."""
        for name, info in Settings.model_fields.items():
            changed = name != "path" and getattr(settings, name) != info.get_default()
            if changed and name not in kind.settings:
                raise SettingError(
                    f"setting {name} means nothing for {kind.what}; those that do: {', '.join(kind.settings)}"
                )


scenario = RecordingScenario()
