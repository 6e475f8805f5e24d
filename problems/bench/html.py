"""Pieces of a report page: tables that sort, pictures whose points can be filtered."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from problems.bench.summary import Summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Cell:
    """A table cell.

    Attributes:
        html: what is shown.
        value: what a number sorts by; None for text.
        missing: a number that has no value.
        wrap: long text.
    """

    html: str
    value: float | None = None
    missing: bool = False
    wrap: bool = False

    def __str__(self) -> str:
        if self.value is not None or self.missing:
            return f'<td class="number" data-value="{"" if self.value is None else repr(self.value)}">{self.html}</td>'
        return f"<td{' class=wrap' if self.wrap else ''}>{self.html}</td>"


def text_cell(text: str, wrap: bool = False) -> Cell:
    """Plain text."""
    return Cell(escape(text), wrap=wrap)


def number_cell(shown: str, value: float | None) -> Cell:
    """A number as shown and as sorted."""
    return Cell(escape(shown), value, missing=value is None)


def command_cell(command: str) -> Cell:
    """A command line with a button that copies it."""
    return Cell(f'<code>{escape(command)}</code><button type="button" class="copy">copy</button>')


def table(caption: str, head: Sequence[str], rows: Sequence[tuple[Mapping[str, str], Sequence[Cell]]]) -> str:
    """A table sorted by a click on its heads.

    Args:
        caption: what it shows.
        head: names of the columns.
        rows: attributes and cells of each row.
    """
    heads = "".join(f'<th scope="col"><button type="button">{escape(name)}</button></th>' for name in head)
    body = "\n".join(f"<tr{_attributes(attributes)}>{''.join(map(str, cells))}</tr>" for attributes, cells in rows)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{heads}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f' {name}="{escape(value)}"' for name, value in values.items())


def marks(summary: Summary) -> dict[str, str]:
    """Attributes by which the filters of the page find what belongs to a method and solver."""
    return {"data-method": summary.method, "data-solver": summary.solver}


def picture(figure: Figure, caption: str, prefix: str = "", points: Sequence[tuple[Summary, str]] = ()) -> str:
    """A figure as SVG inside the page.

    Args:
        figure: with groups named as `problems.bench.plots.accuracy_against_time` does.
        caption: what it shows, also for those who cannot see it.
        prefix: of those groups.
        points: the summary of each point and the text shown on hovering over it.
    """
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix or caption}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]

    def mark(found: re.Match[str]) -> str:
        summary, hover = points[int(found[2])]
        title = f"<title>{escape(hover)}</title>" if found[1] == "point" else ""
        return f"<g{_attributes(marks(summary))}>{title}"

    svg = re.sub(rf'<g id="{re.escape(prefix)}-(point|line)-(\d+)">', mark, svg)
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1)
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"
