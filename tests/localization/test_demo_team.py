"""Scenario `demo-team`: one optimum from every form and solver, tolerances that mean something, robustness, fences."""

from __future__ import annotations

import json
import pickle
import tomllib
import warnings
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import pytest
from typer.testing import CliRunner

from localization.scenarios.demo_team import Drawn, Settings, scenario
from problems import registry
from problems.bench.plan import Study
from problems.bench.scenario import TIMES, Outcome, trial_rng
from problems.cli.main import app
from problems.errors import AccuracyWarning, FormError
from problems.problem import Problem

GRAPH = ["gauss-newton", "ipopt", "gtsam-lm", "gtsam-isam2", "auto"]
QUADRATIC = ["osqp", "proxqp", "daqp"]
PAIRS = ("one", "both")


def registered(*solvers: str) -> list[Any]:
    known = [*registry.names("solvers"), "auto"]
    return [
        pytest.param(name, marks=[] if name in known else pytest.mark.skip(f"{name} is not registered"))
        for name in solvers
    ]


def drawn(trial: int = 0, **given: Any) -> tuple[Settings, Drawn]:
    settings = Settings(**given)
    return settings, scenario.draw(settings, trial_rng(1, scenario.name, trial))


def outcome(method: str, solver: str, **given: Any) -> Outcome:
    settings, world = drawn(**given)
    return scenario.run(settings, method, solver, world)


def value(found: Outcome, name: str) -> float:
    number = found.metrics[name]
    assert number is not None
    return number


@pytest.mark.parametrize(
    ("method", "solver"),
    [(m, p.values[0]) for m in ("ml", "ls") for p in registered(*GRAPH) if not p.marks]
    + [("ls", p.values[0]) for p in registered(*QUADRATIC)],
)
def test_every_form_and_solver_finds_the_optimum(method: str, solver: str) -> None:
    found = outcome(method, solver, tolerance=1e-10, robots=25)
    assert found.status == {"solved": 1}
    assert value(found, "distance_to_reference") < 1e-6
    assert 0.05 < value(found, "rmse") < 1.5
    assert set(found.times) <= set(TIMES)
    assert {"compile", "update", "solve"} <= set(found.times)
    assert all(seconds >= 0 for seconds in found.times.values())
    assert found.residual is not None
    assert found.residual < 1e-3
    if method == "ml":
        assert 0.02 < value(found, "heading_rms") < 0.05
        assert found.times["setup"] > 0
        assert found.iterations >= 2
    else:
        assert found.metrics["heading_rms"] is None
    assert pickle.loads(pickle.dumps(found)).metrics == found.metrics


@pytest.mark.parametrize("solver", registered(*QUADRATIC))
def test_solvers_of_quadratic_programs_take_ls_only(solver: str) -> None:
    assert outcome("ls", solver).options["form"] == "quadratic"
    with pytest.raises(FormError, match=f"'{solver}' takes quadratic programs only"):
        outcome("ml", solver)
    with pytest.raises(FormError, match="loss"):
        outcome("ls", solver, loss="huber")


def test_a_tighter_tolerance_brings_the_answer_closer() -> None:
    distances = [
        value(outcome("ml", "gauss-newton", loss="huber", outliers=3, tolerance=t), "distance_to_reference")
        for t in (1e-2, 1e-5, 1e-8, 1e-11)
    ]
    assert distances == sorted(distances, reverse=True)
    assert distances[0] > 100 * distances[-1]


def test_methods_and_solvers_of_a_trial_meet_the_same_noise() -> None:
    one, other, next_trial = drawn()[1], drawn(tolerance=1e-3, loss="cauchy", fence=1)[1], drawn(trial=1)[1]
    np.testing.assert_array_equal(one.team.bearing_range, other.team.bearing_range)
    np.testing.assert_array_equal(one.team.gps, other.team.gps)
    assert not np.array_equal(one.team.gps, next_trial.team.gps)
    moved = drawn(outliers=3)[1]
    away = np.linalg.norm(moved.team.gps - one.team.gps, axis=1)
    assert np.flatnonzero(away > 1e-9).tolist() == moved.outliers.tolist()
    np.testing.assert_allclose(away[moved.outliers], 50.0)


@pytest.mark.parametrize("method", ["ml", "ls"])
def test_robust_losses_survive_false_fixes(method: str) -> None:
    plain = value(outcome(method, "gauss-newton", outliers=4), "rmse")
    assert plain > 1.5
    for loss in ("huber", "cauchy", "geman-mcclure"):
        assert value(outcome(method, "gauss-newton", outliers=4, loss=loss), "rmse") < 0.6 * plain


