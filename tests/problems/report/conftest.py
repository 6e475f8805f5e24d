"""A small benchmark, its results and its page; `report_pages`, which the tests share, is made importable."""

# ruff: noqa: E402

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("report_pages")

from report_pages import NASTY, TOLERANCES

from problems.bench.plan import Plan, Study
from problems.bench.report import page
from problems.bench.rows import Failure, Job, Row
from problems.bench.run import run_plan
from problems.bench.store import Results, Store, load
from problems.bench.workers import LocalProcesses


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
