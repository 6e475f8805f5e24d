"""A hundred thousand robots localized in a process of its own: time and memory."""

from __future__ import annotations

import subprocess
import sys

import pytest

from benchmarks.record import Row, record

ROBOTS, MEMORY = 100_000, 4.0  # GiB at most
PROGRAM = f"""
import resource, time, warnings
import numpy as np
from localization.lattice import draw_lattice, linear_start, team_data, team_problem
warnings.simplefilter("ignore")
team = draw_lattice({ROBOTS}, np.random.default_rng({ROBOTS}), pairs="both")
start, _ = linear_start(team)
begin = time.perf_counter()
solution = team_problem(team).compile("gauss-newton").solve(team_data(team), initial={{"robot": start}})
assert solution.status == "solved", solution
print(time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory in the unit of Linux")
def test_a_hundred_thousand_robots() -> None:
    ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    seconds, memory = (float(number) for number in ran.stdout.split())
    print(f"\n{ROBOTS} robots: build and solve {seconds:.1f} s, at most {memory:.2f} GiB, data and start included")
    measure = f"localization, {ROBOTS} robots"
    record(Row(f"{measure}, build and solve", "", seconds))
    record(Row(f"{measure}, peak of memory", "", memory, unit="GiB", wanted=MEMORY))
    assert memory < MEMORY
