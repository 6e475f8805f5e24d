"""The store: nothing finished is lost, and a folder that cannot take the rows says so before work starts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from problems.bench import store as store_module
from problems.bench.plan import Plan, Study
from problems.bench.rows import Row
from problems.bench.run import run_plan
from problems.bench.store import JOURNAL, Store, load
from problems.bench.workers import LocalProcesses
from problems.errors import ReadError, WriteError

pytestmark = pytest.mark.usefixtures("toy_package")


def plan(trials: int = 3, mode: str = "raise") -> Plan:
    study = Study(scenario="toy", settings={"mode": ["calm", mode], "tolerance": [1e-3, 1e-6]})
    return Plan(study=(study, Study(scenario="other")), trials=trials)


def filled(folder: Path) -> list[Row]:
    with Store(folder) as store:
        return list(run_plan(plan(), store, LocalProcesses(0)))


def test_parquet_gives_back_the_rows_of_the_journal(tmp_path: Path) -> None:
    rows = filled(tmp_path)
    results = load(tmp_path)
    assert results.rows == rows
    (tmp_path / JOURNAL).unlink()
    assert load(tmp_path) == results  # from Parquet alone
    session = results.sessions[0]
    assert session["machine"]["versions"]["numpy"]
    assert session["machine"]["threads"].keys() >= {"OMP_NUM_THREADS"}
    assert results.scenarios["other"]["methods"] == ["mean"]
    assert results.plan["trials"] == 3


def test_the_table_is_fit_for_pandas(tmp_path: Path) -> None:
    rows = filled(tmp_path)
    load(tmp_path)
    frame: Any = pd.read_parquet(tmp_path / "rows.parquet")
    good = [row for row in rows if row.failure is None and row.job.scenario == "toy"]
    mean = frame[frame["failure.kind"].isna() & (frame.scenario == "toy")]["metrics.error"].mean()
    assert mean == pytest.approx(sum(row.metrics["error"] or 0.0 for row in good) / len(good))
    assert json.loads(frame.settings[0])["steps"] == 4


def test_half_a_line_at_the_end_is_dropped(tmp_path: Path) -> None:
    rows = filled(tmp_path)
    journal = tmp_path / JOURNAL
    whole = journal.read_bytes()
    journal.write_bytes(whole[:-20])
    assert load(tmp_path).rows == rows[:-1]
    with Store(tmp_path) as store:
        again = list(run_plan(plan(), store, LocalProcesses(0)))
    lost = [row.job.key for row in rows[-1:]]
    failed = [row.job.key for row in rows if row.failure]
    assert sorted(row.job.key for row in again) == sorted({*lost, *failed})
    for line in journal.read_text().splitlines():
        json.loads(line)
    assert {row.job.key for row in load(tmp_path).rows} == {row.job.key for row in rows}


def test_a_damaged_line_is_named(tmp_path: Path) -> None:
    filled(tmp_path)
    journal = tmp_path / JOURNAL
    lines = journal.read_text().splitlines()
    lines[4] = lines[4][:30]
    journal.write_text("\n".join(lines) + "\n")
    with pytest.raises(ReadError, match=rf"{JOURNAL}:5: expected a line written by horizonet bench"):
        Store(tmp_path)


def test_a_folder_without_results(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="a folder written by horizonet bench"):
        load(tmp_path)


def test_damaged_parquet_is_named(tmp_path: Path) -> None:
    (tmp_path / "rows.parquet").write_bytes(b"not parquet")
    with pytest.raises(ReadError, match="rows.parquet"):
        load(tmp_path)


def test_two_campaigns_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with Store(tmp_path), pytest.raises(WriteError, match="another run is writing"):
        Store(tmp_path)
    Store(tmp_path)


def test_a_fresh_store_forgets(tmp_path: Path) -> None:
    filled(tmp_path)
    load(tmp_path)
    with Store(tmp_path, fresh=True) as store:
        assert not store.finished
    assert sorted(item.name for item in tmp_path.iterdir()) == [JOURNAL]


@pytest.mark.parametrize("folder", ["/proc/horizonet", "file/results"])
def test_a_folder_that_cannot_be_written(tmp_path: Path, folder: str) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WriteError, match="cannot write to"):
        Store(tmp_path / folder)


def test_a_full_disk_is_refused_before_work_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module.shutil, "disk_usage", lambda _: SimpleNamespace(free=2**20))
    with Store(tmp_path) as store, pytest.raises(WriteError, match="1 MiB are free, 39 rows need 16 MiB"):
        next(run_plan(plan(), store, LocalProcesses(0)))


def test_a_disk_that_fills_up_on_the_way_keeps_what_was_written(tmp_path: Path) -> None:
    # A limit on the size of files stands in for the disk: the write that crosses it comes back short.
    code = (
        "import resource, signal, sys\n"
        "from problems.bench.store import Store\n"
        "from problems.bench.rows import Job, Row\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))\n"
        "with Store(sys.argv[1]) as store:\n"
        "    for trial in range(100):\n"
        "        store.append(Row(Job('toy', 'mean', 'auto', {}, 0, trial)))\n"
        "        print(trial, flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False)
    assert "WriteError: cannot write to" in done.stderr
    with Store(tmp_path) as store:
        assert len(store.finished) == len(done.stdout.split()) > 2


@pytest.mark.serial
def test_a_killed_campaign_keeps_its_rows_and_goes_on(tmp_path: Path, toy_package: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "problems.cli", "bench", "toy", "--trials", "700", "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(toy_package), os.environ.get("PYTHONPATH", "")])}
    campaign = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    journal = out / JOURNAL
    deadline = time.monotonic() + 60
    while (
        not (journal.exists() and journal.read_bytes().count(b'"row"') > 200)
        and campaign.poll() is None
        and time.monotonic() < deadline
    ):
        time.sleep(0.01)
    campaign.send_signal(signal.SIGKILL)
    campaign.wait()
    before = {row.job.key: row for row in load(out).rows}
    assert 200 < len(before) < 2100, "the kill came too late or the campaign never started"
    subprocess.run([*command, "--workers", "2"], env=environment, check=True, stdout=subprocess.DEVNULL)
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    assert sum("row" in line for line in lines) == 2100  # nothing was run twice
    after = {row.job.key: row for row in load(out).rows}
    assert len(after) == 2100
    assert all(after[key] == row for key, row in before.items())
    assert len(load(out).sessions) == 2
