"""Responses of a truth plant: the linear part exactly in frequency, the local laws marched at a high rate.

The motion is split into the response to the shaker alone (exact Laplace line, exponential window) and the response to the local
forces.  Only the latter depends on the step, so even at 16 kHz the hold error acts on the small part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .kernels import march
from .modes import Plant

SHIFT = 0.5  # 1/s, Laplace line to the right of the imaginary axis: wrap-around falls by exp(-SHIFT * padded length)


@dataclass(frozen=True)
class Law:
    """One local force: ``kind`` and ``params`` (8,) of kernels.law at place ``name``."""

    name: str
    kind: int
    params: tuple[float, ...]


def drive(plant: Plant, force: np.ndarray, fs: float, outs: list[str], ins: list[str], out_fs: float, order: int) -> np.ndarray:
    """Time derivative ``order`` of motion at ``outs`` under ``force`` (n, len(ins)) from rest.

    Returns (n * out_fs / fs, len(outs)), band-limited to the lower of the two rates, with a smooth roll-off above 0.47 ``out_fs``
    when rate is reduced.
    """
    n = force.shape[0]
    # Padded to a length both rates divide and the FFT likes.
    blocks = int(np.ceil(n / fs * 1.15 + 5.0))
    padded, padded_out = int(blocks * fs), int(blocks * out_fs)
    time = np.arange(n) / fs
    spectrum = np.fft.rfft(force * np.exp(-SHIFT * time)[:, None], padded, axis=0)
    keep = min(padded, padded_out) // 2 + 1
    frequency = np.arange(keep) / blocks
    s = SHIFT + 2j * np.pi * frequency
    H = plant.receptance(outs, ins, s) * (s**order)[:, None, None]
    reply = np.einsum("foi,fi->fo", H, spectrum[:keep])
    if out_fs < fs:
        reply *= np.clip((0.5 * out_fs - frequency) / (0.03 * out_fs), 0.0, 1.0)[:, None]
    out = np.fft.irfft(np.vstack([reply, np.zeros((padded_out // 2 + 1 - keep, len(outs)))]), padded_out, axis=0) * (padded_out / padded)
    count = int(round(n * out_fs / fs))
    return out[:count] * np.exp(SHIFT * np.arange(count) / out_fs)[:, None]


def steady(plant: Plant, period: np.ndarray, fs: float, outs: list[str], source: str, out_fs: float, order: int) -> np.ndarray:
    """One period of the exact steady response (m, len(outs)) at ``out_fs`` to one period (n,) of force at place ``source``."""
    n = period.size
    m = int(round(n * out_fs / fs))
    spectrum = np.fft.rfft(period)
    s = 2j * np.pi * np.arange(spectrum.size) * fs / n
    s[0] = 1j
    H = plant.receptance(outs, [source], s)[:, :, 0] * (s**order)[:, None]
    H[0] = 0.0
    reply = H * spectrum[:, None]
    full = np.zeros((m // 2 + 1, len(outs)), complex)
    full[: min(reply.shape[0], full.shape[0])] = reply[: full.shape[0]]
    return np.fft.irfft(full, m, axis=0) * (m / n)


def local_forces(
    plant: Plant, laws: tuple[Law, ...], d_lin: np.ndarray, v_lin: np.ndarray, rate: float, modulation: np.ndarray | None = None
) -> np.ndarray:
    """Forces (steps, m) N of the laws under the linear local motion ``d_lin``, ``v_lin`` (steps, m) sampled at ``rate`` Hz.

    Raises ``FloatingPointError`` when the local equations stop converging.
    """
    h = 1.0 / rate
    x = plant.poles * h
    L = np.array([plant.into[law.name] for law in laws]).T
    read = np.array([plant.out[law.name] for law in laws])
    phi1 = (np.exp(x) - 1) / x
    phi2 = (np.exp(x) - 1 - x) / x**2
    first, second = h * (phi1 - phi2)[:, None] * L, h * phi2[:, None] * L
    read_v = read * plant.poles
    cross_d, cross_v = 2 * (read @ second).real, 2 * (read_v @ second).real
    params = np.array([law.params for law in laws], float)
    kinds = np.array([law.kind for law in laws], np.int64)
    if modulation is None:
        modulation = np.zeros(d_lin.shape)
    typical = 1e-9 * max(1e-6, float(np.max(np.abs(params[:, 0]) * np.std(d_lin, axis=0))))
    force, left = march(
        np.exp(x),
        np.ascontiguousarray(first),
        np.ascontiguousarray(second),
        np.ascontiguousarray(read),
        np.ascontiguousarray(read_v),
        cross_d,
        cross_v,
        np.ascontiguousarray(d_lin),
        np.ascontiguousarray(v_lin),
        kinds,
        params,
        np.ascontiguousarray(modulation),
        h,
        typical,
    )
    if not np.all(np.isfinite(force)) or left > 1e-3:
        raise FloatingPointError(f"local equations did not converge (left over {left:.1e} of the peak force)")
    return force
