"""Noise floor of the channels: from the best evidence there is, and saying which that was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.recordings.recording import Channel, Recording

Floats = NDArray[np.float64]
Sureness = Literal["measured", "estimated", "bound"]
SEGMENTS = 8         # a stretch of noise is cut into at least so many half-overlapping segments, if it is long enough
LEAST = 256          # samples that a quiet stretch must have
QUIET = 0.05         # rms of a quiet stretch, relative to the loudest block
STEADY = 1.25        # largest ratio of rms between the halves of a quiet beginning
SETTLED = 1.15       # the same for a quiet end, which must last `SETTLED_PART` of the recording: a slow decay is steady for a while
SETTLED_PART = 1 / 8
BLOCKS = 64          # blocks in which quiet stretches are looked for
LOW_QUANTILE = 0.2   # of the periodogram in a neighbourhood: the lower envelope of signal plus noise
NEIGHBOURS = 101     # lines in a neighbourhood
PASSED = 0.8         # of the Nyquist frequency, below which no anti-aliasing filter takes noise away
QUIET_PART = 0.25    # of the spectrum that is taken for quiet where the force fills its band
DEGREES = 60         # degrees of freedom wanted of a density got from scatter


@final
@dataclass(frozen=True)
class NoiseFloor:
    """One-sided power spectral densities of the noise.

    Parameters
    ----------
    frequency : ndarray (f,)
        Hz, ascending from 0.
    psd : ndarray (f, s)
        Of each response, (unit)²/Hz.
    channels : tuple of Channel, length s
    how : str
        How it was got, in a sentence.
    sure : {"measured", "estimated", "bound"}
        ``measured``: from samples that hold nothing but noise. ``estimated``: from a part that should. ``bound``: from the lower
        envelope of a spectrum that holds signal, so rather too large.
    force_psd : ndarray (f, k)
        Of each measured force, N²/Hz.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    frequency: Floats
    psd: Floats
    channels: tuple[Channel, ...]
    how: str
    sure: Sureness
    force_psd: Floats

    def __post_init__(self) -> None:
        if self.psd.shape != (len(self.frequency), len(self.channels)):
            raise ValueError(f"noise floor: psd has shape {self.psd.shape}, expected {(len(self.frequency), len(self.channels))}")
        if self.force_psd.ndim != 2 or len(self.force_psd) != len(self.frequency):
            raise ValueError(f"noise floor: force_psd has shape {self.force_psd.shape}, expected ({len(self.frequency)}, k)")

    def at(self, frequency: ArrayLike) -> Floats:
        """Densities (..., s) of the responses at the given frequencies (Hz), interpolated."""
        f = np.asarray(frequency, dtype=float)
        return np.stack([np.interp(f, self.frequency, column) for column in self.psd.T], axis=-1)

    def rms(self, band: tuple[float, float] | None = None) -> Floats:
        """Root mean square (s,) of the noise of the responses between two frequencies (Hz); over all frequencies by default.

        Raises
        ------
        ValueError
            If the band does not ascend.
        """
        low, high = (0.0, float(self.frequency[-1])) if band is None else band
        if not 0 <= low < high:
            raise ValueError(f"band {band} Hz must ascend from 0 or above")
        f = np.concatenate([[low], self.frequency[(self.frequency > low) & (self.frequency < high)], [high]])
        return np.asarray(np.sqrt(np.trapezoid(self.at(f), f, axis=0)), dtype=float)


def noise_psd(recording: Recording, noise_record: Recording | None = None) -> NoiseFloor:
    """Noise floor of a recording.

    Parameters
    ----------
    recording : Recording
    noise_record : Recording, optional
        The same channels with the excitation off, or with a period after which everything but noise repeats.

    Returns
    -------
    NoiseFloor
        From the noise record; else from what differs between steady periods; else from a quiet beginning or end; else the lower
        envelope of the spectrum.

    Raises
    ------
    ValueError
        If the noise record has other channels or another time step, or a recording is too short.
    """
    if recording.n < 16:
        raise ValueError(f"recording {recording.name!r}: {recording.n} samples are too few for a spectrum, at least 16 are needed")
    if noise_record is not None:
        _same_channels(recording, noise_record)
        return _from_noise(noise_record, f"the recording {noise_record.name!r}")
    if recording.role == "noise":
        return _from_noise(recording, "the recording itself")
    if recording.period is not None and recording.n // recording.period >= 2:
        return _from_periods(recording)
    quiet = quiet_stretch(recording)
    if quiet is not None:
        place = "before the event" if quiet.start == 0 else "after the decay"
        seconds = (quiet.stop - quiet.start) * recording.dt
        return _from_stretch(recording, quiet, f"from {seconds:.3g} s {place}, where the level is low and steady", "estimated")
    return _from_envelope(recording)


