"""The example package of CONTRIBUTING.md: built by its own backend, installed, and used from the command line."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.serial

PAGE = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
FILES = {name: body for name, body in re.findall(r"```(?:python|toml)\n# (\S+)\n(.*?)```", PAGE, re.DOTALL)}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment of a Python that has the package, without network."""
    pytest.importorskip("hatchling")
    source, target = tmp_path_factory.mktemp("plain-extras"), tmp_path_factory.mktemp("site")
    for name, body in FILES.items():
        (source / name).write_text(body, encoding="utf-8")
    words = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(target), str(source)]
    subprocess.run([sys.executable, "-m", "pip", "install", *words], check=True, capture_output=True, text=True)
    path = os.pathsep.join([str(target), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path}


def run(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "problems.cli", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)


def output(environment: dict[str, str], *words: str) -> dict:
    done = run(environment, *words)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(".py")])
def test_examples_are_short(name: str) -> None:
    assert len([line for line in FILES[name].splitlines() if line.strip()]) <= 35


def test_the_solver_is_listed_beside_ours(installed: dict[str, str]) -> None:
    found = {entry["name"]: entry for entry in output(installed, "solvers", "--json")["solvers"]}
    assert found["plain-newton"] == {
        "name": "plain-newton",
        "available": True,
        "version": "2.5",
        "forms": ["quadratic"],
        "warm_start": False,
        "extra": None,
    }
    assert "daqp" in found
    mine = output(dict(os.environ), "solvers", "--json")["solvers"]
    assert "plain-newton" not in {entry["name"] for entry in mine}


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


def test_the_solver_solves_and_its_answers_are_checked(installed: dict[str, str]) -> None:
    done = subprocess.run([sys.executable, "-c", USE], env=installed, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found["x"] == [pytest.approx([3.0, 4.0])]
    assert (found["status"], found["method"]) == ("solved", "plain-newton")
    assert found["beyond"] == "inaccurate"  # it knows no rows, says solved all the same, and is not believed


def test_the_scenario_runs_with_any_solver(installed: dict[str, str], tmp_path: Path) -> None:
    solvers = ["--solver", "daqp", "--solver", "plain-newton"]
    words = ["bench", "thermometer", *solvers, "--trials", "5", "--out", str(tmp_path), "--json"]
    rows = output(installed, *words)["rows"]
    assert {(row["method"], row["solver"]) for row in rows} == {
        (method, solver) for method in ("mean", "first") for solver in ("daqp", "plain-newton")
    }
    errors = {(row["method"], row["solver"]): row["metrics"]["error"] for row in rows}
    assert errors["mean", "daqp"] == pytest.approx(errors["mean", "plain-newton"], abs=1e-6)
    assert errors["mean", "daqp"] < errors["first", "daqp"]


def test_the_estimator_is_a_method(installed: dict[str, str]) -> None:
    words = ["run", "four-state-ring", "--method", "kf", "--method", "observer", "--trials", "2", "--json"]
    rows = {row["method"]: row for row in output(installed, *words)["rows"]}
    best = rows["kf"]["metrics"]["rmse"]
    assert best < rows["observer"]["metrics"]["rmse"] < 1.5 * best
    done = run(dict(os.environ), *words)
    assert done.returncode == 2 and "observer" in done.stderr  # not there without the package


def test_the_reader_reads(installed: dict[str, str], tmp_path: Path) -> None:
    loop = tmp_path / "loop.steps"
    sides = [f"{k},{(k + 1) % 4},2.0,{0.1 if k == 1 else 0.0},{np.pi / 2}" for k in range(4)]
    loop.write_text("\n".join(sides))
    row = output(installed, "localize", str(loop), "--json")["rows"][0]
    assert row["metrics"]["keyframes"] == 4 and 0 < row["metrics"]["objective"] < 1
    loop.write_text("\n".join([*sides, "4,0,north"]))
    done = run(installed, "localize", str(loop))
    assert done.returncode == 2 and "loop.steps:5: expected five numbers" in done.stderr.replace("\n", "")


def test_all_solvers_are_listed_with_their_facts() -> None:
    found = output(dict(os.environ), "solvers", "--json")["solvers"]
    usable = [entry for entry in found if entry["available"]]
    assert len(usable) >= 14
    for entry in found:
        assert set(entry) == {"name", "available", "version", "forms", "warm_start", "extra"}
        assert entry["available"] or entry["extra"], entry
        assert entry["forms"], entry
        assert set(entry["forms"]) <= {"quadratic", "nonlinear", "graph"}
    assert all(entry["version"] for entry in usable)
    assert {"qpsolvers", "sqp"} <= {entry["name"] for entry in usable}
