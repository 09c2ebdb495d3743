"""The look of the report: one style sheet, and small makers of HTML."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

STYLE = """
:root { --ink: #1b1f24; --soft: #57606a; --line: #d8dee4; --page: #ffffff; --tint: #f3f6f9;
        --accent: #0072B2; --good: #007a56; --bad: #b3480a; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --soft: #9aa4ae; --line: #333b44; --page: #14181d; --tint: #1d232a;
          --accent: #63b3e4; --good: #4cc79c; --bad: #f0935a; }
  figure img { filter: brightness(.93); border-radius: 4px; }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--page); color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 1.2rem 1rem 4rem; }
h1 { font-size: 1.65rem; line-height: 1.2; margin: .4rem 0 .3rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .6rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line); }
p, li { max-width: 46rem; }
.soft { color: var(--soft); font-size: .88rem; }
.story { background: var(--tint); border-left: 4px solid var(--accent); padding: .8rem 1.1rem; margin: 1rem 0; border-radius: 0 6px 6px 0; }
.story p { margin: .45rem 0; }
.badge { display: inline-block; padding: .1rem .6rem; border-radius: 1rem;
          font-weight: 600; font-size: .9rem; border: 1.5px solid currentColor; }
.ok { color: var(--good); } .warn { color: var(--bad); }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1rem; font-size: .92rem; margin: .8rem 0; }
a { color: var(--accent); }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; min-width: 24rem; }
th, td { text-align: left; padding: .28rem .75rem .28rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; }
td.n, th.n { text-align: right; white-space: nowrap; }
caption { caption-side: bottom; text-align: left; color: var(--soft); font-size: .84rem; padding-top: .35rem; }
figure { margin: 1.1rem 0 1.6rem; }
figure .scroll { margin: 0; }
figure img { display: block; width: 100%; min-width: 34rem; height: auto; background: white; }
figcaption { color: var(--soft); font-size: .88rem; margin-top: .4rem; max-width: 46rem; }
code, pre { font-family: ui-monospace, Consolas, monospace; font-size: .85em; }
pre { background: var(--tint); padding: .8rem; overflow-x: auto; border-radius: 6px; }
details summary { cursor: pointer; color: var(--accent); overflow-wrap: anywhere; }
p, li, figcaption, h1, h2, nav { overflow-wrap: anywhere; }
td.long { min-width: 13rem; }
td.hash { font-family: ui-monospace, Consolas, monospace; font-size: .8em; word-break: break-all; }
@media print {
  :root { --ink: #1b1f24; --soft: #57606a; --line: #d8dee4; --page: #ffffff; --tint: #f3f6f9; --accent: #0072B2; --good: #007a56;
          --bad: #b3480a; }
  body { font-size: 10.5pt; } main { max-width: none; padding: 0; } nav { display: none; }
  figure, tr, .story { break-inside: avoid; } h2, summary { break-after: avoid; }
  details::details-content { content-visibility: visible; display: block; }
  figure img { min-width: 0; filter: none; }
  .scroll { overflow: visible; } table { font-size: 8pt; min-width: 0; max-width: 100%; }
  th, td { padding-right: .5rem; } td.n, th.n { white-space: normal; } td.long { min-width: 0; }
  th, td, pre { overflow-wrap: anywhere; } pre { white-space: pre-wrap; font-size: 7.5pt; }
}
"""


ALONE = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Told to the browser: it may load nothing but what stands in the page, and run no script."""


def page(title: str, body: str) -> str:
    """A whole page without any outside resource."""
    return (f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, '
            f'initial-scale=1">'
            f'<meta http-equiv="Content-Security-Policy" content="{ALONE}">'
            f'<meta name="color-scheme" content="light dark"><title>{escape(title)}</title><style>{STYLE}</style></head>\n'
            f"<body><main>\n{body}\n</main></body></html>\n")


def paragraph(text: str, kind: str = "") -> str:
    """Plain text as a paragraph."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def listing(items: Sequence[str]) -> str:
    """Plain texts as a list; nothing for none."""
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>" if items else ""


def details(summary: str, content: str) -> str:
    """HTML that opens on demand under a line of plain text."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], source: str, numeric: Sequence[int] = (), hashes: Sequence[int] = ()) -> str:
    """A table with its source below; ``numeric`` columns are set to the right. It scrolls by itself on a narrow screen."""
    if not rows:
        return ""
    wordy = [i for i in range(len(head)) if max(len(row[i]) for row in rows) > 40]  # kept readable where the table has to scroll

    def mark(i: int) -> str:
        return ' class="n"' if i in numeric else ' class="hash"' if i in hashes else ' class="long"' if i in wordy else ""
    caption = f"<caption>from {escape(source)}</caption>"
    top = "".join(f"<th{mark(i) if i in numeric else ''}>{escape(text)}</th>" for i, text in enumerate(head))
    body = "".join("<tr>" + "".join(f"<td{mark(i)}>{escape(cell)}</td>" for i, cell in enumerate(row)) + "</tr>" for row in rows)
    return f'<div class="scroll"><table>{caption}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def picture(png: bytes, caption: str, source: str, alternative: str) -> str:
    """A figure with the image inside the page."""
    data = base64.b64encode(png).decode("ascii")
    return (f'<figure><div class="scroll"><img alt="{escape(alternative)}" src="data:image/png;base64,{data}"></div>'
            f"<figcaption>{escape(caption)} <span>(from {escape(source)})</span></figcaption></figure>")
