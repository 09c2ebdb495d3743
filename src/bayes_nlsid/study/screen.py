"""Text for the terminal: the plan of a study, its results on one screen, the library as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayes_nlsid.study.axes import brief, brief_names, digits_for, engineering, floor_text, percent
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.stage_read import told
from bayes_nlsid.study.story import doubts, found_words, status_words

WIDTH = 100


def columns(head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """A table in plain text."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]

    def line(cells: Sequence[str]) -> str:
        return "  ".join(c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(cells, widths, strict=True))).rstrip()

    return "\n".join([line(head), line(["-" * w for w in widths]), *map(line, rows)])


def _wrapped(text: str) -> str:
    from textwrap import fill

    return fill(text, WIDTH, subsequent_indent="    " if text.startswith("  ") else "")


def summary(result: Mapping[str, Any], out: Path) -> str:
    """One screen: which force laws were found, parameters with 5/50/95 %, convergence, held-out error, files."""
    parts = [_wrapped(f"{result['title']}: {status_words(result)}")]
    parts += [_wrapped(f"  reason: {brief(reason)}") for reason in result["reasons"][:4]]
    if result.get("selection") is not None:
        parts.append(_wrapped(f"  found: {brief(found_words(result))}"))
    rows = []
    parameters = result.get("parameters", [])
    for p, name in zip(parameters, brief_names([p["name"] for p in parameters]), strict=True):
        digits = digits_for(p["q05"], p["q95"]) if p.get("q05") is not None else 4
        quantiles = [engineering(p[q], p["unit"], digits) if p.get(q) is not None else "-" for q in ("q05", "q50", "q95")]
        fitted = engineering(p["fit"], p["unit"], digits) if p["fit"] is not None else "-"
        rows.append([name, fitted, *quantiles, "" if p.get("identifiable", True) else "not identifiable"])
    if rows:
        shown = rows[:16] + ([[f"... {len(rows) - 16} more in result.json", "", "", "", "", ""]] if len(rows) > 16 else [])
        parts.append("\n" + columns(["parameter", "fit", "5 %", "50 %", "95 %", ""], shown, right=(1, 2, 3, 4)))
    c = result.get("convergence")
    if c:
        rhat = "-" if c["rhat_max"] is None else f"{c['rhat_max']:.3f}"
        ess = "-" if c["ess_min"] is None else f"{c['ess_min']:.0f}"
        parts.append(f"\nsampler: {c['ensembles']} ensembles x {c['steps']} steps, {'converged' if c['converged'] else 'NOT converged'}, "
                     f"R-hat {rhat}, effective draws {ess}, walkers re-drawn or stuck {c['stuck_walkers']}")
    h = result.get("heldout") or {}
    if h.get("nrmse") is not None:
        parts.append(f"held out ({', '.join(h['records'])}): NRMSE {percent(h['nrmse'])}, noise floor {floor_text(h)}"
                     + (f", 90 % band covers {100 * h['coverage90']:.0f} %" if h.get("coverage90") is not None else ""))
    parts += _beware(result)
    files = ", ".join(name for name in ("report.html", "result.json", "posterior.nc", "backbone.npz", "figures/", "run.log")
                      if (out / name).exists())
    return "\n".join([*parts, f"\nin {out}: {files}"])


def extra_summary(name: str, result: Mapping[str, Any], out: Path) -> str:
    """One screen for a command beside the run."""
    from bayes_nlsid.study.report_extras import comparison_rows, response_rows, scatter_words, share_cells

    found = result[name]
    parts = [f"{result['title']}: {'done' if found['status'] == 'ok' else found['status']}"]
    parts += [_wrapped(f"  {reason}") for reason in found["reasons"][:4]]
    if name == "montecarlo":
        parts += ["", *map(_wrapped, scatter_words(found))]
        for what, ranked in found["sensitivity"].items():
            at = engineering(ranked[0]["amplitude_m"], "m") if ranked else ""
            rows = [[n, *share_cells(r)] for n, r in zip(brief_names([r["name"] for r in ranked]), ranked, strict=True)][:8]
            parts.append("\n" + columns([f"scatter of {what} at {at}", "first order", "90 %", "total", "90 %"], rows, right=(1, 2, 3, 4)))
        return "\n".join([*parts, f"\nin {out}: report.html, montecarlo.npz, montecarlo.json, figures/"])
    if name == "compare":
        head = ["alternative", "log density", "se", "weight", "error", "discrepancy", "k-hat"]
        parts.append("\n" + columns(head, comparison_rows(found), right=(1, 2, 3, 4, 5, 6)) + "\n\n" + _wrapped(found["sentence"]))
        return "\n".join([*parts, f"\nin {out}: report.html, compare.json, compare.npz, compare_<k>.nc"])
    head = ["force", "peak (Hz)", "5-95 %", f"amplitude at {found['output']}", "5-95 %", "harmonics"]
    parts.append("\n" + columns(head, response_rows(found), right=(0, 1, 2, 3, 4, 5)))
    return "\n".join([*parts, f"\nin {out}: report.html, {name}.npz, result.json, figures/"])


