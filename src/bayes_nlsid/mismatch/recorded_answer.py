"""The analysis of recordings of any kind put into words and numbers: the same `Diagnosis` as for a case folder."""

from __future__ import annotations

import time as clock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.campaign import RIGID, Campaign
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.detected import detect
from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.mismatch.forward import Extended, predict
from bayes_nlsid.mismatch.odds import OTHER, Key
from bayes_nlsid.mismatch.recorded import Evidence, Progress, analyse, silent, start_of, strength
from bayes_nlsid.mismatch.recorded_portrait import portrait
from bayes_nlsid.mismatch.suspects import Suspect
from bayes_nlsid.mismatch.weigh import Weighed, spread
from bayes_nlsid.mismatch.words import PHASES, WORTH_SAYING, claims, known, of_linear, separates, size_of, sure, whole_percent

Array = NDArray[np.float64]
LISTED = 16


def diagnose_campaign(campaign: Campaign, seed: int = 0, say: Progress = silent) -> Diagnosis:
    """Diagnose what a linear model lacks, from recordings of any kind.

    Parameters
    ----------
    campaign : Campaign
    seed : int
        Of the draws behind the intervals.
    say : callable
        ``say(share, sentence)``.
    """
    begun = clock.perf_counter()
    found = analyse(campaign, say)
    say(0.95, "writing the answer")
    detection, told = detect(found)
    odds = found.odds
    p = 1 - odds.get((), 0.0)
    hypotheses = _named(found, seed)
    verdict = "mismatch" if p > 0.5 else "none"
    top = hypotheses[0]
    if 0.35 < p < 0.65 or (verdict == "mismatch" and _class_probability(odds, top.effects) < 0.4):
        verdict = "cannot_tell"
    where = _where(found)
    s = found.scores
    heldout = {"records": list(found.shown), "nrmse_nominal": s["nominal"], "nrmse_updated_linear": s["updated"],
               "nrmse_extended": s["extended"], "noise_floor": s["noise"], "elpd_difference": s["elpd"], "elpd_se": s["elpd_se"],
               "coverage90": s["coverage90"], "withdrawn": found.withdrawn, "each": _each(found)}
    sentence = _sentence(found, verdict, p, hypotheses, where)
    notes = (*campaign.notes, *retuned(found), *told, *found.notes, *_statuses(found))
    return Diagnosis(campaign.name, seed, clock.perf_counter() - begun, verdict, p, where, hypotheses, heldout, sentence, detection,
                     tuple(dict.fromkeys(notes)), _sealed(found), _figures(found), found.findings.as_dict())


def _class_probability(odds: dict[Key, float], effects: Key) -> float:
    classes = {c for c, _ in effects}
    return sum(v for k, v in odds.items() if k and {c for c, _ in k} == classes)


def _named(found: Evidence, seed: int) -> tuple[Named, ...]:
    ordered = sorted(found.odds.items(), key=lambda kv: -kv[1])
    out: list[Named] = []
    rest = 0.0
    for key, p in ordered:
        if len(out) >= LISTED and key not in ((), OTHER):
            rest += p
            continue
        effects = key or (("none", "-"),)
        parameters = _parameters(found, key, seed) if p > 0.005 else ()
        out.append(Named(effects, p, parameters, claims(effects), separates(effects, ordered)))
    # what is too small to be listed is shared out
    out = [Named(h.effects, h.probability / (1 - rest), h.parameters, h.sentence, h.separated_by) for h in out]
    return tuple(sorted(out, key=lambda h: -h.probability))


