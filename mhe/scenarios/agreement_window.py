"""Scenario ``agreement-window``: windows of a target between walls, as quadratic programs with active rows.

Every solver must find the same optimum. A target moves in a corridor narrower than the noise of its position fixes, so
that walls and speed limits hold the estimate in every window.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pydantic

from mhe.polyhedron import Polyhedron
from mhe.window import Window, WindowForm
from problems.bench.agreement import METRICS, Case, Optimum, certified_optima, compared
from problems.bench.scenario import Outcome
from problems.display import new_figure
from problems.models import LinearModel, Sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HALF_WIDTH, SPEED = 0.15, 0.5  # m, m/s
STEP = 0.2  # s
PUSH, NOISE = 1.5, 0.6  # standard deviations of acceleration (m/s^2) and of position fixes (m)
PRIOR = np.diag([0.5, 0.5, 1.0, 1.0]) ** 2
REFERENCE_TOLERANCE = 1e-12
LIMITS = np.array([np.inf, HALF_WIDTH, SPEED, SPEED])


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    horizon: int = pydantic.Field(10, ge=1, le=60, description="N, transitions in the window")
    windows: int = pydantic.Field(4, ge=1, le=1000, description="solved one after another")
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial: the windows of a run through the corridor, and their optima."""

    horizon: int
    states: np.ndarray
    measurements: np.ndarray
    cases: tuple[Case, ...]
    _optima: list[Optimum] = field(default_factory=list)  # found when they are first asked for

    @property
    def optima(self) -> list[Optimum]:
        if not self._optima:
            session = _window(self.horizon, "F3").compile("daqp", tolerance=REFERENCE_TOLERANCE)
            self._optima.extend(certified_optima(session, self.cases))
        return self._optima


class AgreementWindowScenario:
    """See the module. ``F1`` has states and disturbances joined by equalities, ``F3`` is condensed."""

    name = "agreement-window"
    source = "generated; windows of spec dmhe-pre-estimation 3.1; optimum by daqp, certified by residuals"
    methods = ("F1", "F3")
    metrics = METRICS
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        model, N = _model(), settings.horizon
        state = np.array([0.0, 0.0, SPEED, 0.0])
        states = [state]
        for _ in range(N + settings.windows - 1):
            state = model.A @ state + model.G @ (PUSH * rng.normal(size=2))
            state = np.clip(state, -LIMITS, LIMITS)
            states.append(state)
        truth = np.array(states)
        seen = truth[:, :2] + NOISE * rng.normal(size=(len(truth), 2))
        information = np.linalg.inv(PRIOR)
        scale = max(1.0, float(np.abs(information).max()), 1 / NOISE**2)
        cases = [
            Case(
                {
                    "y": seen[k : k + N + 1].ravel(),
                    "reference": truth[k] + np.sqrt(np.diag(PRIOR)) * rng.normal(size=4),
                    "information": information,
                },
                scale=scale,
            )
            for k in range(settings.windows)
        ]
        return Drawn(N, truth, seen, tuple(cases))

    def run(self, settings: Settings, method: Any, solver: str, drawn: Drawn) -> Outcome:
        session = _window(settings.horizon, method).compile(solver, tolerance=settings.tolerance)
        return compared(session, drawn.cases, drawn.optima, "x")

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        figure = new_figure(figsize=(8.0, 4.0), layout="constrained")
        axes = figure.subplots()
        first = settings.windows - 1
        axes.plot(*drawn.states[first:, :2].T, color="#000000", linewidth=1.6, label="truth")
        axes.plot(*drawn.measurements[first:].T, ".", color="#999999", label="measured")
        for label, outcome in outcomes.items():
            if outcome.trace is not None:
                axes.plot(*outcome.trace[:, :2].T, linewidth=1.2, label=label)
        for wall in (-HALF_WIDTH, HALF_WIDTH):
            axes.axhline(wall, color="#000000", linestyle="--", linewidth=0.8)
        axes.set_xlabel("along the corridor, m")
        axes.set_ylabel("across, m")
        axes.legend()
        return figure


@lru_cache(maxsize=1)
def _model() -> LinearModel:
    A = np.eye(4) + STEP * np.eye(4, k=2)
    G = np.vstack([STEP**2 / 2 * np.eye(2), STEP * np.eye(2)])
    fixes = Sensor("fixes", np.eye(2, 4), sigma=NOISE)
    names = ("x", "y", "speed_x", "speed_y")
    return LinearModel(A, PUSH**2 * np.eye(2), G=G, sensors=[fixes], state_names=names, dt=STEP)


@lru_cache(maxsize=16)
def _window(horizon: int, form: WindowForm) -> Window:
    return Window(_model(), horizon, form=form, state_bounds=Polyhedron.box(-LIMITS, LIMITS))


scenario = AgreementWindowScenario()
