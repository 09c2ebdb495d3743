"""Forces: odd random-phase multisines with random detection lines, and random bursts from rest."""

from __future__ import annotations

import numpy as np


def odd_lines(rng: np.random.Generator, band: tuple[float, float], period: float) -> np.ndarray:
    """Excited odd lines (k,): of every four consecutive odd lines one, drawn at random, stays silent as a detection line."""
    odd = np.arange(1, int(band[1] * period) + 1, 2)
    odd = odd[odd > band[0] * period]
    kept = []
    for i in range(0, odd.size, 4):
        group = odd[i : i + 4]
        kept.append(np.delete(group, rng.integers(group.size)) if group.size == 4 else group)
    return np.concatenate(kept)


def multisine(rng: np.random.Generator, lines: np.ndarray, rms: float, fs: float, period: float) -> np.ndarray:
    """One period (fs * period,) N of a flat multisine with random phases."""
    n = int(round(fs * period))
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
    wave = np.fft.irfft(spectrum, n)
    return wave * (rms / np.sqrt(np.mean(wave**2)))


def burst(
    rng: np.random.Generator, band: tuple[float, float], rms: float, fs: float, duration: float, on: tuple[float, float]
) -> np.ndarray:
    """Random noise (fs * duration,) N inside ``band`` Hz, on between ``on`` s with smooth edges, exactly zero before the start."""
    n = int(round(fs * duration))
    frequency = np.fft.rfftfreq(n, 1 / fs)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    wave = np.fft.irfft(inside * np.exp(2j * np.pi * rng.random(frequency.size)), n)
    time = np.arange(n) / fs
    edge = 0.05
    window = np.clip((time - on[0]) / edge, 0, 1) * np.clip((on[1] - time) / edge, 0, 1)
    window = 0.5 - 0.5 * np.cos(np.pi * window)
    wave = wave * window
    return wave * (rms / np.sqrt(np.mean(wave[window > 0.5] ** 2)))
