"""horizonet localize: estimate the trajectory of whatever a recording holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def localize(
    path: Annotated[Path, typer.Argument(help="Recording: a folder or file in a known layout.")],
    method: Annotated[
        list[str] | None, typer.Option(help="mhe, fixed_lag, ls, ml; may be repeated; mhe by default.")
    ] = None,
    solver: Annotated[str, typer.Option(help="Solver of all methods.")] = "auto",
    settings: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of coarse fixes drawn around the truth.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Write the poses of the first method: .csv or .tum.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw into this file (png, svg, pdf).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Localize a recording; print errors where there is truth, and ratios to published figures where there are any."""
    from problems import registry
    from problems.bench.export import as_json as to_json
    from problems.bench.measure import measure
    from problems.bench.plan import plan_of_names
    from problems.bench.scenario import trial_rng
    from problems.bench.settings import assignments, complete, describe, validated
    from problems.bench.summary import summarize
    from problems.cli.output import one_json_object, print_failures, print_summaries
    from problems.errors import SettingError, WriteError

    if out is not None and out.suffix not in (".csv", ".tum"):
        raise SettingError(f"--out {out}: poses are written as .csv or .tum")
    for target in (out, plot):
        if target is not None and not target.absolute().parent.is_dir():
            raise WriteError(target, "its folder does not exist")
    with one_json_object(as_json) as give:
        given = {"path": str(path)} | assignments(settings or [])
        scenario = registry.load("scenarios", "recording")
        values = complete(scenario, given | ({"covariance": True} if out is not None else {}))
        checked = validated(scenario, values)
        drawn = scenario.draw(checked, trial_rng(seed, scenario.name, 0))  # an unreadable file stops here
        methods = method or [scenario.methods[0]]
        plan = plan_of_names(["recording"], methods, [solver], {k: [v] for k, v in values.items()}, seed=seed, trials=1)
        rows, outcomes = [], {}
        for job in plan.jobs():
            row, outcome = measure(job)
            rows.append(row)
            if outcome is not None:
                outcomes[job.method] = outcome
        facts = describe(scenario)
        summaries = summarize(rows)
        give(to_json(summaries, {"recording": facts}, 1, values))
        if not as_json:
            print_summaries(summaries)
        if out is not None and methods[0] in outcomes:
            _write(out, outcomes[methods[0]].trace)
        if plot is not None and outcomes:
            scenario.plot(checked, drawn, outcomes).savefig(plot, dpi=150)
        failed = print_failures(rows, lambda job: facts["settings"])
    if failed:
        raise typer.Exit(1)


def _write(path: Path, made: Any) -> None:
    """Poses of a planar track; a tag has no heading."""
    import numpy as np

    from localization.io.poses import Poses, write_poses, write_tum

    count = len(made.estimate)
    covariance = None
    if made.covariance is not None:
        covariance = np.full((count, 3, 3), np.nan)
        covariance[:, :2, :2] = made.covariance[:, :2, :2]
    poses = Poses(
        made.estimate.time, np.full(count, "tag"), made.estimate.value, np.full((count, 1), np.nan), covariance
    )
    (write_tum if path.suffix == ".tum" else write_poses)(path, poses)
