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

from bayes_nlsid.mismatch.calibrated import Drive, Linear
from bayes_nlsid.mismatch.campaign import RIGID, Campaign, Trial
from bayes_nlsid.mismatch.forward import Extended, estimate, extended, predict, simulated
from bayes_nlsid.mismatch.innovations import Bench, lay_out
from bayes_nlsid.mismatch.observer import Modal
from bayes_nlsid.mismatch.odds import Key, odds_of
from bayes_nlsid.mismatch.prove import Bands, calibrate_bands, elpd_difference
from bayes_nlsid.mismatch.suspects import Suspect
from bayes_nlsid.mismatch.weigh import Scale, Weighed, doubles, scale_of, weigh

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
RETUNINGS = 3
RIVALS = 2      # hypotheses of different classes that are estimated jointly
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


def start_of(campaign: Campaign, nominal: bool = False) -> Linear:
    """The linear model as delivered, or where calibration starts."""
    model = campaign.nominal if nominal else campaign.start
    stiffness = np.where(model.omega < RIGID, 0.0, model.omega ** 2)
    return Linear(model, Modal(stiffness, 2 * model.zeta * model.omega), 1.0, np.zeros(len(model.inputs)))


def calibrate(campaign: Campaign, say: Progress = silent) -> tuple[Linear, Drive, Bench]:
    """Stiffness and damping of every mode moved to where the innovations say, some times over."""
    linear, drive = start_of(campaign), None
    for i in range(RETUNINGS):
        say(0.05 * i, "calibrating the linear model")
        bench = lay_out(campaign, linear, drive=drive if i else None)
        drive = bench.drive
        if i < RETUNINGS - 1:
            linear = _moved(linear, bench)
    assert drive is not None
    return linear, drive, bench


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
    linear, drive, bench = calibrate(campaign, say)
    scale = scale_of(bench, campaign.places, campaign.classes, campaign.mains)
    singles = weigh(scale, lambda share: say(0.2 + 0.1 * min(share, 2.0), "weighing every suspect"))
    pairs = doubles(scale, singles, progress=lambda share: say(0.4 + 0.1 * share, "weighing pairs"))
    singles, pairs, notes = _one_linear_reading(campaign, singles, pairs)
    values = float(bench.counts.sum())
    odds = odds_of(singles, pairs, values)
    say(0.5, "re-tuning the linear model by forward simulation")
    channels = len(campaign.used("fit")[0].recording.channels)
    tuned, tuned_fit = estimate(linear, drive, campaign, extended(linear, (), (), channels))
    nominal = extended(start_of(campaign, nominal=True), (), (), channels, freed=False)
    best, best_fit, named = _best(campaign, linear, drive, singles, pairs, odds, channels, tuned, tuned_fit, say)
    say(0.85, "simulating records that were not used")
    shown = {t.name: (_shown(start_of(campaign, nominal=True), drive, nominal, t), _shown(linear, drive, tuned, t),
                      _shown(linear, drive, best, t)) for t in campaign.used("judge")}
    bands = (_bands(campaign, tuned_fit), _bands(campaign, best_fit))
    scores = score_all(campaign, shown, bands)
    withdrawn = named is not None and scores.get("extended", np.inf) > WORSE * scores.get("updated", np.inf)
    if withdrawn:
        notes += ("The named effect made the records that were not used worse and was withdrawn from the predictions.",)
        best, named, shown = tuned, None, {n: (s[0], s[1], s[1]) for n, s in shown.items()}
        bands = (bands[0], bands[0])
        scores = score_all(campaign, shown, bands)
    odds = odds_of(singles, pairs, values, _unexplained(scores) if named is not None else 0.0)
    if withdrawn:
        odds = {k: (v * 0.5 if k else 0.5 + 0.5 * v) for k, v in odds.items()}
    return Evidence(campaign, linear, drive, scale, tuple(singles), tuple(pairs), odds, tuned, best, named, shown, scores, bands, withdrawn,
                    notes)


