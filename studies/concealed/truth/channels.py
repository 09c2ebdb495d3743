"""What happens to true signals on their way into the file: gain, delay, drift, clipping, hum, crosstalk, base motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .modes import Plant
from .noise import lowpass_walk
from .response import drive


@dataclass(frozen=True)
class Tap:
    """One channel effect: ``formula`` on ``channel`` (index, -1 force, -2 all) with ``amount`` and further ``params``."""

    formula: str
    channel: int
    amount: float
    params: dict[str, Any] = field(default_factory=dict)
    in_noise_record: bool = True


def _filter(wave: np.ndarray, fs: float, reply) -> np.ndarray:
    spectrum = np.fft.rfft(wave)
    return np.fft.irfft(spectrum * reply(2j * np.pi * np.fft.rfftfreq(wave.size, 1 / fs)), wave.size)


def multiplier(tap: Tap):
    """Frequency response of a linear tap as a function of ``s`` (rad/s), or None for other taps."""
    a = tap.amount
    return {
        "gain": lambda s: np.full(s.shape, 1.0 + a, complex),
        "tilted_gain": lambda s: 1.0 + a * (1.0 + tap.params.get("tilt", 0.0) * np.abs(s) / 5000.0),
        "delay": lambda s: np.exp(-s * a),
        "lag": lambda s: 1.0 / (1.0 + s * a),
        "allpass": lambda s: (1.0 - s * a / 2) / (1.0 + s * a / 2),
    }.get(tap.formula)


def apply(
    tap: Tap, accel: np.ndarray, force: np.ndarray, fs: float, start: float, rng: np.random.Generator, plant: Plant, off: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Signals after one tap: ``accel`` (n, s) m/s^2, ``force`` (n,) N; ``off`` marks the shaker-off record."""
    if off and not tap.in_noise_record:
        return accel, force
    reply = multiplier(tap)
    if reply is not None and tap.channel == -1:
        return accel, _filter(force, fs, reply)
    accel = accel.copy()
    n, i, a = accel.shape[0], tap.channel, tap.amount
    time = start + np.arange(n) / fs
    if reply is not None:
        accel[:, i] = _filter(accel[:, i], fs, reply)
    elif tap.formula == "hard_clip":
        accel[:, i] = np.clip(accel[:, i], -a, a)
    elif tap.formula == "soft_clip":
        accel[:, i] = accel[:, i] / (1.0 + np.abs(accel[:, i] / a) ** 10) ** 0.1
    elif tap.formula == "uneven_clip":
        accel[:, i] = np.clip(accel[:, i], -1.15 * a, a)
    elif tap.formula == "walk":
        accel[:, i] += a * lowpass_walk(rng, n, fs, tap.params["cutoff"])
    elif tap.formula == "warm_up":
        tau = tap.params["tau"]
        wave = np.exp(-(time - start) / tau) * rng.choice([-1.0, 1.0]) + 0.4 * lowpass_walk(rng, n, fs, 1.0)
        accel[:, i] += a * (wave - wave.mean()) / np.std(wave)
    elif tap.formula == "sway":
        accel[:, i] += a * np.sqrt(2) * np.sin(2 * np.pi * tap.params["hz"] * time + rng.uniform(0, 6.28))
    elif tap.formula == "hum":
        accel = accel + _hum(tap, time, rng)[:, None] * np.asarray(tap.params["weights"])[None, :]
    elif tap.formula == "base":
        accel = accel + a * base_reply(tap, n, fs, rng, plant, accel.shape[1])
    elif tap.formula == "crosstalk":
        source = force if tap.params["source"] < 0 else accel[:, tap.params["source"]]
        accel[:, i] += a * source
    elif tap.formula == "dropouts":
        accel[:, i] *= 1.0 - min(a, 1.0) * _losses(rng, n, fs, tap.params["rate"], tap.params["length"])
    elif tap.formula == "cell_curvature":
        x = force / tap.params["rms"]
        return accel, force + a * tap.params["rms"] * (x * x - 1.0) / (1.0 + 0.1 * x * x)
    return accel, force


def _hum(tap: Tap, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mains tones of total rms ``amount``; the mains frequency wanders by parts in ten thousand."""
    mains = tap.params["mains"] * (1.0 + 1e-4 * rng.standard_normal())
    wave = np.zeros(time.size)
    for order, share in zip((1, 2, 3), tap.params["shares"], strict=True):
        wave += share * np.cos(2 * np.pi * order * mains * time + rng.uniform(0, 2 * np.pi))
    return tap.amount * wave / np.sqrt(0.5 * np.sum(np.square(tap.params["shares"])))


def base_reply(tap: Tap, n: int, fs: float, rng: np.random.Generator, plant: Plant, sensors: int) -> np.ndarray:
    """Absolute acceleration (n, sensors) for unit rms floor acceleration inside the tap's band, already ringing at the start."""
    lead = int(2 * fs)
    total = n + lead
    frequency = np.fft.rfftfreq(total, 1 / fs)
    low, high = tap.params["band"]
    shape = np.where((frequency > low) & (frequency < high), (low / np.maximum(frequency, low)) ** tap.params["slope"], 0.0)
    floor = np.fft.irfft(shape * np.fft.rfft(rng.standard_normal(total)), total)
    floor /= np.std(floor)
    names = [f"S{i + 1}" for i in range(sensors)]
    relative = drive(plant, floor[:, None], fs, names, ["BASE"], fs, 2)
    return (relative + floor[:, None])[lead:]


def _losses(rng: np.random.Generator, n: int, fs: float, per_second: float, length: float) -> np.ndarray:
    """Zero, and one during short losses of contact (``length`` s, ``per_second`` on average)."""
    lost = np.zeros(n)
    for at in np.nonzero(rng.random(n) < per_second / fs)[0]:
        lost[at : at + max(1, int(length * fs * rng.uniform(0.5, 1.5)))] = 1.0
    return lost
