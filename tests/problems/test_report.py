"""The report: its numbers are those of the Parquet table, its page is one file, works by keyboard and in a browser."""

from __future__ import annotations

import csv
import html.parser
import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from problems.bench import compare, curves, parquet, plots
from problems.bench.export import as_csv, as_json, as_markdown, command, number, percent, seconds
from problems.bench.html import prose
from problems.bench.metrics import paired_difference
from problems.bench.plan import Plan, Study
from problems.bench.report import page
from problems.bench.rows import Failure, Job, Row
from problems.bench.run import run_plan
from problems.bench.store import Results, Store, load
from problems.bench.summary import by_configuration, reproduce, summarize
from problems.bench.workers import LocalProcesses

pytestmark = pytest.mark.usefixtures("toy_package")

TOLERANCES = [1e-3, 1e-6, 1e-9]
NASTY = 'diverged: <script>alert("x")</script> & more'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, toy_package: Path) -> Path:
    """Results of two scenarios, with rows that failed."""
    out = tmp_path_factory.mktemp("results")
    toy = Study(
        scenario="toy", solvers=("swift", "slow"), settings={"tolerance": TOLERANCES, "mode": ["calm", "raise"]}
    )
    plan = Plan(
        name="toys & others", text="First part\nof the text.\n\nSecond <part>.", study=(toy, Study(scenario="other"))
    )
    with Store(out) as store:
        for _ in run_plan(plan.model_copy(update={"trials": 6}), store, LocalProcesses(0)):
            pass
        job = Job("other", "mean", "auto", {"steps": 9}, 0, 0)
        store.append(Row(job, failure=Failure("ValueError", NASTY, "Traceback"), status={"failed": 1}))
    return out


@pytest.fixture(scope="module")
def results(folder: Path) -> Results:
    return load(folder)


@pytest.fixture(scope="module")
def shown(results: Results) -> str:
    """The page of these results."""
    return page(results)


