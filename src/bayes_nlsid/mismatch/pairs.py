"""Second effects beside the best single one, and singles that come back from pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.effects import weakened
from bayes_nlsid.mismatch.explain import Candidate, scan_forces, scan_linear
from bayes_nlsid.mismatch.joint import estimate, refine
from bayes_nlsid.mismatch.polish import WEAKER, Bench, Hypothesis, begin, day, estimate_linear, everywhere, force_in_time
from bayes_nlsid.mismatch.shapes import accelerance

Array = NDArray[np.float64]
SECOND = 25.0  # smallest gain of a second effect


def unique(candidates: list[Candidate]) -> list[Candidate]:
    seen: set[tuple[str, str]] = set()
    out = []
    for c in candidates:
        if c.effect.key not in seen:
            seen.add(c.effect.key)
            out.append(c)
    return out


def better(first: list[Hypothesis], second: list[Hypothesis]) -> list[Hypothesis]:
    """One hypothesis per key, the cheaper of two estimates."""
    best: dict[tuple, Hypothesis] = {}
    for h in first + second:
        key = tuple(e.key for e in h.effects)
        if key not in best or h.cost < best[key].cost:
            best[key] = h
    return sorted(best.values(), key=lambda h: h.cost)


def second_effects(bench: Bench, first: Hypothesis, places: list[str], band: tuple[float, float]) -> list[Hypothesis]:
    """Pairs of the best single with what its residual still shows.

    A second effect must gain more than chance and than errors of the first law make: a fiftieth of what that leaves unexplained.
    """
    left = max(first.misfit_records - bench.evidence.values, 0.0) + max(first.fit.cost - first.fit.dof, 0.0)
    forces, _, _ = scan_forces(bench.family, first.fit, bench.evidence, places, first.residual)
    linear = scan_linear(bench.family, first.fit, bench.channels, bench.mass, bench.stiffness, band)
    own = {e.key for e in first.effects}
    pool = [c for c in unique(forces)[:3] + unique(linear)[:4]
            if c.gain > max(SECOND, 0.02 * left) and c.effect.key not in own]
    lead = _lead(first)
    out = []
    for c in sorted(pool, key=lambda c: -c.gain)[:3 if bench.evidence.strong else 4]:
        pair = (*lead, c)
        start = first.fit
        if not first.forces and c.effect.is_force:
            pair = (c, *lead)
        out.append(_paired(bench, start, pair))
    out.sort(key=lambda h: h.cost)
    if out and len(out[0].forces) == 2 and first.cost - out[0].cost > SECOND:
        out = better(out, _other_seconds(bench, out[0]))
    return out


def _other_seconds(bench: Bench, pair: Hypothesis, most: int = 2) -> list[Hypothesis]:
    """Other laws in place of the second of two, on the motion that both bring about: on the motion of the first alone a law may be taken
    for another."""
    fam, evidence, (kept, second) = bench.family, bench.evidence, pair.effects
    places = list(dict.fromkeys(e.place for e in pair.effects))
    whole, moved = everywhere(bench, pair, places)
    at = [places.index(second.place)]
    paths, motions = whole.at(at), [D[:, at] for D in moved]
    h = accelerance(fam, pair.fit.fields.modes, evidence.spectra.s, fam.places[second.place][None], pair.fit.shape_errors)
    force = np.stack([paths.to_lines(force_in_time(paths, second, D, time))[evidence.spectra.lines]
                      for D, time in zip(motions, day(evidence.spectra, evidence.spectra.starts), strict=True)])        # (R, L, 1)
    left = pair.residual - np.einsum("lsj,rlj->rls", h, np.moveaxis(evidence.project(np.moveaxis(force, 2, 0)), 0, 2))
    found, _, _ = scan_forces(fam, pair.fit, evidence, [second.place], left, paths, motions)
    others = [c for c in found if c.effect.law is not None and c.effect.key not in (kept.key, second.key) and c.gain > 0.5 * found[0].gain]
    return [refine(bench, begin(bench, pair.fit, (Candidate(kept, 0.0), c), steps=1), steps=4, quick=True) for c in others[:most]]


def _paired(bench: Bench, start: LinearFit, pair: tuple[Candidate, ...]) -> Hypothesis:
    """Joint estimation of a pair whose first member is known.

    A linear effect beside a law is first estimated on the transfer function that the law leaves, the law held.
    """
    if not any(c.effect.is_force for c in pair):
        return estimate(bench, start, pair)
    linear = tuple(c for c in pair if not c.effect.is_force)
    if len(linear) == 1 and not len(start.x):
        left = replace(bench, evidence=replace(bench.evidence, H=start.measured, variance=start.variance))
        start = estimate_linear(left, start, linear).fit
    begun = begin(bench, start, pair, steps=1, weaker=0)
    for _ in range(WEAKER if not linear else 0):
        # the second law was seen on a motion that it changes itself
        pair = (*pair[:-1], replace(pair[-1], effect=weakened(pair[-1].effect, 0.5)))
        less = begin(bench, start, pair, steps=1, weaker=0)
        if not less.misfit_records < begun.misfit_records:
            break
        begun = less
    return refine(bench, begun, steps=4, quick=True)


def members(bench: Bench, lead: Hypothesis, doubles: list[Hypothesis], gained: float) -> list[Hypothesis]:
    """Members of the best pairs, each alone from where the pair has left it, if the pair gains much: what leads may lead only because its
    rival began badly."""
    out: dict[tuple[str, str], Hypothesis] = {}
    for pair in sorted(doubles, key=lambda h: h.cost)[:2]:
        if lead.cost - pair.cost < max(20.0, 0.02 * pair.fit.dof if pair.forces else 0.0, 0.1 * gained):
            break
        for candidate in _lead(pair):
            key = candidate.effect.key
            if key not in out and key != lead.effects[0].key:
                out[key] = estimate(bench, pair.fit, (candidate,))
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
