"""Disturbances that do not follow the shaker: mains hum, a wandering channel, a moving floor, modulation.

They live in the scatter between periods, on lines without force and in the shaker-off record. Each test compares powers that would be
equal if the disturbance were absent; gains are decreases of −2 log likelihood, like those of all other hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case import Case
from bayes_nlsid.mismatch.linear import Family, Modes, receptances
from bayes_nlsid.mismatch.spectra import Spectra

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
STRONG = 25.0  # gain from which a disturbance is taken for real


@final
@dataclass(frozen=True)
class Disturbance:
    """A disturbance found (or not).

    Parameters
    ----------
    cls, place : str
    gain : float
        Decrease of −2 log likelihood.
    size : float
        RMS, m/s².
    detail : str
    """

    cls: str
    place: str
    gain: float
    size: float
    detail: str = ""


def excess(power: Array, count: Array | float) -> Array:
    """−2 log likelihood gain of a variance component: ``power`` is relative to expectation, averaged over ``count`` complex values."""
    x = np.maximum(power, 1.0)
    return np.asarray(2 * count * (x - 1 - np.log(x)))


def disturbances(case: Case, spectra: Spectra | None, fam: Family, modes: Modes) -> list[Disturbance]:
    """All tests that the data allow, best first."""
    out = _hum(case, spectra) + _drift(case, spectra)
    scatter = _scatter(case, spectra)
    if scatter is not None:
        out += _coherent(case, fam, modes, *scatter, spectra)
    return sorted(out, key=lambda d: -d.gain)


def without_hum(case: Case, spectra: Spectra | None) -> Case:
    """The case with strong mains tones taken out of its periodic and quiet records (the channels that hum only).

    Tones are not in phase with the periods, so that strong ones leak over lines that carry something else. Each record gets its own
    mains frequency, within 0.1 % of the nominal one, and its own amplitudes and phases.
    """
    if not case.mains > 0 or not any(d.gain > STRONG for d in _hum(case, spectra)):
        return case
    records = []
    for r in case.records:
        if not r.sealed and r.kind in ("steady", "off") and len(r.accel):
            accel = r.accel.copy()
            accel[:, case.usable] -= tones(r.accel[:, case.usable], case.mains, case.rate)
            r = replace(r, accel=accel)
        records.append(r)
    return replace(case, records=tuple(records))


def tones(accel: Array, mains: float, rate: float) -> Array:
    """Three mains tones (n, S) by least squares, at the mains frequency that fits all channels best."""
    n = len(accel)
    time = (np.arange(n) - n / 2) / rate
    window = np.hanning(n)[:, None]                      # keeps strong neighbouring lines out of the estimate

    def fitted(f: float) -> tuple[float, Array]:
        phase = 2j * np.pi * f * np.outer(time, [h for h in (1, 2, 3) if h * f < 0.45 * rate])
        basis = np.concatenate([np.exp(phase).real, np.exp(phase).imag], axis=1)
        coefficients = np.linalg.lstsq(basis * window, accel * window, rcond=None)[0]
        return float(((window * (basis @ coefficients)) ** 2).sum()), basis @ coefficients

    grid = mains * (1 + np.linspace(-1e-3, 1e-3, 21))
    best = grid[int(np.argmax([fitted(f)[0] for f in grid]))]
    finer = best + (grid[1] - grid[0]) * np.linspace(-1, 1, 9)
    return fitted(float(finer[int(np.argmax([fitted(f)[0] for f in finer]))]))[1]


def _quiet_blocks(case: Case, seconds: float = 1.0) -> tuple[Complex, Array] | None:
    """DFT/n of blocks of the shaker-off record (Q, K, S) and their frequencies, trend removed."""
    offs = [r for r in case.records if r.kind == "off" and not r.sealed]
    if not offs:
        return None
    accel = offs[0].accel[:, case.usable]
    block = min(len(accel), round(seconds * case.rate))
    count = len(accel) // block
    pieces = accel[:count * block].reshape(count, block, -1)
    return np.fft.rfft(pieces, axis=1) / block, np.arange(block // 2 + 1) * case.rate / block


def _tails(case: Case) -> list[tuple[Complex, Array]]:
    """DFT/n of the last two seconds (2, K, S) of every burst that has ended by then, and their frequencies, windowed."""
    out = []
    block = round(case.rate)
    window = np.hanning(block)[:, None] / 0.5
    for r in case.records:
        if r.sealed or r.kind != "burst" or len(r.accel) < 4 * block:
            continue
        if np.abs(r.force[-2 * block:]).max() < 0.02 * np.abs(r.force).max():
            pieces = r.accel[-2 * block:, case.usable].reshape(2, block, -1)
            out.append((np.fft.rfft(window * (pieces - pieces.mean(axis=1, keepdims=True)), axis=1) / block,
                        np.arange(block // 2 + 1) * case.rate / block))
    return out


def _beside(frequency: Array, f: float) -> tuple[int, NDArray[np.intp]]:
    """The line at a frequency, and those beside it that a windowed tone does not reach."""
    k = int(np.argmin(np.abs(frequency - f)))
    return k, np.array([k + i for i in range(-10, 11) if abs(i) > 1 and 0 < k + i < len(frequency)])


def _hum(case: Case, spectra: Spectra | None) -> list[Disturbance]:
    """Power at mains harmonics over power at neighbouring lines, pooled over the records: a tone is in all of them."""
    gains: list[Array] = []
    sizes: list[Array] = []
    for harmonic in (1, 2, 3):
        f = harmonic * case.mains
        ratios: list[Array] = []
        if spectra is not None and spectra.kind == "steady":
            line = f * spectra.block / spectra.rate
            k = int(np.argmin(np.abs(spectra.lines - line)))
            if abs(spectra.lines[k] - line) < 0.1 and not spectra.excited[k]:
                near = np.array([k + i for i in range(-24, 25) if abs(i) > 2 and 0 <= k + i < len(spectra.lines)
                                 and not spectra.excited[k + i] and (spectra.lines[k + i] - spectra.lines[k]) % 2 == 0])
                if len(near) > 4:
                    power = np.abs(spectra.response[:, k]) ** 2
                    ratios += list(power / (np.abs(spectra.response[:, near]) ** 2).mean(1))
                    sizes += list(np.sqrt(2 * power))
        quiet = _quiet_blocks(case, 1.0)
        if quiet is not None and f < 0.45 * case.rate:
            Y, frequency = quiet
            k, near = _beside(frequency, f)
            power = np.abs(Y[:, k]) ** 2
            ratios += list(power / (np.abs(Y[:, near]) ** 2).mean((0, 1)))
            sizes.append(np.sqrt(2 * power.mean(0)))
        for Y, frequency in _tails(case):
            if f < 0.45 * case.rate:
                k, near = _beside(frequency, f)
                power = np.abs(Y[:, k]) ** 2
                # what rings down is not a tone
                ratios.append(np.where(power[1] > 0.7 * power[0], power[1] / (np.abs(Y[1][near]) ** 2).mean(0), 1.0))
                sizes.append(np.sqrt(2 * power[1]))
        if ratios:
            gains.append(np.maximum(excess(np.mean(ratios, axis=0), len(ratios)) - 1.0, 0))
    if not gains:
        return []
    names = np.array(case.sensors)[case.usable]
    gain = np.sum(gains, axis=0)
    share = gain / max(gain.max(), 1e-9)
    size = np.sqrt((np.array(sizes) ** 2).mean(0))
    if len(names) > 1 and np.median(gain) > 40 and np.median(share) > 0.02:
        return [Disturbance("mains_hum", "ALL_SENSORS", float(gain.sum()), float(size.mean()))]
    best = int(np.argmax(gain))
    return [Disturbance("mains_hum", str(names[best]), float(gain[best]), float(size[best]))]


def _drift(case: Case, spectra: Spectra | None) -> list[Disturbance]:
    """Power below 4 Hz of every channel against its own noise higher up, and against the other channels."""
    low: list[Array] = []
    counts = 0
    names = np.array(case.sensors)[case.usable]
    for record in case.records:
        if record.sealed:
            continue
        accel = record.accel[:, case.usable]
        block = round(case.period * case.rate) if record.kind == "steady" else len(accel)
        Y = np.fft.rfft(accel.reshape(-1, block, accel.shape[1]), axis=1) / np.sqrt(block)
        stop = max(2, int(min(4.0, 0.2 * case.band[0]) * block / case.rate) + 1)
        if record.kind == "burst":
            continue
        low.append((np.abs(Y[:, 1:stop]) ** 2).mean((0, 1)))
        counts += Y.shape[0] * (stop - 1)
    if not low or len(names) < 3:
        return []
    high = _white(case, spectra)
    ratio = np.array(low).mean(0) / high
    relative = ratio / np.median(ratio)
    spread = max(float(np.median(np.abs(np.log(relative)))) * 1.5, 0.12)
    # channels differ in the slope of their noise: only what is beyond that spread counts
    beyond = relative / np.exp(2.5 * spread)
    gains = excess(beyond, 0.3 * counts)
    best = int(np.argmax(gains))
    size = np.sqrt(max(float(np.array(low).mean(0)[best] * 8 / case.rate), 0))
    return [Disturbance("sensor_drift", str(names[best]), float(gains[best]), size, f"{relative[best]:.1f} times the other channels")]


def _white(case: Case, spectra: Spectra | None) -> Array:
    """Noise power per channel in the upper half of the spectrum, in units of |DFT|²/n."""
    if spectra is not None and len(spectra.scatter):
        upper = spectra.lines > spectra.lines[-1] // 2
        return np.asarray((np.abs(spectra.scatter[:, upper]) ** 2).mean((0, 1)) * spectra.block)
    quiet = _quiet_blocks(case, 0.25)
    if quiet is not None:
        Y, frequency = quiet
        return np.asarray((np.abs(Y[:, frequency > case.rate / 4]) ** 2).mean((0, 1)) * (2 * len(frequency) - 2))
    return np.ones(int(case.usable.sum()))


def _scatter(case: Case, spectra: Spectra | None) -> tuple[Complex, Array, Array] | None:
    """Incoherent spectra (Q, L, S) with E|.|² of one period, their frequencies, and the level of each."""
    if spectra is not None and len(spectra.scatter):
        keep = ~spectra.excited & (spectra.frequency > 0.3 * case.band[0])
        per = len(spectra.scatter) // len(spectra.names)
        return spectra.scatter[:, keep], spectra.frequency[keep], np.repeat(spectra.levels, per)[:len(spectra.scatter)]
    quiet = _quiet_blocks(case, 0.5)
    if quiet is None:
        return None
    Y, frequency = quiet
    keep = (frequency > 0.3 * case.band[0]) & (frequency < 0.45 * case.rate)
    return Y[:, keep], frequency[keep], np.zeros(len(Y))


def _coherent(case: Case, fam: Family, modes: Modes, scatter: Complex, frequency: Array, levels: Array, spectra: Spectra | None
              ) -> list[Disturbance]:
    """Incoherent response that moves the whole structure in the pattern of one force or of the floor."""
    s = np.asarray(2j * np.pi * frequency, dtype=complex)
    Q, L, S = scatter.shape
    if S < 3:
        return []
    width = max(1, min(12, L // 20))
    usable = (L // width) * width
    patterns: dict[str, Complex] = {}
    if np.abs(fam.base).any():
        patterns["BASE"] = np.asarray(fam.base_direct + s[:, None] ** 2 * receptances(modes, s, fam.sensors, fam.base[None])[:, :, 0])
    for place, row in fam.places.items():
        patterns[place] = s[:, None] ** 2 * receptances(modes, s, fam.sensors, row[None])[:, :, 0]
    patterns["FORCE"] = s[:, None] ** 2 * receptances(modes, s, fam.sensors, fam.shaker[None])[:, :, 0]
    power = (np.abs(scatter) ** 2).mean(0)[:usable].reshape(-1, width, S).mean(1)
    sigma = np.sqrt(np.repeat(power, width, axis=0))
    high = levels >= np.quantile(levels, 0.67) if np.ptp(levels) > 0 else np.ones(Q, dtype=bool)
    gains, growth, sizes = {}, {}, {}
    for name, h in patterns.items():
        tilted = h[:usable] / sigma
        unit = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
        along = np.abs(np.einsum("ls,qls->ql", unit.conj(), scatter[:, :usable] / sigma, optimize=True)) ** 2
        x = along.mean(0).reshape(-1, width).mean(1)
        count = Q * width * 0.67
        gains[name] = float(np.maximum(excess(x, count) - 1.0, 0)[excess(x, count) > 6].sum())
        growth[name] = float(np.log(max(along[high].mean(), 1e-9) / max(along[~high].mean(), 1e-9))) if (~high).any() else 0.0
        sizes[name] = float(np.sqrt((np.maximum(along - 1, 0).mean() * sigma ** 2).sum() * 2 / S))
    best = max(gains, key=lambda k: gains[k])
    out = []
    grows = growth[best] > 0.3
    if "BASE" in gains:
        value = gains["BASE"] if not grows and gains["BASE"] > 0.7 * gains[best] else 0.0
        out.append(Disturbance("base_motion", "BASE", value, sizes["BASE"]))
    if grows or best != "BASE":
        place = best if best in fam.places else "-"
        value = gains[best] if grows else gains[best] - gains.get("BASE", 0.0)
        detail = "incoherent and growing with level" if grows else "incoherent"
        out.append(Disturbance("other", place, max(value, 0.0), sizes[best], detail))
    return out
