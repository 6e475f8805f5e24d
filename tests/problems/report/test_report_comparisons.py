"""What a report compares: solvers, settings, pairs of trials; what it writes beside the page."""

from __future__ import annotations

import csv
import io
import json
from typing import Any

import numpy as np
import pytest
from report_pages import Page

from problems.bench import compare
from problems.bench.export import as_csv, as_json, as_markdown, command, number, percent, seconds
from problems.bench.metrics import paired_difference
from problems.bench.report import page
from problems.bench.rows import Failure, Job, Row
from problems.bench.store import Results
from problems.bench.summary import reproduce, summarize

pytestmark = pytest.mark.usefixtures("toy_package")


def test_solver_times_count_failures_at_the_limit() -> None:
    def row(solver: str, trial: int, solve: float | None, status: dict[str, int]) -> Row:
        job = Job("toy", "mean", solver, {}, 0, trial)
        if solve is None:
            return Row(job, failure=Failure("E", "e", ""))
        return Row(job, times={"solve": solve}, status=status)

    good, bad, fine = {"solved": 100}, {"solved": 98, "inaccurate": 2}, {"solved": 60, "infeasible": 40}
    rows = [row("a", 0, 1.0, good), row("a", 1, None, good), row("b", 0, 1.0, fine), row("b", 1, 1.0, bad)]
    rows += [row("c", 0, 2.0, good), row("c", 1, 2.0, good)]
    (contest,) = compare.contests(rows)
    times = {item.solver: item for item in contest.means(limit=100.0)}
    assert list(times) == ["c", "a", "b"]
    assert times["a"].geometric_mean == pytest.approx(10.0, rel=1e-2)
    assert times["c"].geometric_mean == pytest.approx(2.0)
    assert (times["a"].failed, times["b"].failed, times["c"].failed) == (1, 1, 0)
    profile = contest.profile()
    np.testing.assert_allclose(profile["c"][0], [1.0, 2.0])
    np.testing.assert_allclose(profile["a"][1], [0.5])


def test_solvers_are_compared_on_the_problems_they_share() -> None:
    def row(method: str, loss: str, solver: str, trial: int, failure: Failure | None = None) -> Row:
        return Row(Job("toy", method, solver, {"loss": loss}, 0, trial), times={"solve": 1.0}, failure=failure)

    impossible = Failure("FormError", "no", "")
    rows = [row("ls", loss, solver, k) for loss in ("l2", "huber") for solver in ("qp", "graph") for k in (0, 1)]
    rows += [row("ml", "l2", solver, k) for solver in ("graph", "nlp") for k in (0, 1)]
    rows += [row("ml", "l2", "qp", k, impossible) for k in (0, 1)]
    rows += [row("ls", "huber", "nlp", k) for k in (0, 1)]
    rows += [row("ml", "huber", "graph", 0)]  # alone
    found = {contest.label: contest.times for contest in compare.contests(rows)}
    assert {label: {solver: len(t) for solver, t in times.items()} for label, times in found.items()} == {
        "ls; loss l2": {"qp": 2, "graph": 2},
        "ls; loss huber": {"qp": 2, "graph": 2, "nlp": 2},
        "ml; loss l2": {"graph": 2, "nlp": 2},
    }
    del rows[0]  # a campaign that was interrupted: trial 0 of qp is missing
    found = {contest.label: contest.times for contest in compare.contests(rows)}
    assert {solver: len(t) for solver, t in found["ls; loss l2"].items()} == {"qp": 1, "graph": 1}


def test_effects_of_a_setting_are_paired() -> None:
    def row(warm: bool, trial: int, seconds: float, iterations: int) -> Row:
        job = Job("toy", "mean", "swift", {"warm": warm, "steps": 4}, 0, trial)
        return Row(job, metrics={"error": 1.0}, times={"solve": seconds}, iterations=iterations)

    cold = [(3.0, 9), (5.0, 9), (4.5, 12), (2.0, 7)]
    warm = [(1.0, 4), (2.0, 5), (1.5, 4)]
    rows = [row(True, k, *each) for k, each in enumerate(warm)] + [row(False, k, *each) for k, each in enumerate(cold)]
    (effect,) = compare.setting_differences(rows, "error", ["warm"])
    assert (effect.setting, effect.value, effect.baseline) == ("warm", False, True)
    assert effect.settings == {"steps": 4}
    assert effect.time == paired_difference([3.0, 5.0, 4.5], [1.0, 2.0, 1.5])
    assert effect.iterations == paired_difference([9, 9, 12], [4, 5, 4])
    assert effect.metric is not None
    assert effect.metric.mean == 0


