"""What executes jobs: one small interface, and the processes of this machine behind it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from problems.bench.measure import failure_of, measure
from problems.bench.rows import Failure, Job, Row
from problems.bench.scenario import Outcome

THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
AHEAD = 2  # jobs handed to a worker at a time: the next one starts while the row before is written to disk

Result = tuple[Row, Outcome | None]


class Executor(Protocol):
    """The whole interface between a campaign and what executes it: jobs in, rows out, in any order.

    Attributes:
        workers: number of processes, as the report names it.
    """

    @property
    def workers(self) -> int: ...

    def run(self, jobs: Sequence[Job], time_limit: float | None = None, keep: Collection[str] = ()) -> Iterator[Result]:
        """Run jobs and yield their rows as they finish.

        Args:
            jobs: what to run; jobs of the same trial stand next to each other, so that a worker draws it once.
            time_limit: seconds of one job; a job that takes longer is stopped and fails.
            keep: keys of the jobs of which not only the row but all that the scenario returned is wanted.

        Yields:
            The row of each job and, where it is wanted and there is one, the outcome. A job that raises, crashes its
            process or takes too long costs its own row only.
        """
        ...


@dataclass(frozen=True)
class LocalProcesses:
    """Processes of one thread each on this machine.

    Attributes:
        workers: how many; 0 runs the jobs in this process, without time limit and protection from crashes.
    """

    workers: int = 1

    def run(self, jobs: Sequence[Job], time_limit: float | None = None, keep: Collection[str] = ()) -> Iterator[Result]:
        """See `Executor`."""
        if self.workers:
            yield from _in_processes(jobs, self.workers, time_limit, keep)
            return
        for job in jobs:
            row, outcome = measure(job)
            yield row, outcome if job.key in keep else None


def _in_processes(
    jobs: Sequence[Job], workers: int, time_limit: float | None, keep: Collection[str]
) -> Iterator[Result]:
    context = multiprocessing.get_context("spawn")
    pending = deque(jobs)
    with _one_thread_each():
        pool = [_Worker(context, frozenset(keep)) for _ in range(min(workers, len(jobs)))]
        try:
            while pending or any(worker.assigned for worker in pool):
                for worker in pool:
                    while pending and len(worker.assigned) < AHEAD:
                        worker.assign(pending.popleft())
                timeout = (
                    min((worker.seconds_left(time_limit) for worker in pool), default=None) if time_limit else None
                )
                ready = wait([worker.connection for worker in pool if worker.assigned], timeout)
                for index, worker in enumerate(pool):
                    if worker.connection in ready:
                        result = worker.receive()
                        if result is None:
                            continue
                    elif time_limit and worker.assigned and worker.seconds_left(time_limit) <= 0:
                        result = worker.give_up(f"did not finish within the time limit of {time_limit:g} s")
                    else:
                        continue
                    if not worker.alive:
                        pending.extendleft(reversed(worker.assigned))
                        pool[index] = _Worker(context, frozenset(keep))
                    yield result
        finally:
            for worker in pool:
                worker.stop()


class _Worker:
    """One process and the jobs it was given, the first of which it is running."""

    def __init__(self, context: Any, keep: frozenset[str]) -> None:
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, keep), daemon=True)
        self.process.start()
        theirs.close()
        self.assigned: deque[Job] = deque()
        self.ready = False
        self.since = 0.0
        self.alive = True

    def assign(self, job: Job) -> None:
        if not self.assigned:
            self.since = time.monotonic()
        self.assigned.append(job)
        try:
            self.connection.send(job)
        except OSError:  # the process is gone; `receive` says so
            pass

    def seconds_left(self, time_limit: float) -> float:
        # starting the process is not the job's time
        return self.since + time_limit - time.monotonic() if self.assigned and self.ready else time_limit

    def receive(self) -> Result | None:
        """A result, or None when the process has come up."""
        try:
            result = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return self.give_up(f"the worker process died ({how})")
        self.since = time.monotonic()
        if not self.ready:
            self.ready = True
            return None
        self.assigned.popleft()
        return result

    def give_up(self, reason: str) -> Result:
        self.stop()
        failure = Failure("WorkerError", reason, "")
        return Row(self.assigned.popleft(), failure=failure, status={"failed": 1}), None

    def stop(self) -> None:
        self.alive = False
        self.process.kill()
        self.process.join()
        self.connection.close()


def _serve(connection: Connection, keep: frozenset[str]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process decides what an interrupt means
    os.dup2(2, 1)  # solvers written in C print; standard output belongs to the command
    connection.send(None)  # everything is imported
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        row, outcome = measure(job)
        try:
            connection.send((row, outcome if job.key in keep else None))
        except OSError:  # the main process is gone
            return
        except Exception as error:  # an outcome that cannot be pickled
            connection.send((Row(job, failure=failure_of(error), status={"failed": 1}), None))


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Numerical libraries read these variables when they are loaded, so they are set before a worker starts."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
