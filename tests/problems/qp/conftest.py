"""QP backends, those that are installed, and the problems beside this file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("qp_problems")

from qp_problems import CLASSES, backend_class  # noqa: E402


@pytest.fixture(params=list(CLASSES))
def cls(request: pytest.FixtureRequest) -> type[Any]:
    return backend_class(request.param)
