"""Nodes that relay: what they hold against the data rule, what they estimate against Algorithm 2 written out."""

from __future__ import annotations

import pickle
from functools import cache
from typing import Any

import numpy as np
import pytest

from mhe.named import dmhe_b
from mhe.polyhedron import Polyhedron
from mhe.relay import RelayDesign, RelayEstimate, RelayEstimator, RelayWindows, held
from mhe.relay.node import RelayNode
from mhe.relay.plan import plan_of
from mhe.scenarios.sensor_field_world import POSITION, A, draw_trial, field_model, prmse, sensor_field
from problems.errors import DataError, ShapeError, TopologyError
from problems.models import LinearModel, Sensor
from problems.networks import Network, complete, line, random_digraph, ring
from problems.runtime import Links, Message, Outage
from problems.solvers import qp_session
from problems.solvers.base import Status

RING = ring(4, directed=True)
WINDOWS = RelayWindows()
TABLE = {  # E1 with N = l = 3, latency 0: instants of y^1 held by nodes 1..4 at t = 0..4 (Table 3.1)
    0: ["0", "0", "", ""],
    1: ["01", "01", "0", ""],
    2: ["012", "012", "01", "0"],
    3: ["0123", "0123", "012", "01"],
    4: ["1234", "1234", "123", "12"],
}


def on_ring(l: int = 3, **options: Any) -> RelayEstimator:
    options = {"horizon": 3, "weights": "uniform", **options}
    return RelayEstimator(field_model([0]), RING, "dmhe_l_pre", placement=[0], l=l, windows=WINDOWS, **options)


def small(seed: int = 5, count: int = 9) -> tuple[LinearModel, Network, list[int]]:
    """A random digraph with different sensors at some nodes, one of which has two."""
    rng = np.random.default_rng(seed)
    network = next(g for g in (random_digraph(count, 0.25, rng) for _ in range(100)) if g.is_strongly_connected)
    B = np.array([[0.5, 0], [0, 0.5], [1, 0], [0, 1]])
    sensors = [
        Sensor("a", POSITION, sigma=3.0),
        Sensor("b", [[1.0, 0, 0, 0]], sigma=2.0),
        Sensor("c", [[1.0, 1, 0, 0], [0, 1, 0, 1]], covariance=[[4.0, 1], [1, 3]]),
        Sensor("d", [[0, 0, 0, 1.0]], sigma=0.5),
        Sensor("e", POSITION, sigma=3.0),
    ]
    model = LinearModel(A, 0.1 * np.eye(4), B, sensors=sensors, covariance=np.diag([100.0, 100, 1, 1]))
    return model, network, [0, 3, 5, 5, 7]


