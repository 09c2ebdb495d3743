"""Gauss–Newton in everything at once: law parameters and linear parameters together, by forward simulation.

Alternating between law and calibration stalls where one can take over what the other does, as a modal damping ratio and a
damper at a joint. Here both parts of the sum of squares, projected residual and transfer function, are linearised in both kinds of
parameters: the linear ones move the paths to and from the place, the law moves the transfer function that is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit, System, assemble, finish, floored, stack
from bayes_nlsid.mismatch.effects import Effect, extension, packed, unpack
from bayes_nlsid.mismatch.explain import Candidate
from bayes_nlsid.mismatch.linear import solve
from bayes_nlsid.mismatch.paths import bed
from bayes_nlsid.mismatch.polish import (
    Bench,
    Hypothesis,
    begin,
    estimate_linear,
    force_strengths,
    hypothesis,
    paths_to_sensors,
    simulate,
    widened,
)
from bayes_nlsid.mismatch.spectra import repeats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
NEARBY = 1.25  # times the end of the band, up to where a mode's own deviations move the places noticeably


@final
@dataclass(frozen=True)
class Point:
    """Everything at one set of parameters: weighted projected residual, cleaned transfer function, motions for warm starts, strengths."""

    residual: Complex
    cleaned: Complex
    motions: tuple[Complex, ...]
    status: str
    strengths: Array


@final
class Joint:
    """The sum of squares of one hypothesis as a function of law (y) and linear (theta, x) parameters."""

    def __init__(self, bench: Bench, h: Hypothesis, doubt: bool = False) -> None:
        self.bench, self.h = bench, h
        self.forces = h.forces
        self.places = [e.place for e in self.forces]
        self.rows = np.array([bench.family.places[p] for p in self.places])
        self.ext = extension(h.kinds, len(bench.channels))
        self.unique = repeats(bench.evidence.spectra)
        self.root = np.sqrt(2 * bench.evidence.trust[:, None, None] * bench.evidence.weight)
        self.y0 = [packed(e, e) for e in self.forces]
        self.edges = np.concatenate([[0], np.cumsum([len(p) for p in self.y0])]).astype(int)
        evidence = bench.evidence
        self.s = evidence.spectra.s[evidence.excited]
        self.variance = floored(evidence.H, evidence.doubted(h.residual) if doubt else evidence.variance)
        self.sd = widened(bench.family, h.fit.sd, {e.place for e in h.effects if e.is_force or e.cls == "linear_stiffness"})

    @property
    def linear_prior(self) -> tuple[Array, Array]:
        """Precision and centre (P + X,) of the prior of the linear parameters (theta, x)."""
        beside = (np.zeros(0), np.zeros(0)) if self.ext is None else (1 / self.ext.prior_sd ** 2, self.ext.centre)
        return np.concatenate([1 / self.sd ** 2, beside[0]]), np.concatenate([np.zeros(len(self.sd)), beside[1]])

    def effects(self, y: Array) -> tuple[Effect, ...]:
        """The force effects at ``y``."""
        return tuple(unpack(e, y[a:b], e) for e, a, b in zip(self.forces, self.edges[:-1], self.edges[1:], strict=True))

    def at(self, y: Array, theta: Array, x: Array, errors: Array, warm: tuple[Complex, ...] | None, most: int = 40,
           coarse: bool = False, search: bool = True) -> Point:
        """Simulate all records at these parameters; in a ``search`` a march that is not sound will do."""
        bench, evidence = self.bench, self.bench.evidence
        spectra = evidence.spectra
        modes = solve(bench.family, theta)
        parts = (lambda q: ((), None)) if self.ext is None else (lambda q: self.ext.parts(x, q))  # type: ignore[union-attr]
        paths = bed(modes, spectra, self.rows, bench.family.shaker, lambda q: parts(q)[0])
        fld = replace(self.h.fit.fields, modes=modes)
        fit = replace(self.h.fit, fields=fld, shape_errors=errors)
        h = paths_to_sensors(bench, fit, self.places, spectra.s, parts(spectra.s))
        paths = replace(paths, marched=bench.marched[coarse])
        there = simulate(paths, spectra, self.effects(y), self.unique, warm, most=most, march_only=search)
        projected = np.stack([evidence.project(there.lines[:, :, j]) for j in range(len(self.forces))], axis=-1)
        residual = (evidence.residual + np.einsum("lsj,rlj->rls", h, projected, optimize=True)) * self.root
        shadow = np.stack([evidence.shadow(there.lines[:, :, j]) for j in range(len(self.forces))], axis=-1)[evidence.excited]
        cleaned = evidence.H + np.einsum("lsj,lj->ls", h[evidence.excited], shadow)
        return Point(residual, cleaned, there.motions, there.status, force_strengths(bench, h, there.lines))

    def fit(self, point: Point, theta: Array, x: Array) -> LinearFit:
        """The linear model at a point."""
        return finish(self.bench.family, theta, self.s, point.cleaned, self.variance, self.ext, x, self.sd, spread=self.h.fit.spread,
                      rounds=0)

    def cost(self, point: Point, theta: Array, x: Array) -> float:
        """−2 log posterior at a point."""
        system = assemble(self.bench.family, theta, x, self.s, point.cleaned, self.variance, self.ext, derivatives=False,
                          spread=self.h.fit.spread)
        prior = float(((theta / self.sd) ** 2).sum()) + (self.ext.penalty(x) if self.ext is not None else 0.0)
        return float((np.abs(point.residual) ** 2).sum()) + system.chi2 + prior


def estimate(bench: Bench, start: LinearFit, candidates: tuple[Candidate, ...], beat: float = np.inf) -> Hypothesis:
    """Joint estimation of up to two effects with the linear model.

    Parameters
    ----------
    start : linear fit to begin from.
    candidates : effects with starting values from the first search.
    beat : see ``estimate_linear``.
    """
    if not any(c.effect.is_force for c in candidates):
        return estimate_linear(bench, start, candidates, beat)
    return pursue(bench, begin(bench, start, candidates))


def pursue(bench: Bench, h: Hypothesis) -> Hypothesis:
    """Joint estimation from where a law begins: where it is strong, first with a transfer function that is doubted as far as the law leaves
    something unexplained, for a wrong law bends the linear model."""
    if bench.evidence.strong:
        there = refine(bench, refine(bench, h, steps=5, quick=True, doubt=True), steps=6, quick=True)
        return there if there.cost < h.cost else h
    return refine(bench, h, steps=4, quick=True)


def refine(bench: Bench, h: Hypothesis, steps: int = 5, quick: bool = False, doubt: bool = False) -> Hypothesis:
    """Joint Gauss–Newton iterations; returns the hypothesis unchanged if nothing is gained.

    Parameters
    ----------
    quick : of what linear parameters do to the motion at the place, only the stiffness there counts in the derivatives, which saves most
        simulations, and marches take longer steps.
    doubt : the transfer function counts as far as it is not bent by what ``h`` leaves unexplained; what comes back may cost more.
    """
    if not h.forces:
        return h
    joint = Joint(bench, h, doubt)
    theta, x, errors = h.fit.theta, h.fit.x, h.fit.shape_errors
    y = np.concatenate(joint.y0)
    now = joint.at(y, theta, x, errors, None, coarse=quick)
    cost = joint.cost(now, theta, x)
    damping, curvature = 1e-3, h.curvature
    names = bench.family.names[:len(bench.family.K_parts)]
    moving = [i for i, name in enumerate(names) if name in joint.places] if quick else _moving(joint, h)
    kept: tuple[Complex, Complex] | None = None
    for _ in range(steps):
        # columns of linear parameters are dear and change little: they serve while they lead on
        stale = kept is not None
        normal, gradient, curvature, kept = _linearise(joint, now, y, theta, x, errors, moving, kept)
        trial, there, new, damping = _step(joint, now, (y, theta, x), errors, normal, gradient, damping, cost, quick)
        if there is None and not stale:
            break
        if there is None:
            kept, damping = None, 1e-3
            continue
        gain, (y, theta, x), now, cost, damping = cost - new, trial, there, new, max(damping / 8, 1e-7)
        kept = None if quick else kept
        errors = joint.fit(now, theta, x).shape_errors
        if gain < 1e-4 * cost and not stale:
            break
        kept = None if gain < 0.02 * cost else kept
    now = joint.at(y, theta, x, errors, now.motions, search=doubt)
    if doubt:
        joint.variance = floored(bench.evidence.H, bench.evidence.variance)
    fit = joint.fit(now, theta, x)
    forces = list(joint.effects(y))
    effects = tuple(forces.pop(0) if e.is_force else e for e in h.effects)
    found = hypothesis(bench, effects, h.kinds, fit, float((np.abs(now.residual) ** 2).sum()), curvature, now.residual / joint.root,
                       now.status, now.strengths)
    return found if doubt or found.cost < h.cost else h


def _moving(joint: Joint, h: Hypothesis) -> list[int]:
    """Linear parameters that the motion of a place depends on: all scales, deviations of modes in the band and a little beyond."""
    fam = joint.bench.family
    own = np.flatnonzero(h.fit.fields.modes.omega[:fam.modes] < NEARBY * np.abs(joint.s).max())
    first = len(fam.names)
    return [*range(first), *(first + own), *(first + fam.modes + own)]


def _step(joint: Joint, now: Point, at: tuple[Array, Array, Array], errors: Array, normal: Array, gradient: Array, damping: float,
          cost: float, coarse: bool) -> tuple[tuple[Array, Array, Array], Point | None, float, float]:
    """The first damped step that lowers the cost: where it leads, the point there (None if there was no such step), its cost, damping."""
    y, theta, x = at
    edges = np.cumsum([len(y), len(theta)])
    for _ in range(6):
        step = np.clip(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), -1.0, 1.0)
        dy, dt, dx = np.split(step, edges)
        trial = (y + dy, theta + dt, x + dx)
        there = joint.at(*trial, errors, now.motions, coarse=coarse)
        new = joint.cost(there, trial[1], trial[2])
        if not new < cost:
            trial, there, new = _mended(joint, trial, there, new, errors, cost, coarse)
        if np.isfinite(new) and new < cost:
            return trial, there, new, damping
        damping = max(8 * damping, 1e-3)
    return at, None, cost, damping


def _mended(joint: Joint, at: tuple[Array, Array, Array], there: Point, value: float, errors: Array, cost: float, coarse: bool
            ) -> tuple[tuple[Array, Array, Array], Point, float]:
    """A step that left the narrow valley of a sharp resonance, led back to it by the linear parameters alone if these promise to do so."""
    (y, theta, x), (prior, centre) = at, joint.linear_prior
    for _ in range(2):
        if not np.isfinite(value):
            break
        system = assemble(joint.bench.family, theta, x, joint.s, there.cleaned, joint.variance, joint.ext,
                          spread=joint.h.fit.spread)
        gradient = system.gradient - prior * (np.concatenate([theta, x]) - centre)
        step = np.linalg.solve(system.normal + np.diag(prior), gradient)
        if not float(gradient @ step) > 0.5 * (value - cost) or np.abs(step).max() > 1.0:
            break
        theta, x = theta + step[:len(theta)], x + step[len(theta):]
        there = joint.at(y, theta, x, errors, there.motions, coarse=coarse)
        value = joint.cost(there, theta, x)
        if value < cost:
            break
    return (y, theta, x), there, value


def _linearise(joint: Joint, now: Point, y: Array, theta: Array, x: Array, errors: Array, moving: Sequence[int],
               kept: tuple[Complex, Complex] | None) -> tuple[Array, Array, Array, tuple[Complex, Complex]]:
    """Normal matrix and gradient in (y, theta, x), the curvature in y with all linear parameters profiled out, and the columns.

    Parameters
    ----------
    moving : those of ``theta`` whose effect on the motion of the place counts; the others only change the transfer function.
    kept : columns of ``moving`` from an earlier step, which are used again.
    """
    fam = joint.bench.family
    system = assemble(fam, theta, x, joint.s, now.cleaned, joint.variance, joint.ext, spread=joint.h.fit.spread)
    laws, count = len(y), len(y) + len(theta) + len(x)
    active = np.concatenate([np.arange(laws), laws + np.asarray(moving, dtype=int)])
    columns = np.zeros((len(active), now.residual.size), dtype=complex)
    change = np.zeros((count, *now.cleaned.shape), dtype=complex)
    still = joint.at(y, theta, x, errors, now.motions, most=12, coarse=True)
    if kept is not None:
        columns[laws:], change[active[laws:]] = kept
    for k, i in enumerate(active if kept is None else active[:laws]):
        law, step = i < laws, 1e-3 if i < laws else 1e-3 * float(np.clip(joint.sd[i - laws], 1e-3, 0.3))
        yy = y + step * (np.arange(laws) == i)
        tt = theta if law else theta + step * (np.arange(len(theta)) == i - laws)
        moved = joint.at(yy, tt, x, errors, now.motions, most=12, coarse=True)
        columns[k] = ((still.residual - moved.residual) / step).ravel()
        change[i] = (moved.cleaned - still.cleaned) / step
    normal, gradient = _columns(system, change, laws)
    normal[np.ix_(active, active)] += (columns.conj() @ columns.T).real
    gradient[active] += (columns.conj() @ now.residual.ravel()).real
    prior, centre = (np.concatenate([law, linear]) for law, linear in zip((np.full(laws, 1e-2), y), joint.linear_prior, strict=True))
    normal += np.diag(prior)
    gradient -= prior * (np.concatenate([y, theta, x]) - centre)
    curvature = normal[:laws, :laws] - normal[:laws, laws:] @ np.linalg.solve(normal[laws:, laws:], normal[laws:, :laws])
    return normal, gradient, curvature, (columns[laws:], change[active[laws:]])


def _columns(system: System, change: Complex, laws: int) -> tuple[Array, Array]:
    """Normal matrix and gradient of the transfer-function part, shape errors projected out.

    The prediction of a line less the cleaned measurement moves by dH/dtheta − d(cleaned), which the residual system has for theta only.
    """
    moved = np.moveaxis(stack(change, system.root), 1, 0)
    J = -moved
    J[:, laws:] += system.J
    BJ = system.B @ np.swapaxes(J, 1, 2)
    Br = np.einsum("smk,sk->sm", system.B, system.r)
    CBJ = np.linalg.solve(system.C, BJ)
    flat = np.swapaxes(J, 0, 1).reshape(J.shape[1], -1)
    normal = flat @ flat.T - np.einsum("smp,smq->pq", BJ, CBJ, optimize=True)
    gradient = np.einsum("spk,sk->p", J, system.r) - np.einsum("smp,sm->p", CBJ, Br)
    return normal, gradient


__all__ = ["Joint", "Point", "estimate", "pursue", "refine"]
