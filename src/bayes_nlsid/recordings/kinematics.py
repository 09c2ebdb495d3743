"""Displacement, velocity and acceleration of every channel, exact inside a band.

The discrete Fourier transform of each channel is multiplied by (iω)^k and by one smooth band-pass, the same for responses and
forces, so that any linear relation between them (Eq. 10) still holds for the filtered signals. No quadrature rule is involved and
hence no bias that grows with frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.recordings.filtering import agreeing, band_pass, continuations, reach, rms, skirts, without_line
from bayes_nlsid.recordings.recording import Channel, Recording

ORDER = {"displacement": 0, "velocity": 1, "acceleration": 2}


@final
@dataclass(frozen=True)
class Kinematics:
    """Band-limited motion of every channel.

    Parameters
    ----------
    name : str
        Of the recording.
    dt : float
        Time step, s (after decimation).
    displacement, velocity, acceleration : ndarray (n, s)
        m, m/s, m/s².
    force : ndarray (n, k)
        N, through the same filter.
    valid : slice
        Samples free of edge effects.
    band : tuple of float
        (low, high) Hz where the filter is exactly one.
    error : ndarray (s,)
        Estimated relative rms error per channel, the worst of the three motions: noise seen outside the band continued into it,
        and what the unknown signal beyond the ends of a transient can change inside ``valid``.
    channels, inputs : tuple of Channel
    period : int or None
        Samples per period after decimation.
    stop : tuple of float
        (low, high) Hz where the filter reaches zero.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    name: str
    dt: float
    displacement: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    force: NDArray[np.float64]
    valid: slice
    band: tuple[float, float]
    error: NDArray[np.float64]
    channels: tuple[Channel, ...]
    inputs: tuple[Channel, ...] = ()
    period: int | None = None
    stop: tuple[float, float] = (0.0, np.inf)

    def __post_init__(self) -> None:
        n, s = self.displacement.shape
        for field, shape in (("velocity", (n, s)), ("acceleration", (n, s)), ("force", (n, len(self.inputs))), ("error", (s,))):
            if getattr(self, field).shape != shape:
                raise ValueError(f"kinematics {self.name!r}: {field} has shape {getattr(self, field).shape}, expected {shape}")
        if s != len(self.channels):
            raise ValueError(f"kinematics {self.name!r}: {s} columns but {len(self.channels)} channels")

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.displacement.shape[0])

    def gain(self, frequency: ArrayLike) -> NDArray[np.float64]:
        """Gain of the common filter at the given frequencies (Hz)."""
        return band_pass(frequency, self.band, self.stop)


