"""Scenario ``agreement-graph``: a planar pose graph with false loop closures and robust losses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import pydantic

from localization import measurements as meas
from problems.bench.agreement import METRICS, Case, Optimum, certified_optima, compared
from problems.bench.scenario import Outcome
from problems.display import new_figure
from problems.noise import Cauchy, Gaussian, GemanMcClure, Huber, Loss
from problems.problem import Problem
from problems.spaces import SE2

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIDE = 5  # poses along a side of the square that is driven around
SIGMA = (0.05, 0.05, 0.02)  # m, m, rad: of odometry and loop closures
FALSE_CLOSURE = 2.0  # m, how far off a false closure is
REFERENCE_TOLERANCE = 1e-20  # gradients shrink with the root of the decrement
LOSSES: Mapping[str, Loss] = {"huber": Huber(), "cauchy": Cauchy(), "geman-mcclure": GemanMcClure(3.0)}


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid")

    poses: int = pydantic.Field(40, ge=20, le=5000, description="driven around a square of five poses a side")
    outliers: int = pydantic.Field(3, ge=0, description="loop closures that are false")
    loss: Literal["huber", "cauchy", "geman-mcclure"] = pydantic.Field("huber", description="on loop closures")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial: the graph, where it starts, and the optimum of each loss.

    Attributes:
        truth: poses (n, 3).
        odometry: (n - 1, 3).
        ends: (m, 2) poses that loop closures join.
        closures: (m, 3), the false ones included.
    """

    truth: np.ndarray
    odometry: np.ndarray
    ends: np.ndarray
    closures: np.ndarray
    case: Case
    _optima: dict[str, list[Optimum]] = field(default_factory=dict)  # found when they are first asked for

    def problem(self, loss: str) -> Problem:
        count = len(self.truth)
        problem = Problem("graph of agreement")
        pose = problem.variables("pose", SE2, count)
        odometry = problem.data("odometry", 3, count - 1)
        closures = problem.data("closures", 3, len(self.ends))
        start = problem.data("start", 3)
        noise, robust = Gaussian(np.array(SIGMA)), LOSSES[loss]
        problem.cost("start", meas.pose_log, on=pose[0], data=start, noise=noise)
        problem.cost("odometry", meas.relative_pose_log, on=(pose[:-1], pose[1:]), data=odometry, noise=noise)
        ends = pose[self.ends[:, 0]], pose[self.ends[:, 1]]
        problem.cost("closures", meas.relative_pose_log, on=ends, data=closures, noise=noise, loss=robust)
        return problem

    def optima(self, loss: str) -> list[Optimum]:
        if loss not in self._optima:
            session = self.problem(loss).compile("gauss-newton", tolerance=REFERENCE_TOLERANCE)
            self._optima[loss] = certified_optima(session, [self.case])
        return self._optima[loss]


class AgreementGraphScenario:
    """See the module. All solvers start from the same poses, near enough that losses with several minima have one."""

    name = "agreement-graph"
    source = "generated; residuals of spec gps-range-bearing-localization 7.4; optimum certified by residuals"
    methods = ("graph",)
    metrics = METRICS
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        truth = _square(settings.poses)
        lap = 4 * (SIDE - 1)
        first = np.arange(settings.poses - lap)
        ends = np.column_stack([first, first + lap])
        step = _between(truth[:-1], truth[1:]) + SIGMA * rng.normal(size=(settings.poses - 1, 3))
        closures = _between(truth[ends[:, 0]], truth[ends[:, 1]]) + SIGMA * rng.normal(size=(len(ends), 3))
        false = rng.permutation(len(ends))[: settings.outliers]
        course = rng.uniform(0, 2 * np.pi, false.size)
        closures[false, :2] += FALSE_CLOSURE * np.column_stack([np.cos(course), np.sin(course)])
        near = SE2.retract_array(truth, SIGMA * rng.normal(size=truth.shape))
        data = {"odometry": step, "closures": closures, "start": truth[0]}
        case = Case(data, {"pose": near}, scale=1 / min(SIGMA) ** 2)
        return Drawn(truth, step, ends, closures, case)

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        session = drawn.problem(settings.loss).compile(solver, tolerance=settings.tolerance)
        outcome = compared(session, [drawn.case], drawn.optima(settings.loss), "pose")
        outcome.options = {**outcome.options, "loss": settings.loss}
        return outcome

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        figure = new_figure(figsize=(6.0, 6.0), layout="constrained")
        axes = figure.subplots()
        axes.plot(*drawn.truth[:, :2].T, color="#000000", linewidth=1.6, label="truth")
        for label, outcome in outcomes.items():
            if outcome.trace is not None:
                axes.plot(*outcome.trace[:, :2].T, linewidth=1.2, label=label)
        axes.set_aspect("equal")
        axes.set_xlabel("x, m")
        axes.set_ylabel("y, m")
        axes.legend()
        return figure


def _square(poses: int) -> np.ndarray:
    """Poses (n, 3) 1 m apart around a square, turning left where a side ends."""
    side, along = np.divmod(np.arange(poses), SIDE - 1)
    side = side % 4
    corners = (SIDE - 1) * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    heading = np.pi / 2 * side
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    return SE2.normalize_array(np.column_stack([corners[side] + along[:, None] * ahead, heading]))


def _between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Relative poses (m, 3): position in the frame of `first`, heading difference."""
    return SE2.local_array(first, second)


scenario = AgreementGraphScenario()
