"""Text files taken apart into rows that know their line number, so that every complaint can name it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from problems.errors import ReadError

LATEST_STAMP = 2**62
"""Nanosecond stamps from here on (year 2116) are refused: differences of smaller ones never overflow int64."""

LARGEST_NUMBER = 1e100
"""No quantity of a recording is larger; beyond it squares and inverses would overflow silently."""

_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|inf|nan)", re.ASCII | re.IGNORECASE)


def shorten(text: str) -> str:
    """`text` quoted for an error message, cut to a readable length."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def read_text(path: str | Path) -> str:
    """Content of a UTF-8 text file.

    Raises:
        ReadError: there is no such file, it cannot be read, is empty, or is not text (the line is named).
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise ReadError(path, None, "an existing file", "no such file") from None
    except OSError as error:
        raise ReadError(path, None, "a readable file", error.strerror) from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ReadError(path, line, "UTF-8 text", f"byte {content[error.start]:#04x}") from None
    if not text.strip():
        raise ReadError(path, None, "at least one row", "an empty file")
    return text


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of numbers of one file, still as text.

    Attributes:
        path: the file.
        lines: line number of each row, counted from one.
        texts: the numbers of each row.
        delimiter: between two numbers; None is any white space.
    """

    path: Path
    lines: Sequence[int]
    texts: Sequence[str]
    delimiter: str | None = None

    def __len__(self) -> int:
        return len(self.texts)

    def error(self, row: int, expected: str, found: str | None = None) -> ReadError:
        """The error to raise about one row."""
        return ReadError(self.path, self.lines[row], expected, found)

    def numbers(self, columns: int, layout: str, *, missing: bool = False) -> np.ndarray:
        """All rows as an array (rows, columns).

        Args:
            columns: how many numbers a row must have.
            layout: what the numbers are, for the message.
            missing: whether NaN or an empty field may stand for a missing number.

        Raises:
            ReadError: another count of numbers, no number, one beyond `LARGEST_NUMBER`, or a NaN not allowed.
        """
        if not self.texts:
            return np.zeros((0, columns))
        values = None
        if any(self.texts):
            try:
                values = np.loadtxt(self.texts, delimiter=self.delimiter, comments=None, ndmin=2)
            except ValueError:
                pass  # the slow way below says which row
        if values is None or values.shape != (len(self), columns):
            values = self._numbers_one_by_one(columns, layout, missing)
        good = np.abs(values) < LARGEST_NUMBER
        if missing:
            good |= np.isnan(values)
        if not good.all():
            row, column = (int(k) for k in np.argwhere(~good)[0])
            raise self.error(row, f"finite numbers ({layout})", f"{values[row, column]} in column {column + 1} of them")
        return values

    def _numbers_one_by_one(self, columns: int, layout: str, missing: bool) -> np.ndarray:
        values = np.empty((len(self), columns))
        for row, text in enumerate(self.texts):
            tokens = [token.strip() for token in text.split(self.delimiter)]
            if len(tokens) != columns:
                raise self.error(row, f"{columns} numbers ({layout})", f"{len(tokens)}: {shorten(text)}")
            for column, token in enumerate(tokens):
                if not token and missing:
                    values[row, column] = np.nan
                elif not _NUMBER.fullmatch(token):
                    raise self.error(row, f"a number ({layout})", shorten(token))
                else:
                    values[row, column] = float(token)
        return values


def data_rows(path: str | Path) -> Rows:
    """Rows of a file of white-space separated numbers with ``#`` comment lines.

    Raises:
        ReadError: as `read_text`; or there are comments only.
    """
    stripped = [line.strip() for line in read_text(path).split("\n")]
    kept = [number for number, line in enumerate(stripped, 1) if line and line[0] != "#"]
    if not kept:
        raise ReadError(path, None, "at least one row of data", "comments only")
    return Rows(Path(path), kept, [stripped[number - 1] for number in kept])


class Csv:
    """A comma-separated file with a header line, read by column names.

    Args:
        path: the file.
        required: names the header must hold.

    Raises:
        ReadError: as `read_text`; a name is missing, there is no row, or a row has another count of fields.
    """

    def __init__(self, path: str | Path, required: Sequence[str]) -> None:
        self.path = Path(path)
        text = [line.strip() for line in read_text(path).split("\n")]
        self.header = [name.strip() for name in text[0].split(",")]
        for name in required:
            if name not in self.header:
                raise ReadError(path, 1, f"a header with the column {name!r}", shorten(text[0]))
        self._lines = [number for number, line in enumerate(text[1:], 2) if line]
        self._fields = [text[number - 1].split(",") for number in self._lines]
        if not self._fields:
            raise ReadError(path, None, "at least one row below the header", "a header only")
        for line, fields in zip(self._lines, self._fields, strict=True):
            if len(fields) != len(self.header):
                raise ReadError(path, line, f"{len(self.header)} fields, as in the header", f"{len(fields)}")

    def __len__(self) -> int:
        return len(self._lines)

    def error(self, row: int, expected: str, found: str | None = None) -> ReadError:
        """The error to raise about one row."""
        return ReadError(self.path, self._lines[row], expected, found)

    def texts(self, name: str) -> list[str]:
        """One column as text."""
        column = self.header.index(name)
        return [fields[column].strip() for fields in self._fields]

    def numbers(self, *names: str, missing: bool = False) -> np.ndarray:
        """Columns as an array (rows, columns); see `Rows.numbers`."""
        columns = [self.header.index(name) for name in names]
        texts = [",".join([fields[k] for k in columns]) for fields in self._fields]
        return Rows(self.path, self._lines, texts, ",").numbers(len(names), ", ".join(names), missing=missing)

    def nanoseconds(self, name: str) -> np.ndarray:
        """A column of stamps as int64 nanoseconds, exactly; floating text such as ``1.73e18`` is accepted.

        Raises:
            ReadError: no number, negative, or beyond `LATEST_STAMP`.
        """
        texts = self.texts(name)
        stamps = []
        for row, text in enumerate(texts):
            try:
                stamp = Decimal(text) if _NUMBER.fullmatch(text) else Decimal("nan")
            except InvalidOperation:
                stamp = Decimal("nan")
            if not (stamp.is_finite() and 0 <= stamp < LATEST_STAMP):
                raise self.error(row, f"a stamp in nanoseconds ({name})", shorten(text))
            stamps.append(int(stamp))
        return np.array(stamps, dtype=np.int64)

    def rows(self, selection: np.ndarray) -> Rows:
        """Some rows, for checks that name a line."""
        lines = [self._lines[row] for row in selection]
        return Rows(self.path, lines, [",".join(self._fields[row]) for row in selection], ",")
