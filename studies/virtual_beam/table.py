"""One table for the whole study: what the paper prints, what is found here, and the band the paper does not have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One line; all cells are text."""

    part: str
    what: str
    paper: str
    here: str
    band: str = ""


def span(low: float, high: float, form: str = "{:.4g}") -> str:
    """A band as text."""
    return f"{form.format(low)} – {form.format(high)}"


def write(rows: Sequence[Row], notes: Sequence[str], path: Path) -> None:
    """Markdown, one section for each part in the order of the rows."""
    lines = ["# The paper's virtual beam: paper, here, band", "", *[f"- {note}" for note in notes]]
    for part in dict.fromkeys(row.part for row in rows):
        lines += ["", f"## {part}", "", "| | paper | here | band |", "|---|---|---|---|"]
        lines += [f"| {r.what} | {r.paper} | {r.here} | {r.band} |" for r in rows if r.part == part]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
