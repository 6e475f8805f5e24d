"""Comparisons a report draws from rows: what is paired, what is a failure, what is measured against what."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from problems.bench.metrics import Difference, paired_difference, performance_profile, shifted_geometric_mean
from problems.bench.rows import Row
from problems.bench.scenario import NO_SOLVER
from problems.bench.settings import as_text

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
class Contest:
    """Problems that the same solvers were given.

    Attributes:
        label: which problems, in words.
        times: solve times by solver, of the same instances in the same order; None is a failure. An instance is a trial
            of a method with its settings.
    """

    label: str
    times: dict[str, list[float | None]]

    def means(self, limit: float) -> list[SolverTime]:
        """Shifted geometric means by solver, failures at `limit` seconds, fastest first."""
        found = [
            SolverTime(solver, len(values), values.count(None), shifted_geometric_mean(values, SHIFT, limit))
            for solver, values in self.times.items()
        ]
        return sorted(found, key=lambda item: item.geometric_mean)

    def profile(self) -> dict[str, Any]:
        """Performance profile by solver (`problems.bench.metrics.performance_profile`)."""
        return performance_profile(self.times)


@dataclass(frozen=True)
class SolverTime:
    """Solve times of one solver over the instances of a contest."""

    solver: str
    trials: int
    failed: int
    geometric_mean: float


def contests(rows: Sequence[Row]) -> list[Contest]:
    """Who can be compared with whom: methods and settings that the same two or more solvers ran stand together.

    A pairing that does not exist is left out, so a solver is never blamed for a problem it cannot be given.

    Args:
        rows: of one scenario.
    """
    configurations: dict[tuple[str, str], dict[str, dict[tuple[int, int], float | None]]] = {}
    for row in rows:
        if row.job.solver != NO_SOLVER and not row.impossible:
            problem = row.job.method, json.dumps(row.job.settings, sort_keys=True)
            trials = configurations.setdefault(problem, {}).setdefault(row.job.solver, {})
            trials[row.job.seed, row.job.trial] = solve_time(row)
    groups: dict[frozenset[str], list[tuple[str, str]]] = {}
    for problem, by_solver in configurations.items():
        if len(by_solver) > 1:
            groups.setdefault(frozenset(by_solver), []).append(problem)
    found = []
    for members in groups.values():
        times: dict[str, list[float | None]] = {solver: [] for solver in configurations[members[0]]}
        for problem in members:
            by_solver = configurations[problem]
            shared = [trial for trial in next(iter(by_solver.values())) if all(trial in t for t in by_solver.values())]
            for solver, values in times.items():
                values += [by_solver[solver][trial] for trial in shared]
        if all(times.values()):
            found.append(Contest(_named(members, list(configurations)), times))
    return found


def _named(members: Sequence[tuple[str, str]], everything: Sequence[tuple[str, str]]) -> str:
    """Methods of the members, and the settings in which they differ from other problems."""
    label = ", ".join(dict.fromkeys(method for method, _ in members))
    all_settings = [json.loads(settings) for _, settings in everything]
    own_settings = [json.loads(settings) for _, settings in members]
    for key in all_settings[0]:
        values = list(dict.fromkeys(as_text(settings.get(key)) for settings in all_settings))
        own = list(dict.fromkeys(as_text(settings.get(key)) for settings in own_settings))
        if len(own) < len(values):
            label += f"; {key} {', '.join(own)}"
    return label


@dataclass(frozen=True)
class Robustness:
    """How one method and solver came through all its settings and trials.

    Attributes:
        method, solver: who.
        trials, failed, impossible: numbers of trials, as in `problems.bench.summary.Summary`.
        status: steps by status name.
        infeasible_handled: share of the infeasible steps after which the trial went on to its end; None without any.
    """

    method: str
    solver: str
    trials: int
    failed: int
    impossible: int
    status: dict[str, int]
    infeasible_handled: float | None


def robustness(rows: Sequence[Row]) -> list[Robustness]:
    """One entry for each method and solver, in the order of their first rows."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.job.method, row.job.solver), []).append(row)
    found = []
    for (method, solver), group in groups.items():
        status: Counter[str] = Counter()
        for row in group:
            status.update(row.status)
        handled = sum(row.status.get("infeasible", 0) for row in group if row.failure is None)
        found.append(
            Robustness(
                method=method,
                solver=solver,
                trials=len(group),
                failed=sum(row.failure is not None and not row.impossible for row in group),
                impossible=sum(row.impossible for row in group),
                status=dict(status),
                infeasible_handled=handled / status["infeasible"] if status["infeasible"] else None,
            )
        )
    return found


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


@dataclass(frozen=True)
class Effect:
    """What one value of a setting changes, everything else equal.

    Attributes:
        setting, value, baseline: its name, the value, and what that is compared with.
        method, solver, settings: what both have in common; `settings` has no `setting`.
        metric, time, iterations: differences trial by trial of the metric, the solve time (s) and the iterations; None
            with fewer than two pairs.
    """

    setting: str
    value: Any
    baseline: Any
    method: str
    solver: str
    settings: dict[str, Any]
    metric: Difference | None
    time: Difference | None
    iterations: Difference | None


def setting_differences(rows: Sequence[Row], metric: str, settings: Sequence[str]) -> list[Effect]:
    """Differences of each value of the `settings` to the first one that was run.

    Args:
        rows: of one scenario.
        metric: by name.
        settings: names of those to look at.
    """
    found = []
    for setting in settings:
        groups: dict[tuple[str, str, str], dict[str, list[Row]]] = {}
        for row in rows:
            if setting in row.job.settings:
                others = {key: value for key, value in row.job.settings.items() if key != setting}
                group = groups.setdefault((row.job.method, row.job.solver, json.dumps(others, sort_keys=True)), {})
                group.setdefault(json.dumps(row.job.settings[setting]), []).append(row)
        for (method, solver, others), by_value in groups.items():
            baseline, *compared = by_value
            for value in compared:
                pairs = _pairs(by_value[value], by_value[baseline])
                quantities: list[list[tuple[float | None, float | None]]] = [
                    [(a.metrics.get(metric), b.metrics.get(metric)) for a, b in pairs],
                    [(solve_time(a), solve_time(b)) for a, b in pairs],
                    [(_iterations(a), _iterations(b)) for a, b in pairs],
                ]
                effects = [paired_difference([a for a, _ in each], [b for _, b in each]) for each in quantities]
                if any(effects):
                    ends = json.loads(value), json.loads(baseline)
                    found.append(Effect(setting, *ends, method, solver, json.loads(others), *effects))
    return found


def _pairs(rows: Sequence[Row], baseline: Sequence[Row]) -> list[tuple[Row, Row]]:
    by_trial = {(row.job.seed, row.job.trial): row for row in baseline}
    return [(row, by_trial[trial]) for row in rows if (trial := (row.job.seed, row.job.trial)) in by_trial]


def _iterations(row: Row) -> float | None:
    return None if row.failure else float(row.iterations)


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
