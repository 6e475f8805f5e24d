"""Where rows are kept: a journal that survives a kill, compacted to Parquet.

The journal (`journal.jsonl`) holds one JSON object a line, a `session` for each time the benchmark was started in the
folder and a `row` for each finished job. A row is handed to the operating system before the next one is looked at, so
no finished row is lost with the process, however it dies. A thread syncs the disk every `SYNC_SECONDS`, so a power
failure costs the rows of that time at most, and the campaign never waits for the disk. `rows.parquet` is made from the
journal and holds the same (`problems.bench.parquet`).
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import threading
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

from problems import registry
from problems.bench import machine, parquet
from problems.bench.plan import Plan
from problems.bench.rows import Row
from problems.bench.settings import describe
from problems.errors import ReadError, WriteError

JOURNAL = "journal.jsonl"
ROW_BYTES = 10_000  # of journal and Parquet together, generously
SYNC_SECONDS = 0.2
SPARE_BYTES = 16 * 2**20


class Store:
    """A folder open for writing by one campaign at a time.

    Args:
        folder: made when it does not exist.
        fresh: forget the rows that are there.

    Raises:
        WriteError: the folder cannot be written, or another campaign is writing to it.
        ReadError: the journal holds a line that is none of ours.
    """

    def __init__(self, folder: str | Path, fresh: bool = False) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file = open(self.folder / JOURNAL, "a+b", buffering=0)
        except OSError as error:
            raise WriteError(self.folder, str(error.strerror or error)) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            raise WriteError(self.folder, "another run is writing to this folder") from error
        try:
            whole = 0 if fresh else _complete_length(self.folder / JOURNAL)
            if whole < self._file.seek(0, os.SEEK_END):
                self._file.truncate(whole)
            if fresh:
                (self.folder / parquet.NAME).unlink(missing_ok=True)
            rows, _ = _read_journal(self.folder)
        except BaseException:
            self._file.close()
            raise
        self.finished = {row.job.key: row for row in rows if row.failure is None or row.impossible}
        self._disk = _Disk(self._file.fileno())

    def begin(self, plan: Plan, workers: int, jobs: int) -> None:
        """Record the start of a campaign; the last chance to fail before work starts.

        Args:
            plan: what will be run.
            workers: number of processes.
            jobs: rows that will be written.

        Raises:
            WriteError: there is not enough space for them.
        """
        free, needed = shutil.disk_usage(self.folder).free, jobs * ROW_BYTES + SPARE_BYTES
        if free < needed:
            raise WriteError(self.folder, f"{free / 2**20:.0f} MiB are free, {jobs} rows need {needed / 2**20:.0f} MiB")
        started = datetime.now(UTC).isoformat(timespec="seconds")
        names = dict.fromkeys(study.scenario for study in plan.study)
        session = {
            "started": started,
            "plan": plan.model_dump(mode="json"),
            "scenarios": {name: describe(registry.load("scenarios", name)) for name in names},
            "machine": machine.describe(workers),
        }
        self._write({"session": session})

    def append(self, row: Row) -> None:
        """Write one row; it survives the process when this returns, and a power failure `SYNC_SECONDS` later.

        Raises:
            WriteError: it could not be written. Rows before it are kept.
        """
        self._write({"row": row.to_dict()})

    def _write(self, record: dict[str, Any]) -> None:
        line = json.dumps(record, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        try:
            written = self._file.write(line)
            if written != len(line):
                raise OSError("no space left on device")
            self._disk.dirty()
        except OSError as error:
            raise WriteError(self.folder, str(error.strerror or error)) from error

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._disk.close()
        except OSError as failed:
            raise WriteError(self.folder, str(failed.strerror or failed)) from failed
        finally:
            self._file.close()


class _Disk:
    """A thread that syncs a file while it is written, at most once in `SYNC_SECONDS`."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._written, self._closing = threading.Event(), threading.Event()
        self._error: OSError | None = None
        self._thread: threading.Thread | None = None

    def dirty(self) -> None:
        """The file was written to. Raises what an earlier sync failed with."""
        if self._error is not None:
            raise self._error
        self._written.set()
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Sync what is left and stop. Raises what a sync failed with."""
        self._closing.set()
        self._written.set()
        if self._thread is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def _serve(self) -> None:
        last = False
        while not last:
            self._written.wait()
            self._written.clear()
            last = self._closing.is_set()  # looked at before the sync, so that the last one comes after the last write
            try:
                os.fsync(self._descriptor)
            except OSError as error:
                self._error = error
                return
            self._closing.wait(SYNC_SECONDS)


@dataclass(frozen=True)
class Results:
    """Everything a folder holds.

    Attributes:
        rows: the newest row of each job.
        sessions: {"started", "plan", "scenarios", "machine"} of every start, oldest first.
    """

    rows: list[Row]
    sessions: list[dict[str, Any]]

    @property
    def plan(self) -> dict[str, Any]:
        """The newest plan."""
        return self.sessions[-1]["plan"]

    @property
    def scenarios(self) -> dict[str, dict[str, Any]]:
        """Facts of each scenario by name (`problems.bench.settings.describe`), as they were when it was last run."""
        return {name: facts for session in self.sessions for name, facts in session["scenarios"].items()}


def load(folder: str | Path) -> Results:
    """Read what a benchmark left in a folder, compacting it first when the journal is newer than the Parquet file.

    Raises:
        ReadError: there are no results, or they are damaged.
    """
    folder = Path(folder)
    journal, table = folder / JOURNAL, folder / parquet.NAME
    if not journal.exists() and not table.exists():
        raise ReadError(folder, None, f"a folder written by horizonet bench, with {JOURNAL} or {parquet.NAME}")
    if journal.exists() and not (table.exists() and table.stat().st_mtime_ns >= journal.stat().st_mtime_ns):
        rows, sessions = _read_journal(folder)
        try:
            parquet.write(folder, rows, sessions)
        except WriteError:  # someone else's folder: the journal says the same
            return Results(rows, sessions)
    return Results(*parquet.read(folder))


def _complete_length(journal: Path) -> int:
    """Bytes up to the end of the last whole line; a kill can leave half a line behind."""
    return journal.read_bytes().rfind(b"\n") + 1


def _read_journal(folder: Path) -> tuple[list[Row], list[dict[str, Any]]]:
    rows: dict[str, Row] = {}
    sessions = []
    journal = folder / JOURNAL
    with open(journal, "rb") as lines:
        for number, line in enumerate(lines, start=1):
            if not line.endswith(b"\n"):
                break
            try:
                record = json.loads(line)
                if "session" in record:
                    sessions.append(record["session"])
                else:
                    row = Row.from_dict(record["row"])
                    rows[row.job.key] = row
            except (ValueError, KeyError, TypeError) as error:
                raise ReadError(journal, number, "a line written by horizonet bench", repr(error)) from error
    return list(rows.values()), sessions
