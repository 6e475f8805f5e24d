"""Covariance recursions without data (dmhe-pre-estimation 3.1, 3.3, 5.7, 5.8, 7.2; dmhe-sporadic-fov 3.8)."""

from __future__ import annotations

import numpy as np
import pytest

from mhe.covariance import (
    arrival_update,
    capped,
    centralized_covariances,
    conditioned,
    definite,
    disturbance_response,
    network_covariances,
    output_information,
    prior_error_maps,
    regional_information,
    riccati_step,
    window_information,
    window_noise,
)
from mhe.observers import place_gain
from problems.errors import ModelWarning, NoiseError, ShapeError, UnknownNameError
from problems.networks import (
    Network,
    Weights,
    complete,
    convergence_rate,
    fusion_coefficients,
    observability_matrix,
    random_digraph,
    rank_weights,
    uniform_weights,
)

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
FIRST, THIRD, NOTHING = (np.array([row], dtype=float) for row in ([1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]))
RING = Network.from_edges([(4, 1), (1, 2), (2, 3), (3, 4)], nodes=[1, 2, 3, 4])
OUTPUTS, NOISES = [FIRST, FIRST, THIRD, THIRD], [np.eye(1)] * 4
POLES = [(0.9, 0.6, 0.7, 0.8), (0.45, 0.58), (0.9, 0.6, 0.7, 0.8), (0.7, 0.8)]


def diagonals(covariances: np.ndarray) -> np.ndarray:
    return np.diagonal(covariances, axis1=-2, axis2=-1)


def random_covariance(n: int, rng: np.random.Generator) -> np.ndarray:
    factor = rng.normal(size=(n, n))
    return factor @ factor.T + 0.1 * np.eye(n)


def ring_sequence(weights: Weights | None = None, **settings: object):
    coefficients = fusion_coefficients(weights or uniform_weights(RING))
    return network_covariances(coefficients, A, Q, OUTPUTS, NOISES, 5, np.eye(4), 1000, **settings)  # type: ignore[arg-type]


class TestRegressionNumbers:
    """dmhe-pre-estimation 7.2, N = 5, Pi_0 = I, to the four printed digits."""

    def test_first_local_covariances(self) -> None:
        printed = [
            [0.1593, 0.1927, 0.1884, 0.3245],
            [0.0877, 0.1786, 1.0012, 5.4225],
            [0.1593, 0.1927, 0.1884, 0.3245],
            [1.0316, 0.2218, 0.1157, 0.2241],
        ]
        np.testing.assert_allclose(diagonals(ring_sequence().local[0]), printed, atol=5e-5)

    def test_first_fused_covariances(self) -> None:
        one, two = [0.5954, 0.2073, 0.1520, 0.2743], [0.1235, 0.1856, 0.5948, 2.8735]
        np.testing.assert_allclose(diagonals(ring_sequence().fused[1]), [one, two, two, one], atol=5e-5)

    def test_stationary_traces(self) -> None:
        sequence = ring_sequence()
        traces = np.trace(sequence.fused[-1], axis1=1, axis2=2)
        np.testing.assert_allclose(traces, [0.3618, 0.8739, 0.9351, 0.4231], atol=5e-5)
        assert sequence.growth == pytest.approx(1.21 / 2)
        assert sequence.settled is not None

    def test_centralized(self) -> None:
        sequence = centralized_covariances(A, np.vstack(OUTPUTS), Q, np.eye(4), np.eye(4), 400)
        np.testing.assert_allclose(diagonals(sequence[1]), [0.3700, 0.1965, 1.0012, 4.4464], atol=5e-5)
        np.testing.assert_allclose(diagonals(sequence[-1]), [0.0297, 0.0462, 0.5424, 0.9823], atol=5e-5)

    def test_convergence_rates(self) -> None:
        information = regional_information(RING, OUTPUTS, NOISES)
        regional = [np.vstack([OUTPUTS[j] for j in RING.in_neighborhood(i)]) for i in range(4)]
        observers = np.array([place_gain(A, c, p).error_matrix for c, p in zip(regional, POLES, strict=True)])
        for weights, plain, pre in (
            (uniform_weights(RING), 0.8094, 0.6766),
            (rank_weights(RING, [4, 2, 4, 2]), 0.7687, 0.6235),
        ):
            stationary = ring_sequence(weights).fused[-1]
            maps = prior_error_maps(stationary, A, Q, information, 5)
            assert convergence_rate(weights, maps) == pytest.approx(plain, abs=5e-5)
            maps = prior_error_maps(stationary, A, Q, information, 5, observers)
            assert convergence_rate(weights, maps) == pytest.approx(pre, abs=5e-5)

    def test_without_communication_errors_grow_with_the_unobservable_modes(self) -> None:
        alone = Weights(RING, (RING.senders == RING.receivers).astype(float))
        with pytest.warns(ModelWarning, match="gamma = 1.21 >= 1"):
            sequence = ring_sequence(alone)
        information = regional_information(RING, OUTPUTS, NOISES)
        rate = convergence_rate(alone, prior_error_maps(sequence.fused[-1], A, Q, information, 5))
        assert rate == pytest.approx(1.1, abs=1e-6)

    def test_one_vehicle_always_seen(self) -> None:
        """dmhe-sporadic-fov 3.8: stationary values for A = C = 1, q = r = 1, N = 3."""
        one = np.eye(1)
        window = window_information([one] * 3, one, one)
        for rule, expected in (("seed", 1.296628), ("exact", 0.421722)):
            covariance = one
            for _ in range(200):
                covariance = arrival_update(covariance, one, one, one, window, rule)  # type: ignore[arg-type]
            assert covariance[0, 0] == pytest.approx(expected, abs=5e-7)


