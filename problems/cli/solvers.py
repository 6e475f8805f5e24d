"""horizonet solvers: which solver backends there are."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from problems import registry
from problems.cli.output import console, one_json_object, table
from problems.errors import MissingExtraError


def solvers(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Solver backends: available or not, forms they take, warm start, version."""
    with one_json_object(as_json) as give:
        found = [_facts(name) for name in registry.names("solvers")]
        give({"solvers": found})
    if as_json:
        return
    made = table(None, ["solver", "available", "version", "forms", "warm start"])
    for solver in found:
        extra = f'no: pip install "horizonet[{solver["extra"]}]"' if solver["extra"] else "no"
        made.add_row(
            solver["name"],
            "yes" if solver["available"] else extra,
            solver["version"] or "–",
            ", ".join(solver["forms"]),
            "yes" if solver["warm_start"] else "no",
        )
    console().print(made)


def _facts(name: str) -> dict[str, Any]:
    facts = {"name": name, "available": False, "version": None, "forms": [], "warm_start": False, "extra": None}
    try:
        backend = registry.load("solvers", name)
        facts |= {
            "forms": list(getattr(backend, "forms", ("quadratic",))),
            "warm_start": backend.warm_starts,
            "extra": backend.extra,
        }
        return facts | {"available": True, "version": backend.version()}
    except MissingExtraError as error:
        return facts | {"extra": error.extra or facts["extra"]}
