"""Rows of trials put together: one summary for each scenario, method, solver and set of settings."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from problems.bench.metrics import mean_and_error
from problems.bench.rows import Job, Row
from problems.bench.scenario import NO_SOLVER, TIMES
from problems.bench.settings import as_text
from problems.solvers.base import Status

STEP_TIMES = ("step_median", "step_p95")
TRADE_OFFS = ("tolerance", "iteration_limit")  # settings that trade accuracy for time

Configuration = tuple[str, str, str, str, int]


@dataclass(frozen=True)
class Summary:
    """What the trials of one configuration gave.

    Attributes:
        scenario, method, solver, settings, seed: the configuration; settings are complete.
        options: the method's set of options.
        trials: how many were run.
        failed: how many of them raised, crashed or took too long.
        impossible: how many did not run because the solver cannot take the problem.
        metrics: mean over the finished trials by name; None where no trial has a value.
        metrics_se: standard error of the mean; None with fewer than two values.
        time: medians over the finished trials, in seconds: `TIMES` per trial, `step_median` and `step_p95` per step.
        step_max: seconds of the longest step of all trials.
        wall, cpu: median seconds of a trial.
        memory: median growth of the peak memory in bytes.
        status: steps of all trials by status name, all names; a failed trial counts as one failed step.
        iterations: mean over the finished trials.
        residual: the worst of all trials.
    """

    scenario: str
    method: str
    solver: str
    settings: dict[str, Any]
    seed: int
    options: dict[str, Any]
    trials: int
    failed: int
    impossible: int
    metrics: dict[str, float | None]
    metrics_se: dict[str, float | None]
    time: dict[str, float | None]
    step_max: float | None
    wall: float | None
    cpu: float | None
    memory: float | None
    status: dict[str, int]
    iterations: float | None
    residual: float | None

    @property
    def configuration(self) -> Configuration:
        """As `configuration` of each of its jobs."""
        return configuration(Job(self.scenario, self.method, self.solver, self.settings, self.seed, 0))

    @property
    def label(self) -> str:
        """Method and solver."""
        return self.method if self.solver == NO_SOLVER else f"{self.method} · {self.solver}"


def configuration(job: Job) -> Configuration:
    """What the trials of one summary have in common."""
    return job.scenario, job.method, job.solver, json.dumps(job.settings, sort_keys=True), job.seed


def summarize(rows: Iterable[Row]) -> list[Summary]:
    """One summary for each configuration, in the order of their first rows."""
    return [_summary(group) for group in by_configuration(rows).values()]


def by_configuration(rows: Iterable[Row]) -> dict[Configuration, list[Row]]:
    """Rows by configuration, in the order of their first rows."""
    groups: dict[Configuration, list[Row]] = {}
    for row in rows:
        groups.setdefault(configuration(row.job), []).append(row)
    return groups


def _summary(rows: Sequence[Row]) -> Summary:
    job, done = rows[0].job, [row for row in rows if row.failure is None]
    status: Counter[str] = Counter({name.value: 0 for name in Status})
    for row in rows:
        status.update(row.status)
    statistics = {
        name: mean_and_error([row.metrics.get(name) for row in done])
        for name in dict.fromkeys(name for row in done for name in row.metrics)
    }
    residuals = [row.residual for row in done if row.residual is not None]
    return Summary(
        scenario=job.scenario,
        method=job.method,
        solver=job.solver,
        settings=job.settings,
        seed=job.seed,
        options=done[0].options if done else {},
        trials=len(rows),
        failed=sum(row.failure is not None and not row.impossible for row in rows),
        impossible=sum(row.impossible for row in rows),
        metrics={name: mean for name, (mean, _) in statistics.items()},
        metrics_se={name: error for name, (_, error) in statistics.items()},
        time={name: _median([row.times.get(name) for row in done]) for name in TIMES}
        | {name: _median([getattr(row, name) for row in done]) for name in STEP_TIMES},
        step_max=max((row.step_max for row in done if row.step_max is not None), default=None),
        wall=_median([row.wall for row in done]),
        cpu=_median([row.cpu for row in done]),
        memory=_median([row.memory for row in done]),
        status=dict(status),
        iterations=mean_and_error([row.iterations for row in done])[0],
        residual=max(residuals, default=None),
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def reproduce(job: Job, defaults: dict[str, Any], trials: int | None = None) -> str:
    """The command line that gives the same again.

    Args:
        job: one of the trials.
        defaults: of the scenario's settings; settings that have their default are left out.
        trials: how many; by default just enough to include the job's own.
    """
    words = ["horizonet", "run", job.scenario, "--method", job.method]
    if job.solver != NO_SOLVER:
        words += ["--solver", job.solver]
    for key, value in job.settings.items():
        if key not in defaults or defaults[key] != value:
            words += ["--set", f"{key}={as_text(value)}"]
    words += ["--trials", str(trials or job.trial + 1), "--seed", str(job.seed)]
    return shlex.join(words)


def varied(summaries: Sequence[Summary]) -> list[str]:
    """Names of the settings that differ between summaries of the same scenario, in the scenario's order."""
    first: dict[str, dict[str, Any]] = {}
    different: dict[str, bool] = {}
    for summary in summaries:
        reference = first.setdefault(summary.scenario, summary.settings)
        for key, value in summary.settings.items():
            different[key] = different.get(key, False) or value != reference.get(key)
    return [key for key, differs in different.items() if differs]
