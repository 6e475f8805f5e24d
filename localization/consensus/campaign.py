"""Runs of consensus algorithms over many networks at once, recorded every so many iterations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from localization.consensus.arrays import ARRAYS, KaczmarzArrays
from localization.consensus.relative import RelativeVectors, optimum, union
from problems.errors import SettingError

Method = Literal["s_cl", "a_cl", "gossip", "bc", "rek"]
LOSSY = ("a_cl", "gossip")  # a lost packet only leaves a neighbour as it was; the others count on every answer
_BLOCK = 1024  # iterations whose draws are made at once


@dataclass(frozen=True, eq=False)
class Campaign:
    """What a run recorded.

    Attributes:
        iterations: (k,) at which it did, from 0.
        log_error: (k, networks) ``ln ||A (x - x*)||``.
        packets: (k, networks) sent so far.
        average_log_error: (k, networks) that of the average of x over the iterations so far.
        x: (count of all networks, l) at the end.
    """

    iterations: np.ndarray
    log_error: np.ndarray
    packets: np.ndarray
    average_log_error: np.ndarray
    x: np.ndarray

    def packets_per(self, gain: float) -> np.ndarray:
        """(networks,) packets until the error fell by exp(-gain) for good, NaN where it did not."""
        return self._first(self.packets, gain)

    def iterations_per(self, gain: float) -> np.ndarray:
        """(networks,) iterations, as `packets_per`."""
        return self._first(np.broadcast_to(self.iterations[:, None], self.log_error.shape), gain)

    def _first(self, what: np.ndarray, gain: float) -> np.ndarray:
        above = self.log_error > self.log_error[0] - gain
        last = len(above) - 1 - np.argmax(above[::-1], axis=0)
        found = np.full(above.shape[1], np.nan)
        for k in np.flatnonzero(last < len(above) - 1):
            falls = self.log_error[last[k] : last[k] + 2, k] - (self.log_error[0, k] - gain)
            share = falls[0] / (falls[0] - falls[1])
            found[k] = what[last[k], k] + share * (what[last[k] + 1, k] - what[last[k], k])
        return found


def run_campaign(
    method: Method,
    networks: Sequence[RelativeVectors],
    start: Sequence[np.ndarray],
    iterations: int,
    rng: np.random.Generator,
    *,
    loss: float | Sequence[float] = 0.0,
    every: int = 1000,
    best: Sequence[np.ndarray] | None = None,
) -> Campaign:
    """Run one algorithm on several networks, transmitters equally likely (``rek``: as likely as their measurements).

    An iteration of ``s_cl`` lets every node broadcast, of the others one node act.

    Args:
        method: name of the algorithm.
        networks: each connected.
        start: (count, l) coordinates, one array for each network.
        iterations: of every network.
        rng: draws of transmitters and losses.
        loss: probability that a link loses a packet, one or one for each network; for ``a_cl`` and ``gossip``.
        every: iterations between records.
        best: optima, where they are known already.

    Raises:
        SettingError: losses for a method that cannot stand them, or a probability outside [0, 1).
        TopologyError: a network that is not connected, or one that the method cannot serve.
    """
    losses = np.broadcast_to(np.asarray(loss, dtype=float), (len(networks),))
    if not ((losses >= 0) & (losses < 1)).all():
        raise SettingError(f"loss probabilities lie in [0, 1), got {loss}")
    if losses.any() and method not in LOSSY:
        raise SettingError(f"{method} relies on every packet; losses are for {' and '.join(LOSSY)}")
    for network in networks:
        network.require_connected()
    whole = union(networks)
    target = np.concatenate(best) if best is not None else optimum(whole)
    arrays = (KaczmarzArrays if method == "rek" else ARRAYS[method])(whole, np.concatenate(start))
    counts = np.array([network.count for network in networks])
    edges = np.array([len(network.tail) for network in networks])
    first, first_edge = np.cumsum(counts) - counts, np.cumsum(edges) - edges
    cost = _packets(method, whole)
    total, packets = np.zeros_like(target), np.zeros(len(networks), dtype=np.int64)
    rows = [(0, whole.spread(arrays.x[:-1] - target), packets.copy(), whole.spread(arrays.x[:-1] - target))]
    for begin in range(0, iterations, _BLOCK):
        block = min(_BLOCK, iterations - begin)
        drawn = rng.random((block, len(networks)))
        rows_drawn = rng.random((block, len(networks)))
        nodes = first + (drawn * counts).astype(np.int64)
        if method == "rek":
            nodes = whole.tail[first_edge + (drawn * edges).astype(np.int64)]
        measured = first_edge + (rows_drawn * edges).astype(np.int64)
        heard = None
        if losses.any():
            heard = rng.random((block, len(networks), whole.slots.width)) >= losses[:, None]
        for k in range(block):
            if isinstance(arrays, KaczmarzArrays):
                arrays.column(nodes[k])
                arrays.row(whole.tail[measured[k]], whole.places[0][measured[k]])
            else:
                arrays.step(nodes[k], None if heard is None else heard[k])
            packets += counts if method == "s_cl" else cost[nodes[k]]
            total += arrays.x[:-1]
            done = begin + k + 1
            if done % every == 0 or done == iterations:
                error = whole.spread(arrays.x[:-1] - target)
                rows.append((done, error, packets.copy(), whole.spread(total / done - target)))
    with np.errstate(divide="ignore"):
        return Campaign(
            np.array([row[0] for row in rows]),
            np.log(np.array([row[1] for row in rows])),
            np.array([row[2] for row in rows]),
            np.log(np.array([row[3] for row in rows])),
            arrays.x[:-1].copy(),
        )


def _packets(method: Method, whole: RelativeVectors) -> np.ndarray:
    """(count,) packets of an iteration by the node that acts (Table 2.1)."""
    degree = whole.slots.degree[:-1]
    return {"bc": degree + 1, "rek": degree + 5}.get(method, np.ones_like(degree))
