"""Pre-estimation gains (dmhe-pre-estimation 3.5, 5.4, 6.1, 7.1; dmhe-l-step E2)."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from mhe.observers import check_gain, given_gain, kalman_gain, minimal_radius_gain, place_gain
from problems.errors import DefinitionError, ModelWarning, NoiseError, ShapeError, UnstableError

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
FIRST, THIRD = [1.0, 0, 0, 0], [0, 0, 1.0, 0]
FIXED_FIRST, FIXED_THIRD = np.array([0.9264423, 0.4516577]), np.array([0.99 + 0.4794789j, 0.99 - 0.4794789j])
COUPLED = np.diag([1, 1, -1, -1])  # changes the sign of the coupling between the two halves of the system


def assert_eigenvalues(found: np.ndarray, expected: object, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(np.asarray(expected, dtype=complex)), atol=atol)


class TestTable21:
    """dmhe-pre-estimation 7.1 to 1e-6 and the gains of 6.1."""

    POLES = (0.9, 0.6, 0.7, 0.8)

    def test_centralized(self) -> None:
        observer = place_gain(A, [FIRST, FIRST, THIRD, THIRD], self.POLES)
        assert_eigenvalues(observer.eigenvalues, self.POLES)
        assert observer.spectral_radius == pytest.approx(0.9, abs=1e-6)
        printed = [
            [-0.010952, -0.010952, 0.000129, 0.000129],
            [0.136488, 0.136488, -0.000229, -0.000229],
            [0.001491, 0.001491, 0.190002, 0.190002],
            [0.001786, 0.001786, 0.086202, 0.086202],
        ]
        self.assert_printed(observer.gain, printed)
        np.testing.assert_allclose(observer.error_matrix, A - observer.gain @ observer.C, atol=1e-15)

    def test_nodes_one_and_three(self) -> None:
        observer = place_gain(A, [FIRST, THIRD], self.POLES)
        assert_eigenvalues(observer.eigenvalues, self.POLES)
        printed = [[-0.021903, -0.000248], [0.272975, 0.000441], [-0.002865, 0.380003], [-0.003432, 0.172404]]
        self.assert_printed(observer.gain, printed)

    @staticmethod
    def assert_printed(gain: np.ndarray, printed: object) -> None:
        # The two halves do not interact, so the sign of the coupling is a convention of the linear algebra library.
        columns = np.repeat([1, -1], gain.shape[1] // 2)
        mirrored = COUPLED @ gain * columns
        expected = np.asarray(printed)
        error = min(np.abs(gain - expected).max(), np.abs(mirrored - expected).max())
        assert error < 1.5e-6

    def test_node_two_keeps_its_unobservable_pair(self) -> None:
        observer = place_gain(A, [FIRST, FIRST], (0.45, 0.58))
        assert_eigenvalues(observer.eigenvalues, [0.45, 0.58, *FIXED_THIRD])
        assert_eigenvalues(observer.fixed_eigenvalues, FIXED_THIRD)
        assert observer.spectral_radius == pytest.approx(1.1, abs=1e-6)
        assert observer.reachable_radius == pytest.approx(1.1, abs=1e-6)
        assert observer.observable_rank == 2
        printed = [[0.174050, 0.174050], [-0.062841, -0.062841], [0, 0], [0, 0]]
        np.testing.assert_allclose(observer.gain, printed, atol=1e-6)

    def test_node_four_as_a_design_and_literally(self) -> None:
        observer = place_gain(A, [THIRD, THIRD], (0.7, 0.8))
        assert_eigenvalues(observer.eigenvalues, [0.7, 0.8, *FIXED_FIRST])
        assert observer.reachable_radius == pytest.approx(0.9264, abs=5e-5)
        np.testing.assert_allclose(observer.gain, [[0, 0], [0, 0], [0.24, 0.24], [0.1502, 0.1502]], atol=1e-6)
        literal = place_gain(A, [THIRD, THIRD], (1.17 + 0.98j, 1.17 - 0.98j))
        assert literal.spectral_radius == pytest.approx(1.526, abs=5e-4)
        with pytest.warns(ModelWarning, match="node 4 .place. has spectral radius 1.52.*0.926442 can be reached"):
            check_gain(literal, node=4)


class TestPlacement:
    @pytest.mark.parametrize("seed", range(20))
    def test_random_systems_with_hidden_parts_and_dependent_rows(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        n, observed = 6, int(rng.integers(1, 7))
        inner = rng.normal(size=(n, n))
        inner[:observed, observed:] = 0
        independent = np.zeros((int(rng.integers(1, observed + 1)), n))
        independent[:, :observed] = rng.normal(size=(len(independent), observed))
        mix = np.linalg.qr(rng.normal(size=(n, n)))[0]
        state, output = mix @ inner @ mix.T, rng.normal(size=(4, len(independent))) @ independent @ mix.T
        poles = np.linspace(-0.5, 0.6, observed)
        observer = place_gain(state, output, poles)
        hidden = np.linalg.eigvals(inner[observed:, observed:])
        assert_eigenvalues(observer.eigenvalues, [*poles, *hidden], atol=1e-5)
        assert observer.observable_rank == observed
        assert observer.reachable_radius == pytest.approx(np.abs(hidden).max(initial=0), abs=1e-6)

    def test_complex_pairs_close_together(self) -> None:
        poles = [0.5 + 0.1j, 0.5 - 0.1j, 0.5 + 0.2j, 0.5 - 0.2j]
        observer = place_gain(A, [FIRST, THIRD], poles)
        found = sorted(observer.eigenvalues, key=lambda value: value.imag)
        np.testing.assert_allclose(found, sorted(poles, key=lambda value: value.imag), atol=1e-6)

    def test_a_full_set_of_outputs(self) -> None:
        assert_eigenvalues(place_gain(A, np.eye(4), (0.1, 0.2, 0.3, 0.4)).eigenvalues, (0.1, 0.2, 0.3, 0.4))

    def test_nothing_observed_means_no_gain(self) -> None:
        observer = place_gain(A, np.zeros((1, 4)), ())
        np.testing.assert_array_equal(observer.gain, np.zeros((4, 1)))
        assert observer.reachable_radius == pytest.approx(1.1)
        assert place_gain(A, np.zeros((0, 4)), ()).gain.shape == (4, 0)

    def test_wrong_numbers_and_impossible_eigenvalues(self) -> None:
        with pytest.raises(DefinitionError, match="observe 2 of 4 states, so 2 eigenvalues can be placed, got 4"):
            place_gain(A, [FIRST], (0.9, 0.6, 0.7, 0.8))
        with pytest.raises(DefinitionError, match="cannot be placed"):
            place_gain(A, [FIRST], (0.5, 0.5))
        with pytest.raises(DefinitionError, match="cannot be placed"):
            place_gain(A, [FIRST], (0.5 + 0.1j, 0.5 + 0.2j))
        with pytest.raises(ShapeError):
            place_gain(A, [[1.0, 0]], (0.5, 0.4))


class TestKalman:
    TRACKING = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2))
    POSITION = np.eye(4)[:2]

    @pytest.mark.parametrize(
        ("sensors", "a", "b"),
        [
            (1, 0.31701187, 0.04259045),
            (2, 0.37702, 0.05837),
            (3, 0.41717, 0.06997),
            (5, 0.47368, 0.08760),
            (10, 0.56206, 0.11788),
        ],
    )
    def test_gains_of_the_sensor_field(self, sensors: int, a: float, b: float) -> None:
        """dmhe-l-step E2: m equal sensors stacked get L(m) / m each."""
        output = np.vstack([self.POSITION] * sensors)
        observer = kalman_gain(self.TRACKING, output, np.eye(4) / 12, 100 / 3 * np.eye(2 * sensors))
        expected = np.vstack([a * np.eye(2), b * np.eye(2)]) / sensors
        np.testing.assert_allclose(observer.gain, np.hstack([expected] * sensors), atol=6e-6 if sensors > 1 else 6e-9)
        if sensors == 1:
            pair = [0.84149 + 0.13216j, 0.84149 - 0.13216j]
            assert_eigenvalues(observer.eigenvalues, pair * 2, atol=6e-6)

    def test_is_the_fixed_point_of_the_recursion(self) -> None:
        from mhe.covariance import centralized_covariances

        rng = np.random.default_rng(3)
        output, noise = rng.normal(size=(2, 4)), np.diag([0.5, 2.0])
        disturbance = np.diag([0.1, 0.2, 0.3, 0.4])
        covariance = centralized_covariances(A, output, disturbance, noise, np.eye(4), 500)[-1]
        expected = A @ covariance @ output.T @ np.linalg.inv(output @ covariance @ output.T + noise)
        np.testing.assert_allclose(kalman_gain(A, output, disturbance, noise).gain, expected, atol=1e-9)

    def test_of_a_part_leaves_the_rest(self) -> None:
        observer = kalman_gain(A, [FIRST, FIRST], np.diag([0.0012, 0.038, 0.0012, 0.038]), np.eye(2))
        np.testing.assert_allclose(observer.gain[2:], 0, atol=1e-12)
        assert observer.spectral_radius == pytest.approx(1.1, abs=1e-9)
        check_gain(observer, node=2)

    def test_smallest_reachable_radius(self) -> None:
        """9.3: 1.1000 for node 2, 0.9264 for node 4, whatever the noise."""
        for output, fixed in ((FIRST, 1.1), (THIRD, 0.9264423)):
            for scale in (1e-6, 1.0, 1e6):
                observer = minimal_radius_gain(A, [output], scale * np.eye(4), np.eye(1))
                assert observer.spectral_radius == pytest.approx(fixed, abs=1e-6)
                assert observer.reachable_radius == pytest.approx(fixed, abs=1e-6)
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    check_gain(observer, node="any")

    def test_a_weak_kalman_gain_may_miss_the_reachable_radius(self) -> None:
        """Almost no disturbance: the Kalman gain leaves the slow mode 0.99 alone, the other method does not."""
        state = np.diag([0.99, 0.5])
        weak = kalman_gain(state, [[1.0, 0]], 1e-12 * np.eye(2), np.eye(1))
        assert weak.spectral_radius == pytest.approx(0.99, abs=1e-3)
        with pytest.warns(ModelWarning, match="0.5 can be reached"):
            check_gain(weak, node=1)
        assert minimal_radius_gain(state, [[1.0, 0]], 1e-12 * np.eye(2), np.eye(1)).spectral_radius <= 0.5 + 1e-6

    def test_refusals(self) -> None:
        with pytest.raises(DefinitionError, match="no unobservable eigenvalue"):
            minimal_radius_gain(A, [FIRST, THIRD], np.eye(4), np.eye(2))
        with pytest.raises(NoiseError, match="no stationary Kalman gain"):
            kalman_gain(A, [FIRST], np.eye(4), -np.eye(1))
        with pytest.raises(ShapeError, match="expected Q"):
            kalman_gain(A, [FIRST], np.eye(3), np.eye(1))


class TestChecks:
    def test_unstable_where_all_is_observable(self) -> None:
        zero = given_gain(A, [FIRST, THIRD], np.zeros((4, 2)))
        with pytest.raises(UnstableError, match="observer of node 3 .given. has spectral radius 1.1"):
            check_gain(zero, node=3)
        with pytest.raises(UnstableError, match="centralized observer"):
            check_gain(zero)
        with pytest.warns(ModelWarning, match="spectral radius 1.1"):
            check_gain(zero, allow_unstable=True)

    def test_good_gains_pass_in_silence(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_gain(place_gain(A, [FIRST, THIRD], (0.9, 0.6, 0.7, 0.8)))
            check_gain(place_gain(A, [THIRD], (0.7, 0.8)), node=4)

    def test_a_detectable_node_may_not_be_slower_than_its_hidden_part(self) -> None:
        with pytest.warns(ModelWarning, match="spectral radius 0.95, while 0.926442 can be reached"):
            check_gain(place_gain(A, [THIRD], (0.7, 0.95)), node=4)

    def test_shapes(self) -> None:
        with pytest.raises(ShapeError, match=r"shape \(4, 2\), got \(2, 4\)"):
            given_gain(A, [FIRST, THIRD], np.zeros((2, 4)))
