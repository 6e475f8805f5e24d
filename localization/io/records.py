"""Lines of the form ``TAG [time] keys... numbers... upper triangle``: what g2o and PyFG have in common."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.io.text import Rows, read_text, shorten
from problems.errors import DataError, ReadError
from problems.spaces import wrap

QUATERNION_SLACK = 1e-2
"""Largest deviation of a quaternion's norm from one that is still taken for rounding of the file."""


@dataclass(frozen=True)
class Record:
    """Layout of one kind of line.

    Attributes:
        tag: first word of the line.
        keys: how many names follow (after the time, where there is one).
        value: how many numbers the value has; 3 of a pose are SE2, 7 are SE3.
        weight: size of the symmetric matrix whose upper triangle ends the line; 0 for none.
        timed: whether a time stands before the names.
        dimension: 2 or 3; 0 for a line that fits both.
    """

    tag: str
    keys: int
    value: int = 0
    weight: int = 0
    timed: bool = False
    dimension: int = 0

    @property
    def head(self) -> int:
        """Words before the numbers, the tag included."""
        return 1 + self.timed + self.keys

    @property
    def numbers(self) -> int:
        """Numbers after the names."""
        return self.value + self.weight * (self.weight + 1) // 2

    @property
    def layout(self) -> str:
        """The line in words."""
        parts = [self.tag] + ["time"] * self.timed + [f"{self.keys} name{'s' * (self.keys > 1)}"]
        parts += [f"{self.value} value(s)"] * bool(self.value)
        if self.weight:
            parts.append(f"{self.numbers - self.value} entries of an upper triangle")
        return ", ".join(parts)


@dataclass(frozen=True, eq=False)
class Block:
    """All lines of one record.

    Attributes:
        record: their layout.
        rows: the lines, for messages.
        keys: names per line.
        time: (m,), NaN where the record has none.
        value: (m, d), angles wrapped and quaternions of length one.
        weight: (m, k, k) symmetric, positive definite.
    """

    record: Record
    rows: Rows
    keys: list[list[str]]
    time: np.ndarray
    value: np.ndarray
    weight: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)


def read_records(path: str | Path, records: Sequence[Record]) -> dict[str, Block]:
    """All lines of a file by tag; a tag that does not occur has an empty block.

    Raises:
        ReadError: unknown tag, wrong count of words or numbers, no number, NaN, quaternion that is none, matrix that
            is not positive definite, 2-D and 3-D records in one file; names the line.
    """
    known = {record.tag: record for record in records}
    heads: dict[str, list[list[str]]] = {tag: [] for tag in known}
    tails: dict[str, list[str]] = {tag: [] for tag in known}
    lines: dict[str, list[int]] = {tag: [] for tag in known}
    first: dict[int, int] = {}
    for number, line in enumerate(read_text(path).split("\n"), 1):
        line = line.strip()
        if not line or line[0] == "#":
            continue
        tag = line.split(None, 1)[0]
        record = known.get(tag)
        if record is None:
            raise ReadError(path, number, f"a line starting with one of {', '.join(known)}", shorten(tag))
        words = line.split(None, record.head)
        if len(words) != record.head + (record.numbers > 0):
            raise ReadError(path, number, record.layout, shorten(line))
        heads[tag].append(words[1 : record.head])
        tails[tag].append(words[-1])
        lines[tag].append(number)
        first.setdefault(record.dimension, number)
    if not any(lines.values()):
        raise ReadError(path, None, f"at least one line of {', '.join(known)}", "comments only")
    if 2 in first and 3 in first:
        raise ReadError(
            path, max(first[2], first[3]), f"records of one dimension, as in line {min(first[2], first[3])}", "both"
        )
    return {tag: _block(Path(path), record, lines[tag], heads[tag], tails[tag]) for tag, record in known.items()}


def _block(path: Path, record: Record, lines: list[int], heads: list[list[str]], tails: list[str]) -> Block:
    rows = Rows(path, lines, tails if record.numbers else [""] * len(lines))
    time = np.full(len(lines), np.nan)
    if record.timed:
        time = Rows(path, lines, [head[0] for head in heads]).numbers(1, f"time of {record.tag}")[:, 0]
        heads = [head[1:] for head in heads]
    numbers = rows.numbers(record.numbers, record.layout) if record.numbers else np.zeros((len(lines), 0))
    value = numbers[:, : record.value]
    if record.value == 3 and record.dimension == 2:
        value[:, 2] = wrap(value[:, 2])
    if record.value == 7 and record.dimension == 3:
        value[:, 3:] = normalized(rows, value[:, 3:])
    weight = _symmetric(numbers[:, record.value :], record.weight)
    if record.weight:
        require_definite(rows, weight, "matrix")
    return Block(record, rows, heads, time, value, weight)


