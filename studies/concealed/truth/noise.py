"""Sensor noise: coloured, of mixed quality, independent between channels."""

from __future__ import annotations

import numpy as np


def coloured(rng: np.random.Generator, n: int, fs: float, sigma: float, corner: float, bump: tuple[float, float]) -> np.ndarray:
    """Gaussian noise (n,) of standard deviation ``sigma``: white above ``corner`` Hz, 1/f below, with a broad bump (Hz, gain)."""
    frequency = np.fft.rfftfreq(n, 1 / fs)
    power = 1.0 + corner / np.maximum(frequency, 0.5) + bump[1] * np.exp(-(((frequency - bump[0]) / 60.0) ** 2))
    power[0] = 0.0
    shape = np.sqrt(power / np.mean(power))
    white = np.fft.rfft(rng.standard_normal(n))
    return sigma * np.fft.irfft(white * shape, n)


def lowpass_walk(rng: np.random.Generator, n: int, fs: float, cutoff: float) -> np.ndarray:
    """Unit-rms slow random signal (n,) with 1/f^2 power below ``cutoff`` Hz and none above."""
    frequency = np.fft.rfftfreq(n, 1 / fs)
    shape = np.where((frequency > 0) & (frequency < cutoff), 1.0 / np.maximum(frequency, 0.25), 0.0)
    wave = np.fft.irfft(shape * np.fft.rfft(rng.standard_normal(n)), n)
    return wave / np.sqrt(np.mean(wave**2))
