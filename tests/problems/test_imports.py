"""What an import loads, and that imports between the packages go one way."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ORDER = ("problems", "mhe", "localization")  # each may import those before it
HEAVY = (
    "scipy",
    "gtsam",
    "pandas",
    "qpsolvers",
    "osqp",
    "proxsuite",
    "daqp",
    "qdldl",
    "networkx",
    "matplotlib",
    "plotly",
)


def loaded(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter holds after `statement`."""
    code = f"import sys; {statement}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    return set(run.stdout.split())


def imports(path: Path) -> set[str]:
    """Top-level names that a file imports anywhere, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add((node.module or "").partition(".")[0])
    return found


def test_problems_loads_numpy_and_casadi_and_nothing_heavier() -> None:
    names = loaded("import problems")
    assert {"numpy", "casadi"} <= names
    assert not names & {*HEAVY, "mhe", "localization"}


def test_stating_a_problem_loads_nothing_heavier_either() -> None:
    names = loaded(
        "from problems import Problem, Vector, Gaussian; p = Problem(); x = p.variables('x', Vector(2), 3); "
        "z = p.data('z', 2, 3); p.cost('c', lambda x, z: x - z, on=x, data=z, noise=Gaussian(2.0))"
    )
    assert not names & set(HEAVY)


def test_everything_public_is_there() -> None:
    import problems

    assert len(set(problems.__all__)) == len(problems.__all__) > 10
    for name in problems.__all__:
        assert getattr(problems, name) is not None


@pytest.mark.parametrize("package", ORDER)
def test_imports_go_one_way(package: str) -> None:
    later = set(ORDER[ORDER.index(package) + 1 :])
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    wrong = {str(path.relative_to(ROOT)): sorted(imports(path) & later) for path in files}
    assert not {path: names for path, names in wrong.items() if names}


def test_nothing_of_the_product_imports_tests_or_benchmarks() -> None:
    for package in ORDER:
        for path in (ROOT / package).rglob("*.py"):
            assert not imports(path) & {"tests", "benchmarks", "pytest", "hypothesis"}, path
