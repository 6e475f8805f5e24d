"""What the runner of campaigns costs beside the work it measures: dispatch, rows, journal.

The claim: below 5 % of the measured work of a built-in plan.
"""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median

import pytest

from problems.bench import workers
from problems.bench.measure import measure
from problems.bench.plan import Plan, built_in_plan
from problems.bench.rows import Job, Row
from problems.bench.run import run_plan
from problems.bench.store import Store
from problems.bench.workers import LocalProcesses


@pytest.mark.parametrize("name", ["quick", "warm-start"])
def test_the_runner_costs_little_of_a_built_in_plan(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = built_in_plan(name).model_copy(update={"trials": 1})
    spent = []

    def timed(job: Job):  # type: ignore[no-untyped-def]
        started = time.perf_counter()
        result = measure(job)
        spent.append(time.perf_counter() - started)
        return result

    monkeypatch.setattr(workers, "measure", timed)
    plan.jobs()  # loads the scenarios
    rows, elapsed = campaign(plan, tmp_path / "here", 0)
    runner = elapsed - sum(spent)
    work = sum(row.wall or 0.0 for row in rows)
    each = runner / len(rows) * 1e6
    print(f"\n{name}: {len(rows)} rows, {each:.0f} us of the runner per row, {runner / work:.2%} of the work")
    assert runner < 0.05 * work


def test_rows_through_a_worker_process(tmp_path: Path) -> None:
    """The same with everything between two processes: small jobs, so that the runner is most of what they take."""
    from problems.bench.plan import Study

    study = Study(scenario="robot-lattice", methods=("gps",), settings={"robots": 2})
    plan = Plan(study=(study,), trials=2000)
    moments = []
    with Store(tmp_path) as store:
        for _ in run_plan(plan, store, LocalProcesses(1)):
            moments.append(time.perf_counter())
    gaps = [after - before for before, after in zip(moments, moments[1:], strict=False)]
    print(f"\n{len(moments)} rows through a process: median {median(gaps) * 1e6:.0f} us each")
    assert median(gaps) < 2e-3


def campaign(plan: Plan, folder: Path, processes: int) -> tuple[list[Row], float]:
    with Store(folder) as store:
        started = time.perf_counter()
        rows = list(run_plan(plan, store, LocalProcesses(processes)))
        return rows, time.perf_counter() - started
