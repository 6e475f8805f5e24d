"""The circumstances times depend on: machine, versions, threads."""

from __future__ import annotations

import os
import platform
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from problems.bench.workers import THREADS


def describe(workers: int) -> dict[str, Any]:
    """What a reader of the results needs to know about where they come from (JSON types).

    Args:
        workers: number of worker processes; their thread settings are those of `problems.bench.workers`.
    """
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "workers": workers,
        "threads": {name: "1" if workers else os.environ.get(name) for name in THREADS},
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Version of this distribution and of everything it can use that is installed."""
    found = {"horizonet": metadata.version("horizonet")}
    for requirement in metadata.requires("horizonet") or []:
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        try:
            if name:
                found[name[0]] = metadata.version(name[0])
        except metadata.PackageNotFoundError:
            continue
    return dict(sorted(found.items()))


def _processor() -> str:
    if sys.platform.startswith("linux"):
        try:
            model = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
        except OSError:
            model = None
        if model:
            return model[1]
    return platform.processor() or platform.machine()
