"""The findings in sentences: what was found, how sure, what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayes_nlsid.study.axes import brief, brief_names, digits_for, engineering, floor_text, percent, places
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.stage_read import told

STATUS_WORDS = {"ok": "done", "not_converged": "refused: the sampler has not converged", "not_identifiable": "refused: not identifiable",
                "model_misfit": "refused: the model does not explain the recordings", "failed": "refused: the computation failed"}


DISAGREE = 2.0  # standard deviations of the regression by which the second stage may move a parameter without a word
TOO_FEW = 0.75  # of the samples that a 90 % band should cover: fewer is no chance, the model is inadequate


LOST = 1e-3     # share of motion above the band from which it is told; a cubic coefficient is then off by about 0.3 %


def missed(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Held-out records of which far fewer than 90 % of the samples lie inside the 90 % band of the posterior."""
    if not any("identifiable" in p for p in result.get("parameters", [])):
        return []
    each = (result.get("heldout") or {}).get("each") or []
    return [e for e in each if e.get("coverage90") is not None and e["coverage90"] < TOO_FEW]


def sound(result: Mapping[str, Any]) -> bool:
    """Whether the run ended well and nothing it was tested on contradicts its intervals."""
    return bool(result["status"] == "ok" and not missed(result))


def status_words(result: Mapping[str, Any]) -> str:
    """The outcome in a few words; a run that is done but misses its held-out records is not called just done."""
    said = STATUS_WORDS[result["status"]]
    if result["status"] != "ok" or not missed(result):
        return said
    return f"{said}, but the model is inadequate: {_covered(result)}"


def _covered(result: Mapping[str, Any]) -> str:
    """``the 90 % band covers 4 % of record “late decay”``."""
    found = missed(result)
    named = [f"{100 * e['coverage90']:.0f} % of record “{e['record']}”" for e in found[:3]]
    rest = f" and too little of {len(found) - 3} more" if len(found) > 3 else ""
    return f"the 90 % band covers {', '.join(named)}{rest}"


def story(study: Study, result: Mapping[str, Any]) -> list[str]:
    """A handful of sentences, each from ``result.json`` alone."""
    tellers = (found_words, _doubtful, _cut_off, _against_alternatives, _sure, _two_stages, _backbone, _heldout, _inadequate)
    out = [sentence for sentence in (tell(result) for tell in tellers) if sentence]
    out += list(study.report.notes)
    return [*out, _next(result)]


def found_words(result: Mapping[str, Any]) -> str:
    """What was chosen, and how much of what the linear model leaves unexplained it removes."""
    chosen = result.get("selection")
    if chosen is None:
        modes = result.get("linear", {}).get("modes", [])
        linear = f"The linear model matches {len(modes)} measured modes; no identification was asked for."
        return linear if modes else "The recordings were read."
    score = chosen["score"]
    if not chosen["terms"]:
        return ("No force law of the library explains more than the linear model does; the structure is linear as far as these "
                "recordings can tell.")
    terms = " and ".join(f"{t['name']} at {places(t['locations'])}" for t in chosen["terms"])
    share = 100 * (1 - score["mse"] / score["mse_linear"]) if score["mse_linear"] else 0.0
    verb = "was" if len(chosen["terms"]) == 1 else "were"
    way = f"{verb} chosen from the library" if chosen["forward"] else f"{verb} given as the form"
    left = f"; what is left is {score['mse'] / score['floor']:.3g} times what sensor noise alone would leave" if score.get("floor") else ""
    return f"{terms} {way}, removing {share:.1f} % of what the linear model leaves unexplained{left}."


def doubts(result: Mapping[str, Any]) -> list[str]:
    """What is wrong with channels, which no figure shows: errors found in recordings, signs and sizes against the linear model."""
    said = [told(r["name"], f) for r in result.get("recordings", []) for f in r["findings"] if f["severity"] == "error"]
    said += [p["sentence"] for p in result.get("linear", {}).get("polarity", [])]
    return list(dict.fromkeys(said))


def _doubtful(result: Mapping[str, Any], most: int = 3) -> str:
    said = doubts(result)
    more = f" And {len(said) - most} more, below." if len(said) > most else ""
    return f"Beware, all that follows rests on these recordings: {'. '.join(said[:most])}.{more}" if said else ""


def _cut_off(result: Mapping[str, Any]) -> str:
    """That the band took harmonics from the motion along which the laws were fitted."""
    lost = (result.get("selection") or {}).get("lost_motion") or 0.0
    if lost < LOST:
        return ""
    return (f"These laws make motion above the band that was looked at, {100 * lost:.2g} % of the motion in it, which the fit could not "
            "see: their coefficients may be off by several times that share, and a law may have been taken on to make up for it. Let "
            "[identification] band reach beyond three times the frequency of the main mode, as far as the sensors tell the modes there "
            "apart.")


def _against_alternatives(result: Mapping[str, Any]) -> str:
    rivals = result.get("alternatives") or []
    if not rivals:
        return ""
    main = result["selection"]["score"]["mse"]
    said = [f"“{r['name']}” leaves {r['score']['mse'] / main:.3g} times as much" for r in rivals if main and r["score"]["mse"] is not None]
    return f"Compared on the same recordings, {'; '.join(said)}." if said else ""


