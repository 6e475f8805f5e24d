"""`RelayBuffer`: the measurements a node holds, how far each travelled, and what it sends on.

Source: dmhe-l-step, Algorithm 2 steps 1, 2 and 4; data rule 3.2.1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mhe.relay.plan import RelayPlan
from problems.errors import DataError, TopologyError
from problems.runtime.message import Field

RELAYED: dict[str, Field | tuple[int | None, ...]] = {
    "source": Field((None,), "i4"),
    "instant": Field((None,), "i4"),
    "hops": Field((None,), "u1"),
    "value": (None,),
}
"""Fields of a message for entries sent on: source, instant and hops of each, and the numbers of all of them."""


class RelayBuffer:
    """A time-sliding batch of measurements with hop counters.

    An entry is what one source measured at one instant. It is kept if it is not held yet, its path is not longer than
    l and its instant is in the window; the node's own measurements coming back are ignored. With latency 1, what
    arrives in a step is used from the next one on.

    Args:
        plan: of the node; the sources and l, N, latency and relay of the options count here.

    Attributes:
        values: (N + 1, p) measurements of the sources, the newest instant in slot `newest`, NaN where not held.
        newest: slot of the present instant.
    """

    def __init__(self, plan: RelayPlan) -> None:
        options = plan.options
        self._label, self._index, self._options = plan.label, plan.index, options
        self._rows = dict(zip(plan.sources, plan.source_rows, strict=True))
        self._place = {source: place for place, source in enumerate(plan.sources)}
        slots = options.horizon + 1
        self.values = np.full((slots, plan.model.measurement_size), np.nan)
        self._hops = np.full((slots, len(plan.sources)), -1)
        self._fresh: list[tuple[int, int]] = []  # (instant, source) taken in this step, to be sent on in the next
        self._sent_next: list[tuple[int, int]] = []  # those of the step before
        self._waiting: list[tuple[int, int, int, np.ndarray]] = []
        self._now, self.newest = -1, -1

    def advance(self, instant: int) -> None:
        """Make the next instant the newest one and drop what left the window."""
        horizon = self._options.horizon
        before, self.newest = self._now - self.newest, min(instant, horizon)
        self._now = instant
        left = instant - self.newest - max(0, before)
        for array, nothing in ((self.values, np.nan), (self._hops, -1)):
            if 0 < left <= horizon:
                array[:-left] = array[left:]
            if left:
                array[len(array) - min(left, len(array)) :] = nothing
        self._sent_next = self._fresh
        self._fresh = []
        waiting, self._waiting = self._waiting, []
        for entry in waiting:
            if self._take(*entry):
                self._sent_next.append(entry[:2])

    def measure(self, y: np.ndarray) -> None:
        """Take the node's own measurement of the present instant."""
        if y.size and not np.isnan(y).all():
            self.values[self.newest, self._rows[self._index]] = y
            self._hops[self.newest, self._place[self._index]] = 0

    def outgoing(self) -> dict[str, Any]:
        """Fields of the message for what is sent on in this step, see `RELAYED`; own measurements travel as such."""
        first = self._now - self.newest
        if self._options.relay == "incremental" or self._options.steps == 1:  # the measurement itself is the one hop
            entries = [(k, source) for k, source in self._sent_next if k >= first]
        else:
            slots, places = np.nonzero(self._hops[: self.newest] >= 0)
            sources = list(self._place)
            entries = [(first + int(slot), sources[place]) for slot, place in zip(slots, places, strict=True)]
        limit = self._options.steps
        travelled = [int(self._hops[k - first, self._place[source]]) + 1 for k, source in entries]
        chosen = [(k, source, hops) for (k, source), hops in zip(entries, travelled, strict=True) if hops <= limit]
        return {
            "source": [source for _, source, _ in chosen],
            "instant": [k for k, _, _ in chosen],
            "hops": [hops for _, _, hops in chosen],
            "value": np.concatenate(
                [np.zeros(0), *(self.values[k - first, self._rows[source]] for k, source, _ in chosen)]
            ),
        }

    def receive(self, sender: int, instant: int, y: np.ndarray, relayed: Mapping[str, np.ndarray] | None) -> bool:
        """Take what a neighbour sent: its own measurement and what it sends on.

        Returns:
            Whether its own measurement was new and is in the window.

        Raises:
            TopologyError: a source further away than l, which a fixed graph does not allow.
            DataError: numbers that do not fit their sources.
        """
        new = sender in self._rows and self._arrived(instant, sender, 1, y)
        if relayed is None:
            return new
        at, values = 0, relayed["value"]
        for k, source, hops in zip(
            relayed["instant"].tolist(), relayed["source"].tolist(), relayed["hops"].tolist(), strict=True
        ):
            if source not in self._rows:
                raise TopologyError(
                    f"node {self._label} was sent a measurement of node {source}, which is not within "
                    f"{self._options.steps} hops; the graph is fixed for a run, make a new design for another one"
                )
            rows = self._rows[source]
            end = at + rows.stop - rows.start
            if end > values.size:
                raise DataError(f"node {self._label}: node {sender} sent fewer numbers than its entries need")
            self._arrived(k, source, hops, values[at:end])
            at = end
        return new

    @property
    def held(self) -> np.ndarray:
        """(newest + 1, p) bool: components that are there."""
        return ~np.isnan(self.values[: self.newest + 1])

    def _arrived(self, instant: int, source: int, hops: int, y: np.ndarray) -> bool:
        if source == self._index or hops > self._options.steps or np.isnan(y).all():
            return False
        if self._options.latency:
            self._waiting.append((instant, source, hops, y))
            return True
        taken = self._take(instant, source, hops, y)
        if taken:
            self._fresh.append((instant, source))
        return taken

    def _take(self, instant: int, source: int, hops: int, y: np.ndarray) -> bool:
        slot, place = instant - self._now + self.newest, self._place[source]
        if not 0 <= slot <= self.newest or self._hops[slot, place] >= 0:
            return False
        self.values[slot, self._rows[source]] = y
        self._hops[slot, place] = hops
        return True
