"""The page of a diagnosis: the answer in words, where and when, what and how sure, the proof, what was tested, what else to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.mismatch.words import size_of
from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.axes import digits_for, engineering
from bayes_nlsid.study.diagnosis_pictures import SECTIONS, Pictures
from bayes_nlsid.study.progress import duration
from bayes_nlsid.study.store import versions

HEADLINE = {"none": "nothing is missing", "mismatch": "something is missing", "cannot_tell": "these data cannot tell"}
PHASE = {"displacement": "in phase with displacement there (stiffness)", "velocity": "in phase with velocity there (damping)",
         "memory": "with the history of displacement there (loops: stiffness and loss together)",
         "acceleration": "in phase with acceleration there (inertia)",
         "input": "in the force or in what moves the base, not in the structure",
         "channel": "in one measuring channel, not in the structure"}
TIME = {"throughout": "throughout the recordings", "drifts": "it drifts over the test day",
        "bursts": "in bursts: a sixth of the time holds four fifths of it"}
DETECTION = {
    "odd_lines": ("power on odd lines that the force leaves out, over noise", "1 for a linear system; more: odd nonlinearity"),
    "even_lines": ("power on even lines that the force leaves out, over noise", "1 for a linear system; more: even nonlinearity"),
    "linear_misfit_per_value": ("squared misfit of the re-tuned linear model to the mean transfer function, over its error",
                                "1 if the linear model is right; more: its mass, stiffness, damping or measuring chain is not"),
    "error_over_noise": ("error of the re-tuned linear model on records not used, over sensor noise", "1 where nothing is left to explain"),
    "frequency_trend": ("change of the first mode's frequency from quiet to loud, in standard errors", "beyond ±3: not linear"),
    "damping_trend": ("change of the first mode's damping from quiet to loud, in standard errors", "beyond ±3: not linear"),
    "gain_nats": ("gain of the best single effect on stretches it was not fitted to, nats, with its standard error",
                  "beyond three standard errors: something is there")}


def page(found: Diagnosis, pictures: Pictures, inputs: Sequence[tuple[str, str]] = ()) -> str:
    """The whole page; ``inputs`` are files with their SHA-256."""
    shown = {part: "".join(html.picture(*pictures[name], f"figures/{name}.png", name.replace("_", " ")) for name in names
                           if name in pictures) for part, names in SECTIONS.items()}
    body = [f'<p class="soft">nlsid diagnose, {escape(found.case)}, seed {found.seed}, {duration(found.seconds)}</p>',
            f"<h1>{escape(found.case)}: {HEADLINE[found.verdict]}</h1>",
            f'<div class="story">{html.paragraph(found.sentence)}{html.paragraph(_next(found))}</div>']
    place = _where(found)
    if place or shown["where"]:
        title = "Where, at what amplitude, frequency, phase and time" if place else "What is not linear"
        body += [f"<h2>{title}</h2>", place, shown["where"]]
    body += ["<h2>What is missing, and how sure that is</h2>", _hypotheses(found), shown["what"],
             "<h2>Proof: records that were not used</h2>", _proof(found), shown["proof"],
             "<h2>Is one linear system enough?</h2>", _detection(found)]
    if found.notes:
        body += ["<h2>What else to know</h2>", html.listing(list(found.notes))]
    if inputs:
        body.append(html.details("Files that this rests on", html.table(["file", "SHA-256"], [list(one) for one in inputs], "this run")))
    body.append(html.details("Versions", html.table(["package", "version"], [[k, v] for k, v in versions().items()], "this run")))
    return html.page(f"Diagnosis of {found.case}", "\n".join(part for part in body if part))


def _next(found: Diagnosis) -> str:
    """What to measure next."""
    separating = next((h.separated_by for h in found.hypotheses if h.separated_by), "")
    if found.verdict == "none":
        return f"What would show a smaller effect: {separating}." if separating else ""
    telling = "What would tell the leading explanation from the next one" if "(tells it from" in separating else "What would confirm it"
    return f"{telling}: {separating}." if separating else ""


def _where(found: Diagnosis) -> str:
    """One row for each question."""
    where = found.where
    if found.verdict == "none" or not where:
        return ""
    rows = []
    locations = where.get("locations", [])
    if locations:
        first = locations[0]
        alike = first.get("indistinguishable_from", [])
        said = f"{first['name']} ({_percent(first['probability'])})"
        if alike:
            said += f"; these recordings cannot tell it from {', '.join(alike)}"
        others = [f"{x['name']} ({_percent(x['probability'])})" for x in locations[1:4]
                  if x["probability"] > 0.01 and x["name"] not in alike]
        rows.append(["place", said + (f"; then {', '.join(others)}" if others else "")])
    onset = where.get("amplitude", {})
    rows.append(["amplitude", f"departs from a linear law above about {size_of(onset['onset'], onset.get('unit', 'm'))} there"
                 if onset.get("onset", 0) > 0 else "at any amplitude: no onset"])
    band = where.get("band_hz")
    if band:
        rows.append(["frequency", f"{band[0]:.4g} to {band[1]:.4g} Hz hold four fifths of what the leading explanation takes away"])
    if where.get("phase") in PHASE:
        rows.append(["phase", PHASE[where["phase"]]])
    rows.append(["time", TIME.get(where.get("time", ""), str(where.get("time", "")))])
    return html.table(["question", "answer"], rows, "diagnosis.json, where")


def _percent(p: float) -> str:
    return "> 99.9 %" if 0.999 < p < 1 else "< 0.1 %" if 0 < p < 0.001 else f"{100 * p:.1f} %"


def effects_of(h: Named) -> str:
    """``hysteresis at J2_slip + mains hum at S3``."""
    said = []
    for cls, place in h.effects:
        name = {"none": "nothing missing", "other": "outside the catalogue"}.get(cls, cls.replace("_", " "))
        said.append(name if place in ("", "-") else f"{name} at {place}")
    return " + ".join(said) or "nothing missing"


def _hypotheses(found: Diagnosis) -> str:
    """The ranking, and the estimated numbers of those that have some."""
    listed = [h for i, h in enumerate(found.hypotheses) if i < 3 or h.probability > 0.005 or {c for c, _ in h.effects} <= {"none", "other"}]
    rows = [[effects_of(h), _percent(h.probability), h.separated_by] for h in listed]
    out = html.table(["explanation", "probability", "what would settle it"], rows, "diagnosis.json, hypotheses", (1,))
    values = [[effects_of(h) if i == 0 else "", *_parameter(p)] for h in found.hypotheses[:3] for i, p in enumerate(h.parameters)]
    return out + html.table(["explanation", "parameter", "meaning", "5 %", "50 %", "95 %"], values,
                            "diagnosis.json, hypotheses, parameters", (3, 4, 5))


def _parameter(p: Mapping[str, Any]) -> list[str]:
    low, high = float(p["q05"]), float(p["q95"])
    digits = min(digits_for(low, high), 4)
    if low == high:
        return [str(p["name"]), str(p.get("meaning", "")), "", engineering(low, str(p["unit"]), 4), ""]
    return [str(p["name"]), str(p.get("meaning", "")), *(engineering(float(p[q]), str(p["unit"]), digits) for q in ("q05", "q50", "q95"))]


def _whole(value: float) -> str:
    """A signed number with two digits and no exponent."""
    digits = 1 - int(np.floor(np.log10(abs(value)))) if value else 0
    return f"{round(value, digits):+.{max(digits, 0)}f}"


def _error(share: float) -> str:
    return "< 0.01 %" if share < 1e-4 else f"{100 * share:.3g} %"


def _proof(found: Diagnosis) -> str:
    held = found.heldout
    rows = [[words, _error(held[key])] for words, key in (
        ("model as delivered", "nrmse_nominal"), ("best linear re-tuning, no new physics", "nrmse_updated_linear"),
        ("with what was found", "nrmse_extended"), ("sensor noise alone", "noise_floor"))
        if held.get(key) is not None and (key != "nrmse_extended" or found.verdict != "none")]
    if not rows:
        return html.paragraph("No record was left that had not been fitted: nothing is proved.", "soft")
    records = ", ".join(held.get("records", []))
    out = html.table(["model", "error (rms over rms of the recording)"], rows, f"diagnosis.json, heldout; records {records}", (1,))
    told = []
    change, error = held.get("elpd_difference") or 0.0, held.get("elpd_se") or 0.0
    if held.get("withdrawn"):
        told.append("What was found made a record that was not used worse and was withdrawn: the last model is the re-tuned linear one.")
    elif change:
        verdict = ("that cannot be told from no change" if abs(change) < 2 * error else "an improvement" if change > 0 else
                   "against what was found, although its error is less: its bands promise more than they keep")
        told.append(f"The log predictive density of these records changes by {_whole(change)} ± {_whole(error).lstrip('+')} nats (standard "
                    f"error over blocks) from the re-tuned to the extended model: {verdict}.")
    if held.get("coverage90") is not None and held["coverage90"] == held["coverage90"]:
        kept = held["coverage90"]
        told.append(f"The 90 % bands hold {100 * kept:.3g} % of the samples"
                    + (": too narrow." if kept < 0.85 else ": too wide." if kept > 0.95 else "."))
    each = [[str(x["record"]), *(_error(x[k] / x["rms"]) if x.get("rms") else "–" for k in (
        "rmse_nominal", "rmse_updated_linear", "rmse_extended", "noise"))] for x in held.get("each", [])]
    by_record = html.table(["record", "as delivered", "re-tuned", "with what was found", "noise"], each,
                           "diagnosis.json, heldout, each: first channel", (1, 2, 3, 4)) if len(each) > 1 else ""
    return out + by_record + "".join(html.paragraph(t, "soft") for t in told)


def _detection(found: Diagnosis) -> str:
    """The tests that these data allow."""
    words = dict(DETECTION)
    words["linear_statistic"] = ("squared misfit of any one linear system on lines with force, over noise", "1 for a linear system")
    if "gain_nats" in found.detection:
        words["linear_statistic"] = ("share of the squared innovations that the best single effect takes away", "")
    order = ["linear_statistic", *DETECTION]
    spread = {"gain_nats": found.detection.get("gain_error", 0.0)}
    rows = [[words[k][0], f"{found.detection[k]:.3g}" + (f" ± {spread[k]:.2g}" if k in spread else ""), words[k][1]] for k in order
            if k in found.detection and found.detection[k] is not None and found.detection[k] == found.detection[k]]
    missing = [words[k][0] for k in ("odd_lines", "even_lines") if k in found.detection and found.detection[k] != found.detection[k]]
    out = html.table(["test", "value", "meaning"], rows, "diagnosis.json, detection", (1,))
    if missing:
        out += html.paragraph("Not testable with these recordings: " + "; ".join(missing) + ".", "soft")
    return out or html.paragraph("These recordings allow no test without a model.", "soft")
