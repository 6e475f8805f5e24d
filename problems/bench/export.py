"""Summaries as JSON (the command line's contract), Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from problems.bench.metrics import solved_share
from problems.bench.rows import Job
from problems.bench.scenario import TIMES
from problems.bench.settings import as_text
from problems.bench.summary import STEP_TIMES, Summary, reproduce, varied

Facts = Mapping[str, Mapping[str, Any]]


def command(summary: Summary, scenarios: Facts) -> str:
    """The command line that gives a summary again; `scenarios` holds the facts of each scenario by name."""
    job = Job(summary.scenario, summary.method, summary.solver, summary.settings, summary.seed, 0)
    return reproduce(job, scenarios[summary.scenario]["settings"], summary.trials)


def as_json(summaries: Sequence[Summary], scenarios: Facts, trials: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The object that `run`, `bench` and `report` print with ``--json``.

    Args:
        summaries: the rows.
        scenarios: facts of each scenario by name.
        trials: number of trials asked for.
        settings: complete settings of a run, or those a benchmark was given.
    """
    names = list(dict.fromkeys(summary.scenario for summary in summaries))
    seeds = list(dict.fromkeys(summary.seed for summary in summaries))
    return {
        "scenario": names[0] if len(names) == 1 else names,
        "seed": seeds[0] if len(seeds) == 1 else seeds,
        "trials": trials,
        "settings": dict(settings),
        "rows": [
            {
                "scenario": summary.scenario,
                "method": summary.method,
                "solver": summary.solver,
                "settings": summary.settings,
                "options": summary.options,
                "metrics": dict.fromkeys(scenarios[summary.scenario]["metrics"]) | summary.metrics,
                "metrics_se": {name: error for name, error in summary.metrics_se.items() if error is not None},
                "time": summary.time,
                "status": summary.status,
                "reproduce": command(summary, scenarios),
            }
            for summary in summaries
        ],
    }


def columns(summaries: Sequence[Summary]) -> tuple[list[str], list[str]]:
    """Settings that differ and metrics that occur among summaries: the columns a table of them needs."""
    return varied(summaries), list(dict.fromkeys(name for summary in summaries for name in summary.metrics))


def number(value: float | None, error: float | None = None) -> str:
    """Four significant digits, with the standard error to two; an en dash for no value."""
    if value is None:
        return "–"
    return f"{value:.4g}" if error is None else f"{value:.4g} ± {error:.2g}"


def seconds(value: float | None) -> str:
    """A time in the unit that suits it."""
    if value is None:
        return "–"
    if abs(value) >= 1000:
        return f"{value:.0f} s"
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if abs(value) >= scale:
            return f"{value / scale:.3g} {unit}"
    return f"{value / 1e-6:.3g} µs" if value else "0"


def percent(share: float | None) -> str:
    """A share in percent that says 100 only when nothing is missing."""
    if share is None:
        return "–"
    return f"{min(share * 100, 99.99 if share < 1 else 100.0):.4g} %"


def as_markdown(summaries: Sequence[Summary], scenarios: Facts) -> str:
    """One table for each scenario, with the command that reproduces each row."""
    parts = []
    for name, rows in by_scenario(summaries).items():
        settings, metrics = columns(rows)
        head = ["method", "solver", *settings, *metrics, "step (median)", "solve", "solved", "failed", "reproduce"]
        lines = [f"## {name}", "", _line(head), _line(["---"] * len(head))]
        for row in rows:
            cells = [row.method, row.solver, *(as_text(row.settings.get(key)) for key in settings)]
            cells += [number(row.metrics.get(key), row.metrics_se.get(key)) for key in metrics]
            cells += [seconds(row.time["step_median"]), seconds(row.time["solve"]), percent(solved_share(row.status))]
            failed = "impossible" if row.impossible else f"{row.failed}/{row.trials}"
            cells += [failed, f"`{command(row, scenarios)}`"]
            lines.append(_line(cells))
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def as_csv(summaries: Sequence[Summary], scenarios: Facts) -> str:
    """One line for each summary, numbers in full; settings and metrics are columns of their own."""
    settings = list(dict.fromkeys(key for row in summaries for key in row.settings))
    metrics = columns(summaries)[1]
    times = [*TIMES, *STEP_TIMES]
    statuses = list(summaries[0].status) if summaries else []
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    head = [
        "scenario",
        "method",
        "solver",
        "seed",
        "trials",
        "failed",
        "impossible",
        *(f"setting.{key}" for key in settings),
    ]
    for key in metrics:
        head += [f"metric.{key}", f"metric_se.{key}"]
    head += [f"time.{key}" for key in times] + ["step_max", "wall", "cpu", "memory", "iterations", "residual"]
    writer.writerow([*head, *(f"status.{key}" for key in statuses), "reproduce"])
    for row in summaries:
        cells: list[Any] = [row.scenario, row.method, row.solver, row.seed, row.trials, row.failed]
        cells.append(row.impossible)
        cells += [as_text(row.settings[key]) if key in row.settings else None for key in settings]
        for key in metrics:
            cells += [row.metrics.get(key), row.metrics_se.get(key)]
        cells += [row.time[key] for key in times] + [row.step_max, row.wall, row.cpu, row.memory]
        cells += [row.iterations, row.residual]
        writer.writerow([*cells, *row.status.values(), command(row, scenarios)])
    return buffer.getvalue()


def by_scenario(summaries: Sequence[Summary]) -> dict[str, list[Summary]]:
    """Summaries by scenario, in their order."""
    groups: dict[str, list[Summary]] = {}
    for summary in summaries:
        groups.setdefault(summary.scenario, []).append(summary)
    return groups


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
