"""What the transports of one computer share: nodes behind a host, stamping, routing, counting, tracing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np

from problems.errors import SettingError, TopologyError
from problems.networks.network import Network
from problems.runtime.hosts import Host, LocalHost, ProcessHost
from problems.runtime.links import LinkDraws, Links, Outage
from problems.runtime.message import Message, Outgoing
from problems.runtime.node import NodeFactory
from problems.runtime.trace import Counters, Trace


class Transport:
    """Base of the transports; use `Simulation` or `EventSimulation`.

    Args:
        network: who hears whom.
        make: called with a node's index to make the node, also when it restarts.
        links: loss and delay; ideal by default.
        outages: when nodes are down.
        rng: seeds loss and delay.
        processes: run every node in its own process over pipes instead of in this process; same results.
        record: keep a `Trace`.

    Attributes:
        counters: what every link carried.
        trace: what happened, or None without `record`.
    """

    def __init__(
        self,
        network: Network,
        make: NodeFactory[Any],
        *,
        links: Links | None,
        outages: Iterable[Outage],
        rng: np.random.Generator | None,
        processes: bool,
        record: bool,
        whole_steps: bool,
    ) -> None:
        self.network = network
        self.counters = Counters(network)
        self.trace = Trace() if record else None
        self._draws = LinkDraws(network, links or Links(), rng, whole_steps=whole_steps)
        self._outages = [Outage(*outage) for outage in outages]
        for outage in self._outages:
            if not 0 <= outage.node < network.count or not outage.start < outage.end:
                raise SettingError(f"an outage names a node 0..{network.count - 1} and ends after it starts: {outage}")
        self._host: Host = ProcessHost(make) if processes else LocalHost(make)
        self._sequence = [0] * network.count
        self._routes: list[list[tuple[int, int]]] = [[] for _ in range(network.count)]
        for link, (sender, receiver) in enumerate(network.edges.tolist()):
            self._routes[sender].append((receiver, link))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all nodes (and their processes)."""
        self._host.close()

    def _start(self, nodes: Sequence[int]) -> dict[int, int]:
        for node in nodes:
            self._sequence[node] = 0
        return self._host.start(nodes)

    def _send(self, sender: int, item: Outgoing, time: float, index: int) -> tuple[Message, Sequence[tuple[int, int]]]:
        """Stamp and count one message; returns it with the (receiver, link) pairs it goes to."""
        message = Message(item.schema, sender, self._sequence[sender], float(time), index, item.payload)
        self._sequence[sender] += 1
        if item.to is None:
            self.counters.sent(sender, None, item.floats, len(item.payload))
            return message, self._routes[sender]
        routes = [route for route in self._routes[sender] if route[0] == item.to]
        if not routes:
            name = self.network.names([sender])
            raise TopologyError(
                f"node {name} sends to node index {item.to}, which does not hear it; "
                f"it is heard by {self.network.names([receiver for receiver, _ in self._routes[sender]])}"
            )
        self.counters.sent(sender, routes[0][1], item.floats, len(item.payload))
        return message, routes

    def _lose(self, message: Message, receiver: int, link: int) -> None:
        self.counters.loses(link)
        if self.trace is not None:
            self.trace.delivered(message, receiver, None)
