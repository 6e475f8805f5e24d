"""All solvers on three families of problems at three tolerances: one optimum, and no answer that is silently wrong."""

from __future__ import annotations

import json
import math
import tomllib
import warnings
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from problems import registry
from problems.bench.agreement import Case, Optimum, certified_optima, compared
from problems.bench.plan import Plan, Study, check_solver
from problems.bench.scenario import Outcome, trial_rng
from problems.cli.main import app
from problems.errors import BackendError, MissingExtraError, SettingError, UnknownNameError
from problems.forms.quadratic import QuadraticProgram
from problems.noise import Gaussian
from problems.problem import Problem
from problems.spaces import Vector

PLAN = Plan.model_validate(
    tomllib.loads((resources.files("problems.bench") / "plans" / "agreement.toml").read_text(encoding="utf-8"))
)
TOLERANCES = {1e-3, 1e-6, 1e-9}
LEAST = 14  # backends, apart from the same ones under other names
# what was seen to give up, and says so: cycling (qrqp), or stopping a little short of the tolerance
MAY_GIVE_UP = {"qrqp", "fatrop", "osqp", "sqp:osqp"}
drawn_once: dict[tuple[str, int], Any] = {}


def installed(solver: str) -> bool:
    try:
        check_solver(solver)
    except MissingExtraError:
        return False
    return True


def families(study: Study) -> list[Any]:
    loss = study.settings.get("loss", "")
    return [pytest.param(study, solver, id=f"{study.scenario} {loss} {solver}") for solver in study.solvers]


CELLS = [cell for study in PLAN.study for cell in families(study)]


def outcomes(study: Study, solver: str, trial: int) -> list[tuple[float, Outcome]]:
    scenario = registry.load("scenarios", study.scenario)
    if (study.scenario, trial) not in drawn_once:  # what is drawn depends on no setting that the plan varies
        drawn_once[study.scenario, trial] = scenario.draw(
            scenario.settings(), trial_rng(PLAN.seed, scenario.name, trial)
        )
    drawn = drawn_once[study.scenario, trial]
    found = []
    for method, name, values in study.combinations():
        if name == solver:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                outcome = scenario.run(scenario.settings(**values), method, solver, drawn)
            found.append((values["tolerance"], outcome))
    assert {tolerance for tolerance, _ in found} == TOLERANCES
    return found


def check(study: Study, solver: str, trial: int) -> None:
    for tolerance, outcome in outcomes(study, solver, trial):
        cell = f"{study.scenario}, {solver}, {tolerance:g}: {dict(outcome.status)}, {outcome.metrics}"
        assert outcome.residual is not None or set(outcome.status) <= {"failed", "infeasible", "unbounded"}, cell
        if set(outcome.status) != {"solved"}:
            assert solver in MAY_GIVE_UP, cell
            assert not {"infeasible", "unbounded"} & set(outcome.status), cell  # false: all problems have an optimum
            continue
        error, distance = outcome.metrics["objective_error"], outcome.metrics["distance_to_reference"]
        assert error is not None, cell
        assert distance is not None, cell
        assert error <= 10 * tolerance, cell
        assert distance <= math.sqrt(10 * tolerance), cell  # the cost is flat to second order
        if outcome.options["form"] == "quadratic":  # where residuals decide, not a decrement
            assert distance <= 50 * tolerance, cell


@pytest.mark.parametrize("name", ["qpsolvers", "sqp"])
def test_a_solver_that_names_another_is_not_complete_alone(name: str) -> None:
    with pytest.raises(SettingError, match=f"solver '{name}' needs the name .* '{name}:"):
        check_solver(name)
    with pytest.raises(UnknownNameError):
        check_solver(f"{name}:nothing")


@pytest.mark.parametrize(("study", "solver"), CELLS)
def test_what_is_solved_is_the_optimum(study: Study, solver: str) -> None:
    if not installed(solver):
        pytest.skip(f"the package of {solver} is not installed")
    check(study, solver, trial=0)


@pytest.mark.slow
@pytest.mark.parametrize(("study", "solver"), CELLS)
def test_what_is_solved_is_the_optimum_in_many_trials(study: Study, solver: str) -> None:
    if not installed(solver):
        pytest.skip(f"the package of {solver} is not installed")
    for trial in range(1, 15):
        check(study, solver, trial)


def test_the_plan_has_every_registered_solver() -> None:
    named = {solver for study in PLAN.study for solver in study.solvers}
    project = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())["project"]
    assert {name.partition(":")[0] for name in named} == set(project["entry-points"]["horizonet.solvers"])
    assert len({name for name in named if ":" not in name}) >= LEAST
    assert all(set(study.settings["tolerance"]) == TOLERANCES for study in PLAN.study)


@pytest.mark.parametrize("name", ["agreement-window", "agreement-team"])
def test_bounds_hold_the_optimum_of_every_trial(name: str) -> None:
    scenario = registry.load("scenarios", name)
    for trial in range(5):
        drawn = scenario.draw(scenario.settings(), trial_rng(PLAN.seed, name, trial))
        assert sum(optimum.active for optimum in drawn.optima) >= 2


def box(n: int = 3) -> tuple[Problem, np.ndarray]:
    """min |x - target|^2 / 2 in [-1, 1]^n, whose optimum is the target cut off."""
    problem = Problem("box")
    x = problem.variables("x", Vector(n))
    target = problem.data("target", n)
    problem.cost("near", lambda x, z: x - z, on=x, data=target, noise=Gaussian(1.0))
    problem.inequality("box", lambda x: x, on=x, lower=-1.0, upper=1.0)
    return problem, np.array([3.0, 0.5, -2.0])


def test_certified_optima_are_optima() -> None:
    problem, target = box()
    (optimum,) = certified_optima(problem.compile("daqp", tolerance=1e-12), [Case({"target": target})])
    np.testing.assert_allclose(optimum.values["x"], [[1.0, 0.5, -1.0]], atol=1e-12)
    assert optimum.objective == pytest.approx(2.5)
    assert optimum.size == pytest.approx(target @ target / 2)
    assert optimum.active == 2
    assert QuadraticProgram(problem).problem is problem


def test_a_reference_that_is_not_certified_is_refused() -> None:
    problem, target = box()
    loose = problem.compile("osqp", tolerance=1e-2)
    with pytest.raises(BackendError, match="case 0 by osqp is not certified"):
        certified_optima(loose, [Case({"target": target})])


def test_answers_are_measured_against_the_optimum() -> None:
    problem, target = box()
    session = problem.compile("daqp")
    moved = Optimum({"x": np.array([[1.0, 0.5, -1.1]])}, 2.0, 4.0, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = compared(session, [Case({"target": target})] * 2, [moved, moved], "x")
    distance = found.metrics["distance_to_reference"]
    assert distance == pytest.approx(0.1 / np.linalg.norm([1.0, 0.5, 1.1]))
    assert found.metrics["objective_error"] == pytest.approx(0.5 / 4.0)
    assert found.status == {"solved": 2}
    assert found.times["compile"] == session.compile_seconds
    np.testing.assert_allclose(found.trace, [[1.0, 0.5, -1.0]])


@pytest.mark.serial
@pytest.mark.slow
def test_the_command_makes_the_table(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["bench", "agreement", "--out", str(tmp_path), "--trials", "1", "--json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["rows"]
    assert {row["scenario"] for row in rows} == {study.scenario for study in PLAN.study}
    assert len({row["solver"] for row in rows if ":" not in row["solver"]}) >= LEAST
    assert all(row["metrics"]["residual"] is not None for row in rows if row["status"]["solved"])
