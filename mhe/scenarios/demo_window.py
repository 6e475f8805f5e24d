"""Scenario ``demo-window``: levels in a chain of three tanks, which cannot be negative; one window, many solvers.

Rain fills the first tank now and then, each tank drains into the next, and the levels of the second and third are
measured with noise as large as the levels themselves. Between rains the tanks run dry, so that the bounds hold an
estimate in 30 to 50 % of the steps; that is what makes them worth having.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pydantic

from mhe.centralized import MovingHorizonEstimator, mhe, mhe_pre
from mhe.estimate import Estimate, WindowEstimate
from mhe.filters import KalmanFilter
from mhe.polyhedron import Polyhedron
from problems.bench.scenario import Consistency, Curve, Outcome
from problems.display import new_figure
from problems.errors import ModelWarning
from problems.models import LinearModel, Sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEPT, PASSED = 0.8, 0.18  # share of a level that stays, and that reaches the next tank; the rest is lost
RAIN, RAINY = 0.6, 0.08  # scale of the rain (m per step), and share of the steps with rain
SEEPAGE = 0.02  # scale of the inflow into the other tanks (m per step)
NOISE = 0.4  # standard deviation of the level sensors (m)
REFERENCE_TOLERANCE = 1e-12
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # told apart without colour vision


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    horizon: int = pydantic.Field(8, ge=1, le=100, description="N, transitions in the window")
    duration: int = pydantic.Field(60, ge=1, le=100_000, description="steps")
    bounds: Literal["none", "tight", "soft"] = pydantic.Field(
        "tight", description="tight: no negative levels; soft: relaxed by slacks where no sequence meets that"
    )
    prior: Literal["filter", "seed", "smoothing"] = pydantic.Field("filter", description="arrival cost of mhe")
    form: Literal["auto", "F1", "F2", "F3", "P1", "P2"] = pydantic.Field(
        "auto", description="of the window: F with process noise, P with pre-estimation; the other takes its default"
    )
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")
    warm: bool = pydantic.Field(True, description="start QP solvers from the solution before")


@dataclass(frozen=True, eq=False)
class Drawn:
    """Truth and measurements of one trial, and what each method gives when it is solved tightly."""

    states: np.ndarray
    measurements: np.ndarray
    references: dict[str, np.ndarray] = field(default_factory=dict)  # found when they are first asked for


@dataclass(frozen=True, eq=False)
class Trace:
    """What the picture needs: states (duration + 1, 3) and whether a bound held the window (duration + 1,)."""

    states: np.ndarray
    active: np.ndarray


class DemoWindowScenario:
    """See the module and `problems.bench.scenario.Scenario`."""

    name = "demo-window"
    source = "generated; windows and arrival costs of spec dmhe-pre-estimation 3.1, 3.2; levels in m, errors in m"
    methods = ("mhe", "mhe_pre", "kf")
    without_solver = ("kf",)
    metrics = ("rmse", "distance_to_reference", "active_share")
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        model, steps = _model(), settings.duration
        inflow = np.abs(rng.normal(size=(steps, 3))) * [RAIN, SEEPAGE, SEEPAGE]
        inflow[:, 0] *= rng.random(steps) < RAINY
        states = [0.3 * np.abs(rng.normal(size=3))]
        for push in inflow:
            states.append(model.A @ states[-1] + push)
        truth = np.array(states)
        return Drawn(truth, truth @ model.C.T + NOISE * rng.normal(size=(steps + 1, 2)))

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        if method == "kf":
            return _filtered(drawn)
        started = perf_counter()
        # trials differ in data only, so they share everything compiled
        estimator = _estimator(settings, method, solver)  # type: ignore[arg-type]
        compiled = perf_counter() - started
        estimator.reset()
        estimates, nees = [], []
        for y, truth in zip(drawn.measurements, drawn.states, strict=True):
            estimates.append(estimator.step(y))
            nees.append(_normalized(estimates[-1], truth))  # the covariance follows from what the session holds now
        unmet = [k for k, estimate in enumerate(estimates) if estimate.infeasible]
        if unmet:
            warnings.warn(
                f"{method}, {solver}: no sequence meets the bounds in {len(unmet)} step(s), first in step {unmet[0]}",
                ModelWarning,
                stacklevel=2,
            )
        states = np.array([estimate.state for estimate in estimates])
        active = np.array([_held(estimate) for estimate in estimates])
        seconds = np.array([estimate.seconds for estimate in estimates])
        solutions = [estimate.solution for estimate in estimates if estimate.solution is not None]
        solve = sum(solution.seconds["solve"] for solution in solutions)
        return Outcome(
            metrics={"rmse": _rmse(states, drawn), "active_share": float(active.mean())},
            options=estimator.options,
            times={"compile": compiled, "update": float(seconds.sum()) - solve, "solve": solve},
            step_seconds=seconds,
            status=Counter(str(estimate.status) for estimate in estimates),
            iterations=sum(solution.iterations for solution in solutions),
            residual=max(max(solution.residuals.values()) for solution in solutions),
            curves={"error": _errors(states, drawn)},
            consistency={} if method == "mhe_pre" else {"nees": Consistency(np.array(nees), 3)},
            estimate=states,
            trace=Trace(states, active),
        )

    def reference(self, settings: Settings, method: str, drawn: Drawn) -> np.ndarray | None:
        """States (duration + 1, 3) at the optima of the same windows, solved much more tightly."""
        if method == "kf":
            return None
        if method not in drawn.references:
            exact = settings.model_copy(update={"tolerance": REFERENCE_TOLERANCE, "form": "auto", "warm": True})
            estimator = _estimator(exact, method, "daqp")  # type: ignore[arg-type]
            estimator.reset()
            drawn.references[method] = np.array([estimator.step(y).state for y in drawn.measurements])
        return drawn.references[method]

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        figure = new_figure(figsize=(8.0, 6.4), layout="constrained")
        panels = figure.subplots(3, 1, sharex=True)
        for k, (axes, name) in enumerate(zip(panels, _model().state_names, strict=True)):
            axes.plot(drawn.states[:, k], color="#000000", linewidth=1.6, label="truth")
            if k:
                axes.plot(drawn.measurements[:, k - 1], ".", color="#999999", markersize=4, label="measured")
            for n, (label, outcome) in enumerate(outcomes.items()):
                colour = COLOURS[n % len(COLOURS)]
                axes.plot(outcome.trace.states[:, k], color=colour, linewidth=1.2, label=label)
            axes.axhline(0.0, color="#000000", linewidth=0.6)
            axes.set_ylabel(f"{name} level, m")
            axes.grid(alpha=0.3)
        panels[-1].set_xlabel("time step")
        figure.legend(*panels[1].get_legend_handles_labels(), loc="outside upper center", ncols=4)
        return figure


@lru_cache(maxsize=1)
def _model() -> LinearModel:
    return LinearModel(
        KEPT * np.eye(3) + PASSED * np.eye(3, k=-1),
        np.diag([RAIN**2 / 4, SEEPAGE**2 * 10, SEEPAGE**2 * 10]),
        sensors=[Sensor("second", [[0.0, 1.0, 0.0]], sigma=NOISE), Sensor("third", [[0.0, 0.0, 1.0]], sigma=NOISE)],
        mean=[0.3, 0.3, 0.3],
        covariance=0.1 * np.eye(3),
        state_names=("first", "second", "third"),
    )


@lru_cache(maxsize=256)  # a plan has that many solvers, forms and tolerances
def _estimator(settings: Settings, method: str, solver: str) -> MovingHorizonEstimator:
    observes = method == "mhe_pre"
    options: dict[str, Any] = {
        "solver": solver,
        "tolerance": settings.tolerance,
        "infeasible": "soft" if settings.bounds == "soft" else "predict",
    }
    if settings.form.startswith("P" if observes else "F"):
        options["form"] = settings.form
    if settings.bounds != "none":
        options["state_bounds"] = Polyhedron.box(np.zeros(3), np.full(3, np.inf))
    if not settings.warm:
        options["warm"] = False
    if observes:
        return mhe_pre(_model(), settings.horizon, **options)
    return mhe(_model(), settings.horizon, prior=settings.prior, **options)


def _held(estimate: WindowEstimate) -> bool:
    """Whether a bound is active in the window."""
    solution = estimate.solution
    return solution is not None and any(rows.any() for rows in solution.active_set.values())


def _filtered(drawn: Drawn) -> Outcome:
    model, estimator = _model(), KalmanFilter(_model())
    estimates, nees, nis = [], [], []
    for k, (y, truth) in enumerate(zip(drawn.measurements, drawn.states, strict=True)):
        mean, covariance = estimator.mean, estimator.covariance
        if k:
            mean, covariance = model.A @ mean, model.A @ covariance @ model.A.T + model.process_covariance
        nis.append(_squared(y - model.C @ mean, model.C @ covariance @ model.C.T + model.R))
        estimates.append(estimator.step(y))
        nees.append(_normalized(estimates[-1], truth))
    states = np.array([estimate.state for estimate in estimates])
    seconds = np.array([estimate.seconds for estimate in estimates])
    return Outcome(
        metrics={"rmse": _rmse(states, drawn), "active_share": None},
        times={"solve": float(seconds.sum())},
        step_seconds=seconds,
        status=Counter(str(estimate.status) for estimate in estimates),
        curves={"error": _errors(states, drawn)},
        consistency={"nees": Consistency(np.array(nees), 3), "nis": Consistency(np.array(nis), 2)},
        trace=Trace(states, np.zeros(len(states), dtype=bool)),
    )


def _normalized(estimate: Estimate, truth: np.ndarray) -> float:
    """Squared error in units of the covariance; NaN where there is none."""
    covariance = estimate.covariance
    return np.nan if covariance is None else _squared(estimate.state - truth, covariance)


def _squared(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def _errors(states: np.ndarray, drawn: Drawn) -> Curve:
    return Curve(np.linalg.norm(states - drawn.states, axis=1))


def _rmse(states: np.ndarray, drawn: Drawn) -> float:
    return float(np.sqrt(((states - drawn.states) ** 2).sum(axis=1).mean()))


scenario = DemoWindowScenario()
