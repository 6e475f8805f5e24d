"""Run one job and turn everything that can happen into a row."""

from __future__ import annotations

import json
import sys
import time
import traceback
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from problems import registry
from problems.bench.metrics import chi_square_interval
from problems.bench.rows import Failure, Job, Row, finite
from problems.bench.scenario import DISTANCE, TIMES, Consistency, Curve, Outcome, Scenario, trial_rng
from problems.bench.settings import validated
from problems.errors import ShapeError

POINTS = 64  # of a curve that are kept
DIGITS = 6  # of each


def measure(job: Job) -> tuple[Row, Outcome | None]:
    """Run a job in this process.

    Returns:
        Its row, and the scenario's outcome when the trial finished. Whatever an estimator raises is in the row.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            outcome, wall, cpu, memory = _run(job)
            row = _row(job, outcome, wall, cpu, memory)
        except (Exception, SystemExit) as error:  # a library that calls sys.exit must not end the campaign
            outcome, row = None, Row(job, failure=failure_of(error))
            row.status.update({} if row.impossible else {"failed": 1})
    row.warnings.extend(dict.fromkeys(f"{item.category.__name__}: {item.message}" for item in caught))
    return row, outcome


def failure_of(error: BaseException) -> Failure:
    """An exception as it goes into a row."""
    return Failure(type(error).__name__, str(error), "".join(traceback.format_exception(error)))


def _run(job: Job) -> tuple[Outcome, float, float, int | None]:
    scenario: Scenario = registry.load("scenarios", job.scenario)
    settings = validated(scenario, job.settings)
    drawn = _drawn(job.scenario, json.dumps(job.settings), job.seed, job.trial)
    before = _peak_memory(reset=True)
    wall, cpu = time.perf_counter(), time.process_time()
    outcome = scenario.run(settings, job.method, job.solver, drawn)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    after = _peak_memory()
    outcome.metrics = dict(outcome.metrics) | _distance(scenario, settings, job.method, drawn, outcome)
    return outcome, wall, cpu, None if before is None or after is None else max(after - before, 0)


def _distance(scenario: Any, settings: Any, method: str, drawn: Any, outcome: Outcome) -> dict[str, float]:
    """The metric `DISTANCE` where the scenario offers a reference and the method an estimate."""
    find = getattr(scenario, "reference", None)
    reference = None if find is None or outcome.estimate is None else find(settings, method, drawn)
    if reference is None or outcome.estimate is None:
        return {}
    away = np.asarray(outcome.estimate, dtype=float) - np.asarray(reference, dtype=float)
    return {DISTANCE: float(np.linalg.norm(np.atleast_2d(away), axis=-1).max())}


@lru_cache(maxsize=1)
def _drawn(name: str, settings: str, seed: int, trial: int) -> Any:
    # Jobs of one trial follow each other, so one entry spares nearly all repeated draws.
    scenario: Scenario = registry.load("scenarios", name)
    return scenario.draw(validated(scenario, json.loads(settings)), trial_rng(seed, name, trial))


def _row(job: Job, outcome: Outcome, wall: float, cpu: float, memory: int | None) -> Row:
    scenario: Scenario = registry.load("scenarios", job.scenario)
    unknown = set(outcome.times) - set(TIMES)
    if unknown:
        raise ValueError(f"scenario {job.scenario} reports times {sorted(unknown)}; times are {', '.join(TIMES)}")
    steps = np.asarray(outcome.step_seconds, dtype=float)
    curves = dict(outcome.curves)
    for name, item in outcome.consistency.items():
        curves[name] = Curve(np.asarray(item.squared, dtype=float))
    median, p95, largest = (np.quantile(steps, [0.5, 0.95, 1.0]).tolist()) if steps.size else (None, None, None)
    return Row(
        job=job,
        metrics={
            name: finite(value) for name, value in (dict.fromkeys(scenario.metrics) | dict(outcome.metrics)).items()
        },
        options=json.loads(json.dumps(dict(outcome.options), default=str)),
        times={name: float(seconds) for name, seconds in outcome.times.items()},
        steps=int(steps.size),
        step_median=median,
        step_p95=p95,
        step_max=largest,
        status={str(name): int(count) for name, count in outcome.status.items()},
        iterations=int(outcome.iterations),
        residual=finite(outcome.residual),
        curves={name: _thinned(curve) for name, curve in curves.items()},
        consistency={name: _consistency(item) for name, item in outcome.consistency.items()},
        wall=wall,
        cpu=cpu,
        memory=memory,
    )


def _thinned(curve: Curve) -> dict[str, Any]:
    """At most `POINTS` of its points, evenly among all, the first and the last included."""
    values = np.asarray(curve.values, dtype=float)
    at = np.arange(values.size) if curve.at is None else np.asarray(curve.at, dtype=float)
    if values.ndim != 1 or at.shape != values.shape:
        raise ShapeError(f"a curve is given as two arrays of one length, got {at.shape} and {values.shape}")
    kept = np.unique(np.linspace(0, values.size - 1, min(values.size, POINTS)).round().astype(int))
    shown = [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values[kept].tolist()]
    return {"at": at[kept].tolist(), "values": shown, "over": curve.over}


def _consistency(item: Consistency) -> dict[str, float]:
    squared = np.asarray(item.squared, dtype=float)
    squared = squared[np.isfinite(squared)]
    lower, upper = chi_square_interval(item.degrees)
    if not squared.size:
        return {"degrees": item.degrees, "samples": 0}
    return {
        "mean": float(squared.mean()) / item.degrees,
        "inside": float(((lower <= squared) & (squared <= upper)).mean()),
        "degrees": item.degrees,
        "samples": int(squared.size),
    }


def _peak_memory(reset: bool = False) -> int | None:
    """Peak resident memory in bytes since the last reset; Linux only, None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
    except OSError:
        return None
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024
