"""The plant: free-free beam with five Iwan joints, integrated with numpy alone, from exported matrices.

Nothing of the package is used here: neither its force laws nor its integrators. The plant is richer than what is identified later:
besides its modes it has the static flexibility of everything above them, at the joints, at the sensors and between them, which
no modal filter with few modes can see.

    u̇̇ + 2 ζ ω u̇ + ω² u = φ_F F − Bᵀ g(q),      q = B u − G_jj g + G_jF F,      x = S u − G_sj g + G_sF F

g is the joints' force less that of the stuck spring, which the modes hold already. Modes are carried forward exactly over each step
under forces that follow the parabola through the step's ends and the point before; g at its end follows from five equations (Newton).
The free-free beam does not drift: as in the paper, rigid-body motion has been taken out (Eq. 15-18).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SLIDERS = 60


@dataclass(frozen=True)
class Plant:
    """Exported matrices: modes (m,), rows at joints (J, m), sensors (s, m) and force (m,), residual flexibilities, m/N."""

    omega: Array
    zeta: Array
    joints: Array
    sensors: Array
    shaker: Array
    G_jj: Array
    G_sj: Array
    G_jf: Array
    G_sf: Array

    def truncated(self, modes: int) -> Plant:
        """The lowest modes alone, without residual flexibility: what reduced models of the paper's kind hold."""
        k = slice(0, modes)
        return Plant(self.omega[k], self.zeta[k], self.joints[:, k], self.sensors[:, k], self.shaker[k], 0 * self.G_jj, 0 * self.G_sj,
                     0 * self.G_jf, 0 * self.G_sf)


@dataclass(frozen=True)
class Joint:
    """Parameters of one 4-parameter Iwan element, arrays (R, J) or numbers."""

    f_s: Array
    k_t: Array
    chi: Array
    beta: Array

    @classmethod
    def of(cls, values: Array) -> Joint:
        """From (..., J, 4): N, N/m, -, -."""
        v = np.asarray(values, dtype=float)
        return cls(v[..., 0], v[..., 1], v[..., 2], v[..., 3])

    @property
    def largest(self) -> Array:
        """Displacement at macroslip, m."""
        return self.f_s * (1 + self.beta) / (self.k_t * (self.beta + (self.chi + 1) / (self.chi + 2)))


class Static:
    """Single-valued force: the backbone of the Iwan element, without memory and without dissipation."""

    def __init__(self, joint: Joint, records: int) -> None:
        shape = (records, np.shape(joint.f_s)[-1])
        self.p_m, self.chi, self.f_s, self.k = (np.broadcast_to(x, shape) for x in (joint.largest, joint.chi, joint.f_s, joint.k_t))
        self.c = np.broadcast_to(joint.k_t / ((1 + joint.beta) * joint.largest ** (joint.chi + 1)), shape)
        self.root = bool(np.all(joint.chi == -0.5))

    def force(self, q: Array) -> tuple[Array, Array]:
        """g and dg/dq (R, J)."""
        a = np.abs(q)
        drop = self.c * (np.sqrt(a) if self.root else a ** (self.chi + 1))
        g, slope = -drop * a / (self.chi + 2), -drop
        slips = a >= self.p_m
        if slips.any():
            g, slope = np.where(slips, self.f_s - self.k * a, g), np.where(slips, -self.k, slope)
        return np.copysign(1.0, q) * g, slope

    def commit(self, q: Array) -> None:
        """No memory."""


