"""Every node in a process of its own: same trace, real deaths, errors that name the node."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from problems.errors import SettingError, UnknownNameError
from problems.networks import Network, uniform_weights
from problems.runtime import (
    EventSimulation,
    Field,
    Links,
    Message,
    NeighborMemory,
    NodeError,
    Outage,
    Outgoing,
    Schema,
    Simulation,
    newest_by_sender,
)

pytestmark = pytest.mark.serial

STATE = Schema("state", {"state": (2,), "covariance": Field((2, 2), symmetric=True)})
NETWORK = Network(4, [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (2, 0)])


@pytest.fixture(autouse=True)
def importable_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Children import this module by its name."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2]))


def drift(state: np.ndarray, steps: int) -> np.ndarray:
    return np.array([state[0] + steps * state[1], state[1]])


class FusingNode:
    """Averages what the neighbourhood thinks, by the rule for missing neighbours, over two exchanges per step."""

    rounds = 1

    def __init__(self, index: int, weights: np.ndarray) -> None:
        self.index = index
        members = NETWORK.in_neighborhood(index).tolist()
        self.memory = NeighborMemory(members, weights[index, members], drift, 0.1 * np.eye(2), forget_after=3)
        self.state, self.covariance, self.time = np.zeros(2), np.eye(2), 0.0

    def _say(self) -> list[Outgoing]:
        return [STATE.message(state=self.state, covariance=self.covariance)]

    def _hear(self, inbox: Iterable[Message]) -> None:
        for message in newest_by_sender(inbox).values():
            self.memory.receive(message.sender, message.time, **STATE.unpack(message))
        recall = self.memory.recall(self.time)
        assert recall.covariances is not None
        self.state = recall.weights @ recall.states
        self.covariance = np.einsum("j,jab->ab", recall.weights, recall.covariances)

    def measure(self, time: float, measurement: Any) -> list[Outgoing]:
        self.time = time
        self.state = drift(self.state, 1) + 0.3 * np.asarray(measurement)
        self.memory.receive(self.index, time, self.state, self.covariance)
        return self._say()

    def exchange(self, index: int, inbox: list[Message]) -> list[Outgoing]:
        self._hear(inbox)
        return self._say()

    def finish(self, inbox: list[Message]) -> np.ndarray:
        self._hear(inbox)
        return self.state

    def on_wake(self, time: float, measurement: Any) -> list[Outgoing]:
        return self.measure(time, measurement)

    def on_message(self, time: float, message: Message) -> list[Outgoing]:
        self._hear([message])
        return []

    def output(self) -> np.ndarray:
        return self.state


class FragileNode:
    """Fails in the way its measurement says."""

    rounds = 0

    def __init__(self, index: int) -> None:
        self.index = index

    def measure(self, time: float, measurement: Any) -> list[Outgoing]:
        if measurement == "raise":
            raise ValueError("cannot measure")
        if measurement == "odd":
            raise UnknownNameError("solver", "x", ["y"])
        if measurement == "die":
            os._exit(7)
        return []

    def finish(self, inbox: list[Message]) -> int:
        return os.getpid()


def broken_factory(index: int) -> FragileNode:
    raise ValueError(f"no node {index}")


def make() -> partial[FusingNode]:
    return partial(FusingNode, weights=uniform_weights(NETWORK).matrix())


def test_processes_give_the_trace_of_the_simulation() -> None:
    measurements = np.random.default_rng(5).normal(size=(12, 4, 2))
    links = Links(loss=0.2, delay=lambda rng, count: rng.integers(0, 3, count))
    traces, results, lost = [], [], []
    for processes in (False, True):
        with Simulation(
            NETWORK,
            make(),
            links=links,
            outages=[Outage(2, 4, 7)],
            rng=np.random.default_rng(9),
            processes=processes,
            record=True,
        ) as simulation:
            results.append(simulation.run(measurements))
            traces.append(simulation.trace)
            lost.append(simulation.counters.lost)
    assert traces[0].difference(traces[1]) is None
    assert traces[0] == traces[1]
    assert traces[0].digest() == traces[1].digest()
    np.testing.assert_array_equal(*lost)
    assert lost[0].sum() > 0
    assert [row[2] is None for row in results[1]] == [4 <= step < 7 for step in range(12)]


def test_processes_give_the_events_of_the_simulation() -> None:
    traces, outputs = [], []
    for processes in (False, True):
        with EventSimulation(
            NETWORK,
            make(),
            [(0.3 * i + k for k in count()) for i in range(4)],
            links=Links(loss=0.1, delay=lambda rng, count: rng.exponential(0.5, count)),
            outages=[Outage(1, 3.05, 6.55)],
            rng=np.random.default_rng(2),
            processes=processes,
            record=True,
            sense=lambda node, time: np.array([node, np.sin(time)]),
        ) as simulation:
            simulation.run(10)
            traces.append(simulation.trace)
            outputs.append(np.array(simulation.outputs()))
    assert traces[0] == traces[1]
    assert outputs[0].tobytes() == outputs[1].tobytes()


def test_nodes_live_in_different_processes_that_end() -> None:
    with Simulation(NETWORK, FragileNode, processes=True, outages=[Outage(3, 1, 2)]) as simulation:
        first, second, third = simulation.run([[""] * 4] * 3)
        assert len({os.getpid(), *first}) == 5
        assert second[:3] == first[:3] == third[:3]
        assert second[3] is None
        assert third[3] not in (None, first[3])
    for pid in {*first, *third}:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_factory_that_cannot_travel_is_refused() -> None:
    with pytest.raises(SettingError, match="can be pickled"):
        Simulation(NETWORK, lambda index: FragileNode(index), processes=True)


def test_errors_name_the_node_and_the_phase() -> None:
    with Simulation(NETWORK, FragileNode, processes=True) as simulation:
        with pytest.raises(ValueError, match="cannot measure") as caught:
            simulation.step(["", "", "raise", ""])
        assert "in node 2, measure" in caught.value.__notes__[0]
        assert len(set(simulation.step([""] * 4))) == 4
    with Simulation(NETWORK, FragileNode, processes=True) as simulation:
        with pytest.raises(NodeError, match="the process of node 1 ended during measure with exit code 7"):
            simulation.step(["", "die", "", ""])
    with Simulation(NETWORK, FragileNode, processes=True) as simulation:
        with pytest.raises(NodeError, match="UnknownNameError: unknown solver 'x'"):
            simulation.step(["odd", "", "", ""])
    with Simulation(NETWORK, broken_factory, processes=True) as simulation:
        with pytest.raises(ValueError, match="no node 0"):
            simulation.step()
