"""From the first search to ranked hypotheses: who is estimated jointly, in what order, and when a second effect is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.effects import Effect
from bayes_nlsid.mismatch.explain import Candidate, Latent, scan_forces, scan_linear
from bayes_nlsid.mismatch.joint import refine
from bayes_nlsid.mismatch.polish import Bench, Hypothesis, estimate

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


def search(bench: Bench, fit: LinearFit, places: list[str], band: tuple[float, float], say: Progress, quiet: LinearFit | None = None
           ) -> Found:
    """Singles, then pairs that begin with the best single.

    ``quiet`` is the calibration to the lowest level, where amplitude-dependent laws sleep: forces are looked for with both.
    """
    none = bench.evidence.chi2 + fit.cost
    forces, latents, _ = scan_forces(bench.family, fit, bench.evidence, places)
    begin = fit
    if quiet is not None:
        others, more, _ = scan_forces(bench.family, quiet, bench.evidence, places)
        if others and others[0].gain > (forces[0].gain if forces else 0.0):
            forces, latents, begin = others, more, quiet
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
    if quiet is not None:
        # the leaders also from the other calibration: a law that was strong has bent one of the two
        other = fit if begin is quiet else quiet
        again = [estimate(bench, other, (c,), rounds=3) for c in short[:2]]
        singles = _better(singles, again)
    singles = _finish_leaders(bench, singles, none)
    doubles: list[Hypothesis] = []
    if singles and none - singles[0].cost > 30:
        say("looking for a second effect")
        doubles = _second(bench, singles[0], places, band, none - singles[0].cost)
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


def _finish_leaders(bench: Bench, singles: list[Hypothesis], none: float) -> list[Hypothesis]:
    """Joint iterations for the force hypotheses that are still in the race and leave a misfit; more rounds for the others."""
    if not singles or none - singles[0].cost < 30:
        return singles
    gain = none - singles[0].cost
    values, dof = bench.evidence.values, singles[0].fit.dof
    out = []
    for i, h in enumerate(singles):
        poor = h.misfit_records > 1.02 * values or h.fit.cost > 1.1 * dof
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
