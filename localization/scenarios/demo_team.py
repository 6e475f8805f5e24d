"""Scenario ``demo-team``: a team on a lattice localized at one instant, as quadratic program, NLP and factor graph."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import pydantic

from localization.lattice import (
    Fence,
    Measurements,
    draw_lattice,
    lattice,
    linear_data,
    linear_problem,
    linear_start,
    position_covariances,
    split_squared_error,
    team_data,
    team_problem,
)
from problems.bench.scenario import Outcome
from problems.errors import AccuracyWarning
from problems.noise import Cauchy, GemanMcClure, Huber, Loss
from problems.problem import Problem
from problems.solvers.base import Status
from problems.spaces import wrap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOSSES: Mapping[str, Loss | None] = {
    "l2": None,
    "huber": Huber(),
    "cauchy": Cauchy(),
    "geman-mcclure": GemanMcClure(),
}
OUTLIER = 50.0  # m, how far off a false GPS fix is (spec 10)
ELLIPSES = 150  # robots up to which covariances are computed for the picture
REFERENCE_TOLERANCE = 1e-13


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid")

    robots: int = pydantic.Field(36, ge=2, le=20_000, description="on a square lattice with a spacing of 4 m")
    pairs: Literal["one", "both"] = pydantic.Field("one", description="neighbours that measure range and bearing")
    loss: Literal["l2", "huber", "cauchy", "geman-mcclure"] = pydantic.Field("l2", description="on GPS fixes")
    outliers: int = pydantic.Field(0, ge=0, description="robots whose GPS fix is 50 m off")
    fence: float | None = pydantic.Field(None, ge=0, description="box around the lattice at this distance, m")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")

    @pydantic.model_validator(mode="after")
    def _some_fixes_are_right(self) -> Settings:
        if self.outliers > self.robots:
            raise ValueError(f"outliers={self.outliers} with only {self.robots} robots")
        return self


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial: what the team measured, the problem of each method, and its optimum."""

    team: Measurements
    loss: Loss | None
    fence: Fence | None
    outliers: np.ndarray
    _optima: dict[str, np.ndarray] = field(default_factory=dict)  # found when they are first asked for

    def problem(self, method: str) -> tuple[Problem, dict[str, np.ndarray]]:
        """The problem a method solves, and its data."""
        if method == "ls":
            return linear_problem(self.team, loss=self.loss, fence=self.fence), linear_data(self.team)
        return team_problem(self.team, loss=self.loss, fence=self.fence), team_data(self.team)

    @cached_property
    def start(self) -> np.ndarray:
        """Poses (n, 3): least squares without fence and loss, and compass."""
        return linear_start(self.team)[0]

    def optimum(self, method: str) -> np.ndarray:
        """Positions (n, 2) of the optimum, solved much more tightly than anything it is compared with."""
        if method not in self._optima:
            problem, data = self.problem(method)
            initial = self.start if method == "ml" else self.start[:, :2]
            session = problem.compile("gauss-newton", tolerance=REFERENCE_TOLERANCE)
            self._optima[method] = session.solve(data, initial={"robot": initial})["robot"][:, :2].copy()
        return self._optima[method]


@dataclass(frozen=True, eq=False)
class Trace:
    """What the picture needs: positions (n, 2) or poses (n, 3), and covariances (n, 2, 2) in the world frame."""

    robot: np.ndarray
    covariance: np.ndarray | None


class DemoTeamScenario:
    """See the module. ``ml`` is nonlinear; ``ls`` is linear and starts nothing, so that quadratic programs do too."""

    name = "demo-team"
    source = (
        "spec gps-range-bearing-localization 3.4 to 3.6 and 6; metrics against truth and the tightly solved optimum"
    )
    methods = ("ml", "ls")
    metrics = ("rmse", "distance_to_reference", "heading_rms")
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        team = draw_lattice(settings.robots, rng, pairs=settings.pairs)
        outliers = np.sort(rng.permutation(settings.robots)[: settings.outliers])
        course = rng.uniform(0, 2 * np.pi, settings.robots)[outliers]
        gps = team.gps.copy()
        gps[outliers] += OUTLIER * np.column_stack([np.cos(course), np.sin(course)])
        fence = None
        if settings.fence is not None:
            places = lattice(settings.robots)[0]
            fence = places.min(axis=0) - settings.fence, places.max(axis=0) + settings.fence
        return Drawn(replace(team, gps=gps), LOSSES[settings.loss], fence, outliers)

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        problem, data = drawn.problem(method)
        session = problem.compile(solver, tolerance=settings.tolerance)  # an impossible pairing ends here
        times, initial = {"compile": session.compile_seconds}, None
        if method == "ml":
            begin = time.perf_counter()
            poses, _ = linear_start(drawn.team)
            times["setup"], initial = time.perf_counter() - begin, {"robot": poses}
        session.update(**data)
        solution = session.solve(initial=initial)
        if not solution.solved:  # rows hold no text of their own
            warnings.warn(f"{method}, {solver}: {solution.status}: {solution.message}", AccuracyWarning, stacklevel=2)
        robot = solution["robot"].copy()
        usable = solution.status not in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED)
        covariance = None
        if usable and settings.robots <= ELLIPSES:
            covariance = position_covariances(solution, problem.unknowns["robot"])
        return Outcome(
            metrics=_metrics(drawn, method, robot) if usable else {},
            options={
                "form": session.form,
                "answered_by": solution.method,
                "start": "ls" if method == "ml" else "none",
                "loss": settings.loss,
                "fence": settings.fence,
            },
            times=times | solution.seconds,
            status=Counter({str(solution.status): 1}),
            iterations=solution.iterations,
            residual=max(solution.residuals.values()),
            trace=Trace(robot, covariance),
        )

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        from localization.plots import plot_team

        traces = {label: (o.trace.robot, o.trace.covariance) for label, o in outcomes.items()}
        return plot_team(drawn.team, traces, drawn.fence)


def _metrics(drawn: Drawn, method: str, robot: np.ndarray) -> dict[str, float | None]:
    truth = drawn.team.truth
    assert truth is not None
    away = np.linalg.norm(robot[:, :2] - drawn.optimum(method), axis=1)
    headings = float(np.sqrt(np.mean(wrap(robot[:, 2] - truth[:, 2]) ** 2))) if robot.shape[1] == 3 else None
    return {
        "rmse": sum(split_squared_error(robot, truth)) ** 0.5,
        "distance_to_reference": float(away.max()),
        "heading_rms": headings,
    }


scenario = DemoTeamScenario()
