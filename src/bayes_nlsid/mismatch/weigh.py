"""Weighing suspects on a bench: how much better each predicts blocks of time that its strength was not fitted to.

The score of a suspect in a block is half the number of independent values there times the logarithm of the ratio of squared innovations
without and with it, its factor being fitted to all other blocks. Each block has its own scale, so that loud stretches do not decide alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.innovations import Bench
from bayes_nlsid.mismatch.suspects import (
    Place,
    Suspect,
    channel_response,
    delay_response,
    drift_response,
    force_suspects,
    hum_response,
    places_of,
    response,
)

Array = NDArray[np.float64]
REFINED = 6        # suspects whose shape is refined
SHAPE_CHARGE = 3.0   # nats for each shape parameter that was searched
PLACES_KEPT = 6
OF_THE_BEST = 0.5    # gain of another law of the same class over the best, from which it is kept beside it


@final
@dataclass(frozen=True, eq=False)
class Weighed:
    """One hypothesis on the bench.

    Parameters
    ----------
    suspects : tuple of Suspect
        One, or two.
    factors : tuple of float
        Strength of each.
    blocks : ndarray (B,)
        Gain in log predictive density by block, nats.
    column : ndarray (N,)
        Projected whitened innovations of the last suspect.
    charge : float
        Nats for what was searched.
    share : float
        Share of the projected squared innovations that it explains.
    others : tuple of Weighed
        The same class at the same place by other force laws, best first.
    """

    suspects: tuple[Suspect, ...]
    factors: tuple[float, ...]
    blocks: Array
    column: Array
    charge: float
    share: float
    others: tuple[Weighed, ...] = ()

    @property
    def key(self) -> tuple[tuple[str, str], ...]:
        """Classes and places, sorted."""
        return tuple(sorted(s.key for s in self.suspects))

    @property
    def gain(self) -> float:
        """Nats, charges taken off."""
        return float(self.blocks.sum() - self.charge)

    @property
    def error(self) -> float:
        """Standard error of the gain over blocks."""
        return spread(self.blocks)


def spread(blocks: Array) -> float:
    """Standard error of a sum over blocks."""
    return float(np.std(blocks, ddof=1) * np.sqrt(len(blocks))) if len(blocks) > 1 else float(abs(blocks.sum()))


def score(bench: Bench, e: Array, columns: Array, signed: bool) -> tuple[Array, Array, Array]:
    """Gain by block (K, B), factor (K,) and explained share (K,) of single columns (K, N), both projected already.

    ``signed``: whether a negative factor is allowed.
    """
    xx, xe, ee = bench.per_block(columns ** 2), bench.per_block(columns * e), bench.per_block(e ** 2)
    total, cross = xx.sum(-1, keepdims=True), xe.sum(-1, keepdims=True)
    safe = np.maximum(total - xx, 1e-12 * total + 1e-300)
    factor = (cross - xe) / safe
    full = cross / np.maximum(total, 1e-300)
    if not signed:
        factor, full = np.maximum(factor, 0.0), np.maximum(full, 0.0)
    left = np.maximum(ee - 2 * factor * xe + factor ** 2 * xx, 1e-12 * ee + 1e-300)
    share = (2 * full * cross - full ** 2 * total)[:, 0] / max(float(ee.sum()), 1e-300)
    return 0.5 * bench.counts * np.log(ee / left), full[:, 0], share


def weigh_many(bench: Bench, e: Array, columns: Array) -> tuple[Array, Array]:
    """Gain by block (B,) and share of several columns (k, N) fitted together, coefficients from the other blocks."""
    xx = np.stack([bench.per_block(columns * c) for c in columns])      # (k, k, B)
    xe, ee = bench.per_block(columns * e), bench.per_block(e ** 2)
    ridge = 1e-9 * np.trace(xx.sum(-1)) / len(columns) * np.eye(len(columns)) + 1e-300 * np.eye(len(columns))
    out = np.zeros(bench.blocks)
    for b in range(bench.blocks):
        c = np.linalg.solve(xx.sum(-1) - xx[..., b] + ridge, xe.sum(-1) - xe[:, b])
        left = ee[b] - 2 * c @ xe[:, b] + c @ xx[..., b] @ c
        out[b] = 0.5 * bench.counts[b] * np.log(ee[b] / max(left, 1e-12 * ee[b]))
    c = np.linalg.solve(xx.sum(-1) + ridge, xe.sum(-1))
    return out, np.asarray((c @ xe.sum(-1)) / ee.sum())


@final
@dataclass(frozen=True, eq=False)
class Scale:
    """Where suspects are weighed: the bench, its places, what stands already, and the vocabulary."""

    bench: Bench
    places: tuple[Place, ...]
    standing: tuple[Weighed, ...]
    classes: tuple[str, ...]
    mains: float

    @property
    def residual(self) -> Array:
        """Projected innovations without what stands already."""
        return self.clean(self.bench.project(self.bench.innovations))

    def clean(self, x: Array) -> Array:
        """Free of the columns that stand already, (..., N)."""
        for w in self.standing:
            c = w.column
            x = x - (x @ c)[..., None] * c / (c @ c) if x.ndim > 1 else x - (x @ c) * c / (c @ c)
        return x

    def prepared(self, x: Array) -> Array:
        """A response as it is compared: projected and cleaned."""
        return self.clean(self.bench.project(x))


def scale_of(bench: Bench, names: Sequence[str], classes: Sequence[str], mains: float) -> Scale:
    """A bench with the motion of its places."""
    return Scale(bench, places_of(bench, names), (), tuple(classes), mains)


def weigh(scale: Scale, progress: Callable[[float], None] | None = None, refine: int = REFINED) -> list[Weighed]:
    """Every suspect that these recordings can test, best first; the best of each class and place only."""
    e = scale.residual
    best: dict[tuple[str, str], Weighed] = {}
    tried: dict[tuple[str, str], list[Weighed]] = {}
    for place, cls, law, shapes, x in force_suspects(scale.bench, scale.places, scale.classes, progress):
        prepared, able = distinct(scale, x)
        blocks, factors, shares = score(scale.bench, e, prepared, law.signed)
        gains = np.where(np.isfinite(blocks).all(axis=1) & able, blocks.sum(axis=1), -np.inf)
        i = int(np.argmax(gains))
        if np.isfinite(gains[i]):
            suspect = Suspect(cls, place.name, law, shapes[i], place.size)
            tried.setdefault((cls, place.name), []).append(Weighed((suspect,), (float(factors[i]),), blocks[i], prepared[i],
                                                                   SHAPE_CHARGE * searched(suspect), float(shares[i])))
    for key, some in tried.items():
        ordered = sorted(some, key=lambda w: -w.gain)
        best[key] = replace(ordered[0], others=tuple(w for w in ordered[1:] if w.gain > OF_THE_BEST * ordered[0].gain > 0))
    for w in _others(scale, e):
        best[w.suspects[0].key] = w
    ranked = sorted((w for w in best.values() if np.isfinite(w.gain)), key=lambda w: -w.gain)
    for i, w in enumerate(_worth(ranked, refine)):
        better = refined(scale, e, w)
        best[w.suspects[0].key] = better
        if progress is not None:
            progress(1.0 + (i + 1) / refine)
    return sorted((w for w in best.values() if np.isfinite(w.gain)), key=lambda w: -w.gain)


def distinct(scale: Scale, x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Responses (K, N) prepared for comparison, and which of them differ from what a linear model may absorb by more than rounding."""
    size = np.abs(x).max(axis=1)
    able = np.isfinite(size) & (size > 0) & (size < 1e60)
    x = np.where(able[:, None], x, 0.0) / np.where(able, size, 1.0)[:, None]
    prepared = scale.prepared(x)
    able &= (prepared ** 2).sum(axis=1) > 1e-9 * (x ** 2).sum(axis=1)
    return prepared * np.where(able, size, 0.0)[:, None], able


