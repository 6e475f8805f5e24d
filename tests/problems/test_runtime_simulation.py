"""The simulated transport: phases, rounds, loss, delay, death and restart, locality, counters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from problems.errors import DataError, SettingError, ShapeError, TopologyError
from problems.networks import Network, complete, draw_connected, line, random_digraph, ring, star
from problems.runtime import (
    Links,
    Message,
    Outage,
    Outgoing,
    Schema,
    Simulation,
    random_outages,
)

VALUE = Schema("value", {"value": ()})


class MaxNode:
    """Synchronous max-consensus over rounds + 1 exchanges."""

    def __init__(self, index: int, rounds: int = 0) -> None:
        self.rounds = rounds
        self.value = -np.inf

    def say(self) -> list[Outgoing]:
        return [VALUE.message(value=self.value)]

    def hear(self, inbox: list[Message]) -> None:
        self.value = max([self.value, *(float(VALUE.unpack(message)["value"]) for message in inbox)])

    def measure(self, time: float, measurement: Any) -> list[Outgoing]:
        self.value = float(measurement)
        return self.say()

    def exchange(self, index: int, inbox: list[Message]) -> list[Outgoing]:
        self.hear(inbox)
        return self.say()

    def finish(self, inbox: list[Message]) -> float:
        self.hear(inbox)
        return self.value


class LogNode:
    """Says `talk` things per round and returns what it heard: (sender, sent at, round, sequence)."""

    def __init__(self, index: int, rounds: int = 0, talk: int = 1) -> None:
        self.rounds, self.talk = rounds, talk
        self.heard: list[tuple[int, float, int, int]] = []

    def say(self) -> Iterator[Outgoing]:
        for _ in range(self.talk):
            yield VALUE.message(value=0.0)

    def note(self, inbox: list[Message]) -> None:
        self.heard += [(m.sender, m.time, m.round, m.sequence) for m in inbox]

    def measure(self, time: float, measurement: Any) -> Iterable[Outgoing]:
        self.heard = []
        return self.say()

    def exchange(self, index: int, inbox: list[Message]) -> Iterable[Outgoing]:
        self.note(inbox)
        return self.say()

    def finish(self, inbox: list[Message]) -> np.ndarray:
        self.note(inbox)
        return np.array(self.heard, dtype=float).reshape(-1, 4)


class AgeNode:
    """Counts the steps since it was made and tells its neighbours."""

    rounds = 0

    def __init__(self, index: int) -> None:
        self.age = 0

    def measure(self, time: float, measurement: Any) -> list[Outgoing]:
        self.age += 1
        return [VALUE.message(value=float(self.age))]

    def finish(self, inbox: list[Message]) -> np.ndarray:
        heard = {m.sender: float(VALUE.unpack(m)["value"]) for m in inbox}
        return np.array([self.age, *(heard.get(j, np.nan) for j in range(3))])


def heard_rounds(simulation: Simulation, steps: int) -> list[list[np.ndarray]]:
    return [simulation.step() for _ in range(steps)]


class TestSynchronous:
    @pytest.mark.parametrize("seed", range(10))
    def test_max_consensus_needs_exactly_the_diameter(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        network = draw_connected(lambda: random_digraph(12, 0.15, rng))
        reach = network.distances()
        far = int(np.flatnonzero(reach.max(axis=1) == network.diameter)[0])
        bids = rng.uniform(size=12)
        bids[far] = 2.0
        exact = Simulation(network, partial(MaxNode, rounds=network.diameter - 1)).step(bids)
        assert exact == [2.0] * 12
        short = Simulation(network, partial(MaxNode, rounds=network.diameter - 2)).step(bids)
        assert [value == 2.0 for value in short] == (reach[far] < network.diameter).tolist()

    def test_messages_are_stamped_by_the_transport_and_sorted(self) -> None:
        simulation = Simulation(star(4), partial(LogNode, rounds=1, talk=2))
        simulation.step(time=0.5)
        middle = simulation.step(time=1.5)[0]
        expected = [(j, 1.5, r, 4 + 2 * r + k) for r in (0, 1) for j in (1, 2, 3) for k in (0, 1)]
        np.testing.assert_array_equal(middle, expected)

    def test_nothing_reaches_a_node_but_its_inbox(self) -> None:
        class Meddler(MaxNode):
            def __init__(self, index: int) -> None:
                super().__init__(index)
                self.index = index

            def measure(self, time: float, measurement: Any) -> list[Outgoing]:
                return [VALUE.message(2, value=1.0)] if self.index == 0 else []

        with pytest.raises(TopologyError, match="node 0 sends to node index 2, which does not hear it; .* by 1, 4"):
            Simulation(ring(5), Meddler).step(np.zeros(5))

    def test_a_message_for_one_neighbour_reaches_only_that_one(self) -> None:
        class Whisper(LogNode):
            def say(self) -> Iterator[Outgoing]:
                yield VALUE.message(1, value=0.0)

            def measure(self, time: float, measurement: Any) -> Iterable[Outgoing]:
                return self.say() if measurement else []

        network = complete(4)
        simulation = Simulation(network, Whisper)
        heard = simulation.step([True, False, False, False])
        assert [len(rows) for rows in heard] == [0, 1, 0, 0]
        assert simulation.counters.messages.sum() == 1
        assert network.edges[simulation.counters.messages > 0].tolist() == [[0, 1]]

    def test_counters_per_link(self) -> None:
        network = Network(3, [(0, 1), (0, 2), (1, 2)])
        simulation = Simulation(network, partial(LogNode, rounds=2))
        simulation.run([None] * 5)
        np.testing.assert_array_equal(simulation.counters.messages, [15, 15, 15])
        np.testing.assert_array_equal(simulation.counters.floats, [15, 15, 15])
        np.testing.assert_array_equal(simulation.counters.bytes, [120, 120, 120])
        assert not simulation.counters.lost.any()

    def test_unequal_rounds_and_measurements_are_refused(self) -> None:
        with pytest.raises(SettingError, match=r"same number of exchange rounds, got \[0, 1\]"):
            Simulation(line(2), lambda index: MaxNode(index, rounds=index)).step([1, 2])
        with pytest.raises(ShapeError, match="one measurement per node"):
            Simulation(line(3), MaxNode).step([1, 2])

    def test_an_exception_says_where_it_happened(self) -> None:
        with pytest.raises(TypeError) as caught:
            Simulation(line(3), MaxNode).step([1.0, 2.0, None])
        assert "in node 2, measure" in caught.value.__notes__


class TestLossAndDelay:
    def test_the_same_seed_gives_the_same_run(self) -> None:
        rng = np.random.default_rng(0)
        network = random_digraph(10, 0.4, rng)
        bids = rng.normal(size=(20, 10))
        links = Links(loss=0.3, delay=lambda rng, count: rng.integers(0, 3, count))
        traces = []
        for seed in (5, 5, 6):
            simulation = Simulation(
                network, partial(MaxNode, rounds=2), links=links, rng=np.random.default_rng(seed), record=True
            )
            simulation.run(bids)
            assert simulation.trace is not None
            traces.append(simulation.trace)
        first, again, other = traces
        assert first == again
        assert first.digest() == again.digest()
        assert first.difference(again) is None
        assert first != other
        assert first.digest() != other.digest()
        assert "against" in str(first.difference(other))

    def test_what_a_link_loses_does_not_depend_on_the_traffic(self) -> None:
        """All methods of a trial see the same losses, whatever they send and however many rounds they need."""
        links = Links(loss=0.4)
        network = ring(6)
        lost = {}
        for rounds, talk in ((0, 1), (2, 1), (0, 3)):
            simulation = Simulation(
                network, partial(LogNode, rounds=rounds, talk=talk), links=links, rng=np.random.default_rng(3)
            )
            lost[rounds, talk] = [
                {(int(row[0]), node) for node, rows in enumerate(step) for row in rows if row[2] == 0}
                for step in heard_rounds(simulation, 30)
            ]
        assert lost[0, 1] == lost[2, 1] == lost[0, 3]

    def test_loss_has_the_rate_of_each_link(self) -> None:
        network = Network(3, [(0, 1), (1, 2), (2, 0)])
        simulation = Simulation(network, LogNode, links=Links(loss=[0.0, 1.0, 0.25]), rng=np.random.default_rng(1))
        simulation.run([None] * 2000)
        rates = simulation.counters.lost / simulation.counters.messages
        order = {tuple(edge): rate for edge, rate in zip(network.edges.tolist(), rates, strict=True)}
        assert [order[edge] for edge in ((2, 0), (0, 1))] == [0.0, 1.0]
        assert order[1, 2] == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 2000))

    def test_losses_of_links_rounds_and_steps_are_independent(self) -> None:
        network = complete(5)
        simulation = Simulation(
            network, partial(LogNode, rounds=1), links=Links(loss=0.5), rng=np.random.default_rng(2)
        )
        arrived = np.zeros((600, 2, 5, 5))
        for step, results in enumerate(heard_rounds(simulation, 600)):
            for node, rows in enumerate(results):
                arrived[step, rows[:, 2].astype(int), rows[:, 0].astype(int), node] = 1
        off = ~np.eye(5, dtype=bool)
        table = arrived[:, :, off].reshape(600, -1)
        correlation = np.corrcoef(table.T) - np.eye(table.shape[1])
        assert np.abs(correlation).max() < 5 / np.sqrt(600)
        follow = [np.corrcoef(column[:-1], column[1:])[0, 1] for column in table.T]
        assert np.abs(follow).max() < 5 / np.sqrt(600)

    def test_delay_shifts_by_whole_steps_in_the_same_round(self) -> None:
        network = Network(2, [(0, 1), (1, 0)])
        simulation = Simulation(network, partial(LogNode, rounds=1), links=Links(delay=[0, 2]))
        assert network.edges.tolist() == [[1, 0], [0, 1]]
        for step, (zero, one) in enumerate(heard_rounds(simulation, 6)):
            assert [(time, r) for _, time, r, _ in zero] == [(step, 0), (step, 1)]
            assert [(time, r) for _, time, r, _ in one] == ([(step - 2, 0), (step - 2, 1)] if step >= 2 else [])
        assert simulation.counters.late.tolist() == [0, 12]

    def test_late_messages_are_sorted_in(self) -> None:
        simulation = Simulation(
            complete(4),
            LogNode,
            links=Links(delay=lambda rng, count: rng.integers(0, 4, count)),
            rng=np.random.default_rng(0),
        )
        rows = [rows for step in heard_rounds(simulation, 40) for rows in step if len(rows) > 4]
        assert rows
        for heard in rows:
            keys = [tuple(row[[0, 1, 3]]) for row in heard]
            assert keys == sorted(keys)

    @pytest.mark.parametrize(
        ("links", "message"),
        [
            (Links(loss=1.2), "probabilities"),
            (Links(loss=[0.1, 0.2]), "one per link"),
            (Links(delay=0.5), "whole steps"),
            (Links(delay=-1), "at least 0"),
            (Links(loss=0.1), "need rng"),
            (Links(delay=lambda rng, count: rng.integers(0, 2, count)), "need rng"),
        ],
    )
    def test_links_that_make_no_sense(self, links: Links, message: str) -> None:
        with pytest.raises(SettingError, match=message):
            Simulation(ring(5), LogNode, links=links)

    def test_only_what_has_bits_can_be_traced(self) -> None:
        class Odd(LogNode):
            def finish(self, inbox: list[Message]) -> Any:
                return {"a": 1}

        with pytest.raises(DataError, match="a trace records"):
            Simulation(line(2), Odd, record=True).step()


class TestDeathAndRestart:
    def test_a_dead_node_is_silent_and_restarts_without_memory(self) -> None:
        simulation = Simulation(ring(3), AgeNode, outages=[Outage(1, 2, 4)])
        steps = [simulation.step() for _ in range(6)]
        assert [None if row[1] is None else row[1][0] for row in steps] == [1, 2, None, None, 1, 2]
        heard = [row[0][2] for row in steps]
        np.testing.assert_array_equal(heard, [1, 2, np.nan, np.nan, 1, 2])
        assert [row[0][0] for row in steps] == [1, 2, 3, 4, 5, 6]
        to_dead = ring(3).edges[:, 1] == 1
        np.testing.assert_array_equal(simulation.counters.lost, np.where(to_dead, 2, 0))

    def test_its_numbering_starts_again(self) -> None:
        simulation = Simulation(ring(3), LogNode, outages=[Outage(1, 3, 5)])
        sequence = [[int(row[3]) for row in step[0] if row[0] == 1] for step in heard_rounds(simulation, 7)]
        assert sequence == [[0], [1], [2], [], [], [0], [1]]

    def test_messages_under_way_survive_the_death_of_their_sender(self) -> None:
        simulation = Simulation(ring(3), AgeNode, links=Links(delay=2), outages=[Outage(1, 1)])
        heard = [simulation.step()[0][2] for _ in range(4)]
        np.testing.assert_array_equal(heard, [np.nan, np.nan, 1, np.nan])

    def test_a_node_may_start_late_and_outages_may_overlap(self) -> None:
        simulation = Simulation(ring(3), AgeNode, outages=[Outage(0, 0, 2), Outage(0, 1, 3)])
        alive = [simulation.step()[0] is not None for _ in range(5)]
        assert alive == [False, False, False, True, True]

    def test_random_outages_have_the_rates_asked_for(self) -> None:
        rng = np.random.default_rng(0)
        outages = random_outages(ring(200), 1000.0, 0.02, 5.0, rng)
        lengths = np.array([outage.end - outage.start for outage in outages])
        assert lengths.mean() == pytest.approx(5.0, rel=0.1)
        assert len(outages) == pytest.approx(200 * 1000 / 55, rel=0.1)
        assert outages == random_outages(ring(200), 1000.0, 0.02, 5.0, np.random.default_rng(0))
        with pytest.raises(SettingError, match="positive"):
            random_outages(ring(3), 10.0, 0.0, 1.0, rng)

    @pytest.mark.parametrize("outage", [Outage(9, 0, 1), Outage(0, 3, 3)])
    def test_outages_that_make_no_sense(self, outage: Outage) -> None:
        with pytest.raises(SettingError, match="an outage names a node"):
            Simulation(ring(3), AgeNode, outages=[outage])
