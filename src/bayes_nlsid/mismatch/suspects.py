"""Every hypothesis of the catalogue that a set of recordings can test, as what it would add to the innovations.

Force laws are the catalogue's own, evaluated with their memory along the smoothed motion of each place; a candidate is what its force,
with unit scale, does to the whitened innovations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import Motion, force_along
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.innovations import Bench, Desk
from bayes_nlsid.mismatch.laws import Law, Size
from bayes_nlsid.mismatch.observer import ORDER

Array = NDArray[np.float64]
FINER = 4   # force laws are evaluated so many times finer than the records: what they make above the analysed band must not fold back


def _bent_by(p: Array, peak: float) -> float:
    """Motion at which a Bouc–Wen loop has lost a tenth of its stiffness."""
    return min(0.1 / max(abs(float(p[1])) * (abs(float(p[2])) + abs(float(p[3]))), 1e-300), peak)


# Loops whose branches stiffen or soften. With nu = 1 the force scales with alpha alone; beta and gamma act as a product.
BOUC_WEN = Law(LIBRARY["bouc_wen"], lambda z: np.array([[1.0, b / z.displacement, 1.0, d, 1.0] for b in (0.3, 1.0, 3.0)
                                                        for d in (-1.6, -1.2, -0.5, 0.5)]),
               ("log", "log", "fixed", "linear", "fixed"), (0,), _bent_by, excess=True)
# Largest gap over the largest motion, and largest rounding of its faces: beyond them the law is a smooth hardening spring.
GAPS = {("clearance", "d"): 1.8, ("rounded_gap", "e"): 0.9, ("rounded_gap", "w"): 0.2, ("one_stop", "e"): 0.9, ("two_stops", "e"): 0.9,
        ("round_stops", "e"): 0.9, ("lossy_stop", "e"): 0.9, ("lossy_stops", "e"): 0.9}


@final
@dataclass(frozen=True, eq=False)
class Suspect:
    """One effect with its shape.

    Parameters
    ----------
    cls, place : str
    law : Law or None
        None for effects that are no force law.
    shape : ndarray (n_p,)
        Parameters of the law with unit scale of force; empty without a law.
    size : Size or None
        Scales of the motion at the place.
    """

    cls: str
    place: str
    law: Law | None
    shape: Array
    size: Size | None = None

    @property
    def key(self) -> tuple[str, str]:
        """Class and place."""
        return self.cls, self.place

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest value (n_p,) of each parameter; a gap must be closed by the motion, and open where it is said to be."""
        if self.law is None:
            return np.zeros(0), np.zeros(0)
        params = self.law.term.params
        low = np.array([p.lower if p.rule == "range" else -np.inf for p in params])
        high = np.array([p.upper if p.rule == "range" else np.inf for p in params])
        if self.size is not None:
            for i, p in enumerate(params):
                reach = GAPS.get((self.law.term.name, p.name))
                if reach is not None:
                    high[i] = min(high[i], reach * (self.size.peak if p.unit == "m" else 1.0))
        return low, high

    def parameters(self, factor: float) -> Array:
        """Parameters of the law when its force is scaled by ``factor``."""
        out = self.shape.copy()
        if self.law is not None:
            out[list(self.law.scaled)] *= factor
        return out


@final
@dataclass(frozen=True, eq=False)
class Place:
    """Motion of one location in every fitted record, `FINER` times finer than the record."""

    name: str
    row: Array
    motions: tuple[Motion, ...]
    size: Size


def places_of(bench: Bench, names: Sequence[str]) -> tuple[Place, ...]:
    """The smoothed motion at each place; places that never move are left out."""
    out = []
    rows = bench.linear.model.rows(list(names))
    reach = np.array([max(float(np.std(d.smoothed.u @ row)) for d in bench.desks) for row in rows])
    for name, row, moved in zip(names, rows, reach, strict=True):
        if moved < 1e-6 * reach.max():
            continue   # a node of every mode that takes part
        motions = tuple(finer_motion(d.smoothed.u @ row, d.smoothed.v @ row, d.smoothed.a @ row, d.trial.recording.dt) for d in bench.desks)
        loudest = max(motions, key=lambda q: float(np.std(q.q)))
        if np.std(loudest.q) > 0 and np.abs(row).max() > 0:
            out.append(Place(name, row, motions, _size(loudest)))
    return tuple(out)


