"""Choose the reader of a recording by its layout, among all that are registered."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any, Protocol

from problems import registry
from problems.errors import ReadError, SettingError


class Reader(Protocol):
    """What is registered in ``horizonet.readers``; a module with these three names is one.

    Attributes:
        layout: what it reads, in one line for messages: ``name: what lies where``.
    """

    layout: str

    def matches(self, path: str | Path, /) -> bool:
        """Whether a file or folder looks like this layout (cheap; never raises)."""
        ...

    def read(self, path: str | Path, /, **settings: Any) -> Any:
        """The recording; raises `problems.errors.ReadError` where it cannot be read."""
        ...


def open_recording(path: str | Path, **settings: Any) -> Any:
    """Read a recording of any registered layout.

    Args:
        path: file or folder.
        settings: keyword arguments of the reader, such as ``trajectory="B"``.

    Returns:
        What the reader returns: a `UwbRecording`, `PoseGraph` or `TeamRecording`, or what somebody else's reader makes.

    Raises:
        ReadError: nothing is at `path`, no reader knows its layout (all known ones are named), or it is malformed.
        SettingError: the layout's reader has no such setting.
    """
    path = Path(path)
    if not path.exists():
        raise ReadError(path, None, "an existing file or folder", "nothing there")
    layouts = []
    for name in registry.names("readers"):
        reader: Reader = registry.load("readers", name)
        if reader.matches(path):
            return reader.read(path, **_accepted(name, reader, settings))
        layouts.append(reader.layout)
    raise ReadError(path, None, f"one of the known layouts ({'; '.join(layouts) or 'none is registered'})", "another")


def _accepted(name: str, reader: Reader, settings: dict[str, Any]) -> dict[str, Any]:
    parameters = inspect.signature(reader.read).parameters.values()
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters):
        return settings
    valid = [parameter.name for parameter in parameters if parameter.kind is inspect.Parameter.KEYWORD_ONLY]
    for setting in settings:
        if setting not in valid:
            raise SettingError(f"reader {name} has no setting {setting!r}; valid: {', '.join(valid) or 'none'}")
    return settings
