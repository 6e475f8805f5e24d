"""The numbers of a report are those of the Parquet table."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from report_pages import TOLERANCES, Page
from scipy import stats

from problems.bench import curves
from problems.bench.export import number, seconds
from problems.bench.store import Results
from problems.bench.summary import by_configuration, summarize

pytestmark = pytest.mark.usefixtures("toy_package")


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
