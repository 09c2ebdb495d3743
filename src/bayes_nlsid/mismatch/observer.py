"""A steady observer of the linear model: innovations, smoothed modal motion, and what any force or channel error does to them.

The linear model is driven by the measured forces and by white modal forces that stand for whatever it lacks; sensors add white noise.
The steady Kalman filter (Anderson and Moore, Optimal Filtering, 1979, chapters 4 and 7) turns recordings into innovations. The filter
is linear and forgets its start, so free decays, closed loops, rigid bodies and records of any length are all treated alike, and what a
candidate force would add to the innovations is a convolution. Measured and candidate forces are taken as band-limited between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.simulation.schemes import steps

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
ORDER = {"displacement": 0, "velocity": 1, "acceleration": 2}


@final
@dataclass(frozen=True, eq=False)
class Modal:
    """Modal equations v̇ + c v + k u = f as a set of numbers that calibration may move.

    ``stiffness`` k (m,) rad²/s² (0 for rigid bodies), ``damping`` c (m,) rad/s.
    """

    stiffness: Array
    damping: Array

    def __post_init__(self) -> None:
        if self.stiffness.shape != self.damping.shape or (self.stiffness < 0).any():
            raise ValueError(f"modal: stiffness {self.stiffness.shape} and damping {self.damping.shape} must agree, stiffness not negative")

    @property
    def omega(self) -> Array:
        """rad/s; a rigid body gets a frequency too low to matter."""
        return np.sqrt(np.maximum(self.stiffness, 1e-8))

    @property
    def zeta(self) -> Array:
        """Damping ratios, whatever their size."""
        return self.damping / (2 * self.omega)


@final
@dataclass(frozen=True, eq=False)
class Observer:
    """Steady Kalman filter for one clock and one set of channels.

    Parameters
    ----------
    modal : Modal
    dt : float
        s.
    rows : ndarray (s, m)
        Mode shapes at the channels, kg^-1/2.
    order : tuple of int (s,)
        0, 1, 2: displacement, velocity, acceleration.
    noise : ndarray (s,)
        Variance of the sensor noise.
    drive : ndarray (m,)
        Variance of the white modal force (m/s² kg^1/2)², constant over a step.
    """

    modal: Modal
    dt: float
    rows: Array
    order: tuple[int, ...]
    noise: Array
    drive: Array

    @property
    def size(self) -> int:
        """Number of modes m."""
        return len(self.drive)

    @cached_property
    def _matrices(self) -> tuple[Array, Array, Array, Array, Array]:
        """A (2m, 2m), old and new weights (2m, m) of a force that is linear over a step, C (s, 2m), D (s, m)."""
        step = steps(self.modal.omega, self.modal.zeta, self.dt, "exponential")
        m = self.size
        A, old, new = np.zeros((2 * m, 2 * m)), np.zeros((2 * m, m)), np.zeros((2 * m, m))
        for i in range(2):
            for j in range(2):
                A[i * m + np.arange(m), j * m + np.arange(m)] = step.amplification[:, i, j]
            old[i * m + np.arange(m), np.arange(m)], new[i * m + np.arange(m), np.arange(m)] = step.old[:, i], step.new[:, i]
        C, D = np.zeros((len(self.order), 2 * m)), np.zeros((len(self.order), m))
        for s, order in enumerate(self.order):
            if order == 2:
                C[s], D[s] = np.concatenate([-self.rows[s] * self.modal.stiffness, -self.rows[s] * self.modal.damping]), self.rows[s]
            else:
                C[s, order * m:(order + 1) * m] = self.rows[s]
        return A, old, new, C, D

    @cached_property
    def gain(self) -> tuple[Array, Array, Array]:
        """K (2m, s), innovation covariance (s, s) and state covariance P (2m, 2m)."""
        from scipy.linalg import solve_discrete_are

        A, old, new, C, D = self._matrices
        G = old + new
        # coordinates in which state and outputs are of order one
        w = float(np.median(self.modal.omega[self.modal.omega > 1e-3])) if (self.modal.omega > 1e-3).any() else 1.0
        y = np.sqrt(self.noise + np.einsum("sm,m,sm->s", D, self.drive, D) + 1e-300)
        x = np.repeat([1 / w, 1.0], self.size) * float(np.sqrt(self.drive.max())) * np.sqrt(self.dt / w)
        As, Cs = A * x / x[:, None], C * x / y[:, None]
        Gs, Ds = G / x[:, None], D / y[:, None]
        Q, R = (Gs * self.drive) @ Gs.T, np.diag(self.noise / y ** 2) + (Ds * self.drive) @ Ds.T
        S = (Gs * self.drive) @ Ds.T
        P = solve_discrete_are(As.T, Cs.T, Q + 1e-12 * np.trace(Q) / len(Q) * np.eye(len(Q)), R, s=S)
        Se = Cs @ P @ Cs.T + R
        K = np.linalg.solve(Se.T, (As @ P @ Cs.T + S).T).T
        return K * x[:, None] / y, Se * np.outer(y, y), P * np.outer(x, x)

    @cached_property
    def closed(self) -> tuple[Array, Array, Array, Array, Array]:
        """Closed-loop A − K C, force weights (2m, m) and feed-through (s, m) of the state that is free of the newest force, C and D.

        Weights and feed-through belong to the force as interpolated between samples; D (s, m) to the force at the sample.
        """
        A, old, new, C, D = self._matrices
        K = self.gain[0]
        return A - K @ C, A @ new + old - K @ C @ new, C @ new, C, D

    @cached_property
    def _eigen(self) -> tuple[Complex, Complex, Complex]:
        values, vectors = np.linalg.eig(self.closed[0])
        return values.astype(complex), vectors.astype(complex), np.linalg.inv(vectors).astype(complex)

    @cached_property
    def memory(self) -> int:
        """Samples after which the filter has forgotten all but a thousandth."""
        slowest = float(np.abs(self._eigen[0]).max())
        return int(min(100_000, np.ceil(np.log(1e-3) / np.log(min(slowest, 1 - 1e-9)))))

    def length(self, n: int) -> int:
        """Length of the padded transform for records of n samples."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(n + min(n, 2 * self.memory), real=True))

    def resolvent(self, N: int) -> Complex:
        """1 / (z − λ), (L, 2m), at the lines of a transform of length N."""
        z = np.exp(2j * np.pi * np.arange(N // 2 + 1) / N)
        return np.asarray(1 / (z[:, None] - self._eigen[0]))

    def from_force(self, N: int, resolvent: Complex) -> Complex:
        """Innovations (L, s, m) per unit modal force that acts and is not known to the filter, band-limited between samples."""
        _, B, direct, C, D = self.closed
        _, V, inverse = self._eigen
        held = np.sinc(np.arange(N // 2 + 1) / N)[:, None, None] ** 2   # what straight lines between samples do to a band-limited force
        inner = np.einsum("sp,lp,pm->lsm", C @ V, resolvent, inverse @ B, optimize=True)
        if not D.any():
            return np.asarray((direct + inner) / held)
        at_sample = np.einsum("sp,lp,pm->lsm", C @ V, resolvent, inverse @ self.gain[0] @ D, optimize=True)
        return np.asarray((direct + inner) / held + D - at_sample)

    def from_channel(self, resolvent: Complex) -> Complex:
        """Innovations (L, s, s) per unit signal in each channel."""
        _, V, inverse = self._eigen
        K, C = self.gain[0], self.closed[3]
        return np.asarray(np.eye(len(self.order)) - np.einsum("sp,lp,pr->lsr", C @ V, resolvent, inverse @ K, optimize=True))


@final
@dataclass(frozen=True, eq=False)
class Smoothed:
    """What the filter and its smoother make of one recording.

    Parameters
    ----------
    innovations : ndarray (n, s)
    u, v, a : ndarray (n, m)
        Modal displacement, velocity, acceleration.
    latent : ndarray (n, m)
        White modal force that the smoother needs to follow the recording: what the model lacks.
    likelihood : float
        Gaussian log-likelihood of the innovations.
    """

    innovations: Array
    u: Array
    v: Array
    a: Array
    latent: Array
    likelihood: float


def observe(observer: Observer, response: Array, force: Array) -> Smoothed:
    """Filter and smooth.

    Parameters
    ----------
    observer : Observer
    response : ndarray (n, s)
    force : ndarray (n, m)
        Modal force, known.
    """
    n, m = len(response), observer.size
    N = observer.length(n)
    R = observer.resolvent(N)
    _, V, inverse = observer._eigen
    K, Se, P = observer.gain
    A, B, direct, C, D = observer.closed
    held = np.sinc(np.arange(N // 2 + 1) / N) ** 2
    F = np.fft.rfft(force, n=N, axis=0) / held[:, None]
    Y = np.fft.rfft(response - force @ D.T, n=N, axis=0)
    state = np.fft.irfft(((R * (F @ (inverse @ B).T + Y @ (inverse @ K).T)) @ V.T), n=N, axis=0)[:n]
    shaped = np.fft.irfft(F, n=N, axis=0)[:n]
    e = response - state @ C.T - shaped @ direct.T - force @ D.T
    # the filter began at zero: its true start is estimated from the samples it takes to forget
    e, state = _started(e, state, A, C, Se, min(n, observer.memory + 1, 3000))
    weighted = np.linalg.solve(Se, e.T).T
    Z = np.exp(2j * np.pi * np.arange(N // 2 + 1) / N)
    back = 1 / (1 - Z[:, None] * observer._eigen[0])
    costate = np.fft.irfft((back * (np.fft.rfft(weighted @ C, n=N, axis=0) @ V)) @ inverse, n=N, axis=0)[:n]
    later = np.concatenate([costate[1:], np.zeros((1, 2 * m))])
    _, old, new, _, _ = observer._matrices
    smooth = state + costate @ P.T + shaped @ new.T
    latent = observer.drive * (weighted @ D + later @ (old + new - K @ D))
    u, v = smooth[:, :m], smooth[:, m:]
    a = force + latent - observer.modal.damping * v - observer.modal.stiffness * u
    sign, logdet = np.linalg.slogdet(Se)
    likelihood = float(-0.5 * np.sum(weighted * e) - 0.5 * n * logdet) if sign > 0 else -np.inf
    return Smoothed(e, u, v, a, latent, likelihood)


def _started(e: Array, state: Array, A: Array, C: Array, Se: Array, count: int) -> tuple[Array, Array]:
    """Innovations and states with the start estimated by least squares from the first ``count`` samples."""
    powers = np.empty((count, *A.shape))
    powers[0] = np.eye(len(A))
    for i in range(1, count):
        powers[i] = A @ powers[i - 1]
    seen = np.einsum("sk,nkj->nsj", C, powers)
    root = np.linalg.cholesky(np.linalg.inv(Se)).T
    design, target = np.einsum("rs,nsj->nrj", root, seen).reshape(-1, len(A)), (e[:count] @ root.T).ravel()
    norm = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    start = np.linalg.lstsq(design / norm, target, rcond=1e-9)[0] / norm
    e, state = e.copy(), state.copy()
    e[:count] -= seen @ start
    state[:count] += powers @ start
    return e, state