def test_infeasible_steps_are_handled_when_the_trial_goes_on() -> None:
    rows = [Row(Job("toy", "mean", "a", {}, 0, 0), status={"solved": 7, "infeasible": 3})]
    failed = Failure("E", "e", "")
    rows += [Row(Job("toy", "mean", "a", {}, 0, 1), status={"infeasible": 1}, failure=failed)]
    (found,) = compare.robustness(rows)
    assert (found.trials, found.failed, found.impossible) == (2, 1, 0)
    assert found.infeasible_handled == pytest.approx(0.75)


def test_pairings_that_do_not_exist_stand_apart_from_failures(results: Results) -> None:
    job = Job("other", "mean", "slow", results.rows[-1].job.settings, 0, 0)
    row = Row(job, failure=Failure("FormError", "solver 'slow' takes factor graphs only", "Traceback"))
    changed = Results([row_ for row_ in results.rows if row_.failure is None] + [row], results.sessions)
    text = page(changed)
    parsed = Page(text)
    assert "1 trials belong to pairings" in text
    assert "Trials without a result" not in parsed.tables
    assert "takes factor graphs only" in parsed.tables["Pairings that do not exist"][0][3][0]
    assert "traceback" not in parsed.tables["Pairings that do not exist"][0][3][0]
    assert any(row[-2][0] == "impossible" for row in parsed.tables["Results of other"])


def test_differences_are_paired_with_everything_else_equal(results: Results) -> None:
    rows = [row for row in results.rows if row.job.scenario == "toy" and row.job.settings["mode"] == "calm"]
    pairs = compare.method_differences(rows, "error", ["mean", "first", "kalman"])
    assert {(pair.what, pair.baseline, pair.fixed) for pair in pairs} == {
        ("first", "mean", "swift"),
        ("first", "mean", "slow"),
    }
    one = next(pair for pair in pairs if pair.settings["tolerance"] == 1e-6 and pair.fixed == "slow")
    by_method: dict[str, list[Any]] = {"mean": [], "first": []}
    for row in rows:
        if row.job.method in by_method and row.job.solver == "slow" and row.job.settings["tolerance"] == 1e-6:
            by_method[row.job.method].append(row.metrics["error"])
    assert one.difference == paired_difference(by_method["first"], by_method["mean"])
    solvers = compare.solver_differences(rows, "error")
    assert {(pair.what, pair.baseline) for pair in solvers} == {("slow", "swift")}
    assert all(pair.difference.mean == 0 for pair in solvers)  # the toy ignores its solver


def test_a_solverless_baseline_serves_all_solvers(results: Results) -> None:
    rows = [row for row in results.rows if row.job.scenario == "toy" and row.job.settings["mode"] == "calm"]
    pairs = compare.method_differences(rows, "error", ["kalman", "mean", "first"])
    assert {(pair.what, pair.fixed) for pair in pairs} == {(m, s) for m in ("mean", "first") for s in ("swift", "slow")}


def test_markdown_and_csv_say_the_same(results: Results) -> None:
    summaries = summarize(results.rows)
    lines = list(csv.DictReader(io.StringIO(as_csv(summaries, results.scenarios))))
    assert len(lines) == len(summaries)
    for line, summary in zip(lines, summaries, strict=True):
        mean = summary.metrics.get("error")
        assert line["metric.error"] == ("" if mean is None else repr(mean))
        assert line["reproduce"] == command(summary, results.scenarios)
        assert line["setting.steps"] == str(summary.settings["steps"])
    text = as_markdown(summaries, results.scenarios)
    assert text.count("\n| ") == len(summaries) + 2 * 2
    assert all(f"`{command(summary, results.scenarios)}`" in text for summary in summaries)


def test_json_of_a_report_has_the_fields_of_the_contract(results: Results) -> None:
    found = as_json(summarize(results.rows), results.scenarios, 6, {})
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert list(found) == ["scenario", "seed", "trials", "settings", "rows"]
    failed = next(row for row in found["rows"] if row["method"] == "first" and row["settings"]["mode"] == "raise")
    assert failed["metrics"] == {"error": None, "never": None}
    assert failed["metrics_se"] == {}
    assert failed["status"]["failed"] == 6


def test_reproduce_quotes_and_leaves_defaults_out() -> None:
    job = Job("toy", "mean", "none", {"steps": 4, "label": "a b", "offset": 0.5}, 7, 2)
    line = reproduce(job, {"steps": 4, "label": "1", "offset": 0.0})
    assert line == "horizonet run toy --method mean --set 'label=a b' --set offset=0.5 --trials 3 --seed 7"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"),
        (0.0, "0"),
        (3600.0, "3600 s"),
        (1.234, "1.23 s"),
        (0.0123, "12.3 ms"),
        (9e-6, "9 µs"),
        (3e-9, "0.003 µs"),
    ],
)
def test_times_are_shown_in_the_unit_that_suits_them(value: float | None, shown: str) -> None:
    assert seconds(value) == shown


def test_a_hundred_percent_means_all() -> None:
    assert percent(1.0) == "100 %"
    assert percent(0.999999) == "99.99 %"
    assert percent(None) == number(None) == "–"
