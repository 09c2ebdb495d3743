"""What the answer file says beyond names: how much no linear model absorbs, which places look alike, what tolerances allow."""

from __future__ import annotations

import numpy as np

from .campaign import BURST, STEADY, Campaign, Entry
from .effects import Bench
from .modes import Plant

ALIKE = 0.98
PROVABLE = 12.0  # chi-square below which nobody can be asked to see an effect


def spectrum(wave: np.ndarray, entry: Entry) -> np.ndarray:
    """Lines of a record (k, channels): the mean over periods for multisines, the whole record for bursts."""
    if entry.kind == STEADY:
        periods = 3
        return np.fft.rfft(wave.reshape(periods, -1, *wave.shape[1:]).mean(axis=0), axis=0)
    return np.fft.rfft(wave, axis=0)


def change_not_lti(
    clean: dict[str, tuple[np.ndarray, np.ndarray]], campaign: Campaign, variance: dict[str, np.ndarray]
) -> tuple[float, float]:
    """What the best free linear system over all open records of one kind leaves over (noise-free).

    Per line and channel one free frequency response is fitted; lines without force are left over whole.  Returned are the share of
    the high-level response (rms) and the chi-square of all that is left, against ``variance[name]`` (k, s) of the records' lines.
    """
    kind = STEADY if any(e.kind == STEADY and not e.sealed for e in campaign.entries) else BURST
    entries = [e for e in campaign.entries if e.kind == kind and not e.sealed]
    F = np.array([spectrum(clean[e.name][0], e) for e in entries])
    Y = np.array([spectrum(clean[e.name][1], e) for e in entries])
    power = np.sum(np.abs(F) ** 2, axis=0)
    lit = power > 1e-6 * power.max()
    H = np.einsum("rk,rks->ks", F.conj(), Y) / np.where(lit, power, np.inf)[:, None]
    left = np.abs(Y - H[None] * F[:, :, None]) ** 2
    high = [i for i, e in enumerate(entries) if e.level == 1.0]
    chi2 = sum(float(np.sum(left[i] / variance[e.name])) for i, e in enumerate(entries))
    return float(np.sqrt(np.sum(left[high]) / np.sum(np.abs(Y[high]) ** 2))), chi2


def signatures(plant: Plant, names: list[str], sensors: int, lines_hz: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Whitened change of all sensors over the lines (names, f * s) that a small spring at each place makes."""
    s = 2j * np.pi * lines_hz
    outs = [f"S{i + 1}" for i in range(sensors)]
    to = plant.receptance(outs, names, s) * (s**2)[:, None, None]
    local = plant.receptance(names, ["SHAKER"], s)[:, :, 0]
    return (to * local[:, None, :] / sigma[None, :, None]).transpose(2, 0, 1).reshape(len(names), -1)


def equivalent_places(plant: Plant, truth: str, names: list[str], bench: Bench, sigma: np.ndarray, energy: float) -> dict:
    """Similarity of every rival place with ``truth`` and the sets that cannot be told apart.

    ``same``: similarity of at least 0.98 (a complex factor is free).  ``same_by_noise``: the difference carries less than 9 units of
    chi-square of the ``energy`` (chi-square of the whole change), so that no method could separate them on these records.
    """
    hz = bench.campaign.lines[::2] / 2.0
    if truth.startswith(("P", "SHAKER")):
        names = [n for n in names if n.startswith(("P", "SHAKER"))]
    elif truth.startswith(("J", "ROOT", "TIP")):
        names = [n for n in names if n.startswith(("J", "ROOT", "TIP"))]
    else:
        return {}
    X = signatures(plant, names, bench.sensors, hz, sigma)
    X /= np.linalg.norm(X, axis=1)[:, None]
    alike = np.abs(X.conj() @ X[names.index(truth)]) ** 2
    return {
        "similarity": {n: round(float(a), 4) for n, a in zip(names, alike, strict=True)},
        "same": [n for n, a in zip(names, alike, strict=True) if a >= ALIKE],
        "same_by_noise": [n for n, a in zip(names, alike, strict=True) if a >= ALIKE or (1 - a) * energy < 9.0],
    }