def quiet_stretch(recording: Recording) -> slice | None:
    """The longest quiet and steady stretch at the beginning or at the end of a recording; None if there is none.

    Quiet: every channel below `QUIET` of its loudest block. Steady: both halves alike. At least `LEAST` samples at the beginning, and
    an eighth of the recording at the end.
    """
    signals = np.concatenate([recording.response, recording.force], axis=1)
    size = recording.n // BLOCKS
    if size < 4 or recording.n < 2 * LEAST:
        return None
    blocks = signals[:size * BLOCKS].reshape(BLOCKS, size, -1)
    level = blocks.std(axis=1)
    loud = level > QUIET * level.max(axis=0)
    if not loud.any():
        return None
    first, last = int(np.argmax(loud.any(axis=1))), BLOCKS - int(np.argmax(loud.any(axis=1)[::-1]))
    # one block of distance: the event may have begun within a quiet one
    ends = [slice(0, max(0, first - 1) * size), slice(min(BLOCKS, last + 1) * size, recording.n)]
    rules = [(LEAST, STEADY), (max(2 * LEAST, round(SETTLED_PART * recording.n)), SETTLED)]
    found = [_steady_part(signals, part, *rule, end=part is ends[1]) for part, rule in zip(ends, rules, strict=True)]
    return max((part for part in found if part is not None), key=lambda p: p.stop - p.start, default=None)


def _steady_part(signals: Floats, part: slice, least: int, limit: float, *, end: bool) -> slice | None:
    """The part, halved away from the event until both halves are alike; None if that leaves fewer than ``least`` samples."""
    while part.stop - part.start >= least:
        middle = (part.start + part.stop) // 2
        halves = [signals[a:b].std(axis=0) for a, b in ((part.start, middle), (middle, part.stop))]
        if (np.maximum(*halves) <= limit * np.minimum(*halves)).all():
            return part
        part = slice(middle, part.stop) if end else slice(part.start, middle)
    return None


def _same_channels(recording: Recording, noise_record: Recording) -> None:
    def labels(r: Recording) -> list[tuple[str, str, str]]:
        return [(c.name, c.location, c.quantity) for c in r.channels]

    if labels(recording) != labels(noise_record):
        raise ValueError(f"noise recording {noise_record.name!r} has channels {[c.name for c in noise_record.channels]}, "
                         f"recording {recording.name!r} has {[c.name for c in recording.channels]}; they must be the same")
    if abs(recording.dt / noise_record.dt - 1) > 1e-6:
        raise ValueError(f"noise recording {noise_record.name!r} has the rate {noise_record.fs:g} Hz, recording {recording.name!r} "
                         f"{recording.fs:g} Hz; they must be the same")
    if noise_record.n < 16:
        raise ValueError(f"noise recording {noise_record.name!r}: {noise_record.n} samples are too few, at least 16 are needed")


def _from_noise(recording: Recording, which: str) -> NoiseFloor:
    """From a record without excitation, or from half the square of what differs after a period."""
    if recording.period is None:
        return _from_stretch(recording, slice(0, recording.n), f"from {which} without excitation", "measured")
    t = recording.period
    differences = replace(recording, period=None, response=(recording.response[t:] - recording.response[:-t]) / np.sqrt(2),
                          force=(recording.force[t:] - recording.force[:-t]) / np.sqrt(2))
    how = f"from what differs between {differences.n} samples of {which} and the same ones a period later"
    return _from_stretch(differences, slice(0, differences.n), how, "measured")


def as_stated(floor: NoiseFloor, rms: Sequence[float | None]) -> NoiseFloor:
    """The floor with the channels whose noise is known from elsewhere: flat densities of the given rms (SI; None keeps what was found)."""
    known = [i for i, value in enumerate(rms) if value is not None]
    if not known:
        return floor
    psd = floor.psd.copy()
    psd[:, known] = [float(rms[i] or 0.0) ** 2 / floor.frequency[-1] for i in known]
    names = ", ".join(floor.channels[i].name for i in known)
    how = "as stated in the study" if len(known) == len(rms) else f"{names} as stated in the study; the others {floor.how}"
    return replace(floor, psd=psd, how=how, sure="measured" if len(known) == len(rms) else floor.sure)


def _from_stretch(recording: Recording, part: slice, how: str, sure: Sureness) -> NoiseFloor:
    """Averaged periodograms (P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70–73) of a stretch of noise."""
    f, psd = _averaged(recording.response[part], recording.dt)
    _, force = _averaged(recording.force[part], recording.dt)
    return NoiseFloor(f, psd, recording.channels, how, sure, force)


