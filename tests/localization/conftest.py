"""Where tests find real recordings: HORIZONET_DATA, else ../shared/data beside the repository."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from localization.io.samples import write_samples


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """A function from a path inside the data folder to the file or folder; the test is skipped where it is missing."""
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    root = Path(os.environ.get("HORIZONET_DATA") or beside)

    def find(name: str) -> Path:
        path = root / name
        if not path.exists():
            pytest.skip(f"needs the recording {name}, which is not in {root}")
        return path

    return find


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Generated recordings of every kind; to be read only."""
    return write_samples(tmp_path_factory.mktemp("samples"), np.random.default_rng(7))
