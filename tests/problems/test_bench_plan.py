"""Plans: what they expand to, and where they say a typo stands."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from problems.bench.plan import Plan, Study, built_in_plans, line_of, parse_plan, plan_of_names, read_plan
from problems.bench.settings import as_text, assignments, complete, convert, describe, split
from problems.errors import MissingExtraError, ReadError, SettingError, UnknownNameError

pytestmark = pytest.mark.usefixtures("toy_package")

GOOD = """
name = "two"
trials = 2

[[study]]
scenario = "toy"
methods = ["mean", "kalman"]
solvers = ["swift", "slow"]
[study.settings]
tolerance = [1e-3, 1e-6]   # swept

[[study]]
scenario = "other"
settings.fence = true
"""


def toy():
    from problems import registry

    return registry.load("scenarios", "toy")


def test_a_plan_is_the_product_of_what_it_names() -> None:
    jobs = parse_plan(GOOD, "plan.toml").jobs()
    found = [(job.scenario, job.method, job.solver, job.settings["tolerance"], job.trial) for job in jobs]
    one_trial = [
        ("toy", method, solver, tolerance)
        for tolerance in (1e-3, 1e-6)
        for method, solver in (("mean", "swift"), ("mean", "slow"), ("kalman", "none"))
    ] + [("other", "mean", "auto", 1e-6)]
    assert found == [(*row, trial) for trial in (0, 1) for row in one_trial]
    assert jobs[0].settings["steps"] == 4  # complete: defaults are in


def test_a_study_can_take_fewer_trials_than_its_plan() -> None:
    few = Study(scenario="toy", methods=("mean",), trials=2)
    jobs = Plan(study=(few, Study(scenario="other")), trials=3).jobs()
    assert [(job.scenario, job.trial) for job in jobs] == [
        ("toy", 0), ("other", 0), ("toy", 1), ("other", 1), ("other", 2)
    ]  # fmt: skip
    assert len(Plan(study=(few,), trials=1).jobs()) == 1


def test_equal_jobs_are_run_once_and_keys_do_not_depend_on_order() -> None:
    study = Study(scenario="toy", methods=("mean",), settings={"tolerance": [1e-6, "1e-6"], "steps": 4})
    swapped = Study(scenario="toy", methods=("mean",), settings={"steps": "4"})
    jobs = Plan(study=(study, swapped), trials=1).jobs()
    assert len(jobs) == 1
    assert len({job.key for job in Plan(study=(study,), trials=3).jobs()}) == 3


@pytest.mark.parametrize(
    ("wrong", "right", "line", "named"),
    [
        ("solvrs", "solvers", 8, "did you mean solvers?"),
        ("trails", "trials", 3, "did you mean trials?"),
        ('"meann"', '"mean"', 7, "did you mean mean"),
        ('"swfit"', '"swift"', 8, "did you mean swift?"),
        ("tolerence", "tolerance", 10, "did you mean tolerance?"),
        ('"othr"', '"other"', 13, "did you mean other?"),
        ("settings.fense", "settings.fence", 14, "did you mean fence"),
        ("[1e-3, -1]", "[1e-3, 1e-6]", 10, "greater than 0"),
        ("trials = 0", "trials = 2", 3, "greater than or equal to 1"),
        ("trials = ", "trials = 2", 3, "TOML"),
    ],
)
def test_a_typo_is_reported_with_its_line(tmp_path: Path, wrong: str, right: str, line: int, named: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(GOOD.replace(right, wrong, 1))
    with pytest.raises(ReadError) as caught:
        read_plan(path)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"{path}:{line}: expected")
    assert named in str(caught.value)


def test_a_name_is_looked_for_in_its_own_study() -> None:
    text = '[[study]]\nscenario = "a"\nmethods = ["x"]\n[[study]]\nscenario = "b"\nmethods = ["x"]\n'
    assert (line_of(text, "x", 0), line_of(text, "x", 1)) == (3, 6)
    assert line_of(text, "nothing", 0) is None


def test_a_plan_that_is_not_there_or_empty() -> None:
    with pytest.raises(ReadError, match="a plan in TOML"):
        read_plan("no-such-plan.toml")
    with pytest.raises(ReadError, match="study"):
        parse_plan("trials = 3", "plan.toml")


def test_a_solver_that_is_not_installed_is_refused_before_work() -> None:
    with pytest.raises(MissingExtraError, match=r"horizonet\[magic\]"):
        Plan(study=(Study(scenario="toy", solvers=("absent",)),)).jobs()


def test_names_on_a_command_line_go_to_the_scenarios_that_know_them() -> None:
    plan = plan_of_names(["toy", "other"], ["mean", "first"], [], {"fence": ["true"], "tolerance": ["1e-3"]})
    first, second = plan.study
    assert (first.methods, first.settings) == (("mean", "first"), {"tolerance": ["1e-3"]})
    assert (second.methods, second.settings) == (("mean",), {"fence": ["true"], "tolerance": ["1e-3"]})
    with pytest.raises(UnknownNameError, match="did you mean fence"):
        plan_of_names(["toy", "other"], [], [], {"fenc": ["1"]})
    with pytest.raises(UnknownNameError, match="did you mean kalman"):
        plan_of_names(["toy", "other"], ["kalmn"], [], {})
    with pytest.raises(UnknownNameError, match="method of other 'first'"):
        plan_of_names(["toy", "other"], ["first"], [], {})


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("steps", "7", 7),
        ("tolerance", "1e-3", 1e-3),
        ("mode", "warn", "warn"),
        ("label", "7", "7"),
        ("label", "x=1", "x=1"),
    ],
)
def test_text_becomes_the_value_its_setting_needs_and_back(key: str, text: str, value: object) -> None:
    found = convert(toy(), key, text)
    assert found == value
    assert type(found) is type(value)
    assert convert(toy(), key, as_text(found)) == value


def test_settings_are_completed_and_checked() -> None:
    assert complete(toy(), {"steps": "2"}) == describe(toy())["settings"] | {"steps": 2}
    with pytest.raises(SettingError, match="setting steps of toy cannot be 'many'"):
        complete(toy(), {"steps": "many"})
    with pytest.raises(UnknownNameError, match="did you mean steps"):
        complete(toy(), {"stesp": "2"})


def test_sweeps_and_assignments() -> None:
    assert split("1,[2,3],{'a': (4,5)},6") == ["1", "[2,3]", "{'a': (4,5)}", "6"]
    assert assignments(["a=1", "b=x=y"]) == {"a": "1", "b": "x=y"}
    with pytest.raises(SettingError, match="KEY=VALUE"):
        assignments(["a"])
    with pytest.raises(SettingError, match="twice"):
        assignments(["a=1", "a=2"])


def test_keys_tell_jobs_apart() -> None:
    rng = random.Random(0)
    studies = [
        Study(scenario="toy", settings={"offset": [rng.random() for _ in range(20)], "steps": [1, 2, 3]})
        for _ in range(2)
    ]
    jobs = Plan(study=tuple(studies), trials=5).jobs()
    assert len({job.key for job in jobs}) == len(jobs) == 2 * 20 * 3 * 3 * 5


def test_the_quick_plan_is_shipped() -> None:
    assert "quick" in built_in_plans()
