"""Consensus on relative vectors as array operations: many nodes that do not disturb one another act at once.

Every class holds coordinates ``x`` (count + 1, l), of which the last row belongs to an idle node that unused places of
the tables point at, and makes one iteration of several networks in a call of ``step(nodes, heard)``: `nodes` (w,) act,
one of each network of a `union`, and `heard` (w, width) says which neighbours receive what they send, all of them
by default. Source: spec ``gps-range-bearing-localization`` section 4, A1 to A3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from localization.consensus.rates import consensus_weights, default_step
from localization.consensus.relative import RelativeVectors


def _extended(start: np.ndarray) -> np.ndarray:
    return np.vstack([start, np.zeros((1, start.shape[1]))])


class _Base:
    def __init__(self, vectors: RelativeVectors, start: np.ndarray) -> None:
        self.x = _extended(np.asarray(start, dtype=float))
        self._slots = vectors.slots
        self._idle = vectors.count

    def _receivers(self, nodes: np.ndarray, heard: np.ndarray | None) -> np.ndarray:
        receivers = self._slots.neighbor[nodes]
        return receivers if heard is None else np.where(heard, receivers, self._idle)


class SynchronousArrays(_Base):
    """s-CL (A1): all nodes broadcast and update at once."""

    def __init__(self, vectors: RelativeVectors, start: np.ndarray, step: float | None = None) -> None:
        super().__init__(vectors, start)
        self._weights, self._offset = consensus_weights(vectors, step), _offsets(vectors, step)

    def step(self, nodes: np.ndarray, heard: np.ndarray | None = None) -> None:
        del nodes, heard
        self.x[:-1] = self._weights.combine(self.x[:-1]) + self._offset


class AsynchronousArrays(_Base):
    """a-CL (A2): one node broadcasts, those that hear it update. Memories start at the neighbours' first values."""

    def __init__(self, vectors: RelativeVectors, start: np.ndarray, step: float | None = None) -> None:
        super().__init__(vectors, start)
        network, weights = vectors.network, consensus_weights(vectors, step)
        own = network.receivers == network.senders
        self._self = np.append(weights.values[own], 1.0)[:, None]
        self._others = np.zeros(self._slots.neighbor.shape)
        self._others[self._slots.neighbor < vectors.count] = weights.values[~own]
        self._offset = _extended(_offsets(vectors, step))
        self.memory = self.x[self._slots.neighbor]

    def step(self, nodes: np.ndarray, heard: np.ndarray | None = None) -> None:
        j = self._receivers(nodes, heard)
        self.memory[j, self._slots.back[nodes]] = self.x[nodes][:, None]
        remembered = np.einsum("wdk,wdkl->wdl", self._others[j], self.memory[j])
        self.x[j] = self._self[j] * self.x[j] + remembered + self._offset[j]


class GossipArrays(_Base):
    """Memoryless gossip (A3, erratum A8): neighbours that hear a node move half-way to where it puts them."""

    def __init__(self, vectors: RelativeVectors, start: np.ndarray) -> None:
        vectors.require_both_ways("gossip")
        super().__init__(vectors, start)
        self._difference = _mean_difference(vectors)

    def step(self, nodes: np.ndarray, heard: np.ndarray | None = None) -> None:
        j = self._receivers(nodes, heard)
        self.x[j] = (self.x[j] + self.x[nodes][:, None] + self._difference[j, self._slots.back[nodes]]) / 2
        self.x[-1] = 0


class BroadcastArrays(_Base):
    """BC (A3): a node polls its neighbours and moves to its own optimum, asynchronous Jacobi."""

    def __init__(self, vectors: RelativeVectors, start: np.ndarray) -> None:
        vectors.require_both_ways("bc")
        super().__init__(vectors, start)
        self._difference = _mean_difference(vectors)
        self._divisor = np.maximum(self._slots.degree, 1)[:, None]
        self._present = (self._slots.neighbor < self._idle)[:, :, None]

    def step(self, nodes: np.ndarray, heard: np.ndarray | None = None) -> None:
        del heard
        placed = (self.x[self._slots.neighbor[nodes]] + self._difference[nodes]) * self._present[nodes]
        self.x[nodes] = placed.sum(axis=1) / self._divisor[nodes]


class KaczmarzArrays(_Base):
    """REK (A3, erratum A9): a column step at `nodes`, then a row step at one drawn measurement of each network."""

    def __init__(self, vectors: RelativeVectors, start: np.ndarray) -> None:
        vectors.require_both_ways("rek")
        super().__init__(vectors, start)
        self.z = np.zeros((*self._slots.neighbor.shape, vectors.z.shape[1]))
        self.z[vectors.tail, vectors.places[0]] = vectors.z
        self.s = self.z.copy()
        self._present = (self._slots.neighbor < self._idle)[:, :, None]
        self._norm = 2.0 * np.maximum(self._slots.degree, 1)[:, None]

    def column(self, nodes: np.ndarray) -> None:
        """Column step of `nodes` (w,): takes their share of the flow out of s."""
        j, back = self._slots.neighbor[nodes], self._slots.back[nodes]
        net = (self.s[nodes] - self.s[j, back]) * self._present[nodes]
        t = (net.sum(axis=1) / self._norm[nodes])[:, None] * self._present[nodes]
        self.s[nodes] -= t
        self.s[j, back] += t

    def row(self, tails: np.ndarray, slots: np.ndarray) -> None:
        """Row step of the measurements that `tails` (w,) hold of the neighbours in `slots` (w,)."""
        heads = self._slots.neighbor[tails, slots]
        rho = (self.z[tails, slots] - self.s[tails, slots] - self.x[tails] + self.x[heads]) / 2
        self.x[tails] += rho
        self.x[heads] -= rho


def _offsets(vectors: RelativeVectors, step: float | None) -> np.ndarray:
    """``b = step A' R^-1 z`` (count, l)."""
    return (default_step(vectors) if step is None else step) * vectors.pull[:-1].sum(axis=1)


def _mean_difference(vectors: RelativeVectors) -> np.ndarray:
    """(count + 1, width, l) where the mean of both measurements of a pair puts a node from its neighbour."""
    information = vectors.information[:, :, None]
    return vectors.pull / np.where(information > 0, information, 1.0)


ARRAYS: Mapping[
    str, type[SynchronousArrays] | type[AsynchronousArrays] | type[GossipArrays] | type[BroadcastArrays]
] = {
    "s_cl": SynchronousArrays,
    "a_cl": AsynchronousArrays,
    "gossip": GossipArrays,
    "bc": BroadcastArrays,
}
