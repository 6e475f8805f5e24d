"""Asynchronous runs of a network of nodes, event by event."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from problems.errors import SettingError
from problems.networks.network import Network
from problems.runtime.links import Links, Outage
from problems.runtime.message import Outgoing
from problems.runtime.node import EventNode, NodeFactory
from problems.runtime.transport import Transport

_DOWN, _UP, _WAKE, _MESSAGE = range(4)


class EventSimulation(Transport):
    """An asynchronous algorithm on one computer: nodes wake by their own clocks, messages travel with delays.

    Deterministic: events at one instant are ordered by kind, node and sender. Clocks may count in integers or
    fractions.Fraction, which keeps coincidences exact. The fate of the m-th message on a link depends on the seed, the
    link and m only.

    Source: target-tracking-dkns 3.6.

    Args:
        network: who hears whom.
        make: called with a node's index to make an `EventNode`, also when it restarts.
        clocks: per node, its wake instants in nondecreasing order; endless iterators are fine.
        links: loss and delay (unit of the clocks); ideal by default.
        outages: when nodes are down, in the unit of the clocks; events of a node that is down are lost.
        rng: seeds loss and delay.
        processes: run every node in its own process over pipes; same trace. `make` must be picklable.
        record: keep a `Trace` of deliveries (results are in `outputs`).
        strict: a message that arrives at the very instant of a wake-up is heard after it (theta < t), else before.
        sense: ``(node, time) -> measurement`` handed to `on_wake`; None is handed without it.

    Raises:
        SettingError: links, outages or clocks that make no sense.
    """

    def __init__(
        self,
        network: Network,
        make: NodeFactory[EventNode],
        clocks: Sequence[Iterable[Any]],
        *,
        links: Links | None = None,
        outages: Iterable[Outage] = (),
        rng: np.random.Generator | None = None,
        processes: bool = False,
        record: bool = False,
        strict: bool = True,
        sense: Callable[[int, Any], Any] | None = None,
    ) -> None:
        super().__init__(
            network,
            make,
            links=links,
            outages=outages,
            rng=rng,
            processes=processes,
            record=record,
            whole_steps=False,
        )
        if len(clocks) != network.count:
            raise SettingError(f"expected one clock per node ({network.count}), got {len(clocks)}")
        self.time: Any = 0
        self._clocks: list[Iterator[Any]] = [iter(clock) for clock in clocks]
        self._rank = {_DOWN: 0, _UP: 1, _WAKE: 2 if strict else 3, _MESSAGE: 3 if strict else 2}
        self._sense = sense
        self._carried = [0] * len(network.edges)
        self._downs = [0] * network.count
        self._pushed = 0
        self._events: list[tuple[Any, int, int, int, int, int, Any]] = []
        self._start(range(network.count))
        for outage in self._outages:
            self._push(outage.start, _DOWN, outage.node)
            if outage.end != float("inf"):
                self._push(outage.end, _UP, outage.node)
        for node in range(network.count):
            self._schedule(node)

    def run(self, until: Any) -> None:
        """Run all events up to and including the instant `until`; may be called again with a later one.

        Raises:
            SettingError: a clock runs backwards.
            TopologyError: a node sends to a node that does not hear it.
            NodeError: a node's process ended by itself.
        """
        while self._events and self._events[0][0] <= until:
            time, _, node, sender, _, kind, data = heapq.heappop(self._events)
            self.time = time
            if kind == _DOWN:
                self._downs[node] += 1
                if self._downs[node] == 1:
                    self._host.stop(node)
            elif kind == _UP:
                self._downs[node] -= 1
                if not self._downs[node]:
                    self._start([node])
            elif kind == _WAKE:
                self._schedule(node)
                if not self._downs[node]:
                    self._call(node, "on_wake", time, None if self._sense is None else self._sense(node, time))
            else:
                message, link = data
                if self._downs[node]:
                    self._lose(message, node, link)
                    continue
                if self.trace is not None:
                    self.trace.delivered(message, node, float(time))
                self._call(node, "on_message", time, message)
        self.time = max(self.time, until)

    def outputs(self) -> list[Any]:
        """Present result of every node, None for nodes that are down."""
        alive = [node for node in range(self.network.count) if not self._downs[node]]
        results = self._host.call("output", {node: () for node in alive})
        return [results.get(node) for node in range(self.network.count)]

    @property
    def idle(self) -> bool:
        """No clock will ring and no message is under way."""
        return not self._events

    def _push(self, time: Any, kind: int, node: int, sender: int = -1, data: Any = None) -> None:
        heapq.heappush(self._events, (time, self._rank[kind], node, sender, self._pushed, kind, data))
        self._pushed += 1

    def _schedule(self, node: int) -> None:
        instant = next(self._clocks[node], None)
        if instant is None:
            return
        if instant < self.time:
            raise SettingError(f"the clock of node {node} runs backwards: {instant} after {self.time}")
        self._push(instant, _WAKE, node)

    def _call(self, node: int, method: str, time: Any, given: Any) -> None:
        said: Iterable[Outgoing] = self._host.call(method, {node: (time, given)})[node]
        for item in said:
            message, routes = self._send(node, item, time, 0)
            for receiver, link in routes:
                lost, delay = self._draws.per_message(link, self._carried[link])
                self._carried[link] += 1
                if lost:
                    self._lose(message, receiver, link)
                    continue
                if delay:
                    self.counters.delays(link)
                self._push(time + delay, _MESSAGE, receiver, node, (message, link))
