"""Another package adds a solver: built from its own pyproject, installed, found by name; nothing here changes."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.serial

PYPROJECT = """\
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "plain-newton"
version = "2.5"
entry-points."horizonet.solvers".plain-newton = "plain_newton:PlainNewton"
"""

SOLVER = """\
import numpy as np

from problems.solvers.base import QPResult, Status


class PlainNewton:
    name, dense, warm_starts, extra = "plain-newton", True, False, None

    def __init__(self, P, q, A, l, u, options):
        self.update(P, A)

    def update(self, P, A):
        self.P, self.A = P.copy(), A.copy()

    def solve(self, q, l, u, warm=None):
        return QPResult(np.linalg.solve(self.P, -q), np.zeros(len(l)), Status.SOLVED, 1)

    @classmethod
    def version(cls):
        return "2.5"
"""

USE = """\
import json

import numpy as np

from problems import Gaussian, Problem, Vector

problem = Problem("mean")
x = problem.variables("x", Vector(2))
seen = problem.data("seen", 2, count=4)
problem.cost("fixes", lambda x, z: x - z, on=x, data=seen, noise=Gaussian(0.5))
free = problem.compile(solver="plain-newton").solve({"seen": np.arange(8.0).reshape(4, 2)})
problem.inequality("wall", lambda x: x[0], on=x, upper=1.0)
wrong = problem.compile(solver="plain-newton").solve({"seen": np.arange(8.0).reshape(4, 2)})
print(json.dumps({"x": free["x"].tolist(), "status": free.status, "method": free.method, "beyond": wrong.status}))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment of a Python that has the package, built by its own backend without network."""
    pytest.importorskip("hatchling")
    source, target = tmp_path_factory.mktemp("plain-newton"), tmp_path_factory.mktemp("site")
    (source / "pyproject.toml").write_text(PYPROJECT)
    (source / "plain_newton.py").write_text(SOLVER)
    words = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(target), str(source)]
    subprocess.run([sys.executable, "-m", "pip", "install", *words], check=True, capture_output=True, text=True)
    path = os.pathsep.join([str(target), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path}


def output(environment: dict[str, str], *words: str) -> dict:
    done = subprocess.run(
        [sys.executable, *words], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return json.loads(done.stdout)


def test_the_example_is_short() -> None:
    assert len([line for line in SOLVER.splitlines() if line.strip()]) <= 20


def test_the_command_lists_it_beside_ours(installed: dict[str, str]) -> None:
    found = {entry["name"]: entry for entry in output(installed, "-m", "problems.cli", "solvers", "--json")["solvers"]}
    assert found["plain-newton"] == {
        "name": "plain-newton",
        "available": True,
        "version": "2.5",
        "forms": ["quadratic"],
        "warm_start": False,
        "extra": None,
    }
    assert "daqp" in found
    mine = output(dict(os.environ), "-m", "problems.cli", "solvers", "--json")["solvers"]
    assert "plain-newton" not in {entry["name"] for entry in mine}


def test_problems_are_solved_with_it_and_its_answers_are_checked(installed: dict[str, str]) -> None:
    found = output(installed, "-c", USE)
    assert found["x"] == [pytest.approx([3.0, 4.0])]
    assert (found["status"], found["method"]) == ("solved", "plain-newton")
    assert found["beyond"] == "inaccurate"  # it knows no rows, says solved all the same, and is not believed


def test_all_solvers_are_listed_with_their_facts() -> None:
    found = output(dict(os.environ), "-m", "problems.cli", "solvers", "--json")["solvers"]
    usable = [entry for entry in found if entry["available"]]
    assert len(usable) >= 14
    for entry in found:
        assert set(entry) == {"name", "available", "version", "forms", "warm_start", "extra"}
        assert entry["available"] or entry["extra"], entry
        assert entry["forms"], entry
        assert set(entry["forms"]) <= {"quadratic", "nonlinear", "graph"}
    assert all(entry["version"] for entry in usable)
    assert {"qpsolvers", "sqp"} <= {entry["name"] for entry in usable}
