"""What is installed: entry points that load, files that are shipped, imports that stay light and go one way."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from problems import registry
from problems.bench.plan import built_in_plan, built_in_plans
from problems.errors import MissingExtraError

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("problems", "mhe", "localization")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_registries_are_those_of_the_project() -> None:
    assert {f"horizonet.{kind}" for kind in registry.KINDS} == set(PROJECT["entry-points"])


@pytest.mark.parametrize(
    ("kind", "name"),
    [(group.removeprefix("horizonet."), name) for group, found in PROJECT["entry-points"].items() for name in found],
)
def test_every_entry_point_loads(kind: str, name: str) -> None:
    assert name in {entry.name for entry in entry_points(group=f"horizonet.{kind}")}, "install the project again"
    try:
        loaded = registry.load(kind, name)
    except MissingExtraError as error:
        assert error.extra in PROJECT["optional-dependencies"]
        return
    if kind == "scenarios":
        assert loaded.name == name
        assert loaded.methods
        assert loaded.metrics
        assert loaded.settings.model_config.get("extra") == "forbid"
        required = {key for key, info in loaded.settings.model_fields.items() if info.is_required()}
        assert required <= {"path"}  # all but a recording run by their name alone


@pytest.mark.parametrize("name", built_in_plans())
def test_built_in_plans_name_what_exists(name: str) -> None:
    plan = built_in_plan(name)
    assert plan.jobs()
    assert plan.text


def test_extras_named_by_solvers_exist() -> None:
    for name in PROJECT["entry-points"]["horizonet.solvers"]:
        extra = getattr(registry.load("solvers", name), "extra", None)
        assert extra is None or extra in PROJECT["optional-dependencies"]


def test_importing_problems_loads_numpy_and_casadi_only() -> None:
    code = "import sys, problems; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"scipy", "gtsam", "pandas", "pyarrow", "matplotlib", "networkx", "qpsolvers", "osqp", "proxsuite", "daqp"}
    assert heavy.isdisjoint(done.stdout.split())


@pytest.mark.parametrize(("package", "upward"), [("problems", ("mhe", "localization")), ("mhe", ("localization",))])
def test_imports_go_one_way(package: str, upward: tuple[str, ...]) -> None:
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.partition(".")[0] in upward], path


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)], cwd=ROOT, check=True)
    return zipfile.ZipFile(next(out.glob("*.whl")))


def test_the_wheel_holds_every_file_of_the_packages_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    inside = {name for name in wheel.namelist() if ".dist-info/" not in name}
    tree = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert inside == tree
    needed = {f"{package}/py.typed" for package in PACKAGES}
    needed |= {"problems/bench/plans/quick.toml", "problems/bench/page/report.css", "problems/bench/page/report.js"}
    assert needed <= inside


def test_the_wheel_brings_the_command_and_the_licence(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    entries = wheel.read(next(name for name in names if name.endswith("entry_points.txt"))).decode()
    assert "horizonet = problems.cli.main:run" in entries
    assert any(name.endswith("licenses/LICENSE") for name in names)
    metadata = wheel.read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert f"Version: {PROJECT['version']}" in metadata
    assert "Requires-Python: >=3.11" in metadata
