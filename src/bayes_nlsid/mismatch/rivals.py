"""All that may explain a case, side by side: what each gains, how much it changes, and how it does on a record never fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.case import Case, CaseRecord
from bayes_nlsid.mismatch.clipping import fit_clipping, suspects
from bayes_nlsid.mismatch.disturb import Disturbance
from bayes_nlsid.mismatch.effects import Effect
from bayes_nlsid.mismatch.evidence import Evidence
from bayes_nlsid.mismatch.polish import Bench, Hypothesis
from bayes_nlsid.mismatch.probability import Key
from bayes_nlsid.mismatch.prove import Predictor
from bayes_nlsid.mismatch.search import Found, search

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Progress = Callable[[str], None]
FAINT, FAINT_PLACE = 12.0, 18.0  # gains that the best of all channels, or of all places, has by chance
TRIED = 8  # rivals that are run on the records kept aside
IN_VIEW = 0.2  # gain over the best, from which a rival is worth that


@final
@dataclass(frozen=True)
class Rival:
    """A hypothesis of any kind with its gain over ``none``.

    Parameters
    ----------
    key : tuple of (class, place)
    gain : float
        Decrease of −2 log likelihood, charges included.
    alone : float
        For a pair, the gain of the better of its members alone.
    hypothesis : Hypothesis or None
        Its coherent part.
    clip : tuple of (channel, level)
    extra : tuple of Effect
        Effects that are not in ``hypothesis``: clipping and disturbances.
    strengths : tuple of float
        What each effect of the key changes, relative to the response.
    visible : float
        What it changes that nothing simpler does (the calibrated linear model; for a pair, the better of its members), relative to the
        response at the highest level.
    rest : float
        Leftover −2 log likelihood beyond its expectation.
    held : float
        Logarithm of the squared error on the records kept aside over that of noise; NaN if they were not run.
    faint : bool
        Not estimated, for nothing speaks for it: ``gain`` is what one regression promises.
    """

    key: Key
    gain: float
    alone: float = 0.0
    hypothesis: Hypothesis | None = None
    clip: tuple[tuple[int, float], ...] = ()
    extra: tuple[Effect, ...] = ()
    strengths: tuple[float, ...] = ()
    visible: float = float("nan")
    rest: float = 0.0
    held: float = float("nan")
    faint: bool = False

    @property
    def incoherent(self) -> bool:
        """Whether one of its effects is a disturbance that does not follow the shaker."""
        return any(e.cls != "clipping" for e in self.extra)

    @property
    def strength(self) -> float:
        """The smallest of its effects."""
        return min(self.strengths, default=float("nan"))


def _ordered(keys: list[tuple[str, str]], strengths: list[float]) -> tuple[Key, tuple[float, ...]]:
    """Effects in the order of a key, with what each changes."""
    order = sorted(range(len(keys)), key=lambda i: keys[i])
    return tuple(keys[i] for i in order), tuple(strengths[i] for i in order) if len(strengths) == len(keys) else ()


def rival(h: Hypothesis, none: float) -> Rival:
    """A hypothesis as a rival; ``none`` is the cost without any."""
    key, strengths = _ordered([e.key for e in h.effects], list(h.strengths))
    return Rival(key, none - h.cost, 0.0, h, strengths=strengths)


def all_rivals(case: Case, bench: Bench, fit: LinearFit, found: Found, noise: Array, disturbances: list[Disturbance], say: Progress
               ) -> list[Rival]:
    """Everything found, best first: coherent effects, clipping, disturbances, and pairs of them."""
    rivals = [rival(h, found.none) for h in found.singles]
    best_alone = {r.key: r.gain for r in rivals}
    for h in found.doubles:
        one = rival(h, found.none)
        alone = max([best_alone.get((k,), -np.inf) for k in one.key] + [rivals[0].gain if rivals else 0.0])
        rivals.append(replace(one, alone=max(alone, 0.0)))
    rivals += _clipping(case, bench, fit, found.none, list(bench.family.places), rivals, noise, say)
    rivals = _disturbed(disturbances, rivals, case)
    rivals += _faint(found, {r.key for r in rivals}, float(np.log(max(bench.evidence.H.size, 2))))
    simple: dict[Key, Rival] = {r.key: r for r in rivals if len(r.key) == 1}
    return sorted((_seen(r, simple, bench.evidence, fit) for r in rivals), key=lambda r: -r.gain)


def _faint(found: Found, known: set[Key], charge: float) -> list[Rival]:
    """The best place of every linear class of which no effect was worth estimating, by what one regression promises: what may be there,
    too weak to be seen."""
    out: dict[str, Rival] = {}
    for c in found.first:
        cls = c.effect.cls
        if not c.effect.is_force and c.effect.kind != "maxwell" and cls not in out and all(cls != k for key in known for k, _ in key):
            out[cls] = Rival((c.effect.key,), c.gain - charge, faint=True)
    return list(out.values())


def _seen(r: Rival, simple: dict[Key, Rival], evidence: Evidence, fit: LinearFit) -> Rival:
    """With what it changes that nothing simpler does, and what it leaves."""
    if r.hypothesis is None:
        rest = fit.cost - fit.dof + evidence.chi2 - evidence.values
        return replace(r, visible=r.strength, rest=rest)
    reference, before = fit, evidence.residual
    if len(r.key) > 1 and not r.extra:
        members = [m for m in (simple.get((k,)) for k in r.key) if m is not None and m.hypothesis is not None]
        best = max(members, key=lambda m: m.gain, default=None)
        if best is not None and best.hypothesis is not None:
            reference, before = best.hypothesis.fit, best.hypothesis.residual
    h, spectra = r.hypothesis, evidence.spectra
    top = int(np.argmax(spectra.levels))
    moved = ((h.fit.measured - h.fit.model) - (reference.measured - reference.model)) * spectra.force[top, spectra.excited][:, None]
    change = np.linalg.norm(moved) ** 2 + np.linalg.norm(h.residual[top] - before[top]) ** 2
    visible = float(np.sqrt(change) / max(float(np.linalg.norm(spectra.response[top])), 1e-300))
    if r.extra and len(r.key) > 1:
        # what is not coherent changes what no coherent part does; the other member is seen as it is alone
        own = {e.key for e in r.extra}
        visible = min([visible, *(n for k, n in zip(r.key, r.strengths, strict=False) if k in own)])
    return replace(r, visible=visible, rest=h.fit.cost - h.fit.dof + h.misfit_records - evidence.values)


def _clipping(case: Case, bench: Bench, fit: LinearFit, none: float, places: list[str], rivals: list[Rival], noise: Array,
              say: Progress) -> list[Rival]:
    """Clipped channels, alone and together with what the unclipped evidence then shows."""
    out: list[Rival] = []
    lone = _lone_channel(case, bench.evidence)
    flat = suspects(case, noise)
    for channel, level in (lone + [s for s in flat if all(s[0] != c for c, _ in lone)])[:2]:
        say(f"undoing the clipping of {bench.channels[channel]}")
        undone = fit_clipping(bench.family, bench.evidence, fit, channel, level)
        if undone is None or none - undone[3] < 10:
            continue
        level, cleaned, refit, cost = undone
        gain, name = none - cost, bench.channels[channel]
        effect = Effect("clipping", name, None, np.array([level]), ("level",), ("m/s^2",))
        lost = _clipped_share(bench.evidence, refit, channel, level)
        alone = Rival((("clipping", name),), gain, 0.0, _only_linear(refit, cleaned, cost), ((channel, level),), (effect,), (lost,))
        out.append(alone)
        if gain > 0.3 * max([r.gain for r in rivals] + [0.0]):
            more = search(replace(bench, evidence=cleaned), refit, places, case.band, say)
            for h in more.singles[:2]:
                key, sizes = _ordered([("clipping", name), *[e.key for e in h.effects]], [lost, *h.strengths])
                out.append(Rival(key, none - h.cost - np.log(bench.evidence.H.size), gain, h, ((channel, level),), (effect,), sizes))
    return out


def _lone_channel(case: Case, evidence: Evidence) -> list[tuple[int, float]]:
    """The channel that has most of what is not linear to itself, and nearly its largest value: soft clipping leaves no flat top."""
    power = 2 * np.einsum("r,ls,rls->s", evidence.trust, evidence.weight, np.abs(evidence.residual) ** 2)
    beyond = np.maximum(power - evidence.values / len(power), 0.0)
    channel = int(np.argmax(beyond))
    if len(power) < 3 or beyond[channel] < 0.6 * beyond.sum() or beyond[channel] < 0.1 * evidence.values:
        return []
    largest = max(float(np.abs(r.accel[:, case.usable][:, channel]).max()) for r in case.records if not r.sealed and r.kind != "off")
    return [(channel, 0.95 * largest)]


def _clipped_share(evidence: Evidence, fit: LinearFit, channel: int, level: float) -> float:
    """What clipping takes from the channel, relative to its response at the highest level, by the linear model."""
    spectra = evidence.spectra
    strongest = int(np.argmax(spectra.levels))
    half = np.zeros(spectra.block // 2 + 1, dtype=complex)
    half[spectra.lines[spectra.excited]] = fit.model[:, channel] * spectra.force[strongest, spectra.excited]
    y = np.fft.irfft(half, norm="forward")
    return float(np.linalg.norm(y - np.clip(y, -level, level)) / max(float(np.linalg.norm(y)), 1e-300))


def _only_linear(fit: LinearFit, evidence: Evidence, cost: float) -> Hypothesis:
    return Hypothesis((), (), fit, evidence.chi2, cost, np.zeros((0, 0)), evidence.residual, "ok")


def _disturbed(found: list[Disturbance], rivals: list[Rival], case: Case) -> list[Rival]:
    """Disturbances alone, and together with the best coherent rival."""
    out = list(rivals)
    known = set(case.classes)
    strong = [d for d in found if d.gain > 25 and d.cls in known]
    # the best single, whatever a pair of coherent effects gains beside it
    best = max((r for r in rivals if len(r.key) == 1), key=lambda r: r.gain, default=None)
    size = {d: _relative(case, d) for d in found}
    effects = {d: Effect(d.cls, d.place, None, np.array([d.size]), ("rms",), ("m/s^2",)) for d in found}
    for d in found:
        if d.cls not in known or d.gain < (FAINT_PLACE if d.cls == "other" else FAINT):
            continue
        out.append(Rival(((d.cls, d.place),), d.gain, 0.0, None, (), (effects[d],), (size[d],)))
        if best is not None and d in strong and best.gain > 25 and best.key[0] != (d.cls, d.place):
            key, sizes = _ordered([*best.key, (d.cls, d.place)], [*best.strengths, size[d]])
            out.append(Rival(key, best.gain + d.gain, max(best.gain, d.gain), best.hypothesis, best.clip, (*best.extra, effects[d]), sizes))
    for i, a in enumerate(strong):
        for b in strong[i + 1:]:
            if a.cls != b.cls:
                key, sizes = _ordered([(a.cls, a.place), (b.cls, b.place)], [size[a], size[b]])
                out.append(Rival(key, a.gain + b.gain, max(a.gain, b.gain), extra=(effects[a], effects[b]), strengths=sizes))
    return out


def _relative(case: Case, d: Disturbance) -> float:
    """Size of a disturbance over the response at the highest level, of its channel or of all."""
    names, accel = list(case.sensors), case.loudest.accel
    rms = np.sqrt(np.mean(accel[:, names.index(d.place)] ** 2) if d.place in names else np.mean(accel[:, case.usable] ** 2))
    return float(d.size / max(float(rms), 1e-300))


def on_trial(case: Case, bench: Bench, fit: LinearFit, rivals: list[Rival], held: tuple[CaseRecord, ...], noise: Array
             ) -> tuple[list[Rival], float]:
    """The leading rivals run on records that were not fitted, and how the calibrated linear model alone does there (``held``)."""
    if not held:
        return rivals, float("nan")
    channels, spectra = int(case.usable.sum()), bench.evidence.spectra
    measured = [r.accel[:, case.usable] for r in held]

    def error(fit: LinearFit, h: Hypothesis | None, clip: tuple[tuple[int, float], ...]) -> float:
        predictor = Predictor(bench.family, fit, h, channels, clip, spectra)
        ratio = [((y - predictor.run(case, r)[0]) ** 2).mean(0) / noise ** 2 for y, r in zip(measured, held, strict=True)]
        value = float(np.mean(ratio))
        return float(np.log(value)) if np.isfinite(value) else 60.0

    none = error(fit, None, ())
    known: dict[int, float] = {id(None): none}
    most = max((r.gain for r in rivals), default=0.0)
    out = []
    for r in rivals:
        mark = id(r.hypothesis)
        if mark not in known and len(known) <= TRIED and (r.gain == most or r.gain >= IN_VIEW * most):
            known[mark] = error(r.hypothesis.fit, r.hypothesis, r.clip) if r.hypothesis is not None else none
        out.append(replace(r, held=known.get(mark, float("nan"))))
    return out, none