def finer_motion(q: Array, v: Array, a: Array, dt: float) -> Motion:
    """The motion `FINER` times finer, by the quintic that has displacement, velocity and acceleration of both neighbours."""
    h = dt
    x = np.arange(FINER) / FINER
    nq, nv, na = (np.append(z[1:], z[-1]) for z in (q, v, a))
    nq[-1], nv[-1] = q[-1] + h * v[-1] + h * h * a[-1] / 2, v[-1] + h * a[-1]
    # coefficients of s = x + ... on the unit interval
    c0, c1, c2 = q, h * v, h * h * a / 2
    r0, r1, r2 = nq - c0 - c1 - c2, h * nv - c1 - 2 * c2, h * h * na - 2 * c2
    c3, c4, c5 = 10 * r0 - 4 * r1 + r2 / 2, -15 * r0 + 7 * r1 - r2, 6 * r0 - 3 * r1 + r2 / 2
    powers = x[None] ** np.arange(6)[:, None]
    fine = np.stack([c0, c1, c2, c3, c4, c5], axis=1) @ powers
    slope = np.stack([c1, 2 * c2, 3 * c3, 4 * c4, 5 * c5], axis=1) @ powers[:5] / h
    return Motion(np.ascontiguousarray(fine.ravel()), np.ascontiguousarray(slope.ravel()), dt / FINER)


def _size(motion: Motion) -> Size:
    """Scales of the motion: rms over the louder half, so that the tail of a decay does not count."""
    q, v = motion.q - np.median(motion.q), motion.v
    blocks = np.array_split(np.arange(len(q)), 16)
    loud = sorted(blocks, key=lambda b: -float(np.mean(q[b] ** 2)))[:8]
    chosen = np.concatenate(loud)
    return Size(max(float(np.sqrt(np.mean(q[chosen] ** 2))), 1e-30), max(float(np.sqrt(np.mean(v[chosen] ** 2))), 1e-30),
                max(float(np.abs(q).max()), 1e-30))


def response(bench: Bench, place: Place, law: Law, shapes: Array) -> Array:
    """Whitened innovations (K, N) of a law with K shapes; rows of laws that are not finite along the motion are zero."""
    parts = []
    for desk, motion in zip(bench.desks, place.motions, strict=True):
        with np.errstate(all="ignore"):
            g = force_along(law.term, motion, shapes, law.excess)
        g = np.where(np.isfinite(g).all(axis=1, keepdims=True), g, 0.0)
        # a law acts against the motion
        parts.append(desk.to_force(-place.row, g, FINER))
    return np.concatenate(parts, axis=1)


def laws_of(cls: str) -> tuple[Law, ...]:
    """Force laws of a class that both the regression and the simulation can carry."""
    laws = tuple(law for law in ROWS[cls].laws if law.convert is None)
    return (*laws, BOUC_WEN) if cls == "hysteresis" else laws


def force_suspects(bench: Bench, places: Sequence[Place], classes: Sequence[str],
                   progress: Callable[[float], None] | None = None) -> Iterator[tuple[Place, str, Law, Array, Array]]:
    """For every place, class and law: shapes (K, n_p) and their whitened innovations (K, N)."""
    for i, place in enumerate(places):
        for cls in (row.name for row in ROWS.values() if row.kind == "force"):
            if cls not in classes:
                continue
            for law in laws_of(cls):
                shapes = law.shapes(place.size)
                low, high = Suspect(cls, place.name, law, shapes[0], place.size).bounds
                shapes = shapes[((shapes >= low) & (shapes <= high)).all(axis=1)]
                if not len(shapes):
                    continue   # no gap that this motion closes
                yield place, cls, law, shapes, response(bench, place, law, shapes)
        if progress is not None:
            progress((i + 1) / len(places))


