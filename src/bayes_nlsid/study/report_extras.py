"""Sections of the report for the commands beside the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.axes import brief, brief_names, digits_for, engineering
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
            "harmonic balance followed along each curve past its turning points. Whether a motion is stable was found "
            + ("by the growth of disturbances over a period." if summary["stability"] == "multipliers"
               else "from the turning points alone, since forces have memory."))
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


def scatter_section(done: Mapping[str, Saved]) -> str:
    """How the samples were drawn, the ranking, and what the numbers are worth."""
    saved = done.get("montecarlo")
    if saved is None:
        return ""
    s = saved.data["summary"]
    told = [html.paragraph(sentence, "soft") for sentence in scatter_words(s)]
    rows = [[p["name"], *(engineering(p[q], p["unit"], digits_for(p["q05"], p["q95"])) for q in ("q05", "q50", "q95"))]
            for p in s["parameters"]]
    out = html.table(["parameter", "5 %", "50 %", "95 %"], rows, "stages/montecarlo, montecarlo.npz", numeric=(1, 2, 3))
    for name, ranked in s["sensitivity"].items():
        head = [f"scatter of {name} at {engineering(ranked[0]['amplitude_m'], 'm')}", "first-order share", "90 % interval", "total share",
                "90 % interval"] if ranked else []
        out += html.table(head, [[r["name"], *share_cells(r)] for r in ranked], "stages/montecarlo, montecarlo.json", numeric=(1, 2, 3, 4))
        out += html.paragraph(chance_words(ranked), "soft") if chance_words(ranked) else ""
    return "".join(told) + out + html.listing(s["reasons"])


def chance_words(ranked: Sequence[Mapping[str, Any]]) -> str:
    """What an interval of a share that holds zero means; empty if none does."""
    none = [r["name"] for r in ranked if r["total_low"] is not None and r["total_low"] <= 0]
    if not none:
        return ""
    return (f"The intervals of {', '.join(none)} hold zero: with this many samples their share cannot be told from none. A share below "
            "zero is chance, since shares are estimated from differences; more samples narrow it.")


def share_cells(row: Mapping[str, Any]) -> list[str]:
    """First-order and total share with their intervals."""
    out = []
    for kind in ("first", "total"):
        out += [f"{100 * row[kind]:.3g} %", f"{100 * row[f'{kind}_low']:.2g} – {100 * row[f'{kind}_high']:.2g} %"]
    return out


def scatter_words(s: Mapping[str, Any]) -> list[str]:
    """Sentences about samples, paths, errors and convergence."""
    origin = "draws of the posterior" if s["source"] == "posterior" else "samples of independent distributions"
    paths = " and ".join(f"{count} by {'averaging' if name == 'fast' else 'time integration'}" for name, count in s["paths"].items())
    out = [f"{s['samples']} {origin} ({paths}), mode {s['mode']} at {s['at']}; {s['evaluations']} backbones in all."]
    n = s["numerical"]
    if n["frequency_hz"] is not None:
        out.append(f"The computation's own error, on the sample in the middle: {n['frequency_hz']:.1g} Hz and "
                   f"{100 * (n['damping'] or 0):.1g} % of critical damping."
                   + (f" Time integration at {n['fs_hz']:g} Hz: period error {100 * n['period_error']:.2g} %, false damping "
                      f"{100 * n['false_damping']:.2g} %." if "time" in s["paths"] else ""))
    c = s["convergence"]
    if c["frequency"] is not None and c["frequency"] == c["frequency"]:
        out.append(f"Doubling the samples to {c['counts'][-1]} moved the edges of the band by at most {100 * c['frequency']:.2g} % of its "
                   f"width in frequency and {100 * (c['damping'] or 0):.2g} % in damping.")
    if not s["independent"]:
        out.append("Parameters of a posterior depend on each other: shares are those of a regression on the draws, and single parameters "
                   "are swung with all others at their medians.")
    return out


def comparison_section(done: Mapping[str, Saved]) -> str:
    """The sentence and one row for each alternative."""
    saved = done.get("compare")
    if saved is None:
        return ""
    s = saved.data["summary"]
    head = ["alternative", "log density against the best", "standard error", "stacking weight", "error on held-out records",
            "discrepancy learnt", "k-hat"]
    out = html.table(head, comparison_rows(s), f"stages/compare, compare.json; {', '.join(s['records'])}", numeric=(1, 2, 3, 4, 5, 6))
    note = ("Every alternative is simulated on the same held-out records and scored block by block; its own discrepancy, learnt on the "
            "records it was fitted to, is part of its prediction.")
    return html.paragraph(s["sentence"]) + out + html.paragraph(note, "soft") + html.listing(s["reasons"])


def comparison_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """Best first."""
    def number(value: Any, form: str) -> str:
        return "–" if value is None or value != value or abs(value) == float("inf") else format(value, form)

    return [[r["name"], number(r["elpd_difference"], "+.1f"), number(r["elpd_se"], ".1f"), number(r["stacking_weight"], ".2f"),
             number(100 * r["nrmse"], ".3g") + " %", number(100 * r["discrepancy"], ".2g") + " %", number(r["k_hat"], ".2f")]
            for r in summary["alternatives"]]


def _unseen(rows: Sequence[Mapping[str, Any]]) -> str:
    """How far parameters hang on the form of the model."""
    shown = [[name, f"{row['widening']:.2g}", brief(row["force"])]
             for name, row in zip(brief_names([r["parameter"] for r in rows]), rows, strict=True) if row["widening"] > 1.05]
    if not shown:
        return ""
    table = html.table(["parameter", "interval is so many times longer", "if this force were there, too weak to be seen"], shown,
                       "stages/posterior", numeric=(1,))
    return html.details("Intervals are given the form of the model: what a force that the tests cannot see would do", table)


def stages_section(data: Mapping[str, Any], parameters: Sequence[Mapping[str, Any]]) -> str:
    """Regression and simulation beside each other, and the tests of the simulated recordings."""
    second = data.get("second_stage")
    if not second:
        return html.paragraph(f"Posterior of the {data.get('stage', 'regression')} alone: {data.get('stage_why', '')}.", "soft")
    moved = {row["name"]: row for row in second.get("against_regression") or []}
    rows = []
    for p, name in zip(parameters, brief_names([p["name"] for p in parameters]), strict=True):
        if "regression" not in p or p["name"] not in moved:
            continue
        r = p["regression"]
        digits = digits_for(p["q05"], p["q95"])
        rows.append([name, *(f"{engineering(x['q05'], p['unit'], digits)} – {engineering(x['q95'], p['unit'], digits)}" for x in (r, p)),
                     f"{moved[p['name']]['shift_sd']:+.2g}", f"{moved[p['name']]['width_ratio']:.2g}"])
    head = ["parameter", "regression, 5–95 %", "simulation, 5–95 %", "median moves (sd of regression)", "width over regression"]
    out = html.table(head, rows, "stages/posterior", numeric=(1, 2, 3, 4)) if rows else ""
    misfit = second.get("misfit")
    if misfit:
        ratio = "–" if misfit["innovation"] is None else f"{misfit['innovation']:.3g} (99.9 % limit {misfit['innovation_limit']:.3g})"
        facts = [["error variance over measured sensor noise", ratio],
                 ["log of unmeasured force over sensor noise (limit 3)", f"{misfit['log_unmeasured_force']:.2g}"],
                 *([f"score of {s['force']} (limit 4)", f"{s['z']:+.2g}"] for s in misfit["scores"][:3])]
        out += html.table(["does the model explain the recordings?", "no" if misfit["found"] else "yes"], facts, "stages/posterior")
        out += html.listing([*misfit["reasons"], *misfit["notes"]])
        out += _unseen(misfit.get("unseen", []))
    if "k_hat" in second:
        out += html.paragraph(f"{second['simulated']} draws were simulated and weighted; k-hat {second['k_hat']:.2f} (limit 0.7), "
                              f"{second['effective']:.0f} effective.", "soft")
    return out
