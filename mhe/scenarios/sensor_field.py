"""Scenario ``sensor-field``: a hundred nodes follow a target, and nine of ten measure nothing.

Source: dmhe-l-step E2 and E3 (Case 1 and Case 2), errata 2 and 8.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mhe.centralized import mhe
from mhe.distributed import DistributedEstimator, NetworkDesign, TrialRun, run_trials
from mhe.filters import KalmanFilter
from mhe.polyhedron import Polyhedron
from mhe.relay import RELAY_METHODS, RelayDesign, RelayEstimator
from mhe.relay.engine import run_relay_trials
from mhe.scenarios._network_runs import recorded, warn_of_infeasible
from mhe.scenarios._network_world import World, registered_estimator
from mhe.scenarios._sensor_field_settings import Settings
from mhe.scenarios.sensor_field_world import FieldTrial, SensorField, draw_trial, sensor_field
from problems.bench.scenario import Curve, Outcome
from problems.solvers.base import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CENTRALIZED = ("kf", "mhe")


@dataclass(frozen=True, eq=False)
class Trace:
    """What a method estimated in one trial.

    Attributes:
        errors: (duration + 1, nodes) norms of position errors (m); one column for centralized methods.
    """

    errors: np.ndarray


@dataclass(frozen=True, eq=False)
class Prepared:
    """What all trials of a method share: a design, or an estimator; what it cost (s), and the options it stands for."""

    method: RelayDesign | NetworkDesign | Any
    seconds: float
    options: Mapping[str, Any]


class SensorFieldScenario:
    """See the module, and `problems.bench.scenario.Scenario`."""

    name = "sensor-field"
    source = (
        "spec dmhe-l-step E2 and E3. prmse: mean over time (from t = 1) and nodes of the norm of the position error, "
        "steady_prmse: over the second half, convergence_time: from when it stays below `threshold`. prmse_literal is "
        "the formula as printed, with C^i = 0 at nodes without a sensor (errata 2)"
    )
    methods = ("mhe", "kf", "dmhe_f", "dmhe_pre", "dmhe_b", "dmhe_l_pre", "dmhe_1_pre")
    metrics = ("prmse", "prmse_at_1", "convergence_time", "steady_prmse", "prmse_literal")
    settings = Settings
    takes_estimators = True
    without_solver = ("kf",)

    def field(self, settings: Settings) -> SensorField:
        """The network, the same object for the same settings."""
        s = settings
        return _field(s.network_seed, s.nodes, s.share, s.radius, s.density, s.keeps_largest)

    def draw(self, settings: Settings, rng: np.random.Generator) -> FieldTrial:
        return draw_trial(self.field(settings), settings.duration, rng)

    def design(self, settings: Settings, method: str, solver: str = "auto") -> RelayDesign | NetworkDesign:
        """A distributed method as the settings say.

        Args:
            settings: of the scenario.
            method: one of `methods` that is not centralized.
            solver: registered name.
        """
        field = self.field(settings)
        kind = RelayDesign if method in RELAY_METHODS else NetworkDesign
        return kind(field.model, field.network, method, **self._arguments(settings, method, solver))

    def run(self, settings: Settings, method: str, solver: str, drawn: FieldTrial) -> Outcome:
        prepared = self._prepared(settings, method, solver)
        times = {"compile": prepared.seconds}
        iterations, residual = 0, None
        if isinstance(prepared.method, RelayDesign | NetworkDesign):
            made = _batch(prepared.method, drawn.measurements[None])
            states, status, infeasible = made.states[0], made.status, made.infeasible
            times |= {"setup": made.phases["precompute"], "update": made.phases["update"]}
            times["solve"] = made.phases["solve"]
            # a step is a node's, as in the other network scenarios: its share of a step of all
            steps = made.seconds[1:] / states.shape[1]
            status = Counter({str(name): count for name, count in made.status.items()})
            status[str(Status.SOLVED)] -= states.shape[1]  # instant 0 reports the prior and counts as no step
        else:
            record = recorded(prepared.method, drawn.measurements)
            states, status, infeasible = np.array(record.states), record.status, record.infeasible
            times |= record.times
            steps, iterations, residual = np.array(record.step_seconds), record.iterations, record.residual
        warn_of_infeasible(method, infeasible)
        trace = Trace(position_errors(states, drawn.states))
        curve = Curve(trace.errors.mean(axis=1), np.arange(len(states), dtype=float), "time (s)")
        return Outcome(
            metrics=self.score(settings, trace),
            options=prepared.options,
            times=times,
            step_seconds=steps,
            status=status,
            iterations=iterations,
            residual=residual,
            curves={"PRMSE (m)": curve},
            trace=trace,
        )

    def campaign(
        self, settings: Settings, method: str, drawn: Sequence[FieldTrial], solver: str = "auto"
    ) -> list[Trace]:
        """What `run` estimates in many trials; those of a distributed method are worked out all at once.

        Args:
            settings: of the scenario.
            method: one of `methods`.
            drawn: the trials.
            solver: registered name.
        """
        prepared = self._prepared(settings, method, solver)
        if isinstance(prepared.method, RelayDesign | NetworkDesign):
            states = _batch(prepared.method, np.array([trial.measurements for trial in drawn])).states
        else:
            states = [np.array(recorded(prepared.method, trial.measurements).states) for trial in drawn]
        return [Trace(position_errors(one, trial.states)) for one, trial in zip(states, drawn, strict=True)]

    def score(self, settings: Settings, trace: Trace) -> dict[str, float | None]:
        """Metrics of one trial.

        Args:
            settings: of the scenario.
            trace: of a method.
        """
        field = self.field(settings)
        curve = trace.errors.mean(axis=1)[1:]
        above = np.flatnonzero(~(curve < settings.threshold))
        settled = int(above[-1]) + 2 if above.size else 1
        seen = trace.errors[1:, field.active] if trace.errors.shape[1] > 1 else trace.errors[1:]
        return {
            "prmse": float(curve.mean()),
            "prmse_at_1": float(curve[0]),
            "convergence_time": float(settled) if settled <= len(curve) else None,
            "steady_prmse": float(curve[len(curve) // 2 :].mean()),
            "prmse_literal": float(seen.mean()) * len(field.active) / field.network.count,
        }

    def plot(self, settings: Settings, drawn: FieldTrial, outcomes: Mapping[str, Outcome]) -> Figure:
        """PRMSE over time, logarithmic, and the network with the way of the target."""
        from mhe.scenarios.sensor_field_plot import plot

        curves = {label: outcome.trace.errors.mean(axis=1) for label, outcome in outcomes.items()}
        return plot(self.field(settings), curves, drawn.states, settings.threshold)

    @lru_cache(maxsize=64)
    def _prepared(self, settings: Any, method: str, solver: str) -> Prepared:
        # trials differ in data only, so they share everything that does not depend on data
        field = self.field(settings)
        started = time.perf_counter()
        made, options = self._made(settings, method, solver)
        network = {"nodes": field.network.count, "nodes_drawn": field.drawn, "active": len(field.active)}
        network |= {"links": len(field.network.edges) // 2, "network_seed": field.seed}
        return Prepared(made, time.perf_counter() - started, dict(options) | network)

    def _made(self, settings: Settings, method: str, solver: str) -> tuple[Any, Mapping[str, Any]]:
        field = self.field(settings)
        if method == "kf":
            return KalmanFilter(field.model, initial_update=False), {}
        if method == "mhe":
            options = {"prior": settings.prior, "solver": solver, "tolerance": settings.tolerance}
            central = mhe(field.model, settings.horizon, initial_update=False, **options)
            return central, central.options
        if method not in self.methods:
            everything = np.arange(field.model.measurement_size)
            world = World(field.model, field.network, field.placement, field.model, everything)
            return registered_estimator(world, settings, method, solver), {}
        if settings.engine == "arrays":
            design = self.design(settings, method, solver)
            return design, design.options.as_dict()
        kind = RelayEstimator if method in RELAY_METHODS else DistributedEstimator
        made = kind(field.model, field.network, method, **self._arguments(settings, method, solver))
        return made, made.options.as_dict()

    def _arguments(self, settings: Settings, method: str, solver: str) -> dict[str, Any]:
        """Of the design of a distributed method."""
        common: dict[str, Any] = {
            "placement": self.field(settings).placement,
            "horizon": settings.horizon,
            "weights": settings.weights,
            "solver": solver,
            "tolerance": settings.tolerance,
        }
        if method not in RELAY_METHODS:
            return common
        names = ("latency", "startup", "omega", "alpha", "arrival_divisor", "S", "gains")
        common |= {name: getattr(settings, name) for name in names}
        common["l"] = settings.l if method == "dmhe_l_pre" else 1
        if settings.bounds != "none":
            common["residual_bounds"] = Polyhedron.box([-settings.width] * 2, [settings.width] * 2)
            common["bounds"] = settings.bounds
        return common


def position_errors(states: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(steps, nodes) norms of the position errors (m) of estimates (steps, nodes, 4) against states (steps, 4)."""
    return np.linalg.norm(states[..., :2] - truth[:, None, :2], axis=-1)


def _batch(design: RelayDesign | NetworkDesign, measurements: np.ndarray) -> TrialRun:
    if isinstance(design, RelayDesign):
        return run_relay_trials(design, measurements)
    return run_trials(design, measurements)


@lru_cache(maxsize=16)
def _field(seed: int, nodes: int, share: float, radius: float, density: float, largest: bool) -> SensorField:
    return sensor_field(seed, nodes, share=share, radius=radius, density=density, largest=largest)


scenario = SensorFieldScenario()
