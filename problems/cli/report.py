"""horizonet report: what a benchmark found, as a table, a page, Markdown or CSV."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from problems.bench.export import as_csv, as_markdown
from problems.bench.export import as_json as to_json
from problems.bench.store import load
from problems.bench.summary import summarize
from problems.cli.output import error_console, one_json_object, print_failures, print_summaries
from problems.errors import WriteError


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder written by horizonet bench.")],
    html: Annotated[Path | None, typer.Option(help="Write a page that needs no network.")] = None,
    markdown: Annotated[Path | None, typer.Option(help="Write the tables as Markdown.")] = None,
    csv: Annotated[Path | None, typer.Option(help="Write one line for each row of the tables.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Show the results of a benchmark."""
    with one_json_object(as_json) as give:
        results = load(folder)
        summaries = summarize(results.rows)
        give(to_json(summaries, results.scenarios, results.plan["trials"], {}))
        if not as_json:
            print_summaries(summaries)
            print_failures(results.rows, lambda job: results.scenarios[job.scenario]["settings"])
        if html:
            from problems.bench.report import page

            save(html, page(results))
        if markdown:
            save(markdown, as_markdown(summaries, results.scenarios))
        if csv:
            save(csv, as_csv(summaries, results.scenarios))


def save(path: Path, text: str) -> None:
    """Write a text file and say so on standard error; raises `WriteError`."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise WriteError(path, str(error.strerror or error)) from error
    error_console().print(f"written: {path}", soft_wrap=True)
