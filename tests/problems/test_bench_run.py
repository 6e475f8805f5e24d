"""Running jobs: paired noise, worker processes, and that whatever an estimator does costs its own row only."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from problems.bench.measure import POINTS, measure
from problems.bench.plan import Plan, Study
from problems.bench.rows import Job, Row
from problems.bench.run import missing, run_plan
from problems.bench.scenario import Curve, Outcome, trial_rng
from problems.bench.store import Store
from problems.bench.workers import LocalProcesses

pytestmark = pytest.mark.usefixtures("toy_package")


def plan(trials: int = 2, **study: Any) -> Plan:
    return Plan(study=(Study(scenario="toy", **study),), trials=trials)


def without_times(row: Row) -> dict[str, Any]:
    record = row.to_dict()
    return {key: value for key, value in record.items() if key not in ("wall", "cpu", "memory")}


def test_the_noise_of_a_trial_depends_on_seed_scenario_and_trial_only() -> None:
    draws = {
        (seed, name, trial): trial_rng(seed, name, trial).normal()
        for seed in (0, 1)
        for name in ("toy", "other")
        for trial in (0, 1)
    }
    assert len(set(draws.values())) == 8
    assert trial_rng(1, "toy", 1).normal() == draws[1, "toy", 1]


def test_methods_solvers_and_settings_of_a_trial_meet_the_same_noise() -> None:
    jobs = plan(trials=1, solvers=("swift", "slow"), settings={"tolerance": [1e-3, 1e-6]}).jobs()
    kept = [outcome for _, outcome in LocalProcesses(0).run(jobs, keep=[job.key for job in jobs])]
    traces = [outcome.trace for outcome in kept if outcome is not None]
    assert len(traces) == len(kept) == 10
    assert all(np.array_equal(trace, traces[0]) for trace in traces)


def test_a_row_holds_what_the_scenario_reported() -> None:
    row, outcome = measure(plan(methods=("first",), settings={"steps": 5}).jobs()[0])
    assert outcome is not None
    assert row.metrics == {"error": outcome.metrics["error"], "never": None, "distance_to_reference": 1e-6}
    assert row.curves["size"] == {"at": [0, 1, 2, 3, 4], "values": row.curves["size"]["values"], "over": "time step"}
    np.testing.assert_allclose(row.curves["size"]["values"], np.abs(outcome.trace), rtol=1e-5)
    squared = outcome.trace**2
    inside = (squared >= stats.chi2.ppf(0.025, 1)) & (squared <= stats.chi2.ppf(0.975, 1))
    assert row.consistency["nees"] == {
        "mean": pytest.approx(squared.mean()), "inside": inside.mean(), "degrees": 1, "samples": 5
    }  # fmt: skip
    assert row.times == {"compile": 0.5, "solve": 5e-3}
    assert (row.steps, row.step_median, row.step_p95, row.step_max) == (5, 1e-3, 1e-3, 1e-3)
    assert row.status == {"solved": 4, "inaccurate": 1}
    assert row.wall is not None
    assert row.wall > 0
    assert row.failure is None


@pytest.mark.parametrize(
    ("mode", "message"), [("raise", "ArithmeticError: the estimate diverged"), ("exit", "SystemExit: 3")]
)
def test_an_estimator_that_raises_costs_its_row_only(mode: str, message: str) -> None:
    rows = [row for row, _ in LocalProcesses(0).run(plan(settings={"mode": mode}).jobs())]
    failed = [row for row in rows if row.failure]
    assert [row.job.method for row in failed] == ["first", "first"]
    assert len(rows) == 6
    failure = failed[0].failure
    assert failure is not None
    assert f"{failure.kind}: {failure.message}" == message
    assert "toy_scenarios.py" in failure.traceback
    assert failed[0].status == {"failed": 1}


def test_a_curve_is_thinned_evenly_and_keeps_its_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    from problems import registry

    toy = registry.load("scenarios", "toy")
    values = np.where(np.arange(1001) % 2, np.nan, np.arange(1001) / 3)
    made = Outcome({"error": 1.0}, curves={"c": Curve(values, at=np.arange(1001) * 0.5, over="time, s")})
    monkeypatch.setattr(type(toy), "run", lambda *_: made)
    curve = measure(plan().jobs()[0])[0].curves["c"]
    assert curve["over"] == "time, s"
    assert (len(curve["at"]), curve["at"][0], curve["at"][-1]) == (POINTS, 0.0, 500.0)
    assert np.ptp(np.diff(curve["at"])) <= 1.0
    assert curve["values"][0] == 0.0
    assert curve["values"][-1] == pytest.approx(1000 / 3, rel=1e-5)
    assert None in curve["values"]


def test_a_scenario_without_reference_or_estimate_has_no_distance() -> None:
    metrics = {row.job.method: row.metrics for row, _ in LocalProcesses(0).run(plan(trials=1).jobs())}
    assert metrics["first"]["distance_to_reference"] == 1e-6
    assert "distance_to_reference" not in metrics["kalman"]


def test_a_pairing_that_does_not_exist_is_no_failure_and_not_tried_again(tmp_path: Path) -> None:
    todo = plan(trials=2, methods=("mean",), solvers=("swift", "slow"), settings={"mode": "unfit"})
    with Store(tmp_path) as store:
        rows = list(run_plan(todo, store, LocalProcesses(0)))
    assert [(row.job.solver, row.impossible, sum(row.status.values())) for row in rows] == [
        ("swift", False, 4), ("slow", True, 0), ("swift", False, 4), ("slow", True, 0)
    ]  # fmt: skip
    with Store(tmp_path) as store:
        assert missing(todo.jobs(), store) == []


def test_warnings_are_part_of_the_row() -> None:
    row, _ = measure(plan(settings={"mode": "warn"}).jobs()[0])
    assert row.warnings == ["UserWarning: half of the data is missing"]


def test_a_scenario_that_reports_unknown_times_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    from problems import registry

    toy = registry.load("scenarios", "toy")
    monkeypatch.setattr(type(toy), "run", lambda *_: Outcome({"error": 1.0}, times={"slove": 1.0}))
    row, _ = measure(plan().jobs()[0])
    assert row.failure is not None
    assert "slove" in row.failure.message


def test_nan_is_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    from problems import registry

    toy = registry.load("scenarios", "toy")
    monkeypatch.setattr(type(toy), "run", lambda *_: Outcome({"error": float("nan")}, residual=float("inf")))
    row, _ = measure(plan().jobs()[0])
    assert row.metrics["error"] is None
    assert row.residual is None


@pytest.mark.serial
def test_processes_and_this_process_give_the_same_rows() -> None:
    jobs = plan(trials=5, settings={"mode": ["calm", "raise"]}).jobs()
    here = {row.job.key: without_times(row) for row, _ in LocalProcesses(0).run(jobs)}
    there = {row.job.key: without_times(row) for row, _ in LocalProcesses(2).run(jobs)}
    assert here.keys() == there.keys()
    for key, row in here.items():
        for record in (row, there[key]):
            (record["failure"] or {}).pop("traceback", None)
        assert row == there[key]


@pytest.mark.serial
@pytest.mark.parametrize(("mode", "reason"), [("crash", "SIGSEGV"), ("hang", "time limit of 2 s")])
def test_a_worker_that_dies_or_hangs_costs_its_row_only(mode: str, reason: str) -> None:
    jobs = plan(trials=1, settings={"mode": mode, "steps": [3, 4]}).jobs()
    rows = {row.job.key: row for row, _ in LocalProcesses(1).run(jobs, time_limit=2.0)}
    assert len(rows) == len(jobs) == 6
    for row in rows.values():
        assert (row.failure is not None) == (row.job.method == "first")
        assert row.failure is None or reason in row.failure.message


@pytest.mark.serial
def test_only_the_outcomes_that_are_wanted_cross_the_process_boundary() -> None:
    jobs = plan(trials=2, methods=("mean",)).jobs()
    kept = {row.job.trial: outcome for row, outcome in LocalProcesses(1).run(jobs, keep=[jobs[0].key])}
    assert kept[0] is not None
    assert np.array_equal(kept[0].trace, trial_rng(0, "toy", 0).normal(size=4))
    assert kept[1] is None


@pytest.mark.serial
def test_an_outcome_that_cannot_be_sent_is_a_failure_of_its_row() -> None:
    jobs = plan(trials=1, settings={"mode": "unpicklable"}).jobs()
    rows = {row.job.method: row for row, _ in LocalProcesses(1).run(jobs, keep=[job.key for job in jobs])}
    assert rows["mean"].failure is None
    assert rows["first"].failure is not None
    assert "pickle" in rows["first"].failure.message


@pytest.mark.serial
def test_workers_have_one_thread_and_leave_the_environment_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    seen = []
    for row, _ in LocalProcesses(1).run(plan(trials=1, methods=("mean",)).jobs()):
        seen.append((row.failure, os.environ["OMP_NUM_THREADS"]))
    assert seen == [(None, "1")]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_second_run_repeats_only_what_failed(tmp_path: Path) -> None:
    todo = plan(trials=3, settings={"mode": "raise"})
    with Store(tmp_path) as store:
        first = list(run_plan(todo, store, LocalProcesses(0)))
    with Store(tmp_path) as store:
        second = list(run_plan(todo, store, LocalProcesses(0)))
    assert len(first) == 9
    assert [row.job.method for row in second] == ["first"] * 3


def test_more_trials_of_the_same_plan_add_to_it(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        list(run_plan(plan(trials=2), store, LocalProcesses(0)))
    with Store(tmp_path) as store:
        jobs = plan(trials=4).jobs()
        assert [job.trial for job in missing(jobs, store)] == [2] * 3 + [3] * 3


def test_a_job_is_its_content() -> None:
    one = Job("toy", "mean", "auto", {"a": 1, "b": 2}, 0, 0)
    same = Job("toy", "mean", "auto", {"b": 2, "a": 1}, 0, 0)
    other = Job("toy", "mean", "auto", {"a": 1, "b": 2}, 0, 1)
    assert one.key == same.key != other.key
