"""What a scenario is: the world an estimator is tried in, with the methods that can be tried there."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pydantic

from problems import registry
from problems.display import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity followed through a trial; the report draws it with the band of all trials.

    Attributes:
        values: (points,) what is followed; NaN where it does not exist.
        at: (points,) where, ascending; None counts them from 0.
        over: what `at` is, with its unit.
    """

    values: np.ndarray
    at: np.ndarray | None = None
    over: str = "time step"


@dataclass(frozen=True, eq=False)
class Consistency:
    """Errors weighed with the covariance that was claimed for them, one for each step.

    A normalized estimation error squared (NEES) is e' P^-1 e with the error e of an estimate; a normalized innovation
    squared (NIS) is the same of a predicted measurement. Both are chi-square distributed with `degrees` degrees of
    freedom where the covariance is right (Bar-Shalom, Li, Kirubarajan: Estimation with Applications, 5.4).

    Attributes:
        squared: (steps,) the squares; NaN where there is no covariance.
        degrees: of freedom, the length of e.
    """

    squared: np.ndarray
    degrees: int


@dataclass(repr=False)
class Outcome:
    """What one method did in one trial.

    Attributes:
        metrics: value by metric name; None where the metric has no value in this trial (never converged, no truth).
        options: the set of options the method stands for, by name, as printed beside the result.
        times: seconds by part, among `TIMES`. `compile` is what compiling cost in this process, also when an earlier
            trial paid for it.
        step_seconds: (steps,) wall time of each estimation step.
        status: steps by status name (`problems.solvers.base.Status`).
        iterations: solver iterations of all steps.
        residual: the worst residual the sessions recomputed; None where nothing was solved.
        curves: followed through the trial, by name.
        consistency: squared normalized errors by name ("nees", "nis").
        estimate: what is compared with `Scenario.reference`, an array of the same shape.
        trace: whatever the scenario's own plot needs; must be picklable.
    """

    metrics: Mapping[str, float | None]
    options: Mapping[str, Any] = field(default_factory=dict)
    times: Mapping[str, float] = field(default_factory=dict)
    step_seconds: np.ndarray = field(default_factory=lambda: np.empty(0))
    status: Counter[str] = field(default_factory=Counter)
    iterations: int = 0
    residual: float | None = None
    curves: Mapping[str, Curve] = field(default_factory=dict)
    consistency: Mapping[str, Consistency] = field(default_factory=dict)
    estimate: np.ndarray | None = None
    trace: Any = None

    def table(self) -> Table:
        """Metrics, statuses and times."""
        rows: list[tuple[str, Any]] = list(self.metrics.items())
        rows += [(f"steps {name}", count) for name, count in self.status.items() if count]
        if self.step_seconds.size:
            rows.append(("median step (s)", float(np.median(self.step_seconds))))
        rows += [(f"{name} (s)", seconds) for name, seconds in self.times.items()]
        rows += [] if self.residual is None else [("worst residual", self.residual)]
        return Table("Outcome of one trial", ("what", "value"), rows)

    def __repr__(self) -> str:
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


TIMES = ("compile", "setup", "update", "solve")
DISTANCE = "distance_to_reference"  # the metric that comes from `Scenario.reference`


class Scenario(Protocol):
    """An object registered in the entry-point group ``horizonet.scenarios``.

    Attributes:
        name: the registered name.
        source: where the numbers of the scenario come from.
        methods: names `run` takes; the first one is the baseline of paired differences.
        metrics: names of the metrics, the main one first. Smaller is better unless the source says otherwise.
        settings: pydantic model with defaults, validation and ``extra="forbid"``.

    A scenario with ``takes_estimators = True`` also runs every registered estimator under its name.

    A scenario with methods that solve no optimization problem (a Kalman filter) also has ``without_solver``, a tuple
    of their names; a plan then gives them one row instead of one for each solver.

    A scenario that knows the optimum of what its methods solve has ``reference(settings, method, drawn) -> array``: the
    `Outcome.estimate` of the same problem solved far more tightly, or None for a method without one. The benchmark
    calls it outside of the measured time and adds the metric `DISTANCE`, the largest distance of a row of the estimate
    from that of the reference.
    """

    name: str
    source: str
    methods: tuple[str, ...]
    metrics: tuple[str, ...]
    settings: type[pydantic.BaseModel]

    def draw(self, settings: Any, rng: np.random.Generator) -> Any:
        """Truth and noise of one trial, all that is random in it; `run` leaves it as it is, for others share it."""
        ...

    def run(self, settings: Any, method: str, solver: str, drawn: Any) -> Outcome:
        """Run one method with one solver on what was drawn, starting from fresh sessions."""
        ...

    def plot(self, settings: Any, drawn: Any, outcomes: Mapping[str, Outcome]) -> Figure:
        """Picture of one trial with the outcomes by label."""
        ...


NO_SOLVER = "none"


def takes_method(scenario: Scenario, method: str) -> bool:
    """Whether the scenario knows the method by itself, or takes registered estimators and this is the name of one."""
    if method in scenario.methods:
        return True
    return getattr(scenario, "takes_estimators", False) and method in registry.names("estimators")


def takes_solver(scenario: Scenario, method: str) -> bool:
    """Whether the method solves an optimization problem, so that the choice of a solver means something."""
    return method not in getattr(scenario, "without_solver", ())


def trial_rng(seed: int, scenario: str, trial: int) -> np.random.Generator:
    """The generator of one trial.

    It depends on nothing else: methods, solvers and settings of a trial meet the same noise, so their differences are
    paired. Settings that change what is drawn do so through `Scenario.draw`.
    """
    digest = hashlib.sha256(scenario.encode()).digest()
    words = np.frombuffer(digest[:16], dtype="<u4").tolist()
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(*words, trial)))
