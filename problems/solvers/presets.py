"""Named sets of the options that all solvers share."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from problems.errors import UnknownNameError
from problems.solvers.base import Options

PRESETS: Mapping[str, Options] = MappingProxyType(
    {
        "default": Options(),
        "high-accuracy": Options(tolerance=1e-10, time_limit=120.0),
        "fast": Options(tolerance=1e-5, time_limit=5.0),
    }
)


def preset(name: str) -> Options:
    """Options of a preset (`PRESETS`): ``default``, ``high-accuracy`` or ``fast``.

    Raises:
        UnknownNameError: no preset has that name.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    return PRESETS[name]
