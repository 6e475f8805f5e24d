"""What a step of one node costs beside the linear algebra in it, and beside the bare QP library under active bounds.

The network is the directed ring of four nodes (dmhe-pre-estimation 6.1): 4 states, N = 5, two measurements per region.
A step is `measure` and `finish` of one node: one message packed, one unpacked, the local problem solved, an estimate
returned. The linear algebra is what the step cannot do without: the average of the neighbours' states and the product
that gives the window. A campaign is the grid of 6.2, Case 2, in batches.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mhe.distributed import DistributedNode, NetworkDesign, WindowPool, options_of, run_trials
from mhe.observers import place_gain
from mhe.polyhedron import Polyhedron
from problems.errors import ModelWarning
from problems.models import LinearModel, Sensor, simulate
from problems.networks import Network, ring
from problems.runtime import Message

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
NOTHING, FIRST, THIRD = [[0.0, 0, 0, 0]], [[1.0, 0, 0, 0]], [[0, 0, 1.0, 0]]
EDGES = "1-2 1-5 1-6 2-3 2-4 3-4 3-6 3-9 4-8 4-9 5-6 5-7 7-8 8-9"
METHODS = ("dmhe_f", "dmhe_pre", "dmhe_w_pre")
SETTLED = 300  # steps until the arrival covariances are constant, with room to spare


def model_of(outputs: list[Any]) -> LinearModel:
    sensors = [Sensor(f"s{k}", C, covariance=1.0) for k, C in enumerate(outputs)]
    return LinearModel(A, Q, sensors=sensors, covariance=np.eye(4))


class Ring:
    """The nodes of the ring in steady state; `step` runs node 0 alone on what its neighbour last said."""

    def __init__(self, method: str, **options: Any) -> None:
        model = model_of([FIRST, FIRST, THIRD, THIRD])
        truth = simulate(model, 20, np.random.default_rng(7), trials=12)
        self.measurements = truth.measurements[1, 3:]
        self.limit = np.abs(truth.states[1]).max(axis=0)
        share = options.pop("share", None)
        if share is not None:
            options["state_bounds"] = Polyhedron.box(-share * self.limit, share * self.limit)
        if options_of(method).disturbance == "observer":
            both = place_gain(A, [*FIRST, *THIRD], [0.9, 0.6, 0.7, 0.8])
            options["gains"] = [
                both,
                place_gain(A, FIRST * 2, [0.45, 0.58]),
                both,
                place_gain(A, THIRD * 2, [0.7, 0.8]),
            ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ModelWarning)
            design = NetworkDesign(model, ring(4, directed=True), method, **options)
        self.nodes = [DistributedNode(plan, design.pool) for plan in design.plans]
        self.instant = 0
        for _ in range(SETTLED):
            self.round()

    def round(self) -> tuple[float, Any]:
        """One step of all nodes; seconds that node 0 took, and its estimate."""
        order = np.concatenate([self.measurements, self.measurements[::-1]])
        y, now = order[self.instant % len(order)], float(self.instant)
        said, taken, estimate = [], 0.0, None
        for k, node in enumerate(self.nodes):
            start = time.perf_counter()
            (item,) = node.measure(now, y[k : k + 1])
            taken += time.perf_counter() - start if k == 0 else 0.0
            said.append(Message(item.schema, k, self.instant, now, 0, item.payload))
        for k, node in enumerate(self.nodes):
            start = time.perf_counter()
            result = node.finish([said[k - 1]])
            if k == 0:
                taken += time.perf_counter() - start
                estimate = result
        self.instant += 1
        return taken, estimate


def median(call: Callable[[], Any], rounds: int = 400) -> float:
    """Median microseconds of a call."""
    taken = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return 1e6 * float(np.median(taken))


@pytest.mark.parametrize("covariances", ["offline", "online"])
@pytest.mark.parametrize("method", METHODS)
def test_unconstrained_step_beside_its_linear_algebra(method: str, covariances: str) -> None:
    network = Ring(method, covariances=covariances)
    step = 1e6 * float(np.median([network.round()[0] for _ in range(400)]))
    node: Any = network.nodes[0]
    map_, numbers, weights = node._session.current_map(), node._session.store.numbers, node._plan.weights
    states = np.ones((2, 4))
    algebra = median(lambda: (weights @ states, map_(numbers)))
    print(f"\n{method:11} {covariances:8} step {step:5.1f} us, algebra {algebra:4.1f} us: {step - algebra:+5.1f} us")
    assert step - algebra < 60.0


@pytest.mark.parametrize(
    ("method", "form", "share"),
    [("dmhe_f", "F2", 0.7), ("dmhe_f", "F3", 0.7), ("dmhe_pre", "P1", 1.2), ("dmhe_pre", "P2", 1.2)],
)
def test_step_with_active_rows_beside_daqp(method: str, form: str, share: float) -> None:
    import daqp

    network = Ring(method, form=form, share=share)
    node: Any = network.nodes[0]
    steps, problems = [], []
    solve = node._session.solve
    inside: list[tuple[float, Any]] = []

    def timed(data: Any) -> Any:
        start = time.perf_counter()
        solution = solve(data)
        inside.append((time.perf_counter() - start, solution))
        return solution

    node._session.solve = timed
    sessions = []
    for _ in range(340):
        seconds, _ = network.round()
        spent, solution = inside.pop()
        if solution.method != "linear":
            map_ = node._session.current_map()
            q, l, u, _ = map_.vectors(node._session.store.numbers)
            steps.append(seconds)
            sessions.append(spent)
            problems.append((q, l, u))
    P, A = map_.P, map_.reduced.A
    bare = daqp.Model()
    q, l, u = problems[0]
    bare.setup(P, q, A, u, l)
    kept, cold = [], []
    for q, l, u in problems * 3:
        start = time.perf_counter()
        bare.update(f=q, bupper=u, blower=l)
        bare.solve()
        middle = time.perf_counter()
        daqp.solve(P, q, A, u, l)
        kept.append(middle - start)
        cold.append(time.perf_counter() - middle)
    step, session, update, call = (1e6 * float(np.median(times)) for times in (steps, sessions, kept, cold))
    print(
        f"\n{method:9} {form}: {len(steps)} steps with active rows: node {step:5.1f} us, session {session:5.1f} us, "
        f"daqp.solve {call:5.1f} us, daqp update and solve {update:5.1f} us"
    )
    assert len(steps) >= 30
    assert step - session < 60.0


@pytest.mark.parametrize("method", METHODS)
def test_case_2_campaign(method: str) -> None:
    """9900 runs of 50 steps and 9 nodes."""
    edges = [tuple(map(int, pair.split("-"))) for pair in EDGES.split()]
    seen = {**dict.fromkeys((1, 2, 6), FIRST), **dict.fromkeys((3, 4, 9), THIRD)}
    model = model_of([seen.get(node, NOTHING) for node in range(1, 10)])
    network = Network.from_edges(edges, range(1, 10), undirected=True)
    rng, pool = np.random.default_rng(1), WindowPool()
    truth = simulate(model, 50, rng, initial=rng.uniform(-100, 100, (100, 4)), trials=100)
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        for horizon in range(2, 11):
            for tenth in range(11):
                options = options_of(method, weights="mixed", share=tenth / 10, horizon=horizon)
                run_trials(NetworkDesign(model, network, options, pool=pool), truth.measurements)
    seconds = time.perf_counter() - start
    print(f"\n{method:11} Case 2: {seconds:5.1f} s for {99 * 100 * 50 * 9} local problems")
    assert seconds < 60.0
