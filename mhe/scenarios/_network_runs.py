"""Running the methods of a network scenario: every local step counted and timed, errors, and their picture."""

from __future__ import annotations

import time
import warnings
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mhe.centralized import MovingHorizonEstimator
from mhe.distributed import DistributedEstimator
from mhe.estimate import Estimate, WindowEstimate
from mhe.network import NetworkEstimate, NetworkRun
from mhe.polyhedron import Polyhedron
from mhe.scenarios._network_world import METHODS, AnyEstimator, Drawn, Gains, NetworkSettings, World, make_estimator
from problems.bench.scenario import Curve, Outcome
from problems.display import new_figure
from problems.errors import ModelWarning
from problems.solvers.base import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")  # told apart without colour vision
AT_BOUND = 1e-6
REFERENCE_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Trace:
    """What a method estimated in one trial.

    Attributes:
        errors: (duration + 1, nodes) norms of x_t - x_{t|t}; one column for centralized methods.
        active: (duration, nodes) whether a state of the window lies at the box; all False without bounds.
        infeasible: where no sequence met the bounds, as text.
    """

    errors: np.ndarray
    active: np.ndarray
    infeasible: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Prepared:
    """An estimator with everything compiled, what that cost (s), its options, and what it warned of."""

    estimator: AnyEstimator
    seconds: float
    options: Mapping[str, Any]
    warned: tuple[Warning, ...] = ()


