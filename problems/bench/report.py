"""One self-contained page from the rows of a benchmark."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any

from problems.bench.export import by_scenario
from problems.bench.html import Cell, command_cell, number_cell, prose, table, text_cell
from problems.bench.rows import Row
from problems.bench.section import ScenarioSection
from problems.bench.settings import as_text
from problems.bench.store import Results
from problems.bench.summary import Summary, by_configuration, configuration, reproduce, summarize

FAILURES_SHOWN = 100
TRACEBACK_SHOWN = 4000  # characters, the last ones


def page(results: Results) -> str:
    """The report as HTML; it needs no network and no other file.

    Args:
        results: rows and sessions of a folder.
    """
    rows = by_configuration(_in_order(results))
    summaries = summarize(row for group in rows.values() for row in group)
    scenarios = by_scenario(summaries)
    sections = [_head(results, summaries), _filters(summaries)]
    for number_of, (name, own) in enumerate(scenarios.items()):
        section = ScenarioSection(f"s{number_of}", name, own, rows, results, len(scenarios))
        sections.append(section.html())
    sections += [_failures(results), _circumstances(results.sessions)]
    assets = resources.files("problems.bench") / "page"
    style, script = ((assets / f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    body = "\n".join(sections)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(results.plan["name"])}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<style>{style}</style></head>\n<body>{body}\n<script>{script}</script></body></html>\n"
    )


def _in_order(results: Results) -> list[Row]:
    """Rows as the plans name scenarios, methods and solvers; workers finish them in any order."""
    studies = [study for session in results.sessions for study in session["plan"]["study"]]
    scenarios = {name: place for place, name in reversed(list(enumerate(study["scenario"] for study in studies)))}
    solvers = [solver for study in studies for solver in study["solvers"]]

    def place(row: Row) -> tuple[Any, ...]:
        job, methods = row.job, results.scenarios[row.job.scenario]["methods"]
        values = tuple(
            (str(type(value)), -value if isinstance(value, bool | float) else value) for value in _plain(job.settings)
        )
        solver = solvers.index(job.solver) if job.solver in solvers else -1
        return scenarios.get(job.scenario, -1), methods.index(job.method), solver, values, job.seed, job.trial

    return sorted(results.rows, key=place)


def _plain(settings: Mapping[str, Any]) -> list[Any]:
    return [value if isinstance(value, int | float | str) else as_text(value) for value in settings.values()]


def _head(results: Results, summaries: Sequence[Summary]) -> str:
    plan, failed = results.plan, sum(summary.failed for summary in summaries)
    impossible = sum(summary.impossible for summary in summaries)
    facts = f"{len(results.rows)} trials of {len(summaries)} configurations, {failed} failed; seed {plan['seed']}."
    if impossible:
        facts += f" {impossible} trials belong to pairings of method and solver that do not exist."
    contents = "".join(
        f'<li><a href="#s{number_of}">{escape(name)}</a></li>' for number_of, name in enumerate(by_scenario(summaries))
    )
    return "\n".join(
        [
            f"<h1>{escape(plan['name'])}</h1>",
            f'<p class="muted">{escape(facts)} Started {escape(results.sessions[0]["started"])}.</p>',
            prose(plan["text"]),
            "<p>Metrics are means over the finished trials, ± their standard error; times are medians. All methods"
            " and solvers of a trial met the same noise. Statuses follow from residuals recomputed outside of the"
            " solver.</p>",
            f'<nav aria-label="contents"><ul class="contents">{contents}<li><a href="#failures">Failures</a></li>'
            '<li><a href="#machine">Machine and versions</a></li></ul></nav>',
        ]
    )


def _filters(summaries: Sequence[Summary]) -> str:
    groups = []
    for name in ("method", "solver"):
        values = dict.fromkeys(getattr(summary, name) for summary in summaries)
        boxes = "".join(
            f'<label><input type="checkbox" name="{name}" value="{escape(value)}" checked> {escape(value)}</label>'
            for value in values
        )
        groups.append(
            f"<fieldset><legend>{name.capitalize()}</legend>"
            f'<button type="button" class="all">all</button><button type="button" class="none">none</button>{boxes}'
            "</fieldset>"
        )
    return f'<form class="filters">{"".join(groups)}<span id="shown" role="status" class="muted"></span></form>'


def _failures(results: Results) -> str:
    parts = ['<h2 id="failures">Failures</h2>']
    broken = [row for row in results.rows if row.failure is not None and not row.impossible]
    impossible = [row for row in results.rows if row.impossible]
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in broken:
        assert row.failure is not None
        groups.setdefault((configuration(row.job), row.failure.message), []).append(row)
    if broken:
        head = ["scenario", "method", "solver", "message", "trials", "reproduce the first"]
        body = [
            (_marks(rows[0]), _failure(rows, results, trace=True)) for rows in list(groups.values())[:FAILURES_SHOWN]
        ]
        note = f"The first {FAILURES_SHOWN} of {len(groups)}." if len(groups) > FAILURES_SHOWN else ""
        parts.append(table("Trials without a result", head, body, note))
    else:
        parts.append(
            "<p>Every trial finished.</p>" if not impossible else "<p>Every trial that can exist finished.</p>"
        )
    groups = {}
    for row in impossible:
        groups.setdefault((row.job.scenario, row.job.method, row.job.solver), []).append(row)
    if impossible:
        head = ["scenario", "method", "solver", "why", "trials", "see it"]
        body = [
            (_marks(rows[0]), _failure(rows, results, trace=False)) for rows in list(groups.values())[:FAILURES_SHOWN]
        ]
        parts.append(table("Pairings that do not exist", head, body))
    warned = Counter(message for row in results.rows for message in row.warnings)
    if warned:
        body = [
            ({}, [text_cell(message, wrap=True), number_cell(str(n), n)])
            for message, n in list(warned.items())[:FAILURES_SHOWN]
        ]
        note = f"The first {FAILURES_SHOWN} of {len(warned)}." if len(warned) > FAILURES_SHOWN else ""
        parts.append(table("Warnings", ["warning", "trials"], body, note))
    return "\n".join(parts)


def _marks(row: Row) -> dict[str, str]:
    return {"data-method": row.job.method, "data-solver": row.job.solver}


def _failure(rows: Sequence[Row], results: Results, trace: bool) -> list[Cell]:
    job, failure = rows[0].job, rows[0].failure
    assert failure is not None
    told = escape(f"{failure.kind}: {failure.message}")
    if trace and failure.traceback:
        shown = escape(failure.traceback[-TRACEBACK_SHOWN:])
        told += f"<details><summary>traceback</summary><pre>{shown}</pre></details>"
    line = reproduce(job, results.scenarios[job.scenario]["settings"])
    cells = [text_cell(job.scenario), text_cell(job.method), text_cell(job.solver), Cell(told, wrap=True)]
    return [*cells, number_cell(str(len(rows)), len(rows)), command_cell(line)]


def _circumstances(sessions: Sequence[Mapping[str, Any]]) -> str:
    parts = ['<h2 id="machine">Machine and versions</h2>']
    for session in sessions:
        machine = session["machine"]
        threads = ", ".join(f"{name}={value or 'unset'}" for name, value in machine["threads"].items())
        facts = (
            f"{machine['processor']}, {machine['cores']} cores; {machine['system']}; Python {machine['python']};"
            f" {machine['workers']} worker process(es); {threads}"
        )
        versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
        parts.append(f"<p><strong>{escape(session['started'])}</strong> {escape(facts)}.</p>")
        parts.append(f'<p class="muted">{escape(versions)}</p>')
    return "\n".join(parts)
