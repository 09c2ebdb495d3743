"""Whether steady motions are stable: Floquet multipliers of small disturbances, in all modes.

A disturbance y of a steady motion of period T obeys ü_y + 2ζω u̇_y + ω² u_y + Σ b (k(t) b·u_y + c(t) b·u̇_y) = 0, with k and c the slopes of
the forces along the motion. Its growth over a period is the largest eigenvalue of the monodromy matrix (Nayfeh and Balachandran 1995,
chapter 3). That matrix is the product of exact steps of the linear modes and, between them, of kicks by the slopes (Strang splitting), so
that modes far above the forcing cost no accuracy and its determinant is exact where the slopes are springs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.model import Model
from bayes_nlsid.prediction.harmonics import Basis, SteadyForces
from bayes_nlsid.prediction.response_curve import Curve

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
LEAST, MOST = 128, 2048
FAR = 20.0
"""Modes so many times faster than the force follow a disturbance at once, as springs in series with the joints."""
POINTS = 512  # worked on at once


def has_multipliers(model: Model) -> bool:
    """Whether multipliers exist for this model: with memory a disturbance has more unknowns than the modes."""
    return all(element.term.memory == "none" for element in model.elements)


def multipliers(model: Model, theta: Array, curves: Sequence[Curve]) -> list[Complex]:
    """The largest Floquet multiplier at every point of every curve.

    Parameters
    ----------
    model : Model
        Without memory.
    theta : ndarray (N, P)
        One row for each curve.
    curves : sequence (N) of Curve

    Returns
    -------
    list (N) of ndarray (n,) of complex
        NaN where a motion or its slopes are not finite.
    """
    counts = [len(curve.frequency) for curve in curves]
    which = np.repeat(np.arange(len(curves)), counts)
    if not which.size:
        return [np.zeros(0, dtype=complex) for _ in curves]
    x = np.concatenate([curve.coefficients for curve in curves])
    w = 2 * np.pi * np.concatenate([curve.frequency for curve in curves])
    orders = curves[0].basis.orders
    found = np.concatenate([_largest(model, theta, orders, x[i:i + POINTS], w[i:i + POINTS], which[i:i + POINTS])
                            for i in range(0, len(which), POINTS)])
    return np.split(found, np.cumsum(counts)[:-1])


def _largest(model: Model, theta: Array, orders: tuple[int, ...], x: Array, w: Array, which: NDArray[np.intp]) -> Complex:
    """The same for a block of points (B)."""
    omega, zeta = (values[which] for values in model.linear_values(theta))
    slow = np.asarray((omega < FAR * w[:, None]).any(axis=0))
    slow[omega.min(axis=0).argmin()] = True
    samples = LEAST
    while True:
        forces = SteadyForces(model, theta, Basis(orders, max(samples, 4 * orders[-1])))
        rows = model.linear.rows(forces.locations)
        stiffness, damping = forces.slopes(x[:, :len(rows)], w, which)
        h = 2 * np.pi / (w * forces.basis.samples)
        stiff = np.nan_to_num(np.abs(stiffness).max(axis=2, initial=0.0)) @ (rows[:, slow] ** 2).sum(axis=1)
        # a step resolves the modes and what a contact makes of them
        fast = h**2 * np.maximum(stiff, (omega[:, slow] ** 2).max(axis=1) / 4)
        if samples >= MOST or not (fast > 1.0).any():
            break
        samples *= 2
    series = np.einsum("rm,qm,bm->brq", rows[:, ~slow], rows[:, ~slow], 1 / omega[:, ~slow] ** 2)
    whole = _monodromy(omega[:, slow], zeta[:, slow], rows[:, slow], stiffness, damping, series, h)
    out = np.full(len(w), np.nan + 0j)
    good = np.isfinite(whole).all(axis=(1, 2))
    if good.any():
        values = np.linalg.eigvals(whole[good])
        out[good] = np.take_along_axis(values, np.abs(values).argmax(axis=1)[:, None], axis=1)[:, 0]
    return out


def _monodromy(omega: Array, zeta: Array, rows: Array, stiffness: Array, damping: Array, series: Array, h: Array) -> Array:
    """(B, 2m, 2m) of modes (B, m) with slopes (B, R, N) at rows (R, m) in series with flexibilities (B, R, R), N steps of h (B,)."""
    batch, m = omega.shape
    a, e = zeta * omega, np.exp(-zeta * omega * h[:, None])
    s = np.sqrt((a**2 - omega**2).astype(complex))
    flat = np.abs(s) * h[:, None] < 1e-9
    sine = np.where(flat, h[:, None], (np.sinh(s * h[:, None]) / np.where(flat, 1.0, s)).real)
    cosine = np.cosh(s * h[:, None]).real
    uu, uv, vu, vv = ((e * part)[..., None] for part in (cosine + a * sine, sine, -omega**2 * sine, cosine - a * sine))
    u, v = np.zeros((batch, m, 2 * m)), np.zeros((batch, m, 2 * m))
    u[:, np.arange(m), np.arange(m)] = v[:, np.arange(m), m + np.arange(m)] = 1.0
    damped, yielding, between, across = bool(damping.any()), bool(series.any()), rows @ rows.T, rows.T
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(stiffness.shape[2]):
            if len(rows):
                spring = stiffness[:, :, k, None]
                pull = h[:, None, None] * spring * (rows @ u)
                if damped or yielding:  # the trapezoidal rule, so that steep friction cannot overshoot
                    c = (h[:, None] * damping[:, :, k])[..., None]
                    matrix = np.eye(len(rows)) + 0.5 * c * between + spring * series
                    pull = np.asarray(np.linalg.solve(matrix, pull + c * (rows @ v)), dtype=float)
                v = v - across @ pull
            u, v = uu * u + uv * v, vu * u + vv * v
    return np.concatenate([u, v], axis=1)