class Page(html.parser.HTMLParser):
    """Tables by caption, and everything a page would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[tuple[str, str | None]]]] = {}
        self.loads: list[str] = []
        self.open: list[str] = []
        self._cells: list[list[tuple[str, str | None]]] = []
        self._text, self._value = "", None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.loads += [str(given[name]) for name in ("src", "href", "xlink:href") if name in given]
        if tag not in ("meta", "link", "input", "br"):
            self.open.append(tag)
        if tag == "tr":
            self._cells.append([])
        if tag in ("td", "caption"):
            self._text, self._value = "", given.get("data-value")
        if tag == "table":
            self._cells = []

    def handle_data(self, data: str) -> None:
        self._text += data

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"unbalanced </{tag}>"
        if tag == "caption":
            self._caption = self._text
        if tag == "td":
            self._cells[-1].append((self._text, self._value))
        if tag == "table":
            self.tables[self._caption] = [row for row in self._cells if row]


def test_every_number_of_the_results_table_follows_from_parquet(folder: Path, shown: str) -> None:
    frame: Any = pd.read_parquet(folder / "rows.parquet")
    frame = frame[frame.scenario == "toy"]
    frame["tolerance"] = [json.loads(text)["tolerance"] for text in frame.settings]
    frame["mode"] = [json.loads(text)["mode"] for text in frame.settings]
    statuses = [name for name in frame.columns if name.startswith("status.")]
    rows = Page(shown).tables["Results of toy"]
    assert len(rows) == 30
    for row in rows:
        method, solver, tolerance, mode = (cell[0] for cell in row[:4])
        found = frame[(frame.method == method) & (frame.solver == solver) & (frame["mode"] == mode)]
        found = found[np.isclose(found.tolerance, float(tolerance), rtol=1e-9, atol=0)]
        assert len(found) == 6
        good = found[found["failure.kind"].isna()]
        expected = {
            4: good["metrics.error"].mean(),
            5: None,
            6: good["metrics.distance_to_reference"].mean(),
            7: good.step_median.median(),
            8: good.step_p95.median(),
            9: good.step_max.max(),
            10: None,
            11: good["times.solve"].median(),
            12: None,
            13: good["times.compile"].median(),
            14: good.wall.median(),
            15: good.cpu.median(),
            16: good.memory.median(),
            17: found["status.solved"].sum() / found[statuses].sum().sum(),
            18: good.iterations.mean(),
            19: good.residual.max(),
            20: (len(found) - len(good)) / len(found),
        }
        for column, value in expected.items():
            shown = row[column][1]
            if value is None or np.isnan(value):
                assert shown == "", (column, row)
            else:
                assert float(shown or "nan") == pytest.approx(value, rel=1e-12), (column, row)
        if len(good):
            error = good["metrics.error"].std(ddof=1) / np.sqrt(len(good))
            assert row[4][0] == f"{expected[4]:.4g} ± {error:.2g}"


def frame_of(folder: Path) -> Any:
    """The Parquet table of scenario toy with its settings as columns."""
    frame: Any = pd.read_parquet(folder / "rows.parquet")
    frame = frame[frame.scenario == "toy"].copy()
    for key in ("tolerance", "mode"):
        frame[key] = [json.loads(text)[key] for text in frame.settings]
    return frame


def test_the_heading_counts_what_is_in_parquet(folder: Path, shown: str) -> None:
    frame: Any = pd.read_parquet(folder / "rows.parquet")
    configurations = frame.groupby(["scenario", "method", "solver", "settings", "seed"]).ngroups
    failed = frame["failure.kind"].notna().sum()
    assert f"{len(frame)} trials of {configurations} configurations, {failed} failed; seed 0." in shown


def test_the_robustness_table_follows_from_parquet(folder: Path, shown: str) -> None:
    frame = frame_of(folder)
    statuses = [name for name in frame.columns if name.startswith("status.")]
    rows = Page(shown).tables["Robustness in toy"]
    assert len(rows) == 5
    for row in rows:
        found = frame[(frame.method == row[0][0]) & (frame.solver == row[1][0])]
        steps = found[statuses].sum().sum()
        expected = [len(found), found["failure.kind"].notna().sum(), 0, steps, found["status.solved"].sum() / steps]
        expected += [
            found[f"status.{name}"].sum() if f"status.{name}" in found else 0
            for name in ("inaccurate", "infeasible", "unbounded", "iteration_limit", "time_limit", "failed")
        ]
        assert [float(value or "nan") for _, value in row[2:13]] == pytest.approx([float(each) for each in expected])
        assert row[13][1] == ""  # nothing was infeasible


def test_the_consistency_table_follows_from_parquet(folder: Path, shown: str) -> None:
    frame = frame_of(folder)
    rows = Page(shown).tables["Consistency in toy"]
    assert [(row[0][0], row[1][0]) for row in rows] == [
        ("mean", "swift"), ("mean", "swift"), ("first", "swift"), ("kalman", "none"), ("kalman", "none")
    ]  # fmt: skip
    for row in rows:
        found = frame[(frame.method == row[0][0]) & (frame.solver == row[1][0]) & (frame["mode"] == row[4][0])]
        found = found[(found.tolerance == min(TOLERANCES)) & found["failure.kind"].isna()]
        each = [json.loads(text)["nees"] for text in found.consistency]
        curves = np.array([json.loads(text)["nees"]["values"] for text in found.curves])
        lower, upper = stats.chi2.ppf([0.025, 0.975], 6) / 6
        mean = curves.mean(axis=0)
        expected = [
            np.mean([item["mean"] for item in each]),
            np.mean([item["inside"] for item in each]),
            ((lower <= mean) & (mean <= upper)).mean(),
            1,
            6,
        ]
        shown = [row[place][1] for place in (5, 6, 8, 9, 10)]
        assert [float(value or "nan") for value in shown] == pytest.approx(expected)
        assert row[7][0] == f"[{number(lower)}, {number(upper)}]"


def test_the_tables_of_solvers_follow_from_parquet(folder: Path, results: Results, shown: str) -> None:
    frame = frame_of(folder)
    rows = Page(shown).tables["Solvers of toy on mean, first"]
    frame = frame[frame.method.isin(["mean", "first"])]
    for row in rows:
        found = frame[frame.solver == row[0][0]]
        # a quarter of the toy's steps is inaccurate, so that every trial counts as failed
        assert row[3][0] == f"{len(found)}/{len(found)}"
        assert float(row[1][1] or "nan") == pytest.approx(results.plan["time_limit"])
    assert len(rows) == 2


def test_paired_differences_follow_from_parquet(folder: Path, shown: str) -> None:
    frame = frame_of(folder)
    tables = Page(shown).tables
    rows = tables["Differences of error in toy"]
    assert rows
    for row in rows:
        what, baseline, fixed, tolerance, mode = (cell[0] for cell in row[:5])
        same = frame[(frame["mode"] == mode) & np.isclose(frame.tolerance, float(tolerance), rtol=1e-9, atol=0)]
        same = same.set_index("trial")["metrics.error"], same.set_index("trial")
        ends = []
        for name in (what, baseline):
            chosen = same[1][(same[1].method == name) & (same[1].solver == fixed)]
            if not len(chosen):
                chosen = same[1][(same[1].solver == name) & (same[1].method == fixed)]
            ends.append(chosen["metrics.error"])
        difference = (ends[0] - ends[1]).dropna()
        assert float(row[5][1] or "nan") == pytest.approx(difference.mean(), rel=1e-9, abs=1e-15)
        assert int(row[8][0]) == len(difference)
        half = stats.t.ppf(0.975, len(difference) - 1) * difference.std(ddof=1) / np.sqrt(len(difference))
        lower, upper = difference.mean() - half, difference.mean() + half
        assert row[6][0] == f"[{number(lower)}, {number(upper)}]"
        assert row[7][0] == ("yes" if lower > 0 or upper < 0 else "no")
    effects = tables["Effects of settings in toy"]
    assert {(row[0][0], row[1][0]) for row in effects} == {("mode = raise", "calm")}
    assert len(effects) == 9  # first raises, so that nothing is left to compare
    assert all(float(row[-3][1] or "nan") == 0 for row in effects)


def test_the_texts_of_points_follow_from_parquet(folder: Path, shown: str) -> None:
    frame = frame_of(folder)
    titles = re.findall(r"<title>([^<]*\nerror [^<]*)</title>", shown)
    titles = [title for title in titles if "mode=" in title]
    assert len(titles) == 3 * (5 + 3)
    for title in titles:
        label, settings, metric, time, rest = title.split("\n")
        method, _, solver = label.partition(" · ")
        tolerance = float(settings.split("tolerance=")[1].split(",")[0])
        found = frame[(frame.method == method) & (frame.solver == (solver or "none"))]
        mode = "calm" if settings.endswith("calm") else "raise"
        found = found[np.isclose(found.tolerance, tolerance, rtol=1e-9, atol=0) & (found["mode"] == mode)]
        values = found["metrics.error"]
        assert metric == f"error {values.mean():.4g} ± {values.std(ddof=1) / np.sqrt(len(values)):.2g}"
        assert time == f"median time of a step {seconds(found.step_median.median())}"
        assert rest == f"{found.iterations.mean():.4g} iterations; 75 % solved"


def test_bands_are_the_mean_and_percentiles_of_the_trials(folder: Path, results: Results) -> None:
    frame = frame_of(folder)
    summaries = summarize(results.rows)
    chosen = next(
        s for s in curves.representatives(summaries) if (s.method, s.settings.get("mode")) == ("mean", "calm")
    )
    assert (chosen.solver, chosen.settings["tolerance"]) == ("swift", min(TOLERANCES))
    found = curves.band("size", by_configuration(results.rows)[chosen.configuration], chosen)
    same = frame[(frame.method == "mean") & (frame.solver == "swift") & (frame["mode"] == "calm")]
    values = np.array([json.loads(text)["size"]["values"] for text in same[same.tolerance == 1e-9].curves])
    assert found is not None
    np.testing.assert_allclose(found.mean, values.mean(axis=0))
    np.testing.assert_allclose([found.lower, found.upper], np.percentile(values, [10, 90], axis=0))
    assert found.trials == 6


def test_failed_trials_are_listed_with_their_message_and_command(shown: str) -> None:
    rows = Page(shown).tables["Trials without a result"]
    assert [cell[0] for cell in rows[0][:3]] == ["toy", "first", "swift"]
    assert "ArithmeticError: the estimate diverged" in rows[0][3][0]
    assert "toy_scenarios.py" in rows[0][3][0]
    assert rows[0][4][0] == "6"
    assert rows[0][5][0].startswith(
        "copyhorizonet run toy --method first --solver swift --set tolerance=0.001 --set mode=raise"
    )
    assert len(rows) == 7
    assert NASTY in rows[-1][3][0]
    assert "<script>alert" not in shown


def test_the_page_is_one_file_of_balanced_html(shown: str) -> None:
    parsed = Page(shown)
    assert parsed.open == []
    outside = [address for address in parsed.loads if not address.startswith(("#", "data:"))]
    assert outside == []
    assert "@import" not in shown
    assert re.findall(r"url\((?!#)", shown) == []
    assert len(shown) < 2**20
    names = re.findall(r' id="([^"]*)"', shown)
    assert len(set(names)) == len(names)
    assert set(re.findall(r'(?:xlink:href="#|url\(#|href="#)([\w-]+)', shown)) <= set(names)


def test_points_carry_what_filters_look_for(shown: str) -> None:
    groups = re.findall(r'<g data-method="(\w+)" data-solver="(\w+)">((?:(?!<g data-|</svg>).)*)', shown, re.DOTALL)
    titles = {
        (method, solver): re.findall("<title>([^<]+)</title>", inner)
        for method, solver, inner in groups
        if "<title>" in inner
    }
    assert titles.keys() == {(m, s) for m in ("mean", "first") for s in ("swift", "slow")} | {
        ("kalman", "none"),
        ("mean", "auto"),
    }
    for (method, _), texts in titles.items():
        assert all(title.startswith(method) for title in texts)
    assert any("tolerance=1e-09" in title and "75 % solved" in title for title in titles["mean", "slow"])
    assert len(re.findall('<g data-solver="slow">', shown)) == 1  # its line of the performance profile
    for part in ("points", "bars", "line", "band"):
        assert f"-{part}-" not in shown


def test_the_picture_joins_the_tolerances_of_one_method_and_solver(results: Results) -> None:
    summaries = [s for s in summarize(results.rows) if s.scenario == "toy" and s.settings["mode"] == "calm"]
    marked = plots.accuracy_against(summaries, "error", "p", plots.time_of(summaries))
    axes: Any = marked.figure.axes[0]
    lines = [line for line in axes.lines if "-line-" in (line.get_gid() or "")]
    assert len(lines) == len(marked.groups) == 5
    for line, group in zip(lines, marked.groups, strict=True):
        assert len(group) == 3
        assert np.isfinite(line.get_xdata()).tolist() == [True, True, True, False]
    points = [line for line in axes.lines if "-points-" in (line.get_gid() or "")]
    for line, group in zip(points, marked.groups, strict=True):
        assert list(line.get_ydata()) == [summary.metrics["error"] for summary in group]
    looks = {(line.get_marker(), str(line.get_markerfacecolor())) for line in points}
    assert len(looks) == 5  # told apart by shape alone
    assert len({look[0] for look in looks}) == 5


def test_a_long_legend_fits_into_its_picture() -> None:
    names = [f"solver-{number}" for number in range(40)]
    figure = plots.profile({name: (np.array([1.0, 2.0]), np.array([0.5, 1.0])) for name in names}, "p")
    figure.canvas.draw()
    (legend,) = figure.legends
    assert legend.get_window_extent().y0 >= 0
    assert legend.get_window_extent().y1 <= figure.bbox.height


def test_lines_of_other_settings_are_not_joined(results: Results) -> None:
    summaries = [s for s in summarize(results.rows) if (s.scenario, s.method, s.solver) == ("toy", "mean", "swift")]
    axes: Any = plots.accuracy_against(summaries, "error", "p", plots.time_of(summaries)).figure.axes[0]
    line = next(line for line in axes.lines if "-line-" in (line.get_gid() or ""))
    assert np.isnan(line.get_xdata()).nonzero()[0].tolist() == [3, 7]  # calm and raise apart


def test_distances_of_zero_leave_the_axis_logarithmic(results: Results) -> None:
    summaries = [s for s in summarize(results.rows) if s.scenario == "toy" and s.method == "mean"]
    for summary in summaries[:1]:
        summary.metrics["distance_to_reference"] = 0.0
    axes: Any = plots.accuracy_against(summaries, "distance_to_reference", "p", plots.ITERATIONS).figure.axes[0]
    assert axes.get_yscale() == "log"
    assert min(line.get_ydata().min() for line in axes.lines if "-points-" in (line.get_gid() or "")) == plots.ROUNDING


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


def test_prose_knows_headings_lists_and_code() -> None:
    shown = prose("One\ntwo <b>.\n\n## Head\n\n- first `a < b`\n- second\n  line\n\nEnd")
    assert shown == (
        "<p>One two &lt;b&gt;.</p>\n<h3>Head</h3>\n"
        "<ul><li>first <code>a &lt; b</code></li><li>second line</li></ul>\n<p>End</p>"
    )


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


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
BROWSER = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


def browse(path: Path, address: str, *options: str, timing: bool = False) -> subprocess.CompletedProcess[str]:
    quiet = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    quiet += [] if timing else ["--virtual-time-budget=3000"]  # a virtual clock measures nothing
    home = f"--user-data-dir={path.parent / 'browser'}"
    return subprocess.run(
        [str(CHROMIUM), *quiet, home, *options, f"{path.as_uri()}{address}"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip


@pytest.mark.browser
@BROWSER
def test_the_page_renders_without_console_messages(tmp_path: Path, shown: str) -> None:
    path, picture = tmp_path / "report.html", tmp_path / "report.png"
    path.write_text(shown, encoding="utf-8")
    done = browse(path, "", "--window-size=1300,2400", f"--screenshot={picture}")
    assert "CONSOLE" not in done.stderr
    from matplotlib.image import imread

    image = imread(picture)
    assert image.shape[:2] == (2400, 1300)
    assert len(np.unique(image[::5, ::5, :3].reshape(-1, 3), axis=0)) > 50  # text and pictures, no blank page


@pytest.mark.browser
@BROWSER
def test_filters_and_sorting_work_in_the_browser(tmp_path: Path, shown: str) -> None:
    path = tmp_path / "report.html"
    probe = """<script>
      const rows = () => [...document.querySelectorAll("tr.result:not([hidden])")];
      const off = document.querySelectorAll("svg .off").length;
      const filtered = rows().length;
      const box = document.querySelector('input[value="slow"]');
      box.checked = false; box.dispatchEvent(new Event("change"));
      const fewer = rows().length, address = location.hash;
      const table = document.querySelector("tr.result").closest("table");
      const column = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent === "error");
      const values = () => [...table.tBodies[0].rows].map((row) => row.cells[column].dataset.value);
      const button = table.tHead.rows[0].cells[column].querySelector("button");
      button.click(); const up = values(); button.click(); const down = values();
      document.title = JSON.stringify({off, filtered, fewer, address, up, down});
    </script>"""
    path.write_text(shown.replace("</body>", probe + "</body>"), encoding="utf-8")
    done = browse(path, "#no-method=kalman", "--dump-dom")
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title
    found = json.loads(html_unescape(title[1]))
    assert found["off"] > 0
    assert found["filtered"] == 32 - 6
    assert found["fewer"] == 32 - 6 - 12
    assert found["address"] == "#no-method=kalman&no-solver=slow"
    up = [float(value) for value in found["up"] if value != ""]
    assert up == sorted(up)
    assert [float(value) for value in found["down"] if value != ""] == up[::-1]
    assert found["up"][-1] == found["down"][-1] == ""  # missing values stay last


def html_unescape(text: str) -> str:
    from html import unescape

    return unescape(text)


@pytest.mark.browser
@BROWSER
def test_points_are_reached_by_the_arrow_keys(tmp_path: Path, shown: str) -> None:
    path = tmp_path / "report.html"
    probe = """<script>
      const figure = [...document.querySelectorAll("figure")].find((one) => one.querySelector(".point"));
      const told = [];
      const press = (key) => figure.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
      figure.focus();
      for (const key of ["ArrowRight", "ArrowRight", "ArrowLeft"]) {
        press(key);
        told.push(document.querySelector(".card").textContent);
      }
      const focused = document.activeElement === figure, shown = !document.querySelector(".card").hidden;
      press("Escape");
      const gone = document.querySelector(".card").hidden;
      const none = document.querySelector(".filters .none");
      none.click();
      const left = document.querySelectorAll("tr.result:not([hidden])").length;
      none.parentElement.querySelector(".all").click();
      const back = document.querySelectorAll("tr.result:not([hidden])").length;
      document.title = JSON.stringify({told, focused, shown, gone, left, back});
    </script>"""
    path.write_text(shown.replace("</body>", probe + "</body>"), encoding="utf-8")
    done = browse(path, "", "--dump-dom")
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title
    found = json.loads(html_unescape(title[1]))
    first, second, third = found["told"]
    assert first == third != second
    assert "error" in first or "distance" in first
    assert (found["focused"], found["shown"], found["gone"]) == (True, True, True)
    assert (found["left"], found["back"]) == (0, 32)


def large(rows: int, configurations: int) -> Results:
    """Generated results: rows of so many configurations in two scenarios, with curves, failures and warnings."""
    rng = np.random.default_rng(0)
    found = []
    facts = {
        "methods": ["mhe"],
        "settings": {"tolerance": 1e-6, "horizon": 5},
        "metrics": ["rmse", "bias"],
        "source": "",
    }
    curve_at = list(range(64))
    for number_of in range(rows):
        configuration, trial = number_of % configurations, number_of // configurations
        scenario = ("alpha", "beta")[configuration % 2]
        solver = ("osqp", "daqp", "proxqp", "piqp", "ipopt")[configuration // 2 % 5]
        settings = {"tolerance": 10.0 ** -(2 + configuration // 10 % 8), "horizon": configuration // 80}
        job = Job(scenario, "mhe", solver, settings, 0, trial)
        if number_of % 997 == 0:
            failure = Failure("ArithmeticError", f"diverged in step {number_of}", "Traceback\n" * 40)
            found.append(Row(job, failure=failure, status={"failed": 1}))
            continue
        time, error = rng.lognormal(-7), rng.lognormal()
        found.append(
            Row(
                job,
                metrics={"rmse": error, "bias": error / 3, "distance_to_reference": settings["tolerance"] * error},
                times={"compile": 0.1, "update": time / 2, "solve": time},
                steps=60,
                step_median=time / 60,
                step_p95=time / 30,
                step_max=time / 10,
                status={"solved": 58, "infeasible": 2},
                iterations=int(600 * error),
                residual=settings["tolerance"] / 2,
                curves={
                    "error": {"at": curve_at, "values": rng.lognormal(size=64).round(4).tolist(), "over": "time step"}
                },
                consistency={"nees": {"mean": 1.0, "inside": 0.95, "degrees": 3, "samples": 64}},
                wall=time * 2,
                cpu=time * 2,
                memory=2**20,
                warnings=[f"UserWarning: {number_of}"] if number_of % 500 == 0 else [],
            )
        )
    session = {
        "started": "2026-01-01T00:00:00+00:00",
        "plan": {"name": "large", "text": "", "seed": 0, "trials": rows // configurations, "time_limit": 10.0}
        | {"study": []},
        "scenarios": {name: facts for name in ("alpha", "beta")},
        "machine": {"processor": "p", "cores": 2, "system": "s", "python": "3", "workers": 1}
        | {"threads": {}, "versions": {}},
    }
    return Results(found, [session])


@pytest.mark.parametrize("configurations", [60, 3000])
def test_a_page_of_many_rows_holds_aggregates_only(configurations: int) -> None:
    text = page(large(6000, configurations))
    assert len(text.encode()) < 4 * 2**20
    assert text.count('class="point"') <= 3000
    assert text.count('<tr class="result"') <= 1000
    assert ("are shown, evenly chosen; the CSV has all" in text) == (configurations > 1000)


@pytest.mark.slow
@pytest.mark.browser
@BROWSER
@pytest.mark.parametrize("configurations", [1000, 50_000])
def test_a_hundred_thousand_rows_open_in_three_seconds(tmp_path: Path, configurations: int) -> None:
    path = tmp_path / "report.html"
    probe = """<script>addEventListener("load", () => {
      document.body.offsetHeight;  // everything is laid out
      document.title = JSON.stringify({milliseconds: performance.now(), rows: document.querySelectorAll("tr").length});
    });</script>"""
    results = large(100_000, configurations)
    parquet.write(tmp_path, results.rows, results.sessions)
    path.write_text(page(Results(*parquet.read(tmp_path))).replace("</body>", probe + "</body>"), encoding="utf-8")
    assert path.stat().st_size < 8 * 2**20
    done = browse(path, "", "--dump-dom", timing=True)
    assert "CONSOLE" not in done.stderr
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title
    found = json.loads(html_unescape(title[1]))
    print(f"{configurations} configurations: {path.stat().st_size / 2**20:.1f} MiB, {found}")
    assert found["milliseconds"] < 3000