def _parameters(found: Evidence, key: Key, seed: int) -> tuple[dict[str, Any], ...]:
    """Quantiles of the laws of a hypothesis: from the joint estimate where there is one, else the regression's point."""
    if found.named is not None and key == found.named.key:
        return _intervals(found.best, seed)
    rival = next((r for r in found.rivals if r.weighed is not None and r.weighed.key == key and not r.failed), None)
    if rival is not None:
        return _intervals(rival.model, seed)
    weighed = next((w for w in (*found.singles, *found.pairs) if w.key == key), None)
    if weighed is None:
        return ()
    out: list[dict[str, Any]] = []
    for suspect, factor in zip(weighed.suspects, weighed.factors, strict=True):
        if suspect.law is None:
            continue
        for q, value, kind in zip(suspect.law.term.params, suspect.parameters(factor), suspect.law.free, strict=True):
            if kind == "fixed":
                continue
            width = 1.645 * abs(float(value)) * weighed.error / max(weighed.gain, weighed.error, 1e-9)
            out.append({"name": f"{suspect.law.term.name}[{suspect.place}].{q.name}", "unit": q.unit, "q05": float(value) - width,
                        "q50": float(value), "q95": float(value) + width, "meaning": q.meaning})
        out += known(suspect.law, suspect.place, suspect.parameters(factor).tolist(), suspect.law.term.name)
    return tuple(out)


def _intervals(ext: Extended, seed: int) -> tuple[dict[str, Any], ...]:
    draws = ext.draws(400, seed)
    low, middle, high = np.quantile(draws, (0.05, 0.5, 0.95), axis=0)
    named = [(i, p) for i, p in enumerate(ext.model.parameters) if ext.kind[i] != "held"]
    # the laws first, then the linear parameters estimated along
    named.sort(key=lambda item: (item[1].param is None or item[1].name.startswith("constant"), item[0]))
    out: list[dict[str, Any]] = []
    modes, omega = ext.model.linear.modes, ext.model.linear.omega
    for i, p in named:
        name, unit, factor = p.name, p.unit, 1.0
        if modes <= i < 2 * modes and omega[i - modes] < RIGID:
            # a rigid body has no damping ratio: viscous damping over mass
            name, unit, factor = f"damping[{i - modes + 1}]", "1/s", 2 * float(omega[i - modes])
        meaning = of_linear(name) if p.param is None else p.param.meaning
        out.append({"name": name, "unit": unit, "q05": factor * float(low[i]), "q50": factor * float(middle[i]),
                    "q95": factor * float(high[i]), "meaning": meaning})
    for suspect in ext.suspects:
        if suspect.law is not None:
            out += known(suspect.law, suspect.place, strength(suspect, ext).tolist(), suspect.law.term.name)
    return tuple(out)


def _where(found: Evidence) -> dict[str, Any]:
    table: dict[str, float] = {}
    for key, p in found.odds.items():
        for place in {place for _, place in key}:
            if place != "-":
                table[place] = table.get(place, 0.0) + p
    ranked = sorted(table.items(), key=lambda kv: -kv[1])[:8]
    best = leading(found)
    alike = _alike(found, best) if best is not None else {}
    locations = [{"name": n, "probability": min(p, 1.0), "indistinguishable_from": [m for m in alike.get(n, []) if m != n]}
                 for n, p in ranked]
    onset, unit, phase = 0.0, "m", "-"
    if best is not None:
        suspect = best.suspects[0]
        phase = ROWS[suspect.cls].phase
        onset = onset_of(suspect, strength(suspect, found.best) if found.named is best else suspect.parameters(best.factors[0]))
    return {"locations": locations, "amplitude": {"onset": onset, "unit": unit}, "band_hz": _band(found, best), "time": _time(best),
            "phase": phase, "records": [t.name for t in found.campaign.used("fit")]}


def leading(found: Evidence) -> Weighed | None:
    """The hypothesis that is reported: the estimated one, else the likeliest."""
    if found.named is not None:
        return found.named
    weighed = {w.key: w for w in (*found.pairs, *found.singles)}
    likely = [k for k, _ in sorted(found.odds.items(), key=lambda kv: -kv[1]) if k in weighed]
    return weighed[likely[0]] if likely and found.odds.get((), 0.0) < 0.5 else None


