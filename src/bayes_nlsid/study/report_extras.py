"""Sections of the report for the commands beside the run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.axes import digits_for, engineering
from bayes_nlsid.study.store import Saved


def response_section(done: Mapping[str, Saved]) -> str:
    """Peaks of the response curves as a table."""
    saved = done.get("frf")
    if saved is None:
        return ""
    summary = saved.data["summary"]
    head = ["force", "peak at (Hz)", "5–95 %", f"amplitude at {summary['output']}", "5–95 %", "more harmonics would change"]
    out = html.table(head, response_rows(summary), "stages/frf, frf.npz", numeric=(0, 1, 2, 3, 4, 5))
    said = (f"A sine force at {summary['input']}, {summary['samples']} draws of the posterior, harmonics up to {summary['harmonics']}; "
            "harmonic balance followed along each curve past its turning points.")
    return html.paragraph(said, "soft") + out + html.listing(summary["reasons"])


def response_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """One row for each level of the force."""
    rows = []
    for peak in summary["peaks"]:
        cells = [engineering(peak["level"], "N")]
        for name, unit in (("frequency", ""), ("amplitude", "m")):
            if peak[f"{name}_q50"] is None or peak[f"{name}_q50"] != peak[f"{name}_q50"]:
                cells += ["–", "–"]
                continue
            low, middle, high = (peak[f"{name}_{q}"] for q in ("q05", "q50", "q95"))
            digits = digits_for(low, high)
            cells += [engineering(middle, unit, digits), f"{engineering(low, unit, digits)} – {engineering(high, unit, digits)}"]
        error = peak["harmonic_error"]
        rows.append([*cells, "–" if error is None or error != error else f"{100 * error:.2g} %"])
    return rows
