"""Messages: schemas, bytes, counters, and the rule for neighbours that are missing."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from problems.errors import DataError, DefinitionError, ShapeError
from problems.runtime import Field, Message, NeighborMemory, Schema, newest_by_sender

STEP = Schema("step", {"y": (1,), "window": (4,), "covariance": Field((4, 4), symmetric=True)})
RELAY = Schema("relay", {"ids": Field((None, 2), "i4"), "values": (None, 3), "flags": Field((5,), "u1"), "gain": ()})


def arrived(schema: Schema, **values: object) -> Message:
    return Message(schema.id, 3, 7, 2.5, 1, schema.message(**values).payload)  # type: ignore[arg-type]


def test_the_message_of_one_step_carries_fifteen_floats() -> None:
    """dmhe-pre-estimation 4.2: p + n + n(n+1)/2 = 1 + 4 + 10 numbers and not a byte more."""
    outgoing = STEP.message(y=[1.0], window=np.arange(4), covariance=np.eye(4))
    assert outgoing.floats == 15
    assert len(outgoing.payload) == 15 * 8


def test_fields_come_back_bit_by_bit() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(4, 4))
    covariance = factor @ factor.T
    covariance = (covariance + covariance.T) / 2
    window = np.array([np.nan, -0.0, np.inf, 5e-324])
    fields = STEP.unpack(arrived(STEP, y=[np.pi], window=window, covariance=covariance))
    assert fields["window"].tobytes() == window.tobytes()
    assert fields["covariance"].tobytes() == covariance.tobytes()
    assert fields["y"].tobytes() == np.array([np.pi]).tobytes()


@pytest.mark.parametrize("rows", [0, 1, 6])
def test_rows_that_vary_in_number_and_other_types(rows: int) -> None:
    rng = np.random.default_rng(rows)
    ids, values = rng.integers(0, 1000, (rows, 2)), rng.normal(size=(rows, 3))
    message = arrived(RELAY, ids=ids, values=values, flags=[1, 0, 0, 1, 1], gain=0.25)
    fields = RELAY.unpack(message)
    np.testing.assert_array_equal(fields["ids"], ids)
    np.testing.assert_array_equal(fields["values"], values)
    assert fields["flags"].tolist() == [1, 0, 0, 1, 1]
    assert fields["gain"] == 0.25
    assert RELAY.message(ids=ids, values=values, flags=[0] * 5, gain=1.0).floats == 3 * rows + 1


def test_a_transposed_view_is_packed_row_by_row() -> None:
    schema = Schema("matrix", {"m": (2, 3)})
    matrix = np.arange(6.0).reshape(3, 2).T
    np.testing.assert_array_equal(schema.unpack(arrived(schema, m=matrix))["m"], matrix)


def test_received_fields_cannot_be_written_through() -> None:
    fields = STEP.unpack(arrived(STEP, y=[1.0], window=np.zeros(4), covariance=np.eye(4)))
    with pytest.raises(ValueError, match="read-only"):
        fields["window"][0] = 1.0


def test_what_does_not_fit_a_schema_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"field 'window' of message 'step' has shape \(4,\), got \(3,\)"):
        STEP.message(y=[1.0], window=np.zeros(3), covariance=np.eye(4))
    with pytest.raises(ShapeError, match="'ids'"):
        RELAY.message(ids=[1, 2], values=np.zeros((1, 3)), flags=[0] * 5, gain=0.0)
    with pytest.raises(DataError, match="has fields"):
        STEP.message(y=[1.0], window=np.zeros(4))
    with pytest.raises(DefinitionError, match="first axis"):
        Field((2, None))
    with pytest.raises(DefinitionError, match="symmetric"):
        Field((2, 3), symmetric=True)


def test_other_definitions_and_cut_messages_are_noticed() -> None:
    message = arrived(STEP, y=[1.0], window=np.zeros(4), covariance=np.eye(4))
    other = Schema("step", {"y": (1,), "window": (3,), "covariance": Field((4, 4), symmetric=True)})
    with pytest.raises(DataError, match="message 7 from node 3 has schema"):
        other.unpack(message)
    for wrong in (message.payload[:-1], message.payload + b"\0", b""):
        with pytest.raises(DataError, match="do not fit schema 'step'"):
            STEP.unpack(message._replace(payload=wrong))
    relay = arrived(RELAY, ids=[[1, 2]], values=[[1, 2, 3]], flags=[0] * 5, gain=0.0)
    for cut in range(len(relay.payload)):
        with pytest.raises(DataError, match="do not fit"):
            RELAY.unpack(relay._replace(payload=relay.payload[:cut]))


def test_a_frame_carries_the_whole_message() -> None:
    message = arrived(STEP, y=[1.0], window=np.zeros(4), covariance=np.eye(4))
    frame = message.to_bytes()
    assert Message.from_bytes(frame) == message
    assert len(frame) == len(message.payload) + 28
    assert pickle.loads(pickle.dumps(message)) == message
    with pytest.raises(DataError, match="28 bytes"):
        Message.from_bytes(frame[:10])


def test_newest_by_sender_follows_time_before_sequence() -> None:
    """A node that restarted counts from zero again; its time tells that it is newer."""
    old, new = Message(1, 0, 99, 4.0, 0, b""), Message(1, 0, 0, 5.0, 0, b"")
    other = Message(1, 1, 3, 1.0, 0, b"")
    assert newest_by_sender([new, old, other]) == {0: new, 1: other}
    assert newest_by_sender([old, new._replace(time=4.0)])[0] is old


class TestMissingNeighbours:
    A = np.array([[1.0, 1.0], [0.0, 0.5]])
    Q = np.diag([0.1, 0.2])

    def memory(self, **settings: object) -> NeighborMemory:
        def propagate(state: np.ndarray, steps: int) -> np.ndarray:
            return np.linalg.matrix_power(self.A, steps) @ state

        return NeighborMemory([0, 2, 5], [0.5, 0.3, 0.2], propagate, self.Q, **settings)  # type: ignore[arg-type]

    def test_all_present(self) -> None:
        memory = self.memory()
        states = np.arange(6.0).reshape(3, 2)
        for member, state in zip((0, 2, 5), states, strict=True):
            assert memory.receive(member, 4.0, state, np.eye(2))
        recall = memory.recall(4.0)
        np.testing.assert_array_equal(recall.states, states)
        np.testing.assert_array_equal(recall.weights, [0.5, 0.3, 0.2])
        np.testing.assert_array_equal(recall.covariances, [np.eye(2)] * 3)
        assert recall.members == (0, 2, 5)
        assert recall.ages.tolist() == [0, 0, 0]

    def test_a_late_one_is_propagated_and_inflated_per_step_of_age(self) -> None:
        memory = self.memory(period=0.5)
        memory.receive(0, 3.0, np.ones(2), np.eye(2))
        memory.receive(5, 1.5, np.array([1.0, 2.0]), 2 * np.eye(2))
        recall = memory.recall(3.0)
        assert recall.members == (0, 5)
        assert recall.absent == (2,)
        assert recall.ages.tolist() == [0, 3]
        np.testing.assert_allclose(recall.weights, [5 / 7, 2 / 7])
        np.testing.assert_allclose(recall.states[1], np.linalg.matrix_power(self.A, 3) @ [1.0, 2.0])
        assert recall.covariances is not None
        np.testing.assert_allclose(recall.covariances[1], 2 * np.eye(2) + 3 * self.Q)
        np.testing.assert_array_equal(recall.covariances[0], np.eye(2))

    def test_older_news_does_not_replace_newer(self) -> None:
        memory = self.memory()
        assert memory.receive(0, 2.0, np.ones(2))
        assert not memory.receive(0, 2.0, np.zeros(2))
        assert not memory.receive(0, 1.0, np.zeros(2))
        np.testing.assert_array_equal(memory.recall(2.0).states, [[1.0, 1.0]])
        assert memory.recall(2.0).covariances is None

    def test_those_silent_for_long_are_forgotten(self) -> None:
        memory = self.memory(forget_after=2)
        memory.receive(0, 5.0, np.ones(2))
        memory.receive(2, 3.0, np.ones(2))
        memory.receive(5, 2.0, np.ones(2))
        recall = memory.recall(5.0)
        assert recall.members == (0, 2)
        assert recall.absent == (5,)
        np.testing.assert_allclose(recall.weights, [0.625, 0.375])

    def test_zero_weights_of_the_known_count_equally(self) -> None:
        memory = NeighborMemory([0, 1, 2], [0, 0, 1], lambda state, steps: state, self.Q)
        memory.receive(0, 0.0, np.zeros(2))
        memory.receive(1, 0.0, np.ones(2))
        np.testing.assert_array_equal(memory.recall(0.0).weights, [0.5, 0.5])

    def test_misuse_is_refused(self) -> None:
        memory = self.memory()
        with pytest.raises(DataError, match="nothing was heard"):
            memory.recall(0.0)
        with pytest.raises(DataError, match="node 1 is not among"):
            memory.receive(1, 0.0, np.zeros(2))
        memory.receive(0, 0.0, np.zeros(2), np.eye(2))
        memory.receive(2, 0.0, np.zeros(2))
        with pytest.raises(DataError, match="node 2 sent no covariance"):
            memory.recall(0.0)
        with pytest.raises(ShapeError, match="3 neighbours"):
            NeighborMemory([0, 1, 2], [1.0], lambda state, steps: state, self.Q)
        with pytest.raises(DataError, match="nonnegative"):
            NeighborMemory([0], [-1.0], lambda state, steps: state, self.Q)
