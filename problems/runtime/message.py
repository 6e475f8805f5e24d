"""Messages between nodes: bytes with a schema, a sender, a sequence number and a time."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import DataError, DefinitionError, ShapeError

_HEADER = struct.Struct("<IIQdI")
_COUNT = struct.Struct("<I")


class Message(NamedTuple):
    """What one node receives from another. Fields before the payload are stamped by the transport.

    Attributes:
        schema: `Schema.id` of the payload.
        sender: index of the sending node.
        sequence: counts the sender's messages; starts again at 0 when the sender restarts.
        time: instant at which the sender spoke (the step's time in synchronous runs).
        round: exchange of the step in which it was sent, 0 for the one after measuring; 0 in asynchronous runs.
        payload: the packed fields.
    """

    schema: int
    sender: int
    sequence: int
    time: float
    round: int
    payload: bytes

    @property
    def age_key(self) -> tuple[float, int, int]:
        """Orders the messages of one sender from old to new, also across a restart of the sender."""
        return self.time, self.round, self.sequence

    def to_bytes(self) -> bytes:
        """The message as it travels: a header of 28 bytes and the payload."""
        return _HEADER.pack(self.schema, self.sender, self.sequence, self.time, self.round) + self.payload

    @classmethod
    def from_bytes(cls, frame: bytes) -> Message:
        """Inverse of `to_bytes`.

        Raises:
            DataError: the frame is shorter than a header.
        """
        if len(frame) < _HEADER.size:
            raise DataError(f"a message frame has at least {_HEADER.size} bytes, got {len(frame)}")
        schema, sender, sequence, time, index = _HEADER.unpack_from(frame)
        return cls(schema, sender, sequence, time, index, frame[_HEADER.size :])

    def __reduce__(self) -> tuple[Any, ...]:
        # Pipes pickle: going through the wire format shows that the frame carries everything.
        return Message.from_bytes, (self.to_bytes(),)


class Outgoing(NamedTuple):
    """What a node hands to the transport.

    Attributes:
        schema: `Schema.id` of the payload.
        payload: the packed fields.
        floats: float64 numbers in the payload, for the transport's counters.
        to: index of one out-neighbour, or None for all of them.
    """

    schema: int
    payload: bytes
    floats: int
    to: int | None = None


@dataclass(frozen=True)
class Field:
    """One array of a message.

    Attributes:
        shape: its shape; a first entry None means any number of rows (sent with the message).
        dtype: ``"f8"`` for numbers, ``"i4"``, ``"i8"`` for identifiers and counts, ``"u1"`` for flags.
        symmetric: a square matrix of which only the upper triangle travels.
    """

    shape: tuple[int | None, ...] = ()
    dtype: Literal["f8", "i4", "i8", "u1"] = "f8"
    symmetric: bool = False

    def __post_init__(self) -> None:
        if any(size is None for size in self.shape[1:]):
            raise DefinitionError(f"only the first axis of a message field may vary, got shape {self.shape}")
        if self.symmetric and (len(self.shape) != 2 or self.shape[0] != self.shape[1]):
            raise DefinitionError(f"a symmetric field has shape (n, n), got {self.shape}")


class Schema:
    """Names, shapes and types of the arrays in one kind of message.

    Args:
        name: of the kind of message.
        fields: the arrays in the order in which they travel; a plain shape stands for a float64 `Field`.

    Attributes:
        id: 32-bit number computed from name and fields, so two programs that disagree notice it.

    Example:
        >>> reading = Schema("reading", {"y": (1,), "covariance": Field((4, 4), symmetric=True)})
        >>> outgoing = reading.message(y=[0.5], covariance=np.eye(4))
    """

    def __init__(self, name: str, fields: Mapping[str, Field | tuple[int | None, ...]]) -> None:
        self.name = name
        self.fields = {key: item if isinstance(item, Field) else Field(tuple(item)) for key, item in fields.items()}
        text = repr((name, [(key, f.shape, f.dtype, f.symmetric) for key, f in self.fields.items()]))
        self.id = zlib.crc32(text.encode())
        self._codecs = [_Codec(name, key, item) for key, item in self.fields.items()]

    def __repr__(self) -> str:
        return f"Schema({self.name!r}, {self.fields!r})"

    def pack(self, values: Mapping[str, ArrayLike]) -> bytes:
        """The arrays as bytes (little-endian, row-major, upper triangle of symmetric fields).

        Raises:
            DataError: a field is missing or unknown.
            ShapeError: an array has the wrong shape.
        """
        if values.keys() != self.fields.keys():
            raise DataError(f"message {self.name!r} has fields {sorted(self.fields)}, got {sorted(values)}")
        return b"".join([codec.pack(values[codec.key]) for codec in self._codecs])

    def message(self, to: int | None = None, /, **values: ArrayLike) -> Outgoing:
        """Pack the arrays for one out-neighbour or, by default, for all of them; errors as for `pack`."""
        payload = self.pack(values)
        floats = sum(codec.floats(values[codec.key]) for codec in self._codecs)
        return Outgoing(self.id, payload, floats, to)

    def unpack(self, message: Message) -> dict[str, np.ndarray]:
        """The arrays of a received message, read-only where no copy was needed.

        Raises:
            DataError: the message belongs to another schema or its length does not fit.
        """
        if message.schema != self.id:
            raise DataError(
                f"message {message.sequence} from node {message.sender} has schema {message.schema:#010x}, not "
                f"{self.id:#010x} ({self.name!r}); sender and receiver must run the same definition"
            )
        payload, offset, values = message.payload, 0, {}
        try:
            for codec in self._codecs:
                values[codec.key], offset = codec.unpack(payload, offset)
        except (ValueError, struct.error):
            offset = -1
        if offset != len(payload):
            raise DataError(
                f"message {message.sequence} from node {message.sender}: {len(payload)} bytes do not fit schema "
                f"{self.name!r}; it was cut or packed by other code"
            )
        return values


class _Codec:
    """One field, its sizes worked out once."""

    def __init__(self, schema: str, key: str, field: Field) -> None:
        self.schema, self.key, self.field = schema, key, field
        self.dtype = np.dtype("<" + field.dtype)
        self.varies = bool(field.shape) and field.shape[0] is None
        self.tail = tuple(size for size in field.shape[self.varies :] if size is not None)
        self.size = int(np.prod(self.tail))
        self.upper: np.ndarray | None = None
        if field.symmetric:
            n = self.tail[0]
            rows, columns = np.triu_indices(n)
            self.upper = rows * n + columns
            self.expand = np.zeros((n, n), dtype=np.intp)
            self.expand[rows, columns] = self.expand[columns, rows] = np.arange(len(rows))
            self.size = len(rows)

    def _array(self, value: ArrayLike) -> np.ndarray:
        array = np.asarray(value, dtype=self.dtype)
        if array.shape == self.tail and not self.varies:
            return array
        if self.varies and array.shape[1:] == self.tail and array.ndim:
            return array
        raise ShapeError(
            f"field {self.key!r} of message {self.schema!r} has shape {self.field.shape}, got {array.shape}"
        )

    def pack(self, value: ArrayLike) -> bytes:
        array = self._array(value)
        if self.upper is not None:
            return array.ravel()[self.upper].tobytes()
        return _COUNT.pack(len(array)) + array.tobytes() if self.varies else array.tobytes()

    def floats(self, value: ArrayLike) -> int:
        if self.field.dtype != "f8":
            return 0
        return self.size * len(np.asarray(value)) if self.varies else self.size

    def unpack(self, payload: bytes, offset: int) -> tuple[np.ndarray, int]:
        count, shape = self.size, self.tail
        if self.varies:
            (rows,) = _COUNT.unpack_from(payload, offset)
            offset, count, shape = offset + _COUNT.size, self.size * rows, (rows, *self.tail)
        end = offset + count * self.dtype.itemsize
        if end > len(payload):
            raise ValueError("payload too short")
        flat = np.frombuffer(payload, self.dtype, count, offset) if count else np.empty(0, self.dtype)
        return (flat[self.expand] if self.upper is not None else flat.reshape(shape)), end
