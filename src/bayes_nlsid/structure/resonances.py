"""Where a recording resonates, and when each resonance rings above the noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.kinematics import ORDER
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.polefit import Complex


@final
@dataclass(frozen=True)
class Peak:
    """A resonance in the rough spectrum: frequency (Hz) and how large each channel is there, as displacement (s,)."""

    frequency: float
    size: NDArray[np.float64]


def find_peaks(recording: Recording, nominal: ModalModel, chosen: list[int], search: float) -> dict[int, Peak]:
    """The resonance that belongs to each mode, by nearness, likeness of shape and height together."""
    from scipy.optimize import linear_sum_assignment

    f, spectra = _rough_spectra(recording)
    total = np.sum(np.abs(spectra) ** 2, axis=1)
    shapes = np.abs(nominal.rows([c.location for c in recording.channels]))
    order = np.array([ORDER[c.quantity] for c in recording.channels])
    places = np.concatenate([_maxima(f, total, nominal.frequency[k], search) for k in chosen] or [np.zeros(0, dtype=int)])
    places = np.unique(places).astype(int)
    if places.size == 0:
        return {}
    cost = np.full((len(chosen), places.size), 1e6)
    seen = np.abs(spectra[places]) * (2 * np.pi * f[places, None]) ** (order.max() - order)
    for i, k in enumerate(chosen):
        near = np.abs(f[places] / nominal.frequency[k] - 1)
        likeness = (seen @ shapes[:, k]) ** 2 / (np.sum(seen**2, axis=1) * np.sum(shapes[:, k] ** 2))
        local = np.log10(total[places] / max(total[places][near <= search], default=1.0))
        cost[i] = np.where(near <= search, (near / search) ** 2 + 1 - likeness - 0.5 * np.maximum(local, -4), 1e6)
    rows, columns = linear_sum_assignment(cost)
    return {chosen[i]: Peak(float(f[places[j]]), seen[j]) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 1e5}


def _rough_spectra(recording: Recording) -> tuple[NDArray[np.float64], Complex]:
    """Frequencies and spectra (f, s) in which resonances stand out: of the decay itself, or response over force."""
    n = recording.period or recording.n
    response = recording.response[:n * (recording.n // n)].reshape(-1, n, recording.response.shape[1]).mean(axis=0)
    f = np.asarray(np.fft.rfftfreq(n, recording.dt), dtype=float)
    spectra = np.fft.rfft(response - response.mean(axis=0), axis=0)
    if recording.free:
        return f, spectra
    force = recording.force[:n * (recording.n // n)].reshape(-1, n, recording.force.shape[1]).mean(axis=0)
    drive = np.fft.rfft(force, axis=0)
    main = drive[:, [int(np.argmax(np.sum(np.abs(drive) ** 2, axis=0)))]]
    if recording.period is None:  # smooth over neighbouring lines: H1 of a burst
        kernel = np.hanning(9)[1:-1]
        over = lambda x: np.stack([np.convolve(c, kernel, "same") for c in x.T], axis=1)  # noqa: E731
        power = over(np.abs(main) ** 2)
        return f, over(spectra * main.conj()) / (power + 1e-6 * power.max())
    lit = np.abs(main[:, 0]) > 1e-3 * np.abs(main).max()
    return f[lit], spectra[lit] / main[lit]


def _maxima(f: NDArray[np.float64], power: NDArray[np.float64], nominal: float, search: float) -> NDArray[np.int_]:
    """Indices of lines within the search range that stand highest among their neighbours and above the median there.

    A damped mode fills the range, so its height over the median is small; what is only noise the fit will tell.
    """
    inside = np.flatnonzero((f >= nominal * (1 - search)) & (f <= nominal * (1 + search)))
    if inside.size < 5:
        return np.zeros(0, dtype=int)
    reach = max(2, round(0.003 * nominal / (f[1] - f[0])))
    peak = [i for i in inside if power[i] == power[max(0, i - reach):i + reach + 1].max() and power[i] > 2 * np.median(power[inside])]
    return np.array(sorted(peak, key=lambda i: -power[i])[:8], dtype=int)


def quiet_end(recording: Recording, f: float, others: list[float], span: float, floor: float) -> tuple[int, int] | None:
    """Samples (first, last) of the last stretch in which a resonance stays above its noise, from ``span`` times its last amplitude on."""
    duration = recording.n * recording.dt
    gap = min((abs(f - other) for other in others), default=f)
    width = max(min(0.012 * f, gap / 4), 4 / duration)
    analytic, gain_power, low = _around(recording, f, width)
    n, dt = len(analytic), duration / len(analytic)
    envelope = np.abs(analytic)
    # One-sided density D gives a complex envelope of mean square 2 D ∫gain².
    noise = np.sqrt(2 * _noise_density(recording, f, [f, *others]) * gain_power)
    level = np.sqrt(np.mean((envelope / np.maximum(noise, 1e-12 * envelope.max())) ** 2, axis=1))
    reach = max(1, round(0.5 / width / dt))
    edge = min(2 * reach, n // 10)  # the filter rings at both ends of the recording
    turning = np.sum(analytic[1:] * analytic[:-1].conj(), axis=1)
    smooth = np.cumsum(np.concatenate([np.zeros(1), turning]))
    at = np.clip(np.arange(n), reach, n - 1 - reach)
    running = low + np.angle(smooth[at + reach] - smooth[at - reach]) / (2 * np.pi * dt) % (1 / dt)
    # What still rings where the frequency has wandered off is another resonance that leaks into the filter.
    alive = (level >= floor) & (np.abs(running - f) < max(width, 3 / duration))
    loudest = edge + int(np.argmax(level[edge:n - edge]))
    gone = np.flatnonzero(~alive[loudest:n - edge])
    last = loudest + int(gone[0]) - 1 if gone.size else n - edge - 1
    before = np.flatnonzero(level[loudest:max(last, loudest)] >= span * level[last])
    first = loudest + (int(before[-1]) if before.size else 0)
    stretch = round(first * dt / recording.dt), round((last + 1) * dt / recording.dt)
    return stretch if (last - first) * dt * f >= 8 and stretch[1] - stretch[0] >= 40 else None


def _around(recording: Recording, f: float, width: float) -> tuple[Complex, float, float]:
    """Complex envelopes (n', s) of the channels through a Gaussian filter, at a low rate; ∫gain² (Hz); their shift (Hz)."""
    n = recording.n
    spectrum = np.fft.rfft(recording.response - recording.response.mean(axis=0), axis=0)
    lines = np.fft.rfftfreq(n, recording.dt)
    inside = np.flatnonzero(np.abs(lines - f) <= 5 * width)
    gain = np.exp(-0.5 * ((lines[inside] - f) / width) ** 2)
    analytic = 2 * np.fft.ifft(spectrum[inside] * gain[:, None], axis=0) * inside.size / n
    return analytic, float(np.sum(gain**2) * lines[1]), float(lines[inside[0]])


def _noise_density(recording: Recording, f: float, resonances: list[float]) -> NDArray[np.float64]:
    """One-sided power density (s,) of the noise about a frequency, from the last half and the lines away from resonances."""
    tail = recording.response[recording.n // 2:]
    n = len(tail)
    t = 2 * np.pi * np.arange(n) / n
    taper = 0.35875 - 0.48829 * np.cos(t) + 0.14128 * np.cos(2 * t) - 0.01168 * np.cos(3 * t)  # Blackman-Harris: no leakage above -92 dB
    lines = np.fft.rfftfreq(n, recording.dt)
    psd = 2 * recording.dt * np.abs(np.fft.rfft((tail - tail.mean(axis=0)) * taper[:, None], axis=0)) ** 2 / np.sum(taper**2)
    for reach in (1.3, 1.6, 2.5):
        away = (lines > f / reach) & (lines < f * reach)
        for resonance in resonances:
            away &= np.abs(lines - resonance) > max(0.05 * resonance, 5 * (lines[1] - lines[0]))
        if away.sum() >= 8:
            return np.asarray(np.median(psd[away], axis=0) / np.log(2), dtype=float)
    return np.asarray(psd[(lines > f / 2) & (lines < 2 * f)].min(axis=0), dtype=float)
