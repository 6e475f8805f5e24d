"""What can go wrong between nodes and with them: loss, delay, outages, all from one seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import SettingError
from problems.networks.network import Network

_BLOCK = 64

DelayRule = Callable[[np.random.Generator, int], np.ndarray]


@dataclass(frozen=True)
class Links:
    """Loss and delay of the links of a network.

    Attributes:
        loss: probability that what is sent over a link is lost, one number or one per link in the order of
            ``Network.edges``.
        delay: how much later it arrives: one number, one per link, or a function ``(rng, count) -> delays``. Whole
            steps in synchronous runs, the unit of the clocks in asynchronous ones.
    """

    loss: float | ArrayLike = 0.0
    delay: ArrayLike | Fraction | DelayRule = 0


class Outage(NamedTuple):
    """A node is down for start <= t < end (steps in synchronous runs, else time) and restarts with a fresh memory."""

    node: int
    start: float
    end: float = math.inf


def random_outages(
    network: Network, duration: float, rate: float, mean_length: float, rng: np.random.Generator
) -> list[Outage]:
    """Outages with exponential up and down times.

    Args:
        network: whose nodes fail.
        duration: length of the run, steps or time.
        rate: failures per unit of up time, of each node.
        mean_length: mean down time.
        rng: source of the draws.

    Raises:
        SettingError: a rate or length that is not positive.
    """
    if not (rate > 0 and mean_length > 0):
        raise SettingError(f"failure rate and mean length must be positive, got {rate} and {mean_length}")
    outages = []
    for node in range(network.count):
        start = rng.exponential(1 / rate)
        while start < duration:
            end = start + rng.exponential(mean_length)
            outages.append(Outage(node, start, end))
            start = end + rng.exponential(1 / rate)
    return outages


class LinkDraws:
    """The fate of everything sent, as a function of seed, link and instant alone.

    What happens to a link does not depend on the traffic of other links or rounds, so different algorithms run over the
    same losses.

    Args:
        network: the graph.
        links: loss and delay.
        rng: gives one seed; needed only where something is random.
        whole_steps: delays must be whole numbers.

    Raises:
        SettingError: a probability outside [0, 1], a negative or (if `whole_steps`) broken delay, arrays of the wrong
            length, or randomness without a generator.
    """

    def __init__(self, network: Network, links: Links, rng: np.random.Generator | None, *, whole_steps: bool) -> None:
        self._count = len(network.edges)
        self._loss = self._per_link("loss", links.loss)
        if not ((self._loss >= 0) & (self._loss <= 1)).all():
            raise SettingError(f"loss probabilities lie in [0, 1], got {links.loss}")
        self._rule: Any = links.delay if callable(links.delay) else None
        self._constant: list[Any] = []
        self._whole = whole_steps
        if self._rule is None:
            plain = isinstance(links.delay, (list, tuple, np.ndarray))
            self._constant = self._checked(self._per_link("delay", links.delay)).tolist()
            if not plain and not whole_steps:
                self._constant = [links.delay] * self._count  # keeps exact (rational) clocks exact
        self._lossy = bool((self._loss > 0).any())
        self._delayed = self._rule is not None or any(self._constant)
        self._key = np.zeros(2, dtype=np.uint64)
        if self._lossy or self._rule is not None:
            if rng is None:
                raise SettingError("links with random loss or delay need rng=numpy.random.Generator")
            self._key = rng.integers(0, 2**64, size=2, dtype=np.uint64)
        self._blocks: dict[int, tuple[int, list[bool], list[Any]]] = {}

    def _per_link(self, what: str, values: Any) -> np.ndarray:
        try:
            return np.broadcast_to(np.asarray(values, dtype=float), (self._count,))
        except ValueError:
            raise SettingError(
                f"{what} is one number or one per link ({self._count}), got shape {np.shape(values)}"
            ) from None

    def _checked(self, delays: np.ndarray) -> np.ndarray:
        values = np.asarray(delays)
        if not (np.isfinite(values).all() and (values >= 0).all()):
            raise SettingError("delays are finite and at least 0")
        if self._whole:
            if (values != np.floor(values)).any():
                raise SettingError(f"delays of a synchronous run are whole steps, got {values[values % 1 != 0][0]}")
            return values.astype(np.int64)
        return values

    def _draw(self, counter: list[int], count: int, loss: np.ndarray) -> tuple[list[bool], list[Any] | None]:
        rng = np.random.Generator(np.random.Philox(counter=counter, key=self._key))
        lost = (rng.random(count) < loss).tolist()
        return lost, None if self._rule is None else self._checked(self._rule(rng, count)).tolist()

    def per_round(self, step: int, index: int) -> tuple[list[bool] | None, list[int] | None]:
        """Which links lose and delay what is sent in one round of one step; None where none does."""
        if not self._lossy and self._rule is None:
            return None, self._constant if self._delayed else None
        lost, delays = self._draw([0, index, step, 0], self._count, self._loss)
        return (lost if self._lossy else None), (delays if delays is not None else self._constant)

    def per_message(self, link: int, number: int) -> tuple[bool, Any]:
        """Whether the message of this number on this link is lost, and its delay."""
        if not self._lossy and self._rule is None:
            return False, self._constant[link]
        block, place = divmod(number, _BLOCK)
        cached = self._blocks.get(link)
        if cached is None or cached[0] != block:
            lost, delays = self._draw([0, block, link, 1], _BLOCK, np.broadcast_to(self._loss[link], _BLOCK))
            cached = self._blocks[link] = block, lost, delays or [self._constant[link]] * _BLOCK
        return cached[1][place], cached[2][place]