class TestWindowMatrices:
    def test_disturbance_response_block_by_block(self) -> None:
        output = np.vstack([FIRST, THIRD])
        response = disturbance_response(A, output, 4)
        assert response.shape == (8, 12)
        for row in range(4):
            for column in range(3):
                block = response[2 * row : 2 * row + 2, 4 * column : 4 * column + 4]
                lag = row - 1 - column
                expected = output @ np.linalg.matrix_power(A, lag) if lag >= 0 else np.zeros((2, 4))
                np.testing.assert_allclose(block, expected, atol=1e-14)
        assert disturbance_response(A, output, 1).shape == (2, 0)
        np.testing.assert_array_equal(window_noise(A, output, Q, np.eye(2), 1), np.eye(2))

    def test_window_noise_is_the_covariance_of_simulated_windows(self) -> None:
        rng = np.random.default_rng(0)
        output, noise = rng.normal(size=(2, 4)), random_covariance(2, rng)
        samples = 200_000
        state, stacked = np.zeros((samples, 4)), []
        for _ in range(3):
            stacked.append(state @ output.T + rng.multivariate_normal(np.zeros(2), noise, samples))
            state = state @ A.T + rng.multivariate_normal(np.zeros(4), Q, samples)
        empirical = np.cov(np.hstack(stacked).T)
        expected = window_noise(A, output, Q, noise, 3)
        np.testing.assert_allclose(empirical, expected, atol=0.02 * np.abs(expected).max())

    @pytest.mark.parametrize("horizon", [1, 2, 5, 12])
    def test_window_information_is_the_dense_formula(self, horizon: int) -> None:
        rng = np.random.default_rng(horizon)
        outputs = rng.normal(size=(3, 2, 4))
        noises = np.array([random_covariance(2, rng) for _ in range(3)])
        disturbance = random_covariance(4, rng)
        dense = observability_matrix(A, outputs, horizon)
        noise = window_noise(A, outputs, disturbance, noises, horizon)
        expected = np.swapaxes(dense, -1, -2) @ np.linalg.solve(noise, dense)
        found = window_information([output_information(outputs, noises)] * horizon, A, disturbance)
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)

    def test_a_singular_disturbance_is_allowed(self) -> None:
        shaken = np.outer([0.5, 1, 0, 0], [0.5, 1, 0, 0])
        output = np.vstack([FIRST, THIRD])
        dense = observability_matrix(A, output, 4)
        expected = dense.T @ np.linalg.solve(window_noise(A, output, shaken, np.eye(2), 4), dense)
        found = window_information([output_information(output, np.eye(2))] * 4, A, shaken)
        np.testing.assert_allclose(found, expected, rtol=1e-10)

    def test_conditioned_avoids_both_inverses(self) -> None:
        rng = np.random.default_rng(1)
        covariance, information = random_covariance(4, rng), np.outer([1, 2, 0, 1], [1, 2, 0, 1]).astype(float)
        expected = np.linalg.inv(np.linalg.inv(covariance) + information)
        np.testing.assert_allclose(conditioned(covariance, information), expected, rtol=1e-10)
        huge = conditioned(np.diag([1e14, 1e14]), np.diag([4.0, 0.0]))
        np.testing.assert_allclose(huge, np.diag([0.25, 1e14]), rtol=1e-12)
        with pytest.raises(NoiseError, match="not positive definite"):
            conditioned(np.diag([1.0, -1.0]), np.eye(2))


