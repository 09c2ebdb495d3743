"""Chains of one to three masses with one hidden effect or none, integrated by an adaptive Runge–Kutta method of eighth order.

Nothing here imports the package: formulas, integrator, excitation and noise are its own. Kilogram, metre, second, newton.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh
from scipy.signal import lfilter

Array = NDArray[np.float64]
Rate = Callable[[float, float, Array], tuple[float, Array]]
"""``(q, v, z) -> (force, dz/dt)`` with the internal states z of a law."""


@dataclass(frozen=True)
class Chain:
    """Masses in a row, the first held to the ground: M, C, K (n, n) and the vectors of relative motion at the springs (n, n)."""

    M: Array
    C: Array
    K: Array
    springs: Array

    @property
    def frequencies(self) -> Array:
        """Hz, of the undamped chain."""
        return np.sqrt(np.maximum(eigh(self.K, self.M, eigvals_only=True), 0)) / (2 * np.pi)


def draw_chain(rng: np.random.Generator, n: int) -> Chain:
    """Random masses and springs, damped mode by mode."""
    springs = np.eye(n) - np.eye(n, k=-1)
    m = rng.uniform(0.6, 2.5, n)
    k = m.mean() * (2 * np.pi * rng.uniform(6.0, 30.0)) ** 2 * rng.uniform(0.7, 1.6, n) * (1.0 if n == 1 else 1.8)
    M, K = np.diag(m), springs.T @ np.diag(k) @ springs
    w2, shapes = eigh(K, M)
    zeta = np.exp(rng.uniform(np.log(0.004), np.log(0.04), n))
    back = M @ shapes
    return Chain(M, back @ np.diag(2 * zeta * np.sqrt(w2)) @ back.T, K, springs)


@dataclass(frozen=True)
class Law:
    """A hidden force at one spring: strength times a unit formula whose scales are those of the motion there."""

    cls: str
    formula: str
    states: int
    rate: Rate


def _loop(width: Array, power: float, stiff: float) -> Rate:
    """Parallel elements that yield at ``width``; their spring at rest is taken off, because a linear model has it."""
    def rate(q: float, v: float, z: Array) -> tuple[float, Array]:
        dz = v - np.abs(v) * np.sign(z) * np.abs(z / width) ** power if power == 1.0 else v - np.abs(v) * z * np.abs(z) / width ** 2
        return stiff * float(z.mean() - q), dz
    return rate


def laws(rng: np.random.Generator, cls: str, q: float, v: float, peak: float, k: float) -> Law:
    """A law of the class with unit strength about equal to the spring k (N/m) at motion q (m), v (m/s); ``peak`` (m)."""
    none = np.zeros(0)
    w = v * rng.uniform(0.01, 0.1)
    gap = peak * rng.uniform(0.45, 0.75)
    s = q * rng.uniform(0.6, 1.5)
    sign = float(rng.choice([-1.0, 1.0]))
    table: dict[str, list[tuple[str, Callable[[float, float], float]]]] = {
        "hardening": [("cubic", lambda x, y: k * x ** 3 / q ** 2), ("|q|^1.7", lambda x, y: k * x * (abs(x) / q) ** 1.7),
                      ("sinh", lambda x, y: k * (s * np.sinh(min(max(x / s, -8.0), 8.0)) - x))],
        "softening": [("tanh", lambda x, y: k * (s * np.tanh(x / s) - x)),
                      ("rational", lambda x, y: -k * x ** 3 / (s * s + x * x))],
        "clearance": [("gap", lambda x, y: 4 * k * np.sign(x) * max(abs(x) - gap, 0.0)),
                      ("one stop", lambda x, y: 4 * k * sign * max(sign * x - gap, 0.0)),
                      ("round stop", lambda x, y: 6 * k * sign * max(sign * x - gap, 0.0) ** 1.5 / np.sqrt(q))],
        "asymmetric": [("square", lambda x, y: sign * k * x * x / q), ("two stiffnesses", lambda x, y: k * max(sign * x, 0.0) * sign)],
        "coulomb": [("arctan", lambda x, y: k * q * 2 / np.pi * np.arctan(y / w)),
                    ("Stribeck", lambda x, y: k * q * np.tanh(y / w) * (0.75 + 0.25 * np.exp(-(y / (0.3 * v)) ** 2)))],
        "quad_damping": [("square", lambda x, y: k * q * y * abs(y) / v ** 2), ("power", lambda x, y: k * q * y / v * (abs(y) / v) ** 1.4)],
    }
    if cls == "hysteresis":
        kind = str(rng.choice(["Bouc-Wen 1", "Bouc-Wen 2", "spread"]))
        width = q * (np.geomspace(0.2, 4.0, 6) if kind == "spread" else np.array([rng.uniform(0.4, 1.6)]))
        return Law(cls, kind, len(width), _loop(width, 2.0 if kind == "Bouc-Wen 2" else 1.0, k))
    name, f = table[cls][int(rng.integers(len(table[cls])))]
    return Law(cls, name, 0, lambda x, y, z: (float(f(x, y)), none))


def march(chain: Chain, law: Law | None, strength: float, place: int, force: CubicSpline | None, drive: Array, start: Array, times: Array,
          scale: float, softer: Callable[[float], float] | None = None) -> tuple[Array, Array, Array]:
    """Displacement, velocity, acceleration (len(times), n); ``start`` (2n,), ``scale`` (m) for the absolute tolerance.

    ``softer(t)``: factor on the stiffness of the spring at ``place`` less one, for a drift.
    """
    n = len(chain.M)
    inverse, b = np.linalg.inv(chain.M), chain.springs[place]
    A, B, push = -inverse @ chain.K, -inverse @ chain.C, inverse @ drive
    own = float(1 / (b @ np.linalg.solve(chain.K, b)))
    back = inverse @ b
    states = 0 if law is None else law.states

    def rate(t: float, x: Array) -> Array:
        u, v = x[:n], x[n:2 * n]
        a = A @ u + B @ v
        if force is not None:
            a = a + push * float(force(t))
        out = np.empty_like(x)
        if law is not None:
            g, dz = law.rate(float(b @ u), float(b @ v), x[2 * n:])
            a = a - strength * g * back
            out[2 * n:] = dz
        if softer is not None:
            a = a - own * softer(t) * float(b @ u) * back
        out[:n], out[n:2 * n] = v, a
        return out

    w = 2 * np.pi * float(chain.frequencies[0])
    small = 1e-7 * scale * np.concatenate([np.ones(n), np.full(n, w), np.ones(states)])
    found = solve_ivp(rate, (times[0], times[-1]), np.concatenate([start, np.zeros(states)]), method="DOP853", t_eval=times, rtol=1e-7,
                      atol=small, max_step=0.1 / float(chain.frequencies[-1]))
    if not found.success or found.y.shape[1] != len(times) or not np.isfinite(found.y).all():
        raise ArithmeticError(found.message)
    a = np.array([rate(t, x)[n:2 * n] for t, x in zip(times, found.y.T, strict=True)])
    return found.y[:n].T, found.y[n:2 * n].T, a


def excitation(rng: np.random.Generator, kind: str, seconds: float, low: float, high: float) -> CubicSpline:
    """A force of rms about one on a fine grid, as a spline: ``sweep``, ``noise`` or ``burst``."""
    dt = 1 / (24 * high)
    t = np.arange(int(seconds / dt) + 8) * dt
    if kind == "sweep":
        rise = np.minimum(1.0, t / (0.03 * seconds))
        down = bool(rng.random() < 0.3)
        f0, f1 = (high, low) if down else (low, high)
        x = np.sqrt(2) * rise * np.sin(2 * np.pi * (f0 * t + 0.5 * (f1 - f0) * t * t / seconds))
        return CubicSpline(t, x)
    f = np.fft.rfftfreq(2 * len(t), dt)
    lines = np.where((f > low) & (f < high), np.exp(2j * np.pi * rng.random(len(f))), 0)
    x = np.fft.irfft(lines, 2 * len(t))[:len(t)]
    x /= x.std()
    if kind == "burst":
        x = x * np.clip(6 * (0.55 - t / seconds), 0, 1) * np.minimum(1.0, t / (0.02 * seconds))
    return CubicSpline(t, x)


def sensor_noise(rng: np.random.Generator, n: int, colour: str) -> Array:
    """Unit variance: ``white``, ``slow`` (first-order) or ``pink``."""
    x = rng.standard_normal(n + 400)
    if colour == "slow":
        x = lfilter([1.0], [1.0, -0.92], x)
    if colour == "pink":
        x = lfilter([0.049922035, -0.095993537, 0.050612699, -0.004408786], [1.0, -2.494956002, 2.017265875, -0.522189400], x)
    x = x[400:] - x[400:].mean()
    return np.asarray(x / x.std())
