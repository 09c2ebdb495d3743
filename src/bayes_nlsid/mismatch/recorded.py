"""The mismatch engine for recordings of any kind: calibrate the linear model, detect, locate, name, model, prove.

Steps: (1) the linear model is re-tuned to the innovations and then to the simulated channels; (2) every suspect of the catalogue is
weighed on the bench, then pairs; (3) the leaders are put into the model and estimated jointly by forward simulation; (4) records that
were not fitted are simulated with the nominal, the re-tuned and the extended model; (5) what does not help there is withdrawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrated import Drive, Linear, best_drive
from bayes_nlsid.mismatch.campaign import RIGID, Campaign, Trial
from bayes_nlsid.mismatch.contest import Entrant, compared, enter_linear, errors_by_block, fallen, hold, lead, polished, second
from bayes_nlsid.mismatch.forward import Extended, extended, predict, simulated
from bayes_nlsid.mismatch.innovations import Bench, lay_out
from bayes_nlsid.mismatch.observer import Modal
from bayes_nlsid.mismatch.odds import Findings, Key, bench_findings, odds_of
from bayes_nlsid.mismatch.prove import Bands, calibrate_bands, elpd_difference
from bayes_nlsid.mismatch.refit import refitted
from bayes_nlsid.mismatch.settled import linear_at
from bayes_nlsid.mismatch.suspects import Suspect
from bayes_nlsid.mismatch.weigh import Scale, Weighed, doubles, scale_of, weigh

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
RETUNINGS = 3
SANE = float(np.log(0.5))   # block error (logarithm of its square) up to which a simulated linear model is believed
WORSE = 1.02


def silent(share: float, sentence: str) -> None:
    """The default progress: nothing."""


@final
@dataclass(frozen=True, eq=False)
class Shown:
    """What a model makes of one record that was not fitted: simulated channels, first scored sample, status."""

    wave: Array
    first: int
    status: str


@final
@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything found, before it is put into words.

    Parameters
    ----------
    campaign : Campaign
    linear : Linear
        Re-tuned.
    drive : Drive
    scale : Scale
    singles, pairs : tuple of Weighed
    odds : dict
        Probability of every hypothesis.
    tuned, best : Extended
        The best linear model and the best model with what was found, both estimated by forward simulation.
    named : Weighed or None
        The hypothesis that ``best`` carries; None if nothing is claimed or the claim was withdrawn.
    shown : dict of str to tuple of Shown
        For every judged record: nominal, re-tuned, extended.
    scores : dict of str to float
        NRMSE of the three, noise floor, ELPD difference with standard error, coverage.
    bands : tuple of Bands
        Of the re-tuned and of the extended model.
    withdrawn : bool
    notes : tuple of str
    rivals : tuple of Entrant
        Hypotheses that were estimated by simulation.
    findings : Findings
        What the odds were made from.
    """

    campaign: Campaign
    linear: Linear
    drive: Drive
    scale: Scale
    singles: tuple[Weighed, ...]
    pairs: tuple[Weighed, ...]
    odds: dict[Key, float]
    tuned: Extended
    best: Extended
    named: Weighed | None
    shown: dict[str, tuple[Shown, Shown, Shown]]
    scores: dict[str, float]
    bands: tuple[Bands, Bands]
    withdrawn: bool
    notes: tuple[str, ...]
    rivals: tuple[Entrant, ...]
    findings: Findings


def start_of(campaign: Campaign, nominal: bool = False) -> Linear:
    """The linear model as delivered, or where calibration starts."""
    model = campaign.nominal if nominal else campaign.start
    stiffness = np.where(model.omega < RIGID, 0.0, model.omega ** 2)
    return Linear(model, Modal(stiffness, 2 * model.zeta * model.omega), 1.0, np.zeros(len(model.inputs)))


def calibrate(campaign: Campaign, say: Progress = silent) -> tuple[Entrant, Bench]:
    """The linear model fitted to the recordings and then by simulation, and its innovations.

    Frequencies, damping and the mode shapes at the channels come from simulation; stiffness and damping then move to where the innovations
    say as long as they gain, which is all there is to do for rigid bodies.
    """
    say(0.0, "calibrating the linear model")
    linear = refitted(campaign, start_of(campaign))
    trials = campaign.used("fit")
    tuned = enter_linear(campaign, linear, best_drive(linear, trials, [linear.forces(t) for t in trials]))
    if not tuned.failed and float(np.median(tuned.blocks)) < SANE:
        linear = replace(linear_at(linear, tuned.model, tuned.model.theta), seen=tuned.model.seen)
    say(0.05, "calibrating the linear model")
    bench = lay_out(campaign, linear)
    for _ in range(RETUNINGS):
        tried = lay_out(campaign, _moved(bench.linear, bench), drive=bench.drive)
        if not likelihood(tried) > likelihood(bench):
            break
        bench = tried
    return tuned, bench


def likelihood(bench: Bench) -> float:
    """Of all innovations."""
    return float(sum(d.smoothed.likelihood for d in bench.desks))