def normalized(rows: Rows, quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (m, 4) of length one.

    Raises:
        ReadError: a length that rounding in the file does not explain; names the line.
    """
    norm = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~(np.abs(norm - 1) <= QUATERNION_SLACK))
    if bad.size:
        raise rows.error(int(bad[0]), "a quaternion (qx qy qz qw) of length 1", f"length {norm[bad[0]]:.6g}")
    return quaternions / norm[:, None]


def _symmetric(triangle: np.ndarray, size: int) -> np.ndarray:
    full = np.zeros((len(triangle), size, size))
    row, column = np.triu_indices(size)
    full[:, row, column] = triangle
    full[:, column, row] = triangle
    return full


def require_definite(rows: Rows, matrices: np.ndarray, what: str) -> None:
    """Check that symmetric matrices (m, k, k), one per row, are positive definite.

    Raises:
        ReadError: one is not; names its line and smallest eigenvalue.
    """
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        for row, matrix in enumerate(matrices):
            try:
                np.linalg.cholesky(matrix)
            except np.linalg.LinAlgError:
                smallest = np.linalg.eigvalsh(matrix)[0]
                raise rows.error(row, f"a positive definite {what}", f"smallest eigenvalue {smallest:.3g}") from None


def inverse(rows: Rows, matrices: np.ndarray, what: str) -> np.ndarray:
    """Inverses of positive definite matrices (m, k, k), exactly symmetric.

    Raises:
        ReadError: an inverse is not finite or not definite in double precision; names the line.
    """
    with np.errstate(all="ignore"):
        try:
            inverted = np.linalg.inv(matrices)
        except np.linalg.LinAlgError:
            inverted = np.full_like(matrices, np.nan)
            for row, matrix in enumerate(matrices):
                if np.linalg.matrix_rank(matrix) == len(matrix):
                    inverted[row] = np.linalg.inv(matrix)
        inverted = (inverted + inverted.swapaxes(1, 2)) / 2
    good = np.isfinite(inverted).all(axis=(1, 2))
    if not good.all():
        raise rows.error(int(np.flatnonzero(~good)[0]), f"a {what} that can be inverted", "a singular one")
    require_definite(rows, inverted, what)
    return inverted


def numbered(block: Block, taken: dict[str, int], where: dict[str, int], offset: int = 0) -> None:
    """Enter the names a vertex block defines into `taken` (name: node) and their lines into `where`.

    Raises:
        ReadError: a name is defined twice; names both lines.
    """
    for row, (name,) in enumerate(block.keys):
        if name in taken:
            raise block.rows.error(row, "a name not used before", f"{name!r}, also in line {where[name]}")
        taken[name] = offset + row
        where[name] = block.rows.lines[row]


def nodes(block: Block, place: int, known: dict[str, int], what: str) -> np.ndarray:
    """Node indices (m,) of the names at one place of a block.

    Raises:
        ReadError: a name nothing defines.
    """
    try:
        return np.array([known[names[place]] for names in block.keys], dtype=np.intp)
    except KeyError:
        for row, names in enumerate(block.keys):
            if names[place] not in known:
                raise block.rows.error(row, f"the name of a {what} of this file", repr(names[place])) from None
        raise


def require_two_ends(block: Block, first: np.ndarray, second: np.ndarray) -> None:
    """Check that no edge joins a node to itself.

    Raises:
        ReadError: one does; names its line.
    """
    loops = np.flatnonzero(first == second)
    if loops.size:
        row = int(loops[0])
        raise block.rows.error(row, "an edge between two different nodes", f"{block.keys[row][0]!r} twice")


def format_records(
    record: Record, names: Iterable[Sequence[object]], time: np.ndarray, value: np.ndarray, weight: np.ndarray
) -> list[str]:
    """Lines of one record; numbers in the shortest form that reads back the same.

    Raises:
        DataError: a number is not finite.
    """
    if not (np.isfinite(value).all() and np.isfinite(weight).all() and (not record.timed or np.isfinite(time).all())):
        raise DataError(f"{record.tag}: times, values and matrices must be finite to be written")
    row, column = np.triu_indices(record.weight)
    numbers = np.hstack([value, weight[:, row, column]]).tolist() if record.numbers else [[]] * len(value)
    lines = []
    for stamp, keys, tail in zip(time.tolist(), names, numbers, strict=True):
        words = [record.tag] + [repr(stamp)] * record.timed + [str(key) for key in keys]
        lines.append(" ".join(words + [repr(number) for number in tail]))
    return lines
