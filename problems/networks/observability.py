"""What the nodes of a network can observe of one linear system, alone, with their neighbours and all together.

Everything works on arrays with a leading node axis; neighbourhoods of any size are first compressed to n rows each by
an orthogonal transformation, which changes no singular value of an observability matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import ShapeError, UnobservableError
from problems.networks.network import Network

RANK_TOLERANCE = 1e-9
# Eigenvalues of repeated (defective) roots carry errors of the order of the square root of the machine precision.
EIGENVALUE_TOLERANCE = 1e-6

NodeClass = Literal["green", "yellow", "orange", "red"]


def observability_matrix(A: ArrayLike, C: ArrayLike, blocks: int) -> np.ndarray:
    """Observability matrix ``[C; C A; ...; C A^(blocks-1)]``.

    Source: dmhe-pre-estimation (2.24), (2.35).

    Args:
        A: (..., n, n) state matrix.
        C: (..., p, n) output matrix; leading axes broadcast against those of A.
        blocks: number of block rows, at least 1.

    Returns:
        (..., p * blocks, n).

    Raises:
        ShapeError: shapes do not fit or there are no blocks.
    """
    state, output = system_matrices(A, C)
    if blocks < 1:
        raise ShapeError(f"an observability matrix needs at least one block row, got blocks={blocks}")
    rows = [output]
    for _ in range(blocks - 1):
        rows.append(rows[-1] @ state)
    return np.concatenate(np.broadcast_arrays(*rows), axis=-2)


def observability_rank(A: ArrayLike, C: ArrayLike, blocks: int, *, tolerance: float = RANK_TOLERANCE) -> np.ndarray:
    """Rank of the observability matrix, singular values counted above ``tolerance`` times the largest.

    Returns:
        (...) integers.
    """
    return _rank(np.linalg.svd(observability_matrix(A, C, blocks), compute_uv=False), tolerance)


def observable_split(A: ArrayLike, C: ArrayLike, *, tolerance: float = RANK_TOLERANCE) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal basis that separates the observable directions from the kernel of the observability matrix.

    Args:
        A: (..., n, n).
        C: (..., p, n).
        tolerance: relative to the largest singular value.

    Returns:
        basis (..., n, n), whose first `rank` columns span the observable directions and whose others span the kernel
        (an A-invariant subspace), and rank (...).
    """
    matrix = observability_matrix(A, C, np.shape(A)[-1])
    short = matrix.shape[-1] - matrix.shape[-2]
    if short > 0:
        matrix = np.concatenate([matrix, np.zeros(matrix.shape[:-2] + (short, matrix.shape[-1]))], axis=-2)
    _, singular, rows = np.linalg.svd(matrix, full_matrices=False)
    return np.swapaxes(rows, -1, -2), _rank(singular, tolerance)


def unobservable_eigenvalues(A: ArrayLike, C: ArrayLike, *, tolerance: float = RANK_TOLERANCE) -> np.ndarray:
    """Eigenvalues of A on the kernel of the observability matrix: no gain moves them.

    Returns:
        (..., n) complex, filled with NaN after the last one.
    """
    state, output = system_matrices(A, C)
    basis, rank = observable_split(state, output, tolerance=tolerance)
    restricted = np.swapaxes(basis, -1, -2) @ state @ basis
    n = state.shape[-1]
    result = np.full(rank.shape + (n,), np.nan, dtype=complex)
    for observed in np.unique(rank):
        if observed < n:
            chosen = rank == observed
            result[chosen, : n - observed] = np.linalg.eigvals(restricted[chosen][..., observed:, observed:])
    return result


def regional_outputs(network: Network, outputs: Sequence[ArrayLike]) -> np.ndarray:
    """Output matrices stacked over every in-neighbourhood, compressed to n rows by an orthogonal transformation.

    Source: dmhe-pre-estimation (2.5); ``result[i]' result[i]`` equals the sum of C^j' C^j over the in-neighbourhood.

    Args:
        network: the graph.
        outputs: output matrix C^j (p_j, n) of every node; p_j may differ and be 0.

    Returns:
        (count, n, n).

    Raises:
        ShapeError: not one matrix per node, or different numbers of columns.
    """
    own = stacked_outputs(network, outputs)
    count, rows, n = own.shape
    result = np.zeros((count, n, n))
    for size in np.unique(network.in_degree):
        nodes = np.flatnonzero(network.in_degree == size)
        heard = network.senders[network.offsets[nodes][:, None] + np.arange(size)]
        stack = own[heard].reshape(len(nodes), size * rows, n)
        result[nodes, : min(size * rows, n)] = stack if size * rows <= n else np.linalg.qr(stack, mode="r")
    return result


