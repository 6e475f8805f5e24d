"""What happened in a run, so that two runs can be compared bit by bit, and what it cost on every link."""

from __future__ import annotations

import hashlib
import struct
from typing import Any, NamedTuple

import numpy as np

from problems.errors import DataError
from problems.networks.network import Network
from problems.runtime.message import Message


class Delivery(NamedTuple):
    """One message on one link: who received it when; arrival None means that it was lost."""

    receiver: int
    arrival: float | None
    frame: bytes


class Result(NamedTuple):
    """What a node returned at an instant, as bytes."""

    node: int
    time: float
    value: bytes


class Trace:
    """Deliveries and results of a run in the order in which they happened.

    Two traces are equal iff every message, its fate and every result are equal bit by bit.
    """

    def __init__(self) -> None:
        self.entries: list[Delivery | Result] = []

    def __eq__(self, other: object) -> bool:
        return self.entries == other.entries if isinstance(other, Trace) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __len__(self) -> int:
        return len(self.entries)

    def delivered(self, message: Message, receiver: int, arrival: float | None) -> None:
        """Note one message on one link."""
        self.entries.append(Delivery(receiver, arrival, message.to_bytes()))

    def finished(self, node: int, time: float, output: Any) -> None:
        """Note what a node returned: an array, a number, an object with a `state` array, or None.

        Raises:
            DataError: the output is none of these.
        """
        self.entries.append(Result(node, time, _canonical(output)))

    def digest(self) -> str:
        """SHA-256 over all entries, for comparing runs on different machines."""
        total = hashlib.sha256()
        for entry in self.entries:
            node, time = entry[0], entry[1]
            total.update(struct.pack("<?Id", isinstance(entry, Delivery), node, -1.0 if time is None else time))
            total.update(struct.pack("<I", len(entry[2])) + entry[2])
        return total.hexdigest()

    def difference(self, other: Trace) -> str | None:
        """The first entry in which two traces differ, in words; None if they are equal."""
        for place, (mine, theirs) in enumerate(zip(self.entries, other.entries, strict=False)):
            if mine != theirs:
                return f"entry {place}: {_words(mine)} against {_words(theirs)}"
        if len(self) != len(other):
            return f"{len(self)} entries against {len(other)}"
        return None


class Counters:
    """Messages, floats and bytes sent over every link, and what became of them.

    All arrays have one entry per link in the order of ``Network.edges``. What was neither lost nor is still under way
    has been delivered. Bytes count payloads.
    """

    def __init__(self, network: Network) -> None:
        self._senders = network.edges[:, 0]
        # Broadcasts are counted once per sender, as a loop over links would cost more than the delivery itself.
        self._broadcast = [[0] * network.count for _ in range(3)]
        self._single = np.zeros((3, len(network.edges)), dtype=np.int64)
        self._lost = [0] * len(network.edges)
        self._late = [0] * len(network.edges)

    def sent(self, sender: int, link: int | None, floats: int, size: int) -> None:
        """Count one message, on one link or (None) on all links of the sender."""
        if link is not None:
            self._single[:, link] += (1, floats, size)
            return
        for counts, amount in zip(self._broadcast, (1, floats, size), strict=True):
            counts[sender] += amount

    def loses(self, link: int) -> None:
        """Count one message that never arrived: lost on the way or sent to a node that was down."""
        self._lost[link] += 1

    def delays(self, link: int) -> None:
        """Count one message that arrives late."""
        self._late[link] += 1

    def _total(self, kind: int) -> np.ndarray:
        return np.array(self._broadcast[kind], dtype=np.int64)[self._senders] + self._single[kind]

    @property
    def messages(self) -> np.ndarray:
        """(E,) messages sent."""
        return self._total(0)

    @property
    def floats(self) -> np.ndarray:
        """(E,) float64 numbers sent."""
        return self._total(1)

    @property
    def bytes(self) -> np.ndarray:
        """(E,) payload bytes sent."""
        return self._total(2)

    @property
    def lost(self) -> np.ndarray:
        """(E,) messages that never arrived."""
        return np.array(self._lost, dtype=np.int64)

    @property
    def late(self) -> np.ndarray:
        """(E,) messages that were delayed."""
        return np.array(self._late, dtype=np.int64)


def _canonical(output: Any) -> bytes:
    value = getattr(output, "state", output)
    if value is None:
        return b""
    try:
        array = np.ascontiguousarray(value)
    except ValueError:
        array = np.empty(0, dtype=object)
    if array.dtype == object:
        raise DataError(
            f"a trace records arrays, numbers or objects with a `state` array, not {type(output).__name__}; "
            "run without record=True or let the node return one of these"
        )
    return f"{array.dtype.str}{np.shape(value)}".encode() + array.tobytes()


def _words(entry: Delivery | Result) -> str:
    if isinstance(entry, Result):
        return f"result of node {entry.node} at {entry.time:g}"
    message = Message.from_bytes(entry.frame)
    fate = "lost" if entry.arrival is None else f"arriving at {entry.arrival:g}"
    return (
        f"message {message.sequence} from node {message.sender} to node {entry.receiver}, sent at {message.time:g} in "
        f"round {message.round}, {fate}"
    )