class NetworkScenario(ABC):
    """What the two scenarios have in common; see `problems.bench.scenario.Scenario`."""

    name: ClassVar[str]
    methods: ClassVar[tuple[str, ...]] = METHODS
    takes_estimators: ClassVar[bool] = True
    without_solver: ClassVar[tuple[str, ...]] = ("kf",)
    metrics: ClassVar[tuple[str, ...]]

    @abstractmethod
    def world(self, settings: Any) -> World:
        """The network and its model, the same object for the same settings."""

    @abstractmethod
    def gains(self, settings: Any, world: World) -> Gains:
        """Pre-estimation gains as the settings say."""

    @abstractmethod
    def weights(self, settings: Any, world: World, method: str) -> dict[str, Any]:
        """Options of a distributed method about its consensus weights."""

    @abstractmethod
    def score(self, errors: np.ndarray) -> dict[str, float | None]:
        """Metrics from error norms (duration + 1, nodes)."""

    def run(self, settings: Any, method: str, solver: str, drawn: Drawn) -> Outcome:
        prepared = self._prepared(settings, method, solver, drawn)
        for warned in prepared.warned:  # in every trial, also where an earlier one prepared the estimator
            warnings.warn(warned, stacklevel=2)
        record = self._recorded(prepared.estimator, settings, drawn)
        warn_of_infeasible(method, record.infeasible)
        states = np.array(record.states)
        errors = np.linalg.norm(states - drawn.states[:, None], axis=-1)
        return Outcome(
            metrics=self.score(errors),
            options=prepared.options,
            times={"compile": prepared.seconds, **record.times},
            step_seconds=np.array(record.step_seconds),
            status=record.status,
            iterations=record.iterations,
            residual=record.residual,
            curves={"error": Curve(errors.mean(axis=1))},
            estimate=states,
            trace=Trace(errors, np.array(record.active), tuple(record.infeasible)),
        )

    def reference(self, settings: Any, method: str, drawn: Drawn) -> np.ndarray | None:
        """States (duration + 1, nodes, 4) at the optima of the same windows, solved much more tightly."""
        if method not in METHODS or method in self.without_solver:
            return None
        exact = settings.model_copy(update={"tolerance": REFERENCE_TOLERANCE, "form": "auto", "warm": True})
        key = method, exact
        if key not in drawn.references:
            estimator = self._prepared(exact, method, "daqp", drawn).estimator
            drawn.references[key] = np.array(self._recorded(estimator, exact, drawn).states)
        return drawn.references[key]

    def _recorded(self, estimator: AnyEstimator, settings: Any, drawn: Drawn) -> Record:
        rows = slice(None) if hasattr(estimator, "network") else self.world(settings).rows
        return recorded(estimator, drawn.measurements[:, rows], None if settings.bounds == "none" else drawn.box)

    def _prepared(self, settings: Any, method: str, solver: str, drawn: Drawn) -> Prepared:
        if settings.bounds == "none":
            return self._shared(settings, method, solver)
        return self._prepare(settings, method, solver, drawn.box)  # the box is the trial's own

    @lru_cache(maxsize=64)
    def _shared(self, settings: NetworkSettings, method: str, solver: str) -> Prepared:
        # trials of a campaign differ in data only, so they share everything compiled
        return self._prepare(settings, method, solver, None)

    def _prepare(self, settings: Any, method: str, solver: str, box: Polyhedron | None) -> Prepared:
        world = self.world(settings)
        started = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            gains = self.gains(settings, world) if method in METHODS and method.endswith("_pre") else Gains(None, None)
            weights = self.weights(settings, world, method)
            estimator = make_estimator(world, settings, method, solver, gains, weights, box)
            options = _options(estimator)
        seconds = time.perf_counter() - started
        distinct = {(item.category, str(item.message)): item.message for item in caught}
        warned = [item if isinstance(item, Warning) else UserWarning(item) for item in distinct.values()]
        return Prepared(estimator, seconds, options, tuple(warned))

    def plot(self, settings: Any, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        """Error of every node over time; centralized methods in every panel."""
        labels = self.world(settings).network.labels
        return plot_errors(labels, {label: outcome.trace.errors for label, outcome in outcomes.items()})


def recorded(estimator: Any, measurements: np.ndarray, box: Polyhedron | None = None) -> Record:
    """Run an estimator from a fresh start.

    Args:
        estimator: centralized or of a network.
        measurements: (steps, p) as its `step` takes them, instant 0 first.
        box: bounds of the states, to note where they hold a window.
    """
    record = Record(box)
    started = time.perf_counter()
    estimator.reset()
    for k, y in enumerate(measurements):
        estimate = estimator.step(y)
        if k == 0:  # nothing is solved at instant 0: fresh nodes come up and report the prior
            record.times["setup"] += time.perf_counter() - started
        record.add(estimate)
    return record


def warn_of_infeasible(method: str, infeasible: Sequence[Any]) -> None:
    """Warn where no sequence met the bounds; called by the `run` of a scenario."""
    if infeasible:
        warnings.warn(
            f"{method}: {len(infeasible)} local problem(s) had no sequence within the bounds; first {infeasible[0]}",
            ModelWarning,
            stacklevel=3,
        )


class Record:
    """What the steps of one trial leave behind; instant 0 reports the prior and counts as no step."""

    def __init__(self, box: Polyhedron | None = None) -> None:
        self.box = box
        self.states: list[np.ndarray] = []
        self.active: list[list[bool]] = []
        self.step_seconds: list[float] = []
        self.times = {"setup": 0.0, "update": 0.0, "solve": 0.0}
        self.status: Counter[str] = Counter()
        self.iterations = 0
        self.residual: float | None = None
        self.infeasible: list[str] = []

    def add(self, estimate: Estimate | NetworkEstimate) -> None:
        locals_: list[Estimate]
        if isinstance(estimate, NetworkEstimate):
            locals_ = [node for node in estimate.nodes if node is not None]
            self.infeasible += [str(item) for item in estimate.infeasible]
        else:
            locals_ = [estimate]
            if estimate.infeasible:
                bounds = " and ".join(estimate.infeasible)
                self.infeasible.append(f"time step {len(self.states)}: no sequence meets the {bounds}")
        self.states.append(np.array([one.state for one in locals_]))
        if len(self.states) > 1:
            self.active.append([self._at_bound(one) for one in locals_])
            for one in locals_:
                self._count(one)

    def _at_bound(self, estimate: Estimate) -> bool:
        if self.box is None or estimate.window is None or estimate.status is not Status.SOLVED:
            return False
        slack = AT_BOUND * np.maximum(1.0, np.abs(estimate.window))
        above, below = self.box.upper - estimate.window, estimate.window - self.box.lower
        return bool((np.minimum(above, below) <= slack).any())

    def _count(self, estimate: Estimate) -> None:
        self.step_seconds.append(estimate.seconds)
        self.status[str(estimate.status)] += 1
        spent = 0.0
        if isinstance(estimate, WindowEstimate) and estimate.solution is not None:
            solution = estimate.solution
            for part, seconds in solution.seconds.items():
                self.times[part] += seconds
                spent += seconds
            self.iterations += solution.iterations
            self.residual = max(self.residual or 0.0, *solution.residuals.values())
            self.times["update"] += estimate.seconds - spent
        else:
            self.times["solve"] += estimate.seconds


def _options(estimator: AnyEstimator) -> dict[str, Any]:
    """All options of a method, its gains and forms included; everything it needs is compiled afterwards."""
    if isinstance(estimator, MovingHorizonEstimator):
        gain = estimator.window.gain
        return dict(estimator.options) | ({} if gain is None else {"gain": gain.tolist()})
    if not isinstance(estimator, NetworkRun):
        return {}
    if not isinstance(estimator, DistributedEstimator):
        return estimator.options.as_dict()
    design = estimator.design
    options = design.options.as_dict() | {"phi": design.reach, "gamma": design.growth}
    if design.gains is not None:
        labels = design.network.labels
        options["gains"] = {str(label): gain.gain.tolist() for label, gain in zip(labels, design.gains, strict=True)}
    for node, region in enumerate(design.regional):
        gain = None if design.gains is None else design.gains[node].gain
        bounds = design.state_bounds, design.disturbance_bounds
        window, _ = design.pool.get(region, gain, design.options, *bounds)  # the node finds it there
        options["form"] = window.form_for(design.options.solver)
    return options


def plot_errors(labels: tuple[Any, ...], errors: Mapping[str, np.ndarray]) -> Figure:
    """One panel per node with the error norms (steps, nodes) of every method, logarithmic, by label."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    columns = int(np.ceil(np.sqrt(len(labels))))
    rows = -(-len(labels) // columns)
    figure = new_figure(figsize=(1.5 + 3.2 * columns, 1.2 + 2.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for node, axes in enumerate(panels.flat):
        if node >= len(labels):
            axes.set_visible(False)
            continue
        for k, (label, norms) in enumerate(errors.items()):
            central = norms.shape[1] == 1
            axes.semilogy(
                norms[:, 0 if central else node],
                color=COLOURS[k % len(COLOURS)],
                linestyle=":" if central else "-",
                linewidth=1.6 if central else 1.2,
                label=f"{label} (centralized)" if central else label,
            )
        axes.set_title(f"node {labels[node]}", fontsize=10)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=9))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    figure.supxlabel("time step")
    figure.supylabel("error norm of the state")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=min(len(errors), 3))
    return figure
