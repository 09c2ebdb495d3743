"""Putting an analysis into words and numbers: verdict, places, ranked hypotheses, sentence, predictions of sealed records."""

from __future__ import annotations

import time as clock
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case import Case, CaseRecord
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.diagnose import Analysis, Progress, Proof, Rival, claim, intervals, prove, rank
from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.mismatch.portrait import portrait
from bayes_nlsid.mismatch.probability import STRANGE as OTHER
from bayes_nlsid.mismatch.probability import Key, Layer, classes_of
from bayes_nlsid.mismatch.prove import Predictor, envelope
from bayes_nlsid.mismatch.words import PHASES, error_percent, separates, size_of, sure, whole_percent

Array = NDArray[np.float64]
LISTED = 12  # hypotheses that are listed place by place


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
    sentence = _sentence(verdict, p_mismatch, hypotheses, where, proof, () if best is None else best.key)
    detection = {"linear_statistic": analysis.evidence.statistic, "odd_lines": analysis.evidence.odd, "even_lines": analysis.evidence.even,
                 "linear_misfit_per_value": analysis.fit.cost / analysis.fit.dof}
    figures = portrait(analysis, best, proof, predictor) | {
        "hypothesis_names": np.array([" + ".join(f"{c}@{p}" for c, p in k) or "none" for k in odds]),
        "hypothesis_probability": np.array(list(odds.values()))}
    return Diagnosis(analysis.case.name, seed, clock.perf_counter() - begun, verdict, p_mismatch, where, hypotheses, heldout, sentence,
                     detection, tuple(notes), predictions, figures, asdict(analysis.scores))


def _named(analysis: Analysis, odds: dict[Key, float], seed: int) -> tuple[Named, ...]:
    """Hypotheses, likeliest first; beyond the first twelve the places of what is listed already count with it."""
    by_key: dict[Key, Rival] = {}
    for r in analysis.rivals:
        if r.key not in by_key or r.gain > by_key[r.key].gain:
            by_key[r.key] = r
    ordered = sorted((odds | {OTHER: odds.get(OTHER, 0.0)}).items(), key=lambda kv: -kv[1])
    out: dict[tuple[str, ...], list[Named]] = {}
    for i, (key, p) in enumerate(ordered):
        effects = key if key else (("none", "-"),)
        alike = out.setdefault(classes_of(effects), [])
        if alike and i >= LISTED and key and key != OTHER:
            alike[0] = replace(alike[0], probability=alike[0].probability + p)
            continue
        parameters = _intervals(analysis, by_key[key], seed) if key in by_key and p > 0.005 else ()
        alike.append(Named(effects, p, parameters, " and ".join(claim(e) for e in effects), separates(effects, ordered)))
    return tuple(sorted((h for some in out.values() for h in some), key=lambda h: -h.probability))


def _intervals(analysis: Analysis, rival: Rival, seed: int) -> tuple[dict[str, Any], ...]:
    """Parameters of all effects of a rival."""
    out: tuple[dict[str, Any], ...] = ()
    for e in rival.hypothesis.effects if rival.hypothesis is not None else ():
        out += intervals(rival.hypothesis, e, max(analysis.scores.dispersion, 1.0), seed)  # type: ignore[arg-type]
    for e in rival.extra:
        value = float(e.values[0])
        out += ({"name": f"{e.cls}[{e.place}].{e.names[0]}", "unit": e.units[0], "q05": 0.9 * value, "q50": value, "q95": 1.1 * value},)
    return out


def _where(analysis: Analysis, odds: dict[Key, float], best: Rival | None) -> dict[str, Any]:
    table: dict[str, float] = {}
    for key, p in odds.items():
        for _, place in key:
            table[place] = table.get(place, 0.0) + p
    ranked = sorted(((n, p) for n, p in table.items() if n != "-"), key=lambda kv: -kv[1])[:8]
    alike = _alike(odds, [n for n, p in ranked if p > 0.25 * ranked[0][1]])
    locations = [{"name": n, "probability": min(p, 1.0), "indistinguishable_from": alike.get(n, [])} for n, p in ranked]
    spectra = analysis.evidence.spectra
    phase, time, onset, unit = "-", "throughout", 0.0, "m"
    if best is not None:
        phase = ROWS[best.key[0][0]].phase if best.key[0][0] in ROWS else "-"
        time = "drifts" if any(c == "stiffness_drift" for c, _ in best.key) else "throughout"
        onset, unit = _onset(analysis, best)
    return {"locations": locations, "amplitude": {"onset": onset, "unit": unit}, "band_hz": _band(analysis, best), "time": time,
            "phase": phase, "records": list(spectra.names)}