def _beware(result: Mapping[str, Any], most: int = 4) -> list[str]:
    said = doubts(result)
    more = [f"  ... and {len(said) - most} more in the report"] if len(said) > most else []
    return [_wrapped(f"  beware: {text}") for text in said[:most]] + more


def plan(study: Study, recordings: Sequence[Mapping[str, Any]]) -> str:
    """What a run would do.

    Parameters
    ----------
    study : Study
    recordings : sequence of dict
        As `checking.examine` gives them.
    """
    parts = [f"{study.title} ({study.file.name}): everything it names is there and readable.", ""]
    rows = [[r.name, r.role, Path(r.file).name, ", ".join(c.name for c in r.channels),
             "whole file" if r.window is None else f"{r.window[0]:g}-{r.window[1]:g} s",
             f"{found['seconds']:.4g} s", f"{found['rate']:.6g} Hz"]
            for r, found in zip(study.recordings, recordings, strict=True)]
    parts.append(columns(["recording", "role", "file", "channels", "window", "length", "rate"], rows, right=(5, 6)))
    parts += [_wrapped(f"{f['severity']}: {told(r['name'], f)}") for r in recordings for f in r["findings"]]
    parts += ["", "stages: " + " -> ".join(study.stages)]
    parts.append(_wrapped(f"structure: {study.structure.kind}, locations {', '.join(study.locations)}"))
    entry = study.identification
    if entry is not None:
        what = f"{len(entry.candidates)} candidate terms at {', '.join(entry.joints)}" if entry.candidates else "known form " + "; ".join(
            f"{e.term} at {', '.join(e.locations)}" for e in entry.elements)
        parts.append(_wrapped(f"identification: scenario {entry.scenario}, modes {', '.join(map(str, entry.modes))}, {what}"))
        parts += [_wrapped(f"  beside it: {a.name}, {len(a.candidates)} candidate terms") for a in entry.alternatives]
    if study.posterior is not None:
        length = "until converged" if study.posterior.steps is None else f"{study.posterior.steps} steps"
        parts.append(f"posterior: {study.posterior.ensembles} ensembles, {length}, {study.posterior.likelihood} likelihood")
    if study.prediction is not None:
        p = study.prediction
        parts.append(f"prediction: backbone of mode {p.mode} at {p.at} from {engineering(p.amplitude, 'm')}, {p.samples} samples; "
                     f"held out: {', '.join(p.heldout) or 'none'}")
    if study.plan is not None:
        count = len(study.plan.inputs) * len(study.plan.levels)
        parts.append(f"plan: {count} excitations, {len(study.plan.sensors)} sensors, {len(study.plan.joints)} suspected joints "
                     "(nlsid plan)")
        if not study.recordings:
            return "\n".join([*parts, "missing: no [[recordings]], so there is nothing to run yet"])
    missing = [text for given, text in (
        (study.linear.recording or study.linear.file, "no low-level recording under [linear]: the linear model is used as stated"),
        (study.identification, "no [identification]: only the linear model is made"),
        (study.posterior, "no [posterior]: best values without uncertainty"),
        (study.prediction and study.prediction.heldout, "no held-out record under [prediction]: nothing tests the prediction"))
               if not given]
    return "\n".join([*parts, *(f"missing: {text}" for text in missing)])


def terms_table() -> str:
    """The library."""
    from bayes_nlsid.forces.library import LIBRARY

    rows = [["" if t.index is None else str(t.index), name, t.parity, t.memory, t.confidence,
             ", ".join(f"{p.name} ({p.unit})" if p.unit else p.name for p in t.params),
             t.formula if len(t.formula) <= 60 else t.meaning or f"{t.formula[:57]}..."] for name, t in LIBRARY.items()]
    note = ("number: in Table 1 of Safari and Londoño Monsalve (2023); sure: how certain the reading of the printed table is (H, M, L).")
    return columns(["number", "term", "parity", "memory", "sure", "parameters", "force"], rows, right=(0,)) + "\n\n" + _wrapped(note)


def hypotheses_table() -> str:
    """The catalogue of what may be missing."""
    from bayes_nlsid.mismatch.catalogue import catalogue_rows

    rows = [[row["class"], row["sits"], row["phase"], row["claim"]] for row in catalogue_rows()]
    return columns(["class", "where", "in phase with", "claim"], rows)
