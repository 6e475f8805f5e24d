"""horizonet run: one scenario, a few trials, results at once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from problems import registry
from problems.bench.export import as_json as to_json
from problems.bench.plan import AUTO, Plan, plan_of_names
from problems.bench.rows import Job, Row
from problems.bench.scenario import Outcome, Scenario, trial_rng
from problems.bench.settings import assignments, complete, describe, validated
from problems.bench.summary import summarize
from problems.bench.workers import LocalProcesses
from problems.cli.output import error_console, one_json_object, print_failures, print_summaries
from problems.cli.progress import progress
from problems.errors import WriteError


def run(
    scenario: Annotated[str, typer.Argument(help="Name of the scenario; see horizonet scenarios.")],
    method: Annotated[list[str] | None, typer.Option(help="Method to run, may be repeated; all by default.")] = None,
    solver: Annotated[str, typer.Option(help="Solver of all methods.")] = AUTO,
    settings: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting.")] = None,
    trials: Annotated[int, typer.Option(min=1, help="Number of trials, each with fresh noise.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="The noise of all trials follows from it.")] = 0,
    plot: Annotated[Path | None, typer.Option(help="Draw the first trial into this file (png, svg, pdf).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Run a scenario and print its metrics (mean ± standard error) and times (median)."""
    with one_json_object(as_json) as give:
        given = assignments(settings or [])
        plan = plan_of_names(
            [scenario], method or [], [solver], {key: [value] for key, value in given.items()}, seed=seed, trials=trials
        )
        if plot and not plot.absolute().parent.is_dir():
            raise WriteError(plot, "its folder does not exist")
        rows, outcomes = _run(plan, first_trial=plot is not None)
        world: Scenario = registry.load("scenarios", scenario)
        values, facts = complete(world, given), describe(world)
        summaries = summarize(rows)
        give(to_json(summaries, {scenario: facts}, trials, values))
        if not as_json:
            print_summaries(summaries)
        if plot and outcomes:
            _draw(world, values, seed, outcomes, plot)
        code = print_failures(rows, lambda job: facts["settings"])
    raise typer.Exit(code)


def _run(plan: Plan, first_trial: bool) -> tuple[list[Row], dict[str, Outcome]]:
    jobs = plan.jobs()
    keep = [job.key for job in jobs if job.trial == 0] if first_trial else []
    rows, outcomes = [], {}
    for row, outcome in progress(LocalProcesses().run(jobs, keep=keep), len(jobs), plan.study[0].scenario):
        rows.append(row)
        if outcome is not None:
            outcomes[row.job.method] = outcome
    return _in_order(rows, jobs), outcomes


def _in_order(rows: list[Row], jobs: list[Job]) -> list[Row]:
    place = {job.key: number for number, job in enumerate(jobs)}
    return sorted(rows, key=lambda row: place[row.job.key])


def _draw(scenario: Scenario, settings: dict[str, Any], seed: int, outcomes: dict[str, Outcome], path: Path) -> None:
    checked = validated(scenario, settings)
    drawn = scenario.draw(checked, trial_rng(seed, scenario.name, 0))
    figure = scenario.plot(checked, drawn, outcomes)
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise WriteError(path, str(error)) from error
    error_console().print(f"picture: {path}", soft_wrap=True)
