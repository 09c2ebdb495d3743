"""Numbers behind the figures of a diagnosis of recordings: laws along the smoothed motion, errors by frequency, time and amplitude."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.motion import force_along
from bayes_nlsid.mismatch.calibrated import Drive, observer_of
from bayes_nlsid.mismatch.campaign import Trial
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.innovations import Desk
from bayes_nlsid.mismatch.observer import Smoothed, observe
from bayes_nlsid.mismatch.recorded import Evidence, strength
from bayes_nlsid.mismatch.suspects import FINER, Suspect, finer_motion
from bayes_nlsid.mismatch.weigh import Weighed
from bayes_nlsid.recordings.recording import SI_UNIT

Array = NDArray[np.float64]
Numbers = dict[str, NDArray[Any]]
LATENT = 0.03         # modal force of the observer behind the latent force, at least, over the modal acceleration
THIN = 6000           # samples that are drawn
STRETCHES = 40
DRAWS, GRID = 300, 241


def portrait(found: Evidence, best: Weighed | None) -> Numbers:
    """All numbers by the name of the figure they belong to; ``best`` is the hypothesis that is reported, if any."""
    shares: dict[str, float] = {}
    for w in found.singles:
        if w.suspects[0].law is not None:
            shares[w.suspects[0].place] = max(shares.get(w.suspects[0].place, 0.0), w.share)
    places = sorted(shares, key=lambda n: -shares[n])
    out: Numbers = {"place_names": np.array(places), "place_share": np.array([shares[n] for n in places]),
                    "place_share_by": np.array("the best force law")}
    desk = max(found.scale.bench.desks, key=lambda d: d.trial.level)
    lawful = () if best is None else tuple((s, f) for s, f in zip(best.suspects, best.factors, strict=True) if s.law is not None)
    if lawful:
        out |= _laws(found, best, lawful, desk)
    elif best is None or all(c == "other" for c, _ in best.key):
        out |= _free(found, desk, places[:3])
    judged = found.campaign.used("judge")
    if judged:
        out |= _held(found, judged[0]) | _errors(found, judged[0])
    return out


def freely(found: Evidence, desk: Desk) -> Smoothed:
    """A record smoothed by an observer whose modal forces are free to follow it: where the mismatch is faint the likeliest ones are not."""
    largest = np.maximum(found.drive.force, (LATENT * desk.smoothed.a.std(axis=0)) ** 2)
    observer = observer_of(found.linear, desk.trial, Drive(largest, found.drive.noise))
    try:
        return observe(observer, found.linear.response(desk.trial.recording), desk.force)
    except (np.linalg.LinAlgError, ValueError):
        return desk.smoothed


def linear_design(q: Array, v: Array, a: Array, free: bool) -> Array:
    """What a linear model may absorb of a force at a place, (n, k), columns of unit length.

    Without a measured force the inertia is the force, and nothing would be left without it.
    """
    design = np.stack([q, v, *([] if free else [a]), np.ones_like(q)], axis=1)
    return np.asarray(design / np.maximum(np.linalg.norm(design, axis=0), 1e-300))


def without(design: Array, force: Array) -> Array:
    """A force (n,) less what is linear in the columns of ``design``."""
    return np.asarray(force - design @ np.linalg.lstsq(design, force, rcond=1e-9)[0])


def _laws(found: Evidence, best: Weighed | None, lawful: tuple[tuple[Suspect, float], ...], desk: Desk) -> Numbers:
    """Every law along the loudest fitted record, and what that record asks for beyond it and beyond a linear model."""
    moved, record = freely(found, desk), desk.trial.recording
    rows = [found.linear.model.rows([s.place])[0] for s, _ in lawful]
    estimated = best is not None and found.named is best
    values = [strength(s, found.best) if estimated else s.parameters(f) for s, f in lawful]
    motions = [finer_motion(moved.u @ r, moved.v @ r, moved.a @ r, record.dt) for r in rows]
    with np.errstate(all="ignore"):
        forces = [force_along(s.law.term, m, p[None], s.law.excess)[0] for (s, _), m, p in zip(lawful, motions, values, strict=True)
                  if s.law is not None]
    out: Numbers = {"law_record": np.array(record.name)}
    for i, ((suspect, _), row, motion, g) in enumerate(zip(lawful, rows, motions, forces, strict=True)):
        size = float(row @ row)
        asked = -(moved.latent @ row) / size
        own = sum((float(other @ row) / size * f[::FINER] for other, f in zip(rows, forces, strict=True)), np.zeros(len(asked)))
        design = linear_design(moved.u @ row, moved.v @ row, moved.a @ row, record.free)
        left = without(design[desk.skip:], (asked - own)[desk.skip:])
        key, kept = f"law_{i}", slice(desk.skip * FINER, None)
        if suspect.law is not None and suspect.law.excess:
            # with its spring at rest, which the linear model carries: so a loop looks like one
            g = force_along(suspect.law.term, motion, values[i][None], False)[0]
        out |= {f"{key}_displacement": motion.q[kept], f"{key}_velocity": motion.v[kept], f"{key}_force": g[kept], f"{key}_left": left,
                f"{key}_class": np.array(suspect.cls), f"{key}_place": np.array(suspect.place), f"{key}_unit": np.array("m"),
                f"{key}_phase": np.array(ROWS[suspect.cls].phase)}
        if suspect.law is not None and suspect.law.term.memory == "none":
            out |= {f"{key}_{k}": x for k, x in _curve(found, suspect, values[i], motion.q, motion.v, estimated).items()}
    return out


def _curve(found: Evidence, suspect: Suspect, p: Array, q: Array, v: Array, estimated: bool) -> Numbers:
    """A law over the range of its own coordinate; with the quantiles that the errors of its parameters make where it was estimated."""
    assert suspect.law is not None
    term = suspect.law.term
    by_speed = ROWS[suspect.cls].phase == "velocity"
    own = v if by_speed else q
    grid = np.linspace(float(own.min()), float(own.max()), GRID)
    zero = np.zeros_like(grid)
    motion = (zero, grid) if by_speed else (grid, zero)
    middle = np.asarray(term.static_force(*motion, p))
    low = high = middle
    if estimated:
        index = next(i for i, e in enumerate(found.best.model.elements) if e.term is term and suspect.place in e.locations)
        draws = found.best.draws(DRAWS, 0)
        with np.errstate(all="ignore"):
            curves = np.array([term.static_force(*motion, found.best.model.element_values(x, index, suspect.place)) for x in draws])
            low, high = np.nanquantile(np.where(np.isfinite(curves), curves, np.nan), [0.05, 0.95], axis=0)
    return {"grid": grid, "curve": middle, "low": low, "high": high}


def _free(found: Evidence, desk: Desk, places: list[str]) -> Numbers:
    """Forces without a law at the likeliest places, what a linear model may absorb taken off so that the shape of the rest can be seen."""
    moved = freely(found, desk)
    out: Numbers = {}
    for i, name in enumerate(places):
        row = found.linear.model.rows([name])[0]
        q, v, a = (z @ row for z in (moved.u, moved.v, moved.a))
        force = without(linear_design(q, v, a, desk.trial.recording.free), -(moved.latent @ row) / float(row @ row))
        every = max(1, len(q) // THIN)
        for key, value in (("force", force), ("displacement", q), ("velocity", v)):
            out[f"latent_{i}_{key}"] = value[desk.skip::every]
    return out


def _held(found: Evidence, t: Trial) -> Numbers:
    """The loudest stretch of the first record that was not used."""
    first, n = max(s.first for s in found.shown[t.name]), t.recording.n
    y = t.recording.response
    at = int(np.argmax(np.abs(y[first:] - y[first:].mean(axis=0)).max(axis=1))) + first
    begin = int(np.clip(at - THIN // 2, first, max(n - THIN, first)))
    piece = slice(begin, min(n, begin + THIN))
    out: Numbers = {"heldout_time": t.recording.time[piece], "heldout_measured": y[piece],
                    "heldout_channels": np.array([c.name for c in t.recording.channels]),
                    "heldout_units": np.array([SI_UNIT[c.quantity] for c in t.recording.channels]), "heldout_name": np.array(t.name)}
    for key, s in zip(("nominal", "updated", "extended"), found.shown[t.name], strict=True):
        if np.isfinite(s.wave).all() and (key != "extended" or found.named is not None):
            out[f"heldout_{key}"] = s.wave[piece]
    last = found.shown[t.name][2].wave
    if np.isfinite(last).all():
        out["heldout_half"] = (found.bands[1].factor * found.bands[1].sd(last, t.recording.fs))[piece]
    return out


def _errors(found: Evidence, t: Trial) -> Numbers:
    """Errors on that record in the channel of the loudest motion: by frequency, and by stretch of time with the level of the stretch."""
    from scipy.signal import welch

    first, dt = max(s.first for s in found.shown[t.name]), t.recording.dt
    y = t.recording.response[first:]
    c = int(np.argmax(y.std(axis=0)))
    count = min(STRETCHES, max(len(y) // 16, 1))
    window = min(len(y), max(256, len(y) // 8))

    def blocks(x: Array) -> Array:
        return np.array([float(np.sqrt(np.mean(b ** 2))) for b in np.array_split(x, count)])

    middle = np.array([float(b.mean()) for b in np.array_split(t.recording.time[first:], count)])
    f, power = welch(y[:, c] - y[:, c].mean(), 1 / dt, nperseg=window)
    out: Numbers = {"error_frequency": f, "error_measured_spectrum": np.sqrt(power), "error_time": middle,
                    "error_level": blocks(y[:, c] - y[:, c].mean()), "error_noise": np.array(t.noise[c]),
                    "error_unit": np.array(SI_UNIT[t.recording.channels[c].quantity]),
                    "error_channel": np.array(t.recording.channels[c].name), "error_record": np.array(t.name)}
    for key, s in zip(("nominal", "updated", "extended"), found.shown[t.name], strict=True):
        if np.isfinite(s.wave).all() and (key != "extended" or found.named is not None):
            e = y[:, c] - s.wave[first:, c]
            out |= {f"error_{key}_spectrum": np.sqrt(welch(e, 1 / dt, nperseg=window)[1]), f"error_{key}_block": blocks(e)}
    return out
