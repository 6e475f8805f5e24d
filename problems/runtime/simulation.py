"""Synchronous runs of a network of nodes, step by step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from problems.errors import SettingError, ShapeError
from problems.networks.network import Network
from problems.runtime.links import Links, Outage
from problems.runtime.message import Message, Outgoing
from problems.runtime.node import Node, NodeFactory
from problems.runtime.transport import Transport


class Simulation(Transport):
    """A synchronous algorithm on one computer, deterministic whatever the losses, delays and outages.

    A step is: all nodes measure and speak; as many exchange rounds as the nodes ask for; all nodes finish. A message
    delayed by d steps arrives in the same round d steps later. What a link loses in a round depends on the seed, the
    link, the step and the round only, so all messages of one round on one link share their fate. Inboxes are sorted
    by sender, then age. A node that is down neither speaks nor hears; it restarts as a fresh node.

    Args:
        network: who hears whom.
        make: called with a node's index to make a `Node`, also when it restarts.
        links: loss and delay (whole steps); ideal by default.
        outages: when nodes are down, in step numbers.
        rng: seeds loss and delay.
        processes: run every node in its own process over pipes; same trace. `make` must be picklable.
        record: keep a `Trace`.

    Raises:
        SettingError: links or outages that make no sense, or nodes with different numbers of rounds.

    Example:
        >>> with Simulation(ring(5), make_node, links=Links(loss=0.1), rng=np.random.default_rng(7)) as simulation:
        ...     estimates = [simulation.step(row) for row in measurements]
    """

    def __init__(
        self,
        network: Network,
        make: NodeFactory[Node],
        *,
        links: Links | None = None,
        outages: Iterable[Outage] = (),
        rng: np.random.Generator | None = None,
        processes: bool = False,
        record: bool = False,
    ) -> None:
        super().__init__(
            network,
            make,
            links=links,
            outages=outages,
            rng=rng,
            processes=processes,
            record=record,
            whole_steps=True,
        )
        self.steps = 0
        self._alive: set[int] = set()
        self._rounds: int | None = None
        self._pending: dict[tuple[int, int], list[tuple[int, int, Message]]] = {}

    def step(self, measurements: Sequence[Any] | np.ndarray | None = None, time: float | None = None) -> list[Any]:
        """Run one step of all nodes.

        Args:
            measurements: one entry (or row) per node; None where nothing was measured.
            time: the step's instant; by default the number of steps before it.

        Returns:
            What every node's `finish` returned, None for nodes that are down.

        Raises:
            ShapeError: not one measurement per node.
            TopologyError: a node sends to a node that does not hear it.
            NodeError: a node's process ended by itself.
        """
        count = self.network.count
        own: Sequence[Any] | np.ndarray = [None] * count if measurements is None else measurements
        if len(own) != count:
            raise ShapeError(f"expected one measurement per node ({count}), got {len(own)}")
        now = float(self.steps if time is None else time)
        self._apply_outages()
        alive, rounds = sorted(self._alive), self._rounds or 0
        said = self._host.call("measure", {node: (now, own[node]) for node in alive})
        for index in range(rounds):
            inboxes = self._deliver(said, index, now)
            said = self._host.call("exchange", {node: (index + 1, inboxes[node]) for node in alive})
        inboxes = self._deliver(said, rounds, now)
        results = self._host.call("finish", {node: (inboxes[node],) for node in alive})
        if self.trace is not None:
            for node, result in results.items():
                self.trace.finished(node, now, result)
        self.steps += 1
        return [results.get(node) for node in range(count)]

    def run(self, measurements: Iterable[Sequence[Any] | np.ndarray | None]) -> list[list[Any]]:
        """Run one step per entry; entries and results as for `step`."""
        return [self.step(row) for row in measurements]

    def _apply_outages(self) -> None:
        down = {outage.node for outage in self._outages if outage.start <= self.steps < outage.end}
        for node in sorted(self._alive & down):
            self._host.stop(node)
        self._alive -= down
        starting = sorted(set(range(self.network.count)) - down - self._alive)
        if starting:
            found = set(self._start(starting).values()) | ({self._rounds} - {None})
            if len(found) > 1:
                raise SettingError(f"all nodes need the same number of exchange rounds, got {sorted(found, key=str)}")
            self._rounds = found.pop()
            self._alive.update(starting)

    def _deliver(self, said: dict[int, Iterable[Outgoing]], index: int, now: float) -> dict[int, list[Message]]:
        """Send what every node said in one round and return the inboxes at its end."""
        inboxes: dict[int, list[Message]] = {node: [] for node in sorted(self._alive)}
        lost, delays = self._draws.per_round(self.steps, index)
        for sender, items in said.items():
            for item in items:
                message, routes = self._send(sender, item, now, index)
                for receiver, link in routes:
                    if lost is not None and lost[link]:
                        self._lose(message, receiver, link)
                    elif delays is not None and delays[link]:
                        self.counters.delays(link)
                        due = self.steps + delays[link], index
                        self._pending.setdefault(due, []).append((receiver, link, message))
                    else:
                        self._arrive(inboxes, message, receiver, link)
        late = self._pending.pop((self.steps, index), [])
        for receiver, link, message in late:
            self._arrive(inboxes, message, receiver, link)
        for receiver in {receiver for receiver, _, _ in late} & inboxes.keys():
            inboxes[receiver].sort(key=lambda message: (message.sender, *message.age_key))
        return inboxes

    def _arrive(self, inboxes: dict[int, list[Message]], message: Message, receiver: int, link: int) -> None:
        inbox = inboxes.get(receiver)
        if inbox is None:
            self._lose(message, receiver, link)
            return
        inbox.append(message)
        if self.trace is not None:
            self.trace.delivered(message, receiver, float(self.steps))
