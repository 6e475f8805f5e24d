"""Consensus on relative vectors as nodes that know their own measurements and what neighbours told them.

`RelativeNodes` makes them for the transports of `problems.runtime`: ``s_cl`` for `Simulation`, the others for
`EventSimulation`. Source: spec ``gps-range-bearing-localization`` section 4, A1 to A3.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from localization.consensus.rates import consensus_weights, default_step
from localization.consensus.relative import RelativeVectors
from problems.errors import UnknownNameError
from problems.runtime import Message, Outgoing, Schema


@dataclass(frozen=True, eq=False)
class Known:
    """What a node has before it runs: measurements exchanged once with its neighbours, and first values.

    Attributes:
        start: (l,) its own first value.
        first: (l,) first value of every neighbour.
        own, others: its row of P.
        offset: (l,) its b.
        difference: (l,) where the measurements of a pair put it from each neighbour.
        held: (l,) the differences that it measured itself, by neighbour.
    """

    start: np.ndarray
    first: Mapping[int, np.ndarray]
    own: float
    others: Mapping[int, float]
    offset: np.ndarray
    difference: Mapping[int, np.ndarray]
    held: Mapping[int, np.ndarray]


class _ConsensusNode:
    def __init__(self, known: Known) -> None:
        self.known = known
        self.x = known.start.copy()
        self._estimate = Schema("estimate", {"x": known.start.shape})

    def on_wake(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        """Broadcast the estimate."""
        del time, measurement
        return [self._estimate.message(x=self.x)]

    def output(self) -> np.ndarray:
        """The estimate (l,)."""
        return self.x


class SynchronousNode(_ConsensusNode):
    """s-CL: a node of `Simulation`; a neighbour that is not heard counts with what it said last."""

    rounds = 0

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self._last = dict(known.first)

    def measure(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        """Broadcast the estimate."""
        return self.on_wake(time, measurement)

    def exchange(self, index: int, inbox: list[Message]) -> Iterable[Outgoing]:
        """Nothing: one exchange is all."""
        return []

    def finish(self, inbox: list[Message]) -> np.ndarray:
        """Average and return the estimate (l,)."""
        for message in inbox:
            self._last[message.sender] = self._estimate.unpack(message)["x"]
        self.x = _average(self.known, self.x, self._last)
        return self.x


class AsynchronousNode(_ConsensusNode):
    """a-CL: who hears a neighbour remembers it and averages; packets older than the one remembered are dropped."""

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self._memory = dict(known.first)
        self._age: dict[int, tuple[float, int, int]] = {}

    def on_message(self, time: float, message: Message) -> Iterable[Outgoing]:
        """Average with the neighbour's new value."""
        del time
        if message.sender in self._age and message.age_key < self._age[message.sender]:
            return []
        self._age[message.sender] = message.age_key
        self._memory[message.sender] = self._estimate.unpack(message)["x"]
        self.x = _average(self.known, self.x, self._memory)
        return []


class GossipNode(_ConsensusNode):
    """Memoryless gossip."""

    def on_message(self, time: float, message: Message) -> Iterable[Outgoing]:
        """Move half-way to where the neighbour puts this node."""
        del time
        told = self._estimate.unpack(message)["x"]
        self.x = (self.x + told + self.known.difference[message.sender]) / 2
        return []


