"""Scenario ``agreement-team``: positions of a team by least squares in a box that holds its border robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pydantic

from localization.lattice import Fence, Measurements, draw_lattice, lattice, linear_data, linear_problem
from problems.bench.agreement import METRICS, Case, Optimum, certified_optima, compared
from problems.bench.scenario import Outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REFERENCE_TOLERANCE = 1e-12


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid")

    robots: int = pydantic.Field(25, ge=2, le=20_000, description="on a square lattice with a spacing of 4 m")
    fence: float = pydantic.Field(0.0, ge=0, description="box around the lattice at this distance, m")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial: what the team measured, its box, and the optimum."""

    team: Measurements
    fence: Fence
    case: Case
    _optima: list[Optimum] = field(default_factory=list)  # found when they are first asked for

    @property
    def optima(self) -> list[Optimum]:
        if not self._optima:
            problem = linear_problem(self.team, fence=self.fence)
            solver = "daqp" if self.team.robots <= 200 else "gauss-newton"
            session = problem.compile(solver, tolerance=REFERENCE_TOLERANCE)
            self._optima.extend(certified_optima(session, [self.case]))
        return self._optima


class AgreementTeamScenario:
    """See the module."""

    name = "agreement-team"
    source = "spec gps-range-bearing-localization 3.5, 3.6 and 6; optimum certified by residuals"
    methods = ("ls",)
    metrics = METRICS
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        team = draw_lattice(settings.robots, rng)
        places = lattice(settings.robots)[0]
        fence = places.min(axis=0) - settings.fence, places.max(axis=0) + settings.fence
        data = linear_data(team)
        weight = 1 / np.linalg.eigvalsh(data["covariances"]).min()
        return Drawn(team, fence, Case(data, scale=max(1.0, weight)))

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        session = linear_problem(drawn.team, fence=drawn.fence).compile(solver, tolerance=settings.tolerance)
        return compared(session, [drawn.case], drawn.optima, "robot")

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        from localization.plots import plot_team

        return plot_team(
            drawn.team, {label: (o.trace, None) for label, o in outcomes.items() if o.trace is not None}, drawn.fence
        )


scenario = AgreementTeamScenario()
