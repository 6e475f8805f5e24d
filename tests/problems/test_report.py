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

from problems.bench import compare, plots
from problems.bench.export import as_csv, as_json, as_markdown, command, number, percent, seconds
from problems.bench.metrics import paired_difference
from problems.bench.plan import Plan, Study
from problems.bench.report import page
from problems.bench.rows import Failure, Job, Row
from problems.bench.run import run_plan
from problems.bench.store import Results, Store, load
from problems.bench.summary import reproduce, summarize
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


def test_every_number_of_the_results_table_follows_from_parquet(folder: Path, results: Results) -> None:
    frame: Any = pd.read_parquet(folder / "rows.parquet")
    frame = frame[frame.scenario == "toy"]
    frame["tolerance"] = [json.loads(text)["tolerance"] for text in frame.settings]
    frame["mode"] = [json.loads(text)["mode"] for text in frame.settings]
    statuses = [name for name in frame.columns if name.startswith("status.")]
    rows = Page(page(results)).tables["Results of toy"]
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
            6: good.step_median.median(),
            7: good.step_p95.median(),
            8: None,
            9: good["times.solve"].median(),
            10: None,
            11: good["times.compile"].median(),
            12: good.cpu.median(),
            13: good.memory.median(),
            14: found["status.solved"].sum() / found[statuses].sum().sum(),
            15: good.iterations.mean(),
            16: good.residual.max(),
            17: (len(found) - len(good)) / len(found),
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


def test_failed_trials_are_listed_with_their_message_and_command(results: Results) -> None:
    text = page(results)
    rows = Page(text).tables["Trials without a result"]
    assert [cell[0] for cell in rows[0][:3]] == ["toy", "first", "swift"]
    assert "ArithmeticError: the estimate diverged" in rows[0][3][0]
    assert "toy_scenarios.py" in rows[0][3][0]
    assert rows[0][4][0] == "6"
    assert rows[0][5][0].startswith(
        "horizonet run toy --method first --solver swift --set tolerance=0.001 --set mode=raise"
    )
    assert len(rows) == 7
    assert NASTY in rows[-1][3][0]
    assert "<script>alert" not in text


def test_the_page_is_one_file_of_balanced_html(results: Results) -> None:
    text = page(results)
    parsed = Page(text)
    assert parsed.open == []
    outside = [address for address in parsed.loads if not address.startswith(("#", "data:"))]
    assert outside == []
    assert "@import" not in text
    assert re.findall(r"url\((?!#)", text) == []
    assert len(text) < 2**20


def test_points_carry_what_filters_look_for(results: Results) -> None:
    text = page(results)
    points = re.findall(r'<g data-method="(\w+)" data-solver="(\w+)"><title>([^<]+)</title>', text)
    named = {(method, solver) for method, solver, _ in points}
    assert named == {(m, s) for m in ("mean", "first") for s in ("swift", "slow")} | {
        ("kalman", "none"),
        ("mean", "auto"),
    }
    assert any("tolerance=1e-09" in title and "75 % solved" in title for _, _, title in points)
    assert "-point-" not in text
    assert "-line-" not in text


def test_the_picture_joins_the_tolerances_of_one_method_and_solver(results: Results) -> None:
    summaries = [s for s in summarize(results.rows) if s.scenario == "toy" and s.settings["mode"] == "calm"]
    figure = plots.accuracy_against_time(summaries, "error", "p")
    axes: Any = figure.axes[0]
    lines = [line for line in axes.lines if "-line-" in (line.get_gid() or "")]
    assert len(lines) == 5
    for line in lines:
        assert len(line.get_xdata()) == 3
    markers = [line for line in axes.lines if "-point-" in (line.get_gid() or "") and line.get_markersize() == 8]
    assert len(markers) == 15
    looks = {(line.get_marker(), str(line.get_markerfacecolor())) for line in markers}
    assert len(looks) == 5  # told apart by shape alone
    assert len({look[0] for look in looks}) == 5


def test_solver_times_count_failures_at_the_limit() -> None:
    def row(solver: str, trial: int, solve: float | None, status: dict[str, int]) -> Row:
        job = Job("toy", "mean", solver, {}, 0, trial)
        if solve is None:
            return Row(job, failure=Failure("E", "e", ""))
        return Row(job, times={"solve": solve}, status=status)

    good, bad, fine = {"solved": 100}, {"solved": 98, "inaccurate": 2}, {"solved": 60, "infeasible": 40}
    rows = [row("a", 0, 1.0, good), row("a", 1, None, good), row("b", 0, 1.0, fine), row("b", 1, 1.0, bad)]
    rows += [row("c", 0, 2.0, good), row("c", 1, 2.0, good)]
    times = {item.solver: item for item in compare.solver_times(rows, limit=100.0)}
    assert list(times) == ["c", "a", "b"]
    assert times["a"].geometric_mean == pytest.approx(10.0, rel=1e-2)
    assert times["c"].geometric_mean == pytest.approx(2.0)
    assert (times["a"].failed, times["b"].failed, times["c"].failed) == (1, 1, 0)
    profile = compare.solver_profile(rows)
    np.testing.assert_allclose(profile["c"][0], [1.0, 2.0])
    np.testing.assert_allclose(profile["a"][1], [0.5])


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


def browse(path: Path, address: str, *options: str) -> subprocess.CompletedProcess[str]:
    quiet = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    home = f"--user-data-dir={path.parent / 'browser'}"
    return subprocess.run(
        [str(CHROMIUM), *quiet, home, "--virtual-time-budget=3000", *options, f"{path.as_uri()}{address}"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip


@pytest.mark.browser
@BROWSER
def test_the_page_renders_without_console_messages(results: Results, tmp_path: Path) -> None:
    path, picture = tmp_path / "report.html", tmp_path / "report.png"
    path.write_text(page(results), encoding="utf-8")
    done = browse(path, "", "--window-size=1300,2400", f"--screenshot={picture}")
    assert "CONSOLE" not in done.stderr
    from matplotlib.image import imread

    image = imread(picture)
    assert image.shape[:2] == (2400, 1300)
    assert len(np.unique(image[::5, ::5, :3].reshape(-1, 3), axis=0)) > 50  # text and pictures, no blank page


@pytest.mark.browser
@BROWSER
def test_filters_and_sorting_work_in_the_browser(results: Results, tmp_path: Path) -> None:
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
    path.write_text(page(results).replace("</body>", probe + "</body>"), encoding="utf-8")
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
