"""horizonet demo: the main job on what comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from problems.bench.plan import built_in_plan
from problems.bench.report import page
from problems.bench.store import load
from problems.bench.summary import summarize
from problems.cli.bench import run_campaign
from problems.cli.output import print_failures, print_summaries
from problems.cli.report import save

PLAN = "quick"


def demo(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; results of an earlier demo in it are replaced.")
    ] = Path("demo"),
) -> None:
    """Solve an MHE window and a team localization in several forms and with several solvers; table and report.html."""
    rows = run_campaign(built_in_plan(PLAN), out, workers=1, fresh=True)
    results = load(out)
    print_summaries(summarize(rows))
    code = print_failures(rows, lambda job: results.scenarios[job.scenario]["settings"])
    save(out / "report.html", page(results))
    raise typer.Exit(code)