def searched(suspect: Suspect) -> int:
    """Number of shape parameters that were searched."""
    law = suspect.law
    return 0 if law is None else sum(kind != "fixed" for i, kind in enumerate(law.free) if i not in law.scaled)


def _worth(ranked: Sequence[Weighed], count: int) -> list[Weighed]:
    """The best of every class first, then the best places of the leading class."""
    seen: set[str] = set()
    first = [w for w in ranked if w.gain > 0 and not (w.suspects[0].cls in seen or seen.add(w.suspects[0].cls))]  # type: ignore[func-returns-value]
    rest = [w for w in ranked if w.gain > 0 and w not in first and first and w.suspects[0].cls == first[0].suspects[0].cls]
    return (first + rest)[:count]


def refined(scale: Scale, e: Array, found: Weighed) -> Weighed:
    """The same suspect with its shape moved to where it explains most."""
    from scipy.optimize import minimize

    suspect = found.suspects[-1]
    law = suspect.law
    if law is None:
        return found
    place = next(p for p in scale.places if p.name == suspect.place)
    moving = [i for i, kind in enumerate(law.free) if kind != "fixed" and (i not in law.scaled or i != law.scaled[0])]
    moving = [i for i in moving if not (law.excess and law.term.name != "bouc_wen" and i == 1)]
    if not moving:
        return found
    low, high = suspect.bounds

    def shape_at(x: Array) -> Array:
        out = suspect.shape.copy()
        for value, i in zip(x, moving, strict=True):
            out[i] = suspect.shape[i] * np.exp(value) if law.free[i] == "log" else suspect.shape[i] + value * _step(suspect, i)
        return np.clip(out, low, high)

    def explained(x: Array) -> float:
        column, able = distinct(scale, response(scale.bench, place, law, shape_at(x)[None]))
        value = float(score(scale.bench, e, column, law.signed)[0].sum()) if able[0] else 0.0
        return -value if np.isfinite(value) else 0.0

    start = np.vstack([np.zeros(len(moving)), 0.25 * np.eye(len(moving))])
    with np.errstate(all="ignore"):
        at = minimize(explained, start[0], method="Nelder-Mead",
                      options={"initial_simplex": start, "maxfev": 40 * len(moving), "xatol": 0.01, "fatol": 0.1}).x
    shape = shape_at(at)
    column = distinct(scale, response(scale.bench, place, law, shape[None]))[0]
    blocks, factors, shares = score(scale.bench, e, column, law.signed)
    if not blocks[0].sum() > found.blocks.sum():
        return found
    return replace(found, suspects=(*found.suspects[:-1], replace(suspect, shape=shape)), factors=(*found.factors[:-1], float(factors[0])),
                   blocks=blocks[0], column=column[0], share=float(shares[0]))


