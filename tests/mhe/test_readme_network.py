"""A user's own model on an own network: every method and two solvers in one loop, as the README shows it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
SNIPPET = next(block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "networkx" in block)


def test_all_methods_and_two_solvers_in_thirty_lines(capsys: pytest.CaptureFixture[str]) -> None:
    assert sum(bool(line.strip()) for line in SNIPPET.splitlines()) <= 30
    exec(compile(SNIPPET, "README.md", "exec"), {})
    printed = dict(line.split(" mean error ") for line in capsys.readouterr().out.splitlines())
    found = {name.strip(): values for name, values in printed.items()}
    methods = ("mhe", "mhe_pre", "dmhe_f", "dmhe_pre", "dmhe_w_pre")
    assert set(found) == {"kf", *(f"{method}, {solver}" for method in methods for solver in ("daqp", "osqp"))}
    for method in methods:
        assert found[f"{method}, daqp"] == found[f"{method}, osqp"]
    mean = {name: float(values.split(",")[0]) for name, values in found.items()}
    # without bounds mhe is the Kalman filter, so it is the bounds that make it better
    assert mean["mhe, daqp"] < mean["kf"] < mean["dmhe_f, daqp"] < 1
