"""The page of a report is one file: failures, points, pictures, prose."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from report_pages import NASTY, Page

from problems.bench import plots
from problems.bench.html import prose
from problems.bench.store import Results
from problems.bench.summary import summarize

pytestmark = pytest.mark.usefixtures("toy_package")


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


def test_prose_knows_headings_lists_and_code() -> None:
    shown = prose("One\ntwo <b>.\n\n## Head\n\n- first `a < b`\n- second\n  line\n\nEnd")
    assert shown == (
        "<p>One two &lt;b&gt;.</p>\n<h3>Head</h3>\n"
        "<ul><li>first <code>a &lt; b</code></li><li>second line</li></ul>\n<p>End</p>"
    )