def kinematics(recording: Recording, band: tuple[float, float], fs: float | None = None) -> Kinematics:
    """Displacement, velocity and acceleration from whichever of them was measured.

    Parameters
    ----------
    recording : Recording
        Whole steady periods (``period`` set) are transformed as they stand; anything else is treated as a transient: its straight
        line is removed, it is continued by linear prediction that fades out, and edges are called invalid.
    band : tuple of float
        (low, high) Hz, 0 < low < high ≤ Nyquist frequency.
    fs : float, optional
        Lower rate, Hz, an integer fraction of the recorded one, above twice ``high``.

    Returns
    -------
    Kinematics

    Raises
    ------
    ValueError
        If the band or the rate cannot be had, or the recording is too short for the lower edge.
    """
    every = _decimation(recording, band, fs)
    rate = recording.fs / every
    stop = skirts(band, rate)
    if recording.n * recording.dt < 2 / band[0]:
        raise ValueError(f"recording {recording.name!r}: {recording.n * recording.dt:.3g} s hold fewer than two periods of the lower band "
                         f"edge {band[0]:g} Hz; raise the edge or record longer")
    order = np.array([ORDER[c.quantity] for c in recording.channels], dtype=int)
    if recording.period is not None:
        motions, force = _filtered(recording.response, recording.force, order, recording.dt, band, stop)
        keep, edge = slice(0, recording.n), np.zeros(len(order))
    else:
        motions, force, keep, edge = _transient(recording, order, band, stop)
    noise = np.max([_ratio(np.sqrt(power), rms(motion[keep]))
                    for power, motion in zip(_noise_power(recording, order, band, stop), motions, strict=True)], axis=0)
    displacement, velocity, acceleration = (m[::every] for m in motions)
    valid = slice(-(-keep.start // every), (keep.stop - 1) // every + 1)
    return Kinematics(recording.name, recording.dt * every, displacement, velocity, acceleration, force[::every], valid, band,
                      np.minimum(np.hypot(noise, edge), 1.0), recording.channels, recording.inputs,
                      None if recording.period is None else recording.period // every, stop)


def _decimation(recording: Recording, band: tuple[float, float], fs: float | None) -> int:
    """How many recorded samples make one, after the arguments were checked."""
    low, high = band
    if not (0 < low < high <= recording.fs / 2 * (1 + 1e-9)):
        raise ValueError(f"band {band} Hz must ascend and lie between 0 and the Nyquist frequency {recording.fs / 2:g} Hz of "
                         f"recording {recording.name!r}")
    if fs is None:
        return 1
    every = round(recording.fs / fs) if np.isfinite(fs) and fs > 0 else 0
    if every < 1 or abs(recording.fs / every - fs) > 1e-6 * fs:
        raise ValueError(f"fs {fs} Hz must be the recorded rate {recording.fs:g} Hz divided by a whole number")
    if high > fs / 2 * (1 + 1e-9):
        raise ValueError(f"fs {fs:g} Hz is below twice the upper band edge {high:g} Hz")
    if recording.period is not None and recording.period % every:
        raise ValueError(f"fs {fs:g} Hz does not divide the period of {recording.period} samples of recording {recording.name!r}")
    return every


def _filtered(response: NDArray[np.float64], force: NDArray[np.float64], order: NDArray[np.int_], dt: float, band: tuple[float, float],
              stop: tuple[float, float]) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Three motions and the force, by one circular transform."""
    n = len(response)
    frequency = np.fft.rfftfreq(n, dt)
    gain = band_pass(frequency, band, stop)
    jw = 2j * np.pi * np.where(gain > 0, frequency, 1.0)[:, None]
    spectrum = np.fft.rfft(response, axis=0) * gain[:, None]
    motions = tuple(np.fft.irfft(spectrum * jw ** (k - order), n=n, axis=0) for k in (0, 1, 2))
    return motions, np.fft.irfft(np.fft.rfft(force, axis=0) * gain[:, None], n=n, axis=0)


def _transient(recording: Recording, order: NDArray[np.int_], band: tuple[float, float], stop: tuple[float, float],
               ) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64], slice, NDArray[np.float64]]:
    """Filter a transient continued beyond its ends; what two different continuations disagree about is the edge effect."""
    from scipy.fft import next_fast_len

    n, dt = recording.n, recording.dt
    far = reach(band, dt)
    total = next_fast_len(n + 2 * far, real=True)
    response, force = without_line(recording.response), without_line(recording.force)
    runs = []
    for one, two in zip(continuations(response, far, total - n - far, band, dt), continuations(force, far, total - n - far, band, dt),
                        strict=True):
        motions, filtered = _filtered(one, two, order, dt, band, stop)
        runs.append((tuple(m[far:far + n] for m in motions), filtered[far:far + n]))
    (motions, filtered), (others, other) = runs
    floor = [np.sqrt(power) for power in _noise_power(recording, order, band, stop)] + [np.zeros(force.shape[1])]
    keep = agreeing([*motions, filtered], [*others, other], floor, min(far, n // 3))
    edge = np.max([_ratio(rms(a[keep] - b[keep]), rms(a[keep])) for a, b in zip(motions, others, strict=True)], axis=0)
    return motions, filtered, keep, edge


def _noise_power(recording: Recording, order: NDArray[np.int_], band: tuple[float, float], stop: tuple[float, float],
                 ) -> list[NDArray[np.float64]]:
    """Mean square (s,) that noise leaves in each motion, if inside the band it is what is seen just below and just above it.

    The level is the median of the periodogram over the neighbouring octave (divided by ln 2, the median of an exponential variable
    of mean one), so that a few lines of signal there do not count.
    """
    n, dt = recording.n, recording.dt
    if recording.period is not None:
        window, signal = np.ones(n), recording.response - recording.response.mean(axis=0)
    else:
        window, signal = np.hanning(n + 2)[1:-1], without_line(recording.response)
    spectrum = np.fft.rfft(signal * window[:, None], axis=0)
    psd = 2 * dt * np.abs(spectrum) ** 2 / (window @ window)
    f = np.fft.rfftfreq(n, dt)
    sides = [psd[(f >= stop[0]) & (f < band[0])], psd[(f > band[1]) & (f <= min(2 * band[1], 0.98 * f[-1]))]]
    found = [np.median(s, axis=0) / np.log(2) for s in sides if len(s) >= 3]
    if not found:
        return [np.zeros(len(order))] * 3
    level = np.where((f < np.sqrt(band[0] * band[1]))[:, None], found[0], found[-1])
    gain = band_pass(f, band, stop)
    omega = 2 * np.pi * np.where(gain > 0, f, 1.0)[:, None]
    return [np.sum(level * gain[:, None] ** 2 * omega ** (2.0 * (k - order)), axis=0) * (f[1] - f[0]) for k in (0, 1, 2)]


def _ratio(part: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """part / whole; a channel without any signal is all error."""
    return np.asarray(np.divide(part, whole, out=np.ones_like(part), where=whole > 0), dtype=float)
