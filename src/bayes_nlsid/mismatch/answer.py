"""Putting an analysis into words and numbers: verdict, places, ranked hypotheses, sentence, predictions of sealed records."""

from __future__ import annotations

import time as clock
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case import Case, CaseRecord
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.diagnose import Analysis, Progress, Proof, Rival, claim, intervals, prove, rank
from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.mismatch.probability import Key, Layer
from bayes_nlsid.mismatch.prove import Predictor, envelope

Array = NDArray[np.float64]


def answer(analysis: Analysis, seed: int, layer: Layer, begun: float, say: Progress) -> Diagnosis:
    """Everything that is told to the user."""
    say("testing on records that were not used")
    odds = rank(analysis, layer)
    ranked = sorted((r for r in analysis.rivals if r.key in odds), key=lambda r: (-odds[r.key], -r.gain))
    p_mismatch = 1 - odds.get((), 0.0)
    best = ranked[0] if ranked and p_mismatch > 0.5 else None
    proof, predictor = prove(analysis, best)
    if proof.withdrawn and best is not None and len(best.key) > 1:
        # a pair that does not help may hide a single that does
        single = next((r for r in ranked if len(r.key) == 1 and r.hypothesis is not None and r.key[0] in best.key), None)
        if single is not None:
            best = single
            proof, predictor = prove(analysis, single)
    notes = list(analysis.notes)
    if proof.withdrawn:
        notes.append("The named effect made a held-out record worse and was withdrawn from the predictions.")
    hypotheses = _named(analysis, odds, seed)
    verdict = "mismatch" if p_mismatch > 0.5 else "none"
    top = hypotheses[0]
    if (verdict == "mismatch" and top.probability < 0.35) or 0.35 < p_mismatch < 0.65:
        verdict = "cannot_tell"
    where = _where(analysis, odds, best)
    heldout = {"records": list(proof.records), "nrmse_nominal": proof.nominal, "nrmse_updated_linear": proof.updated,
               "nrmse_extended": proof.extended, "noise_floor": proof.noise, "elpd_difference": proof.elpd, "elpd_se": proof.elpd_se,
               "coverage90": proof.coverage, "withdrawn": proof.withdrawn}
    predictions = _predict_sealed(analysis, predictor, proof)
    sentence = _sentence(verdict, p_mismatch, hypotheses, where, proof)
    detection = {"linear_statistic": analysis.evidence.statistic, "odd_lines": analysis.evidence.odd, "even_lines": analysis.evidence.even,
                 "linear_misfit_per_value": analysis.fit.cost / analysis.fit.dof}
    figures = _figures(analysis, proof, odds)
    return Diagnosis(analysis.case.name, seed, clock.perf_counter() - begun, verdict, p_mismatch, where, hypotheses, heldout, sentence,
                     detection, tuple(notes), predictions, figures, asdict(analysis.scores))


def _named(analysis: Analysis, odds: dict[Key, float], seed: int) -> tuple[Named, ...]:
    by_key: dict[Key, Rival] = {}
    for r in analysis.rivals:
        if r.key not in by_key or r.gain > by_key[r.key].gain:
            by_key[r.key] = r
    ordered = sorted(odds.items(), key=lambda kv: -kv[1])
    out: list[Named] = []
    rest = 0.0
    for key, p in ordered:
        special = not key or key == (("other", "-"),)
        if len(out) >= 12 and not special:
            rest += p
            continue
        effects = key if key else (("none", "-"),)
        parameters: tuple[Any, ...] = ()
        rival = by_key.get(key)
        if rival is not None and p > 0.005:
            if rival.hypothesis is not None:
                for e in rival.hypothesis.effects:
                    parameters += intervals(rival.hypothesis, e, max(analysis.scores.dispersion, 1.0), seed)
            for e in rival.extra:
                value = float(e.values[0])
                parameters += ({"name": f"{e.cls}[{e.place}].{e.names[0]}", "unit": e.units[0], "q05": 0.9 * value, "q50": value,
                                "q95": 1.1 * value},)
        words = " and ".join(claim(e) for e in effects)
        out.append(Named(effects, p, parameters, words, _separates(effects, ordered)))
    if rest > 0:
        out = [Named(h.effects, h.probability + (rest if h.effects == (("other", "-"),) else 0.0), h.parameters, h.sentence, h.separated_by)
               for h in out]
    if not any(h.effects == (("other", "-"),) for h in out):
        out.append(Named((("other", "-"),), rest, (), claim(("other", "-")), ROWS["other"].test))
    return tuple(sorted(out, key=lambda h: -h.probability))


