"""Scenario ``robot-lattice``: a lattice team localized from GPS, compass, range and bearing (E3.1 to E3.4)."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import pydantic

from localization.consensus.gradient import GradientArrays, LocalCosts, wake
from localization.estimators import compass_state_data, compass_state_poses, compass_state_problem
from localization.lattice import (
    Fence,
    Measurements,
    Sigmas,
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
from problems.errors import AccuracyWarning, FormError
from problems.solvers.base import Status
from problems.spaces import wrap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ELLIPSES = 150  # robots up to which covariances are computed for the picture
_BLOCK = 100_000  # wake-ups drawn at once


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid")

    robots: int = pydantic.Field(9, ge=2, le=20_000, description="on a square lattice with a spacing of 4 m")
    pairs: Literal["one", "both"] = pydantic.Field("one", description="neighbours that measure range and bearing")
    fence: float | None = pydantic.Field(
        None, ge=0, description="box around the lattice at this distance, m; not for gps and agl"
    )
    sigma_position: float = pydantic.Field(2.0, gt=0, description="of GPS, m per axis")
    sigma_heading: float = pydantic.Field(0.05, gt=0, description="of the compass, rad")
    sigma_range: float = pydantic.Field(0.1, gt=0, description="m")
    sigma_bearing: float = pydantic.Field(0.03, gt=0, description="rad")
    angles: Literal["geodesic", "chordal"] = pydantic.Field("geodesic", description="residual of angles, for ml")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")
    rounds: int = pydantic.Field(5000, ge=1, description="wake-ups of agl, as a multiple of the robots")
    step: float = pydantic.Field(0.5, gt=0, le=1, description="of agl, in units of 1/diag(H_i)")
    loss: float = pydantic.Field(0.0, ge=0, lt=1, description="probability that agl's links lose a packet")


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial: what the team measured, and the seed of who wakes when and what is lost."""

    team: Measurements
    fence: Fence | None
    seed: int


@dataclass(frozen=True, eq=False)
class Trace:
    """What the picture needs: positions (n, 2) or poses (n, 3), and covariances (n, 2, 2) in the world frame."""

    robot: np.ndarray
    covariance: np.ndarray | None


class RobotLatticeScenario:
    """See the module. ``gps`` and ``agl`` call no solver and refuse a fence; ``ml`` starts at least squares."""

    name = "robot-lattice"
    source = "spec gps-range-bearing-localization 6 (E3.1 to E3.4); per-robot squared errors (3.15) to (3.17)"
    methods = ("gps", "ls", "gls", "ml", "agl")
    without_solver = ("gps", "agl")
    metrics = ("mse", "mse_centroid", "mse_relative", "heading_rms")
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        sigmas = Sigmas(settings.sigma_position, settings.sigma_heading, settings.sigma_range, settings.sigma_bearing)
        team = draw_lattice(settings.robots, rng, pairs=settings.pairs, sigmas=sigmas)
        return Drawn(team, _fence(settings), int(rng.integers(2**63)))

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        if method in self.without_solver and drawn.fence is not None:
            others = ", ".join(name for name in self.methods if name not in self.without_solver)
            raise FormError(f"method {method!r} of {self.name} knows no fence; leave fence out, or choose {others}")
        if method == "gps":
            robot = np.column_stack([drawn.team.gps, drawn.team.compass])
            return Outcome(metrics=_metrics(drawn.team, robot), trace=Trace(robot, None))
        if method == "agl":
            return _run_gradient(settings, drawn)
        return _run_solver(settings, method, solver, drawn)

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        from localization.plots import plot_team

        # fixes are in the picture anyway
        shown = {label: (o.trace.robot, o.trace.covariance) for label, o in outcomes.items() if label != "gps"}
        return plot_team(drawn.team, shown, drawn.fence)


def _run_gradient(settings: Settings, drawn: Drawn) -> Outcome:
    rng, total = np.random.default_rng(drawn.seed), settings.rounds * settings.robots
    begin = time.perf_counter()
    costs = LocalCosts.of(drawn.team)
    arrays = GradientArrays(costs, settings.step)
    setup = time.perf_counter() - begin
    for first in range(0, total, _BLOCK):
        block = min(_BLOCK, total - first)
        robots = rng.integers(0, settings.robots, block)
        heard = rng.random((block, costs.slots.width)) >= settings.loss if settings.loss else None
        wake(arrays, costs, robots, heard)
    seconds = time.perf_counter() - begin - setup
    robot = arrays.x[:-1].copy()
    return Outcome(
        metrics=_metrics(drawn.team, robot),
        options={"step": settings.step, "wakeups": total, "loss": settings.loss},
        times={"setup": setup, "solve": seconds},
        step_seconds=np.full(total, seconds / total),
        trace=Trace(robot, None),
    )


def _run_solver(settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
    team = drawn.team
    if method == "ml":
        problem = team_problem(team, angles=settings.angles, fence=drawn.fence)
    else:
        problem = (linear_problem if method == "ls" else compass_state_problem)(team, fence=drawn.fence)
    session = problem.compile(solver, tolerance=settings.tolerance)  # an impossible pairing ends here
    times, initial, begin = {"compile": session.compile_seconds}, None, time.perf_counter()
    if method == "ml":
        data, initial = team_data(team), {"robot": linear_start(team)[0]}
    else:
        data = linear_data(team) if method == "ls" else compass_state_data(team)
    times["setup"] = time.perf_counter() - begin
    session.update(**data)
    solution = session.solve(initial=initial)
    if not solution.solved:  # rows hold no text of their own
        warnings.warn(f"{method}, {solver}: {solution.status}: {solution.message}", AccuracyWarning, stacklevel=2)
    robot = compass_state_poses(team, solution) if method == "gls" else solution["robot"].copy()
    usable = solution.status not in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED)
    covariance = None
    if usable and settings.robots <= ELLIPSES:
        covariance = position_covariances(solution, problem.unknowns["robot"])
    return Outcome(
        metrics=_metrics(team, robot) if usable else {},
        options={
            "form": session.form,
            "answered_by": solution.method,
            "start": "ls" if method == "ml" else "none",
            "fence": settings.fence,
        },
        times=times | solution.seconds,
        status=Counter({str(solution.status): 1}),
        iterations=solution.iterations,
        residual=max(solution.residuals.values()),
        trace=Trace(robot, covariance),
    )


def _metrics(team: Measurements, robot: np.ndarray) -> dict[str, float | None]:
    assert team.truth is not None
    center, relative = split_squared_error(robot, team.truth)
    heading = float(np.sqrt(np.mean(wrap(robot[:, 2] - team.truth[:, 2]) ** 2))) if robot.shape[1] == 3 else None
    return {"mse": center + relative, "mse_centroid": center, "mse_relative": relative, "heading_rms": heading}


def _fence(settings: Settings) -> Fence | None:
    if settings.fence is None:
        return None
    places = lattice(settings.robots)[0]
    return places.min(axis=0) - settings.fence, places.max(axis=0) + settings.fence


scenario = RobotLatticeScenario()
