"""horizonet scenarios: what can be run."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from problems import registry
from problems.bench.scenario import Scenario
from problems.bench.settings import as_text, describe
from problems.cli.output import console, error_console, one_json_object, table


def scenarios(
    name: Annotated[str | None, typer.Argument(help="Show the settings of this scenario.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Scenarios with their methods, metrics, settings and source."""
    with one_json_object(as_json) as give:
        loaded = [registry.load("scenarios", name)] if name else _all()
        give({"scenarios": [describe(scenario) for scenario in loaded]})
    if as_json:
        return
    made = table(None, ["scenario", "methods", "metrics", "source"])
    for scenario in loaded:
        made.add_row(scenario.name, " ".join(scenario.methods), " ".join(scenario.metrics), scenario.source)
    console().print(made)
    if name:
        console().print(_settings_table(loaded[0]))


def _all() -> list[Scenario]:
    """Every scenario that can be loaded; a broken package of somebody else hides its own scenarios only."""
    loaded = []
    for name in registry.names("scenarios"):
        try:
            loaded.append(registry.load("scenarios", name))
        except Exception as error:
            error_console().print(f"scenario {name} cannot be loaded: {error}", style="red", soft_wrap=True)
    return loaded


def _settings_table(scenario: Scenario) -> Any:
    made = table("Settings (--set KEY=VALUE)", ["setting", "default", "type", "meaning"])
    values = describe(scenario)["settings"]
    properties = scenario.settings.model_json_schema().get("properties", {})
    for key, info in scenario.settings.model_fields.items():
        default = "required" if info.is_required() else as_text(values[key])
        made.add_row(key, default, _type(properties.get(key, {})), info.description or "")
    return made


def _type(schema: dict[str, Any]) -> str:
    """A JSON schema in few words."""
    if "enum" in schema:
        return "|".join(as_text(value) for value in schema["enum"])
    if "const" in schema:
        return as_text(schema["const"])
    if "anyOf" in schema:
        return "|".join(_type(option) for option in schema["anyOf"])
    limits = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    words = [schema.get("type", "any"), *(f"{sign} {schema[key]:g}" for key, sign in limits.items() if key in schema)]
    return " ".join(words)
