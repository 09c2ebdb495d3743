"""From the first search to ranked hypotheses: who is estimated jointly, in what order, and when a second effect is asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.effects import Effect, pack
from bayes_nlsid.mismatch.explain import Candidate, Latent, forced, scan_forces, scan_linear
from bayes_nlsid.mismatch.joint import estimate, pursue, refine
from bayes_nlsid.mismatch.pairs import better, members, second_effects, unique
from bayes_nlsid.mismatch.polish import Bench, Hypothesis, begin, estimate_linear, everywhere
from bayes_nlsid.mismatch.quasilinear import strong_starts

Array = NDArray[np.float64]
Progress = Callable[[str], None]
WORTH = 14.0  # smallest gain of one regression that is looked at more closely
FIRST_FEW = 2  # linear effects that are estimated first from a linear fit that is no good
CLEAR = 1000.0  # gain of a linear effect that its column promises nearly rightly
KINDS = ("displacement", "velocity", "memory")   # what a law may follow
CHARGED = 6.0  # the same for each parameter: less than what it will be charged


@final
@dataclass(frozen=True)
class Found:
    """Result of a search.

    Parameters
    ----------
    none : float
        −2 log likelihood with nothing but the calibrated linear model.
    fit : LinearFit
        That model.
    singles, doubles : tuple of Hypothesis
        Estimated, best first.
    latents : tuple of Latent
    first : tuple of Candidate
        The first search, best first.
    """

    none: float
    fit: LinearFit
    singles: tuple[Hypothesis, ...]
    doubles: tuple[Hypothesis, ...]
    latents: tuple[Latent, ...]
    first: tuple[Candidate, ...]


def search(bench: Bench, fit: LinearFit, places: list[str], band: tuple[float, float], say: Progress, others: tuple[LinearFit, ...] = ()
           ) -> Found:
    """Singles, then pairs that begin with the best single.

    ``others`` are calibrations to one level, where some laws sleep: forces are looked for with all of them.
    """
    none = bench.evidence.chi2 + fit.cost
    forces, latents, starts = _pooled(bench, (fit, *others), places)
    linear = scan_linear(bench.family, fit, bench.channels, bench.mass, bench.stiffness, band)
    top_force = forces[0].gain if forces else 0.0
    top_linear = linear[0].gain if linear else 0.0
    # what no law moves by a fiftieth is no law's doing, however far it stands above the noise
    hopeless = bench.evidence.strong and top_force < 0.02 * (bench.evidence.chi2 - bench.evidence.values)
    short = [] if hopeless else _short_forces(forces, top_linear)
    say(f"estimating {len(short)} laws jointly")
    begun = [_begun(bench, c, (starts[c.effect.key], *others[:1])) for c in short]
    if bench.evidence.strong:
        begun += strong_starts(bench, (fit, *others)[-1].theta)
    singles = _pursued(bench, begun)
    # a law that explains more than any linear effect could makes those superfluous as first effects
    linear_too = top_linear > 0.15 * top_force and (not singles or 1.5 * top_linear > none - singles[0].cost)
    if linear_too:
        columns = _short_linear(linear)
        say(f"estimating {len(columns)} linear effects")
        fit, estimates = _estimated(bench, fit, band, columns)
        none = bench.evidence.chi2 + fit.cost
        singles = better(singles, estimates)
        if estimates and none - estimates[0].cost > WORTH and singles[0].fit.cost > 1.02 * singles[0].fit.dof:
            # a stiff relaxing branch has a column that is a poor guide: try one at every joint, if nothing simpler explains the data
            centre = 1.5 * float(np.sqrt(band[0] * band[1]))
            slow = [Candidate(Effect("other", place, kind="maxwell"), 0.0, 0.5, centre) for place in bench.family.places]
            singles = better(singles, [estimate(bench, fit, (c,)) for c in slow])
    singles, finished = _promising(bench, singles, short)
    if not linear_too and latents and singles and singles[0].misfit_records > 2 * bench.evidence.values:
        where = max(latents, key=lambda x: x.explained).place
        if where != singles[0].effects[0].place:
            say("trying strong laws where a free force explains most")
            tried = forced(bench.family, fit, bench.evidence, where, bench.sizes[where], 0.4)
            singles = better(singles, _pursued(bench, [begin(bench, fit, (c,)) for c in tried], most=2))
    singles = _again(bench, singles, places, none, say)
    singles = _finish_leaders(bench, singles, none, finished)
    singles = _other_formulas(bench, singles, none, say)
    doubles: list[Hypothesis] = []
    if singles and none - singles[0].cost > 30:
        say("looking for a second effect")
        doubles = second_effects(bench, singles[0], places, band)
        before = singles[0]
        singles = better(singles, members(bench, singles[0], doubles, none - singles[0].cost))
        if singles[0] is not before:
            say("a member of a pair leads alone: looking for a second effect beside it")
            singles = _finish_leaders(bench, singles, none, finished)
            doubles = better(doubles, second_effects(bench, singles[0], places, band))
    return Found(none, fit, tuple(singles), tuple(doubles), tuple(latents), tuple(sorted(forces + linear, key=lambda c: -c.gain)))


def _estimated(bench: Bench, fit: LinearFit, band: tuple[float, float], columns: list[Candidate]) -> tuple[LinearFit, list[Hypothesis]]:
    """Linear effects estimated, and the linear model alone calibrated again from where the best of them have left it: an effect that
    only leads it out of a side valley explains nothing.

    From a linear fit that is no good every estimate is long and all but one are in vain: there the first few lead the way.
    """
    found: list[Hypothesis] = []

    def tried(some: list[Candidate]) -> list[Hypothesis]:
        out = found
        for c in some:
            out = better(out, [estimate(bench, fit, (c,), out[0].fit.cost if out else np.inf)])
        return out

    for _ in range(3):
        few = columns[:FIRST_FEW] if fit.status != "ok" else columns
        found = tried(few)
        again = min((estimate_linear(bench, h.fit, ()).fit for h in found[:2]), key=lambda f: f.cost, default=fit)
        if not again.cost < fit.cost - 3.0:
            found = tried(columns[len(few):])
            break
        fit = again
        columns = _short_linear(scan_linear(bench.family, fit, bench.channels, bench.mass, bench.stiffness, band)) or columns
    return fit, found


def _pooled(bench: Bench, fits: tuple[LinearFit, ...], places: list[str]
            ) -> tuple[list[Candidate], list[Latent], dict[tuple[str, str], LinearFit]]:
    """Force candidates by several calibrations, the best of each law and place, with the calibration it was found by; latent forces of the
    first."""
    pool: dict[tuple[str, str], tuple[Candidate, LinearFit]] = {}
    first: list[Latent] = []
    for i, fit in enumerate(fits):
        found, latents, _ = scan_forces(bench.family, fit, bench.evidence, places)
        first = latents if i == 0 else first
        for c in found:
            if c.effect.key not in pool or c.gain > pool[c.effect.key][0].gain:
                pool[c.effect.key] = (c, fit)
    return sorted((c for c, _ in pool.values()), key=lambda c: -c.gain), first, {k: f for k, (_, f) in pool.items()}


def _begun(bench: Bench, c: Candidate, starts: Sequence[LinearFit]) -> Hypothesis:
    """Where a law begins, by the calibration from which it leaves least of the projected residual."""
    different = [f for i, f in enumerate(starts) if all(f is not g for g in starts[:i])]
    return min((begin(bench, f, (c,)) for f in (different if bench.evidence.strong else different[:1])), key=lambda h: h.misfit_records)


def _pursued(bench: Bench, begun: list[Hypothesis], most: int = 5) -> list[Hypothesis]:
    """Laws estimated jointly from where they began, of strong ones only those that began well."""
    order = sorted(begun, key=lambda h: h.misfit_records)
    many = most if bench.evidence.strong else len(order)
    out: list[Hypothesis] = []
    for h in order[:many]:
        if not _beaten(bench, h, out, 4.0):
            out.append(pursue(bench, h))
    return better(order, out)


def _beaten(bench: Bench, h: Hypothesis, others: list[Hypothesis], times: float) -> bool:
    """Whether a strong law leaves so many times more unexplained than another that it will not catch up."""
    values = bench.evidence.values
    best = min((o.misfit_records for o in others), default=np.inf)
    return bench.evidence.strong and h.misfit_records - values > times * max(best - values, 0.2 * values)


def _promising(bench: Bench, singles: list[Hypothesis], short: list[Candidate], most: int = 3
               ) -> tuple[list[Hypothesis], dict[tuple[str, str], float]]:
    """All derivatives for the laws that lead and the one that promised most in the first search, where these explain half and leave
    much: the linear model that a strong law has bent comes back with them only. With the cost of those that need no more."""
    if not singles or not bench.evidence.strong or not _poor(bench, singles[0], 1.2):
        return singles, {}
    promised, values = {c.effect.key: c.gain for c in short}, bench.evidence.values
    forces = [h for h in singles if h.forces and len(h.effects) == 1]
    first = sorted(forces, key=lambda h: -promised.get(h.effects[0].key, 0.0))[:1]
    chosen = [h for h in first + [h for h in forces if h is not first[0]][:most - 1]
              if not _beaten(bench, h, forces, 3.0) and h.misfit_records - values < 0.5 * (bench.evidence.chi2 - values)]
    refined = [refine(bench, h, steps=8) for h in chosen]
    return better(singles, refined), {h.effects[0].key: h.cost for h in refined}


def _worth(c: Candidate) -> bool:
    """Whether a candidate gains more than chance gives to as many parameters."""
    e = c.effect
    free = len(pack(e)) if e.is_force else 3 if e.cls == "unmodelled_mode" else 2 if e.kind == "maxwell" else 1
    return c.gain > max(WORTH, CHARGED * free)


def _short_forces(candidates: list[Candidate], other: float, most: int = 7) -> list[Candidate]:
    """The best laws over all places, and every law worth a look at the best place."""
    candidates = [c for c in candidates if _worth(c)]
    if not candidates:
        return []
    top = candidates[0]
    keep = [c for c in unique(candidates) if c.gain > max(WORTH, 0.2 * top.gain, 0.2 * other)]
    here = [c for c in keep if c.effect.place == top.effect.place]
    there = [c for c in keep if c.effect.place != top.effect.place and c.gain > 0.35 * top.gain]
    remembered = 0
    out = []
    for c in sorted(here[:5] + there, key=lambda c: -c.gain):
        if c.effect.cls == "hysteresis":
            remembered += 1
            if remembered > 2:
                continue
        out.append(c)
    return _every_kind(out[:most], candidates)


def _every_kind(chosen: list[Candidate], candidates: list[Candidate]) -> list[Candidate]:
    """With the best of each kind of law that is not among the chosen: on a motion that a strong law has changed, a damper may look like a
    spring."""
    out = list(chosen)
    for kind in KINDS:
        best = next((c for c in candidates if _follows(c, kind)), None)
        if best is not None and best.gain > 0.1 * candidates[0].gain and not any(_follows(c, kind) for c in out):
            out.append(best)
    return out


def _follows(c: Candidate, kind: str) -> bool:
    """Whether a law follows the displacement, the velocity or the history."""
    row = ROWS[c.effect.cls]
    return row.kind == "force" and row.phase == kind


def _short_linear(candidates: list[Candidate], most: int = 7) -> list[Candidate]:
    """The best linear effects by their columns."""
    candidates = [c for c in candidates if _worth(c)]
    if not candidates:
        return []
    top = candidates[0].gain
    limit = max(WORTH, (0.15 if top < CLEAR else 0.5) * top)
    return [c for c in unique(candidates) if c.gain > limit][:most]


def _again(bench: Bench, singles: list[Hypothesis], places: list[str], none: float, say: Progress, turns: int = 2) -> list[Hypothesis]:
    """All laws once more, on the motion that the leading one has brought close to the truth, while that changes who leads.

    A law that is strong moves its place otherwise than the linear model says, so that the first search may miss it; a law of the wrong
    class still brings the motion most of the way.
    """
    for _ in range(turns):
        lead = singles[0] if singles else None
        if lead is None or len(lead.forces) != 1 or none - lead.cost < 200 or not _much_left(bench, lead):
            break
        say("looking again at the motion that the leading law brings about")
        paths, motions = everywhere(bench, lead, places)
        forces, _, _ = scan_forces(bench.family, lead.fit, bench.evidence, places, None, paths, motions)
        top = forces[0].gain if forces else 0.0
        own = lead.effects[0]
        fresh = [c for c in unique(forces) if c.gain > 0.5 * top and (c.effect.key != own.key or c.effect.law is not own.law)]
        tried = _pursued(bench, [begin(bench, lead.fit, (c,)) for c in fresh[:4]], most=1)
        new = better([lead, *singles], tried)
        won = new[0].cost < lead.cost - 1.0
        singles = new
        if not won:
            break
    return singles


def _much_left(bench: Bench, h: Hypothesis) -> bool:
    """Whether a law leaves half the noise, and some of what no linear model explains, unexplained."""
    values = bench.evidence.values
    return h.misfit_records - values > max(0.5 * values, 0.05 * (bench.evidence.chi2 - values))


def _poor(bench: Bench, h: Hypothesis, limit: float = 1.02) -> bool:
    return h.misfit_records > limit * bench.evidence.values or h.fit.cost > (limit + 0.08) * h.fit.dof


def _finish_leaders(bench: Bench, singles: list[Hypothesis], none: float, finished: dict[tuple[str, str], float]) -> list[Hypothesis]:
    """Joint iterations for the force hypotheses that are still in the race and leave a misfit, unless that was done (``finished``: at what
    cost); quick ones for the others."""
    if not singles or none - singles[0].cost < 30:
        return singles
    gain = none - singles[0].cost
    out = []
    for i, h in enumerate(singles):
        poor = _poor(bench, h)
        if h.forces and i < 3 and h.cost - singles[0].cost < 0.3 * gain:
            done = finished.get(h.effects[0].key) == h.cost and not (i == 0 and _much_left(bench, h))
            if not done and poor and gain > 200 and i < 2:
                h = refine(bench, h, steps=10)
            elif not done:
                h = refine(bench, h, steps=4, quick=True)
        out.append(h)
    return sorted(out, key=lambda z: z.cost)


def _other_formulas(bench: Bench, singles: list[Hypothesis], none: float, say: Progress, most: int = 4) -> list[Hypothesis]:
    """The other laws at the places of the leaders, of any class, on the motion that these bring about, where they leave more than chance.

    The first search takes one law of each class by the motion without it, where formulas, and sometimes classes, are hard to tell apart.
    """
    out: list[Hypothesis] = []
    for h in singles[:2]:
        e = h.effects[0]
        left = h.misfit_records - bench.evidence.values
        if len(h.effects) > 1 or e.law is None or left < 3 * np.sqrt(2 * bench.evidence.values) or (
                h.cost - singles[0].cost > 0.1 * (none - singles[0].cost)):
            continue
        say(f"trying other laws at {e.place}")
        paths, motions = everywhere(bench, h, [e.place])
        found, _, _ = scan_forces(bench.family, h.fit, bench.evidence, [e.place], None, paths, motions, every=True)
        others = [c for c in found if c.effect.law is not None and c.effect.law is not e.law and c.gain > 0.5 * found[0].gain]
        own = [c for c in others if c.effect.cls == e.cls]
        for c in [*own[:most], *[c for c in others if c.effect.cls != e.cls][:most - len(own[:most])]]:
            tried = begin(bench, h.fit, (c,))
            if not _beaten(bench, tried, [h], 4.0):
                out.append(refine(bench, tried, steps=6, quick=True))
    return better(singles, out)
