"""Settings of a scenario as people give them: text from a command line or values from a TOML file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pydantic
from pydantic_core import to_jsonable_python

from problems.bench.scenario import Scenario
from problems.errors import SettingError, UnknownNameError


def convert(scenario: Scenario, key: str, value: Any) -> Any:
    """One setting as the scenario's model takes it.

    Args:
        scenario: whose setting it is.
        key: name of the setting.
        value: a value, or text that reads as one ("1e-6", "on", "[1, 2]").

    Returns:
        The value, JSON types only.

    Raises:
        UnknownNameError: the scenario has no such setting.
        SettingError: the setting cannot take the value.
    """
    model = scenario.settings
    if key not in model.model_fields:
        raise UnknownNameError(f"setting of {scenario.name}", key, model.model_fields)
    problem = ""
    for candidate in _readings(value):
        try:
            accepted = model.model_validate({key: candidate})
        except pydantic.ValidationError as error:
            wrong = [item["msg"] for item in error.errors() if item["loc"] and item["loc"][0] == key]
            if not wrong:  # another setting is missing or at odds with this one: `complete` judges the whole
                return candidate
            problem = wrong[0]
        else:
            return accepted.model_dump(mode="json")[key]
    raise SettingError(f"setting {key} of {scenario.name} cannot be {value!r}: {problem}")


def complete(scenario: Scenario, given: Mapping[str, Any]) -> dict[str, Any]:
    """All settings of a scenario, defaults included, as JSON types; raises as `convert` does."""
    converted = {key: convert(scenario, key, value) for key, value in given.items()}
    return validated(scenario, converted).model_dump(mode="json")


def validated(scenario: Scenario, settings: Mapping[str, Any]) -> pydantic.BaseModel:
    """The scenario's own settings object; raises `SettingError` when settings contradict each other."""
    try:
        return scenario.settings.model_validate(dict(settings))
    except pydantic.ValidationError as error:
        problems = "; ".join(f"{'.'.join(map(str, item['loc']))} {item['msg']}".strip() for item in error.errors())
        raise SettingError(f"settings of {scenario.name}: {problems}") from error


def describe(scenario: Scenario) -> dict[str, Any]:
    """What people and reports need to know of a scenario (JSON types).

    Returns:
        "name", "methods", "settings" (default by name, None where a value must be given), "metrics" and "source".
    """
    fields = scenario.settings.model_fields
    return {
        "name": scenario.name,
        "methods": list(scenario.methods),
        "settings": {
            key: None if info.is_required() else to_jsonable_python(info.get_default(call_default_factory=True))
            for key, info in fields.items()
        },
        "metrics": list(scenario.metrics),
        "source": scenario.source,
    }


def as_text(value: Any) -> str:
    """The text after ``--set key=`` that reads back as this value."""
    return value if isinstance(value, str) else json.dumps(value)


def _readings(value: Any) -> list[Any]:
    """What a text can mean: the JSON value it spells, else itself (a setting of text "1" refuses the number 1)."""
    if not isinstance(value, str):
        return [value]
    try:
        return [json.loads(value), value]
    except ValueError:
        return [value]


def split(text: str) -> list[str]:
    """Values of a sweep ``V1,V2,...``; commas inside brackets or braces belong to a value."""
    values, depth, start = [], 0, 0
    for position, character in enumerate(text):
        depth += (character in "[{(") - (character in "]})")
        if character == "," and depth == 0:
            values.append(text[start:position])
            start = position + 1
    return [*values, text[start:]]


def assignments(pairs: list[str]) -> dict[str, str]:
    """``KEY=VALUE`` texts of a command line as a dictionary; raises `SettingError` for a text without ``=``."""
    given: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key:
            raise SettingError(f"--set expects KEY=VALUE, got {pair!r}")
        if key in given:
            raise SettingError(f"--set gives {key} twice: {given[key]!r} and {value!r}")
        given[key.strip()] = value
    return given