def written_out(design: RelayDesign, measurements: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Algorithm 2 in closed form, from the data rule; (steps, count, n)."""
    model, network, options = design.model, design.network, design.options
    N, l, count, n = options.horizon, options.steps, network.count, model.state_size
    distance, pi = network.distances().T, design.weights.matrix()
    S1, Q = np.linalg.inv(model.process_covariance), model.process_covariance
    noisy = options.disturbance == "process_noise"
    pushed = np.vstack([np.zeros(n), inputs @ model.B.T])
    found = np.zeros((len(measurements), count, n))
    P = np.tile(np.linalg.inv(model.covariance), (count, 1, 1))
    states: list[np.ndarray] = [np.zeros((1, n))] * count
    Xi = H = P
    own = [
        (model.C[r], np.linalg.inv(model.R[np.ix_(r, r)]), design.own(i).gain) for i, r in enumerate(design.own_rows)
    ]
    AL = [A - L @ C for C, _, L in own]
    for t in range(1, len(measurements)):
        m, first = min(t, N), max(0, t - N)
        if t > N:
            guess = np.zeros((count, n))
            new = []
            for i, (C, W, L) in enumerate(own):
                step = A if noisy else AL[i]
                y = measurements[first - 1][design.own_rows[i]]
                guess[i] = A @ states[i][0] + pushed[first] + (0 if noisy else L @ (y - C @ states[i][0]))
                omega = Xi[i].copy()
                if noisy:
                    omega += marginal(C, W, N, Q)
                else:
                    F = np.vstack([C @ np.linalg.matrix_power(AL[i], k) for k in range(N + 1)])
                    omega += F.T @ np.kron(np.eye(N + 1), W) @ F
                if options.omega == "hessian":
                    omega, guess[i] = H[i], states[i][1]
                    step = A if noisy else A - design.gains(i, N)[0] @ model.C[design.regional_rows[i]]
                new.append(np.linalg.inv(step @ np.linalg.inv(omega) @ step.T + np.linalg.inv(S1)))
            P = options.alpha / options.arrival_divisor * np.array(new)
        else:
            guess = np.array([s[0] for s in states])
            if options.startup == "literal":
                guess = np.zeros((count, n))
            elif t > 1:
                new = np.linalg.inv(np.linalg.inv(H) + np.linalg.inv(S1))
                P = options.alpha / options.arrival_divisor * new
        Xi = np.einsum("ij,jab->iab", pi, P)
        xi = np.einsum("ij,jab,jb->ia", pi, P, guess)
        H, states = np.zeros((count, n, n)), []
        for i in range(count):
            rows = design.regional_rows[i]
            gains = design.gains(i, m)
            unknowns = (m + 1) * n if noisy else n
            big, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
            T, b = np.eye(n, unknowns), np.zeros(n)
            big[:n, :n] += Xi[i]
            right[:n] += xi[i]
            trajectory = []
            for s in range(m + 1):
                k = first + s
                trajectory.append((T, b))
                near = [j for j in design.sources[i] if j == i or distance[i, j] <= min(l, t - k + 1 - options.latency)]
                for j in near:
                    C, W, _ = own[j]
                    y = measurements[k][design.own_rows[j]]
                    big += T.T @ C.T @ W @ C @ T
                    right += T.T @ C.T @ W @ (y - C @ b)
                if s == m:
                    break
                if noisy:
                    w = np.zeros((n, unknowns))
                    w[:, (s + 1) * n : (s + 2) * n] = np.eye(n)
                    big += w.T @ S1 @ w
                    T, b = A @ T + w, A @ b + pushed[k + 1]
                else:
                    mine = np.isin(rows, np.concatenate([design.own_rows[j] for j in [*near, i]])).astype(float)
                    C, L = model.C[rows], gains[s] * mine
                    T, b = (A - L @ C) @ T, (A - L @ C) @ b + L @ measurements[k][rows] + pushed[k + 1]
            z = np.linalg.solve(big, right)
            states.append(np.array([T @ z + b for T, b in trajectory]))
            H[i] = big[:n, :n] - big[:n, n:] @ np.linalg.solve(big[n:, n:], big[n:, :n]) if noisy else big
            found[t, i] = states[i][-1]
    return found


def marginal(C: np.ndarray, W: np.ndarray, N: int, Q: np.ndarray) -> np.ndarray:
    """Information about the first state in the outputs of a window, disturbances integrated out."""
    n = len(A)
    big = np.zeros(((N + 1) * n,) * 2)
    T = np.eye(n, (N + 1) * n)
    for s in range(N + 1):
        big += T.T @ C.T @ W @ C @ T
        if s < N:
            w = np.zeros((n, (N + 1) * n))
            w[:, (s + 1) * n : (s + 2) * n] = np.eye(n)
            big += w.T @ np.linalg.inv(Q) @ w
            T = A @ T + w
    return big[:n, :n] - big[:n, n:] @ np.linalg.solve(big[n:, n:], big[n:, :n])


@cache
def recorded(steps: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    model = small()[0]
    rng = np.random.default_rng(2)
    x, states, inputs = rng.normal(size=4) * [10, 10, 1, 1], [], rng.normal(size=(steps - 1, 2))
    for k in range(steps):
        if k:
            x = A @ x + model.B @ inputs[k - 1] + 0.3 * rng.normal(size=4)
        states.append(x)
    clean = np.array(states) @ model.C.T
    return np.array(states), clean + 2 * rng.normal(size=clean.shape), inputs


# Messages and what is held


@pytest.mark.parametrize("l", [1, 2, 3])
@pytest.mark.parametrize("relay", ["incremental", "batch"])
def test_table_of_the_ring_by_messages(l: int, relay: str) -> None:
    estimator = on_ring(l, relay=relay)
    for t, cells in TABLE.items():
        result = estimator.step([np.array([float(t), 0.0]), None, None, None])
        for node, (cell, estimate) in enumerate(zip(cells, result.nodes, strict=True)):
            assert isinstance(estimate, RelayEstimate)
            first = t - len(estimate.held) + 1
            instants = "".join(str(first + s) for s in np.flatnonzero(estimate.held.all(axis=1))) if node <= l else ""
            assert instants == (cell if node <= l else ""), (t, node)
            assert estimate.held.shape == (min(t, 3) + 1, 2 if node <= l else 0)


@pytest.mark.parametrize("latency", [0, 1])
@pytest.mark.parametrize("l", [1, 2, 4])
@pytest.mark.parametrize("relay", ["incremental", "batch"])
def test_what_is_held_is_the_data_rule(l: int, latency: int, relay: str) -> None:
    model, network, placement = small()
    estimator = RelayEstimator(
        model,
        network,
        horizon=4,
        l=l,
        latency=latency,
        relay=relay,
        weights="uniform",
        placement=placement,
        windows=WINDOWS,
    )
    _, measurements, inputs = recorded()
    design = estimator.design
    for t in range(10):
        result = estimator.step(measurements[t], inputs[t - 1] if t else None)
        for node, estimate in enumerate(result.nodes):
            assert isinstance(estimate, RelayEstimate)
            expected = held(design.local(node).row_hops, t, horizon=4, steps=l, latency=latency).T
            assert np.array_equal(estimate.held, expected), (t, node)
            assert estimate.missing == ()


def test_the_values_relayed_are_those_measured_and_own_ones_are_not_taken_back() -> None:
    model, network, placement = small()
    design = RelayDesign(model, network, horizon=4, weights="uniform", placement=placement)
    nodes = [RelayNode(plan_of(design, i)) for i in range(network.count)]
    _, measurements, inputs = recorded()
    for t in range(9):
        rows = design.by_node(measurements[t])
        said = [node.measure(t, (rows[i], inputs[t - 1] if t else None))[0] for i, node in enumerate(nodes)]
        for i, node in enumerate(nodes):
            heard = [j for j in network.in_neighborhood(i) if j != i]
            node.finish([Message(said[j].schema, j, t, float(t), 0, said[j].payload) for j in heard])
            first = t - node._buffer.newest
            for s, y in enumerate(node._buffer.values[: node._buffer.newest + 1]):
                there = ~np.isnan(y)
                assert np.array_equal(y[there], measurements[first + s][design.regional_rows[i]][there])
            if i in design.sources[i]:  # hops 0: never replaced by one that came back around a cycle
                place = list(design.sources[i]).index(i)
                assert (node._buffer._hops[: node._buffer.newest + 1, place] == 0).all()


@pytest.mark.parametrize(
    ("horizon", "l", "relay", "mean", "largest"),
    [
        (4, 1, "batch", 0.2, 2),
        (4, 2, "incremental", 1.8, 8),
        (4, 2, "batch", 7.4, 32),
        (4, 4, "incremental", 5.9, 14),
    ],
)
def test_floats_sent_on_the_reference_network(horizon: int, l: int, relay: str, mean: float, largest: int) -> None:
    field = sensor_field()
    trial = draw_trial(field, 2 * horizon + 2, np.random.default_rng(0))
    estimator = RelayEstimator(
        field.model,
        field.network,
        placement=field.placement,
        horizon=horizon,
        l=l,
        relay=relay,
        exchange="online",
        windows=WINDOWS,
    )
    for y in trial.measurements[:-1]:
        estimator.step(y)
    before = estimator.counters.floats
    estimator.step(trial.measurements[-1])
    floats = estimator.counters.floats - before - 4 - 10  # the prediction and the upper triangle of P
    sender = np.zeros(100)
    sender[field.network.edges[:, 0]] = floats
    assert (round(sender.mean(), 2), floats.max()) == (mean, largest)


# Estimates


@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_1_pre", "dmhe_b"])
@pytest.mark.parametrize("startup", ["literal", "fuse"])
@pytest.mark.parametrize("omega", ["seed", "hessian"])
@pytest.mark.parametrize("exchange", ["offline", "online"])
def test_estimates_equal_the_algorithm_written_out(method: str, startup: str, omega: str, exchange: str) -> None:
    model, network, placement = small()
    options: dict[str, Any] = {"horizon": 3, "weights": "uniform", "startup": startup, "omega": omega}
    estimator = RelayEstimator(
        model, network, method, placement=placement, exchange=exchange, windows=WINDOWS, **options
    )
    _, measurements, inputs = recorded()
    found = [estimator.step(y, None if t == 0 else inputs[t - 1]).states for t, y in enumerate(measurements)]
    expected = written_out(estimator.design, measurements, inputs)
    assert np.abs(np.array(found) - expected).max() < 1e-7 * np.abs(expected).max()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("gains", "latency"), [("mean", 0), ("sum", 0), ("joint", 1)])
def test_gains_and_latency_equal_the_algorithm_written_out(gains: str, latency: int) -> None:
    model, network, placement = small()
    estimator = RelayEstimator(
        model, network, placement=placement, horizon=3, weights="uniform", gains=gains, latency=latency, windows=WINDOWS
    )
    _, measurements, inputs = recorded()
    found = [estimator.step(y, None if t == 0 else inputs[t - 1]).states for t, y in enumerate(measurements)]
    expected = written_out(estimator.design, measurements, inputs)
    assert np.abs(np.array(found) - expected).max() < 1e-7 * np.abs(expected).max()


def test_incremental_and_batch_relay_give_equal_estimates_bit_by_bit() -> None:
    model, network, placement = small()
    _, measurements, inputs = recorded()
    runs = []
    for relay in ("incremental", "batch"):
        estimator = RelayEstimator(model, network, placement=placement, weights="uniform", relay=relay, windows=WINDOWS)
        runs.append([estimator.step(y, inputs[t - 1] if t else None).states for t, y in enumerate(measurements)])
    assert np.array_equal(*runs)


def test_fused_cost_differs_from_the_sum_by_a_constant() -> None:
    model, network, placement = small()
    design = RelayDesign(model, network, placement=placement, weights="uniform")
    node = RelayNode(plan_of(design, 4))
    rng = np.random.default_rng(0)
    members, t = node._plan.members, 6
    guesses = dict(zip(members, rng.normal(size=(len(members), 4)) * 50, strict=True))
    for member, guess in guesses.items():
        node._fusion.receive(member, float(t), guess)
    reference, information, linear = node._fusion.arrival(t)
    P = design.schedule().local[design.schedule().at(t)]

    def difference(x: np.ndarray) -> float:
        d = x - reference
        summed = sum(
            w * (x - guesses[j]) @ P[j] @ (x - guesses[j]) for w, j in zip(node._plan.weights, members, strict=True)
        )
        return float(summed - (d @ information @ d + 2 * linear @ d))

    values = np.array([difference(rng.normal(size=4) * 50) for _ in range(20)])
    assert np.ptp(values) < 1e-9 * abs(values.mean())
    # (3.14) is zero at its centre, (3.10) is not where predictions differ
    centre = reference - np.linalg.solve(information, linear)
    at_centre = information @ (centre - reference) + linear
    assert np.abs(at_centre).max() < 1e-9 and difference(centre) + linear @ np.linalg.solve(information, linear) > 1


def test_a_node_without_data_propagates_the_fused_prior() -> None:
    estimator = on_ring(1)  # nodes 3 and 4 never hold anything
    rng = np.random.default_rng(0)
    for t in range(9):
        result = estimator.step([rng.normal(size=2) * 10, None, None, None])
        node = result.nodes[3]
        assert isinstance(node, RelayEstimate) and node.held.shape[1] == 0 and node.window is not None
        if t:
            moved = np.linalg.matrix_power(A, len(node.window) - 1) @ node.window[0]
            assert np.abs(node.state - moved).max() < 1e-9
    reference, information, linear = estimator._simulation._host._nodes[3]._fusion.arrival(8)  # type: ignore[attr-defined]
    assert np.abs(node.window[0] - (reference - np.linalg.solve(information, linear))).max() < 1e-9


def test_nodes_of_a_complete_graph_agree() -> None:
    field = sensor_field(nodes=12, share=0.25, radius=2000)
    assert field.network == complete(12)
    trial = draw_trial(field, 20, np.random.default_rng(1))
    for method in ("dmhe_1_pre", "dmhe_b"):
        for weights in ("uniform", "metropolis"):
            with RelayEstimator(
                field.model, field.network, method, placement=field.placement, weights=weights
            ) as estimator:
                states = np.array([estimator.step(y).states for y in trial.measurements])
            assert np.ptp(states, axis=1).max() < 1e-8


# Work that is done once


def test_no_matrix_is_factorized_once_the_weights_have_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    made = 0
    original = qp_session.DenseMap.__init__

    def counted(self: Any, *given: Any) -> None:
        nonlocal made
        made += 1
        original(self, *given)

    monkeypatch.setattr(qp_session.DenseMap, "__init__", counted)
    for exchange in ("offline", "online"):
        field = sensor_field(nodes=20)
        estimator = RelayEstimator(field.model, field.network, placement=field.placement, exchange=exchange)
        trial = draw_trial(field, 40, np.random.default_rng(1))
        for y in trial.measurements[:36]:
            estimator.step(y)
        before, counted_before, floats = made, estimator.factorizations, estimator.counters.floats
        estimator.step(trial.measurements[36])
        per_link = estimator.counters.floats - floats
        for y in trial.measurements[37:]:
            result = estimator.step(y)
        assert before > 100 and counted_before > 100
        assert (made, estimator.factorizations) == (before, counted_before)
        assert not any(node.factorized for node in result.nodes)  # type: ignore[union-attr]
        assert per_link.max() <= 4 + 2 * len(field.active)  # P (10 numbers) is no longer sent


def test_nodes_with_equal_regions_share_a_window() -> None:
    field = sensor_field()
    estimator = RelayEstimator(field.model, field.network, placement=field.placement)
    assert len(estimator.windows._compiled) < 10 < len(estimator.design.problems)


# Losses, delays, restarts


@pytest.mark.parametrize("exchange", ["offline", "online"])
def test_estimates_survive_losses_and_delays(exchange: str) -> None:
    field = sensor_field(nodes=24, share=0.2)
    trial = draw_trial(field, 24, np.random.default_rng(1))
    errors = []
    for links in (None, Links(loss=0.2, delay=lambda rng, count: rng.integers(0, 3, count))):
        estimator = RelayEstimator(
            field.model,
            field.network,
            placement=field.placement,
            links=links,
            rng=np.random.default_rng(4),
            exchange=exchange,
            windows=WINDOWS,
        )
        results = [estimator.step(y) for y in trial.measurements]
        errors.append(prmse(np.array([r.states for r in results]), trial.states)[12:].mean())
    assert estimator.counters.lost.sum() > 100 and estimator.counters.late.sum() > 100
    late = sum(len(node.late) for r in results for node in r.nodes)  # type: ignore[union-attr]
    assert late > 20
    assert errors[0] < errors[1] < 3 * errors[0]


@pytest.mark.parametrize("exchange", ["offline", "online"])
def test_a_node_that_restarts_takes_its_prior_from_its_neighbours(exchange: str) -> None:
    field = sensor_field(nodes=20)
    trial = draw_trial(field, 20, np.random.default_rng(1))
    estimator = RelayEstimator(
        field.model, field.network, placement=field.placement, exchange=exchange, outages=[Outage(3, 8, 12)]
    )
    results = [estimator.step(y) for y in trial.measurements]
    assert results[8].nodes[3] is None and np.isnan(results[8].states[3]).all()
    error = np.linalg.norm(np.array([r.states for r in results])[12:, 3, :2] - trial.states[12:, :2], axis=1)
    assert error.max() < 30


def test_processes_give_the_same_numbers() -> None:
    trial = draw_trial(sensor_field(nodes=20), 6, np.random.default_rng(1))
    runs = []
    for processes in (False, True):
        with on_ring(2, processes=processes, record=True) as estimator:
            states = [estimator.step([y[:2], None, None, None]).states for y in trial.measurements]
            assert estimator.trace is not None
            runs.append((np.array(states), estimator.trace.digest()))
    assert np.array_equal(runs[0][0], runs[1][0]) and runs[0][1] == runs[1][1]


def test_plans_travel_between_processes() -> None:
    design = RelayDesign(field_model([0]), RING, placement=[0], weights="uniform")
    plan = pickle.loads(pickle.dumps(plan_of(design, 2)))
    assert np.array_equal(plan.gain, plan_of(design, 2).gain)


# Bounds


def bounded(bounds: str, size: float, method: str = "dmhe_l_pre", **options: Any) -> tuple[list[Any], np.ndarray]:
    field = sensor_field(nodes=30, share=0.2)
    trial = draw_trial(field, 8, np.random.default_rng(1))
    estimator = RelayEstimator(
        field.model,
        field.network,
        method,
        placement=field.placement,
        residual_bounds=Polyhedron.box([-size] * 2, [size] * 2),
        bounds=bounds,
        windows=WINDOWS,
        **options,
    )
    return [estimator.step(y) for y in trial.measurements], trial.states


@pytest.mark.filterwarnings("ignore")
def test_hard_residual_bounds_that_cannot_be_met_are_reported_per_node_and_instant() -> None:
    results, _ = bounded("hard", 10.0, gains="sum")
    reported = [entry for result in results for entry in result.infeasible]
    status = [s for result in results for s in result.status]
    assert len(reported) == status.count(Status.INFEASIBLE) > 10
    assert all(entry.bounds and entry.bounds[0].startswith("residual node ") for entry in reported)
    names = {name for entry in reported for name in entry.bounds}
    assert len(names) > 1  # named by the sensors of the node, not by those of the window it shares


def test_soft_residual_bounds_never_fail_and_wide_ones_do_nothing() -> None:
    tight, _ = bounded("soft", 10.0)
    assert all(status is Status.SOLVED for result in tight for status in result.status)
    assert any(result.infeasible for result in tight)
    free, wide = (bounded("soft", size)[0] for size in (1e9, 1000.0))
    for a, b in zip(free, wide, strict=True):
        assert np.abs(a.states - b.states).max() < 1e-9
        assert not b.infeasible


def test_residual_bounds_hold_where_they_are_feasible() -> None:
    results, _ = bounded("hard", 9.0, method="dmhe_b")
    field = sensor_field(nodes=30, share=0.2)
    trial = draw_trial(field, 8, np.random.default_rng(1))
    touched = 0
    for t, result in enumerate(results[1:], 1):
        assert result.status.count(Status.SOLVED) == 30
        for node in result.nodes:
            assert isinstance(node, RelayEstimate) and node.window is not None
        for i in field.active:
            node = result.nodes[i]
            rows = [2 * i, 2 * i + 1]
            residual = trial.measurements[t - len(node.window) + 1 : t + 1][:, rows] - node.window @ POSITION.T
            assert np.abs(residual).max() < 9 + 1e-6
            touched += np.abs(residual).max() > 9 - 1e-6
    assert touched


# What a node refuses


def test_topology_does_not_change_during_a_run() -> None:
    estimator = on_ring()
    with pytest.raises(TopologyError, match="fixed for a run"):
        estimator.network = complete(4)
    design = estimator.design
    node, stranger = (RelayNode(plan_of(design, i)) for i in (0, 1))
    (said,) = stranger.measure(0.0, None)
    node.measure(0.0, [0.0, 0.0])
    with pytest.raises(TopologyError, match="no in-neighbour"):
        node.finish([Message(said.schema, 1, 0, 0.0, 0, said.payload)])


def test_relayed_measurements_of_an_unknown_source_are_refused() -> None:
    design = RelayDesign(field_model([0]), line(4), placement=[0], l=1)
    far = RelayNode(plan_of(design, 3))
    far.measure(0.0, None)
    relayed = {"source": [0], "instant": [0], "hops": [1], "value": np.zeros(2)}
    with pytest.raises(TopologyError, match="within 1 hops"):
        far._buffer.receive(2, 0, np.zeros(0), {key: np.asarray(value) for key, value in relayed.items()})


def test_bad_measurements_are_named() -> None:
    estimator = on_ring()
    with pytest.raises(ShapeError, match="node 0: expected 2 measurement"):
        estimator.step([[1.0], None, None, None])
    with pytest.raises(DataError, match="infinite"):
        on_ring().step([[np.inf, 0.0], None, None, None])
    with pytest.raises(ShapeError, match="one entry per node"):
        on_ring().step([None])


def test_registered_names_make_estimators() -> None:
    field = sensor_field(nodes=20)
    estimator = dmhe_b(field.model, field.network, placement=field.placement, horizon=2)
    assert estimator.options.disturbance == "process_noise" and estimator.options.steps == 1
