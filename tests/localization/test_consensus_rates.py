"""Step sizes, one-step matrices and rates of consensus on relative vectors."""

from __future__ import annotations

import networkx
import numpy as np
import pytest

from localization.consensus.arrays import AsynchronousArrays
from localization.consensus.rates import (
    average_matrix,
    consensus_weights,
    essential_radius,
    mean_square_rates,
    ramanujan_second,
    regular_eigenvalues,
    regular_rate,
    step_limit,
    torus_second,
    transmission_matrix,
)
from localization.consensus.relative import RelativeVectors, measure_differences, optimum
from problems.errors import ModelWarning, SettingError
from problems.networks import Network, complete, random_geometric, ring, torus

PETERSEN = Network.from_networkx(networkx.petersen_graph())
TABLE = [  # spec 7.2: rho_ess(P), rho_ess(Qbar), R
    (ring(10), 0.87268, 0.984460, 0.969709),
    (torus([4, 4]), 0.6, 0.969859, 0.949529),
    (torus([6, 6]), 0.8, 0.993390, 0.987202),
    (PETERSEN, 0.5, 0.936603, 0.908607),
    (complete(4), 0.0, 0.625, 0.671091),
    (complete(5), 0.0, 0.743303, 0.750946),
    (complete(10), 0.0, 0.888712, 0.888905),
]


def measured(network: Network, seed: int = 0, variance: float | np.ndarray = 1e-4) -> RelativeVectors:
    rng = np.random.default_rng(seed)
    return measure_differences(network, rng.random((network.count, 1)), variance, rng)


@pytest.mark.parametrize(("network", "plain", "average", "exact"), TABLE)
def test_rates_of_the_table(network: Network, plain: float, average: float, exact: float) -> None:
    weights = consensus_weights(measured(network))
    rates = mean_square_rates(weights)
    assert essential_radius(weights.matrix()) == pytest.approx(plain, abs=6e-6)
    assert rates.average == pytest.approx(average, abs=6e-7)
    assert rates.exact == pytest.approx(exact, abs=1e-6)
    assert rates.lower == pytest.approx(average**2, abs=2e-6)
    assert rates.lower <= rates.exact <= rates.upper


def test_exact_rate_is_that_of_the_dense_map() -> None:
    weights = consensus_weights(measured(complete(3)))
    shares = np.array([0.5, 0.3, 0.2])
    q = [transmission_matrix(weights, s).toarray() for s in range(3)]
    dense = sum(b * np.kron(m.T, m.T) for b, m in zip(shares, q, strict=True))
    omega = np.eye(6) - 1 / 6
    project = np.kron(omega, omega)
    expected = np.abs(np.linalg.eigvals(project @ dense @ project)).max()
    assert mean_square_rates(weights, shares).exact == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    "network",
    [
        ring(7),
        torus([3, 4]),
        complete(6),
        PETERSEN,
        Network.from_adjacency(np.kron([[0, 1], [1, 0]], np.ones((5, 5)))),
    ],
)
def test_regular_graphs_have_the_eigenvalues_of_the_closed_form(network: Network) -> None:
    weights = consensus_weights(measured(network))
    eigenvalues = np.linalg.eigvalsh(weights.matrix())
    degree = int(network.in_degree[0]) - 1
    closed = regular_eigenvalues(eigenvalues, degree)
    dense = np.linalg.eigvals(average_matrix(weights))
    for power in range(1, 2 * network.count + 1):
        assert abs((closed**power).sum() - (dense**power).sum()) < 1e-11
    second = np.sort(eigenvalues)[-2]
    assert regular_rate(network.count, degree, second) == pytest.approx(essential_radius(average_matrix(weights)))


def test_the_closed_form_solves_the_printed_quadratic() -> None:
    count, degree = 10, 3
    eigenvalues = np.linalg.eigvalsh(consensus_weights(measured(PETERSEN)).matrix())
    roots = regular_eigenvalues(eigenvalues, degree).reshape(2, count)
    a = -((count - degree) / count + eigenvalues / count + (degree - 1) / (count * (degree + 1)))
    b = -(count - 1) / count
    c = -((degree - 1) / count**2) * (eigenvalues - 1 / (degree + 1))
    np.testing.assert_allclose(roots.sum(axis=0), -(a + b), atol=1e-14)
    np.testing.assert_allclose(roots.prod(axis=0), a * b + c, atol=1e-14)