@pytest.mark.parametrize("solver", registered("gauss-newton", "ipopt"))
@pytest.mark.parametrize("method", ["ml", "ls"])
def test_a_fence_is_kept(method: str, solver: str) -> None:
    found = outcome(method, solver, fence=0, robots=16, tolerance=1e-10)
    assert found.status == {"solved": 1}
    assert found.trace.robot[:, :2].min() > -1e-6
    assert found.trace.robot[:, :2].max() < 12 + 1e-6
    assert value(found, "distance_to_reference") < 1e-4
    assert found.options["fence"] == 0
    free = outcome(method, solver, robots=16)
    assert free.trace.robot[:, :2].min() < -1e-3


@pytest.mark.parametrize("solver", registered("gtsam-lm"))
def test_a_fence_is_no_factor(solver: str) -> None:
    with pytest.raises(FormError, match="fence"):
        outcome("ml", solver, fence=1)


def test_both_measurements_of_a_pair_help() -> None:
    one, both = (value(outcome("ml", "gauss-newton", pairs=pairs, robots=100), "heading_rms") for pairs in PAIRS)
    assert both < 0.8 * one


class Impossible(Drawn):
    """A team that must be left of its fence and inside it."""

    def problem(self, method: str) -> tuple[Problem, dict[str, np.ndarray]]:
        problem, data = super().problem(method)
        assert self.fence is not None
        limit = problem.data("limit", 2)  # as data, or compiling would refuse the empty set
        problem.inequality("away", lambda place: place, on=problem.unknowns["robot"], upper=limit)
        return problem, data | {"limit": np.array([self.fence[0][0] - 1, np.inf])}


def test_what_is_not_solved_says_so_and_has_no_metrics() -> None:
    settings, world = drawn(fence=1, robots=9)
    impossible = Impossible(world.team, world.loss, world.fence, world.outliers)
    with pytest.warns(AccuracyWarning, match="ls, daqp: infeasible"):
        found = scenario.run(settings, "ls", "daqp", impossible)
    assert found.metrics == {}
    assert found.status == {"infeasible": 1}
    assert found.trace.covariance is None


@pytest.mark.parametrize(
    "given", [{"robots": 1}, {"outliers": 40}, {"loss": "l1"}, {"fence": -1}, {"tolerance": 0}, {"robot": 9}]
)
def test_settings_without_meaning_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(pydantic.ValidationError):
        Settings(**given)
    assert all(field.description for field in Settings.model_fields.values())


def test_the_study_of_the_built_in_plan_is_solved_by_all() -> None:
    text = (resources.files("problems.bench") / "plans" / "quick.toml").read_text()
    (study,) = [Study(**entry) for entry in tomllib.loads(text)["study"] if entry["scenario"] == scenario.name]
    combinations = list(study.combinations())
    assert {method for method, _, _ in combinations} == set(scenario.methods)
    for method, solver, values in combinations:
        settings = Settings(**values)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = scenario.run(settings, method, solver, scenario.draw(settings, trial_rng(1, scenario.name, 0)))
        assert found.status == {"solved": 1}
        assert value(found, "distance_to_reference") < 1e-3


@pytest.mark.serial
def test_the_command_runs_it_and_draws(tmp_path: Path) -> None:
    words = ["run", "demo-team", "--solver", "gauss-newton", "--set", "robots=9", "--trials", "2", "--seed", "3"]
    result = CliRunner().invoke(app, [*words, "--plot", str(tmp_path / "team.png"), "--json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["rows"]
    assert [row["method"] for row in rows] == list(scenario.methods)
    assert all(row["metrics"]["rmse"] < 2 for row in rows)
    assert (tmp_path / "team.png").stat().st_size > 30_000


def test_the_picture_shows_team_fixes_estimates_and_ellipses() -> None:
    settings, world = drawn(robots=9, fence=1)
    outcomes = {method: scenario.run(settings, method, "auto", world) for method in scenario.methods}
    above, beside = scenario.plot(settings, world, outcomes).axes
    labels = {text.get_text() for text in above.get_legend().get_texts()}
    assert labels == {"range and bearing", "GPS fix", "truth", "ml", "ls", "fence"}
    # an ellipse of 60 points and a gap for each robot, one line for each method
    curves = [np.array(line.get_xydata()) for line in above.get_lines() if len(line.get_xdata()) == 9 * 61]
    assert len(curves) == 2
    root = outcomes["ml"].trace.covariance[0]
    around = curves[0][:60] - outcomes["ml"].trace.robot[0, :2]
    distance = np.einsum("ki,ij,kj->k", around, np.linalg.inv(root), around)
    np.testing.assert_allclose(distance, 5.991, rtol=1e-6)
    assert len(beside.get_lines()) == 3
