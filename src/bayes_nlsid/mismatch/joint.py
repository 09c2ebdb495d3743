"""One Gauss–Newton iteration in everything at once: law parameters and linear parameters, for the hypothesis that leads.

Alternating between law and calibration (``polish``) stalls where one can take over what the other does, as a modal damping ratio and a
damper at a joint. Here both parts of the sum of squares, projected residual and transfer function, are linearised in both kinds of
parameters: the linear ones move the paths to and from the place, the law moves the transfer function that is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import System, assemble, finish, floored, stack
from bayes_nlsid.mismatch.effects import Effect, extension, packed, unpack
from bayes_nlsid.mismatch.linear import solve
from bayes_nlsid.mismatch.paths import bed
from bayes_nlsid.mismatch.polish import (
    Bench,
    Hypothesis,
    force_strengths,
    hypothesis,
    paths_to_sensors,
    simulate,
    widened,
)
from bayes_nlsid.mismatch.spectra import repeats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


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

    def __init__(self, bench: Bench, h: Hypothesis) -> None:
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
        self.variance = floored(evidence.H, evidence.variance)
        self.sd = widened(bench.family, {e.place for e in h.effects if e.is_force or e.cls == "linear_stiffness"})

    def effects(self, y: Array) -> tuple[Effect, ...]:
        """The force effects at ``y``."""
        return tuple(unpack(e, y[a:b], e) for e, a, b in zip(self.forces, self.edges[:-1], self.edges[1:], strict=True))

    def at(self, y: Array, theta: Array, x: Array, errors: Array, warm: tuple[Complex, ...] | None, most: int = 40,
           coarse: bool = False) -> Point:
        """Simulate all records at these parameters."""
        bench, evidence = self.bench, self.bench.evidence
        spectra = evidence.spectra
        modes = solve(bench.family, theta)
        parts = (lambda q: ((), None)) if self.ext is None else (lambda q: self.ext.parts(x, q))  # type: ignore[union-attr]
        paths = bed(modes, spectra, self.rows, bench.family.shaker, lambda q: parts(q)[0])
        fld = replace(self.h.fit.fields, modes=modes)
        fit = replace(self.h.fit, fields=fld, shape_errors=errors)
        h = paths_to_sensors(bench, fit, self.places, spectra.s, parts(spectra.s))
        there = simulate(paths.coarse if coarse else paths, spectra, self.effects(y), self.unique, warm, most=most)
        projected = np.stack([evidence.project(there.lines[:, :, j]) for j in range(len(self.forces))], axis=-1)
        residual = (evidence.residual + np.einsum("lsj,rlj->rls", h, projected, optimize=True)) * self.root
        shadow = np.stack([evidence.shadow(there.lines[:, :, j]) for j in range(len(self.forces))], axis=-1)[evidence.excited]
        cleaned = evidence.H + np.einsum("lsj,lj->ls", h[evidence.excited], shadow)
        return Point(residual, cleaned, there.motions, there.status, force_strengths(bench, h, there.lines))

    def cost(self, point: Point, theta: Array, x: Array) -> float:
        """−2 log posterior at a point."""
        system = assemble(self.bench.family, theta, x, self.s, point.cleaned, self.variance, self.ext, derivatives=False)
        prior = float(((theta / self.sd) ** 2).sum()) + (self.ext.penalty(x) if self.ext is not None else 0.0)
        return float((np.abs(point.residual) ** 2).sum()) + system.chi2 + prior


def refine(bench: Bench, h: Hypothesis, steps: int = 5) -> Hypothesis:
    """Joint Gauss–Newton iterations from a polished hypothesis; returns it unchanged if nothing is gained."""
    if not h.forces:
        return h
    joint = Joint(bench, h)
    theta, x, errors = h.fit.theta, h.fit.x, h.fit.shape_errors
    y = np.concatenate(joint.y0)
    now = joint.at(y, theta, x, errors, None)
    cost = joint.cost(now, theta, x)
    damping, curvature = 1e-3, h.curvature
    kept: tuple[Complex, Complex] | None = None
    fresh = 0
    while fresh < steps:
        # columns of linear parameters are dear and change little: they serve three steps, or until they fail
        stale = kept is not None
        normal, gradient, curvature, kept = _linearise(joint, now, y, theta, x, errors, kept)
        fresh += 1
        accepted = False
        for _ in range(4):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            step[:len(y)] = np.clip(step[:len(y)], -1.0, 1.0)
            step[len(y):] = np.clip(step[len(y):], -1.0, 1.0)
            trial = (y + step[:len(y)], theta + step[len(y):len(y) + len(theta)], x + step[len(y) + len(theta):])
            there = joint.at(*trial, errors, now.motions)
            new = joint.cost(there, trial[1], trial[2])
            if np.isfinite(new) and new < cost:
                accepted = True
                break
            damping = max(8 * damping, 1e-3)
        if not accepted and not stale:
            break
        if not accepted:
            kept, damping = None, 1e-3
            continue
        gain, (y, theta, x), now, cost, damping = cost - new, trial, there, new, max(damping / 8, 1e-7)
        kept = None if fresh % 3 == 0 else kept
        errors = finish(bench.family, theta, joint.s, now.cleaned, joint.variance, joint.ext, x, joint.sd).shape_errors
        if gain < 1e-4 * cost:
            if not stale:
                break
            kept = None
    now = joint.at(y, theta, x, errors, now.motions)
    fit = finish(bench.family, theta, joint.s, now.cleaned, joint.variance, joint.ext, x, joint.sd)
    forces = list(joint.effects(y))
    effects = tuple(forces.pop(0) if e.is_force else e for e in h.effects)
    found = hypothesis(bench, effects, h.kinds, fit, float((np.abs(now.residual) ** 2).sum()), curvature, now.residual / joint.root,
                       now.status, now.strengths)
    return found if found.cost < h.cost else h


def _linearise(joint: Joint, now: Point, y: Array, theta: Array, x: Array, errors: Array, kept: tuple[Complex, Complex] | None
               ) -> tuple[Array, Array, Array, tuple[Complex, Complex]]:
    """Normal matrix and gradient in (y, theta, x), the curvature in y with all linear parameters profiled out, and the columns.

    ``kept``: columns of an earlier step, whose part for ``theta`` is used again.
    """
    fam = joint.bench.family
    system = assemble(fam, theta, x, joint.s, now.cleaned, joint.variance, joint.ext)
    count = len(y) + len(theta)
    columns = np.zeros((count + len(x), now.residual.size), dtype=complex)
    change = np.zeros((count + len(x), *now.cleaned.shape), dtype=complex)
    still = joint.at(y, theta, x, errors, now.motions, most=12, coarse=True)
    if kept is not None:
        columns[len(y):count], change[len(y):count] = kept[0][len(y):count], kept[1][len(y):count]
    for i in range(count if kept is None else len(y)):
        law, step = i < len(y), 1e-3 if i < len(y) else 1e-3 * float(np.clip(joint.sd[i - len(y)], 1e-3, 0.3))
        yy = y + step * (np.arange(len(y)) == i)
        tt = theta if law else theta + step * (np.arange(len(theta)) == i - len(y))
        moved = joint.at(yy, tt, x, errors, now.motions, most=12, coarse=True)
        columns[i] = ((still.residual - moved.residual) / step).ravel()
        change[i] = (moved.cleaned - still.cleaned) / step
    linear = _columns(system, change, len(y))
    normal = (columns.conj() @ columns.T).real + linear[0]
    gradient = (columns.conj() @ now.residual.ravel()).real + linear[1]
    prior = np.concatenate([np.full(len(y), 1e-2), 1 / joint.sd ** 2, np.zeros(0) if joint.ext is None else 1 / joint.ext.prior_sd ** 2])
    centre = np.concatenate([y, np.zeros(len(theta)), np.zeros(0) if joint.ext is None else joint.ext.centre])
    normal += np.diag(prior)
    gradient -= prior * (np.concatenate([y, theta, x]) - centre)
    k = len(y)
    curvature = normal[:k, :k] - normal[:k, k:] @ np.linalg.solve(normal[k:, k:], normal[k:, :k])
    return normal, gradient, curvature, (columns, change)


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


__all__ = ["Joint", "Point", "refine"]
