"""One self-contained page from the rows of a benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any

from problems.bench import compare, plots
from problems.bench.export import by_scenario, columns, command, number, percent, seconds
from problems.bench.html import Cell, command_cell, marks, number_cell, picture, table, text_cell
from problems.bench.metrics import solved_share
from problems.bench.rows import Row
from problems.bench.scenario import NO_SOLVER
from problems.bench.settings import as_text
from problems.bench.store import Results
from problems.bench.summary import Summary, configuration, reproduce, summarize

COMPARISONS_SHOWN = 200

DISTANCE = "distance_to_reference"


def page(results: Results) -> str:
    """The report as HTML; it needs no network and no other file.

    Args:
        results: rows and sessions of a folder.
    """
    summaries = summarize(results.rows)
    sections = [_head(results, summaries), _filters(summaries)]
    for number_of, (name, rows) in enumerate(by_scenario(summaries).items()):
        own = [row for row in results.rows if row.job.scenario == name]
        sections.append(_scenario(f"s{number_of}", name, rows, own, results))
    sections += [_failures(results), _circumstances(results.sessions)]
    assets = resources.files("problems.bench") / "page"
    style, script = ((assets / f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    body = "\n".join(sections)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(results.plan["name"])}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<style>{style}</style></head>\n<body>{body}\n<script>{script}</script></body></html>\n"
    )


def _head(results: Results, summaries: Sequence[Summary]) -> str:
    plan, failed = results.plan, sum(row.failure is not None for row in results.rows)
    paragraphs = [" ".join(part.split()) for part in plan["text"].split("\n\n") if part.strip()]
    facts = f"{len(results.rows)} trials of {len(summaries)} configurations, {failed} failed; seed {plan['seed']}."
    return "\n".join(
        [
            f"<h1>{escape(plan['name'])}</h1>",
            f'<p class="muted">{escape(facts)} Started {escape(results.sessions[0]["started"])}.</p>',
            *(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs),
            "<p>Metrics are means over the finished trials, ± their standard error; times are medians. All methods"
            " and solvers of a trial met the same noise. Statuses follow from residuals recomputed outside of the"
            " solver.</p>",
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
        groups.append(f"<fieldset><legend>{name.capitalize()}</legend>{boxes}</fieldset>")
    return f'<form class="filters">{"".join(groups)}<span id="shown" role="status" class="muted"></span></form>'


def _scenario(prefix: str, name: str, summaries: Sequence[Summary], rows: Sequence[Row], results: Results) -> str:
    facts = results.scenarios[name]
    settings, metrics = columns(summaries)
    main = [metric for metric in facts["metrics"] if metric in metrics]
    shown = [*main, *(metric for metric in metrics if metric not in main)]
    parts = [f"<h2>{escape(name)}</h2>", f'<p class="muted">{escape(facts["source"])}</p>']
    # where tolerances are swept, what they buy is the distance to the optimum: that curve comes first
    swept = DISTANCE in shown and "tolerance" in settings
    drawn = [DISTANCE, *(metric for metric in shown if metric != DISTANCE)] if swept else shown
    pictures = [_accuracy(f"{prefix}m{place}", metric, summaries, settings) for place, metric in enumerate(drawn)]
    pictures = [each for each in pictures if each]
    open_ones = 2 if swept else 1
    parts += pictures[:open_ones]
    if pictures[open_ones:]:
        rest = "".join(pictures[open_ones:])
        parts.append(f"<details><summary>The other metrics against time</summary>{rest}</details>")
    parts.append(_results(name, summaries, settings, shown, results.scenarios))
    limit = results.plan["time_limit"]
    parts += [_solver_times(rows, limit), _profile(rows)]
    if main:
        pairs = [
            *compare.method_differences(rows, main[0], facts["methods"]),
            *compare.solver_differences(rows, main[0]),
        ]
        parts.append(_differences(main[0], pairs, settings))
    return "\n".join(part for part in parts if part)


def _accuracy(prefix: str, metric: str, summaries: Sequence[Summary], settings: Sequence[str]) -> str:
    if not any(summary.metrics.get(metric) is not None and plots.time_of(summary)[0] for summary in summaries):
        return ""
    points = []
    for summary in summaries:
        varied_here = ", ".join(f"{key}={as_text(summary.settings[key])}" for key in settings)
        value = number(summary.metrics.get(metric), summary.metrics_se.get(metric))
        hover = f"{summary.label} {varied_here}\n{metric} {value}\n{seconds(plots.time_of(summary)[0])}"
        points.append((summary, f"{hover}\n{percent(solved_share(summary.status))} solved"))
    figure = plots.accuracy_against_time(summaries, metric, prefix)
    caption = (
        f"{metric} against time. Bars are standard errors; lines join tolerances and iteration limits of one method."
    )
    return picture(figure, caption, prefix, points)


def _results(
    name: str, summaries: Sequence[Summary], settings: Sequence[str], metrics: Sequence[str], facts: Mapping[str, Any]
) -> str:
    head = [
        "method",
        "solver",
        *settings,
        *metrics,
        "step (median)",
        "step (p95)",
        "update",
        "solve",
        "setup",
        "compile",
    ]
    head += ["cpu", "memory", "solved", "iterations", "residual", "failed", "reproduce"]
    rows = []
    for summary in summaries:
        cells = [text_cell(summary.method), text_cell(summary.solver)]
        cells += [_setting(summary.settings.get(key)) for key in settings]
        for metric in metrics:
            value = summary.metrics.get(metric)
            cells.append(number_cell(number(value, summary.metrics_se.get(metric)), value))
        for key in ("step_median", "step_p95", "update", "solve", "setup", "compile"):
            cells.append(number_cell(seconds(summary.time[key]), summary.time[key]))
        share, memory = solved_share(summary.status), summary.memory
        cells += [
            number_cell(seconds(summary.cpu), summary.cpu),
            number_cell("–" if memory is None else f"{memory / 2**20:.1f} MiB", memory),
            number_cell(percent(share), share),
            number_cell(number(summary.iterations), summary.iterations),
            number_cell("–" if summary.residual is None else f"{summary.residual:.1e}", summary.residual),
            number_cell(f"{summary.failed}/{summary.trials}", summary.failed / summary.trials),
            command_cell(command(summary, facts)),
        ]
        rows.append(({"class": "result"} | marks(summary), cells))
    return "<h3>Results</h3>" + table(f"Results of {name}", head, rows)


def _setting(value: Any) -> Cell:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return number_cell(as_text(value), float(value)) if is_number else text_cell(as_text(value))


def _solver_times(rows: Sequence[Row], limit: float) -> str:
    times = compare.solver_times(rows, limit)
    if len(times) < 2:
        return ""
    body = [
        (
            {},
            [
                text_cell(item.solver),
                number_cell(seconds(item.geometric_mean), item.geometric_mean),
                number_cell(f"{item.geometric_mean / times[0].geometric_mean:.3g}", item.geometric_mean),
                number_cell(f"{item.failed}/{item.trials}", item.failed / item.trials),
            ],
        )
        for item in times
    ]
    caption = (
        f"Shifted geometric mean (shift {seconds(compare.SHIFT)}) of the solve time of a trial over all methods and"
        f" settings. A trial without result, or with more than {compare.UNSOLVED_SHARE:.0%} of its steps neither solved"
        f" nor found infeasible, failed and counts as {seconds(limit)}."
    )
    return "<h3>Solvers</h3>" + table(caption, ["solver", "geometric mean", "ratio to the fastest", "failed"], body)


def _profile(rows: Sequence[Row]) -> str:
    profiles = compare.solver_profile(rows)
    if not profiles:
        return ""
    caption = "Share of trials each solver finished within a factor of the fastest one (failed trials never)."
    return picture(plots.profile(profiles), caption)


def _differences(metric: str, pairs: Sequence[compare.Comparison], settings: Sequence[str]) -> str:
    if not pairs:
        return ""
    body = []
    for pair in pairs[:COMPARISONS_SHOWN]:
        difference = pair.difference
        cells = [text_cell(pair.what), text_cell(pair.baseline), text_cell(pair.fixed.replace(NO_SOLVER, "–"))]
        cells += [_setting(pair.settings.get(key)) for key in settings]
        cells += [
            number_cell(number(difference.mean), difference.mean),
            text_cell(f"[{number(difference.lower)}, {number(difference.upper)}]"),
            text_cell("yes" if difference.significant else "no"),
            number_cell(str(difference.pairs), difference.pairs),
        ]
        body.append(({}, cells))
    caption = f"Differences of {metric}, trial by trial, with 95 % confidence intervals (Student's t)."
    if len(pairs) > COMPARISONS_SHOWN:
        caption += f" The first {COMPARISONS_SHOWN} of {len(pairs)}."
    head = ["compared", "with", "both with", *settings, "mean difference", "interval", "differs", "pairs"]
    return "<details><summary>Paired differences</summary>" + table(caption, head, body) + "</details>"


def _failures(results: Results) -> str:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in results.rows:
        if row.failure is not None:
            groups.setdefault((configuration(row.job), row.failure.message), []).append(row)
    warned: dict[str, int] = {}
    for row in results.rows:
        for message in row.warnings:
            warned[message] = warned.get(message, 0) + 1
    parts = ["<h2>Failures</h2>"]
    body = []
    for rows in groups.values():
        job, failure = rows[0].job, rows[0].failure
        assert failure is not None
        trace = f"<details><summary>traceback</summary><pre>{escape(failure.traceback)}</pre></details>"
        told = f"{escape(f'{failure.kind}: {failure.message}')}{trace if failure.traceback else ''}"
        line = reproduce(job, results.scenarios[job.scenario]["settings"])
        cells = [text_cell(job.scenario), text_cell(job.method), text_cell(job.solver), Cell(told, wrap=True)]
        cells += [number_cell(str(len(rows)), len(rows)), command_cell(line)]
        body.append(({"data-method": job.method, "data-solver": job.solver}, cells))
    if body:
        head = ["scenario", "method", "solver", "message", "trials", "reproduce the first"]
        parts.append(table("Trials without a result", head, body))
    else:
        parts.append("<p>Every trial finished.</p>")
    if warned:
        rows = [({}, [text_cell(message, wrap=True), number_cell(str(n), n)]) for message, n in warned.items()]
        parts.append(table("Warnings", ["warning", "trials"], rows))
    return "\n".join(parts)


def _circumstances(sessions: Sequence[Mapping[str, Any]]) -> str:
    parts = ["<h2>Machine and versions</h2>"]
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
