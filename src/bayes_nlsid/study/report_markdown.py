"""A page of ours as Markdown: the same sentences, tables and figures, the figures as links to their files."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import final

_SKIPPED = ("style", "title", "nav")
_BLOCKS = ("p", "h1", "h2", "li", "summary", "figcaption", "caption", "td", "th", "pre")
_SPECIAL = re.compile(r"([\\`*\[\]<>|#]|(?<!\w)_|_(?!\w))")
_FILE = re.compile(r"figures/\S+?\.png")


def markdown(page: str) -> str:
    """What `report_page.page` made, as Markdown (CommonMark with pipe tables).

    Parameters
    ----------
    page : str
        HTML.

    Returns
    -------
    str
        Ends with a new line. Images are links into ``figures/``, as their captions say.
    """
    reader = _Reader()
    reader.feed(page)
    reader.close()
    return re.sub(r"\n{3,}", "\n\n", "\n\n".join(reader.parts)).strip() + "\n"


def _plain(text: str) -> str:
    """Text on one line with the signs of Markdown made harmless."""
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))


@final
class _Reader(HTMLParser):
    """Collects blocks as they end; a table is collected row by row and written as a whole."""

    def __init__(self) -> None:
        super().__init__()
        self.parts: list[str] = []
        self._text: list[str] = []
        self._skipping = 0
        self._rows: list[list[str]] = []
        self._row: list[str] = []
        self._right: set[int] = set()
        self._caption = ""
        self._image = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag in _SKIPPED:
            self._skipping += 1
        elif tag in _BLOCKS:
            self._text = []
        if tag == "tr":
            self._row = []
        elif tag == "th" and given.get("class") == "n":
            self._right.add(len(self._row))
        elif tag == "table":
            self._rows, self._right, self._caption = [], set(), ""
        elif tag == "img":
            self._image = given.get("alt") or "figure"

    def handle_data(self, data: str) -> None:
        if not self._skipping:
            self._text.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag in _SKIPPED:
            self._skipping -= 1
        if tag == "table":
            self._table()
        elif tag == "tr":
            self._rows.append(self._row)
        elif tag in _BLOCKS:
            self._block(tag, "".join(self._text))
            self._text = []

    def _block(self, tag: str, text: str) -> None:
        """One finished paragraph, heading, cell or caption."""
        if tag in ("td", "th"):
            self._row.append(_plain(text))
        elif tag == "caption":
            self._caption = _plain(text)
        elif tag == "pre":
            fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
            self.parts.append(f"{fence}\n{text.rstrip()}\n{fence}")
        elif tag == "figcaption":
            file = _FILE.search(text)
            self.parts.append((f"![{_plain(self._image)}](<{file.group()}>)\n\n" if file else "") + f"*{_plain(text)}*")
        elif tag == "li" and self.parts and self.parts[-1].startswith("- "):
            self.parts[-1] += f"\n- {_plain(text)}"
        elif text.strip():
            before = {"h1": "# ", "h2": "## ", "li": "- ", "summary": "### "}.get(tag, "")
            self.parts.append(before + _plain(text))

    def _table(self) -> None:
        """All rows, the first as the head, and the source below."""
        if not self._rows:
            return
        head, *rows = self._rows
        rule = ["---:" if i in self._right else "---" for i in range(len(head))]
        lines = [f"| {' | '.join(row)} |" for row in (head, rule, *rows)]
        self.parts.append("\n".join(lines) + (f"\n\n*{self._caption}*" if self._caption else ""))