def stacked_outputs(network: Network, outputs: Sequence[ArrayLike]) -> np.ndarray:
    """Output matrices of all nodes as one array (count, p_max, n), shorter ones filled up with zero rows.

    Raises:
        ShapeError: not one matrix per node, or different numbers of columns.
    """
    matrices = [np.asarray(matrix, dtype=float) for matrix in outputs]
    if len(matrices) != network.count or any(m.ndim != 2 or m.shape[1] != matrices[0].shape[1] for m in matrices):
        shapes = sorted({m.shape for m in matrices})
        raise ShapeError(f"expected {network.count} output matrices (p_i, n) of equal n, got {len(matrices)}: {shapes}")
    result = np.zeros((len(matrices), max(1, *(len(m) for m in matrices)), matrices[0].shape[1]))
    for node, matrix in enumerate(matrices):
        result[node, : len(matrix)] = matrix
    return result


def regional_ranks(
    network: Network, A: ArrayLike, outputs: Sequence[ArrayLike], blocks: int, *, tolerance: float = RANK_TOLERANCE
) -> np.ndarray:
    """Rank rho_O^i of the regional observability matrix with `blocks` block rows, for every node.

    Source: dmhe-pre-estimation (2.35) and 3.6.

    Returns:
        (count,) integers 0..n.
    """
    return observability_rank(A, regional_outputs(network, outputs), blocks, tolerance=tolerance)


@dataclass(frozen=True)
class ObservabilityReport:
    """What each node observes (dmhe-pre-estimation section 5 item 3).

    Attributes:
        collective_rank: rank of the observability matrix of all outputs together.
        local_rank: (count,) of the node's own output.
        regional_rank: (count,) of the outputs of the in-neighbourhood.
        local_detectable: (count,) bool, every unobservable eigenvalue lies inside the unit circle.
        regional_detectable: (count,) bool.
        unobservable: regionally unobservable eigenvalues of every node.
        classes: "green" regionally observable, "yellow" detectable, "orange" some output but not detectable,
            "red" nothing observed.
        index: (count,) smallest number of block rows that reaches the regional rank (observability index).
    """

    collective_rank: int
    local_rank: np.ndarray
    regional_rank: np.ndarray
    local_detectable: np.ndarray
    regional_detectable: np.ndarray
    unobservable: tuple[np.ndarray, ...]
    classes: tuple[NodeClass, ...]
    index: np.ndarray


def observability_report(network: Network, A: ArrayLike, outputs: Sequence[ArrayLike]) -> ObservabilityReport:
    """Observability of one linear system from every node, its neighbourhood and the whole network.

    Raises:
        ShapeError: shapes do not fit.
        UnobservableError: all outputs together do not observe the system.
    """
    own, regional = stacked_outputs(network, outputs), regional_outputs(network, outputs)
    state, regional = system_matrices(A, regional)
    n = state.shape[-1]
    collective = int(observability_rank(state, own.reshape(-1, n), n))
    if collective < n:
        hidden = unobservable_eigenvalues(state, own.reshape(-1, n))
        raise UnobservableError(
            f"the {network.count} sensors together observe {collective} of {n} states; unobservable eigenvalues: "
            f"{np.round(hidden[: n - collective], 6).tolist()}; add a sensor that sees them"
        )
    hidden = unobservable_eigenvalues(state, regional)
    ranks = [observability_rank(state, regional, blocks) for blocks in range(1, n + 1)]
    regional_rank = ranks[-1]
    detectable = _inside(hidden)
    classes: list[NodeClass] = [
        "green" if rank == n else "red" if rank == 0 else "yellow" if stable else "orange"
        for rank, stable in zip(regional_rank.tolist(), detectable.tolist(), strict=True)
    ]
    return ObservabilityReport(
        collective_rank=collective,
        local_rank=observability_rank(state, own, n),
        regional_rank=regional_rank,
        local_detectable=_inside(unobservable_eigenvalues(state, own)),
        regional_detectable=detectable,
        unobservable=tuple(row[: n - rank] for row, rank in zip(hidden, regional_rank.tolist(), strict=True)),
        classes=tuple(classes),
        index=np.argmax(np.array(ranks) == regional_rank, axis=0) + 1,
    )


def system_matrices(A: ArrayLike, C: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """State and output matrix as float arrays.

    Raises:
        ShapeError: A is not square or C has not n columns.
    """
    state, output = np.asarray(A, dtype=float), np.asarray(C, dtype=float)
    if state.ndim < 2 or state.shape[-1] != state.shape[-2]:
        raise ShapeError(f"a state matrix is square, got shape {state.shape}")
    if output.ndim < 2 or output.shape[-1] != state.shape[-1]:
        raise ShapeError(f"an output matrix has shape (p, {state.shape[-1]}), got {output.shape}")
    return state, output


def _inside(eigenvalues: np.ndarray) -> np.ndarray:
    # The NaN that fill up the rows compare as false.
    return np.asarray(~(np.abs(eigenvalues) >= 1 - EIGENVALUE_TOLERANCE).any(axis=-1))


def _rank(singular: np.ndarray, tolerance: float) -> np.ndarray:
    return np.count_nonzero(singular > tolerance * singular.max(axis=-1, keepdims=True, initial=0.0), axis=-1)
