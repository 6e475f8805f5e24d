"""Run a plan: what is missing in the store, one row after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from problems.bench.plan import Plan
from problems.bench.rows import Job, Row
from problems.bench.store import Store
from problems.bench.workers import Executor


def missing(jobs: Sequence[Job], store: Store) -> list[Job]:
    """The jobs without a finished row. A row that failed is no result, so its job is tried again, unless it failed for
    a pairing that does not exist."""
    return [job for job in jobs if job.key not in store.finished]


def run_plan(plan: Plan, store: Store, executor: Executor) -> Iterator[Row]:
    """Run the jobs of a plan that the store does not have yet.

    Args:
        plan: what to run.
        store: where the rows go.
        executor: what runs them.

    Yields:
        Each new row, after the store has it.

    Raises:
        WriteError: the store cannot take the rows; before any work when that can be known.
    """
    jobs = missing(plan.jobs(), store)
    if not jobs:
        return
    store.begin(plan, executor.workers, len(jobs))
    for row, _ in executor.run(jobs, plan.time_limit):
        store.append(row)
        yield row