def _averaged(x: Floats, dt: float) -> tuple[Floats, Floats]:
    """Frequencies (f,) and densities (f, c) from half-overlapping Hann segments without their means."""
    size = max(16, min(len(x), 2 * (len(x) // (SEGMENTS + 1))))
    window = np.hanning(size + 2)[1:-1]
    starts = range(0, len(x) - size + 1, max(1, size // 2))
    total = np.zeros((size // 2 + 1, x.shape[1]))
    for start in starts:
        piece = x[start:start + size]
        total += np.abs(np.fft.rfft((piece - piece.mean(axis=0)) * window[:, None], axis=0)) ** 2
    psd = _one_sided(total * dt / (window @ window) / len(starts), size)
    psd[0] = psd[1]  # the mean was taken away
    return np.fft.rfftfreq(size, dt).astype(float), psd


def _one_sided(psd: Floats, size: int) -> Floats:
    """Doubled, except the mean and the Nyquist line."""
    psd[1:(size + 1) // 2] *= 2
    return psd


def _from_periods(recording: Recording) -> NoiseFloor:
    """Half the mean square of what differs between neighbouring periods, which a slow drift hardly enters."""
    period = int(recording.period or 0)
    f: Floats = np.fft.rfftfreq(period, recording.dt).astype(float)
    spectra = []
    for x in (recording.response, recording.force):
        lines = np.fft.rfft(x.reshape(recording.n // period, period, x.shape[1]), axis=1)
        raw = np.mean(np.abs(np.diff(lines, axis=0)) ** 2, axis=0) / 2 * recording.dt / period
        spectra.append(_one_sided(raw, period))
    count = recording.n // period
    width = max(1, int(np.ceil(DEGREES / (2 * (count - 1)))))
    smooth = [_moving_average(s, width | 1) for s in spectra]
    how = f"from the differences between {count} steady periods, averaged over {width | 1} lines"
    return NoiseFloor(f, smooth[0], recording.channels, how, "measured", smooth[1])


def _moving_average(x: Floats, width: int) -> Floats:
    """Centred moving average along the first axis, of fewer lines at the ends."""
    sums = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    i = np.arange(len(x))
    low, high = np.maximum(i - width // 2, 0), np.minimum(i + width // 2 + 1, len(x))
    return np.asarray(np.maximum(sums[high] - sums[low], 0) / (high - low)[:, None], dtype=float)


def _from_envelope(recording: Recording) -> NoiseFloor:
    """A low quantile of the periodogram in each neighbourhood, corrected for exponentially distributed lines of pure noise."""
    from scipy.ndimage import percentile_filter

    n, dt = recording.n, recording.dt
    # A force without a period, such as a sweep, fills its whole band: there no line is free of signal, and the level of the quietest part
    # of the spectrum is taken to hold everywhere. Between the lines of a multisine, and beside the resonances of a decay, noise shows.
    flat = not recording.free and recording.period is None
    window = np.ones(n) if recording.period is not None else np.hanning(n + 2)[1:-1]
    f = np.fft.rfftfreq(n, dt)
    out = []
    for x in (recording.response, recording.force):
        lines = np.abs(np.fft.rfft((x - x.mean(axis=0)) * window[:, None], axis=0)) ** 2 * dt / (window @ window)
        lines = _one_sided(lines, n)
        lines[0] = lines[min(2, len(lines) - 1)]
        size = min(NEIGHBOURS, len(f))
        low = lines.copy()
        for i in range(x.shape[1]):
            low[:, i] = percentile_filter(lines[:, i], 100 * LOW_QUANTILE, size=size, mode="nearest")
        level = low / -np.log1p(-LOW_QUANTILE)
        if flat:
            quiet = (f > 0) & (f < PASSED * f[-1])
            level = np.minimum(level, np.quantile(level[quiet], QUIET_PART, axis=0))
        out.append(level)
    every = max(1, min(NEIGHBOURS, len(f)) // 10)
    pick = np.unique(np.append(np.arange(0, len(f), every), len(f) - 1))
    envelope = f"the lower envelope of the spectrum ({100 * LOW_QUANTILE:.0f} % quantile of {NEIGHBOURS} lines)"
    how = (f"from the quietest quarter of {envelope}, taken to hold at all frequencies, because no part of the recording is quiet" if flat
           else f"from {envelope}, because no part of the recording is quiet; it holds the skirts of the signal")
    return NoiseFloor(f[pick], out[0][pick], recording.channels, how, "bound", out[1][pick])