def _moved(linear: Linear, bench: Bench) -> Linear:
    found = dict(zip(bench.columns, bench.coefficients, strict=True))
    m = linear.model.modes
    k, c = linear.modal.stiffness, linear.modal.damping
    dk, dc = (np.array([found.get(f"{what}[{i + 1}]", 0.0) for i in range(m)]) for what in ("stiffness", "damping"))
    stiffness = np.where(k > 0, np.clip(k + dk, 0.5 * k, 2 * k), 0.0)
    # modes must keep their order, and damping stay positive
    if (np.diff(stiffness) < 0).any():
        stiffness = k
    return replace(linear, modal=Modal(stiffness, np.clip(c + dc, np.maximum(0.2 * c, 1e-6), np.maximum(5 * c, 1e-3))))


def analyse(campaign: Campaign, say: Progress = silent) -> Evidence:
    """Run all steps."""
    linear_one, bench = calibrate(campaign, say)
    linear, drive = bench.linear, bench.drive
    scale = scale_of(bench, campaign.places, campaign.classes, campaign.mains)
    singles = weigh(scale, lambda share: say(0.2 + 0.1 * min(share, 2.0), "weighing every suspect"))
    pairs = doubles(scale, singles, progress=lambda share: say(0.4 + 0.1 * share, "weighing pairs"))
    singles, pairs, notes = _one_linear_reading(campaign, singles, pairs)
    values = float(bench.counts.sum())
    findings = bench_findings(singles, pairs, values)
    odds = odds_of(findings)
    rivals = hold(campaign, bench, linear_one, singles, pairs, odds, say)
    findings = replace(findings, simulated=compared(rivals), lead=lead(linear_one, rivals), beside=second(rivals))
    tuned = linear_one.model
    nominal = extended(start_of(campaign, nominal=True), (), (), [t.recording for t in campaign.trials], freed=False)
    say(0.85, "simulating records that were not used")
    plain = {t.name: (_shown(start_of(campaign, nominal=True), drive, nominal, t), _shown(linear, drive, tuned, t))
             for t in campaign.used("judge")}
    leader, shown, bands, scores, failed = linear_one, _with(plain, None), (_bands(campaign, linear_one.waves),) * 2, {}, []
    for rival in (*_standing(linear_one, rivals, odds_of(findings)), linear_one):
        leader = polished(campaign, bench, rival)
        shown = _with(plain, {t.name: _shown(linear, drive, leader.model, t) for t in campaign.used("judge")} if leader.weighed else None)
        bands = (_bands(campaign, linear_one.waves), _bands(campaign, leader.waves))
        scores = score_all(campaign, shown, bands)
        if leader.weighed is None or not scores["extended"] > WORSE * scores["updated"]:
            break
        failed.append(leader.weighed.key)
    best, named = leader.model, leader.weighed
    withdrawn = named is None and bool(failed)
    notes += tuple(f"With {' and '.join(f'{c} at {p}' for c, p in key)} the records that were not used are simulated worse than with the "
                   "re-tuned linear model; it was withdrawn." for key in failed)
    notes += tuple(f"Record {n} is simulated worse with what was found than without it, though all together are simulated better."
                   for n in worse(campaign, shown))
    findings = replace(findings, judged=_judged(campaign, shown) if named is not None else (0.0, 0.0),
                       unexplained=_unexplained(scores, linear_one, leader) if named is not None else 0.0,
                       left=scores["extended"], noise=scores["noise"], withdrawn=tuple(failed))
    odds = odds_of(findings)
    return Evidence(campaign, linear, drive, scale, tuple(singles), tuple(pairs), odds, tuned, best, named, shown, scores, bands, withdrawn,
                    notes, tuple(rivals), findings)


def _one_linear_reading(campaign: Campaign, singles: list[Weighed], pairs: list[Weighed]
                        ) -> tuple[list[Weighed], list[Weighed], tuple[str, ...]]:
    """A single record, or free decays each quieter than the one before, cannot tell a drift from an effect that follows the amplitude: a
    drift is kept as a rival only where they can."""
    fit = sorted(campaign.used("fit"), key=lambda t: t.recording.start)
    if len(fit) > 1 and not (all(t.recording.free for t in fit) and bool(np.all(np.diff([t.level for t in fit]) < 0))):
        return singles, pairs, ()

    def fine(w: Weighed) -> bool:
        return all(cls != "stiffness_drift" for cls, _ in w.key)

    return [w for w in singles if fine(w)], [w for w in pairs if fine(w)], ()


def _standing(tuned: Entrant, rivals: Sequence[Entrant], odds: dict[Key, float]) -> list[Entrant]:
    """Rivals that simulate the fitted records better than the linear model does, likeliest first."""
    level = float(tuned.blocks.mean()) if not tuned.failed else np.inf
    able = [r for r in rivals if r.weighed is not None and not r.failed and float(r.blocks.mean()) < level]
    return sorted(able, key=lambda r: -odds.get(r.weighed.key if r.weighed is not None else (), 0.0))


def _with(plain: dict[str, tuple[Shown, Shown]], extended: dict[str, Shown] | None) -> dict[str, tuple[Shown, Shown, Shown]]:
    """Nominal, re-tuned and extended; without an extension the re-tuned model stands in its place."""
    return {name: (a, b, b if extended is None else extended[name]) for name, (a, b) in plain.items()}


