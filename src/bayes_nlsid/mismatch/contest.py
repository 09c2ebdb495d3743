"""Rivals simulated forward: the likeliest hypotheses estimated jointly with the linear model, and what that says for and against each.

Innovations see one step ahead, so an effect that changes a slow decay a little in every cycle hides in them; simulated over a whole
record it adds up. Errors of the simulated channels are compared block by block in time, in their own standard error, as on the bench.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrated import Drive, Linear
from bayes_nlsid.mismatch.campaign import Campaign, Trial
from bayes_nlsid.mismatch.forward import Extended, estimate, extended, simulated
from bayes_nlsid.mismatch.innovations import Bench
from bayes_nlsid.mismatch.odds import Key
from bayes_nlsid.mismatch.settled import settled
from bayes_nlsid.mismatch.weigh import Weighed, searched, spread

Array = NDArray[np.float64]
ITERATIONS = 12
WIDE = 24       # channels times modes
LAWS = 3        # of one class that are tried
CHARGE = 0.01   # of the logarithm of squared error, for each parameter of a law
PLACES, NEAR = 2, 0.3   # other places at which the leading class is tried, and how much less they may gain on the bench
RIVALS = 5      # hypotheses of different classes that are estimated jointly
BLOCKS = 24
LOUD = 3.0      # error of the best linear model over noise from which rivals are simulated whatever the bench says


@final
@dataclass(frozen=True, eq=False)
class Entrant:
    """A model estimated by simulating the fitted records.

    Parameters
    ----------
    weighed : Weighed or None
        Its hypothesis; None for the linear model.
    model : Extended
    waves : tuple of ndarray (n, s)
        Simulated channels of the fitted records that were simulated; empty if that failed.
    blocks : ndarray (B,)
        Logarithm of squared error and noise over squared response, by block of time.
    """

    weighed: Weighed | None
    model: Extended
    waves: tuple[Array, ...]
    blocks: Array

    @property
    def failed(self) -> bool:
        """Whether a record could not be simulated."""
        return not np.isfinite(self.blocks).all()


def errors_by_block(trials: Sequence[Trial], waves: Sequence[Array], first: Sequence[int] | None = None, count: int = BLOCKS) -> Array:
    """Logarithm of squared error and noise over squared response (B,), blocks shared out among records by their length.

    Both are local, so that loud and quiet stretches count alike. inf where a wave is not finite.
    """
    skips = [0] * len(trials) if first is None else list(first)
    total = sum(len(w) - s for w, s in zip(waves, skips, strict=True))
    out = []
    for t, w, s in zip(trials, waves, skips, strict=True):
        y = t.recording.response[:len(w)]
        parts = max(2, round(count * (len(w) - s) / max(total, 1)))
        for at in np.array_split(np.arange(s, len(w)), parts):
            size = np.mean(y[at] ** 2, axis=0) + t.noise ** 2 + 1e-6 * np.mean(y ** 2, axis=0) + 1e-300
            wrong = np.mean((y[at] - w[at]) ** 2, axis=0) + t.noise ** 2
            out.append(float(np.log(np.mean(wrong / size) + 1e-12)) if np.isfinite(wrong).all() else np.inf)
    return np.array(out)


def enter(campaign: Campaign, bench: Bench, weighed: Weighed) -> Entrant:
    """Estimate one hypothesis by simulation, from where it settles on the bench."""
    linear, drive = bench.linear, bench.drive
    model = extended(linear, weighed.suspects, weighed.factors, [t.recording for t in campaign.trials], push=_push(campaign))
    model, waves = estimate(linear, drive, campaign, model, ITERATIONS, settled(campaign, linear, drive, bench, model))
    return _entrant(campaign, weighed, model, waves)


def enter_linear(campaign: Campaign, linear: Linear, drive: Drive) -> Entrant:
    """Estimate the linear model by simulation, to the end."""
    model = extended(linear, (), (), [t.recording for t in campaign.trials], push=_push(campaign))
    return _entrant(campaign, None, *estimate(linear, drive, campaign, model, 2 * ITERATIONS))


def _entrant(campaign: Campaign, weighed: Weighed | None, model: Extended, waves: Sequence[Array]) -> Entrant:
    trials = simulated(campaign)
    blocks = errors_by_block(trials, waves) if len(waves) == len(trials) else np.full(BLOCKS, np.inf)
    return Entrant(weighed, model, tuple(waves), blocks)


def _push(campaign: Campaign) -> float:
    """rms of the strongest force, N; 1 where none was measured."""
    sizes = [float(np.std(t.recording.force)) for t in campaign.used("fit") if t.recording.force.size]
    return max(sizes, default=0.0) or 1.0


def polished(campaign: Campaign, bench: Bench, entrant: Entrant, iterations: int = 24) -> Entrant:
    """The same entrant estimated to the end, if it stopped at its limit of iterations."""
    if entrant.failed or entrant.model.status != "iteration limit":
        return entrant
    model, waves = estimate(bench.linear, bench.drive, campaign, entrant.model, iterations)
    tried = _entrant(campaign, entrant.weighed, model, waves)
    return tried if not tried.failed and tried.blocks.mean() < entrant.blocks.mean() + 0.01 else entrant


def champion(campaign: Campaign, bench: Bench, tuned: Entrant, weighed: Weighed) -> Entrant:
    """The hypothesis by the law of its class that simulates best; a richer law than another must be clearly better.

    A richer law always fits as well as a simpler one on the bench, and is the harder to estimate by simulation.
    """
    level = np.inf if tuned.failed else float(tuned.blocks.mean())
    kept: Entrant | None = None
    for w in sorted((weighed, *weighed.others[:(1 if _wide(campaign, bench) else LAWS) - 1]), key=lambda w: (_shapes(w), -w.gain)):
        tried = enter(campaign, bench, w)
        if tried.failed or float(tried.blocks.mean()) < level:
            tried = polished(campaign, bench, tried)
        if kept is None or kept.weighed is None or kept.failed or (not tried.failed and richer(kept, tried)):
            kept = tried
    assert kept is not None
    return kept


def _wide(campaign: Campaign, bench: Bench) -> bool:
    """Whether there are so many channels and modes that few hypotheses can be simulated."""
    return bench.linear.model.modes * max(len(t.recording.channels) for t in campaign.used("fit")) > WIDE


def _shapes(w: Weighed) -> int:
    """Number of parameters that give the laws of a hypothesis their shape."""
    return sum(searched(s) for s in w.suspects)


def richer(simple: Entrant, rich: Entrant) -> bool:
    """Whether the law with more parameters is clearly better in simulation, by two standard errors over blocks and some per cent for
    each parameter."""
    assert simple.weighed is not None and rich.weighed is not None
    difference = simple.blocks - rich.blocks
    error = float(np.std(difference, ddof=1) / np.sqrt(len(difference)))
    return float(difference.mean()) > 2 * error + CHARGE * (_shapes(rich.weighed) - _shapes(simple.weighed))


def ahead(before: Array, after: Array) -> float:
    """How far the second model leads the first: mean decrease of the logarithmic block errors over its error; from 1 on by some per cent
    at least."""
    difference = before - after
    error = float(np.std(difference, ddof=1) / np.sqrt(len(difference)))
    return float(difference.mean()) / (0.1 + error)


def hold(campaign: Campaign, bench: Bench, tuned: Entrant, singles: Sequence[Weighed], pairs: Sequence[Weighed],
         odds: dict[Key, float], say: Callable[[float, str], None]) -> list[Entrant]:
    """Estimate the likeliest hypothesis of some classes: those with odds; all, where the linear model leaves far more than noise.

    A pair comes with the better of its members, which it must beat.
    """
    trials = simulated(campaign)
    floor = np.mean([np.log(np.mean(t.noise ** 2 / (np.mean(t.recording.response ** 2, axis=0) + t.noise ** 2 + 1e-300)) + 1e-12)
                     for t in trials])
    loud = tuned.failed or float(np.median(tuned.blocks)) > max(float(floor), np.log(1e-8)) + 2 * np.log(LOUD)
    ranked = sorted((w for w in (*singles, *pairs) if modelled(w) and (loud or (w.gain > 0 and odds.get(w.key, 0.0) > 0.02))),
                    key=lambda w: -odds.get(w.key, 0.0))
    chosen: list[Weighed] = []
    for w in ranked:
        if len(chosen) < (3 if _wide(campaign, bench) else RIVALS) and all(classes(w) != classes(other) for other in chosen):
            chosen.append(w)
    for w in [w for w in chosen if len(w.key) > 1]:
        members = [m for m in singles if m.key[0] in w.key and modelled(m)]
        if members and all(m.key != members[0].key for m in chosen):
            chosen.append(members[0])
    out = []
    for i, w in enumerate(chosen):
        say(0.55 + 0.3 * i / len(chosen), "estimating " + " and ".join(f"{c} at {p}" for c, p in w.key))
        out.append(champion(campaign, bench, tuned, w))
    say(0.8, "estimating the leading class at other places")
    return out + _elsewhere(campaign, bench, tuned, singles, out)


def _elsewhere(campaign: Campaign, bench: Bench, tuned: Entrant, singles: Sequence[Weighed], entrants: Sequence[Entrant]) -> list[Entrant]:
    """The class that simulates best alone, estimated at the next places too: on the bench places differ by little."""
    alone = [e for e in entrants if e.weighed is not None and len(e.weighed.key) == 1 and not e.failed]
    best = min(alone, key=lambda e: float(e.blocks.mean()), default=None)
    if best is None or best.weighed is None or tuned.failed or ahead(tuned.blocks, best.blocks) < 1.0:
        return []
    own = best.weighed
    near = [w for w in singles if classes(w) == classes(own) and w.key != own.key and modelled(w)
            and own.gain - w.gain < NEAR * abs(own.gain) + 3 * spread(own.blocks - w.blocks) + 10.0]
    return [champion(campaign, bench, tuned, w) for w in near[:1 if _wide(campaign, bench) else PLACES]]


def classes(w: Weighed) -> frozenset[str]:
    """Classes of a hypothesis."""
    return frozenset(c for c, _ in w.key)


def second(entrants: Sequence[Entrant]) -> float:
    """Lead in simulation of the best pair over the better of its members; nan where no pair was simulated beside a member."""
    worth = []
    for e in entrants:
        assert e.weighed is not None
        if len(e.weighed.key) > 1:
            members = [m for m in entrants if m.weighed is not None and len(m.weighed.key) == 1 and m.weighed.key[0] in e.weighed.key]
            alone = [m for m in members if not m.failed]
            if alone:
                best = min(alone, key=lambda m: float(m.blocks.mean()))
                worth.append(0.0 if e.failed else max(ahead(best.blocks, e.blocks), 0.0))
    return max(worth, default=float("nan"))


def modelled(w: Weighed) -> bool:
    """Whether every effect of a hypothesis is a force law that the simulation can carry."""
    terms = [(s.law.term.name, s.place) for s in w.suspects if s.law is not None]
    return len(terms) == len(w.suspects) and len(set(terms)) == len(terms)


def compared(entrants: Sequence[Entrant]) -> tuple[tuple[Key, float, float], ...]:
    """Every hypothesis that was simulated against the best of them: mean difference of the logarithmic block errors and its standard error;
    inf where the simulation failed."""
    able = [e for e in entrants if not e.failed]
    best = min(able, key=lambda e: float(e.blocks.mean()), default=None)
    out: list[tuple[Key, float, float]] = []
    for e in entrants:
        assert e.weighed is not None
        if best is None or e.failed:
            out.append((e.weighed.key, float("inf"), 0.0))
            continue
        # parameters beyond those of the better rival are not charged here: block means differ by far more than they take
        difference = e.blocks - best.blocks
        out.append((e.weighed.key, float(difference.mean()), float(np.std(difference, ddof=1) / np.sqrt(len(difference)))))
    return tuple(out)


def lead(tuned: Entrant, entrants: Sequence[Entrant]) -> float:
    """Lead of the best simulated hypothesis over the linear model; nan if none was simulated."""
    able = [ahead(tuned.blocks, e.blocks) for e in entrants if not e.failed] if not tuned.failed else []
    return max(able, default=0.0 if entrants and not tuned.failed else float("nan"))


def fallen(before: Array, after: Array) -> tuple[float, float]:
    """Mean decrease of logarithmic block errors on records that were not fitted, and its standard error; zeros where it cannot be said.

    Parameters
    ----------
    before, after : ndarray (B,)
        `errors_by_block` of the best linear and of the extended model.
    """
    gain = before - after
    gain = gain[np.isfinite(gain)]
    if len(gain) < 4 or not np.isfinite(before).all() or not np.isfinite(after).all():
        return 0.0, 0.0
    return float(gain.mean()), float(np.std(gain, ddof=1) / np.sqrt(len(gain)))
