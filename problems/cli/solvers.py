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
    """Solver backends: available or not, forms they take, warm start, version. NAME after a colon is one of theirs."""
    with one_json_object(as_json) as give:
        found = [_facts(name) for name in registry.names("solvers")]
        give({"solvers": [facts for facts, _, _ in found]})
    if as_json:
        return
    made = table(None, ["solver", "available", "version", "forms", "warm start"])
    for facts, missing, named in found:
        made.add_row(
            f"{facts['name']}:NAME" if named else facts["name"],
            "yes" if missing is None else f"no: {missing}",
            facts["version"] or "–",
            ", ".join(facts["forms"]),
            "yes" if facts["warm_start"] else "no",
        )
    console().print(made)


def _facts(name: str) -> tuple[dict[str, Any], str | None, bool]:
    """What the contract of ``--json`` says of a solver, why it cannot be used, and whether it takes a name."""
    named = False
    facts = {"name": name, "available": False, "version": None, "forms": [], "warm_start": False, "extra": None}
    try:
        backend = registry.load("solvers", name)
        named = bool(getattr(backend, "named", False))
        forms = list(getattr(backend, "forms", ("quadratic",)))
        facts |= {"forms": forms, "warm_start": backend.warm_starts, "extra": backend.extra}
        return facts | {"available": True, "version": backend.version()}, None, named
    except MissingExtraError as error:
        extra = error.extra or facts["extra"]
        reason = f'pip install "horizonet[{extra}]"' if extra else f"needs {error.package}"
        return facts | {"extra": extra}, reason, named
    except Exception as error:  # somebody else's broken backend hides nothing but itself
        return facts, str(error), named