def _step(suspect: Suspect, i: int) -> float:
    """Scale of a linear move of one parameter."""
    law, size = suspect.law, suspect.size
    assert law is not None
    unit = law.term.params[i].unit
    return size.displacement if unit == "m" and size is not None else 1.0


def _others(scale: Scale, e: Array) -> list[Weighed]:
    """Effects that are no force law: drift of a stiffness, delays and gains of the measuring chain, hum."""
    bench, out = scale.bench, []
    record = bench.desks[0].trial.recording
    columns: list[tuple[str, str, Array]] = []
    if "stiffness_drift" in scale.classes:
        columns += [("stiffness_drift", p.name, drift_response(bench, p)) for p in scale.places]
    if "force_delay" in scale.classes and not record.free:
        names = list(dict.fromkeys(c.location for c in record.inputs))
        columns += [("force_delay", "FORCE", delay_response(bench, n)) for n in names[:1]]
    if len(record.channels) > 1 and bench.linear.model.modes > 1:
        for c in record.channels:
            columns += [("sensor_gain", c.name, channel_response(bench, c.name, "gain")),
                        ("sensor_delay", c.name, channel_response(bench, c.name, "delay"))]
    for cls, place, x in columns:
        if cls not in scale.classes:
            continue
        column = scale.prepared(x)
        if not (column ** 2).sum() > 1e-8 * (x ** 2).sum():
            continue   # part of what a linear model may absorb: not testable
        blocks, factors, shares = score(bench, e, column, True)
        out.append(Weighed((Suspect(cls, place, None, np.zeros(0)),), (float(factors[0]),), blocks[0], column[0], 1.0, float(shares[0])))
    if "mains_hum" in scale.classes:
        for c in record.channels:
            x = scale.prepared(hum_response(bench, c.name, scale.mains))
            x = x[(x ** 2).sum(axis=1) > 0]
            if len(x):
                blocks, share = weigh_many(bench, e, x)
                out.append(Weighed((Suspect("mains_hum", c.name, None, np.zeros(0)),), (1.0,), blocks, x[0], len(x) / 2.0, float(share)))
    return out


def doubles(scale: Scale, singles: Sequence[Weighed], leaders: int = 2, progress: Callable[[float], None] | None = None) -> list[Weighed]:
    """Pairs: what the best second effect adds to each of the leading ones."""
    out: list[Weighed] = []
    for i, first in enumerate(singles[:leaders]):
        if first.gain <= 0:
            continue
        seconds = weigh(replace(scale, standing=(first,)), refine=2)
        for second in seconds[:4]:
            if second.suspects[0].key == first.suspects[0].key or second.gain <= 0:
                continue
            out.append(Weighed((*first.suspects, *second.suspects), (*first.factors, *second.factors), first.blocks + second.blocks,
                               second.column, first.charge + second.charge + 3.0, first.share + second.share * (1 - first.share)))
        if progress is not None:
            progress((i + 1) / leaders)
    return sorted(out, key=lambda w: -w.gain)
