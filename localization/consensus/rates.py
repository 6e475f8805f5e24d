"""Step sizes, one-step matrices and convergence rates of consensus on relative vectors.

Source: spec ``gps-range-bearing-localization`` 3.1 to 3.3, with errata A1 to A7.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigs

from localization.consensus.relative import RelativeVectors
from problems.errors import ModelWarning, SettingError
from problems.networks import Weights


def step_limit(vectors: RelativeVectors) -> float:
    """Bound ``R_min / (2 d_max)`` below which P is nonnegative with a positive diagonal."""
    return float(vectors.variance.min()) / (2 * vectors.slots.width)


def default_step(vectors: RelativeVectors) -> float:
    """``R_min / (2 (d_max + 1))``, the step used where none is given."""
    return float(vectors.variance.min()) / (2 * (vectors.slots.width + 1))


def consensus_weights(vectors: RelativeVectors, step: float | None = None, *, force: bool = False) -> Weights:
    """Matrix ``P = I - step A' R^-1 A`` as weights on the links.

    Args:
        vectors: the network; need not be connected.
        step: unit of the variance; by default `default_step`.
        force: use a step outside the condition, with a `ModelWarning` that gives the rate.

    Raises:
        SettingError: the step is not positive; or not below `step_limit`, without `force`.
    """
    limit = step_limit(vectors)
    step = default_step(vectors) if step is None else step
    network = vectors.network
    values = np.zeros(len(network.senders))
    apart = network.senders != network.receivers
    values[apart] = step * vectors.information[vectors.slots.neighbor < vectors.count]
    values[~apart] = 1 - np.bincount(network.receivers, values, network.count)
    weights = Weights(network, values)
    if 0 < step < limit:
        return weights
    rate = f"; with this step rho_ess(P) = {essential_radius(weights.matrix()):.4g}" if step > 0 else ""
    told = f"step {step:g} lies outside (0, {limit:g}), the bound R_min / (2 d_max) of this network{rate}"
    if not (force and step > 0):
        raise SettingError(f"{told}; take a smaller one, or leave it out")
    warnings.warn(told, ModelWarning, stacklevel=2)
    return weights


def essential_radius(matrix: np.ndarray) -> float:
    """Second largest modulus among the eigenvalues of a matrix with rows that sum to 1."""
    values = np.linalg.eigvals(matrix)
    return float(np.abs(np.delete(values, np.argmin(np.abs(values - 1)))).max(initial=0.0))


def transmission_matrix(weights: Weights, sender: int) -> sparse.csr_array:
    """Q_s (2n, 2n) of a-CL: what `sender` transmitting does to (estimates; last broadcasts) (2.4)-(2.6)."""
    network, count = weights.network, weights.network.count
    hearers = network.out_neighborhood(sender)
    hearers = hearers[hearers != sender]
    matrix = sparse.lil_array(sparse.eye_array(2 * count))
    for j in hearers:
        for h, p in zip(network.in_neighborhood(int(j)), weights.row(int(j)), strict=True):
            matrix[j, h if h in (j, sender) else count + h] = p
    matrix[count + sender, count + sender] = 0
    matrix[count + sender, sender] = 1
    return sparse.csr_array(matrix)


def transmission_matrices(weights: Weights) -> list[sparse.csr_array]:
    """Q_s of every node."""
    return [transmission_matrix(weights, s) for s in range(weights.network.count)]


@dataclass(frozen=True)
class Rates:
    """Mean-square rates of a-CL on a network, per transmission.

    Attributes:
        exact: R, factor by which the expected squared error falls.
        lower, upper: the bounds (2.9); the upper one may exceed 1.
        average: rho_ess of the average matrix. R is often below it, but not always (erratum A7).
    """

    exact: float
    lower: float
    upper: float
    average: float


def mean_square_rates(weights: Weights, shares: np.ndarray | None = None) -> Rates:
    """Exact mean-square rate of a-CL and its bounds (spec 3.3).

    Args:
        weights: of `consensus_weights`; the network is connected.
        shares: (n,) probability that a node transmits; equal by default.

    Raises:
        SettingError: shares that are not positive or do not sum to 1.
    """
    count = weights.network.count
    beta = np.full(count, 1 / count) if shares is None else np.asarray(shares, dtype=float)
    if beta.shape != (count,) or not (beta > 0).all() or abs(beta.sum() - 1) > 1e-9:
        raise SettingError(f"shares are {count} positive numbers that sum to 1, got a sum of {beta.sum():g}")
    matrices, size = transmission_matrices(weights), 2 * count
    mean = np.asarray(sum(b * q.toarray() for b, q in zip(beta, matrices, strict=True)))
    center = np.eye(size) - 1 / size

    def apply(flat: np.ndarray) -> np.ndarray:
        given = _centered(flat.reshape(size, size))
        total = np.zeros((size, size))
        for b, q in zip(beta, matrices, strict=True):
            total += b * (q.T @ (q.T @ given).T)
        return _centered(total).ravel()

    # The map keeps the cone of positive semidefinite matrices, so its spectral radius is an eigenvalue.
    operator = LinearOperator((size * size, size * size), matvec=apply, dtype=float)  # pyright: ignore[reportCallIssue]
    found = eigs(operator, k=1, which="LM", v0=center.ravel(), return_eigenvectors=False)
    spread = sum(b * (q.T @ center @ q.toarray()) for b, q in zip(beta, matrices, strict=True))
    average = essential_radius(mean)
    return Rates(float(np.abs(found[0])), average**2, float(np.linalg.eigvalsh(np.asarray(spread)).max()), average)


def average_matrix(weights: Weights) -> np.ndarray:
    """(2n, 2n) mean of Q_s over equally likely transmitters."""
    return np.asarray(sum(q.toarray() for q in transmission_matrices(weights))) / weights.network.count


def _centered(matrix: np.ndarray) -> np.ndarray:
    """Projection on symmetric matrices with M 1 = 0; without it rounding brings the eigenvalue 1 back."""
    symmetric = (matrix + matrix.T) / 2
    rows = symmetric.mean(axis=0)
    return symmetric - rows - rows[:, None] + rows.mean()


def regular_eigenvalues(eigenvalues: np.ndarray, degree: int) -> np.ndarray:
    """The 2n eigenvalues of the average a-CL matrix on a regular graph, from those of ``P = (I + Adj)/(degree + 1)``.

    Closed form of (2.10) under Assumption 2.11: equal variances R, step ``R/(2 (degree + 1))``, equal shares.
    """
    count, gap = len(eigenvalues), 1 - np.asarray(eigenvalues, dtype=float)
    u = (degree**2 + 1) / (degree + 1)
    root = np.sqrt((u + gap) ** 2 - 4 * degree * gap + 0j)
    return 1 - np.concatenate([u + gap - root, u + gap + root]) / (2 * count)


def regular_rate(count: int, degree: int, second: float) -> float:
    """rho_ess of the average a-CL matrix on a regular graph from `second`, the second largest eigenvalue of P.

    Source: (2.10) with erratum A5: algebraically largest, not largest in modulus.
    """
    u, gap = (degree**2 + 1) / (degree + 1), 1 - second
    root = np.sqrt((u + gap) ** 2 - 4 * degree * gap + 0j)
    roots = np.array([u + gap - root, u + gap + root, 2 * u])  # the last one belongs to the constant vector
    return float(np.abs(1 - roots / (2 * count)).max())


def torus_second(sides: tuple[int, int]) -> float:
    """Second largest eigenvalue of ``P = (I + Adj)/5`` on a torus with these sides, each at least 3."""
    return float((1 + 2 + 2 * np.cos(2 * np.pi / max(sides))) / 5)


def ramanujan_second(degree: int) -> float:
    """Largest second eigenvalue of ``P = (I + Adj)/(degree + 1)`` on a Ramanujan graph (errata A1, A6)."""
    return (1 + 2 * np.sqrt(degree - 1)) / (degree + 1)
