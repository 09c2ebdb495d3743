"""From the first search to ranked hypotheses: who is estimated jointly, in what order, and when a second effect is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.effects import Effect
from bayes_nlsid.mismatch.explain import Candidate, Latent, forced, scan_forces, scan_linear
from bayes_nlsid.mismatch.joint import refine
from bayes_nlsid.mismatch.polish import Bench, Hypothesis, estimate, everywhere

Array = NDArray[np.float64]
Progress = Callable[[str], None]
WORTH = 14.0  # smallest gain of one regression that is looked at more closely


@final
@dataclass(frozen=True)
class Found:
    """Result of a search.

    Parameters
    ----------
    none : float
        −2 log likelihood with nothing but the calibrated linear model.
    singles, doubles : tuple of Hypothesis
        Estimated, best first.
    latents : tuple of Latent
    first : tuple of Candidate
        The first search, best first.
    """

    none: float
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
    forces, latents, _ = scan_forces(bench.family, fit, bench.evidence, places)
    begin = fit
    for other in others:
        found, more, _ = scan_forces(bench.family, other, bench.evidence, places)
        if found and found[0].gain > (forces[0].gain if forces else 0.0):
            forces, latents, begin = found, more, other
    linear = scan_linear(bench.family, fit, bench.channels, bench.mass, bench.stiffness, band)
    top_force = forces[0].gain if forces else 0.0
    top_linear = linear[0].gain if linear else 0.0
    short = _short_forces(forces, top_linear)
    say(f"estimating {len(short)} laws jointly")
    singles = sorted((estimate(bench, begin, (c,), rounds=3) for c in short), key=lambda h: h.cost)
    # a law that explains more than any linear effect could makes those superfluous as first effects
    linear_too = top_linear > 0.15 * top_force and (not singles or 1.5 * top_linear > none - singles[0].cost)
    if linear_too:
        columns = _short_linear(linear)
        say(f"estimating {len(columns)} linear effects")
        singles = _better(singles, [estimate(bench, fit, (c,)) for c in columns])
    asked = linear_too and top_linear > 40
    if asked and (not singles or singles[0].fit.cost + singles[0].misfit_records > 1.02 * (fit.dof + bench.evidence.values) or
                  singles[0].fit.cost > 1.02 * fit.dof):
        # a stiff relaxing branch has a column that is a poor guide: try one at every joint, if nothing simpler explains the data
        centre = 1.5 * float(np.sqrt(band[0] * band[1]))
        slow = [Candidate(Effect("other", place, kind="maxwell"), 0.0, 0.5, centre) for place in bench.family.places]
        singles = _better(singles, [estimate(bench, fit, (c,)) for c in slow])
    for other in (fit, *others):
        # the leaders also from the other calibrations: a law that was strong has bent some of them
        if other is not begin and singles and _poor(bench, singles[0]):
            singles = _better(singles, [estimate(bench, other, (c,), rounds=3) for c in short[:2]])
    if not linear_too and latents and singles and singles[0].misfit_records > 2 * bench.evidence.values:
        say("trying strong laws where a free force explains most")
        where = max(latents, key=lambda x: x.explained).place
        starts = forced(bench.family, fit, bench.evidence, where, bench.sizes[where], 0.4)
        tried = sorted((estimate(bench, fit, (c,), rounds=1) for c in starts), key=lambda h: h.cost)[:2]
        singles = _better(singles, [estimate(bench, h.fit, _lead(h), rounds=3) for h in tried])
    singles = _promising(bench, singles, short, none)
    singles = _again(bench, singles, places, none, say)
    singles = _finish_leaders(bench, singles, none)
    doubles: list[Hypothesis] = []
    if singles and none - singles[0].cost > 30:
        say("looking for a second effect")
        doubles = _second(bench, singles[0], places, band, none - singles[0].cost)
        before = singles[0]
        singles = _better(singles, _members(bench, singles[0], doubles))
        if singles[0] is not before:
            say("a member of a pair leads alone: looking for a second effect beside it")
            singles = _finish_leaders(bench, singles, none)
            doubles = _better(doubles, _second(bench, singles[0], places, band, none - singles[0].cost))
    return Found(none, tuple(singles), tuple(doubles), tuple(latents), tuple(sorted(forces + linear, key=lambda c: -c.gain)))


def _unique(candidates: list[Candidate]) -> list[Candidate]:
    seen: set[tuple[str, str]] = set()
    out = []
    for c in candidates:
        if c.effect.key not in seen:
            seen.add(c.effect.key)
            out.append(c)
    return out


def _short_forces(candidates: list[Candidate], other: float, most: int = 7) -> list[Candidate]:
    """The best laws over all places, and every law worth a look at the best place."""
    if not candidates or candidates[0].gain < WORTH:
        return []
    top = candidates[0]
    keep = [c for c in _unique(candidates) if c.gain > max(WORTH, 0.2 * top.gain, 0.2 * other)]
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
    return out[:most]


def _short_linear(candidates: list[Candidate], most: int = 7) -> list[Candidate]:
    """The best linear effects by their columns (relaxing branches apart)."""
    if not candidates or candidates[0].gain < WORTH:
        return []
    limit = max(WORTH, 0.15 * candidates[0].gain)
    return [c for c in _unique(candidates) if c.gain > limit and c.effect.kind != "maxwell"][:most]


def _better(first: list[Hypothesis], second: list[Hypothesis]) -> list[Hypothesis]:
    """One hypothesis per key, the cheaper of two estimates."""
    best: dict[tuple, Hypothesis] = {}
    for h in first + second:
        key = tuple(e.key for e in h.effects)
        if key not in best or h.cost < best[key].cost:
            best[key] = h
    return sorted(best.values(), key=lambda h: h.cost)


def _again(bench: Bench, singles: list[Hypothesis], places: list[str], none: float, say: Progress, turns: int = 2) -> list[Hypothesis]:
    """All laws once more, on the motion that the leading one has brought close to the truth, while that changes who leads.

    A law that is strong moves its place otherwise than the linear model says, so that the first search may miss it; a law of the wrong
    class still brings the motion most of the way.
    """
    for _ in range(turns):
        lead = singles[0] if singles else None
        if lead is None or len(lead.forces) != 1 or none - lead.cost < 200 or not _poor(bench, lead):
            break
        say("looking again at the motion that the leading law brings about")
        lead = refine(bench, lead, steps=3)
        paths, motions = everywhere(bench, lead, places)
        forces, _, _ = scan_forces(bench.family, lead.fit, bench.evidence, places, None, paths, motions)
        top = forces[0].gain if forces else 0.0
        own = lead.effects[0]
        fresh = [c for c in _unique(forces) if c.gain > 0.5 * top and (c.effect.key != own.key or c.effect.law is not own.law)]
        tried = [estimate(bench, lead.fit, (c,), rounds=3) for c in fresh[:4]]
        new = _better([lead, *singles], tried)
        won = new[0].cost < lead.cost - 1.0
        singles = new
        if not won:
            break
    return singles


def _promising(bench: Bench, singles: list[Hypothesis], short: list[Candidate], none: float, most: int = 3) -> list[Hypothesis]:
    """Joint iterations for the laws that promised most in the first search, where much is left: alternating estimation of a strong law
    may end far from its optimum, behind a law of the wrong class that happened to begin well."""
    if not singles or none - singles[0].cost < 200 or not _poor(bench, singles[0]):
        return singles
    promised = {c.effect.key: c.gain for c in short}
    limit = 0.5 * (none - singles[0].cost)
    worth = [h for h in singles if h.forces and len(h.effects) == 1 and promised.get(h.effects[0].key, 0.0) > limit]
    order = sorted(worth, key=lambda h: -max(promised[h.effects[0].key], none - h.cost))
    return _better(singles, [refine(bench, h, steps=6) for h in order[:most]])


def _poor(bench: Bench, h: Hypothesis) -> bool:
    return h.misfit_records > 1.02 * bench.evidence.values or h.fit.cost > 1.1 * h.fit.dof


def _finish_leaders(bench: Bench, singles: list[Hypothesis], none: float) -> list[Hypothesis]:
    """Joint iterations for the force hypotheses that are still in the race and leave a misfit; more rounds for the others."""
    if not singles or none - singles[0].cost < 30:
        return singles
    gain = none - singles[0].cost
    out = []
    for i, h in enumerate(singles):
        poor = _poor(bench, h)
        if h.forces and i < 3 and h.cost - singles[0].cost < 0.3 * gain:
            if poor and gain > 200 and i < 2:
                h = refine(bench, h, steps=10)
            else:
                h = min((h, estimate(bench, h.fit, tuple(Candidate(e, 0.0) for e in h.effects), rounds=4)), key=lambda z: z.cost)
        out.append(h)
    return sorted(out, key=lambda z: z.cost)


def _second(bench: Bench, first: Hypothesis, places: list[str], band: tuple[float, float], gained: float) -> list[Hypothesis]:
    """Pairs of the best single with what its residual still shows."""
    forces, _, _ = scan_forces(bench.family, first.fit, bench.evidence, places, first.residual)
    linear = scan_linear(bench.family, first.fit, bench.channels, bench.mass, bench.stiffness, band)
    own = {e.key for e in first.effects}
    pool = [c for c in _unique(forces)[:3] + _unique([c for c in linear if c.effect.kind != "maxwell"])[:4]
            if c.gain > max(40.0, 0.002 * gained) and c.effect.key not in own]
    lead = _lead(first)
    out = []
    for c in sorted(pool, key=lambda c: -c.gain)[:4]:
        pair = (*lead, c)
        start = first.fit
        if not first.forces and c.effect.is_force:
            pair = (c, *lead)
        out.append(estimate(bench, start, pair, rounds=3))
    return sorted(out, key=lambda h: h.cost)


def _members(bench: Bench, lead: Hypothesis, doubles: list[Hypothesis]) -> list[Hypothesis]:
    """Members of the best pairs, each alone from where the pair has left it: what leads may lead only because its rival began badly."""
    out: dict[tuple[str, str], Hypothesis] = {}
    for pair in sorted(doubles, key=lambda h: h.cost)[:2]:
        if lead.cost - pair.cost < max(20.0, 0.02 * pair.fit.dof):
            break
        for candidate in _lead(pair):
            key = candidate.effect.key
            if key not in out and key != lead.effects[0].key:
                out[key] = estimate(bench, pair.fit, (candidate,), rounds=3)
    return list(out.values())


def _lead(first: Hypothesis) -> tuple[Candidate, ...]:
    """Candidates that reproduce a hypothesis as a start: forces keep their values, linear effects their coordinates."""
    out, edge = [], 0
    kinds = list(first.kinds)
    for e in first.effects:
        if e.is_force or e.cls == "linear_stiffness":
            out.append(Candidate(e, 0.0))
            continue
        k = kinds.pop(0)
        x = first.fit.x[edge:edge + len(k.start)]
        edge += len(k.start)
        logs = e.cls in ("unmodelled_mode",) or e.kind == "maxwell"
        frequency = 0.0
        if logs:
            frequency = float(e.values[1]) if e.cls == "unmodelled_mode" else 1 / (2 * np.pi * float(e.values[1]))
        out.append(Candidate(replace(e, values=np.zeros(0)), 0.0, float(np.exp(x[0])) if logs else float(x[0]), frequency, _other(k)))
    return tuple(out)


def _other(kind: object) -> int:
    return int(getattr(kind, "other", -1))
