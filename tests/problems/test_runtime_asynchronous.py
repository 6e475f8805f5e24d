"""The simulated transport without rounds: clocks and asynchronous events."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from itertools import chain, count, takewhile
from typing import Any

import numpy as np
import pytest

from problems.errors import SettingError
from problems.networks import Network, line
from problems.runtime import (
    EventSimulation,
    Field,
    Links,
    Message,
    Outage,
    Outgoing,
    Schema,
    newest_by_sender,
)
from problems.runtime.trace import Delivery

TOKENS = Schema("tokens", {"value": (), "tokens": Field((3,), "u1")})


class TokenNode:
    """Asynchronous max-consensus with tokens (target-tracking-dkns 4.5) on the newest message of each neighbour."""

    def __init__(
        self, index: int, bids: tuple[float, ...], send_initial: bool = False, updates: float = np.inf
    ) -> None:
        self.value, self.send_initial, self.updates = bids[index], send_initial, updates
        self.tokens = np.zeros(3, dtype=np.uint8)
        self.tokens[index] = 1
        self.inbox: dict[int, Message] = {}
        self.top = max(bids)
        self.reached: float | None = 0.0 if self.value == self.top else None
        self.complete: float | None = None

    def on_message(self, time: float, message: Message) -> list[Outgoing]:
        self.inbox = newest_by_sender([*self.inbox.values(), message])
        return []

    def on_wake(self, time: float, measurement: Any) -> list[Outgoing]:
        if time > 0 and self.updates > 0:
            self.updates -= 1
            for message in self.inbox.values():
                fields = TOKENS.unpack(message)
                self.value = max(self.value, float(fields["value"]))
                self.tokens |= fields["tokens"]
            if self.value == self.top and self.reached is None:
                self.reached = time
            if self.tokens.all() and self.complete is None:
                self.complete = time
        return [TOKENS.message(value=self.value, tokens=self.tokens)] if time > 0 or self.send_initial else []

    def output(self) -> tuple[float, float | None, float | None]:
        return self.value, self.reached, self.complete


def clock(period: Fraction, first: Fraction | None = None) -> Iterator[Fraction]:
    start = period if first is None else first
    return chain([Fraction(0)], (start + k * period for k in count()))


def tenths(*numbers: int) -> list[Fraction]:
    return [Fraction(number, 10) for number in numbers]


class TestAsynchronous:
    def run_tokens(self, bids, periods, *, send_initial, links, seed=0):
        simulation = EventSimulation(
            line(3),
            partial(TokenNode, bids=bids, send_initial=send_initial),
            [clock(period) for period in periods],
            links=links,
            rng=np.random.default_rng(seed),
        )
        simulation.run(Fraction(3))
        return simulation.outputs()

    @pytest.mark.parametrize("seed", range(25))
    def test_published_timing_holds_for_any_delay(self, seed: int) -> None:
        """target-tracking-dkns 10.16 (Figs 5.4 and 5.5): 0.8 and 1.0 ms, tokens and states alike."""
        links = Links(delay=lambda rng, count: rng.uniform(0, 0.095, count))
        first = self.run_tokens((15.0, 8.0, 2.0), tenths(5, 3, 2), send_initial=False, links=links, seed=seed)
        assert [complete for _, _, complete in first] == tenths(5, 6, 8)
        assert max(reached for _, reached, _ in first) == Fraction(8, 10)
        second = self.run_tokens((2.0, 8.0, 15.0), tenths(5, 3, 4), send_initial=False, links=links, seed=seed)
        assert max(complete for _, _, complete in second) == 1
        assert max(reached for _, reached, _ in second) == 1
        early = self.run_tokens((15.0, 8.0, 2.0), tenths(5, 3, 2), send_initial=True, links=links, seed=seed)
        assert max(reached for _, reached, _ in early) == Fraction(4, 10)
        assert max(complete for _, _, complete in early) == Fraction(5, 10)

    def test_stopping_after_the_diameter_fails_without_alignment(self) -> None:
        """target-tracking-dkns 6.3 and 10.17: final states 15, 15, 8."""
        offsets = tenths(4, 2, 0)
        clocks = [takewhile(lambda t: t < 10, (offset + 1 + k for k in count())) for offset in offsets]
        simulation = EventSimulation(
            line(3),
            partial(TokenNode, bids=(15.0, 8.0, 2.0), updates=2),
            [chain([Fraction(0)], times) for times in clocks],
            links=Links(delay=Fraction(5, 100)),
        )
        simulation.run(10)
        assert [value for value, _, _ in simulation.outputs()] == [15.0, 15.0, 8.0]

    def test_a_message_at_the_instant_of_a_wake_up(self) -> None:
        """theta < t, strictly: with a delay of exactly one period it counts at the next update only."""
        for strict, expected in ((True, [0, 2]), (False, [0, 1])):
            simulation = EventSimulation(
                Network(3, [(0, 1)]),
                partial(TokenNode, bids=(3.0, 1.0, 0.0), send_initial=True),
                [[0], [0, 1, 2], []],
                links=Links(delay=1),
                strict=strict,
            )
            simulation.run(5)
            assert simulation.outputs()[1][1] == expected[1]
            assert simulation.idle

    def test_equal_seeds_equal_traces_and_fates_by_message_number(self) -> None:
        links = Links(loss=0.3, delay=lambda rng, count: rng.exponential(0.2, count))
        digests = []
        for seed in (1, 1, 2):
            simulation = EventSimulation(
                line(3),
                partial(TokenNode, bids=(3.0, 1.0, 0.0)),
                [clock(period) for period in tenths(5, 3, 2)],
                links=links,
                rng=np.random.default_rng(seed),
                record=True,
            )
            simulation.run(60)
            assert simulation.trace is not None
            digests.append(simulation.trace.digest())
            counters = simulation.counters
            assert counters.lost.sum() / counters.messages.sum() == pytest.approx(0.3, abs=0.06)
        assert digests[0] == digests[1] != digests[2]

    def test_fates_of_messages_and_links_are_independent(self) -> None:
        simulation = EventSimulation(
            Network(3, [(0, 1), (1, 0)]),
            partial(TokenNode, bids=(0.0, 0.0, 0.0)),
            [range(1, 641), range(1, 641), []],
            links=Links(loss=0.5),
            rng=np.random.default_rng(4),
            record=True,
        )
        simulation.run(700)
        assert simulation.trace is not None
        arrivals = [
            (entry.receiver, Message.from_bytes(entry[2]).sequence)
            for entry in simulation.trace.entries
            if isinstance(entry, Delivery) and entry.arrival is not None
        ]
        fates = np.zeros((2, 640))
        fates[tuple(np.array(arrivals).T)] = 1
        table = fates.reshape(20, 64)
        assert np.abs(np.corrcoef(table) - np.eye(20)).max() < 4.5 / np.sqrt(64)
        assert abs(np.corrcoef(fates)[0, 1]) < 4 / np.sqrt(640)

    def test_death_loses_events_and_memory(self) -> None:
        simulation = EventSimulation(
            line(3),
            partial(TokenNode, bids=(3.0, 1.0, 0.0)),
            [clock(Fraction(1)) for _ in range(3)],
            outages=[Outage(1, Fraction(5, 2), Fraction(9, 2)), Outage(2, Fraction(11, 2))],
        )
        simulation.run(4)
        assert simulation.outputs()[1] is None
        simulation.run(Fraction(46, 10))
        assert simulation.outputs()[1] == (1.0, None, None)
        simulation.run(8)
        (_, _, _), (value, reached, _), gone = simulation.outputs()
        assert (value, reached, gone) == (3.0, 6, None)
        to_one = line(3).edges[:, 1] == 1
        assert simulation.counters.lost[to_one].tolist() == [2, 2]

    def test_own_measurements_arrive_with_the_wake_up(self) -> None:
        seen: list[tuple[int, float]] = []

        class Senses(TokenNode):
            def on_wake(self, time: float, measurement: Any) -> list[Outgoing]:
                seen.append(measurement)
                return []

        simulation = EventSimulation(
            line(3), partial(Senses, bids=(0.0, 0.0, 0.0)), [[1], [2], []], sense=lambda node, time: (node, time)
        )
        simulation.run(3)
        assert seen == [(0, 1), (1, 2)]

    def test_clocks_that_make_no_sense(self) -> None:
        with pytest.raises(SettingError, match="one clock per node"):
            EventSimulation(line(3), partial(TokenNode, bids=(0.0, 0.0, 0.0)), [[1]])
        simulation = EventSimulation(line(3), partial(TokenNode, bids=(0.0, 0.0, 0.0)), [[2, 1], [], []])
        with pytest.raises(SettingError, match="clock of node 0 runs backwards"):
            simulation.run(5)
