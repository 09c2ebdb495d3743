"""Calibration of the linear model to a measured transfer function, globally.

Poles of the measurement (vector fitting, started at the nominal poles) are paired with nominal modes by MAC, which brings the
physical parameters into the right basin; then the transfer function itself is fitted, first coarsely, at last against its noise. Errors
of single mode shapes at single sensors are random effects and are integrated out sensor by sensor; how large these and other errors of
the model's form are is estimated with them (``form``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.form import groups_price, likeliest_groups, likeliest_shapes, shapes_price
from bayes_nlsid.mismatch.linear import Attachment, Family, Fields, fields, jacobian, solve
from bayes_nlsid.mismatch.poles import modal_start
from bayes_nlsid.mismatch.shapes import shape_columns, with_shape_errors
from bayes_nlsid.mismatch.valley import Place, follow

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
RELATIVE_FLOOR = 2e-4  # of any model of this kind
NEAR = 20.0  # cost per value from which full steps may lead on


@final
@dataclass(frozen=True)
class Chain:
    """What the measuring chain does to the accelerance: H → (H ∘ factor) mix.

    Parameters
    ----------
    factor : ndarray complex (L, S)
    mix : ndarray (S, S) or None
        Crosstalk: column s says what channel s picks up.
    """

    factor: Complex
    mix: Array | None = None

    def apply(self, values: Complex) -> Complex:
        """(..., L, S) as the chain reports it."""
        out = values * self.factor
        return out if self.mix is None else out @ self.mix


@final
@dataclass(frozen=True)
class Extension:
    """Linear effects beside the family.

    Parameters
    ----------
    x : ndarray (X,)
        Their parameters, scaled so that 1 is a large change.
    parts : callable
        ``parts(x, s) -> (attachments, chain or None)``.
    prior_sd : ndarray (X,)
        Around ``centre``.
    centre : ndarray (X,)
    """

    x: Array
    parts: Callable[[Array, Complex], tuple[tuple[Attachment, ...], Chain | None]]
    prior_sd: Array
    centre: Array

    def penalty(self, x: Array) -> float:
        """Prior part of the cost."""
        return float((((x - self.centre) / self.prior_sd) ** 2).sum())


@final
@dataclass(frozen=True)
class LinearFit:
    """A calibrated member of the family and the curvature around it.

    Parameters
    ----------
    theta : ndarray (P,)
    x : ndarray (X,)
        Parameters of the extension (empty without one).
    fields : Fields
        Without shape errors and measuring chain.
    model : ndarray complex (L, S)
        Best prediction of the measurement, random effects and measuring chain included.
    cost : float
        −2 log posterior up to a constant: chi² + priors, random effects integrated out.
    chi2 : float
        The part of ``cost`` that is residual and random effects.
    dof : int
        Real data values.
    normal : ndarray (P + X, P + X)
        Curvature of cost/2, priors included.
    shape_errors : ndarray (S, m)
        Those of modes in the band, and of groups beyond it.
    spread : ndarray (m,)
        Their standard deviations, fitted.
    sd : ndarray (P,)
        Prior standard deviations of theta, those of errors of form fitted.
    s, measured, variance : lines, measured accelerance (L, S), its variance
    system : System
        The normal equations at the optimum.
    rest : ndarray (P + X,)
        Gradient of −cost/2 there (zero up to the stopping rule).
    misfit : float
        Weighted RMS of the final residual over that of the measurement.
    status : str
    """

    theta: Array
    x: Array
    fields: Fields
    model: Complex
    cost: float
    chi2: float
    dof: int
    normal: Array
    shape_errors: Array
    spread: Array
    sd: Array
    s: Complex
    measured: Complex
    variance: Array
    system: System
    rest: Array
    misfit: float
    status: str


@final
@dataclass(frozen=True)
class System:
    """Normal equations with the random effects projected out: ``normal`` (P, P), ``gradient`` (P,), ``chi2``, and whitened parts
    per sensor (``B`` (S, m, 2L) shape errors, ``J`` (S, P, 2L), ``r`` (S, 2L), ``C`` (S, m, m), ``root`` (S, L))."""

    normal: Array
    gradient: Array
    chi2: float
    root: Array
    B: Array
    J: Array
    C: Array
    r: Array

    @property
    def effects(self) -> Array:
        """(S, m): best shape errors."""
        return np.asarray(np.linalg.solve(self.C, np.einsum("smk,sk->sm", self.B, self.r)[..., None])[..., 0])

    def gains(self, columns: Complex, full: Array, rest: Array) -> tuple[Array, Array, Array]:
        """What one more column would explain, everything else projected out.

        Parameters
        ----------
        columns : (C, L, S) complex, change of the transfer function per unit of the parameter.
        full : (P, P) normal matrix with priors. rest : (P,) gradient of −cost/2 that is left (zero at the exact optimum).

        Returns
        -------
        gain (C,) decrease of cost, value (C,) of the coefficient, moves (C, P) of the parameters that go with it
        """
        c = np.moveaxis(stack(columns, self.root), 1, 0)                            # (S, C, 2L)
        Bc = self.B @ np.swapaxes(c, 1, 2)                                         # (S, m, C)
        CBc = np.linalg.solve(self.C, Bc)
        BJ = self.B @ np.swapaxes(self.J, 1, 2)
        cross = np.einsum("spk,sck->pc", self.J, c, optimize=True) - np.einsum("smp,smc->pc", BJ, CBc, optimize=True)
        own = np.einsum("sck,sck->c", c, c) - np.einsum("smc,smc->c", Bc, CBc)
        Br = np.einsum("smk,sk->sm", self.B, self.r)
        slope = np.einsum("sck,sk->c", c, self.r) - np.einsum("smc,sm->c", CBc, Br)
        solved = np.linalg.solve(full, cross)
        information = np.maximum(own - (cross * solved).sum(0), 1e-12 * own + 1e-300)
        slope = slope - rest @ solved
        value = slope / information
        return np.asarray(slope ** 2 / information), np.asarray(value), np.asarray(np.linalg.solve(full, rest) - (solved * value).T)


def stack(values: Complex, root: Array) -> Array:
    """(..., L, S) complex → (..., S, 2L) real, divided by ``root`` (S, L)."""
    moved = np.moveaxis(values, -1, -2) / root
    return np.concatenate([moved.real, moved.imag], axis=-1)


def predict(fam: Family, theta: Array, s: Complex, extension: Extension | None, x: Array) -> tuple[Fields, Chain | None]:
    """Fields and measuring chain at (theta, x)."""
    attach, chain = ((), None) if extension is None else extension.parts(x, s)
    return fields(fam, solve(fam, theta), s, attach), chain


def assemble(fam: Family, theta: Array, x: Array, s: Complex, measured: Complex, variance: Array,
             extension: Extension | None = None, log: bool = False, derivatives: bool = True, spread: Array | None = None) -> System:
    """Normal equations of one Gauss–Newton step in (theta, x), data part only; ``spread`` (modes + BEYOND,): sd of the errors of shapes."""
    spread = fam.error_sd if spread is None else spread
    fld, chain = predict(fam, theta, s, extension, x)
    H, B = fld.H, shape_columns(fam, fld, s)
    J = jacobian(fam, theta, fld, s) if derivatives else np.zeros((0, *H.shape), dtype=complex)
    if chain is not None:
        H, B, J = chain.apply(H), chain.apply(B), chain.apply(J)
    if extension is not None and derivatives:
        extra = np.empty((len(x), *H.shape), dtype=complex)
        for i in range(len(x)):
            step = 1e-4
            moved = x + step * (np.arange(len(x)) == i)
            attach, other = extension.parts(moved, s)
            there = fields(fam, fld.modes, s, attach).H if attach else fld.H
            extra[i] = ((other.apply(there) if other is not None else there) - H) / step
        J = np.concatenate([J, extra])
    residual = measured - H
    if log:
        residual, J, B = np.log(measured / H), J / H, B / H
    root = np.sqrt(variance.T / 2)
    Jr, Br, r = np.moveaxis(stack(J, root), 1, 0), np.moveaxis(stack(B, root), 1, 0), stack(residual, root)
    gram = Br @ np.swapaxes(Br, 1, 2)
    C = gram + np.eye(Br.shape[1]) / spread ** 2
    Brr = np.einsum("smk,sk->sm", Br, r)
    effect = np.linalg.solve(C, Brr[..., None])[..., 0]
    chi2 = float((r ** 2).sum() - (Brr * effect).sum()) + shapes_price(gram, C, spread, fam.error_sd)
    if not derivatives:
        return System(np.zeros((0, 0)), np.zeros(0), chi2, root, Br, Jr, C, r)
    BJ = Br @ np.swapaxes(Jr, 1, 2)
    CBJ = np.linalg.solve(C, BJ)
    flat = np.swapaxes(Jr, 0, 1).reshape(Jr.shape[1], -1)
    normal = flat @ flat.T - np.einsum("smp,smq->pq", BJ, CBJ, optimize=True)
    gradient = np.einsum("spk,sk->p", Jr, r) - np.einsum("smp,sm->p", CBJ, Brr)
    return System(normal, gradient, chi2, root, Br, Jr, C, r)


def descend(fam: Family, theta: Array, s: Complex, measured: Complex, variance: Array, steps: int, *, prior_sd: Array | None = None,
            extension: Extension | None = None, x: Array | None = None, log: bool = False, tol: float = 1e-3, spread: Array | None = None
            ) -> tuple[Array, Array, float]:
    """Levenberg–Marquardt on cost = chi² + priors; returns the best theta, x and cost."""
    count = fam.size
    x = (np.zeros(0) if extension is None else extension.x) if x is None else x
    prior = 1 / (fam.prior_sd if prior_sd is None else prior_sd) ** 2
    centre = np.zeros(count)
    if extension is not None:
        prior = np.concatenate([prior, 1 / extension.prior_sd ** 2])
        centre = np.concatenate([centre, extension.centre])

    def at(y: Array, derivatives: bool = True) -> Place:
        system = assemble(fam, y[:count], y[count:], s, measured, variance, extension, log, derivatives, spread)
        normal, gradient = system.normal, system.gradient
        if derivatives:
            normal, gradient = normal + np.diag(prior), gradient - prior * (y - centre)
        return Place(y, normal, gradient, system.chi2 + float(prior @ (y - centre) ** 2))

    end = follow(at, np.concatenate([theta, x]), steps, tol, NEAR * 2 * measured.size)
    return end.y[:count], end.y[count:], end.cost


def finish(fam: Family, theta: Array, s: Complex, measured: Complex, variance: Array, extension: Extension | None = None,
           x: Array | None = None, prior_sd: Array | None = None, status: str = "ok", spread: Array | None = None,
           rounds: int = 6) -> LinearFit:
    """Curvature, random effects and best prediction at ``theta``, ``x``; in ``rounds`` the sizes of errors of form are fitted too."""
    x = np.zeros(0) if x is None else x
    spread = fam.error_sd if spread is None else spread
    sd = fam.prior_sd if prior_sd is None else prior_sd
    beside = np.zeros(0) if extension is None else 1 / extension.prior_sd ** 2
    centre = np.zeros(0) if extension is None else extension.centre
    own = np.diag(np.concatenate([np.zeros(fam.size), beside]))
    system = assemble(fam, theta, x, s, measured, variance, extension, spread=spread)
    before = np.inf
    for _ in range(rounds):
        spread = likeliest_shapes(system.B @ np.swapaxes(system.B, 1, 2), np.einsum("smk,sk->sm", system.B, system.r), spread, fam.error_sd)
        sd = likeliest_groups(fam, theta, system.normal + own, system.gradient - np.concatenate([0 * theta, beside * (x - centre)]), sd)
        theta, x, cost = descend(fam, theta, s, measured, variance, 2, prior_sd=sd, extension=extension, x=x, tol=0.1, spread=spread)
        system = assemble(fam, theta, x, s, measured, variance, extension, spread=spread)
        cost += groups_price(fam, system.normal + own, sd)
        if before - cost < max(1.0, 1e-4 * cost):
            break
        before = cost
    fld, chain = predict(fam, theta, s, extension, x)
    cost = system.chi2 + float(((theta / sd) ** 2).sum()) + (extension.penalty(x) if extension is not None else 0.0)
    cost += groups_price(fam, system.normal + own, sd)
    errors = system.effects
    model = with_shape_errors(fam, fld, s, errors)
    model = model if chain is None else chain.apply(model)
    misfit = float(np.sqrt((np.abs(measured - model) ** 2 / variance).sum() / (np.abs(measured) ** 2 / variance).sum()))
    rest = system.gradient - np.concatenate([theta / sd ** 2, beside * (x - centre)])
    full = system.normal + np.diag(np.concatenate([1 / sd ** 2, beside]))
    return LinearFit(theta, x, fld, model, cost, system.chi2, 2 * measured.size, full, errors, spread, sd, s, measured, variance,
                     system, rest, misfit, status)


def calibrate(fam: Family, s: Complex, measured: Complex, variance: Array, *, restarts: int = 6, enough: float = 1.1) -> LinearFit:
    """Fit the family to a measured accelerance, globally.

    Parameters
    ----------
    s : (L,) Laplace variable; ``measured`` (L, S) m/s²/N; ``variance`` (L, S) of it (noise and distortion; the floor of the model,
        ``RELATIVE_FLOOR``, is added here).
    restarts : starts with other stiffnesses tried while the cost per value stays above ``enough``.
    """
    variance = floored(measured, variance)
    guess = modal_start(fam, s, measured, variance)
    starts = [np.zeros(fam.size) if guess is None else guess, *_group_starts(fam)]
    best, cost = _anneal(fam, starts[0], s, measured, variance)
    if restarts and cost > enough * 2 * measured.size:
        others = sorted((coarse(fam, first, s, measured, variance) for first in starts[1:1 + restarts]), key=lambda c: c[2])
        for theta, _, _ in others[:2]:
            theta, _, value = descend(fam, theta, s, measured, variance, 25, tol=0.05)
            if value < cost:
                best, cost = theta, value
            if cost < enough * 2 * measured.size:
                break
    status = "ok" if cost < 2 * 2 * measured.size else "misfit remains"
    return finish(fam, best, s, measured, variance, status=status)


def _group_starts(fam: Family) -> list[Array]:
    """Starts with all joints of one kind softer or stiffer: modes that cross when a whole group moves make the basins."""
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(fam.names[:len(fam.K_parts)]):
        groups.setdefault(name.rsplit("_", 1)[-1] if "_" in name else name, []).append(i)
    out = []
    for members in sorted(groups.values(), key=len, reverse=True)[:3]:
        for sign in (-1.3, 1.3):
            theta = np.zeros(fam.size)
            theta[members] = sign * fam.scale_sd[members]
            out.append(theta)
    return out


def floored(measured: Complex, variance: Array) -> Array:
    """Variance with the floor of any model of this kind added."""
    return np.asarray(variance + (RELATIVE_FLOOR * np.abs(measured)) ** 2)


def coarse(fam: Family, theta: Array, s: Complex, measured: Complex, variance: Array, extension: Extension | None = None,
           x: Array | None = None) -> tuple[Array, Array, float]:
    """Log residual with 30 % tolerance, then relative tolerances of 10 and 2 %; theta, x and the cost at the last of them."""
    relative = variance / np.maximum(np.abs(measured) ** 2, 1e-300)
    thin = slice(None, None, 3)
    wide = fam.prior_sd.copy()
    wide[len(fam.names):len(fam.names) + fam.modes] = 0.01
    theta, x, _ = descend(fam, theta, s[thin], measured[thin], relative[thin] + 0.3 ** 2, 12, prior_sd=wide, extension=extension, x=x,
                          log=True, tol=0.3)
    cost = np.inf
    for tolerance in (0.1, 0.02):
        inflated = variance + (tolerance * np.abs(measured)) ** 2
        theta, x, cost = descend(fam, theta, s[thin], measured[thin], inflated[thin], 8, extension=extension, x=x, tol=0.3)
    return theta, x, cost


def strained(fam: Family, theta: Array, sd: Array) -> bool:
    """Whether physical parameters lie further from nominal than their tolerances let expect."""
    count = len(fam.names)
    return float(((theta[:count] / sd[:count]) ** 2).sum()) > 2 * count + 10


def _anneal(fam: Family, theta: Array, s: Complex, measured: Complex, variance: Array) -> tuple[Array, float]:
    """Coarse to fine, at last against noise."""
    theta, _, _ = coarse(fam, theta, s, measured, variance)
    theta, _, cost = descend(fam, theta, s, measured, variance, 25, tol=0.05)
    return theta, cost