class Memory:
    """The Iwan element proper: springs in series with sliders whose slip displacements have the density R φ^χ and a lump at the end."""

    def __init__(self, joint: Joint, records: int, sliders: int = SLIDERS) -> None:
        shape = (records, np.shape(joint.f_s)[-1])
        p_m, chi, k_t, beta = (np.broadcast_to(x, shape)[..., None] for x in (joint.largest, joint.chi, joint.k_t, joint.beta))
        steps = 1.1 ** np.arange(sliders)
        edges = p_m * np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
        density = k_t * (chi + 1) / ((1 + beta) * p_m ** (chi + 1))
        k = density * np.diff(edges ** (chi + 1), axis=-1) / (chi + 1)
        moment = density * np.diff(edges ** (chi + 2), axis=-1) / (chi + 2)
        self.k = np.concatenate([k, k_t * beta / (1 + beta)], axis=-1)
        self.phi = np.concatenate([moment / k, p_m], axis=-1)
        self.stuck = self.k.sum(axis=-1)
        self.at = np.zeros_like(self.k)      # where each slider rests

    def force(self, q: Array) -> tuple[Array, Array]:
        """g and dg/dq (R, J) from the committed positions."""
        stretch = q[..., None] - self.at
        pull = np.clip(stretch, -self.phi, self.phi)
        sticks = np.abs(stretch) <= self.phi
        return (self.k * pull).sum(axis=-1) - self.stuck * q, (self.k * sticks).sum(axis=-1) - self.stuck

    def commit(self, q: Array) -> None:
        """The step has ended here."""
        stretch = q[..., None] - self.at
        self.at = q[..., None] - np.clip(stretch, -self.phi, self.phi)


@dataclass(frozen=True)
class Motion:
    """What happened: time (n,); displacement and acceleration of sensors (n, R, s); motion and excess force of joints (n, R, J); modal
    displacement, velocity, acceleration (n, R, m)."""

    time: Array
    x: Array
    a: Array
    q: Array
    g: Array
    u: Array
    v: Array
    inertia: Array
    worst: float        # largest part of a joint's displacement that Newton left


