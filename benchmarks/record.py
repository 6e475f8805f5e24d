"""Rows of the table that the benchmarks end with: each is appended to a file when it is measured.

``make bench`` starts the file anew and makes the table of it; a benchmark run alone replaces its own rows.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

FILE = Path(os.environ.get("HORIZONET_BENCH") or Path(__file__).resolve().parents[1] / "build" / "benchmarks.jsonl")


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        measure: what was measured, and `peer` beside whom; "" where ours stands alone.
        ours, theirs: medians in `unit`; `theirs` is None where the peer was not compared, and `note` says why.
        low, high: of the ratio theirs / ours over repetitions or blocks.
        wanted: the target: of the ratio, at least; of `ours`, at most, where there is no peer.
        compiled, compiled_theirs: s, done once before what is timed; None where it is part of it.
    """

    measure: str
    peer: str
    ours: float
    theirs: float | None = None
    unit: str = "s"
    low: float | None = None
    high: float | None = None
    wanted: float | None = None
    compiled: float | None = None
    compiled_theirs: float | None = None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        return None if self.theirs is None else self.theirs / self.ours

    @property
    def reached(self) -> bool | None:
        """Whether the target is met; None where there is none, or nothing to compare with."""
        if self.wanted is None or (self.peer and self.ratio is None):
            return None
        return self.ours <= self.wanted if self.ratio is None else self.ratio >= self.wanted


def record(row: Row) -> None:
    """Append a row."""
    FILE.parent.mkdir(parents=True, exist_ok=True)
    with FILE.open("a") as file:
        file.write(json.dumps(asdict(row)) + "\n")


def compared(
    measure: str,
    peer: str,
    ours: list[float] | np.ndarray,
    theirs: list[float] | np.ndarray,
    *,
    block: int = 1,
    wanted: float | None = None,
    compiled: tuple[float | None, float | None] = (None, None),
    note: str = "",
) -> Row:
    """Row of two series of times (s) taken in turns; the spread is that of the ratios of medians of blocks."""
    first, second = np.asarray(ours), np.asarray(theirs)
    count = min(len(first), len(second)) // block
    middles = [np.median(part[: count * block].reshape(count, block), axis=1) for part in (first, second)]
    ratios = middles[1] / middles[0]
    row = Row(
        measure,
        peer,
        float(np.median(first)),
        float(np.median(second)),
        low=float(ratios.min()),
        high=float(ratios.max()),
        wanted=wanted,
        compiled=compiled[0],
        compiled_theirs=compiled[1],
        note=note,
    )
    record(row)
    return row


def rows() -> list[Row]:
    """All rows recorded, the last of each measure and peer."""
    found: dict[tuple[str, str], Row] = {}
    for line in FILE.read_text().splitlines() if FILE.exists() else []:
        row = Row(**json.loads(line))
        found[row.measure, row.peer] = row
    return list(found.values())
