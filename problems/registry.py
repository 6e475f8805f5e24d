"""Solvers, estimators, scenarios, readers and commands by name, through entry points.

The benchmark and the command line reach all of these only from here, so a package of somebody else adds one by
declaring an entry point in the group ``horizonet.<kind>``; nothing of this package changes.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from problems.errors import MissingExtraError, SettingError, UnknownNameError

KINDS = ("solvers", "estimators", "scenarios", "readers", "commands", "native_factors")


@cache
def _entries(kind: str) -> dict[str, EntryPoint]:
    if kind not in KINDS:
        raise SettingError(f"no registry {kind!r}; registries: {', '.join(KINDS)}")
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=f"horizonet.{kind}"):
        found.setdefault(entry.name, entry)
    return found


def names(kind: str) -> list[str]:
    """Registered names of one kind (`KINDS`), in alphabetical order; nothing is imported."""
    return sorted(_entries(kind))


def load(kind: str, name: str) -> Any:
    """The object registered under `name`.

    Raises:
        UnknownNameError: nothing is registered under that name.
        MissingExtraError: its module needs a package that is not installed.
    """
    entries = _entries(kind)
    if name not in entries:
        raise UnknownNameError(kind.removesuffix("s"), name, entries)
    try:
        return entries[name].load()
    except MissingExtraError:
        raise
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"{kind.removesuffix('s')} {name}", str(error.name)) from error