class TestUpdates:
    @pytest.mark.parametrize("seed", range(5))
    def test_seed_is_the_printed_formula(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        output, noise, horizon = rng.normal(size=(3, 4)), random_covariance(3, rng), 4
        before, disturbance = random_covariance(4, rng), random_covariance(4, rng)
        dense = observability_matrix(A, output, horizon)
        star = np.linalg.inv(np.linalg.inv(before) + output.T @ np.linalg.solve(noise, output))
        inner = dense @ star @ dense.T + window_noise(A, output, disturbance, noise, horizon)
        correction = A @ star @ dense.T @ np.linalg.solve(inner, dense @ star @ A.T)
        expected = A @ star @ A.T + disturbance - correction
        information = output_information(output, noise)
        window = window_information([information] * horizon, A, disturbance)
        found = arrival_update(before, A, disturbance, information, window)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)

    @pytest.mark.parametrize("seed", range(5))
    def test_exact_is_the_covariance_of_the_window_problem(self, seed: int) -> None:
        """Brute force: all states of the window and one before as unknowns of a linear least-squares problem."""
        rng = np.random.default_rng(seed)
        horizon = 4
        outputs = rng.normal(size=(horizon + 1, 2, 4))  # of t-N-1 .. t-1
        noise, disturbance, before = random_covariance(2, rng), random_covariance(4, rng), random_covariance(4, rng)
        size = 4 * (horizon + 1)
        hessian = np.zeros((size, size))
        hessian[:4, :4] += np.linalg.inv(before)
        for k in range(horizon + 1):
            block = slice(4 * k, 4 * k + 4)
            hessian[block, block] += outputs[k].T @ np.linalg.solve(noise, outputs[k])
            if k:
                step = np.zeros((4, size))
                step[:, block], step[:, 4 * k - 4 : 4 * k] = np.eye(4), -A
                hessian += step.T @ np.linalg.solve(disturbance, step)
        expected = np.linalg.inv(hessian)[4:8, 4:8]
        informations = [output_information(output, noise) for output in outputs]
        window = window_information(informations[1:], A, disturbance)
        found = arrival_update(before, A, disturbance, informations[0], window, "exact")
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)

    def test_riccati_step_is_batched(self) -> None:
        rng = np.random.default_rng(0)
        covariances = np.array([random_covariance(4, rng) for _ in range(3)])
        outputs, noise = rng.normal(size=(3, 2, 4)), random_covariance(2, rng)
        batch = riccati_step(covariances, A, outputs, Q, noise)
        for covariance, output, result in zip(covariances, outputs, batch, strict=True):
            gain = A @ covariance @ output.T @ np.linalg.inv(output @ covariance @ output.T + noise)
            expected = A @ covariance @ A.T + Q - gain @ output @ covariance @ A.T
            np.testing.assert_allclose(result, expected, rtol=1e-10)
            np.testing.assert_array_equal(result, result.T)

    def test_unknown_rule(self) -> None:
        with pytest.raises(UnknownNameError, match="exact"):
            arrival_update(np.eye(4), A, Q, np.eye(4), np.eye(4), "exakt")  # type: ignore[arg-type]


