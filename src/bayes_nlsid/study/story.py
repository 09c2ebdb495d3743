"""The findings in sentences: what was found, how sure, what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayes_nlsid.study.axes import digits_for, engineering
from bayes_nlsid.study.schema import Study

STATUS_WORDS = {"ok": "done", "not_converged": "refused: the sampler has not converged", "not_identifiable": "refused: not identifiable",
                "failed": "refused: the computation failed"}


def story(study: Study, result: Mapping[str, Any]) -> list[str]:
    """A handful of sentences, each from ``result.json`` alone."""
    out = [s for s in (_found(result), _against_alternatives(result), _sure(result), _backbone(result), _heldout(result)) if s]
    out += list(study.report.notes)
    return [*out, _next(result)]


def _found(result: Mapping[str, Any]) -> str:
    chosen = result.get("selection")
    if chosen is None:
        modes = result.get("linear", {}).get("modes", [])
        linear = f"The linear model matches {len(modes)} measured modes; no identification was asked for."
        return linear if modes else "The recordings were read."
    score = chosen["score"]
    if not chosen["terms"]:
        return ("No force law of the library explains more than the linear model does; the structure is linear as far as these "
                "recordings can tell.")
    terms = " and ".join(f"{t['name']} at {', '.join(t['locations'])}" for t in chosen["terms"])
    share = 100 * (1 - score["mse"] / score["mse_linear"]) if score["mse_linear"] else 0.0
    verb = "was" if len(chosen["terms"]) == 1 else "were"
    way = f"{verb} chosen from the library" if chosen["forward"] else f"{verb} given as the form"
    left = f"; what is left is {score['mse'] / score['floor']:.3g} times what sensor noise alone would leave" if score.get("floor") else ""
    return f"{terms} {way}, removing {share:.1f} % of what the linear model leaves unexplained{left}."


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
    loose = [p["name"] for p in rows if not p["identifiable"]]
    said = f"The recordings determine {len(tight)} of {len(rows)} parameters"
    if tight and tight[0]["q50"] is not None:
        best = min(tight, key=lambda p: p.get("narrowing", 1.0))
        low, middle, high = (engineering(best[q], best["unit"], digits_for(best["q05"], best["q95"])) for q in ("q05", "q50", "q95"))
        said += f", best {best['name']}: {middle}, 90 % between {low} and {high}"
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
    return (f"On {records} not used for fitting the simulated response errs by {100 * h['nrmse']:.3g} % (sensor noise alone "
            f"{100 * h['noise_floor']:.2g} %), and {100 * h['coverage90']:.0f} % of the samples lie inside the 90 % band.")


def _next(result: Mapping[str, Any]) -> str:
    """What a person should do now."""
    status = result["status"]
    if status == "failed":
        return f"Next: the computation failed ({'; '.join(result['reasons'][:2])}); look at run.log and widen or correct what it names."
    if status == "not_converged":
        return "Next: do not use the intervals yet; raise steps under [posterior] and run again, the sampler goes on from where it stopped."
    if status == "not_identifiable":
        return "Next: record larger amplitudes, or tie the joints' parameters, before trusting any value of the nonlinear part."
    h, b = result.get("heldout") or {}, result.get("backbone") or {}
    if h.get("coverage90") is not None and h["coverage90"] < 0.75:
        return ("Next: the band is too narrow on records it has not seen, so something is missing in the model; find it with nlsid "
                "diagnose, and do not extrapolate until then.")
    if b.get("inside_damping") is not None and min(b["inside_damping"], b["inside_frequency"]) < 0.6:
        return "Next: the measured backbone leaves the band; find what is missing with nlsid diagnose before extrapolating."
    if "parameters" in result and not any("identifiable" in p for p in result["parameters"]):
        return "Next: add [posterior] and [prediction] to learn how sure these values are."
    return "Next: use the model within the amplitudes shown; a record at a larger amplitude would test it where it extrapolates."
