"""A solver's own settings as a typed dataclass, read from keyword settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from typing import Any, TypeVar

from problems.errors import SettingError, UnknownNameError

T = TypeVar("T")


def read_settings(kind: type[T], given: Mapping[str, Any], solver: str) -> T:
    """Raises SettingError naming the nearest valid setting."""
    names = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    for name in given:
        if name not in names:
            valid = names | {"tolerance", "time_limit", "iteration_limit"}  # which all solvers have
            raise SettingError(str(UnknownNameError(f"setting of solver {solver}", name, valid)))
    return kind(**given)


def own_version() -> str:
    """Version of this distribution."""
    try:
        return version("horizonet")
    except PackageNotFoundError:
        return "source"