class BroadcastNode(_ConsensusNode):
    """BC: polls its neighbours; moves when all have answered, so a lost packet costs the iteration."""

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self._poll = Schema("poll", {})
        self._answers: dict[int, np.ndarray] = {}

    def on_wake(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        """Ask the neighbours."""
        del time, measurement
        self._answers = {}
        return [self._poll.message()]

    def on_message(self, time: float, message: Message) -> Iterable[Outgoing]:
        """Answer a poll, or collect an answer."""
        del time
        if message.schema == self._poll.id:
            return [self._estimate.message(message.sender, x=self.x)]
        self._answers[message.sender] = self._estimate.unpack(message)["x"]
        if len(self._answers) == len(self.known.others):
            placed = [self._answers[j] + d for j, d in self.known.difference.items()]
            self.x = np.sum(placed, axis=0) / len(placed)
        return []


class KaczmarzNode(_ConsensusNode):
    """REK: woken without measurement it makes a column step; with the index of a neighbour, the row step of that pair.

    Needs links without loss.
    """

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self._poll, self._share = Schema("poll", {}), Schema("share", {"s": known.start.shape})
        self._correction = Schema("correction", {"t": known.start.shape})
        self._ask, self._move = Schema("ask", {}), Schema("move", {"rho": known.start.shape})
        self._s = {j: z.copy() for j, z in known.held.items()}
        self._shares: dict[int, np.ndarray] = {}

    def on_wake(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        """Poll all neighbours for their side of the state, or one neighbour for its estimate."""
        del time
        if measurement is None:
            self._shares = {}
            return [self._poll.message()]
        return [self._ask.message(int(measurement))]

    def on_message(self, time: float, message: Message) -> Iterable[Outgoing]:
        """Take part in a step of a neighbour or go on with an own one."""
        del time
        sender = message.sender
        if message.schema == self._poll.id:
            return [self._share.message(sender, s=self._s[sender])]
        if message.schema == self._ask.id:
            return [self._estimate.message(sender, x=self.x)]
        if message.schema == self._correction.id:
            self._s[sender] = self._s[sender] + self._correction.unpack(message)["t"]
        elif message.schema == self._move.id:
            self.x = self.x - self._move.unpack(message)["rho"]
        elif message.schema == self._estimate.id:
            told = self._estimate.unpack(message)["x"]
            rho = (self.known.held[sender] - self._s[sender] - self.x + told) / 2
            self.x = self.x + rho
            return [self._move.message(sender, rho=rho)]
        else:
            self._shares[sender] = self._share.unpack(message)["s"]
            if len(self._shares) == len(self._s):
                t = np.sum([self._s[j] - self._shares[j] for j in self._s], axis=0) / (2 * len(self._s))
                self._s = {j: s - t for j, s in self._s.items()}
                return [self._correction.message(t=t)]
        return []


NODES = {
    "s_cl": SynchronousNode,
    "a_cl": AsynchronousNode,
    "gossip": GossipNode,
    "bc": BroadcastNode,
    "rek": KaczmarzNode,
}


class RelativeNodes:
    """A node factory for one method on one network.

    Args:
        method: ``s_cl``, ``a_cl``, ``gossip``, ``bc`` or ``rek``.
        vectors: the measurements of all nodes; each node gets those of its own pairs.
        start: (count, l) first values.
        step: of ``s_cl`` and ``a_cl``; see `rates.consensus_weights`.

    Raises:
        UnknownNameError: another method.
        TopologyError, NoiseError, SettingError: the method cannot serve the network, or the step is too long.
    """

    def __init__(self, method: str, vectors: RelativeVectors, start: np.ndarray, step: float | None = None) -> None:
        if method not in NODES:
            raise UnknownNameError("method", method, NODES)
        vectors.require_connected()
        if method in ("gossip", "bc", "rek"):
            vectors.require_both_ways(method)
        self._make = NODES[method]
        self._known = _local_knowledge(vectors, np.asarray(start, dtype=float), step)

    def __call__(self, node: int) -> Any:
        return self._make(self._known[node])


def _local_knowledge(vectors: RelativeVectors, start: np.ndarray, step: float | None) -> list[Known]:
    weights = consensus_weights(vectors, step)
    used = default_step(vectors) if step is None else step
    held: list[dict[int, np.ndarray]] = [{} for _ in range(vectors.count)]
    for i, j, z in zip(vectors.tail.tolist(), vectors.head.tolist(), vectors.z, strict=True):
        held[i][j] = z
    known = []
    for i in range(vectors.count):
        row = dict(zip(vectors.network.in_neighborhood(i).tolist(), weights.row(i).tolist(), strict=True))
        own = row.pop(i)
        pull = vectors.pull[i, : len(row)]
        difference = dict(zip(row, pull / vectors.information[i, : len(row), None], strict=True))
        known.append(
            Known(start[i], {j: start[j] for j in row}, own, row, used * pull.sum(axis=0), difference, held[i])
        )
    return known


def _average(known: Known, x: np.ndarray, others: Mapping[int, np.ndarray]) -> np.ndarray:
    return known.own * x + sum(p * others[j] for j, p in known.others.items()) + known.offset