def _alike(found: Evidence, best: Weighed) -> dict[str, list[str]]:
    """Places at which the same class explains the recordings as well as at the first, within the error of the difference."""
    out: dict[str, list[str]] = {}
    for suspect in best.suspects:
        same = [w for w in found.singles if w.suspects[0].cls == suspect.cls]
        own = next((w for w in same if w.suspects[0].place == suspect.place), None)
        if own is None:
            continue
        names = [w.suspects[0].place for w in same if own.gain - w.gain < 2 + spread(own.blocks - w.blocks) + 0.02 * max(own.gain, 0)]
        for n in names:
            out[n] = names
    return out


def _time(best: Weighed | None) -> str:
    if best is None:
        return "throughout"
    if any(c == "stiffness_drift" for c, _ in best.key):
        return "drifts"
    gains = np.sort(np.maximum(best.blocks, 0))[::-1]
    few = max(1, len(gains) // 6)
    return "bursts" if gains.sum() > 0 and gains[:few].sum() > 0.8 * gains.sum() else "throughout"


def _band(found: Evidence, best: Weighed | None) -> list[float]:
    """Frequencies that hold 80 % of what the best hypothesis adds to the innovations."""
    top = found.campaign.top
    if best is None:
        return [0.0, top]
    desk = max(found.scale.bench.desks, key=lambda d: d.trial.level)
    at = 0
    for d in found.scale.bench.desks:
        if d is desk:
            break
        at += (d.n - d.skip) * len(d.trial.recording.channels)
    s = len(desk.trial.recording.channels)
    wave = best.column[at:at + (desk.n - desk.skip) * s].reshape(-1, s)
    power = (np.abs(np.fft.rfft(wave * np.hanning(len(wave))[:, None], axis=0)) ** 2).sum(axis=1)
    f = np.fft.rfftfreq(len(wave), desk.trial.recording.dt)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return [float(f[min(int(np.searchsorted(share, q)), len(f) - 1)]) for q in (0.1, 0.9)]


def onset_of(suspect: Suspect, p: Array) -> float:
    """Motion (m) above which a law departs from a linear one; 0 for laws that act at any motion."""
    if suspect.law is None or suspect.law.onset is None:
        return 0.0
    return suspect.law.onset(p, 0.0 if suspect.size is None else suspect.size.peak)


def _each(found: Evidence) -> list[dict[str, Any]]:
    """Errors of every judged record in the unit of its first channel."""
    out = []
    for t in found.campaign.used("judge"):
        y, three = t.recording.response, found.shown[t.name]
        first = max(s.first for s in three)
        rmse = [float(np.sqrt(np.mean((y - s.wave)[first:, 0] ** 2))) for s in three]
        out.append({"record": t.name, "rmse_nominal": rmse[0], "rmse_updated_linear": rmse[1], "rmse_extended": rmse[2],
                    "rms": float(np.sqrt(np.mean(y[first:, 0] ** 2))), "noise": float(t.noise[0]), "scored_from_s": first * t.recording.dt})
    return out


def retuned(found: Evidence) -> list[str]:
    """What the re-tuning of the linear model changed, where it lies beyond the stated tolerance."""
    out = []
    before, after, tolerance = start_of(found.campaign, nominal=True), found.tuned, found.campaign.tolerances
    if after.status.startswith("not") or "failed" in after.status:
        return [f"The linear model could not be re-tuned by simulation: {after.status}."]
    omega, _ = after.model.linear_values(after.theta)
    for i, w in enumerate(omega):
        if w >= RIGID:
            old = float(before.modal.omega[i])
            change = w / old - 1
            if abs(change) > 3 * tolerance.get("frequency", 0.05):
                out.append(f"Mode {i + 1} was re-tuned from {old / 2 / np.pi:.4g} to {w / 2 / np.pi:.4g} Hz, beyond its tolerance: "
                           "stiffness or mass of the nominal model is off; these records cannot say which.")
    gain = after.model.gain(after.theta)
    if gain is not None and abs(float(gain) - 1) > 3 * tolerance.get("gain", 0.05):
        out.append(f"The measured force had to be multiplied by {float(gain):.3g}: the force cell, or the mass of the model, is off.")
    return out


def _statuses(found: Evidence) -> list[str]:
    out = []
    for name, three in found.shown.items():
        for s, what in zip(three, ("nominal", "re-tuned", "extended"), strict=True):
            if s.status != "ok":
                out.append(f"Record {name} could not be simulated with the {what} model: {s.status}.")
    if found.best.status == "iteration limit":
        out.append("The joint estimate stopped at its limit of iterations.")
    return out


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %" if np.isfinite(value) else "unknown"


def _sentence(found: Evidence, verdict: str, p: float, hypotheses: tuple[Named, ...], where: dict[str, Any]) -> str:
    s = found.scores
    many = len(found.shown) != 1
    end = (f"On {len(found.shown)} record{'s' if many else ''} that {'were' if many else 'was'} not used the error "
           f"is {_percent(s['nominal'])} as delivered and {_percent(s['updated'])} with the best linear re-tuning")
    noise = "sensor noise is negligible" if s["noise"] < 1e-5 else f"sensor noise alone makes {_percent(s['noise'])}"
    if verdict == "none":
        return f"Beyond what a re-tuned linear model explains nothing was found (probability {100 * (1 - p):.0f} %). {end}; {noise}."
    top = next(h for h in hypotheses if h.effects != (("none", "-"),))
    place = next((q for _, q in top.effects if q != "-"), "-")
    alike: list[str] = next((x["indistinguishable_from"] for x in where["locations"] if x["name"] == place), [])
    places = place + (f" (not to be told from {', '.join(alike)})" if alike else "")
    words = top.sentence.replace(place, places, 1) if place != "-" else top.sentence
    share = _listed(hypotheses, top.effects)
    own = {c for c, _ in top.effects}
    rivals = [h for h in hypotheses if h.effects != (("none", "-"),) and {c for c, _ in h.effects} != own]
    rival = max(rivals, key=lambda h: _listed(hypotheses, h.effects), default=None)
    follow = f"; next, {rival.sentence} ({whole_percent(_listed(hypotheses, rival.effects))})" \
        if rival is not None and _listed(hypotheses, rival.effects) > WORTH_SAYING else ""
    helped = found.named is not None
    end = end.replace(" and ", ", ") if helped else end
    proof = f", and {_percent(s['extended'])} with what was found" if helped else ""
    lead = "The recordings differ from any linear model" if verdict == "mismatch" else "It cannot be told for sure what is missing"
    onset, phase = where["amplitude"], PHASES.get(where["phase"], "")
    how = f"; it grows with amplitude from about {size_of(onset['onset'], onset['unit'])}" if onset["onset"] > 0 else ""
    how += f"; {phase}" if phase else ""
    return f"{lead} (p {sure(p)}). Likeliest: {words} ({whole_percent(share)}){how}{follow}. {end}{proof}; {noise}."


def _listed(hypotheses: tuple[Named, ...], effects: Key) -> float:
    """Probability of all listed hypotheses of the same classes."""
    own = {c for c, _ in effects}
    return sum(h.probability for h in hypotheses if {c for c, _ in h.effects} == own)


def _sealed(found: Evidence) -> dict[str, Array]:
    out: dict[str, Array] = {}
    for t in found.campaign.used("sealed"):
        wave, _, status = predict(found.linear, found.drive, found.best, t)
        if status != "ok":
            wave, _, _ = predict(found.linear, found.drive, found.tuned, t)
        wave = np.nan_to_num(wave)
        half = found.bands[1].factor * found.bands[1].sd(wave, t.recording.fs)
        for tag, value in zip(("q05", "q50", "q95"), (wave - half, wave, wave + half), strict=True):
            out[f"{t.name}_accel_{tag}"] = value
    return out


def _figures(found: Evidence) -> dict[str, NDArray[Any]]:
    """Numbers behind the figures."""
    ranked = sorted(found.odds.items(), key=lambda kv: -kv[1])[:LISTED]
    names = [" + ".join(f"{c}@{p}" for c, p in key) or "none" for key, _ in ranked]
    return portrait(found, leading(found)) | {"hypothesis_names": np.array(names),
                                              "hypothesis_probability": np.array([p for _, p in ranked])}
