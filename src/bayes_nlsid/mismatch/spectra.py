"""Recordings as lines of the discrete Fourier transform: periodic records by their period, bursts as they stand.

A burst that starts and ends at rest is its own period. One that is cut off before it has died away is multiplied, force and
response alike, by exp(-alpha t): this evaluates every transfer function at s = alpha + i omega instead of i omega, which is exact for any
linear path from rest, and brings the end of the record below the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case import Case, CaseRecord

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Mask = NDArray[np.bool_]


@final
@dataclass(frozen=True)
class Spectra:
    """Records of one length and kind on common lines.

    Parameters
    ----------
    names : tuple of str
        R records.
    kind : str
        ``"steady"`` or ``"burst"``.
    block : int
        Samples of one period (or of the burst).
    rate, alpha : float
        Hz; 1/s (0 unless a burst was cut off).
    lines : ndarray of int (L,)
        Analysed lines, frequency ``lines * rate / block``.
    excited : ndarray of bool (L,)
        Whether the force reaches the line.
    force : ndarray complex (R, L)
        DFT / block, mean over periods; zero on lines without force.
    response : ndarray complex (R, L, S)
        Accelerations, usable channels only.
    noise : ndarray (R, L, S)
        Variance E|n|² of ``response``.
    force_noise : ndarray (R, L)
        Variance of ``force``.
    waveforms : ndarray (R, block)
        Mean force in time, N.
    scatter : ndarray complex (Q, L, S)
        Deviations of single periods from their mean, scaled to the variance of one period (Q = 0 for bursts).
    levels, starts : ndarray (R,)
    stray : ndarray complex (R, L)
        Force that stands out of its noise on lines the excitation leaves out; zero elsewhere (and for bursts).
    """

    names: tuple[str, ...]
    kind: str
    block: int
    rate: float
    alpha: float
    lines: NDArray[np.int64]
    excited: Mask
    force: Complex
    response: Complex
    noise: Array
    force_noise: Array
    waveforms: Array
    scatter: Complex
    levels: Array
    starts: Array
    stray: Complex = field(default_factory=lambda: np.zeros((0, 0), dtype=complex))

    def __post_init__(self) -> None:
        r, length = self.force.shape
        if self.response.shape[:2] != (r, length) or self.noise.shape != self.response.shape or self.lines.shape != (length,):
            raise ValueError(f"force {self.force.shape}, response {self.response.shape}, noise {self.noise.shape}, lines "
                             f"{self.lines.shape} disagree")
        if self.stray.shape != self.force.shape:
            if self.stray.size:
                raise ValueError(f"stray has shape {self.stray.shape}, that of force is {self.force.shape}")
            object.__setattr__(self, "stray", np.zeros_like(self.force))

    @property
    def frequency(self) -> Array:
        """(L,) Hz."""
        return self.lines * self.rate / self.block

    @property
    def s(self) -> Complex:
        """(L,) Laplace variable of every line, rad/s."""
        return np.asarray(self.alpha + 2j * np.pi * self.frequency)

    @property
    def power(self) -> Array:
        """(L,) sum over records of |F|²/weight, the leverage of each line on a free transfer function (unit weights)."""
        return np.asarray((np.abs(self.force) ** 2).sum(0))


def steady_spectra(case: Case, records: tuple[CaseRecord, ...], floor: Array | None = None) -> Spectra:
    """Lines of periodic records; see :class:`Spectra`.

    Parameters
    ----------
    records : steady records of the case.
    floor : (block // 2 + 1, S) variance of one period's DFT / block from elsewhere, for records with one period.
    """
    block = round(case.period * case.rate)
    first, last = max(2, round(5.0 * case.period)), int(0.47 * block)
    lines = np.arange(first, last)
    per_record = [_periods(r, block, case.usable) for r in records]
    force = np.array([f.mean(0) for f, _ in per_record])
    response = np.array([y.mean(0) for _, y in per_record])
    scatter = [d for _, y in per_record if len(y) > 1 for d in (y - y.mean(0)) * np.sqrt(len(y) / (len(y) - 1))]
    force_scatter = [d for f, _ in per_record if len(f) > 1 for d in (f - f.mean(0)) * np.sqrt(len(f) / (len(f) - 1))]
    if scatter:
        one = local_mean((np.abs(np.array(scatter)) ** 2).mean(0))
        one_force = local_mean((np.abs(np.array(force_scatter)) ** 2).mean(0)[:, None])[:, 0]
    else:
        one = floor if floor is not None else np.abs(response[:, -len(response[0]) // 20:]).mean() ** 2 * np.ones(response.shape[1:])
        one_force = 1e-8 * (np.abs(force) ** 2).mean() * np.ones(force.shape[1])
    one = np.maximum(one, 1e-14 * (np.abs(response) ** 2).mean())
    count = np.array([r.periods for r in records], dtype=float)
    excited = _excited_lines(case, force, one_force / count.mean())
    stray = np.where(excited | (np.abs(force) ** 2 < 20 * one_force / count[:, None]), 0, force)
    force = np.where(excited, force, 0)
    waveforms = np.fft.irfft(np.where(np.arange(block // 2 + 1) <= last, force, 0) * block, block, axis=1)
    return Spectra(tuple(r.name for r in records), "steady", block, case.rate, 0.0, lines, excited[lines], force[:, lines],
                   response[:, lines], one[lines] / count[:, None, None], one_force[lines] / count[:, None], waveforms,
                   np.array(scatter)[:, lines] if scatter else np.zeros((0, len(lines), response.shape[2]), dtype=complex),
                   np.array([r.level for r in records]), np.array([r.start for r in records]), stray[:, lines])


def burst_spectra(case: Case, records: tuple[CaseRecord, ...], psd: Array, most: int = 1200) -> Spectra:
    """Lines of bursts of one length.

    Parameters
    ----------
    psd : (K, S) noise variance of DFT/n times n, on K frequencies evenly spaced from 0 to rate/2.
    most : largest number of lines kept (evenly thinned).
    """
    block = min(len(r.force) for r in records)
    usable = case.usable
    stack = np.array([r.accel[:block][:, usable] for r in records])
    force = np.array([r.force[:block] for r in records])
    alpha = _decay(stack, psd, case)
    window = np.exp(-alpha * np.arange(block) / case.rate)
    full = np.fft.rfft(force * window, axis=1) / block
    low, high = int(np.ceil(case.band[0] * block / case.rate)), int(case.band[1] * block / case.rate)
    inside = np.arange(low, high + 1)
    lines = inside[::max(1, int(np.ceil(len(inside) / most)))]
    response = np.fft.rfft(stack * window[:, None], axis=1)[:, lines] / block
    grid = np.linspace(0, block // 2, len(psd))
    share = (window ** 2).mean()
    noise = np.stack([np.interp(lines, grid, psd[:, i]) for i in range(psd.shape[1])], axis=1) / block * share
    force_noise = np.full((len(records), len(lines)), _force_noise(case, full, lines, block, share))
    return Spectra(tuple(r.name for r in records), "burst", block, case.rate, alpha, lines, np.ones(len(lines), dtype=bool),
                   full[:, lines], response, np.broadcast_to(noise, response.shape).copy(), force_noise, force,
                   np.zeros((0, len(lines), response.shape[2]), dtype=complex),
                   np.array([r.level for r in records]), np.array([r.start for r in records]))


def _force_noise(case: Case, full: Complex, lines: NDArray[np.int64], block: int, share: float) -> float:
    """Variance of DFT/n of the force channel's noise: from the record with the shaker off, else from where the bursts have no power."""
    offs = [r for r in case.records if r.kind == "off" and not r.sealed and len(r.force) > 64 and r.force.std() > 0]
    if offs:
        # differences of neighbours: an offset or a slow drift is not noise
        return float(np.mean(np.diff(offs[0].force) ** 2) / 2 / block * share)
    quiet = np.abs(full[:, int(0.97 * full.shape[1]):]) ** 2
    return float(min(quiet.mean(), 1e-6 * (np.abs(full[:, lines]) ** 2).mean()))


def _decay(stack: Array, psd: Array, case: Case) -> float:
    """Rate (1/s) of the exponential window that keeps what still rings at the end of bursts (R, n, S) below a fifth of the noise of a line.

    An end that is cut off leaks its amplitude over 2π to the next line. A ring too faint for the eye is looked for line by line in the
    last quarter. With the window the same model holds at s + alpha, exactly.
    """
    block = stack.shape[1]
    piece = stack[:, -(block // 4):] * np.hanning(block // 4)[:, None]
    f = np.arange(piece.shape[1] // 2 + 1) * case.rate / piece.shape[1]
    inside = (f > 0.8 * case.band[0]) & (f < 1.1 * case.band[1])
    noise = np.stack([np.interp(f[inside], np.linspace(0, case.rate / 2, len(psd)), psd[:, i]) for i in range(psd.shape[1])], axis=1)
    power = (np.abs(np.fft.rfft(piece, axis=1)[:, inside]) ** 2).max(0) / (0.375 * piece.shape[1])
    ratio = float((power / np.maximum(noise, 1e-300)).max())
    if ratio < 25:                                        # the largest of some thousand values of noise alone stays below
        return 0.0
    leak = np.sqrt(ratio * 4) / np.pi
    return float(np.log(leak / 0.2)) * case.rate / block


def noise_density(case: Case, steady: Spectra | None, points: int = 257) -> tuple[Array, str]:
    """Noise variance of DFT/n times n (points, S) on a grid from 0 to rate/2, and how it was found."""
    usable = case.usable
    offs = [r for r in case.records if r.kind == "off" and not r.sealed]
    if steady is not None and len(steady.scatter):
        power = (np.abs(steady.scatter) ** 2).mean(0) * steady.block
        position = steady.lines / (steady.block / 2)
        how = "scatter between periods"
    elif offs:
        n = len(offs[0].accel)
        power = (np.abs(np.fft.rfft(offs[0].accel[:, usable], axis=0)) ** 2)[1:] / n
        position = np.arange(1, len(power) + 1) / (n / 2)
        how = "shaker-off record"
    else:
        record = max((r for r in case.records if not r.sealed), key=lambda r: len(r.accel))
        quiet = np.sqrt((record.accel[:, usable] ** 2).mean(1))
        block = max(64, len(quiet) // 40)
        start = int(np.argmin([quiet[i:i + block].mean() for i in range(0, len(quiet) - block + 1, block)])) * block
        piece = record.accel[start:start + block][:, usable]
        power = (np.abs(np.fft.rfft(piece, axis=0)) ** 2)[1:] / block
        position = np.arange(1, len(power) + 1) / (block / 2)
        how = "quietest stretch of the longest record"
    if how != "scatter between periods":
        # Few lines in a mean: sharp where noise makes the structure ring. What is divided by a variance from m values is m/(m − 1) times
        # too large on average.
        count = 13 + len(power) // points
        power = local_mean(power, 6) * count / (count - 1)
    edges = np.linspace(0, 1, points + 1)
    out = np.empty((points, power.shape[1]))
    previous = power[:max(3, len(power) // points)].mean(0)
    for i in range(points):
        inside = (position >= edges[i]) & (position < edges[i + 1])
        previous = power[inside].mean(0) if inside.sum() >= 2 else previous
        out[i] = previous
    return np.maximum(out, 1e-300), how


def local_mean(power: Array, half: int = 6) -> Array:
    """Running mean (K, S) over ``half`` lines to each side, narrower near line 0 where noise is steep."""
    total = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    k = np.arange(len(power))
    width = np.minimum(half, np.maximum(1, k // 4))
    low, high = np.maximum(k - width, 0), np.minimum(k + width + 1, len(power))
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def _periods(record: CaseRecord, block: int, usable: Mask) -> tuple[Complex, Complex]:
    force = record.force.reshape(record.periods, block)
    accel = record.accel[:, usable].reshape(record.periods, block, -1)
    return np.fft.rfft(force, axis=1) / block, np.fft.rfft(accel, axis=1) / block


def _excited_lines(case: Case, force: Complex, noise: Array) -> Mask:
    """Lines the force reaches: as stated, or those well above the force noise."""
    power = (np.abs(force) ** 2).max(0)
    out = np.zeros(force.shape[1], dtype=bool)
    if len(case.excited):
        out[case.excited[(case.excited > 0) & (case.excited < len(out))]] = True
        return out & (power > 20 * noise)
    strong = power > max(1e-3 * float(np.quantile(power, 0.98)), 30 * float(np.median(noise)))
    return np.asarray(strong)


def repeats(spectra: Spectra) -> list[int]:
    """For every record the first one with the same force history."""
    out = []
    w = spectra.waveforms
    norms = np.linalg.norm(w, axis=1)
    for r in range(len(w)):
        first = r
        for q in range(r):
            if abs(norms[r] - norms[q]) < 2e-3 * norms[r] and w[r] @ w[q] > 0.9995 * norms[r] * norms[q]:
                first = q
                break
        out.append(first)
    return out
