"""Strong laws seen from afar: one place whose stiffness and damping differ from level to level.

A law that changes the response by a tenth or more moves its place otherwise than any linear model without it, and bends the mean transfer
function on which that model is calibrated; a search that begins there may never reach it. But to the force of each level the structure
answers nearly as a linear one would, with another dynamic stiffness k + c s at the place of the law (equivalent linearization, Caughey
1963). Such a fit, all levels with one linear model, has no side valleys worth the name. The place that explains most so is that of the
law; how k and c go with the level tells which law, and how strong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import Extension, LinearFit, assemble, finish, floored
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.effects import along_period, effect_of
from bayes_nlsid.mismatch.evidence import Evidence, transfer
from bayes_nlsid.mismatch.explain import Candidate, sizes
from bayes_nlsid.mismatch.laws import Law
from bayes_nlsid.mismatch.linear import Attachment
from bayes_nlsid.mismatch.paths import Bed, bed
from bayes_nlsid.mismatch.polish import Bench, Hypothesis, begin
from bayes_nlsid.mismatch.valley import Place, follow

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Level = tuple[NDArray[np.intp], Complex, Array]
TOLERANCE = 0.1   # of a transfer function that is only nearly linear, relative
SAME = 0.1        # difference of forces (log rms) that are taken as one level
WIDE = 30.0       # prior sd of an equivalent stiffness over the static one of the place, and of damping at mid band
EVERY = 3         # lines of which one is used
INEXACT = 0.05    # of an equivalent stiffness as the statement of a law, over the largest
ALIKE = 6.0       # squared deviation over what is expected, up to which a law is worth a start
PLACES = 2        # that are followed


@final
@dataclass(frozen=True)
class Equivalent:
    """One place with a dynamic stiffness of its own at every level, fitted together with the linear model.

    Parameters
    ----------
    place : str
    theta : ndarray (P,)
        Linear model.
    groups : tuple of ndarray of int
        Records of each of Q levels.
    values : ndarray (Q, 2)
        Stiffness, N/m, and damping, N s/m.
    covariance : ndarray (2 Q, 2 Q)
        Of ``values``.
    cost : float
        −2 log posterior up to a constant.
    """

    place: str
    theta: Array
    groups: tuple[NDArray[np.intp], ...]
    values: Array
    covariance: Array
    cost: float


def by_level(evidence: Evidence) -> list[Level]:
    """Records, transfer function (Le, S) and its variance for each level."""
    spectra, e = evidence.spectra, evidence.excited
    size = np.linalg.norm(spectra.waveforms, axis=1)
    mark = np.round(np.log(np.maximum(size / max(float(size.max()), 1e-300), 1e-9)) / SAME)
    F = spectra.force[:, e]
    Y = F[:, :, None] * evidence.H + evidence.residual[:, e]    # not the responses: what was undone stays undone
    out = []
    for level in np.unique(mark):
        records = np.flatnonzero(mark == level)
        trust = evidence.trust[records]
        H, power = transfer(F[records], Y[records], trust)
        noise = np.einsum("r,rls->ls", trust, spectra.noise[records][:, e]) / len(records)
        out.append((records, H, noise / power + (TOLERANCE * np.abs(H)) ** 2))
    return out


def equivalent(bench: Bench, place: str, theta: Array, levels: list[Level], steps: int = 15) -> Equivalent:
    """Fit of all levels with one linear model, begun at ``theta`` (P,), and a dynamic stiffness of each at ``place``."""
    fam, count = bench.family, bench.family.size
    s = bench.evidence.spectra.s[bench.evidence.excited][::EVERY]
    unit = bench.stiffness[place] * np.array([1.0, 1.0 / float(np.abs(s).mean())])
    beside = Extension(np.zeros(2), lambda x, q: ((Attachment(fam.places[place], unit[0] * x[0] + unit[1] * x[1] * q),), None),
                       np.full(2, WIDE), np.zeros(2))
    prior = np.concatenate([1 / fam.prior_sd ** 2, np.full(2 * len(levels), 1 / WIDE ** 2)])

    def at(y: Array, derivatives: bool = True) -> Place:
        normal, gradient, cost = np.diag(prior), -prior * y, float(prior @ y ** 2)
        for i, (_, H, variance) in enumerate(levels):
            own = count + 2 * i + np.arange(2)
            system = assemble(fam, y[:count], y[own], s, H[::EVERY], variance[::EVERY], beside, derivatives=derivatives)
            cost += system.chi2
            if derivatives:
                where = np.concatenate([np.arange(count), own])
                normal[np.ix_(where, where)] += system.normal
                gradient[where] += system.gradient
        return Place(y, normal, gradient, cost)

    end = follow(at, np.concatenate([theta, np.zeros(2 * len(levels))]), steps, 0.3)
    units = np.tile(unit, len(levels))
    covariance = np.linalg.inv(end.normal)[count:, count:] * np.outer(units, units)
    return Equivalent(place, end.y[:count], tuple(records for records, _, _ in levels), (end.y[count:] * units).reshape(-1, 2),
                      covariance, end.cost)


def strong_starts(bench: Bench, theta: Array) -> list[Hypothesis]:
    """Laws whose equivalents are those found at the likeliest places, as hypotheses to be estimated; none where there is one level only.

    Parameters
    ----------
    theta : (P,) linear model to begin from.
    """
    levels = by_level(bench.evidence)
    if len(levels) < 2:
        return []
    found = sorted((equivalent(bench, place, theta, levels) for place in bench.family.places), key=lambda e: e.cost)
    values = 2 * sum(H[::EVERY].size for _, H, _ in levels)
    out = []
    for e in found[:PLACES]:
        if e.cost - found[0].cost < 0.1 * values:
            out += _laws_at(bench, e)
    return out


def _laws_at(bench: Bench, found: Equivalent) -> list[Hypothesis]:
    """The best law of each class that goes with the level as the place does, begun."""
    fam, spectra = bench.family, bench.evidence.spectra
    paths = bed(_linear(bench, found.theta).fields.modes, spectra, fam.places[found.place][None], fam.shaker)
    motions = {int(r): paths.linear(int(r)) / (1 + paths.among[:, 0] * (k + c * paths.s)[:, None])
               for records, (k, c) in zip(found.groups, found.values, strict=True) for r in records}
    size = sizes(paths, [found.place], [motions[r] for r in range(len(motions))])[found.place]
    moved = [_in_time(paths, motions[int(records[0])]) for records in found.groups]
    movable = _own_stiffness(bench, found.place) > 0
    best: list[tuple[float, Candidate, float]] = []
    for row in ROWS.values():
        if row.kind == "force":
            each = [_matched(law, law.shapes(size), moved, paths, found, row.name, movable) for law in row.laws]
            acting = [m for m, law in zip(each, row.laws, strict=True) if m[1].effect.values[law.scaled[0]] != 0]
            best += sorted(acting, key=lambda m: m[0])[:1]
    least = min((m[0] for m in best), default=0.0)
    out = []
    for misfit, candidate, offset in sorted(best, key=lambda m: m[0]):
        if misfit < ALIKE * max(least, 1.0):
            start = _linear(bench, _stiffened(bench, found, offset))
            both = (candidate, _mirrored(candidate)) if candidate.effect.cls == "asymmetric" else (candidate,)
            out.append(min((begin(bench, start, (c,), steps=0, weaker=0) for c in both), key=lambda h: h.misfit_records))
    return out


def _linear(bench: Bench, theta: Array) -> LinearFit:
    """The linear model at ``theta``, held against a mean transfer function that a strong law has bent."""
    evidence = bench.evidence
    variance = floored(evidence.H, evidence.doubted(evidence.residual))
    return finish(bench.family, theta, evidence.spectra.s[evidence.excited], evidence.H, variance, rounds=0)


def _in_time(paths: Bed, D: Complex) -> tuple[Array, Array]:
    """Displacement and velocity (n,) of the only place."""
    d, v = paths.in_time(D)
    return d[:, 0], v[:, 0]


def _matched(law: Law, shapes: Array, moved: list[tuple[Array, Array]], paths: Bed, found: Equivalent, cls: str,
             movable: bool) -> tuple[float, Candidate, float]:
    """The shape and factor of a law whose equivalents are nearest to those found: mean squared deviation, the law, and the stiffness that
    belongs to the linear model beside it (0 unless that is ``movable`` at the place)."""
    along = [along_period(law, shapes, d, v, paths.dt, paths.periodic) for d, v in moved]                         # (K, n) each
    own = np.array([[g @ d / (d @ d), g @ v / (v @ v)] for g, (d, v) in zip(along, moved, strict=True)])          # (Q, 2, K)
    rate = float(np.mean([np.std(v) / np.std(d) for d, v in moved]))
    scale = np.tile([1.0, rate], len(moved))                                             # damping as stiffness
    wanted = found.values.ravel() * scale
    doubt = found.covariance * np.outer(scale, scale) + np.diag(np.full(len(wanted), (INEXACT * np.abs(wanted).max()) ** 2 + 1e-300))
    root = np.linalg.inv(np.linalg.cholesky(doubt))
    offset, target = root @ np.tile([1.0, 0.0], len(moved)) * movable, root @ wanted
    columns = root @ (own.reshape(len(wanted), -1) * scale[:, None])                                              # (2 Q, K)
    length = max(float(offset @ offset), 1e-300)
    free = np.eye(len(target)) - np.outer(offset, offset) / length
    columns_left, target_left = free @ columns, free @ target
    factor = target_left @ columns_left / np.maximum((columns_left ** 2).sum(0), 1e-300)
    if not law.signed:
        factor = np.maximum(factor, 0.0)
    misfit = ((target_left[:, None] - columns_left * factor) ** 2).sum(0) / max(len(target) - 2, 1)
    k = int(np.argmin(misfit))
    values = shapes[k].copy()
    values[list(law.scaled)] *= factor[k]
    beside = float(offset @ (target - columns[:, k] * factor[k]) / length)
    return float(misfit[k]), Candidate(effect_of(cls, found.place, law, values), 0.0), beside


def _mirrored(candidate: Candidate) -> Candidate:
    """The same one-sided law on the other side, which has the same equivalents."""
    effect = candidate.effect
    assert effect.law is not None
    turned = np.array([-1.0 if kind in ("signed", "linear") else 1.0 for kind in effect.law.free])
    return replace(candidate, effect=replace(effect, values=effect.values * turned))


def _own_stiffness(bench: Bench, place: str) -> float:
    """Stiffness of the part of the linear model that acts at a place and nowhere else, N/m; 0 if there is none."""
    b = bench.family.single.get(bench.family.names.index(place)) if place in bench.family.names else None
    direction = bench.family.places[place]
    return 0.0 if b is None else float(b @ b) / float(direction @ direction)


def _stiffened(bench: Bench, found: Equivalent, offset: float) -> Array:
    """The linear model with the stiffness at the place that is no part of the law."""
    theta, own = found.theta.copy(), _own_stiffness(bench, found.place)
    if own > 0:
        i = bench.family.names.index(found.place)
        theta[i] = float(np.log(max(np.exp(theta[i]) + offset / own, 0.05)))
    return theta
