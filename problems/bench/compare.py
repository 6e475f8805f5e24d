"""Comparisons a report draws from rows: what is paired, what is a failure, what is measured against what."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from problems.bench.metrics import Difference, paired_difference, performance_profile, shifted_geometric_mean
from problems.bench.rows import Row
from problems.bench.scenario import NO_SOLVER

UNSOLVED_SHARE = 0.01  # a trial counts as failed when more of its steps ended neither solved nor infeasible
SHIFT = 1e-3  # seconds; solve times of a trial far below it count as equal


def solve_time(row: Row) -> float | None:
    """Seconds of solving in a trial, its wall time where the scenario does not tell; None for a failed trial."""
    if row.failure is not None:
        return None
    steps = sum(row.status.values())
    answered = row.status.get("solved", 0) + row.status.get("infeasible", 0)
    if steps and steps - answered > UNSOLVED_SHARE * steps:
        return None
    return row.times.get("solve", row.wall)


@dataclass(frozen=True)
class SolverTime:
    """Solve times of one solver over all trials of a scenario."""

    solver: str
    trials: int
    failed: int
    geometric_mean: float


def solver_times(rows: Sequence[Row], limit: float) -> list[SolverTime]:
    """Shifted geometric mean of the solve times by solver, failures at `limit` seconds, fastest first."""
    times: dict[str, list[float | None]] = {}
    for row in rows:
        if row.job.solver != NO_SOLVER:
            times.setdefault(row.job.solver, []).append(solve_time(row))
    found = [
        SolverTime(solver, len(values), values.count(None), shifted_geometric_mean(values, SHIFT, limit))
        for solver, values in times.items()
    ]
    return sorted(found, key=lambda item: item.geometric_mean)


def solver_profile(rows: Sequence[Row]) -> dict[str, Any]:
    """Performance profile over solvers; an instance is a trial of a method with its settings that all solvers ran."""
    by_instance: dict[tuple[Any, ...], dict[str, float | None]] = {}
    for row in rows:
        if row.job.solver != NO_SOLVER:
            instance = (row.job.method, json.dumps(row.job.settings, sort_keys=True), row.job.seed, row.job.trial)
            by_instance.setdefault(instance, {})[row.job.solver] = solve_time(row)
    solvers = list(dict.fromkeys(solver for times in by_instance.values() for solver in times))
    shared = [times for times in by_instance.values() if len(times) == len(solvers)]
    if len(solvers) < 2 or not shared:
        return {}
    return performance_profile({solver: [times[solver] for times in shared] for solver in solvers})


@dataclass(frozen=True)
class Comparison:
    """One choice against the baseline, everything else equal.

    Attributes:
        what: the method or solver compared.
        baseline: what it is compared with.
        fixed: the solver or method both have in common.
        settings: both have in common.
        difference: of the metric, trial by trial.
    """

    what: str
    baseline: str
    fixed: str
    settings: dict[str, Any]
    difference: Difference


def method_differences(rows: Sequence[Row], metric: str, methods: Sequence[str]) -> list[Comparison]:
    """Differences of each method to the first of `methods` that was run, with the same solver and settings."""
    values = _by_configuration(rows, metric)
    ran = dict.fromkeys(method for method, _, _ in values)
    baseline = next((method for method in methods if method in ran), None)
    if baseline is None:
        return []
    found = []
    for (method, solver, settings), by_trial in values.items():
        reference = values.get((baseline, solver, settings)) or values.get((baseline, NO_SOLVER, settings))
        if method != baseline and reference:
            found += _comparison(method, baseline, solver, settings, by_trial, reference)
    return found


def solver_differences(rows: Sequence[Row], metric: str) -> list[Comparison]:
    """Differences of each solver to the first one of the rows, with the same method and settings."""
    values = _by_configuration(rows, metric)
    solvers = list(dict.fromkeys(solver for _, solver, _ in values if solver != NO_SOLVER))
    found = []
    for (method, solver, settings), by_trial in values.items():
        reference = values.get((method, solvers[0], settings)) if solvers else None
        if solver not in (NO_SOLVER, *solvers[:1]) and reference:
            found += _comparison(solver, solvers[0], method, settings, by_trial, reference)
    return found


_Trials = dict[tuple[int, int], float | None]


def _by_configuration(rows: Sequence[Row], metric: str) -> dict[tuple[str, str, str], _Trials]:
    values: dict[tuple[str, str, str], _Trials] = {}
    for row in rows:
        key = row.job.method, row.job.solver, json.dumps(row.job.settings, sort_keys=True)
        values.setdefault(key, {})[row.job.seed, row.job.trial] = row.metrics.get(metric)
    return values


def _comparison(
    what: str,
    baseline: str,
    fixed: str,
    settings: str,
    values: Mapping[tuple[int, int], float | None],
    reference: Mapping[tuple[int, int], float | None],
) -> list[Comparison]:
    trials = [trial for trial in values if trial in reference]
    difference = paired_difference([values[trial] for trial in trials], [reference[trial] for trial in trials])
    return [Comparison(what, baseline, fixed, json.loads(settings), difference)] if difference else []
