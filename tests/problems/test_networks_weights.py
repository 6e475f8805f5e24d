"""Consensus weights, fusion, observability and the reports on them (dmhe-pre-estimation 3.6, 4.4, 5, 7)."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from problems.errors import ModelWarning, ShapeError, TopologyError, UnknownNameError, UnobservableError
from problems.networks import (
    Network,
    Weights,
    complete,
    consensus_margin,
    consensus_reach,
    convergence_rate,
    covariance_growth,
    draw_connected,
    fusion_coefficients,
    given_weights,
    line,
    metropolis_weights,
    mixed_weights,
    normalize_rows,
    observability_matrix,
    observability_report,
    observable_split,
    random_digraph,
    rank_weights,
    regional_outputs,
    regional_ranks,
    ring,
    spectral_radius,
    uniform_weights,
    unobservable_eigenvalues,
)

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
FIRST, THIRD, NOTHING = (np.array([row], dtype=float) for row in ([1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]))

RING = Network.from_edges([(4, 1), (1, 2), (2, 3), (3, 4)], nodes=[1, 2, 3, 4])
RING_OUTPUTS = [FIRST, FIRST, THIRD, THIRD]
RING_K = np.array([[0.5, 0, 0, 0.5], [0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5]])

NINE_OUTPUTS = [FIRST, FIRST, THIRD, THIRD, NOTHING, FIRST, NOTHING, NOTHING, THIRD]
NINE_EDGES = "1-2 1-5 1-6 2-3 2-4 3-4 3-6 3-9 4-8 4-9 5-6 5-7 7-8 8-9"
CYCLE = [1, 2, 3, 4, 9, 8, 7, 5, 6]


def nine_nodes() -> Network:
    pairs = [tuple(map(int, edge.split("-"))) for edge in NINE_EDGES.split()]
    return Network.from_edges(((a, b) for a, b in pairs), nodes=range(1, 10), undirected=True)


def nine_cycle() -> Network:
    return Network.from_edges(zip(CYCLE, CYCLE[1:] + CYCLE[:1], strict=True), nodes=range(1, 10), undirected=True)


def random_covariances(count: int, n: int, rng: np.random.Generator) -> np.ndarray:
    factors = rng.normal(size=(count, n, n)) * rng.lognormal(sigma=1.0, size=(count, 1, 1))
    return factors @ np.swapaxes(factors, -1, -2) + 0.01 * np.eye(n)


class TestWeights:
    def test_given_matrix_is_kept(self) -> None:
        weights = given_weights(RING, RING_K)
        np.testing.assert_array_equal(weights.matrix(), RING_K)
        np.testing.assert_array_equal(weights.row(0), [0.5, 0.5])
        np.testing.assert_array_equal(weights.matrix(), uniform_weights(RING).matrix())

    @pytest.mark.parametrize(
        ("entry", "value", "error", "message"),
        [
            ((0, 0), 0.6, TopologyError, "weights at node 1 sum to 1.1"),
            ((0, 0), -0.5, TopologyError, "weight of node 1 at node 1 is -0.5"),
            ((0, 0), np.nan, TopologyError, "nonnegative"),
        ],
    )
    def test_a_wrong_entry_is_named(self, entry, value, error, message) -> None:
        wrong = RING_K.copy()
        wrong[entry] = value
        with pytest.raises(error, match=message):
            given_weights(RING, wrong)

    def test_weights_off_the_graph_and_without_self_loops_are_refused(self) -> None:
        outside = RING_K.copy()
        outside[0] = [0.5, 0.25, 0, 0.25]
        with pytest.raises(TopologyError, match="node 1 weighs node 2 with 0.25 but does not hear it"):
            given_weights(RING, outside)
        mute = RING_K.copy()
        mute[2] = [0, 1, 0, 0]
        with pytest.raises(TopologyError, match="nodes 3 give themselves no weight"):
            given_weights(RING, mute)
        with pytest.raises(ShapeError):
            given_weights(RING, np.eye(3))

    def test_an_unused_link_is_only_warned_about(self) -> None:
        with pytest.warns(ModelWarning, match="1 links from nodes 4 have weight zero"):
            unused = given_weights(RING, np.vstack([[1, 0, 0, 0], RING_K[1:]]))
        np.testing.assert_array_equal(unused.matrix()[0], [1, 0, 0, 0])

    def test_row_sums_within_tolerance_pass(self) -> None:
        given_weights(RING, RING_K * (1 + 5e-10))
        with pytest.raises(TopologyError, match="sum to"):
            given_weights(RING, RING_K * (1 + 1e-8))

    def test_metropolis_excludes_self_loops(self) -> None:
        """(2.33): on the path 1-2-3 degrees are 1, 2, 1."""
        np.testing.assert_allclose(
            metropolis_weights(line(3)).matrix(),
            [[2 / 3, 1 / 3, 0], [1 / 3, 1 / 3, 1 / 3], [0, 1 / 3, 2 / 3]],
            atol=1e-15,
        )
        doubly = metropolis_weights(nine_nodes()).matrix()
        np.testing.assert_allclose(doubly, doubly.T, atol=1e-15)
        np.testing.assert_allclose(doubly.sum(axis=0), 1, atol=1e-12)

    def test_metropolis_refuses_a_digraph(self) -> None:
        with pytest.raises(TopologyError, match="Metropolis weights: the graph must be undirected"):
            metropolis_weights(RING)

    def test_metropolis_of_the_reference_field(self) -> None:
        """dmhe-l-step E2: minimal diagonal 1/14, pi_00 = 0.265873, second eigenvalue modulus 0.98755."""
        from problems.networks import within_radius

        positions = np.random.default_rng(1).uniform(-500, 500, (100, 2))
        matrix = metropolis_weights(within_radius(positions, 160.0, strict=True)).matrix()
        assert np.diag(matrix).min() == pytest.approx(1 / 14, abs=1e-12)
        assert matrix[0, 0] == pytest.approx(0.265873, abs=5e-7)
        assert np.sort(np.abs(np.linalg.eigvals(matrix)))[-2] == pytest.approx(0.98755, abs=5e-6)

    def test_rank_weights_of_the_ring(self) -> None:
        ranks = regional_ranks(RING, A, RING_OUTPUTS, 5)
        assert ranks.tolist() == [4, 2, 4, 2]
        expected = np.array([[4, 0, 0, 2], [4, 2, 0, 0], [0, 2, 4, 0], [0, 0, 4, 2]]) / 6
        np.testing.assert_allclose(rank_weights(RING, ranks).matrix(), expected, atol=1e-15)

    def test_rank_weights_of_the_nine_nodes(self) -> None:
        network = nine_nodes()
        ranks = regional_ranks(network, A, NINE_OUTPUTS, 4)
        assert ranks.tolist() == [2, 4, 4, 4, 2, 4, 0, 2, 2]
        with pytest.warns(ModelWarning, match=r"from nodes 7 have weight zero because they observe nothing"):
            weights = rank_weights(network, ranks)
        matrix = weights.matrix()
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-15)
        assert (matrix[:, 6] == 0).all()
        np.testing.assert_allclose(matrix[6, [4, 7]], 0.5)

    def test_rows_in_which_nobody_observes_are_uniform(self) -> None:
        with pytest.warns(ModelWarning) as caught:
            weights = rank_weights(line(4), [0, 0, 0, 3])
        assert "nodes 0, 1 hear observes anything" in str(caught[0].message)
        np.testing.assert_allclose(weights.matrix()[0], [0.5, 0.5, 0, 0])
        np.testing.assert_allclose(weights.matrix()[1], [1 / 3, 1 / 3, 1 / 3, 0])
        np.testing.assert_allclose(weights.matrix()[2], [0, 0, 0, 1])

    def test_floored_ranks_warn_of_nothing(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            weights = rank_weights(line(3), [0.5, 0.5, 4])
        np.testing.assert_allclose(weights.row(1), [0.1, 0.1, 0.8])

    def test_bad_ranks(self) -> None:
        with pytest.raises(ShapeError):
            rank_weights(RING, [1, 2, 3])
        with pytest.raises(TopologyError, match="nodes 2"):
            rank_weights(RING, [1, -1, 3, 2])

    def test_one_rule_for_one_node_and_for_many_trials(self) -> None:
        rng = np.random.default_rng(0)
        network = nine_nodes()
        ranks = rng.integers(0, 5, (20, 9)).astype(float)
        batched = normalize_rows(ranks[:, network.senders], network.offsets)
        for trial in range(20):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.testing.assert_array_equal(batched[trial], rank_weights(network, ranks[trial]).values)
        heard = network.in_neighborhood(3)
        row = normalize_rows(ranks[0, heard], [0, len(heard)])
        np.testing.assert_array_equal(row, batched[0, network.offsets[3] : network.offsets[4]])

    def test_mixed(self) -> None:
        first, second = uniform_weights(RING), rank_weights(RING, [4, 2, 4, 2])
        np.testing.assert_allclose(
            mixed_weights(first, second, 0.25).matrix(), 0.25 * first.matrix() + 0.75 * second.matrix(), atol=1e-15
        )
        with pytest.raises(TopologyError, match="share"):
            mixed_weights(first, second, 1.2)
        with pytest.raises(TopologyError, match="different graphs"):
            mixed_weights(first, uniform_weights(ring(4)), 0.5)

    def test_combine_sums_over_the_in_neighbourhood(self) -> None:
        rng = np.random.default_rng(4)
        network = random_digraph(12, 0.3, rng)
        weights = uniform_weights(network)
        items = rng.normal(size=(12, 3, 2))
        np.testing.assert_allclose(
            weights.combine(items), np.einsum("ij,jab->iab", weights.matrix(), items), atol=1e-14
        )
        with pytest.raises(ShapeError, match="first axis 12"):
            weights.combine(items[:5])
        with pytest.raises(ShapeError):
            Weights(network, np.ones(3))


class TestFusion:
    def test_coefficients_literal(self) -> None:
        fan = Network(4, [(0, 1), (0, 2), (0, 3), (1, 0)])
        weights = uniform_weights(fan)
        squared = weights.matrix() ** 2
        np.testing.assert_allclose(fusion_coefficients(weights).matrix(), squared * [4, 2, 1, 1])
        np.testing.assert_allclose(fusion_coefficients(weights, "in_degree").matrix(), squared * [2, 2, 2, 2])
        np.testing.assert_allclose(fusion_coefficients(weights, "convex").matrix(), weights.matrix())
        np.testing.assert_allclose(fusion_coefficients(Weights(fan, fan.senders == fan.receivers)).matrix(), np.eye(4))
        with pytest.raises(UnknownNameError, match="out_degree"):
            fusion_coefficients(weights, "out-degree")  # type: ignore[arg-type]

    def test_out_degree_meets_the_consensus_inequality_and_in_degree_does_not(self) -> None:
        """Spec 4.4 and E1: 300 random digraphs, 0 violations with d_j, many with the printed n_S^j."""
        rng = np.random.default_rng(11)
        margins = {"out_degree": [], "in_degree": []}
        for _ in range(300):
            count = int(rng.integers(3, 9))
            network = draw_connected(lambda count=count: random_digraph(count, 0.35, rng))
            weights = Weights(network, normalize_rows(rng.uniform(0.05, 1, len(network.senders)), network.offsets))
            covariances = random_covariances(count, 3, rng)
            for rule, found in margins.items():
                coefficients = fusion_coefficients(weights, rule)  # type: ignore[arg-type]
                found.append(consensus_margin(weights, covariances, coefficients.combine(covariances)))
        assert min(margins["out_degree"]) > -1e-10
        broken = sum(margin < -1e-6 for margin in margins["in_degree"])
        assert broken > 100
        assert min(margins["in_degree"]) < -0.5

    def test_margin_is_that_of_the_matrix_inequality(self) -> None:
        rng = np.random.default_rng(2)
        network = random_digraph(5, 0.5, rng)
        weights = uniform_weights(network)
        before, after = random_covariances(5, 2, rng), random_covariances(5, 2, rng)
        spread = np.kron(weights.matrix(), np.eye(2))
        right, middle = np.zeros((10, 10)), np.zeros((10, 10))
        for i in range(5):
            block = slice(2 * i, 2 * i + 2)
            right[block, block], middle[block, block] = np.linalg.inv(before[i]), np.linalg.inv(after[i])
        from scipy.linalg import eigh

        largest = eigh(spread.T @ middle @ spread, right, eigvals_only=True)[-1]
        assert consensus_margin(weights, before, after) == pytest.approx(1 - largest, rel=1e-9)


class TestObservability:
    def test_classes_of_both_nine_node_graphs(self) -> None:
        report = observability_report(nine_nodes(), A, NINE_OUTPUTS)
        classes = {name: {i + 1 for i, c in enumerate(report.classes) if c == name} for name in report.classes}
        assert classes == {"green": {2, 3, 4, 6}, "yellow": {8, 9}, "orange": {1, 5}, "red": {7}}
        assert report.local_rank.tolist() == [2, 2, 2, 2, 0, 2, 0, 0, 2]
        assert report.local_detectable.tolist() == [c is THIRD for c in NINE_OUTPUTS]
        assert report.index.tolist() == [2] * 6 + [1] + [2] * 2
        np.testing.assert_allclose(np.abs(report.unobservable[0]), 1.1, atol=1e-9)
        np.testing.assert_allclose(np.sort(report.unobservable[7].real), [0.451658, 0.926442], atol=1e-6)
        report = observability_report(nine_cycle(), A, NINE_OUTPUTS)
        classes = {name: {i + 1 for i, c in enumerate(report.classes) if c == name} for name in report.classes}
        assert classes == {"green": {2, 3}, "yellow": {4, 8, 9}, "orange": {1, 5, 6}, "red": {7}}

    def test_a_system_nobody_observes_is_refused(self) -> None:
        with pytest.raises(UnobservableError, match="together observe 2 of 4 states"):
            observability_report(RING, A, [FIRST] * 4)

    def test_a_marginal_double_root_counts_as_undetectable(self) -> None:
        tracking = np.kron(np.eye(2), [[1.0, 1.0], [0, 1.0]])
        network = complete(2)
        report = observability_report(network, tracking, [np.eye(4)[[0]], np.eye(4)[[2]]])
        assert report.local_rank.tolist() == [2, 2]
        assert not report.local_detectable.any()
        assert report.regional_detectable.all()

    def test_compression_changes_no_singular_value(self) -> None:
        rng = np.random.default_rng(6)
        network = random_digraph(8, 0.4, rng)
        outputs = [rng.normal(size=(rows, 4)) for rows in (0, 1, 2, 3, 1, 5, 0, 2)]
        compressed = regional_outputs(network, outputs)
        for node in range(8):
            stacked = np.vstack([outputs[j] for j in network.in_neighborhood(node)])
            expected = np.linalg.svd(observability_matrix(A, stacked, 5), compute_uv=False) if len(stacked) else []
            found = np.linalg.svd(observability_matrix(A, compressed[node], 5), compute_uv=False)
            np.testing.assert_allclose(found[: len(expected)], expected[:4], atol=1e-12)
            np.testing.assert_allclose(compressed[node].T @ compressed[node], stacked.T @ stacked, atol=1e-12)
        with pytest.raises(ShapeError, match="8 output matrices"):
            regional_outputs(network, outputs[:3])

    def test_split_and_fixed_eigenvalues_of_a_hidden_part(self) -> None:
        rng = np.random.default_rng(1)
        mix = rng.normal(size=(4, 4))
        system, output = mix @ A @ np.linalg.inv(mix), FIRST @ np.linalg.inv(mix)
        basis, rank = observable_split(system, output)
        assert rank == 2
        np.testing.assert_allclose(observability_matrix(system, output, 4) @ basis[:, 2:], 0, atol=1e-10)
        np.testing.assert_allclose(basis.T @ basis, np.eye(4), atol=1e-12)
        fixed = unobservable_eigenvalues(system, output)
        assert np.isnan(fixed[2:]).all()
        np.testing.assert_allclose(np.sort_complex(fixed[:2]), [0.99 - 0.47948j, 0.99 + 0.47948j], atol=1e-5)

    def test_ranks_need_enough_block_rows(self) -> None:
        assert regional_ranks(RING, A, RING_OUTPUTS, 1).tolist() == [2, 1, 2, 1]
        assert regional_ranks(RING, A, RING_OUTPUTS, 2).tolist() == [4, 2, 4, 2]


class TestReports:
    def test_reach_on_the_ring(self) -> None:
        assert consensus_reach(uniform_weights(RING), A, RING_OUTPUTS) == pytest.approx(0.55, abs=1e-9)
        ranked = rank_weights(RING, [4, 2, 4, 2])
        assert consensus_reach(ranked, A, RING_OUTPUTS) == pytest.approx(1.1 / 3, abs=1e-9)

    @pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")
    def test_reach_and_growth_on_the_nine_cycle(self) -> None:
        network = nine_cycle()
        uniform = uniform_weights(network)
        ranked = rank_weights(network, regional_ranks(network, A, NINE_OUTPUTS, 4))
        assert consensus_reach(uniform, A, NINE_OUTPUTS) == pytest.approx(0.960, abs=5e-4)
        assert consensus_reach(ranked, A, NINE_OUTPUTS) == pytest.approx(0.979, abs=5e-4)
        assert covariance_growth(fusion_coefficients(uniform), A, NINE_OUTPUTS) == pytest.approx(1.056, abs=5e-4)
        assert covariance_growth(fusion_coefficients(ranked), A, NINE_OUTPUTS) == pytest.approx(1.337, abs=5e-4)

    def test_reach_equals_the_definition_with_projectors(self) -> None:
        rng = np.random.default_rng(9)
        for _ in range(5):
            network = random_digraph(7, 0.3, rng)
            outputs = [(FIRST, THIRD, NOTHING)[rng.integers(3)] for _ in range(7)]
            weights = uniform_weights(network)
            projector = np.zeros((28, 28))
            for node, stacked in enumerate(regional_outputs(network, outputs)):
                matrix = observability_matrix(A, stacked, 4)
                block = slice(4 * node, 4 * node + 4)
                projector[block, block] = np.eye(4) - np.linalg.pinv(matrix, rcond=1e-9) @ matrix
            dense = projector @ np.kron(weights.matrix(), A) @ projector
            expected = np.abs(np.linalg.eigvals(dense)).max()
            assert consensus_reach(weights, A, outputs) == pytest.approx(expected, abs=1e-6)

    def test_growth_equals_the_definition_with_ranks(self) -> None:
        rng = np.random.default_rng(10)
        for _ in range(5):
            network = random_digraph(7, 0.3, rng)
            outputs = [(FIRST, THIRD, NOTHING)[rng.integers(3)] for _ in range(7)]
            coefficients = fusion_coefficients(uniform_weights(network))
            expected = 0.0
            for eigenvalue in np.linalg.eigvals(A):
                blind = [
                    node
                    for node, stacked in enumerate(regional_outputs(network, outputs))
                    if np.linalg.matrix_rank(np.vstack([A - eigenvalue * np.eye(4), stacked]), tol=1e-9) < 4
                ]
                if blind:
                    radius = np.abs(np.linalg.eigvals(coefficients.matrix()[np.ix_(blind, blind)])).max()
                    expected = max(expected, abs(eigenvalue) ** 2 * radius)
            assert covariance_growth(coefficients, A, outputs) == pytest.approx(expected, abs=1e-9)

    def test_nothing_hidden_reaches_zero(self) -> None:
        weights = uniform_weights(complete(4))
        assert consensus_reach(weights, A, RING_OUTPUTS) == 0
        assert covariance_growth(fusion_coefficients(weights), A, RING_OUTPUTS) == 0

    def test_convergence_rate_is_the_radius_of_the_block_matrix(self) -> None:
        rng = np.random.default_rng(3)
        network = random_digraph(6, 0.5, rng)
        weights, maps = uniform_weights(network), rng.normal(size=(6, 2, 2))
        dense = np.block([[weights.matrix()[i, j] * maps[j] for j in range(6)] for i in range(6)])
        expected = np.abs(np.linalg.eigvals(dense)).max()
        assert convergence_rate(weights, maps) == pytest.approx(expected, rel=1e-9)
        with pytest.raises(ShapeError, match="one square map per node"):
            convergence_rate(weights, maps[:4])

    def test_spectral_radius_of_chains_and_of_large_components(self) -> None:
        chain = np.diag(np.full(60, 0.1)) + np.diag(np.full(59, 5.0), 1)
        assert spectral_radius(chain) == pytest.approx(0.1, abs=1e-12)
        assert spectral_radius(uniform_weights(ring(800)).sparse) == pytest.approx(1.0, abs=1e-8)