def integrate(plant: Plant, law: Static | Memory, force: Array, h: float, *, u0: Array | None = None, keep: int = 1,
              progress: Callable[[str], None] | None = None) -> Motion:
    """Response of R records side by side.

    Parameters
    ----------
    plant : Plant
    law : Static or Memory
    force : ndarray (n, R)
        N, at steps of ``h`` (s).
    u0 : ndarray (R, m), optional
        Modal displacement at the start, at rest; its residual part follows from the joints' force.
    keep : int
        Every so many steps are kept.
    """
    n, R = force.shape
    B, m = plant.joints, len(plant.omega)
    e = _exact(plant.omega, plant.zeta, h)
    H = (B * e.u1) @ B.T + plant.G_jj
    forward, back = _maps(plant, e)
    eye, J = np.eye(len(B)), len(B)
    now = slice(2 * m, 2 * m + J)
    state = np.zeros((R, 2 * m + 2 * J + 3))         # u, v, g now, g before, F before, now, next
    state[:, :m] = 0.0 if u0 is None else u0
    q = _solve(law, state[:, :m] @ B.T, plant.G_jj, eye, state[:, :m] @ B.T)[0]
    state[:, now] = state[:, 2 * m + J:-3] = law.force(q)[0]
    law.commit(q)
    kept = -(-n // keep)
    states, qs = np.empty((kept, R, 2 * m + J)), np.empty((kept, R, J))
    states[0], qs[0] = state[:, :now.stop], q
    first, second, worst = q, q, 0.0
    for i in range(1, n):
        state[:, -3], state[:, -2], state[:, -1] = force[max(i - 2, 0)], force[i - 1], force[i]
        ahead = state @ forward
        guess = 3 * (q - first) + second
        first, second = q, first
        q, left = _solve(law, ahead[:, 2 * m:], H, eye, guess)
        worst = max(worst, left)
        g = law.force(q)[0]
        law.commit(q)
        state[:, :2 * m] = ahead[:, :2 * m] - g @ back
        state[:, now.stop:-3], state[:, now] = state[:, now], g
        if i % keep == 0:
            states[i // keep], qs[i // keep] = state[:, :now.stop], q
        if progress is not None and i % 65536 == 0:
            progress(f"plant: {i / n:.0%}")
    u, v, g, F = states[..., :m], states[..., m:2 * m], states[..., 2 * m:], force[::keep][..., None]
    inertia = F * plant.shaker - g @ B - 2 * plant.zeta * plant.omega * v - plant.omega**2 * u
    static = F * plant.G_sf - g @ plant.G_sj.T
    S = plant.sensors
    return Motion(h * keep * np.arange(kept), u @ S.T + static, inertia @ S.T + _second(static, h * keep), qs, g, u, v, inertia, worst)


def _maps(plant: Plant, e: _Step) -> tuple[Array, Array]:
    """(2m + 2J + 3, 2m + J): what the present state and the forces give without the joints' next force; (J, 2m): what that force takes."""
    B, m, J = plant.joints, len(plant.omega), len(plant.joints)
    forward = np.zeros((2 * m + 2 * J + 3, 2 * m + J))
    forward[:m, :m], forward[m:2 * m, :m] = np.diag(e.uu), np.diag(e.uv)
    forward[:m, m:2 * m], forward[m:2 * m, m:2 * m] = np.diag(e.vu), np.diag(e.vv)
    for k, rows in enumerate((slice(2 * m, 2 * m + J), slice(2 * m + J, -3))):
        forward[rows, :m], forward[rows, m:2 * m] = -B * (e.u0, e.ub)[k], -B * (e.v0, e.vb)[k]
    for k, row in enumerate((-3, -2, -1)):
        forward[row, :m], forward[row, m:2 * m] = plant.shaker * (e.ub, e.u0, e.u1)[k], plant.shaker * (e.vb, e.v0, e.v1)[k]
    forward[:, 2 * m:] = forward[:, :m] @ B.T
    forward[-1, 2 * m:] += plant.G_jf
    return forward, np.hstack([B * e.u1, B * e.v1])


TOLERANCE = 1e-15
"""m; a ten-billionth of the joints' largest motion here."""


def _solve(law: Static | Memory, aim: Array, H: Array, eye: Array, guess: Array) -> tuple[Array, float]:
    """q with q + H g(q) = aim."""
    q = guess
    for _ in range(40):
        g, slope = law.force(q)
        miss = q + g @ H.T - aim
        left = float(np.abs(miss).max())
        if left < TOLERANCE:
            break
        q = q - np.linalg.solve(eye + H * slope[:, None, :], miss[..., None])[..., 0]
    return q, left


@dataclass(frozen=True)
class _Step:
    """One exact step of damped oscillators under a force on the parabola through its values before (b), now (0) and next (1)."""

    uu: Array
    uv: Array
    vu: Array
    vv: Array
    ub: Array
    u0: Array
    u1: Array
    vb: Array
    v0: Array
    v1: Array


def _exact(omega: Array, zeta: Array, h: float) -> _Step:
    from scipy.linalg import expm

    out = np.empty((10, len(omega)))
    for k, (w, z) in enumerate(zip(omega, zeta, strict=True)):
        # states: wu, v, force/w and its first and second change per step, so that the exponential is well conditioned
        A = np.zeros((5, 5))
        A[0, 1], A[1, 0], A[1, 1] = w * h, -w * h, -2 * z * w * h
        A[1, 2], A[2, 3], A[3, 4] = w * h, 1.0, 1.0
        E = expm(A)
        before, now, after = -E[:2, 3] / 2 + E[:2, 4], E[:2, 2] - 2 * E[:2, 4], E[:2, 3] / 2 + E[:2, 4]
        out[:, k] = (E[0, 0], E[0, 1] / w, E[1, 0] * w, E[1, 1], *(x[0] / w**2 for x in (before, now, after)),
                     *(x[1] / w for x in (before, now, after)))
    return _Step(*out)


def _second(x: Array, h: float) -> Array:
    """Second difference along the first axis; the ends repeat their neighbours."""
    out = np.empty_like(x)
    out[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) / h**2
    out[0], out[-1] = out[1], out[-2]
    return out


def sweep(start: float, stop: float, seconds: float, total: float, amplitude: float, fs: float, edge: float = 0.05) -> Array:
    """Linear sine sweep (n,) with cosine edges, then silence, N."""
    t = np.arange(round(total * fs)) / fs
    phase = 2 * np.pi * (start * t + 0.5 * (stop - start) / seconds * t**2)
    window = np.sin(0.5 * np.pi * np.clip(np.minimum(t, seconds - t) / edge, 0, 1)) ** 2
    return amplitude * window * np.sin(phase)


def decimated(x: Array, factor: int) -> Array:
    """Every ``factor``-th sample behind a linear-phase low-pass filter."""
    if factor == 1:
        return x
    from scipy.signal import decimate

    return np.ascontiguousarray(decimate(x, factor, ftype="fir", axis=0, zero_phase=True))
