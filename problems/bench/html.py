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


LONG = 60  # lines of a table that a browser lays out when it comes into view


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
    """A command line with a button that copies it; long ones are cut on the screen, not in what is copied."""
    return Cell(f'<button type="button" class="copy">copy</button><code>{escape(command)}</code>')


def table(
    caption: str, head: Sequence[str], rows: Sequence[tuple[Mapping[str, str], Sequence[Cell]]], note: str = ""
) -> str:
    """A table sorted by a click on its heads.

    Args:
        caption: what it shows.
        head: names of the columns.
        rows: attributes and cells of each row.
        note: printed above it.
    """
    kind = "scroll long" if len(rows) > LONG else "scroll"
    before = f"<p>{escape(note)}</p>" if note else ""
    heads = "".join(f'<th scope="col"><button type="button">{escape(name)}</button></th>' for name in head)
    body = "\n".join(f"<tr{_attributes(attributes)}>{''.join(map(str, cells))}</tr>" for attributes, cells in rows)
    return (
        f'{before}<div class="{kind}" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{heads}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f' {name}="{escape(value)}"' for name, value in values.items())


def marks(summary: Summary) -> dict[str, str]:
    """Attributes by which the filters of the page find what belongs to a method and solver."""
    return {"data-method": summary.method, "data-solver": summary.solver}


@dataclass(frozen=True)
class Group:
    """What an SVG group of a picture stands for.

    Attributes:
        attributes: for the filters.
        hovers: text of each point, in the order they are drawn; empty for groups without.
    """

    attributes: Mapping[str, str]
    hovers: Sequence[str] = ()


def picture(figure: Figure, caption: str, prefix: str, groups: Sequence[Group]) -> str:
    """A figure as SVG inside the page.

    Args:
        figure: with artists whose gid is ``{prefix}-{part}-{number}``; points of the part ``points`` are markers.
        caption: what it shows, also for those who cannot see it.
        prefix: unique in the page.
        groups: by number.
    """
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]

    def mark(found: re.Match[str]) -> str:
        group = groups[int(found[2])]
        return f"<g{_attributes(group.attributes)}>" + (
            _with_hovers(found[3], group.hovers) if found[1] == "points" else found[3]
        )

    svg = re.sub(rf'<g id="{re.escape(prefix)}-(\w+)-(\d+)">(.*?)(?=<g id=|\Z)', mark, svg, flags=re.DOTALL)
    referenced = set(re.findall(r"#([\w-]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in referenced else "", svg)
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1)
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def _with_hovers(svg: str, hovers: Sequence[str]) -> str:
    texts = iter(hovers)
    return re.sub(
        r"<use ([^>]*?)/>",
        lambda use: f'<use class="point" {use[1]}><title>{escape(next(texts))}</title></use>',
        svg,
    )


def prose(text: str) -> str:
    """A page of text: paragraphs, ``## `` headings and ``- `` lists apart by empty lines, `code` between backticks."""
    parts = []
    for block in text.strip().split("\n\n"):
        if block.startswith("## "):
            parts.append(f"<h3>{_inline(block[3:])}</h3>")
        elif block.startswith("- "):
            items = "".join(f"<li>{_inline(item)}</li>" for item in re.split(r"(?:\A|\n)- ", block)[1:])
            parts.append(f"<ul>{items}</ul>")
        elif block.strip():
            parts.append(f"<p>{_inline(block)}</p>")
    return "\n".join(parts)


def _inline(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(" ".join(text.split())))
