"""Whether a network can agree: reach of consensus, growth of fused covariances, convergence rate.

All three are spectral radii of sparse block matrices, found one strongly connected component at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import ShapeError
from problems.networks.observability import (
    EIGENVALUE_TOLERANCE,
    observable_split,
    regional_outputs,
    system_matrices,
    unobservable_eigenvalues,
)
from problems.networks.weights import Weights

_DENSE_LIMIT = 600


def consensus_reach(weights: Weights, A: ArrayLike, outputs: Sequence[ArrayLike]) -> float:
    """phi = rho(P (K x A) P), P = projectors on what no neighbourhood observes.

    Errors that no node's data can stop decay iff phi < 1.

    Source: dmhe-pre-estimation section 5 item 6.

    Args:
        weights: consensus weights K.
        A: (n, n) state matrix.
        outputs: output matrix (p_j, n) of every node.

    Returns:
        The spectral radius phi (0 if every neighbourhood observes everything).
    """
    network = weights.network
    state, regional = system_matrices(A, regional_outputs(network, outputs))
    basis, rank = observable_split(state, regional)
    hidden = np.where(np.arange(state.shape[-1]) < rank[:, None, None], 0.0, basis)
    blocks = np.swapaxes(hidden[network.receivers], -1, -2) @ state @ hidden[network.senders]
    return spectral_radius(_block_matrix(weights, blocks))


def covariance_growth(coefficients: Weights, A: ArrayLike, outputs: Sequence[ArrayLike]) -> float:
    """gamma = max over eigenvalues of A of |lambda|^2 rho([c_ij] over the nodes blind to lambda).

    Fused covariances stay bounded iff gamma < 1; near 1 they converge slowly.

    Source: dmhe-pre-estimation section 5 item 7.

    Args:
        coefficients: fusion coefficients c_ij, see `fusion_coefficients`.
        A: (n, n) state matrix.
        outputs: output matrix (p_j, n) of every node.

    Returns:
        gamma (0 if no neighbourhood is blind to anything).
    """
    state, regional = system_matrices(A, regional_outputs(coefficients.network, outputs))
    hidden = unobservable_eigenvalues(state, regional)
    growth = 0.0
    for eigenvalue in np.linalg.eigvals(state):
        tolerance = EIGENVALUE_TOLERANCE * max(1.0, abs(eigenvalue))
        blind = np.flatnonzero((np.abs(hidden - eigenvalue) <= tolerance).any(axis=1))
        if blind.size and eigenvalue.imag >= 0:
            among = coefficients.sparse[blind][:, blind]
            growth = max(growth, abs(eigenvalue) ** 2 * spectral_radius(among))
    return float(growth)


def convergence_rate(weights: Weights, maps: ArrayLike) -> float:
    """Spectral radius of the network's error matrix with blocks k_ij T_j.

    Source: dmhe-pre-estimation section 5 item 8.

    Args:
        weights: consensus weights K.
        maps: (count, n, n), T_j takes the error of node j's prior to the error of what it hands on, noise-free.

    Returns:
        Factor by which unconstrained, noise-free errors shrink per step in the long run.
    """
    blocks = np.asarray(maps, dtype=float)
    count = weights.network.count
    if blocks.ndim != 3 or blocks.shape[0] != count or blocks.shape[1] != blocks.shape[2]:
        raise ShapeError(f"expected one square map per node, shape ({count}, n, n), got {blocks.shape}")
    return spectral_radius(_block_matrix(weights, blocks[weights.network.senders]))


def consensus_margin(weights: Weights, covariances: ArrayLike, fused: ArrayLike) -> float:
    """How far fused arrival weights are from the inequality that convergence rests on.

    The inequality is (K x I)' diag(Pi_bar^i)^-1 (K x I) <= diag(Pi^j)^-1.

    Source: dmhe-pre-estimation 4.4.

    Args:
        weights: consensus weights K.
        covariances: (count, n, n) Pi^j before fusion.
        fused: (count, n, n) Pi_bar^i after fusion.

    Returns:
        1 minus the largest eigenvalue of diag(S_j)' (K x I)' diag(Pi_bar^i)^-1 (K x I) diag(S_j), Pi^j = S_j S_j':
        at least 0 iff the inequality holds.
    """
    before, after = np.asarray(covariances, dtype=float), np.asarray(fused, dtype=float)
    count = weights.network.count
    if before.ndim != 3 or before.shape[0] != count or before.shape != after.shape:
        raise ShapeError(f"expected covariances ({count}, n, n) twice, got {before.shape} and {after.shape}")
    n = before.shape[-1]
    whitened = np.linalg.solve(np.linalg.cholesky(after)[:, None], weights.matrix()[:, :, None, None] * np.eye(n))
    product = (whitened @ np.linalg.cholesky(before)).transpose(0, 2, 1, 3).reshape(count * n, count * n)
    return float(1.0 - np.linalg.norm(product, 2) ** 2)


def spectral_radius(matrix: Any) -> float:
    """Largest modulus of an eigenvalue of a sparse square matrix.

    Source: block triangular by strongly connected components; dense eigenvalues up to 600 unknowns per component,
    Arnoldi iteration beyond.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import eigs

    sparse = csr_array(matrix, copy=True)
    sparse.eliminate_zeros()
    if not sparse.nnz:
        return 0.0
    _, member = connected_components(sparse, directed=True, connection="strong")
    sizes = np.bincount(member)
    alone = sizes[member] == 1
    radius = float(np.abs(sparse.diagonal()[alone]).max(initial=0.0))
    for component in np.flatnonzero(sizes > 1):
        chosen = np.flatnonzero(member == component)
        block = sparse[chosen][:, chosen]
        if len(chosen) <= _DENSE_LIMIT:
            eigenvalues = np.linalg.eigvals(block.toarray())
        else:
            start = 1.0 + 0.5 * np.cos(np.arange(len(chosen)))
            eigenvalues = eigs(block, k=4, ncv=64, v0=start, maxiter=20000, return_eigenvectors=False)
        radius = max(radius, float(np.abs(eigenvalues).max()))
    return radius


def _block_matrix(weights: Weights, blocks: np.ndarray) -> Any:
    """Sparse matrix with blocks ``k_ij * blocks[link]`` at (receiver, sender)."""
    from scipy.sparse import coo_array

    network, n = weights.network, blocks.shape[-1]
    inner = np.arange(n)
    rows = np.broadcast_to(network.receivers[:, None, None] * n + inner[:, None], blocks.shape)
    columns = np.broadcast_to(network.senders[:, None, None] * n + inner, blocks.shape)
    size = network.count * n
    data = weights.values[:, None, None] * blocks
    return coo_array((data.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsr()
