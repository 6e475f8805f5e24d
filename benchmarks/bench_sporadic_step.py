"""What a step of one node with detections costs, and its local problem beside the bare QP library.

Five vehicles, single integrators, all of them seen in most instants of the window, N = 3 and 4 (dmhe-sporadic-fov 6);
flags and covariances are new in every step, so is every matrix. The bare call is quadprog's own on ready matrices with
the rows that are on. A whole step is `measure`, the rank round and `finish` of one node with two neighbours: readings,
flags, states, ranks and covariances packed, sent, unpacked. Times are medians of the process's own time, taken in turn.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.sporadic import METHODS, SporadicDesign, SporadicNode
from problems.models import LinearModel, Sensor
from problems.networks import band
from problems.runtime import Message

VEHICLES, NODES = 5, 3


def design_of(method: str, **options: Any) -> SporadicDesign:
    size = 2 * VEHICLES
    sensors = [
        Sensor(f"camera {node} vehicle {v}", np.eye(2, size, 2 * v), covariance=np.eye(2))
        for node in range(NODES)
        for v in range(VEHICLES)
    ]
    prior = {"mean": np.zeros(size), "covariance": 1e5 * np.eye(size)}
    model = LinearModel(np.eye(size), np.eye(size), sensors=sensors, **prior)
    fields = [Polyhedron(*pentagon(1.2)) for _ in range(NODES)]
    gains = {"gains": 0.3} if METHODS[method].disturbance == "observer" else {}
    return SporadicDesign(model, band(NODES, 1), method, fields=fields, **gains, **options)


def pentagon(radius: float) -> tuple[np.ndarray, np.ndarray]:
    angles = 2 * np.pi * np.arange(5) / 5
    return np.column_stack([np.cos(angles), np.sin(angles)]), np.full(5, radius)


class Middle:
    """The middle node and its neighbours; `step` returns the seconds that the middle one took."""

    def __init__(self, method: str, **options: Any) -> None:
        design = design_of(method, **options)
        self.nodes = [SporadicNode(plan, design.pool) for plan in design.plans]
        self.rng, self.instant = np.random.default_rng(3), 0

    def step(self) -> tuple[float, Any]:
        rng, now, count = self.rng, float(self.instant), len(self.nodes)
        values = 0.7 * rng.normal(size=(count, VEHICLES, 2))
        values[rng.random((count, VEHICLES)) > 0.9] = np.nan
        taken = 0.0
        said: list[list[Message]] = []
        estimate = None
        for phase in ["measure", *["exchange"] * self.nodes[0].rounds, "finish"]:
            spoken = []
            for k, node in enumerate(self.nodes):
                inbox = [] if phase == "measure" else [m for j in range(count) if abs(j - k) == 1 for m in said[j]]
                start = time.process_time()
                if phase == "measure":
                    out: Any = node.measure(now, values[k])
                elif phase == "exchange":
                    out = node.exchange(1, inbox)
                else:
                    out = node.finish(inbox)
                taken += time.process_time() - start if k == 1 else 0.0
                estimate = out if phase == "finish" and k == 1 else estimate
                if phase != "finish":
                    spoken.append([Message(item.schema, k, self.instant, now, 0, item.payload) for item in out])
            said = spoken
        self.instant += 1
        return taken, estimate


@pytest.mark.parametrize("horizon", [3, 4])
@pytest.mark.parametrize("method", METHODS)
def test_whole_step(method: str, horizon: int) -> None:
    network = Middle(method, horizon=horizon)
    steps = 1e6 * float(np.median([network.step()[0] for _ in range(400)]))
    print(f"\n{method:13} N={horizon}: whole step {steps:5.0f} us")
    assert steps < 500.0


@pytest.mark.parametrize("solver", ["quadprog", "auto"])
@pytest.mark.parametrize("horizon", [3, 4])
@pytest.mark.parametrize("method", METHODS)
def test_joint_problem_beside_quadprog(method: str, horizon: int, solver: str) -> None:
    quadprog = pytest.importorskip("quadprog")
    network = Middle(method, horizon=horizon, solver=solver)
    local: Any = network.nodes[1]
    session = local._local._session
    inner, recorded = session.solve, []

    def spied(data: dict[str, np.ndarray]) -> Any:
        recorded.append({name: np.array(value) for name, value in data.items()})
        return inner(data)

    session.solve = spied
    for _ in range(120):
        network.step()
    ours, bare, rows = [], [], 0
    for _ in range(4):
        for data in recorded[20:]:
            start = time.process_time()
            inner(data)
            middle = time.process_time()
            program = session.code(session.store.numbers)
            used = program.u < np.inf
            C, b = np.ascontiguousarray(-program.A[used].T), -program.u[used]
            begin = time.process_time()
            if used.any():
                quadprog.solve_qp(program.P, -program.q, C, b)
            else:
                quadprog.solve_qp(program.P, -program.q)
            bare.append(time.process_time() - begin)
            ours.append(middle - start)
            rows += int(used.sum())
    one, other = 1e6 * float(np.median(ours)), 1e6 * float(np.median(bare))
    print(
        f"\n{method:13} N={horizon} {solver:8}: {rows / len(ours):5.1f} rows on, assembly and solve {one:5.0f} us, "
        f"quadprog alone {other:5.0f} us, ratio {one / other:4.1f}"
    )
    # what is named is called in every step; auto answers by itself where no row is violated
    assert one < (3 if solver == "auto" else 10) * other