def _separates(effects: Key, ordered: list[tuple[Key, float]]) -> str:
    """The test of the first row that would tell this from the next one."""
    cls = effects[0][0]
    rivals = [key for key, _ in ordered if key and key != effects][:3]
    for key in rivals:
        for other, _ in key:
            if cls in ROWS and other in ROWS[cls].confused:
                return ROWS[cls].test
    return ROWS[cls].test if cls in ROWS else ""


def _where(analysis: Analysis, odds: dict[Key, float], best: Rival | None) -> dict[str, Any]:
    table: dict[str, float] = {}
    for key, p in odds.items():
        for _, place in key:
            table[place] = table.get(place, 0.0) + p
    ranked = sorted(((n, p) for n, p in table.items() if n != "-"), key=lambda kv: -kv[1])[:8]
    alike = [n for n, p in ranked if ranked and p > 0.25 * ranked[0][1]]
    locations = [{"name": n, "probability": min(p, 1.0), "indistinguishable_from": [m for m in alike if m != n] if n in alike else []}
                 for n, p in ranked]
    spectra = analysis.evidence.spectra
    phase, time, onset, unit = "-", "throughout", 0.0, "m"
    if best is not None:
        phase = ROWS[best.key[0][0]].phase if best.key[0][0] in ROWS else "-"
        time = "drifts" if any(c == "stiffness_drift" for c, _ in best.key) else "throughout"
        onset, unit = _onset(analysis, best)
    return {"locations": locations, "amplitude": {"onset": onset, "unit": unit}, "band_hz": _band(analysis, best), "time": time,
            "phase": phase, "records": list(spectra.names)}


def _onset(analysis: Analysis, best: Rival) -> tuple[float, str]:
    """Motion at the place above which the law departs from a linear one."""
    if best.hypothesis is None or not best.hypothesis.forces:
        return 0.0, "m"
    e = best.hypothesis.forces[0]
    unit = "rad" if "rot" in e.place.lower() else "m"
    if e.law is None:
        return 0.0, unit
    name = e.law.term.name
    v = e.values
    if name == "clearance":
        return float(v[1]) / 2, unit
    if name in ("rounded_gap", "one_stop", "two_stops", "round_stops"):
        return float(v[1]), unit
    if name in ("one_sided_spring", "bent_spring"):
        return abs(float(v[1] * v[-1])), unit
    if name in ("saturating_spring", "levelling_spring"):
        return 0.1 * float(v[1]), unit
    if name in ("iwan4_memory", "jenkins_memory", "bouc_wen_loop"):
        return (0.1 if name.startswith("iwan") else 1.0) * float(v[0] / max(v[1], 1e-300)), unit
    latent = next((x for x in analysis.found.latents if x.place == e.place), None)
    if name == "power_spring" and latent is not None:
        return 0.5 * float(latent.displacement.std(1).max()), unit
    return 0.0, unit


def _band(analysis: Analysis, best: Rival | None) -> list[float]:
    """Frequencies that hold 80 % of the squared residual over noise that the best hypothesis explains."""
    evidence = analysis.evidence
    power = np.einsum("ls,rls->l", evidence.weight, np.abs(evidence.residual) ** 2) - len(evidence.residual) * evidence.weight.shape[1]
    if best is None or best.hypothesis is None:
        return [float(analysis.case.band[0]), float(analysis.case.band[1])]
    after = np.einsum("ls,rls->l", evidence.weight, np.abs(best.hypothesis.residual) ** 2)
    power = np.maximum(power + len(evidence.residual) * evidence.weight.shape[1] - after, 0)
    if power.sum() <= 0:
        return [float(analysis.case.band[0]), float(analysis.case.band[1])]
    share = np.cumsum(power) / power.sum()
    f = evidence.spectra.frequency
    last = len(f) - 1
    return [float(f[min(int(np.searchsorted(share, p)), last)]) for p in (0.1, 0.9)]


def _predict_sealed(analysis: Analysis, predictor: Predictor, proof: Proof) -> dict[str, Array]:
    case = analysis.case
    out: dict[str, Array] = {}
    for record in case.records:
        if not record.sealed:
            continue
        wave, _ = predictor.run(case, record)
        if not np.isfinite(wave).all():
            wave, _ = Predictor(analysis.family, analysis.fit, None, predictor.channels, (), analysis.evidence.spectra).run(case, record)
        half = proof.bands.factor * proof.bands.sd(wave, case.rate)
        full = [_all_channels(case, record, w) for w in (wave - half, wave, wave + half)]
        if not case.usable.all():
            blind = predictor.silent(case, record)[:len(record.force)]
            wide = 1.645 * np.sqrt(np.mean(proof.bands.noise) ** 2 + (np.median(proof.bands.relative) * envelope(blind, case.rate)) ** 2)
            for k, w in enumerate((blind - wide, blind, blind + wide)):
                full[k][:, ~case.usable] = w
        for tag, w in zip(("q05", "q50", "q95"), full, strict=True):
            out[f"{record.name}_accel_{tag}"] = w
    return out