def test_published_constants_of_large_regular_graphs() -> None:
    alphas = [1000 * (1 - regular_rate(1000, nu, ramanujan_second(nu))) for nu in (3, 4, 6, 10, 30)]
    np.testing.assert_allclose(alphas, [0.05165, 0.12683, 0.24922, 0.39751, 0.64073], atol=5e-6)
    ratios = [n * n * (1 - regular_rate(n * n, 4, torus_second((n, n)))) / (1 - torus_second((n, n))) for n in (10, 50)]
    np.testing.assert_allclose(ratios, [1.1813, 1.17666], atol=5e-5)


def test_bipartite_graph_needs_the_algebraically_second_eigenvalue() -> None:
    assert regular_rate(10, 5, 1 / 6) == pytest.approx(0.9, abs=1e-12)  # K_5,5, erratum A5


def unequal(seed: int = 5) -> RelativeVectors:
    """Unequal variances and some pairs measured one way only."""
    rng = np.random.default_rng(seed)
    network, _ = random_geometric(12, 0.4, rng)
    full = measured(network, seed, rng.uniform(0.5, 2.0, len(network.edges)))
    keep = (full.tail < full.head) | (rng.random(len(full.tail)) < 0.5)
    return RelativeVectors(12, full.tail[keep], full.head[keep], full.z[keep], full.variance[keep])


def test_one_step_matrices_are_stochastic_and_keep_the_optimum() -> None:
    vectors = unequal()
    weights, best = consensus_weights(vectors), optimum(vectors)
    matrix = weights.matrix()
    incidence = np.zeros((len(vectors.tail), 12))
    incidence[np.arange(len(vectors.tail)), vectors.tail] = 1
    incidence[np.arange(len(vectors.tail)), vectors.head] = -1
    information = incidence.T @ (incidence / vectors.variance[:, None])
    step = vectors.variance.min() / (2 * (vectors.slots.width + 1))
    np.testing.assert_allclose(matrix, np.eye(12) - step * information, atol=1e-15)
    offset = step * incidence.T @ (vectors.z / vectors.variance[:, None])
    for s in range(12):
        q = transmission_matrix(weights, s).toarray()
        assert (q >= 0).all()
        np.testing.assert_allclose(q.sum(axis=1), 1, atol=1e-15)
        hearers = np.setdiff1d(vectors.network.out_neighborhood(s), s)
        pushed = np.zeros((24, 1))
        pushed[hearers] = offset[hearers]
        both = np.vstack([best, best])
        np.testing.assert_allclose(q @ both + pushed, both, atol=1e-14)


def test_a_cl_is_the_matrix_recursion() -> None:
    vectors = unequal(8)
    rng = np.random.default_rng(1)
    weights, start = consensus_weights(vectors), rng.random((12, 1))
    arrays = AsynchronousArrays(vectors, start)
    step = vectors.variance.min() / (2 * (vectors.slots.width + 1))
    offset = step * vectors.pull[:-1].sum(axis=1)
    state = np.vstack([start, start])
    for s in rng.integers(0, 12, 300):
        hearers = np.setdiff1d(vectors.network.out_neighborhood(int(s)), s)
        state = transmission_matrix(weights, int(s)) @ state
        state[hearers] += offset[hearers]
        arrays.step(np.array([s]))
        np.testing.assert_allclose(arrays.x[:-1], state[:12], atol=1e-14)


@pytest.mark.parametrize("factor", [1.0, 2.2, -1.0, 0.0])
def test_steps_outside_the_condition_are_refused(factor: float) -> None:
    vectors = measured(complete(10))
    with pytest.raises(SettingError, match="R_min"):
        consensus_weights(vectors, factor * step_limit(vectors))
    consensus_weights(vectors, 0.99 * step_limit(vectors))


def test_a_forced_step_warns_of_its_rate() -> None:
    vectors = measured(complete(10))
    with pytest.warns(ModelWarning, match="rho_ess\\(P\\) = 1.444"):
        weights = consensus_weights(vectors, 2.2 * step_limit(vectors), force=True)
    assert essential_radius(weights.matrix()) == pytest.approx(1.4444, abs=1e-4)


def test_shares_that_are_no_probabilities_are_refused() -> None:
    weights = consensus_weights(measured(complete(3)))
    for shares in ([0.5, 0.5, 0.0], [0.5, 0.5, 0.5]):
        with pytest.raises(SettingError, match="sum to 1"):
            mean_square_rates(weights, np.array(shares))
