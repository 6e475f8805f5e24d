"""horizonet bench: a campaign that can be interrupted and resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from problems import registry
from problems.bench.export import as_json as to_json
from problems.bench.plan import Plan, built_in_plan, built_in_plans, plan_of_names, read_plan
from problems.bench.rows import Row
from problems.bench.run import missing, run_plan
from problems.bench.settings import assignments, describe, split
from problems.bench.store import Store, load
from problems.bench.summary import summarize
from problems.bench.workers import LocalProcesses
from problems.cli.output import error_console, one_json_object, print_failures, print_summaries
from problems.cli.progress import progress
from problems.errors import SettingError, UnknownNameError


def bench(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENARIO...|PLAN",
            help=f"Scenarios, a TOML file, or a built-in plan: {', '.join(built_in_plans())}.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the results; an interrupted run in it is resumed.")],
    method: Annotated[list[str] | None, typer.Option(help="Method to run, may be repeated; all by default.")] = None,
    solver: Annotated[list[str] | None, typer.Option(help="Solver, may be repeated; auto by default.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=V1,V2,...", help="Values of a setting to sweep.")
    ] = None,
    trials: Annotated[
        int | None, typer.Option(min=1, help="Number of trials, each with fresh noise; default 10.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="The noise of all trials follows from it; default 0.")] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=0, help="Processes of one thread each. More are faster, but then they share caches and times suffer."
        ),
    ] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Compare methods and solvers over many trials; rows that are already in the folder are not run again."""
    with one_json_object(as_json) as give:
        values = {key: split(text) for key, text in assignments(settings or []).items()}
        plan = _plan(what, method or [], solver or [], values)
        plan = plan.model_copy(update={k: v for k, v in (("trials", trials), ("seed", seed)) if v is not None})
        rows = run_campaign(plan, out, workers)
        facts = {study.scenario: describe(registry.load("scenarios", study.scenario)) for study in plan.study}
        summaries = summarize(rows)
        give(to_json(summaries, facts, plan.trials, values))
        if not as_json:
            print_summaries(summaries)
        code = print_failures(rows, lambda job: facts[job.scenario]["settings"])
        error_console().print(
            f"results in {out}; horizonet report {out} --html FILE makes a page of them", soft_wrap=True
        )
    raise typer.Exit(code)


def _plan(what: list[str], methods: list[str], solvers: list[str], values: dict[str, list[str]]) -> Plan:
    known, plans = registry.names("scenarios"), built_in_plans()
    if len(what) > 1:
        for name in what:
            if name not in known and (name in plans or name.endswith(".toml")):
                raise SettingError(f"a plan is run alone: {name} with {', '.join(n for n in what if n != name)}")
    elif what[0] not in known and not what[0].endswith(".toml") and what[0] not in plans:
        raise UnknownNameError("scenario or plan", what[0], [*known, *plans])
    elif what[0] not in known:
        if methods or solvers or values:
            raise SettingError(f"--method, --solver and --set go with scenarios; the plan {what[0]} states its own")
        return read_plan(what[0]) if what[0].endswith(".toml") else built_in_plan(what[0])
    return plan_of_names(what, methods, solvers, values)


def run_campaign(plan: Plan, folder: Path, workers: int, fresh: bool = False) -> list[Row]:
    """Run what is missing in the folder, showing progress on standard error.

    Returns:
        The rows of the whole plan, those of earlier runs included, in the plan's order.
    """
    jobs = plan.jobs()
    with Store(folder, fresh) as store:
        left = missing(jobs, store)
        if len(left) < len(jobs):
            error_console().print(
                f"{len(jobs) - len(left)} of {len(jobs)} rows are in {folder} already", soft_wrap=True
            )
        try:
            for _ in progress(run_plan(plan, store, LocalProcesses(workers)), len(left), plan.name):
                pass
        except KeyboardInterrupt:
            error_console().print("stopped; the same command goes on where it was", soft_wrap=True)
            raise
    found = {row.job.key: row for row in load(folder).rows}
    return [found[job.key] for job in jobs]
