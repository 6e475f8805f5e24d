"""Consensus on relative vectors: nodes on the runtime are the array versions, step by step, and both converge."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from localization.consensus.arrays import ARRAYS, AsynchronousArrays, KaczmarzArrays, SynchronousArrays
from localization.consensus.campaign import run_campaign
from localization.consensus.nodes import RelativeNodes
from localization.consensus.relative import RelativeVectors, measure_differences, optimum, union
from problems.errors import DataError, NoiseError, SettingError, ShapeError, TopologyError, UnknownNameError
from problems.networks import Network, complete, random_geometric, ring
from problems.runtime import EventSimulation, Links, Simulation
from problems.runtime.message import Message
from problems.runtime.trace import Delivery

STEPS = 500


def world(nodes: int = 20, seed: int = 0) -> tuple[RelativeVectors, np.ndarray]:
    rng = np.random.default_rng(seed)
    network, places = random_geometric(nodes, 0.35, rng)
    return measure_differences(network, places, 1e-4, rng), rng.random((nodes, 2))


def clocks_of(nodes: np.ndarray, count: int) -> list[list[int]]:
    return [(2 * np.flatnonzero(nodes == i) + 1).tolist() for i in range(count)]


def test_optimum_is_the_minimum_norm_least_squares_solution() -> None:
    vectors, _ = world()
    incidence = np.zeros((len(vectors.tail), 20))
    incidence[np.arange(len(vectors.tail)), vectors.tail] = 1
    incidence[np.arange(len(vectors.tail)), vectors.head] = -1
    np.testing.assert_allclose(optimum(vectors), np.linalg.pinv(incidence) @ vectors.z, atol=1e-12)
    pair = union([vectors, vectors])
    np.testing.assert_allclose(optimum(pair)[20:], optimum(vectors), atol=1e-13)
    assert pair.spread(np.repeat([[1.0, 2.0], [3.0, 4.0]], 20, axis=0)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("method", ["a_cl", "gossip", "bc"])
def test_nodes_are_arrays(method: str) -> None:
    vectors, start = world()
    acting = np.random.default_rng(1).integers(0, 20, STEPS)
    arrays = ARRAYS[method](vectors, start)
    before = vectors.spread(start - optimum(vectors))[0]
    with EventSimulation(vectors.network, RelativeNodes(method, vectors, start), clocks_of(acting, 20)) as simulation:
        for k, node in enumerate(acting):
            simulation.run(2 * k + 1)
            arrays.step(np.array([node]))
            np.testing.assert_allclose(np.array(simulation.outputs()), arrays.x[:-1], atol=1e-13)
    assert vectors.spread(arrays.x[:-1] - optimum(vectors))[0] < 0.1 * before


def test_kaczmarz_nodes_are_arrays_and_send_the_packets_of_the_table() -> None:
    vectors, start = world()
    rng = np.random.default_rng(2)
    columns, rows = rng.integers(0, 20, STEPS), rng.integers(0, len(vectors.tail), STEPS)
    plan: dict[tuple[int, int], int | None] = {(int(h), 2 * k + 1): None for k, h in enumerate(columns)}
    plan |= {(int(vectors.tail[e]), 2 * k + 2): int(vectors.head[e]) for k, e in enumerate(rows)}
    clocks = [sorted(t for node, t in plan if node == i) for i in range(20)]
    arrays = KaczmarzArrays(vectors, start)
    before = vectors.spread(start - optimum(vectors))[0]
    with EventSimulation(
        vectors.network,
        RelativeNodes("rek", vectors, start),
        clocks,
        sense=lambda node, time: plan[node, time],
        record=True,
    ) as simulation:
        for k in range(STEPS):
            simulation.run(2 * k + 2)
            arrays.column(columns[k : k + 1])
            arrays.row(vectors.tail[rows[k : k + 1]], vectors.places[0][rows[k : k + 1]])
            np.testing.assert_allclose(np.array(simulation.outputs()), arrays.x[:-1], atol=1e-13)
        assert simulation.trace is not None
        frames = [Message.from_bytes(e.frame) for e in simulation.trace.entries if isinstance(e, Delivery)]
    packets = len({(m.sender, m.sequence) for m in frames})
    assert packets == (vectors.slots.degree[columns] + 5).sum()
    assert vectors.spread(arrays.x[:-1] - optimum(vectors))[0] < 0.2 * before


def test_synchronous_nodes_are_arrays_and_keep_the_mean() -> None:
    vectors, start = world()
    arrays = SynchronousArrays(vectors, start)
    everyone = np.arange(20)
    with Simulation(vectors.network, RelativeNodes("s_cl", vectors, start)) as simulation:
        for _ in range(STEPS):
            said = np.array(simulation.step())
            arrays.step(everyone)
            np.testing.assert_allclose(said, arrays.x[:-1], atol=1e-13)
    np.testing.assert_allclose(said.mean(axis=0), start.mean(axis=0), atol=1e-12)


def test_a_cl_nodes_on_lossy_links_are_arrays_with_the_same_losses() -> None:
    vectors, start = world()
    acting = np.random.default_rng(3).integers(0, 20, STEPS)
    arrays = AsynchronousArrays(vectors, start)
    with EventSimulation(
        vectors.network,
        RelativeNodes("a_cl", vectors, start),
        clocks_of(acting, 20),
        links=Links(loss=0.4),
        rng=np.random.default_rng(4),
        record=True,
    ) as simulation:
        for k, node in enumerate(acting):
            assert simulation.trace is not None
            seen = len(simulation.trace)
            simulation.run(2 * k + 1)
            got = [e for e in simulation.trace.entries[seen:] if isinstance(e, Delivery) and e.arrival is not None]
            heard = np.isin(vectors.slots.neighbor[[node]], [e.receiver for e in got])
            arrays.step(np.array([node]), heard)
            np.testing.assert_allclose(np.array(simulation.outputs()), arrays.x[:-1], atol=1e-13)
        lost = simulation.counters.lost.sum() / simulation.counters.messages.sum()
    assert 0.3 < lost < 0.5


def test_an_old_packet_does_not_replace_a_newer_one() -> None:
    vectors, start = world(6)
    i, j = int(vectors.tail[0]), int(vectors.head[0])
    speaker, hearer = (RelativeNodes("a_cl", vectors, start)(k) for k in (i, j))
    old = Message(*_stamped(speaker.on_wake(0, None)[0], i, 0))
    speaker.x = speaker.x + 1.0
    new = Message(*_stamped(speaker.on_wake(1, None)[0], i, 1))
    hearer.on_message(2, new)
    settled = hearer.output().copy()
    hearer.on_message(3, old)
    np.testing.assert_array_equal(hearer.output(), settled)


def _stamped(said, sender: int, sequence: int) -> tuple:
    return said.schema, sender, sequence, float(sequence), 0, said.payload


def test_node_factories_travel_to_other_processes() -> None:
    vectors, start = world(5)
    again = pickle.loads(pickle.dumps(RelativeNodes("a_cl", vectors, start)))
    np.testing.assert_array_equal(again(3).output(), start[3])


def test_networks_run_together_are_the_networks_run_alone() -> None:
    worlds = [world(15, seed) for seed in range(3)]
    pair = union([w[0] for w in worlds])
    together = AsynchronousArrays(pair, np.concatenate([w[1] for w in worlds]), step=5e-6)
    alone = [AsynchronousArrays(*w, step=5e-6) for w in worlds]
    for nodes in np.random.default_rng(0).integers(0, 15, (200, 3)):
        together.step(nodes + 15 * np.arange(3))
        for arrays, node in zip(alone, nodes, strict=True):
            arrays.step(np.array([node]))
    np.testing.assert_allclose(together.x[:-1], np.concatenate([a.x[:-1] for a in alone]), atol=1e-13)


@pytest.mark.parametrize("method", ["s_cl", "a_cl", "bc", "rek"])
def test_campaigns_reach_the_optimum_and_count_packets(method) -> None:
    worlds = [world(8, seed) for seed in range(2)]
    vectors, starts = [w[0] for w in worlds], [w[1] for w in worlds]
    run = run_campaign(method, vectors, starts, 12_000, np.random.default_rng(0), every=500)
    assert (run.log_error[-1] < -25).all()
    degree = np.array([v.slots.degree[:-1].mean() for v in vectors])
    share = np.array([(v.slots.degree[:-1] ** 2).sum() / v.slots.degree[:-1].sum() for v in vectors])
    expected = {"s_cl": np.full(2, 8.0), "a_cl": np.ones(2), "bc": degree + 1, "rek": share + 5}[method]
    np.testing.assert_allclose(run.packets[-1] / 12_000, expected, rtol=0.02)
    gain = run.packets_per(6.0)
    assert (gain > 0).all() and (gain < run.packets[-1]).all()


def test_gossip_does_not_converge_but_its_average_does() -> None:
    worlds = [world(20, seed) for seed in range(3)]
    run = run_campaign("gossip", [w[0] for w in worlds], [w[1] for w in worlds], 20_000, np.random.default_rng(0))
    assert (run.log_error[10:] > -6).all()
    assert (run.average_log_error[-1] < run.log_error[5:].min(axis=0)).all()
    assert np.isnan(run.packets_per(12.0)).all()


def test_worlds_that_make_no_sense_are_refused() -> None:
    tail, head, z, one = np.array([0, 1]), np.array([1, 0]), np.ones((2, 1)), np.ones(2)
    with pytest.raises(NoiseError, match="variance 0"):
        RelativeVectors(2, tail, head, z, np.array([1.0, 0.0]))
    with pytest.raises(TopologyError, match="0 to 1"):
        RelativeVectors(2, tail, np.array([1, 2]), z, one)
    with pytest.raises(TopologyError, match="at most once"):
        RelativeVectors(2, np.zeros(2, int), np.ones(2, int), z, one)
    with pytest.raises(ShapeError, match="shape"):
        RelativeVectors(2, tail, head, z[:, 0], one)
    with pytest.raises(DataError, match="finite"):
        RelativeVectors(2, tail, head, z * np.nan, one)


def test_networks_that_a_method_cannot_serve_are_refused() -> None:
    rng = np.random.default_rng(0)
    split = measure_differences(Network(4, [(0, 1), (2, 3)], undirected=True), rng.random((4, 1)), 1.0, rng)
    with pytest.raises(TopologyError, match="0, 1; 2, 3"):
        RelativeNodes("a_cl", split, np.zeros((4, 1)))
    with pytest.raises(TopologyError, match="0, 1; 2, 3"):
        run_campaign("a_cl", [split], [np.zeros((4, 1))], 10, rng)
    one_way = measure_differences(ring(4, directed=True), rng.random((4, 1)), 1.0, rng)
    unequal = measure_differences(complete(3), rng.random((3, 1)), np.arange(1.0, 7.0), rng)
    for method in ("gossip", "bc", "rek"):
        with pytest.raises(TopologyError, match="vice versa"):
            RelativeNodes(method, one_way, np.zeros((4, 1)))
        with pytest.raises(NoiseError, match="equal variances"):
            run_campaign(method, [unequal], [np.zeros((3, 1))], 10, rng)
    with pytest.raises(SettingError, match="every packet"):
        run_campaign("bc", [unequal], [np.zeros((3, 1))], 10, rng, loss=0.1)
    with pytest.raises(UnknownNameError, match="a_cl"):
        RelativeNodes("acl", unequal, np.zeros((3, 1)))