def _sure(result: Mapping[str, Any]) -> str:
    rows = [p for p in result.get("parameters", []) if "identifiable" in p]
    if not rows:
        return "No posterior was computed, so these are best values without uncertainty." if result.get("parameters") else ""
    tight = [p for p in rows if p["identifiable"]]
    short = dict(zip([p["name"] for p in rows], brief_names([p["name"] for p in rows]), strict=True))
    loose = [short[p["name"]] for p in rows if not p["identifiable"]]
    said = f"The recordings determine {len(tight)} of {len(rows)} parameters"
    if tight and tight[0]["q50"] is not None:
        best = min(tight, key=lambda p: p.get("narrowing", 1.0))
        low, middle, high = (engineering(best[q], best["unit"], digits_for(best["q05"], best["q95"])) for q in ("q05", "q50", "q95"))
        said += f", best {short[best['name']]}: {middle}, 90 % between {low} and {high}"
    return said + (f"; not determined are {', '.join(loose[:6])}{' and others' if len(loose) > 6 else ''}." if loose else ".")


def _backbone(result: Mapping[str, Any]) -> str:
    b = result.get("backbone") or {}
    if not b.get("amplitude_m"):
        return ""
    low, high = b["amplitude_m"]
    said = (f"From {engineering(low, 'm')} to {engineering(high, 'm')} the model's frequency goes from {b['frequency_hz'][0]:.2f} to "
            f"{b['frequency_hz'][1]:.2f} Hz and its damping from {100 * b['damping'][0]:.2g} to {100 * b['damping'][1]:.2g} %")
    if b.get("inside_frequency") is not None:
        said += (f"; the backbone measured directly lies inside the 90 % band at {100 * b['inside_frequency']:.0f} % of the amplitudes for "
                 f"frequency and {100 * b['inside_damping']:.0f} % for damping")
    return said + "."


def _heldout(result: Mapping[str, Any]) -> str:
    h = result.get("heldout") or {}
    if not h.get("records") or h.get("nrmse") is None:
        return ""
    records = f"{len(h['records'])} record{'s' if len(h['records']) > 1 else ''}"
    said = f"On {records} not used for fitting the simulated response errs by {percent(h['nrmse'])} (sensor noise alone {floor_text(h)})"
    if h.get("coverage90") is None:
        return f"{said}."
    return f"{said}, and {100 * h['coverage90']:.0f} % of the samples lie inside the 90 % band."


def _two_stages(result: Mapping[str, Any]) -> str:
    """Whether the posterior by simulation agrees with that of the regression, and what a difference says."""
    second = (result.get("posterior") or {}).get("second_stage")
    if not second:
        return ""
    if second["status"] != "ok":
        return f"The posterior by simulation of the recordings is not to be trusted ({'; '.join(second['reasons'][:1])})."
    rows = second.get("against_regression") or []
    if not rows:
        return "The posterior comes from simulating the recordings."
    far = [r for r in rows if abs(r["shift_sd"]) > DISAGREE]
    if not far:
        return "Simulating the recordings instead of regressing on them moves no parameter beyond the uncertainty of the regression."
    names = ", ".join(f"{brief(r['name'])} by {abs(r['shift_sd']):.2g}" for r in sorted(far, key=lambda r: -abs(r["shift_sd"]))[:3])
    return (f"Simulating the recordings instead of regressing on them moves {names} standard deviations of the regression: noise in the "
            "measured motion, or modes that the model leaves out, bias the regression; the values given are those of the simulation.")


def _inadequate(result: Mapping[str, Any]) -> str:
    """That intervals of a model which its own test contradicts are conditional on that model."""
    if result["status"] == "model_misfit":
        why = "; ".join(result["posterior"]["second_stage"]["misfit"]["reasons"][:2])
        return (f"All intervals given here are conditional on an inadequate model: {why}. They tell how closely the recordings fix the "
                "parameters of this model, not how far it is from the structure.")
    if result["status"] == "failed" or not missed(result):
        return ""
    worst = min(missed(result), key=lambda e: float(e["coverage90"]))
    error = f"; on “{worst['record']}” the model errs by {100 * worst['nrmse']:.3g} %"
    error += f", {worst['nrmse'] / worst['noise_floor']:.3g} times the sensor noise" if worst.get("noise_floor") else ""
    return (f"All intervals given here are conditional on an inadequate model: {_covered(result)}{error}. They tell how closely the "
            "recordings fix the parameters of this model, not how far it is from the structure; the truth may lie far outside them.")


def _next(result: Mapping[str, Any]) -> str:
    """What a person should do now."""
    status = result["status"]
    if status == "failed":
        why = "; ".join(map(brief, result["reasons"][:2]))
        return f"Next: the computation failed ({why}); look at run.log and widen or correct what it names."
    if status == "not_converged":
        return "Next: do not use the intervals yet; raise steps under [posterior] and run again, the sampler goes on from where it stopped."
    if status == "not_identifiable":
        return "Next: record larger amplitudes, or tie the joints' parameters, before trusting any value of the nonlinear part."
    if status == "model_misfit":
        return "Next: something is missing in the model; find it with nlsid diagnose, or add force laws or modes, and run again."
    b = result.get("backbone") or {}
    if missed(result):
        return ("Next: the band is too narrow on records it has not seen, so something is missing in the model; find it with nlsid "
                "diagnose, and do not extrapolate until then.")
    if b.get("inside_damping") is not None and min(b["inside_damping"], b["inside_frequency"]) < 0.6:
        return "Next: the measured backbone leaves the band; find what is missing with nlsid diagnose before extrapolating."
    if "parameters" in result and not any("identifiable" in p for p in result["parameters"]):
        lacking = "[posterior]" if b or result.get("heldout") else "[posterior] and [prediction]"
        return f"Next: add {lacking} to learn how sure these values are."
    return "Next: use the model within the amplitudes shown; a record at a larger amplitude would test it where it extrapolates."