def _one_linear_reading(campaign: Campaign, singles: list[Weighed], pairs: list[Weighed]
                        ) -> tuple[list[Weighed], list[Weighed], tuple[str, ...]]:
    """A single record cannot tell a drift from an effect that follows the decay: it is kept as a rival only with several records."""
    if len(campaign.used("fit")) > 1:
        return singles, pairs, ()

    def fine(w: Weighed) -> bool:
        return all(cls != "stiffness_drift" for cls, _ in w.key)

    return [w for w in singles if fine(w)], [w for w in pairs if fine(w)], ()


def modelled(w: Weighed) -> bool:
    """Whether every effect of a hypothesis is a force law that the simulation can carry."""
    terms = [(s.law.term.name, s.place) for s in w.suspects if s.law is not None]
    return len(terms) == len(w.suspects) and len(set(terms)) == len(terms)


def _best(campaign: Campaign, linear: Linear, drive: Drive, singles: Sequence[Weighed], pairs: Sequence[Weighed], odds: dict[Key, float],
          channels: int, tuned: Extended, tuned_fit: list[Array], say: Progress) -> tuple[Extended, list[Array], Weighed | None]:
    """The likeliest hypotheses estimated jointly; the one that simulates the fitted records best among those that are likely."""
    ranked = sorted((w for w in (*singles, *pairs) if modelled(w) and odds.get(w.key, 0.0) > 0.02 and w.gain > 0),
                    key=lambda w: -odds[w.key])
    chosen: list[Weighed] = []
    for w in ranked:
        if all({c for c, _ in w.key} != {c for c, _ in other.key} for other in chosen):
            chosen.append(w)
    best, fit, named, cost = tuned, tuned_fit, None, _misfit(campaign, tuned_fit)
    for i, w in enumerate(chosen[:RIVALS]):
        say(0.55 + 0.1 * i, "estimating " + " and ".join(f"{c} at {p}" for c, p in w.key))
        ext, waves = estimate(linear, drive, campaign, extended(linear, w.suspects, w.factors, channels))
        found = _misfit(campaign, waves)
        # the likeliest keeps its place unless a rival simulates clearly better
        if found < (cost if named is None else 0.9 * cost):
            best, fit, named, cost = ext, waves, w, found
    return best, fit, named


def _misfit(campaign: Campaign, waves: Sequence[Array]) -> float:
    """Mean over fitted records of squared error over squared response; infinite if a simulation failed."""
    trials = simulated(campaign)
    if len(waves) != len(trials) or not all(np.isfinite(w).all() for w in waves):
        return float("inf")
    return float(np.mean([((t.recording.response[:len(w)] - w) ** 2).sum() / (t.recording.response[:len(w)] ** 2).sum()
                          for t, w in zip(trials, waves, strict=True)]))


def _shown(linear: Linear, drive: Drive, ext: Extended, trial: Trial) -> Shown:
    return Shown(*predict(linear, drive, ext, trial))


def _bands(campaign: Campaign, waves: list[Array]) -> Bands:
    """Width of predictive bands from the fitted records."""
    trials = simulated(campaign)
    noise = trials[0].noise
    if len(waves) != len(trials):
        size = np.std(trials[0].recording.response, axis=0)
        return Bands(noise + 1e-9 * size, np.ones(len(noise)), 1.645)
    measured = [t.recording.response[:len(w)] for t, w in zip(trials, waves, strict=True)]
    found = calibrate_bands(np.maximum(noise, 1e-9 * np.std(measured[0], axis=0)), measured, waves, trials[0].recording.fs)
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


def _unexplained(scores: dict[str, float]) -> float:
    """Share of the re-tuned model's error energy, noise apart, that the extended model leaves on judged records."""
    before = scores["updated"] ** 2 - scores["noise"] ** 2
    after = scores["extended"] ** 2 - scores["noise"] ** 2
    if not (np.isfinite(before) and np.isfinite(after)) or before <= 0:
        return 0.0
    return float(np.clip(after / before, 0.0, 1.0))


def strength(suspect: Suspect, ext: Extended) -> Array:
    """Parameters (n_p,) of a law in the estimated model."""
    assert suspect.law is not None
    index = next(i for i, e in enumerate(ext.model.elements) if e.term is suspect.law.term and suspect.place in e.locations)
    return ext.model.element_values(ext.theta, index, suspect.place)