def _all_channels(case: Case, record: CaseRecord, wave: Array) -> Array:
    """Put the usable channels into their columns, zeros into the others."""
    out = np.zeros((len(record.force), len(case.sensors)))
    out[:, case.usable] = wave[:len(out)]
    return out


def _sentence(verdict: str, p: float, hypotheses: tuple[Named, ...], where: dict[str, Any], proof: Proof) -> str:
    sure = "> 0.999" if p > 0.999 else f"= {p:.3f}"
    if verdict == "none":
        return (f"The recordings do not differ from the model beyond noise and its tolerances (p of a mismatch {sure}). "
                f"The calibrated model predicts {', '.join(proof.records)} with an error of {100 * proof.updated:.2g} % "
                f"(noise floor {100 * proof.noise:.2g} %).")
    real = [h for h in hypotheses if h.effects != (("none", "-"),)]
    first = real[0]
    places = " and ".join("a place these data do not show" if q == "-" else q for q in dict.fromkeys(q for _, q in first.effects))
    text = (f"The recordings differ from the model beyond noise (p {sure})." if p > 0.65 else
            f"Whether the recordings differ from the model beyond noise and its tolerances cannot be told from these data (p {sure}).")
    text += f" The mismatch {'sits' if p > 0.65 else 'would sit'} at {places}"
    onset = where["amplitude"]["onset"]
    if onset > 0:
        text += f"; it grows with amplitude from about {onset:.2g} {where['amplitude']['unit']}"
    if where["phase"] not in ("-", ""):
        text += f"; it follows the {where['phase']}" if where["phase"] in ("displacement", "velocity", "acceleration") else (
            "; it follows the history of displacement (loops)" if where["phase"] == "memory" else f"; it sits in the {where['phase']}")
    text += f". Missing physics: {first.sentence} ({100 * first.probability:.0f} %)"
    if len(real) > 1 and real[1].probability > 0.005:
        text += f"; next, {real[1].sentence} ({100 * real[1].probability:.0f} %), which this would separate: {first.separated_by}"
    text += "."
    if proof.withdrawn:
        text += " Added to the model it does not improve the records that were not used, so no improvement is claimed."
    else:
        text += (f" With it, the error on {', '.join(proof.records)} (not used) falls from {100 * proof.nominal:.2g} % to "
                 f"{100 * proof.extended:.2g} % (noise floor {100 * proof.noise:.2g} %); the best linear re-tuning reaches "
                 f"{100 * proof.updated:.2g} %.")
    if verdict == "cannot_tell":
        text += " These data cannot tell the leading explanations apart."
    return text


def _figures(analysis: Analysis, proof: Proof, odds: dict[Key, float]) -> dict[str, NDArray[Any]]:
    """Numbers for figures: where, latent force against motion, transfer functions, before and after."""
    evidence, fit = analysis.evidence, analysis.fit
    e = evidence.excited
    latents = sorted(analysis.found.latents, key=lambda x: -x.explained)
    out: dict[str, NDArray[Any]] = {
        "frequency": evidence.spectra.frequency, "frf_frequency": evidence.spectra.frequency[e], "frf_measured": evidence.H,
        "frf_linear": fit.model, "residual_by_line": np.sqrt((np.abs(evidence.residual) ** 2).mean((0, 2))),
        "noise_by_line": np.sqrt(evidence.spectra.noise.mean((0, 2))), "statistic_by_record": evidence.by_record,
        "levels": evidence.spectra.levels, "starts": evidence.spectra.starts,
        "place_names": np.array([x.place for x in latents]), "place_share": np.array([x.share for x in latents]),
        "hypothesis_names": np.array([" + ".join(f"{c}@{p}" for c, p in k) or "none" for k in odds]),
        "hypothesis_probability": np.array(list(odds.values()))}
    strongest = int(np.argmax(evidence.spectra.levels))
    for i, x in enumerate(latents[:3]):
        out[f"latent_{i}_force"], out[f"latent_{i}_displacement"] = x.force[strongest], x.displacement[strongest]
        out[f"latent_{i}_velocity"] = x.velocity[strongest]
    limit = 4096
    for name, wave in proof.waves.items():
        out[f"heldout_{name}"] = wave[:limit].astype(np.float32)
        out[f"heldout_{name}_envelope"] = envelope(wave, analysis.case.rate)[::64]
    out["heldout_channels"] = np.array([n for n, ok in zip(analysis.case.sensors, analysis.case.usable, strict=True) if ok])
    out["heldout_time"] = np.arange(min(limit, len(proof.waves["measured"]))) / analysis.case.rate
    return out
