"""Results of a small benchmark and their report."""

from __future__ import annotations

import html.parser

TOLERANCES = [1e-3, 1e-6, 1e-9]


NASTY = 'diverged: <script>alert("x")</script> & more'


class Page(html.parser.HTMLParser):
    """Tables by caption, and everything a page would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[tuple[str, str | None]]]] = {}
        self.loads: list[str] = []
        self.open: list[str] = []
        self._cells: list[list[tuple[str, str | None]]] = []
        self._text, self._value = "", None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.loads += [str(given[name]) for name in ("src", "href", "xlink:href") if name in given]
        if tag not in ("meta", "link", "input", "br"):
            self.open.append(tag)
        if tag == "tr":
            self._cells.append([])
        if tag in ("td", "caption"):
            self._text, self._value = "", given.get("data-value")
        if tag == "table":
            self._cells = []

    def handle_data(self, data: str) -> None:
        self._text += data

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"unbalanced </{tag}>"
        if tag == "caption":
            self._caption = self._text
        if tag == "td":
            self._cells[-1].append((self._text, self._value))
        if tag == "table":
            self.tables[self._caption] = [row for row in self._cells if row]
