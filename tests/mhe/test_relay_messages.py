"""Nodes that relay: what they hold against the data rule, what they send, losses and processes."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from relay_worlds import RING, WINDOWS, on_ring, recorded, small

from mhe.relay import RelayDesign, RelayEstimate, RelayEstimator, held
from mhe.relay.node import RelayNode
from mhe.relay.plan import plan_of
from mhe.scenarios.sensor_field_world import draw_trial, field_model, prmse, sensor_field
from problems.errors import TopologyError
from problems.networks import complete, line
from problems.runtime import Links, Message, Outage

TABLE = {  # E1 with N = l = 3, latency 0: instants of y^1 held by nodes 1..4 at t = 0..4 (Table 3.1)
    0: ["0", "0", "", ""],
    1: ["01", "01", "0", ""],
    2: ["012", "012", "01", "0"],
    3: ["0123", "0123", "012", "01"],
    4: ["1234", "1234", "123", "12"],
}


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
