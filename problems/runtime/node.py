"""What a node of a distributed algorithm is: a state machine behind an inbox.

A node knows its own index, what its factory gave it, its own measurement and its inbox, and nothing else. The
same node class runs under every transport.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar

from problems.errors import HorizonetError
from problems.runtime.message import Message, Outgoing

NodeT = TypeVar("NodeT")

# Called with the node's index when it starts and again, for a fresh node, when it restarts.
NodeFactory = Callable[[int], NodeT]


class NodeError(HorizonetError, RuntimeError):
    """The process of a node ended or stopped answering."""


class Node(Protocol):
    """A node of a synchronous algorithm.

    One step is: `measure`, whose messages are delivered in round 0; `rounds` times `exchange`, each with the messages
    of the round before; `finish` with the messages of the last round. An algorithm with one exchange per step has
    ``rounds = 0``, max-consensus over a graph of diameter D has ``rounds = D - 1``.

    Attributes:
        rounds: number of `exchange` calls per step, equal at all nodes.
    """

    rounds: int

    def measure(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        """Take the node's own measurement (None or NaN: nothing was measured) and speak first."""
        ...

    def exchange(self, index: int, inbox: list[Message]) -> Iterable[Outgoing]:
        """Hear round ``index - 1`` and speak again, index = 1, ..., rounds."""
        ...

    def finish(self, inbox: list[Message]) -> Any:
        """Hear the last round and return the step's result."""
        ...


class EventNode(Protocol):
    """A node of an asynchronous algorithm."""

    def on_wake(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        """Act at one of the node's own instants."""
        ...

    def on_message(self, time: float, message: Message) -> Iterable[Outgoing]:
        """Take one message at the instant of its delivery."""
        ...

    def output(self) -> Any:
        """The node's present result."""
        ...


def newest_by_sender(inbox: Iterable[Message]) -> dict[int, Message]:
    """The newest message of every sender, so that late and repeated ones do no harm."""
    newest: dict[int, Message] = {}
    for message in inbox:
        known = newest.get(message.sender)
        if known is None or message.age_key > known.age_key:
            newest[message.sender] = message
    return newest