def drift_response(bench: Bench, place: Place) -> Array:
    """Whitened innovations (1, N) of a stiffness at the place that changes in proportion to time."""
    starts = [d.trial.recording.start for d in bench.desks]
    ends = [d.trial.recording.start + d.n * d.trial.recording.dt for d in bench.desks]
    middle, half = 0.5 * (min(starts) + max(ends)), max(0.5 * (max(ends) - min(starts)), 1e-300)
    parts = []
    for desk, motion, start in zip(bench.desks, place.motions, starts, strict=True):
        tau = (start + desk.trial.recording.time - middle) / half
        parts.append(desk.to_force(-place.row, (tau * motion.q[::FINER])[None]))
    return np.concatenate(parts, axis=1)


def delay_response(bench: Bench, name: str) -> Array:
    """Whitened innovations (1, N) of a delay of one measured force: minus its derivative."""
    parts = []
    for d in bench.desks:
        record = d.trial.recording
        force = sum((record.force[:, i] for i, c in enumerate(record.inputs) if c.location == name), np.zeros(record.n))
        parts.append(d.to_force(bench.linear.model.rows([name])[0], -np.gradient(force, record.dt)[None]))
    return np.concatenate(parts, axis=1)


def channel_response(bench: Bench, location: str, what: str) -> Array:
    """Whitened innovations (1, N) of a gain error or a delay of the channel at a location."""
    parts = []
    for d in bench.desks:
        record = d.trial.recording
        part = np.zeros((1, (d.n - d.skip) * len(record.channels)))
        for j, c in enumerate(record.channels):
            if c.name == location:
                # the motion as the model has it there, not the signal itself: a signal always predicts itself
                z = (d.smoothed.u, d.smoothed.v, d.smoothed.a)[ORDER[c.quantity]] @ bench.linear.rows([c])[0]
                part += d.to_channel(j, (z if what == "gain" else -np.gradient(z, record.dt))[None])
        parts.append(part)
    return np.concatenate(parts, axis=1)


def hum_response(bench: Bench, channel: str, mains: float) -> Array:
    """Whitened innovations (6, N) of three tones of the mains on one channel; each record has its own phase by its start time."""
    parts = []
    for d in bench.desks:
        record = d.trial.recording
        t = record.start + record.time
        top = min(0.45, d.part / 2.25) * record.fs   # tones above the analysed band would leave their beginning and end only
        tones = [f(2 * np.pi * h * mains * t) for h in (1, 2, 3) for f in (np.cos, np.sin) if h * mains < top]
        part = np.zeros((6, (d.n - d.skip) * len(record.channels)))
        for j, c in enumerate(record.channels):
            if c.name == channel and tones:
                part[:len(tones)] = d.to_channel(j, np.array(tones))
        parts.append(part)
    return np.concatenate(parts, axis=1)


def resonator_response(bench: Bench, name: str, frequency: float, zeta: float, row: Array) -> Array:
    """Whitened innovations (2, N) of an attachment at ``row`` that resonates: its force follows the acceleration there."""
    parts = []
    w = 2 * np.pi * frequency
    for d in bench.desks:
        parts.append(d.to_force(-row, _resonant(d, d.smoothed.a @ row, w, zeta)))
    return np.concatenate(parts, axis=1)


def _resonant(d: Desk, a: Array, w: float, zeta: float) -> Array:
    """Displacement (in units of acceleration) and velocity of an oscillator on a moving base, (2, n)."""
    from scipy.signal import lfilter

    dt = d.trial.recording.dt
    pole = np.exp((-zeta + 1j * np.sqrt(1 - zeta ** 2)) * w * dt)
    z = lfilter([1.0], [1.0, -pole], a.astype(complex)) * dt * w
    return np.stack([z.imag, z.real])
