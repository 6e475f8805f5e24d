"""horizonet localize: estimate the trajectory of whatever a recording holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def localize(
    path: Annotated[Path, typer.Argument(help="Recording: a folder or file in a known layout.")],
    method: Annotated[
        list[str] | None,
        typer.Option(help="mhe, fixed_lag, ls, ml; may be repeated. By default mhe, of graphs ml."),
    ] = None,
    solver: Annotated[str, typer.Option(help="Solver of all methods.")] = "auto",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting; horizonet scenarios recording lists them."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of coarse fixes drawn around the truth.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Write the poses of the first method: .csv (with covariances), .tum, or .g2o for graphs."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw into this file (png, svg, pdf).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Localize a recording: UWB folders, MRCLAM folders, g2o and PyFG graphs.

    Prints errors where there is truth, ratios to published figures where there are any, and for graphs the measurements
    that contradict the others most.
    """
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
        wanted = {"covariance": True} if out is not None or plot is not None else {}
        values = complete(scenario, {"path": str(path)} | wanted | given)

        def planned(methods: list[str]) -> Any:
            return plan_of_names(
                ["recording"], methods, [solver], {k: [v] for k, v in values.items()}, seed=seed, trials=1
            )

        planned(method or [scenario.methods[0]])  # unknown names stop here
        checked = validated(scenario, values)
        drawn = scenario.draw(checked, trial_rng(seed, scenario.name, 0))  # an unreadable file stops here
        methods = method or [drawn.kind.methods[0]]
        for name in methods:
            scenario.require_method(drawn, name)
        _check_suffix(out, drawn)
        jobs = planned(methods).jobs()
        rows, outcomes = [], {}
        for row, outcome in progress(map(measure, jobs), len(jobs), "localize"):
            rows.append(row)
            if outcome is not None:
                outcomes[row.job.method] = outcome
        facts = describe(scenario)
        summaries = summarize(rows)
        edges = {m: getattr(o.trace, "edges", []) for m, o in outcomes.items()}
        told = [{"method": m, **edge} for m, listed in edges.items() for edge in listed]
        give(to_json(summaries, {"recording": facts}, 1, values) | ({"edges": told} if told else {}))
        if not as_json:
            print_summaries([_known(summary) for summary in summaries])
            _print_options(summaries)
            _print_edges(told)
        for warned in dict.fromkeys(warning for row in rows for warning in row.warnings):
            error_console().print(warned, style="yellow", soft_wrap=True)
        if out is not None and methods[0] in outcomes:
            for written in _write(out, drawn, outcomes[methods[0]].trace):
                error_console().print(f"poses of {methods[0]}: {written}", soft_wrap=True)
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
    if out is not None and out.suffix.lower() not in (".csv", ".tum", ".g2o"):
        raise SettingError(f"--out {out}: poses are written as .csv, .tum or .g2o")
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


def _check_suffix(out: Path | None, drawn: Any) -> None:
    from problems.errors import SettingError

    if out is not None and out.suffix.lower() not in drawn.kind.outputs:
        raise SettingError(f"--out {out}: poses of {drawn.kind.what} are written as {' or '.join(drawn.kind.outputs)}")


def _known(summary: Any) -> Any:
    """A summary without the metrics that its kind of recording does not have."""
    from dataclasses import replace

    return replace(summary, metrics={name: value for name, value in summary.metrics.items() if value is not None})


def _print_options(summaries: Any) -> None:
    """How each row was made: where it started, what was placed, how well it fits."""
    from problems.bench.settings import as_text
    from problems.cli.output import console

    for row in summaries:
        known = ", ".join(f"{key} {as_text(value)}" for key, value in row.options.items() if value is not None)
        console().print(f"{row.method}: {known}", soft_wrap=True)


def _print_edges(edges: list[dict[str, Any]]) -> None:
    from problems.bench.export import number
    from problems.cli.output import console, table

    if not edges:
        return
    keys = ("squared", "p_value", "weight", "redundancy", "statistic", "p_against_others")
    numeric = ("squared", "p", "weight", "redundancy", "against others", "p against others")
    made = table(
        "measurements that contradict the others most", ["method", "term", "row", "between", *numeric], numeric
    )
    for edge in edges:
        made.add_row(
            edge["method"], edge["term"], str(edge["row"]), " ".join(edge["between"]),
            *(number(edge[key]) for key in keys),
        )  # fmt: skip
    console().print(made)


def _write(path: Path, drawn: Any, made: Any) -> list[Path]:
    """Write poses by suffix; a TUM file holds one trajectory, so that several robots get a file each."""
    import numpy as np

    from localization.io import g2o
    from localization.io.poses import write_poses, write_tum
    from problems.errors import WriteError

    suffix = path.suffix.lower()
    try:
        if suffix == ".g2o":
            g2o.write(path, drawn.kind.localized(drawn.recording, made))
            return [path]
        poses = drawn.kind.poses(drawn.recording, made)
        if suffix == ".csv":
            write_poses(path, poses)
            return [path]
        tracks = drawn.kind.tracks(drawn.recording, poses)
        names = np.unique(tracks)
        if len(names) < 2:
            write_tum(path, poses)
            return [path]
        written = []
        for name in names:
            written.append(path.with_name(f"{path.stem}-{name}{path.suffix}"))
            write_tum(written[-1], poses.chosen(np.flatnonzero(tracks == name)))
        return written
    except OSError as error:
        raise WriteError(path, str(error)) from error