def _judged(campaign: Campaign, shown: dict[str, tuple[Shown, Shown, Shown]]) -> tuple[float, float]:
    """What records that were not fitted say for the extended model against the re-tuned one."""
    trials = campaign.used("judge")
    if not trials:
        return 0.0, 0.0
    first = [max(s.first for s in shown[t.name]) for t in trials]
    before, after = (errors_by_block(trials, [shown[t.name][i].wave for t in trials], first) for i in (1, 2))
    return fallen(before, after)


def worse(campaign: Campaign, shown: dict[str, tuple[Shown, Shown, Shown]]) -> list[str]:
    """Names of judged records that the extended model simulates worse than the re-tuned one."""
    out = []
    for t in campaign.used("judge"):
        first = max(s.first for s in shown[t.name])
        before, after = (float(np.mean((t.recording.response - shown[t.name][i].wave)[first:] ** 2)) for i in (1, 2))
        if after > WORSE ** 2 * before + float(np.mean(t.noise ** 2)):
            out.append(t.name)
    return out


def _shown(linear: Linear, drive: Drive, ext: Extended, trial: Trial) -> Shown:
    return Shown(*predict(linear, drive, ext, trial))


def _bands(campaign: Campaign, waves: Sequence[Array]) -> Bands:
    """Width of predictive bands from the fitted records."""
    trials = simulated(campaign)
    noise = trials[0].noise
    if len(waves) != len(trials):
        size = np.std(trials[0].recording.response, axis=0)
        return Bands(noise + 1e-9 * size, np.ones(len(noise)), 1.645)
    measured = [t.recording.response[:len(w)] for t, w in zip(trials, waves, strict=True)]
    found = calibrate_bands(np.maximum(noise, 1e-9 * np.std(measured[0], axis=0)), measured, list(waves), trials[0].recording.fs)
    return Bands(found.noise, found.relative, float(max(found.factor, 1.645)))


def score_all(campaign: Campaign, shown: dict[str, tuple[Shown, Shown, Shown]], bands: tuple[Bands, Bands]) -> dict[str, float]:
    """NRMSE over all judged records together, each relative to its own response, and what block differences say."""
    sums = {name: [] for name in ("nominal", "updated", "extended", "noise", "coverage", "elpd", "variance")}  # type: dict[str, list[float]]
    for t in campaign.used("judge"):
        y = t.recording.response
        three = shown[t.name]
        first = max(s.first for s in three)
        size = np.maximum(np.sqrt(np.mean(y[first:] ** 2, axis=0)), 1e-300)
        # channels of one quantity count by their size, as one norm
        scale = np.full(y.shape[1], np.sqrt(np.mean(size ** 2))) if len({c.quantity for c in t.recording.channels}) == 1 else size
        for name, s in zip(("nominal", "updated", "extended"), three, strict=True):
            sums[name].append(float(np.mean(((y - s.wave)[first:] / scale) ** 2)))
        sums["noise"].append(float(np.mean((t.noise / scale) ** 2)))
        if all(np.isfinite(s.wave).all() for s in three[1:]):
            z, a, b = y[first:], three[1].wave[first:], three[2].wave[first:]
            half = bands[1].factor * bands[1].sd(b, t.recording.fs)
            sums["coverage"].append(float(np.mean(np.abs(z - b) <= half)))
            value, error = elpd_difference(z, a, b, bands[0], bands[1], t.recording.fs)
            sums["elpd"].append(value)
            sums["variance"].append(error ** 2)
    out = {name: float(np.sqrt(np.mean(sums[name]))) if sums[name] else float("nan")
           for name in ("nominal", "updated", "extended", "noise")}
    out["coverage90"] = float(np.mean(sums["coverage"])) if sums["coverage"] else float("nan")
    out["elpd"], out["elpd_se"] = float(np.sum(sums["elpd"])), float(np.sqrt(np.sum(sums["variance"])))
    return out


def _unexplained(scores: dict[str, float], tuned: Entrant, leader: Entrant) -> float:
    """Share of the re-tuned model's error energy, noise apart, that the extended model leaves: on judged records, or on fitted ones where
    the effect shows more."""
    before = scores["updated"] ** 2 - scores["noise"] ** 2
    after = scores["extended"] ** 2 - scores["noise"] ** 2
    fitted = float(np.exp(min(leader.blocks.mean() - tuned.blocks.mean(), 0.0))) if not (tuned.failed or leader.failed) else 1.0
    if not (np.isfinite(before) and np.isfinite(after)) or before <= 0:
        return 0.0
    return float(min(np.clip(after / before, 0.0, 1.0), fitted))


def strength(suspect: Suspect, ext: Extended) -> Array:
    """Parameters (n_p,) of a law in the estimated model."""
    assert suspect.law is not None
    index = next(i for i, e in enumerate(ext.model.elements) if e.term is suspect.law.term and suspect.place in e.locations)
    return ext.model.element_values(ext.theta, index, suspect.place)