def _alike(odds: dict[Key, float], names: list[str]) -> dict[str, list[str]]:
    """Places that stand for one another: the same class sits at one or the other, but not at both at once."""
    classes: dict[str, set[str]] = {}
    together: dict[tuple[str, str], float] = {}
    single: dict[str, float] = {}
    for key, p in odds.items():
        places = {place for _, place in key}
        for cls, place in key:
            if p > 0.01:
                classes.setdefault(place, set()).add(cls)
        for n in places:
            single[n] = single.get(n, 0.0) + p
            for m in places - {n}:
                together[n, m] = together.get((n, m), 0.0) + p
    return {n: [m for m in names if m != n and classes.get(n, set()) & classes.get(m, set())
                and together.get((n, m), 0.0) < 0.5 * min(single[n], single[m])] for n in names}


def _onset(analysis: Analysis, best: Rival) -> tuple[float, str]:
    """Motion at the place above which the law departs from a linear one."""
    if best.hypothesis is None or not best.hypothesis.forces:
        return 0.0, "m"
    e = best.hypothesis.forces[0]
    unit = "rad" if "rot" in e.place.lower() else "m"
    if e.law is None or e.law.onset is None:
        return 0.0, unit
    latent = next((x for x in analysis.found.latents if x.place == e.place), None)
    return e.law.onset(e.values, 0.0 if latent is None else float(np.abs(latent.displacement).max())), unit


def _band(analysis: Analysis, best: Rival | None) -> list[float]:
    """Frequencies that hold 80 % of what the best hypothesis explains, in records and transfer function together."""
    evidence = analysis.evidence
    if best is None or best.hypothesis is None:
        return [float(analysis.case.band[0]), float(analysis.case.band[1])]
    before, after = (np.einsum("r,ls,rls->l", evidence.trust, evidence.weight, np.abs(residual) ** 2)
                     for residual in (evidence.residual, best.hypothesis.residual))
    power = before - after
    # faults of mass, stiffness and channels show in the transfer function
    first, then = ((np.abs(fit.measured - fit.model) ** 2 / fit.variance).sum(1) for fit in (analysis.fit, best.hypothesis.fit))
    power[evidence.excited] += first - then
    power = np.maximum(power, 0)
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


def _sentence(verdict: str, p: float, hypotheses: tuple[Named, ...], where: dict[str, Any], proof: Proof, shown: Key) -> str:
    """The first line of the answer; ``shown``: the hypothesis that place, onset and proof belong to."""
    if verdict == "none":
        return (f"The recordings do not differ from the model beyond noise and its tolerances (p of a mismatch {sure(p)}). "
                f"The calibrated model predicts {', '.join(proof.records)} with an error of {error_percent(proof.updated)} "
                f"(noise floor {error_percent(proof.noise)}).")
    real = [h for h in hypotheses if h.effects != (("none", "-"),)]
    first = real[0]
    places = " and ".join("a place these data do not show" if q == "-" else q for q in dict.fromkeys(q for _, q in first.effects))
    text = (f"The recordings differ from the model beyond noise (p {sure(p)})." if p > 0.65 else
            f"Whether the recordings differ from the model beyond noise and its tolerances cannot be told from these data (p {sure(p)}).")
    text += f" The mismatch {'sits' if p > 0.65 else 'would sit'} at {places}"
    onset = where["amplitude"]["onset"] if first.effects == shown else 0.0
    if onset > 0:
        text += f"; it grows with amplitude from about {size_of(onset, where['amplitude']['unit'])}"
    if where["phase"] in PHASES and first.effects == shown:
        text += f"; {PHASES[where['phase']]}"
    text += f". Missing physics: {first.sentence} ({whole_percent(first.probability)})"
    if len(real) > 1 and real[1].probability > 0.005:
        text += f"; next, {real[1].sentence} ({whole_percent(real[1].probability)})"
    text += "."
    if proof.withdrawn:
        text += " Added to the model it does not improve the records that were not used, so no improvement is claimed."
    elif first.effects != shown or proof.extended > 0.98 * proof.updated:
        text += (f" On {', '.join(proof.records)} (not used) the error is {error_percent(proof.nominal)} as delivered and "
                 f"{error_percent(proof.updated)} with the best linear re-tuning (noise floor {error_percent(proof.noise)})"
                 + (", and no less with it." if first.effects == shown else "; nothing can be added to the model that it names."))
    else:
        text += (f" With it, the error on {', '.join(proof.records)} (not used) falls from {error_percent(proof.nominal)} to "
                 f"{error_percent(proof.extended)} (noise floor {error_percent(proof.noise)}); the best linear re-tuning reaches "
                 f"{error_percent(proof.updated)}.")
    if verdict == "cannot_tell":
        text += " These data cannot tell the leading explanations apart."
    return text
