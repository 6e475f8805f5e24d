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
from problems.bench.rows import Failure, Job, Row, finite
from problems.bench.scenario import TIMES, Outcome, Scenario, trial_rng
from problems.bench.settings import validated


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
            outcome, row = None, Row(job, failure=failure_of(error), status={"failed": 1})
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
    return outcome, wall, cpu, None if before is None or after is None else max(after - before, 0)


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
        wall=wall,
        cpu=cpu,
        memory=memory,
    )


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
