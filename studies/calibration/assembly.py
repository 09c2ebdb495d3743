"""Virtual tests of a structure with five joints, written without the force laws and integrators of the package.

Modes of a string, so to speak: unit modal masses, sensors at four places, a shaker at one, and five joints that see the modes by rows
of their own. In every mode

    a_k + 2 ζ_k ω_k v_k + ω_k² u_k + Σ_j b_jk g_j(q_j, q̇_j) = φ_k p(t) + w_k(t),    q_j = Σ_k b_jk u_k,

integrated by classical Runge–Kutta for many realisations at once. The laws are those of ``truth``, one for each joint.
"""

from __future__ import annotations

import numpy as np
from studies.calibration import truth

FS, SECONDS = 1024.0, 3.0
FINE = 8
BAND = (35.0, 260.0)                             # Hz
FREQUENCY = np.array([62.0, 141.0, 223.0, 371.0, 552.0])
ZETA = np.array([0.005, 0.005, 0.006, 0.006, 0.006])
KEPT = 3                                         # modes of the model; the others are there where a study hides them
JOINTS = np.array([0.13, 0.31, 0.46, 0.68, 0.87])
SENSORS = np.array([0.18, 0.37, 0.61, 0.83])
SHAKER = 0.27
LEVEL = 4.0                                      # N, rms of the force
Array = np.ndarray


def shapes(at: Array | float, modes: int) -> Array:
    """Rows (places, modes) of displacement."""
    return np.sqrt(2.0) * np.sin(np.pi * np.outer(np.atleast_1d(at), np.arange(1, modes + 1)))


def slips(modes: int) -> Array:
    """Rows (5, modes) of the relative motion of the joints: slopes, which grow with the number of the mode."""
    k = np.arange(1, modes + 1)
    return np.cos(np.pi * np.outer(JOINTS, k)) * np.sqrt(k)


def force(time: Array, seed: int = 0) -> Array:
    """Random phases on lines around the modes kept, faded in, shut off for the last third."""
    rng = np.random.default_rng([20, seed])
    out = np.zeros(len(time))
    for f0, share in zip(FREQUENCY[:KEPT], (1.0, 1.5, 2.0), strict=True):
        for f in np.linspace(0.95 * f0, 1.03 * f0, 24):
            out += share * np.cos(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi))
    end = SECONDS * 2 / 3
    fade = np.sin(0.5 * np.pi * np.clip(time / 0.1, 0, 1)) ** 2 * np.sin(0.5 * np.pi * np.clip((end - time) / 0.05, 0, 1)) ** 2
    return LEVEL * out / np.sqrt(0.5 * 24 * (1.0 + 1.5**2 + 2.0**2)) * fade


def integrate(frequency: Array, zeta: Array, laws: list[truth.Static] | list[truth.Sliders], seed: int = 0,
              disturbance: Array | None = None) -> Array:
    """Accelerations (R, n, 4) at the rate ``FS`` for frequencies and damping ratios (R, K) and one law for each joint.

    ``disturbance`` (R, n · FINE, K): modal forces that nobody measured, held over each fine step.
    """
    modes = frequency.shape[1]
    n, h = round(FS * SECONDS), 1 / (FS * FINE)
    p = force(h / 2 * np.arange(2 * n * FINE + 1), seed)
    drive, rows, out_rows = shapes(SHAKER, modes)[0], slips(modes), shapes(SENSORS, modes).T
    omega = 2 * np.pi * frequency
    c, k = 2 * zeta * omega, omega**2
    u, v = np.zeros(frequency.shape), np.zeros(frequency.shape)
    out = np.empty((len(frequency), n, len(SENSORS)))
    for i in range(n * FINE):
        w = np.zeros(modes) if disturbance is None else disturbance[:, i]

        def rate(x: Array, y: Array, push: float, w: Array = w) -> Array:
            q, s = x @ rows.T, y @ rows.T
            g = np.stack([law.force(q[:, j], s[:, j]) for j, law in enumerate(laws)], axis=1)
            return drive * push + w - c * y - k * x - g @ rows

        a1 = rate(u, v, p[2 * i])
        if i % FINE == 0:
            seen = a1 if disturbance is None else rate(u, v, p[2 * i], 0.5 * (disturbance[:, i] + disturbance[:, i - 1]))
            out[:, i // FINE] = seen @ out_rows
        u, v = truth.stepped(rate, u, v, a1, h, (p[2 * i + 1], p[2 * i + 2]))
        q = u @ rows.T
        for j, law in enumerate(laws):
            law.commit(q[:, j])
    return out
