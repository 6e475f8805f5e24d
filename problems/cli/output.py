"""What commands print: results on standard output, everything else on standard error."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

from problems.bench.export import by_scenario, columns, number, percent, seconds
from problems.bench.metrics import solved_share
from problems.bench.rows import Job, Row
from problems.bench.scenario import TIMES
from problems.bench.settings import as_text
from problems.bench.summary import STEP_TIMES, Summary, configuration, reproduce
from problems.errors import ReadError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PIPE_WIDTH = 200  # columns of a table that goes to a file or a pipe
FAILURES_SHOWN = 10


@contextmanager
def one_json_object(wanted: bool) -> Iterator[Callable[[Any], None]]:
    """Keep standard output free for one JSON object.

    While the context is open everything written to standard output, also by libraries in C, goes to standard error.

    Args:
        wanted: False changes nothing.

    Yields:
        A function that takes the object; it is printed when the context closes.
    """
    if not wanted:
        yield lambda value: None
        return
    results: list[Any] = []
    sys.stdout.flush()
    saved = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield results.append
    finally:
        sys.stdout.flush()
        os.dup2(saved, 1)
        os.close(saved)
    for value in results:
        print(json.dumps(value, allow_nan=False))


def console() -> Console:
    """Standard output for people."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False, markup=False)


def error_console() -> Console:
    """Standard error for people."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False)


def table(title: str | None, names: Iterable[str], numeric: Iterable[str] = ()) -> Table:
    """An empty table with columns of these names; `numeric` ones are aligned to the right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made, right = Table(title=title, title_justify="left", box=SIMPLE_HEAD), set(numeric)
    for name in names:
        made.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return made


def print_summaries(summaries: Sequence[Summary]) -> None:
    """A table for each scenario: metrics (mean ± standard error), times (median) and what failed."""
    for name, rows in by_scenario(summaries).items():
        settings, metrics = columns(rows)
        head = ["method", "solver", *settings]
        numeric = [*metrics, "step (median)", "step (p95)", *TIMES, "solved", "failed trials"]
        made = table(f"{name}, {_counted(rows)}", [*head, *numeric], numeric)
        for row in rows:
            made.add_row(
                row.method,
                row.solver,
                *(as_text(row.settings.get(key)) for key in settings),
                *(number(row.metrics.get(key), row.metrics_se.get(key)) for key in metrics),
                *(seconds(row.time[key]) for key in (*STEP_TIMES, *TIMES)),
                percent(solved_share(row.status)),
                "impossible" if row.impossible else str(row.failed),
            )
        console().print(made)


def _counted(rows: Sequence[Summary]) -> str:
    fewest, most = min(row.trials for row in rows), max(row.trials for row in rows)
    trials = f"{most} trial{'s' if most > 1 else ''}" if fewest == most else f"{fewest} to {most} trials"
    seeds = list(dict.fromkeys(str(row.seed) for row in rows))
    return f"{trials}, seed{'s' if len(seeds) > 1 else ''} {', '.join(seeds)}"


def print_failures(rows: Sequence[Row], defaults: Callable[[Job], dict[str, Any]]) -> int:
    """Say on standard error what failed and how to see it again, and which pairings do not exist.

    Args:
        rows: all rows.
        defaults: default settings of the scenario of a job.

    Returns:
        The exit code of the command: 2 when an input could not be read, 1 when a trial failed or nothing could run at
        all, else 0. A method that cannot go to a solver is no failure as long as others can.
    """
    failed = [row for row in rows if row.failure is not None and not row.impossible]
    impossible = [row for row in rows if row.impossible]
    _print(failed, lambda job, message: (configuration(job), message), "failed", "red", defaults)
    _print(impossible, lambda job, _: (job.scenario, job.method, job.solver), "not possible", "yellow", defaults)
    if rows and len(impossible) == len(rows):
        return 1
    return max((2 if row.failure.kind == ReadError.__name__ else 1 for row in failed if row.failure), default=0)


def _print(
    rows: Sequence[Row],
    alike: Callable[[Job, str], Any],
    what: str,
    style: str,
    defaults: Callable[[Job], dict[str, Any]],
) -> None:
    different = {alike(row.job, row.failure.message): row for row in reversed(rows) if row.failure}
    out = error_console()
    for row in list(different.values())[::-1][:FAILURES_SHOWN]:
        assert row.failure is not None
        out.print(f"{what}: {row.failure.kind}: {row.failure.message}", style=style, soft_wrap=True)
        out.print(f"  {reproduce(row.job, defaults(row.job))}", soft_wrap=True)
    if len(different) > FAILURES_SHOWN:
        out.print(f"  and {len(different) - FAILURES_SHOWN} others that were {what}")
