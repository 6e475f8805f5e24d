"""Tables and figures that show themselves in a terminal and in Jupyter."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 60  # rows of a table; what follows is counted


class Table:
    """A captioned table that shows itself in both places.

    Args:
        caption: what it shows.
        head: names of the columns.
        rows: cells, as text or numbers.
    """

    def __init__(self, caption: str, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        self.caption, self.head = caption, tuple(head)
        self.rows = [tuple(shown(cell) for cell in row) for row in rows[:LONGEST]]
        if len(rows) > LONGEST:
            self.rows.append((f"and {len(rows) - LONGEST} more", *[""] * (len(self.head) - 1)))

    def __str__(self) -> str:
        lines = [self.head, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.head))]
        body = [
            "  " + "  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines
        ]
        return "\n".join([self.caption, *body])

    def _repr_html_(self) -> str:
        head = "".join(f'<th style="text-align:left">{escape(name)}</th>' for name in self.head)
        body = "".join(
            "<tr>" + "".join(f'<td style="text-align:left">{escape(cell)}</td>' for cell in row) + "</tr>"
            for row in self.rows
        )
        caption = f'<caption style="text-align:left;font-weight:bold">{escape(self.caption)}</caption>'
        return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

    def __repr__(self) -> str:
        return str(self)


def shown(value: Any) -> str:
    """A cell's text: arrays shortened, numbers to six digits."""
    if isinstance(value, np.ndarray):
        return np.array2string(value, precision=4, suppress_small=True, threshold=8, separator=" ").replace("\n", "")
    if isinstance(value, (float, np.floating)):
        return f"{value:.6g}"
    return "" if value is None else str(value)


def new_figure(**options: Any) -> Figure:
    """An empty ``matplotlib.figure.Figure``, outside of pyplot's bookkeeping.

    Args:
        options: of the figure.
    """
    if "ipykernel" in sys.modules:
        import matplotlib.pyplot as plt

        plt.switch_backend(plt.get_backend())  # only this registers how a notebook shows figures
    from matplotlib.figure import Figure

    return Figure(**options)