class TestNetwork:
    def test_equals_the_loop_over_nodes_with_stacked_matrices(self) -> None:
        rng = np.random.default_rng(4)
        network = random_digraph(7, 0.4, rng)
        outputs = [rng.normal(size=(int(rng.integers(0, 3)), 4)) for _ in range(7)]
        noises = [random_covariance(len(output), rng) for output in outputs]
        weights, horizon = uniform_weights(network), 3
        coefficients = fusion_coefficients(weights).matrix()
        found = network_covariances(fusion_coefficients(weights), A, Q, outputs, noises, horizon, 2 * np.eye(4), 6)
        fused = np.array([2 * np.eye(4)] * 7)
        for step in range(6):
            local = []
            for node in range(7):
                heard = [j for j in network.in_neighborhood(node) if len(outputs[j])]
                stacked = np.vstack([np.zeros((0, 4)), *(outputs[j] for j in heard)])
                noise = np.zeros((len(stacked), len(stacked)))
                start = 0
                for j in heard:
                    end = start + len(outputs[j])
                    noise[start:end, start:end], start = noises[j], end
                star = np.linalg.inv(np.linalg.inv(fused[node]) + stacked.T @ np.linalg.solve(noise, stacked))
                dense = observability_matrix(A, stacked, horizon)
                inner = dense @ star @ dense.T + window_noise(A, stacked, Q, noise, horizon)
                local.append(A @ star @ A.T + Q - A @ star @ dense.T @ np.linalg.solve(inner, dense @ star @ A.T))
            fused = np.einsum("ij,jab->iab", coefficients, np.array(local))
            np.testing.assert_allclose(found.local[step], local, rtol=1e-8, atol=1e-10)
            np.testing.assert_allclose(found.fused[step + 1], fused, rtol=1e-8, atol=1e-10)

    def test_times_count_from_the_full_window(self) -> None:
        sequence = ring_sequence()
        np.testing.assert_array_equal(sequence.fused_at(0), [np.eye(4)] * 4)
        np.testing.assert_array_equal(sequence.fused_at(5), [np.eye(4)] * 4)
        np.testing.assert_array_equal(sequence.fused_at(6), sequence.fused[1])
        np.testing.assert_array_equal(sequence.fused_at(10**6), sequence.fused[-1])
        short = network_covariances(fusion_coefficients(uniform_weights(RING)), A, Q, OUTPUTS, NOISES, 5, np.eye(4), 3)
        assert short.settled is None
        with pytest.raises(ShapeError, match="had not settled"):
            short.fused_at(9)

    def test_stays_symmetric_and_definite(self) -> None:
        for rule in ("seed", "exact"):
            fused = ring_sequence(rule=rule).fused
            np.testing.assert_array_equal(fused, np.swapaxes(fused, -1, -2))
            assert np.linalg.eigvalsh(fused).min() > 0

    def test_growth_without_bound_is_capped_with_a_warning(self) -> None:
        """Spec 10 of section 9: the nine-cycle with uniform weights has gamma = 1.056."""
        cycle = [1, 2, 3, 4, 9, 8, 7, 5, 6]
        network = Network.from_edges(
            zip(cycle, cycle[1:] + cycle[:1], strict=True), nodes=range(1, 10), undirected=True
        )
        outputs = [FIRST, FIRST, THIRD, THIRD, NOTHING, FIRST, NOTHING, NOTHING, THIRD]
        coefficients = fusion_coefficients(uniform_weights(network))
        with pytest.warns(ModelWarning, match="gamma = 1.056 >= 1.*capped at 4e"):
            sequence = network_covariances(coefficients, A, Q, outputs, [np.eye(1)] * 9, 4, np.eye(4), 900)
        largest = np.linalg.eigvalsh(sequence.fused).max(axis=(1, 2))
        assert largest[-1] == pytest.approx(4e8, rel=1e-9)
        assert largest[20] < 1e5
        assert np.linalg.eigvalsh(sequence.fused[-1]).min() > 0
        with pytest.warns(ModelWarning, match="capped at 100"):
            low = network_covariances(coefficients, A, Q, outputs, [np.eye(1)] * 9, 4, np.eye(4), 900, cap=100.0)
        assert np.linalg.eigvalsh(low.fused).max() <= 100 * (1 + 1e-12)

    def test_complete_graph_makes_all_nodes_equal(self) -> None:
        coefficients = fusion_coefficients(uniform_weights(complete(4)))
        fused = network_covariances(coefficients, A, Q, OUTPUTS, NOISES, 5, np.eye(4), 50).fused
        np.testing.assert_allclose(fused - fused[:, :1], 0, atol=1e-12)

    def test_capped_leaves_small_ones_untouched(self) -> None:
        covariances = np.array([np.eye(2), np.diag([5.0, 200.0])])
        result = capped(covariances, 100.0)
        np.testing.assert_array_equal(result[0], np.eye(2))
        np.testing.assert_allclose(result[1], np.diag([5.0, 100.0]), rtol=1e-14)
        assert capped(covariances, 1e9) is covariances

    def test_bad_covariances_are_named(self) -> None:
        coefficients = fusion_coefficients(uniform_weights(RING))
        arguments = (coefficients, A, Q, OUTPUTS, NOISES, 5, np.eye(4), 3)

        def replaced(position: int, value: object) -> tuple:
            return (*arguments[:position], value, *arguments[position + 1 :])

        with pytest.raises(NoiseError, match="Q is not positive definite"):
            network_covariances(*replaced(2, np.diag([1.0, 1, 1, 0])))
        with pytest.raises(NoiseError, match="node 3: R is not positive definite"):
            network_covariances(*replaced(4, [np.eye(1), np.eye(1), -np.eye(1), np.eye(1)]))
        with pytest.raises(NoiseError, match="Pi_0 is not symmetric"):
            network_covariances(*replaced(6, np.eye(4) + np.triu(np.ones((4, 4)), 1)))
        with pytest.raises(ShapeError, match="N >= 1"):
            network_covariances(*replaced(5, 0))
        with pytest.raises(ShapeError, match="square"):
            definite("Q", np.ones((2, 3)))
        with pytest.raises(NoiseError, match="Q"):
            definite("Q", np.full((2, 2), np.nan))
