"""The machine-readable summary of a run, ``result.json``, made from the stored stages alone."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayes_nlsid.inference.prior import SPACE
from bayes_nlsid.study.schema import EXTRAS, Study
from bayes_nlsid.study.store import Saved, versions

AT_BOUND = 1e-3
"""Share of its range within which a value counts as lying at the end of it."""
STATUSES = ("ok", "not_converged", "not_identifiable", "model_misfit", "failed")


def summarise(study: Study, done: Mapping[str, Saved], seed: int) -> dict[str, Any]:
    """Everything a program outside needs to know of a run.

    ``status``: ``failed`` if the fit or the prediction could not be computed, ``not_converged`` if the sampler is not to be
    trusted, ``not_identifiable`` if the recordings narrow none of the nonlinear parameters,
    ``model_misfit`` if the simulated recordings differ from the measured ones by more than noise, else ``ok``.
    """
    status, reasons = _verdict(done)
    out: dict[str, Any] = {
        "format": 1, "title": study.title, "seed": seed, "versions": versions(), "inputs": dict(study.inputs), "status": status,
        "reasons": reasons, "stages": {name: {"key": s.key, "seconds": s.seconds, "versions": s.versions} for name, s in done.items()}}
    if "read" in done:
        out["recordings"] = [{"name": r["name"], "findings": r["findings"]} for r in done["read"].data["recordings"]]
    if "linear" in done:
        out["linear"] = {key: done["linear"].data.get(key, []) for key in ("modes", "updated", "polarity", "notes")}
    if "identify" in done:
        out["selection"] = _selection(done["identify"].data["variants"][0])
        out["alternatives"] = [{"name": v["name"], **_selection(v)} for v in done["identify"].data["variants"][1:]]
        out["parameters"] = _parameters(done)
    if "posterior" in done:
        out["convergence"] = done["posterior"].data["convergence"]
        out["posterior"] = {"prior_space": SPACE} | {
            key: done["posterior"].data.get(key) for key in ("stage", "stage_why", "likelihood", "second_stage", "groups")}
    if "predict" in done:
        out["heldout"] = _heldout(done["predict"])
        out["backbone"] = done["predict"].data.get("backbone", {})
    for name in EXTRAS:
        if name in done:
            out[name] = done[name].data["summary"]
    return _finite(out)


def _verdict(done: Mapping[str, Saved]) -> tuple[str, list[str]]:
    reasons: list[str] = []
    status = "ok"
    if "identify" in done:
        main = done["identify"].data["variants"][0]
        reasons += main["reasons"]
        if main["status"] == "failed":
            return "failed", reasons
        astray = _astray(done)
        if astray:
            status = "not_identifiable"
            reasons.append(f"{', '.join(astray)} ended at a bound of its range: the linear model is too far off; correct it, name a "
                           "recording under [linear], or raise frequency_widening")
    if "posterior" in done:
        data = done["posterior"].data
        reasons += data["reasons"]
        linear = ("f[", "zeta[", "gain")
        flags = [f for f, name in zip(data["identifiable"], data["names"], strict=True) if not name.startswith(linear)]
        if not data["convergence"]["converged"]:
            status = "not_converged"
        elif flags and not any(flags):
            status = "not_identifiable"
            reasons.append("the recordings narrow none of the nonlinear parameters beyond what was assumed")
        status = _second(data, status, reasons)
    if "predict" in done and done["predict"].data.get("status", "ok") != "ok":
        reasons.append(done["predict"].data["status"])
        status = "failed" if status == "ok" and done["predict"].data.get("all_failed", False) else status
    return status, list(dict.fromkeys(reasons))


def _second(data: Mapping[str, Any], status: str, reasons: list[str]) -> str:
    """What the stage by simulation changes: one that was asked for and is not to be trusted, a model that its errors contradict."""
    second = data.get("second_stage")
    if not second:
        return status
    if second["status"] in ("failed", "not_converged") and data["stage_why"] == "as the study says":
        reasons += second["reasons"]
        status = "not_converged"
    if second["misfit"] and second["misfit"]["found"]:
        reasons += second["misfit"]["reasons"]
        status = "model_misfit" if status == "ok" else status
    return status


def _astray(done: Mapping[str, Saved]) -> list[str]:
    """Natural frequencies that the fit left at an end of their range."""
    saved = done["identify"]
    names, theta, bounds = saved.data["variants"][0]["names"], saved.arrays["0.theta"], saved.arrays["0.bounds"]
    return [name for name, value, (low, high) in zip(names, theta, bounds, strict=True)
            if name.startswith("f[") and min(value - low, high - value) < AT_BOUND * (high - low)]


def _selection(record: Mapping[str, Any]) -> dict[str, Any]:
    """Indices of Table 1 where a term has one, else its name."""
    def label(element: Mapping[str, Any]) -> Any:
        return element["index"] if element["index"] is not None else element["term"]

    terms = [{"index": e["index"], "name": e["term"], "locations": e["locations"]} for e in record["elements"]]
    return {"forward": [label(e) for e in record.get("forward", [])], "backward": [label(e) for e in record.get("backward", [])],
            "terms": terms, "score": {"mse": record["mse"], "mse_linear": record["mse_linear"], "floor": record["floor"]},
            "lost_motion": record.get("lost_motion", 0.0),
            "aliases": record.get("aliases", []), "status": record["status"]}


def _parameters(done: Mapping[str, Saved]) -> list[dict[str, Any]]:
    record = done["identify"].data["variants"][0]
    fit = np.asarray(done["identify"].arrays["0.theta"], dtype=float)
    named = zip(record["names"], record["units"], fit, strict=True)
    rows: list[dict[str, Any]] = [{"name": name, "unit": unit, "fit": float(value)} for name, unit, value in named]
    if "posterior" in done:
        saved = done["posterior"]
        quantiles = np.asarray(saved.arrays["quantiles"], dtype=float)
        for i, row in enumerate(rows):
            row |= {"q05": float(quantiles[0, i]), "q50": float(quantiles[1, i]), "q95": float(quantiles[2, i]),
                    "identifiable": bool(saved.data["identifiable"][i]), "narrowing": float(saved.arrays["narrowing"][i]),
                    "ess": float(saved.arrays["ess"][i]), "tau": float(saved.arrays["tau"][i])}
        priors = {p["parameter"]: {key: value for key, value in p.items() if key != "parameter"} for p in saved.data["priors"]}
        for row in rows:
            row["prior"] = priors.get(row["name"])
        if "regression_quantiles" in saved.arrays:
            for i, row in enumerate(rows):
                low, middle, high = (float(x) for x in saved.arrays["regression_quantiles"][:, i])
                row["regression"] = {"q05": low, "q50": middle, "q95": high}
    return rows


def _heldout(saved: Saved) -> dict[str, Any]:
    entries = saved.data.get("heldout", [])
    if not entries:
        return {"records": [], "nrmse": None, "noise_floor": None, "coverage90": None}
    kept = ("record", "nrmse", "nrmse_linear", "noise_floor", "noise_sure", "coverage90", "rmse", "unit")
    means = {key: [e[key] for e in entries if e.get(key) is not None] for key in ("nrmse", "noise_floor", "coverage90")}
    return {"records": [e["record"] for e in entries], **{key: float(np.mean(x)) if x else None for key, x in means.items()},
            "noise_sure": next((s for s in ("bound", "estimated") if any(e.get("noise_sure") == s for e in entries)), "measured"),
            "each": [{key: e[key] for key in kept if key in e} for e in entries]}


def _finite(value: Any) -> Any:
    """NaN and infinity have no place in JSON: they become null."""
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, np.generic):
        return _finite(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def to_text(result: Mapping[str, Any]) -> str:
    """JSON text, stable from run to run."""
    return json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
