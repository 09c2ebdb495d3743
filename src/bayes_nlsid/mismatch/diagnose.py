"""All steps in order: read, detect, calibrate, search, compare on records not used, predict, put into words."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit, calibrate, descend, finish
from bayes_nlsid.mismatch.case import Case, CaseRecord, read_case
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.cell import Heard, heard, straightened, without
from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.mismatch.disturb import Disturbance, disturbances, without_hum
from bayes_nlsid.mismatch.effects import Effect, pack, unpack
from bayes_nlsid.mismatch.evidence import Evidence, gather, level_transfer
from bayes_nlsid.mismatch.explain import sizes
from bayes_nlsid.mismatch.linear import Family
from bayes_nlsid.mismatch.paths import bed
from bayes_nlsid.mismatch.polish import Bench, Hypothesis
from bayes_nlsid.mismatch.probability import SHIPPED, Key, Layer, Score, Scores, probabilities
from bayes_nlsid.mismatch.prove import Bands, Predictor, calibrate_bands, elpd_difference, nrmse
from bayes_nlsid.mismatch.reduced import family
from bayes_nlsid.mismatch.rivals import Rival, all_rivals, on_trial
from bayes_nlsid.mismatch.search import Found, search
from bayes_nlsid.mismatch.spectra import Spectra, burst_spectra, noise_density, steady_spectra
from bayes_nlsid.mismatch.words import known

Array = NDArray[np.float64]
Progress = Callable[[str], None]


@final
@dataclass(frozen=True)
class Analysis:
    """Everything found in a case before it is put into words; what the probability layer is fitted on.

    ``as_read``: the case before the curve of a bent force cell was straightened (mostly the same).
    """

    case: Case
    as_read: Case
    evidence: Evidence
    family: Family
    fit: LinearFit
    rivals: tuple[Rival, ...]
    scores: Scores
    found: Found
    held: tuple[CaseRecord, ...]
    noise: Array
    notes: tuple[str, ...]


def diagnose(path: str | Path | Case, seed: int = 0, progress: Progress | None = None, layer: Layer = SHIPPED) -> Diagnosis:
    """Locate the mismatch of a case, name what is missing, add it and test it on records not used.

    Parameters
    ----------
    path : case folder, or a Case.
    seed : int
        For the draws behind parameter intervals.
    progress : callable or None
        Told in words what is being done.
    layer : Layer
        Numbers that turn scores into probabilities.

    Raises
    ------
    InputError
        If the folder cannot be used at all.
    """
    begun = clock.perf_counter()
    case = path if isinstance(path, Case) else read_case(path)
    say = progress or (lambda text: None)
    analysis = analyse(case, say)
    from bayes_nlsid.mismatch.answer import answer

    return answer(analysis, seed, layer, begun, say)


def analyse(case: Case, say: Progress) -> Analysis:
    """Everything but the words: evidence, calibration, all rivals with their gains."""
    notes = list(case.notes)
    spectra, held, floor = _groups(case, notes)
    raw, humming = spectra, without_hum(case, spectra)
    if humming is not case:
        spectra, held, floor = _groups(humming, [])
    evidence = gather(spectra, case.band, case.mains)
    fam = family(case)
    say("calibrating the linear model")
    linear = not evidence.statistic > 1.1
    # one that a strong law has bent is not begun from many starts, but from where the other calibrations end
    fit = calibrate(fam, spectra.s[evidence.excited], evidence.H, evidence.variance, restarts=6 if linear else 0 if evidence.strong else 2)
    as_read, between = case, heard(spectra, fam, fit, case.band)
    if between is not None and between.real:
        evidence = gather(without(spectra, between), case.band, case.mains)
    elif between is not None and (straight := straightened(case, spectra)) is not None:
        case = straight
        spectra, held, floor = _groups(without_hum(case, spectra), [])
        evidence = gather(spectra, case.band, case.mains)
        fit = calibrate(fam, spectra.s[evidence.excited], evidence.H, evidence.variance, restarts=2)
    others = () if linear else _one_level(fam, evidence)
    fit = _cheapest(fam, fit, others) if evidence.strong else fit
    bench = _bench(case, fam, fit, evidence)
    say("searching laws, places and channels")
    places = list(fam.places)
    found = search(bench, fit, places, case.band, say, others)
    fit = found.fit
    noisy = disturbances(case, raw if raw.kind == "steady" else None, fam, fit.fields.modes) + cell_fault(case, between)
    rivals = all_rivals(case, bench, fit, found, floor, noisy, say)
    say("running the leading explanations on records that were not used")
    rivals, held_none = on_trial(case, bench, fit, rivals, held, floor)
    return Analysis(case, as_read, evidence, fam, fit, tuple(rivals), _scores(evidence, fit, found, rivals, held_none), found, held, floor,
                    tuple(notes))


def cell_fault(case: Case, between: Heard | None) -> list[Disturbance]:
    """Force that only the cell reads, as a disturbance as large as the response it should have had."""
    if between is None or between.real:
        return []
    rms = float(np.sqrt(np.mean(case.loudest.accel[:, case.usable] ** 2)))
    return [Disturbance("other", "FORCE", between.gain, between.size * rms, "curve of the force cell")]


def _groups(case: Case, notes: list[str]) -> tuple[Spectra, tuple[CaseRecord, ...], Array]:
    """Records to fit, records never fitted, and the noise rms per usable channel."""
    steady, bursts = case.select("steady"), case.select("burst")
    if steady:
        held: tuple[CaseRecord, ...] = bursts
        used = steady
        if not bursts and len(steady) >= 4:
            held = (max(steady[1:], key=lambda r: (r.level, r.start)),)
            used = tuple(r for r in steady if r is not held[0])
            notes.append(f"No burst is available: record {held[0].name} is kept aside to judge predictions.")
        spectra = steady_spectra(case, used)
    else:
        held = (bursts[-1],) if len(bursts) > 1 else ()
        used = bursts[:-1] if len(bursts) > 1 else bursts
        density, how = noise_density(case, None)
        notes.append(f"Noise is taken from the {how}.")
        longest = max(len(r.force) for r in used)
        same = tuple(r for r in used if len(r.force) == longest)
        if len(same) < len(used):
            notes.append("Bursts of different lengths: only the longest are fitted.")
        spectra = burst_spectra(case, same, density)
    density, _ = noise_density(case, spectra if spectra.kind == "steady" else None)
    rms = np.sqrt(density.mean(0))
    offs = [r for r in case.records if r.kind == "off" and not r.sealed]
    if offs:
        rms = np.maximum(rms, offs[0].accel[:, case.usable].std(0))
    if not held:
        notes.append("No record is left that was not fitted: an improvement cannot be proved.")
    return spectra, held, rms


def _bench(case: Case, fam: Family, fit: LinearFit, evidence: Evidence) -> Bench:
    K = fam.K_parts.sum(0) + fam.K_rest
    stiffness = {k: 1 / max(float(v @ np.linalg.solve(K, v)), 1e-30) for k, v in fam.places.items()}
    rows = np.array(list(fam.places.values())) if fam.places else np.zeros((0, len(K)))
    scale = sizes(bed(fit.fields.modes, evidence.spectra, rows, fam.shaker), list(fam.places)) if len(rows) else {}
    return Bench(fam, evidence, case.channels, _mass_scale(case), stiffness, scale)


def _one_level(fam: Family, evidence: Evidence) -> tuple[LinearFit, ...]:
    """Calibrations to the lowest level alone, and to all levels as far as the mean is not bent by what is not linear."""
    found = [level_transfer(evidence), (evidence.H, evidence.doubted(evidence.residual))]
    restarts = 1 if evidence.strong else 4
    return tuple(calibrate(fam, evidence.spectra.s[evidence.excited], *f, restarts=restarts) for f in found if f is not None)


def _cheapest(fam: Family, fit: LinearFit, others: tuple[LinearFit, ...]) -> LinearFit:
    """The calibration, or what it becomes from where another one ended: one of a bent transfer function is not begun from many starts."""
    for other in others:
        theta, _, _ = descend(fam, other.theta, fit.s, fit.measured, fit.variance, 25, tol=0.05)
        fit = min(fit, finish(fam, theta, fit.s, fit.measured, fit.variance, status=fit.status), key=lambda f: f.cost)
    return fit


def _mass_scale(case: Case) -> float:
    """Five per cent of the moving mass (of the rigid motion of the base if that is stated)."""
    r = case.base if np.abs(case.base).any() else case.shaker
    total = float(r @ case.M @ r) / max(float(np.abs(r).max()) ** 2, 1e-300)
    return max(0.05 * total, 1e-9)


def _scores(evidence: Evidence, fit: LinearFit, found: Found, rivals: list[Rival], held_none: float) -> Scores:
    items = tuple(Score(r.key, float(r.gain), float(r.alone), r.strength, r.visible, r.rest, r.held, r.faint, r.incoherent)
                  for r in rivals)
    best = next((r.hypothesis for r in rivals if r.hypothesis is not None), None)
    total = evidence.values + fit.dof
    leftover = found.none if best is None else best.misfit_records + best.fit.cost
    above = max(evidence.chi2 - evidence.values, 0.0)
    unexplained = 0.0
    if above > 12 * np.sqrt(2 * evidence.values):
        unexplained = 1.0 if best is None else float(np.clip((best.misfit_records - evidence.values) / above, 0, 1))
    linear = (fit if best is None else best.fit).cost / fit.dof
    return Scores(items, unexplained, float(max(leftover / total, 1.0)), float(linear), held_none)


def intervals(h: Hypothesis, effect: Effect, dispersion: float, seed: int) -> tuple[dict[str, Any], ...]:
    """5, 50 and 95 % quantiles of the parameters of one effect from the curvature at the optimum (Laplace)."""
    rng = np.random.default_rng(seed)
    if effect.cls == "linear_stiffness" or not effect.is_force:
        return _linear_intervals(h, effect, dispersion, rng)
    edge = 0
    for e in h.forces:
        count = len(pack(e))
        if e is effect:
            break
        edge += count
    covariance = np.linalg.pinv(h.curvature)[edge:edge + count, edge:edge + count] * dispersion
    x0 = pack(effect)
    draws = rng.multivariate_normal(x0, (covariance + covariance.T) / 2 + 1e-12 * np.eye(count), size=400, method="eigh")
    out = []
    free = list(range(len(effect.values))) if effect.law is None else [i for i, k in enumerate(effect.law.free) if k != "fixed"]
    drawn = np.array([unpack(effect, x, effect).values for x in draws])   # inside the ranges of the law
    for i in free:
        q = np.quantile(drawn[:, i], [0.05, 0.5, 0.95])
        out.append({"name": f"{effect.cls}[{effect.place}].{effect.names[i]}", "unit": effect.units[i],
                    "q05": float(q[0]), "q50": float(q[1]), "q95": float(q[2]),
                    "meaning": "" if effect.law is None else effect.law.term.params[i].meaning})
    return tuple(out) if effect.law is None else (*out, *known(effect.law, effect.place, effect.values.tolist(), effect.cls))


def _linear_intervals(h: Hypothesis, effect: Effect, dispersion: float, rng: np.random.Generator) -> tuple[dict[str, Any], ...]:
    covariance = np.linalg.pinv(h.fit.normal) * dispersion
    if effect.cls == "linear_stiffness":
        value = np.log(float(effect.values[0]))
        # the index of the place among the scales is where theta reproduces the value
        i = int(np.argmin(np.abs(h.fit.theta - value)))
        q = np.exp(value + np.sqrt(covariance[i, i]) * np.array([-1.645, 0, 1.645]))
        return ({"name": f"linear_stiffness[{effect.place}].factor", "unit": "", "q05": float(q[0]), "q50": float(q[1]),
                 "q95": float(q[2])},)
    edge = 0
    kinds = list(h.kinds)
    for e in h.effects:
        if e.is_force or e.cls == "linear_stiffness":
            continue
        k = kinds.pop(0)
        if e is effect:
            first = len(h.fit.theta) + edge
            x = h.fit.x[edge:edge + len(k.start)]
            block = covariance[first:first + len(x), first:first + len(x)]
            draws = rng.multivariate_normal(x, (block + block.T) / 2 + 1e-14 * np.eye(len(x)), size=400, method="eigh")
            values = np.array([np.atleast_1d(k.natural(d)) for d in draws])
            q = np.quantile(values, [0.05, 0.5, 0.95], axis=0)
            return tuple({"name": f"{e.cls}[{e.place}].{n}", "unit": u, "q05": float(q[0, j]), "q50": float(q[1, j]), "q95": float(q[2, j])}
                         for j, (n, u) in enumerate(zip(k.names, k.units, strict=True)))
        edge += len(k.start)
    return ()


@final
@dataclass(frozen=True)
class Proof:
    """Held-out comparison of the model as delivered, re-tuned and extended.

    ``records``: names; ``nominal``, ``updated``, ``extended``, ``noise``: NRMSE over them; ``elpd``, ``elpd_se``;
    ``withdrawn``: the extension made a held-out record worse; ``bands``: of the model finally used; ``coverage``: on the same records.
    """

    records: tuple[str, ...]
    nominal: float
    updated: float
    extended: float
    noise: float
    elpd: float
    elpd_se: float
    withdrawn: bool
    bands: Bands
    coverage: float
    waves: dict[str, Array]


def prove(analysis: Analysis, rival: Rival | None) -> tuple[Proof, Predictor]:
    """Run the held-out records with all models; the predictor that comes back is the one that may be used."""
    case, spectra = analysis.case, analysis.evidence.spectra
    channels = int(case.usable.sum())
    updated = Predictor(analysis.family, analysis.fit, None, channels, (), spectra)
    extended = updated
    if rival is not None and rival.hypothesis is not None:
        extended = Predictor(analysis.family, rival.hypothesis.fit, rival.hypothesis, channels, rival.clip, spectra)
    elif rival is not None and rival.clip:
        extended = replace(updated, clip=rival.clip)
    nominal = Predictor(analysis.family, None, None, channels, (), spectra)
    held = analysis.held or ()
    if not held:
        held = tuple(r for r in case.records if not r.sealed and r.kind != "off")[:1]
    measured = [r.accel[:, case.usable] for r in held]
    read = {r.name: r for r in analysis.as_read.records}    # a bent cell is missing from the nominal model and from the re-tuned one
    runs = {name: [p.run(case, read[r.name] if name != "extended" else r) for r in held]
            for name, p in (("nominal", nominal), ("updated", updated), ("extended", extended))}
    waves = {name: [w for w, _ in many] for name, many in runs.items()}
    bad = any(not np.isfinite(w).all() for w in waves["extended"]) or any(s != "ok" for _, s in runs["extended"])
    errors = {name: float(np.sqrt(sum(((m - w) ** 2).sum() for m, w in zip(measured, many, strict=True))
                                  / sum((m ** 2).sum() for m in measured))) for name, many in waves.items()}
    worse = any(nrmse(m, e) > 1.01 * nrmse(m, u) for m, e, u in zip(measured, waves["extended"], waves["updated"], strict=True))
    withdrawn = bool(extended is not updated and (worse or (bad and errors["extended"] > 0.9 * errors["updated"]) or
                                                  not np.isfinite(errors["extended"])))
    chosen, name = (updated, "updated") if withdrawn else (extended, "extended")
    bands = calibrate_bands(analysis.noise, measured, waves[name], case.rate)
    first = calibrate_bands(analysis.noise, measured, waves["updated"], case.rate)
    y, p = np.concatenate(measured), np.concatenate(waves[name])
    alike = all(np.array_equal(a, b) for a, b in zip(waves[name], waves["updated"], strict=True))
    elpd, se = (0.0, 0.0) if alike else elpd_difference(y, np.concatenate(waves["updated"]), p, first, bands, case.rate)
    coverage = float((np.abs(y - p) < bands.factor * bands.sd(p, case.rate)).mean())
    floor = float(np.sqrt((analysis.noise ** 2).mean() / np.mean([(m ** 2).mean() for m in measured])))
    stored = {"measured": measured[0], "nominal": waves["nominal"][0], "updated": waves["updated"][0], "extended": waves[name][0]}
    return Proof(tuple(r.name for r in held), errors["nominal"], errors["updated"], errors[name], floor, elpd, se, withdrawn, bands,
                 coverage, stored), chosen


def claim(effect: tuple[str, str]) -> str:
    """What a hypothesis says in words."""
    cls, place = effect
    return ROWS[cls].claim.format(place=place if place != "-" else "an unknown place") if cls in ROWS else f"{cls} at {place}"


def rank(analysis: Analysis, layer: Layer) -> dict[Key, float]:
    """Probability of every hypothesis in the vocabulary of the case."""
    known = {*analysis.case.classes, "other"}
    odds = {key: p for key, p in probabilities(analysis.scores, layer).items() if all(cls in known for cls, _ in key)}
    total = sum(odds.values())
    return {key: p / total for key, p in odds.items()}


__all__ = ["Analysis", "Named", "Proof", "Rival", "analyse", "claim", "diagnose", "intervals", "prove", "rank"]
