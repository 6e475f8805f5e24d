"""Graphs: construction, neighbourhoods, distances, generators, checks."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

from problems.errors import TopologyError
from problems.networks import (
    Network,
    band,
    circulant,
    complete,
    draw_connected,
    erdos_renyi,
    lattice,
    line,
    random_digraph,
    random_geometric,
    random_regular,
    ring,
    star,
    torus,
    within_radius,
)

REPOSITORY = Path(__file__).resolve().parents[2]


def as_digraph(network: Network) -> nx.DiGraph:
    graph = nx.DiGraph(network.edges.tolist())
    graph.add_nodes_from(range(network.count))
    return graph


@pytest.fixture
def four_ring() -> Network:
    """The directed ring 4 -> 1 -> 2 -> 3 -> 4 of dmhe-pre-estimation 6.1."""
    return Network.from_edges([(4, 1), (1, 2), (2, 3), (3, 4)], nodes=[1, 2, 3, 4])


def test_neighbourhoods_of_the_directed_ring_include_the_node_itself(four_ring: Network) -> None:
    heard = {four_ring.labels[i]: {four_ring.labels[j] for j in four_ring.in_neighborhood(i)} for i in range(4)}
    assert heard == {1: {1, 4}, 2: {1, 2}, 3: {2, 3}, 4: {3, 4}}
    assert [four_ring.labels[i] for i in four_ring.out_neighborhood(four_ring.index(1))] == [1, 2]
    assert not four_ring.is_undirected
    assert four_ring.is_balanced


def test_degrees_count_self_loops_in_and_out_apart() -> None:
    fan = Network(4, [(0, 1), (0, 2), (0, 3), (1, 0)])
    assert fan.out_degree.tolist() == [4, 2, 1, 1]
    assert fan.in_degree.tolist() == [2, 2, 2, 2]
    assert not fan.is_balanced


def test_repeated_edges_and_self_loops_change_nothing() -> None:
    assert Network(3, [(0, 1), (0, 1), (1, 1)]) == Network(3, [(0, 1)])


def test_a_network_does_not_change() -> None:
    network = ring(4)
    with pytest.raises(AttributeError, match="does not change"):
        network.count = 3
    with pytest.raises(ValueError, match="read-only"):
        network.senders[0] = 3
    assert pickle.loads(pickle.dumps(network)) == network


def test_networkx_round_trip_keeps_names_and_directions() -> None:
    digraph = nx.DiGraph([("a", "b"), ("b", "c"), ("c", "a"), ("a", "c")])
    network = Network.from_networkx(digraph)
    assert [network.labels[j] for j in network.in_neighborhood(network.index("c"))] == ["a", "b", "c"]
    assert nx.utils.graphs_equal(network.to_networkx(), digraph)
    graph = nx.petersen_graph()
    assert nx.utils.edges_equal(Network.from_networkx(graph).to_networkx().edges, graph.edges)


def test_adjacency_row_lists_what_a_node_receives() -> None:
    matrix = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    network = Network.from_adjacency(matrix)
    assert network.in_neighborhood(0).tolist() == [0, 1]
    np.testing.assert_array_equal(network.adjacency().toarray(), matrix + np.eye(3))


@pytest.mark.parametrize("seed", range(20))
def test_distances_diameter_and_steps_agree_with_networkx(seed: int) -> None:
    rng = np.random.default_rng(seed)
    network = random_digraph(25, 0.1, rng)
    lengths = dict(nx.all_pairs_shortest_path_length(as_digraph(network)))
    expected = np.array([[lengths[j].get(i, -1) for i in range(25)] for j in range(25)])
    np.testing.assert_array_equal(network.distances(), expected)
    np.testing.assert_array_equal(network.distances([3, 7]), expected[[3, 7]])
    for steps in (0, 1, 2, 4, 30):
        wide, hops = network.within(steps)
        for node in range(25):
            reached = np.flatnonzero((expected[:, node] >= 0) & (expected[:, node] <= steps))
            assert wide.in_neighborhood(node).tolist() == reached.tolist()
            row = slice(wide.offsets[node], wide.offsets[node + 1])
            assert hops[row].tolist() == expected[reached, node].tolist()
    strong = draw_connected(lambda: random_digraph(25, 0.12, rng))
    assert strong.diameter == nx.diameter(as_digraph(strong))


def test_step_neighbourhood_runs_against_the_arrows() -> None:
    """dmhe-l-step, Definition 3.1: ring 1 -> 2 -> 3 -> 4 -> 1 gives N_1^4 = {3}."""
    network = Network.from_edges([(1, 2), (2, 3), (3, 4), (4, 1)], nodes=[1, 2, 3, 4])
    one, _ = network.within(1)
    two, _ = network.within(2)
    assert [network.labels[j] for j in one.in_neighborhood(3)] == [3, 4]
    assert [network.labels[j] for j in two.in_neighborhood(3)] == [2, 3, 4]


def test_components_strong_and_weak() -> None:
    network = Network(6, [(0, 1), (1, 0), (1, 2), (3, 4), (4, 3)])
    assert [part.tolist() for part in network.components()] == [[0, 1], [2], [3, 4], [5]]
    assert [part.tolist() for part in network.components(strong=False)] == [[0, 1, 2], [3, 4], [5]]


def test_refusals_name_the_nodes() -> None:
    chain = Network.from_edges([("a", "b"), ("b", "c")])
    with pytest.raises(TopologyError, match="no path from node b, c to node a"):
        chain.require_strongly_connected()
    with pytest.raises(TopologyError, match="no path from node 0 to node 2"):
        Network(3, [(0, 1), (1, 0), (2, 0)]).require_strongly_connected()
    with pytest.raises(TopologyError, match="not strongly connected"):
        _ = chain.diameter
    with pytest.raises(TopologyError, match="node a sends to node b without hearing it"):
        chain.require_undirected("this")
    with pytest.raises(TopologyError, match="node a hears 1 and is heard by 2"):
        chain.require_balanced("this")
    ring(5, directed=True).require_strongly_connected()
    ring(5, directed=True).require_balanced("this")
    ring(5).require_undirected("this")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Network(0), "at least one node"),
        (lambda: Network(3, [(0, 3)]), r"edge \(0, 3\) leaves"),
        (lambda: Network(3, [(0.5, 1)]), "node indices"),
        (lambda: Network(3, [(0, 1, 2)]), "pairs"),
        (lambda: Network(2, labels=["a", "a"]), "different labels"),
        (lambda: Network.from_edges([("a", "x")], nodes=["a", "b"]), "'x'"),
        (lambda: Network.from_adjacency(np.ones((2, 3))), "square"),
        (lambda: ring(4).index(9), "no node is called 9"),
        (lambda: ring(4).within(-1), "steps"),
        (lambda: lattice((3, 0)), "every axis"),
        (lambda: within_radius(np.zeros(3), 1.0), "positions"),
        (lambda: within_radius(np.zeros((3, 2)), -1.0), "radius"),
        (lambda: erdos_renyi(5, 1.5, np.random.default_rng(0)), "probability"),
        (lambda: random_regular(5, 3, np.random.default_rng(0)), "even"),
        (lambda: draw_connected(lambda: Network(2), attempts=3), "3 draws"),
    ],
)
def test_bad_input_is_refused(make, message: str) -> None:
    with pytest.raises(TopologyError, match=message):
        make()


@pytest.mark.parametrize(
    ("network", "reference"),
    [
        (complete(5), nx.complete_graph(5)),
        (line(6), nx.path_graph(6)),
        (ring(7), nx.cycle_graph(7)),
        (star(6), nx.star_graph(5)),
        (circulant(9, [1, 3]), nx.circulant_graph(9, [1, 3])),
    ],
)
def test_generators_agree_with_networkx(network: Network, reference: nx.Graph) -> None:
    assert nx.utils.edges_equal(network.to_networkx().edges, reference.edges)


def test_grids_number_their_points_row_major() -> None:
    reference = nx.convert_node_labels_to_integers(nx.grid_2d_graph(3, 4), ordering="sorted")
    assert nx.utils.edges_equal(lattice((3, 4)).to_networkx().edges, reference.edges)
    reference = nx.convert_node_labels_to_integers(nx.grid_2d_graph(3, 4, periodic=True), ordering="sorted")
    assert nx.utils.edges_equal(torus((3, 4)).to_networkx().edges, reference.edges)
    assert lattice((3, 3), diagonal=True).in_degree.tolist() == [4, 6, 4, 6, 9, 6, 4, 6, 4]
    assert (lattice((3, 3, 3)).in_degree.max(), torus((4, 4, 4)).in_degree.min()) == (7, 7)


def test_band_is_a_radius_in_node_numbering() -> None:
    network = band(12, 3)
    assert network.in_neighborhood(0).tolist() == [0, 1, 2, 3]
    assert network.in_neighborhood(6).tolist() == list(range(3, 10))
    assert band(12, 11) == complete(12)


def test_radius_may_be_open_or_closed() -> None:
    points = np.array([[0.0, 0.0], [3.0, 4.0], [0.0, 4.9]])
    assert within_radius(points, 5.0).edges.tolist() == [[1, 0], [2, 0], [0, 1], [2, 1], [0, 2], [1, 2]]
    assert [0, 1] not in within_radius(points, 5.0, strict=True).edges.tolist()


def test_reference_sensor_field() -> None:
    """Fingerprint of dmhe-l-step E2."""
    positions = np.random.default_rng(1).uniform(-500, 500, (100, 2))
    network = within_radius(positions, 160.0, strict=True)
    degree = network.in_degree - 1
    assert len(network.edges) == 2 * 352
    assert (degree.min(), degree.mean(), degree.max()) == (2, 7.04, 13)
    assert network.diameter == 12
    assert degree[:10].tolist() == [6, 6, 10, 11, 5, 10, 7, 10, 9, 6]
    nearest = network.distances(range(10)).min(axis=0)
    assert np.bincount(nearest).tolist() == [10, 56, 28, 6]
    drawn, where = random_geometric(100, 160.0, np.random.default_rng(1), low=-500, high=500, strict=True)
    assert drawn == network
    np.testing.assert_array_equal(where, positions)


def test_random_graphs_have_the_statistics_asked_for_and_repeat() -> None:
    rng = np.random.default_rng(3)
    undirected = erdos_renyi(400, 0.02, rng)
    directed = random_digraph(400, 0.02, rng)
    pairs = 400 * 399
    for network in (undirected, directed):
        assert len(network.edges) / pairs == pytest.approx(0.02, abs=5 * np.sqrt(2 * 0.02 / pairs))
    assert undirected.is_undirected
    assert not directed.is_undirected
    assert (random_regular(20, 3, rng).in_degree == 4).all()
    assert erdos_renyi(50, 0.1, np.random.default_rng(5)) == erdos_renyi(50, 0.1, np.random.default_rng(5))
    assert erdos_renyi(30, 1.0, rng) == random_digraph(30, 1.0, rng) == complete(30)


def test_importing_graphs_and_runtime_loads_nothing_heavy() -> None:
    code = (
        "import sys, problems.networks, problems.runtime;"
        "print([m for m in ('scipy', 'networkx', 'pandas', 'gtsam') if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert found.stdout.strip() == "[]"


def test_every_pair_can_be_drawn() -> None:
    """The pair numbering of the undirected draw covers the triangle once."""
    for count in (1, 2, 3, 50):
        assert erdos_renyi(count, 1.0, np.random.default_rng(0)) == complete(count)
    seen = np.zeros((6, 6))
    rng = np.random.default_rng(8)
    for _ in range(300):
        seen += erdos_renyi(6, 0.2, rng).adjacency().toarray()
    assert (seen > 0).all()
