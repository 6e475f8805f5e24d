"""Consensus weights and the fusion of neighbours' covariances: a number per link."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import ModelWarning, ShapeError, TopologyError, UnknownNameError
from problems.networks.network import Network

if TYPE_CHECKING:
    from scipy.sparse import csr_array

ROW_SUM_TOLERANCE = 1e-9

FusionRule = Literal["out_degree", "convex", "in_degree"]


@dataclass(frozen=True, eq=False)
class Weights:
    """One number per link of a network, self-loops included: consensus weights k_ij or fusion coefficients.

    Attributes:
        network: the graph.
        values: (E + count,) numbers aligned with ``network.senders``: row by row, row i = receiver i.
    """

    network: Network
    values: np.ndarray

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=float)
        if values.shape != self.network.senders.shape:
            raise ShapeError(
                f"expected one weight per link and self-loop, shape {self.network.senders.shape}, got {values.shape}"
            )
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    def row(self, node: int) -> np.ndarray:
        """Weights of one receiver, aligned with ``network.in_neighborhood(node)``."""
        return self.values[self.network.offsets[node] : self.network.offsets[node + 1]]

    def matrix(self) -> np.ndarray:
        """(count, count) dense matrix K, row i of receiver i."""
        dense = np.zeros((self.network.count, self.network.count))
        dense[self.network.receivers, self.network.senders] = self.values
        return dense

    @cached_property
    def sparse(self) -> csr_array:
        """(count, count) sparse matrix K, row i of receiver i."""
        from scipy.sparse import csr_array

        shape = (self.network.count, self.network.count)
        return csr_array((self.values, self.network.senders, self.network.offsets), shape=shape)

    def combine(self, items: ArrayLike) -> np.ndarray:
        """Weighted sums over the in-neighbourhoods, ``sum_j k_ij items[j]`` for every node i.

        Source: dmhe-pre-estimation (2.22) for estimates, (2.23) and (4.11) for covariances.

        Args:
            items: (count, ...) one array per node.

        Returns:
            Array of the same shape.
        """
        array = np.asarray(items, dtype=float)
        if array.shape[:1] != (self.network.count,):
            raise ShapeError(f"expected one item per node, first axis {self.network.count}, got shape {array.shape}")
        return np.asarray(self.sparse @ array.reshape(self.network.count, -1)).reshape(array.shape)


def given_weights(network: Network, matrix: ArrayLike) -> Weights:
    """Consensus weights from a matrix, checked against the graph.

    Source: dmhe-pre-estimation (2.4), section 5 item 2.

    Args:
        network: the graph.
        matrix: (count, count), k_ij in row i of receiver i, nonnegative, rows summing to 1 within 1e-9, zero off the
            graph, positive on the diagonal.

    Raises:
        ShapeError: wrong shape.
        TopologyError: a negative entry, a row sum that is not 1, a weight on a link the graph lacks, no self-weight.

    Warns:
        ModelWarning: a link of the graph has weight zero.
    """
    dense = np.asarray(matrix, dtype=float)
    if dense.shape != (network.count, network.count):
        raise ShapeError(f"weights of {network.count} nodes have shape {(network.count,) * 2}, got {dense.shape}")
    bad = np.argwhere(~(dense >= 0))
    if len(bad):
        i, j = bad[0]
        raise TopologyError(
            f"weight of node {network.names([j])} at node {network.names([i])} is {dense[i, j]:g}; "
            "consensus weights are nonnegative numbers"
        )
    wrong = np.flatnonzero(np.abs(dense.sum(axis=1) - 1) > ROW_SUM_TOLERANCE)
    if wrong.size:
        raise TopologyError(
            f"weights at node {network.names(wrong[:1])} sum to {dense[wrong[0]].sum():.12g}, each row must sum to 1 "
            f"within {ROW_SUM_TOLERANCE:g}; rows that do not: {network.names(wrong)}"
        )
    on_graph = np.zeros(dense.shape, dtype=bool)
    on_graph[network.receivers, network.senders] = True
    outside = np.argwhere((dense > 0) & ~on_graph)
    if len(outside):
        i, j = outside[0]
        raise TopologyError(
            f"node {network.names([i])} weighs node {network.names([j])} with {dense[i, j]:g} but does not hear it; "
            "add the link to the graph or set the weight to zero"
        )
    mute = np.flatnonzero(np.diag(dense) <= 0)
    if mute.size:
        raise TopologyError(f"nodes {network.names(mute)} give themselves no weight; every node needs a self-loop")
    values = dense[network.receivers, network.senders]
    _warn_unused(network, values, "in the matrix given")
    return Weights(network, values)


def uniform_weights(network: Network) -> Weights:
    """Equal weights 1 / n_S^i over every in-neighbourhood (dmhe-pre-estimation 4.4)."""
    return Weights(network, np.repeat(1.0 / network.in_degree, network.in_degree))


def metropolis_weights(network: Network) -> Weights:
    """Metropolis weights 1 / (1 + max(deg_i, deg_j)), deg without the self-loop, the rest on the node itself.

    Source: dmhe-pre-estimation (2.33) with erratum E6.

    Raises:
        TopologyError: the graph is directed.
    """
    network.require_undirected("Metropolis weights")
    degree = network.in_degree
    values = 1.0 / np.maximum(degree[network.receivers], degree[network.senders])
    own = network.receivers == network.senders
    values[own] = 0.0
    values[own] = 1.0 - np.add.reduceat(values, network.offsets[:-1])
    return Weights(network, values)


def rank_weights(network: Network, ranks: ArrayLike) -> Weights:
    """Weights in proportion to the regional observability ranks of the neighbours.

    Source: dmhe-pre-estimation (2.36) and 3.6; dmhe-sporadic-fov (4.13) with ranks floored at 0.5.

    Args:
        network: the graph.
        ranks: (count,) rank rho_O^j of every node, see `observability.regional_ranks`.

    Warns:
        ModelWarning: a neighbour of rank 0 gets weight 0 (its link carries measurements but no consensus), or a whole
            neighbourhood has rank 0 and uniform weights are used there.

    Raises:
        ShapeError: not one rank per node.
        TopologyError: a negative rank.
    """
    scores = np.asarray(ranks, dtype=float)
    if scores.shape != (network.count,):
        raise ShapeError(f"expected one rank per node, shape {(network.count,)}, got {scores.shape}")
    if not (scores >= 0).all():
        raise TopologyError(f"ranks are nonnegative; not so at nodes {network.names(np.flatnonzero(~(scores >= 0)))}")
    values = normalize_rows(scores[network.senders], network.offsets)
    blind = np.flatnonzero(np.add.reduceat(scores[network.senders], network.offsets[:-1]) == 0)
    if blind.size:
        warnings.warn(
            f"no node that nodes {network.names(blind)} hear observes anything; uniform weights are used there",
            ModelWarning,
            stacklevel=2,
        )
    _warn_unused(network, values, "because they observe nothing")
    return Weights(network, values)


def normalize_rows(scores: ArrayLike, offsets: ArrayLike) -> np.ndarray:
    """Scores divided by their sum over each in-neighbourhood; uniform where all of a neighbourhood are zero.

    One row (a node that knows only its own neighbourhood) and many networks at once (leading axes) use the same rule.

    Args:
        scores: (..., E) nonnegative scores, aligned with the links.
        offsets: (rows + 1,) where each row starts, as in ``Network.offsets``; ``[0, E]`` for one row.

    Returns:
        (..., E) weights, each row summing to 1.
    """
    values, starts = np.asarray(scores, dtype=float), np.asarray(offsets)
    sizes = np.diff(starts)
    sums = np.repeat(np.add.reduceat(values, starts[:-1], axis=-1), sizes, axis=-1)
    return np.where(sums > 0, values / np.where(sums > 0, sums, 1.0), 1.0 / np.repeat(sizes, sizes))


def mixed_weights(first: Weights, second: Weights, share: float) -> Weights:
    """``share * first + (1 - share) * second`` (dmhe-pre-estimation (2.38)).

    Raises:
        TopologyError: the weights belong to different graphs, or the share is not in [0, 1].
    """
    if first.network is not second.network and first.network != second.network:
        raise TopologyError("weights of two different graphs cannot be mixed")
    if not 0 <= share <= 1:
        raise TopologyError(f"a share lies in [0, 1], got {share}")
    return Weights(first.network, share * first.values + (1 - share) * second.values)


def fusion_coefficients(weights: Weights, rule: FusionRule = "out_degree") -> Weights:
    """Coefficients c_ij of the fused arrival covariance ``Pi_bar^i = sum_j c_ij Pi^j``; apply with `Weights.combine`.

    Args:
        weights: consensus weights k_ij.
        rule: ``"out_degree"``: d_j k_ij^2, (2.23) with d_j = nodes that hear j (dmhe-pre-estimation 3.3, E1); links of
            weight 0 count as absent;
            ``"convex"``: k_ij, (4.11) of dmhe-sporadic-fov 3.8;
            ``"in_degree"``: n_S^j k_ij^2, (2.23) as printed; breaks the consensus inequality on unbalanced graphs.

    Raises:
        UnknownNameError: an unknown rule.
    """
    network, values = weights.network, weights.values
    if rule == "convex":
        return weights
    if rule == "out_degree":
        listeners = np.bincount(network.senders[values > 0], minlength=network.count)
        return Weights(network, listeners[network.senders] * values**2)
    if rule == "in_degree":
        return Weights(network, network.in_degree[network.senders] * values**2)
    raise UnknownNameError("fusion rule", rule, get_args(FusionRule))


def _warn_unused(network: Network, values: np.ndarray, why: str) -> None:
    unused = np.flatnonzero(values == 0)
    if unused.size:
        senders = np.unique(network.senders[unused])
        warnings.warn(
            f"{unused.size} links from nodes {network.names(senders)} have weight zero {why}; "
            "consensus treats them as absent, measurements still travel over them",
            ModelWarning,
            stacklevel=3,
        )
