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
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting; horizonet scenarios recording lists them."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of coarse fixes drawn around the truth.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Write the poses of the first method, with the recording's stamps in s: .csv or .tum."),
    ] = None,
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
    from problems.cli.output import error_console, one_json_object, print_failures, print_summaries
    from problems.cli.progress import progress
    from problems.errors import SettingError

    _check_targets(out, plot)
    with one_json_object(as_json) as give:
        given = assignments(settings or [])
        if "path" in given:
            raise SettingError(f"the recording is the argument {path}; --set path={given['path']} names another")
        scenario = registry.load("scenarios", "recording")
        values = complete(scenario, {"path": str(path)} | given | ({"covariance": True} if out is not None else {}))
        methods = method or [scenario.methods[0]]
        plan = plan_of_names(["recording"], methods, [solver], {k: [v] for k, v in values.items()}, seed=seed, trials=1)
        jobs = plan.jobs()  # unknown names stop here
        checked = validated(scenario, values)
        drawn = scenario.draw(checked, trial_rng(seed, scenario.name, 0))  # an unreadable file stops here
        rows, outcomes = [], {}
        for row, outcome in progress(map(measure, jobs), len(jobs), "localize"):
            rows.append(row)
            if outcome is not None:
                outcomes[row.job.method] = outcome
        facts = describe(scenario)
        summaries = summarize(rows)
        give(to_json(summaries, {"recording": facts}, 1, values))
        if not as_json:
            print_summaries(summaries)
        for told in dict.fromkeys(warning for row in rows for warning in row.warnings):
            error_console().print(told, style="yellow", soft_wrap=True)
        if out is not None and methods[0] in outcomes:
            _write(out, drawn.recording, outcomes[methods[0]].trace)
            error_console().print(f"poses of {methods[0]}: {out}", soft_wrap=True)
        if plot is not None and outcomes:
            _draw(plot, scenario.plot(checked, drawn, outcomes))
            error_console().print(f"picture: {plot}", soft_wrap=True)
        failed = print_failures(rows, lambda job: facts["settings"])
    if failed:
        raise typer.Exit(1)


def _check_targets(out: Path | None, plot: Path | None) -> None:
    """Refuse what cannot be written before any work is done."""
    from problems.errors import SettingError, WriteError

    for target in (out, plot):
        if target is not None and not target.absolute().parent.is_dir():
            raise WriteError(target, "its folder does not exist")
    if out is not None and out.suffix.lower() not in (".csv", ".tum"):
        raise SettingError(f"--out {out}: poses are written as .csv or .tum")
    if plot is not None:
        from matplotlib.backend_bases import FigureCanvasBase

        known = FigureCanvasBase.get_supported_filetypes()
        if plot.suffix.lower().removeprefix(".") not in known:
            raise SettingError(f"--plot {plot}: pictures are written as {', '.join('.' + name for name in known)}")


def _draw(path: Path, figure: Any) -> None:
    from problems.errors import WriteError

    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise WriteError(path, str(error)) from error


def _write(path: Path, recording: Any, made: Any) -> None:
    """Poses of a planar track; a tag has no heading."""
    import numpy as np

    from localization.io.poses import Poses, write_poses, write_tum
    from problems.errors import WriteError

    count = len(made.estimate)
    covariance = None
    if made.covariance is not None:
        covariance = np.full((count, 3, 3), np.nan)
        covariance[:, :2, :2] = made.covariance
    stamps = recording.start * 1e-9 + made.estimate.time
    poses = Poses(stamps, np.full(count, "tag"), made.estimate.value, np.full((count, 1), np.nan), covariance)
    try:
        (write_tum if path.suffix.lower() == ".tum" else write_poses)(path, poses)
    except OSError as error:
        raise WriteError(path, str(error)) from error
