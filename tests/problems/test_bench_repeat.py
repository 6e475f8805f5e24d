"""Two runs of one plan give the same rows but for times, whatever the process did before."""

from __future__ import annotations

from typing import Any

import pytest

from problems.bench.plan import Plan, Study, built_in_plan, built_in_plans
from problems.bench.rows import Job, Row
from problems.bench.workers import LocalProcesses

TIMED = ("times", "step_median", "step_p95", "step_max", "wall", "cpu", "memory")
# what is said while something is compiled stands in the row of the trial that compiled it for its process
TIMED += ("warnings",)
PLAN = Plan(
    trials=2,
    study=(
        Study(
            scenario="demo-window",
            solvers=("daqp", "osqp", "proxqp", "piqp", "gauss-newton"),
            settings={"duration": 12, "tolerance": [1e-3, 1e-8]},
        ),
        Study(scenario="four-state-ring", solvers=("osqp", "daqp"), settings={"bounds": ["none", "tight"]}),
        Study(scenario="nine-node", methods=("mhe", "dmhe_f", "dmhe_w_pre"), settings={"duration": 12}),
        Study(scenario="demo-team", solvers=("gauss-newton", "gtsam-lm", "ipopt"), settings={"robots": 9}),
        Study(scenario="robot-lattice", methods=("gps", "ls", "gls", "ml"), settings={"fence": [None, 1.0]}),
        Study(scenario="relative-network", settings={"nodes": 12, "radius": 0.6, "iterations": 200}),
    ),
)


def untimed(row: Row) -> dict[str, Any]:
    record = {key: value for key, value in row.to_dict().items() if key not in TIMED}
    return record | {"failure": record["failure"] and {**record["failure"], "traceback": ""}}


def rows(jobs: list[Job], workers: int) -> dict[str, dict[str, Any]]:
    return {row.job.key: untimed(row) for row, _ in LocalProcesses(workers).run(jobs)}


@pytest.mark.serial
def test_two_runs_give_identical_rows_but_for_times() -> None:
    jobs = PLAN.jobs()
    first = rows(jobs, 0)
    assert sum(row["failure"] is None for row in first.values()) > 0.9 * len(jobs)
    # the other way round: every trial meets sessions that something else was solved with before
    second = rows(jobs[::-1], 1)
    assert first.keys() == second.keys()
    for key, row in first.items():
        assert second[key] == row


@pytest.mark.parametrize("name", built_in_plans())
def test_built_in_plans_are_valid_and_say_how_to_read_them(name: str) -> None:
    plan = built_in_plan(name)
    assert plan.name == name
    jobs = plan.jobs()
    assert 50 < len(jobs) < 2500
    assert len(plan.text) > 300
    for study in plan.study:
        assert study.scenario in plan.text or name in ("quick", "agreement")


def test_the_plans_of_issue_and_command_line_exist() -> None:
    assert {"quick", "agreement", "mhe-solvers", "distributed", "localization", "warm-start"} <= set(built_in_plans())
    for name in ("mhe-solvers", "localization"):
        tolerances = {job.settings["tolerance"] for job in built_in_plan(name).jobs() if "tolerance" in job.settings}
        assert {1e-2, 1e-4, 1e-6, 1e-9} <= tolerances
