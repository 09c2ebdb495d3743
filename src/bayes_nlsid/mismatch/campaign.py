"""Recordings of any kind beside a linear model: forced or free, one channel or many, one record or several.

This is what the mismatch engine for general recordings works on. It is made from a study, or from a case folder whose records are not
periodic, and holds nothing nonlinear: the model is the linear one that is claimed to be right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.filtering import extended, predicted, smooth_step
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
Use = Literal["fit", "judge", "sealed", "noise"]
RIGID = 1e-3
"""rad/s: below it a mode is a rigid-body mode, whose stiffness is taken as zero."""
PASS = 0.3       # upper end of the analysed band over the sampling rate, at most
COARSE = 0.18    # the same after decimation: splines between coarser samples would bend the forces by some per cent
AT_REST = 0.02   # of the largest force, below which there is none
ROLL = 1.6       # upper end of what the low-pass lets through in part, over the upper end of the band
LINES, OUTSTANDING = 400, 4.0   # bands in which a spectrum is held against its floor, and what stands out of it
MOST = 240_000   # samples times channels that are analysed


@final
@dataclass(frozen=True, eq=False)
class Trial:
    """One recording as the analysis uses it.

    Parameters
    ----------
    recording : Recording
        Low-passed to ``top`` and decimated.
    use : {"fit", "judge", "sealed", "noise"}
        ``judge``: never fitted; ``sealed``: only the force is known, the response is to be predicted (its samples are zero).
    noise : ndarray (s,)
        Standard deviation of the sensor noise in the analysed band, in the units of the channels.
    floor : str
        How the noise was got, in a sentence.
    level : float
        rms of the force, or of the response of a free decay: what makes records louder or quieter.
    bound : bool
        The noise may be less than stated.
    """

    recording: Recording
    use: Use
    noise: Array
    floor: str
    level: float
    bound: bool = True

    def __post_init__(self) -> None:
        if self.noise.shape != (len(self.recording.channels),):
            raise ValueError(f"trial {self.recording.name!r}: noise has shape {self.noise.shape}, expected one per channel")

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.recording.name


@final
@dataclass(frozen=True, eq=False)
class Campaign:
    """Linear model and recordings.

    Parameters
    ----------
    name : str
    nominal, start : ModalModel
        As delivered; and where calibration starts, which may have been updated to modes measured at low level. Rigid-body modes stand
        in them with a frequency below `RIGID`.
    trials : tuple of Trial
    places : tuple of str
        Locations where a force may be missing.
    classes : tuple of str
        Vocabulary of the answer.
    tolerances : dict of str to float
        ``frequency`` and ``damping``, one relative standard deviation each, and ``gain``.
    mains : float
        Hz.
    top : float
        Hz up to which the records are analysed.
    notes : tuple of str
        What was wrong with the data, what was lost and what cannot be tested.
    """

    name: str
    nominal: ModalModel
    start: ModalModel
    trials: tuple[Trial, ...]
    places: tuple[str, ...]
    classes: tuple[str, ...]
    tolerances: dict[str, float] = field(default_factory=dict)
    mains: float = 50.0
    top: float = 0.0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not any(t.use == "fit" for t in self.trials):
            raise ValueError("a campaign needs at least one record to fit")
        self.start.rows(self.places)

    def used(self, use: Use) -> tuple[Trial, ...]:
        """Trials of one use."""
        return tuple(t for t in self.trials if t.use == use)


def decimated(recording: Recording, top: float, bottom: float = 0.0) -> Recording:
    """The recording low-passed at ``top`` (Hz) and sampled as coarsely as that allows; unchanged if it is sampled coarsely already.

    ``bottom`` (Hz) above zero takes slow motion off too. The filter has no phase; a transient is continued beyond its ends first.
    """
    step = int(np.floor(COARSE * recording.fs / top + 1e-9))
    periodic = recording.period is not None
    while periodic and step > 1 and (recording.period or 1) % step:
        step -= 1
    if step <= 1 and bottom <= 0:
        return recording
    stop = min(0.48 * recording.fs / max(step, 1), ROLL * top)
    signals = np.concatenate([recording.response, recording.force], axis=1)
    n = len(signals)
    far = 0 if periodic else min(n - 1, int(16 * recording.fs / (min(top, 4 * bottom) if bottom > 0 else top)))
    padded = _continued(signals, far) if far else signals
    f = np.asarray(np.fft.rfftfreq(len(padded), recording.dt), dtype=np.float64)
    gain = 1 - smooth_step(f, min(top, 0.99 * stop), stop)
    if bottom > 0:
        gain = gain * smooth_step(f, 0.5 * bottom, bottom)
    step = max(step, 1)
    low = np.fft.irfft(np.fft.rfft(padded, axis=0) * gain[:, None], n=len(padded), axis=0)[far:far + n][::step]
    low = low[:n // step] if periodic else low
    s = recording.response.shape[1]
    return replace(recording, dt=recording.dt * step, response=low[:, :s], force=low[:, s:],
                   period=None if recording.period is None else recording.period // step)


def alive(recording: Recording) -> tuple[Recording, Recording | None]:
    """A transient without its quiet end, and that end, which shows the noise; the whole and None where it has not died away."""
    whole = recording.n * recording.dt
    blocks = np.array_split(recording.response - recording.response[-(recording.n // 20 + 1):].mean(axis=0), 40)
    loud = np.array([np.sqrt(np.mean((b / np.maximum(np.abs(recording.response).max(axis=0), 1e-300)) ** 2)) for b in blocks])
    quiet = np.median(loud[-5:])
    living = np.flatnonzero(loud > 4 * quiet)
    # dead at the end: no more change there, and far below the beginning
    if not living.size or living[-1] >= 35 or loud.max() <= 20 * quiet or loud[-5:].max() >= 2.5 * loud[-5:].min():
        return recording, None
    after = recording.force[int((living[-1] + 3) / 40 * recording.n):]
    if recording.force.size and np.abs(after).max(initial=0.0) > AT_REST * np.abs(recording.force).max():
        return recording, None   # a sweep that has passed the resonance is not quiet
    return recording.window(0.0, (living[-1] + 1) / 40 * whole), recording.window((living[-1] + 3) / 40 * whole, whole)


def parted(recording: Recording, share: float) -> tuple[Recording, Recording, Recording | None]:
    """A record in time: what is fitted, what judges, and a quiet end, where a transient has died away, that shows the noise.

    Without the last step the end of a decay would judge every model by noise alone. The loudest motion is fitted: where it comes late,
    as in a sweep, the beginning judges.
    """
    living, rest = alive(recording)
    whole = living.n * living.dt
    level = np.abs(living.response - living.response.mean(axis=0)) / np.maximum(living.response.std(axis=0), 1e-300)
    loudest = int(np.argmax([np.mean(b ** 2) for b in np.array_split(level, 20)]))
    if not living.free and loudest >= 20 * share:
        return living.window((1 - share) * whole, whole), living.window(0.0, (1 - share) * whole), rest
    return living.window(0.0, share * whole), living.window(share * whole, whole), rest


def _continued(signals: Array, far: int) -> Array:
    """A transient beyond its ends: by linear prediction where it is long enough, else by its mirror image."""
    order = min(400, len(signals) // 8)
    return predicted(signals, far, far, order) if order >= 16 else extended(signals, far, far, True)


def energetic_band(model: ModalModel, recordings: Sequence[Recording], share: float = 0.998) -> float:
    """Upper end (Hz) of the band that holds ``share`` of the motion, with the modes it needs, below what the slowest clock allows.

    Motion is taken as velocity, so that neither the few high modes of an accelerometer nor the drift of a displacement decide alone.
    """
    edge = 0.5
    for r in recordings:
        f = np.fft.rfftfreq(r.n, r.dt)
        window = np.hanning(r.n + 2)[1:-1]
        for column, channel in zip([*r.response.T, *r.force.T], [*r.channels, *r.inputs], strict=True):
            order = {"displacement": 1, "velocity": 0, "acceleration": -1, "force": 0}[channel.quantity]
            power = np.abs(np.fft.rfft((column - column.mean()) * window)) ** 2
            weight = np.where(f > 0.2 * max(float(model.frequency[0]), 4 / (r.n * r.dt)), np.maximum(f, 1e-12) ** (2 * order), 0.0)
            # white noise is amplified by differentiation: what hardly stands out of the upper half, over some lines, is no signal
            lines = max(1, len(power) // LINES)
            smooth = np.convolve(power, np.ones(lines) / lines, mode="same")
            floor = float(np.median(smooth[len(smooth) // 2:]))
            power = np.where(smooth > OUTSTANDING * floor, np.maximum(power - floor, 0.0), 0.0) * weight
            if power.sum() > 0:
                edge = max(edge, float(f[np.searchsorted(np.cumsum(power) / power.sum(), share)]))
    clock = min(r.fs for r in recordings)
    elastic = model.frequency[model.omega > RIGID]
    if elastic.size:
        above = elastic[elastic >= 0.8 * edge]
        needed = above[0] if above.size and above[0] < 1.3 * edge else elastic[max(0, int(np.searchsorted(elastic, edge)) - 1)]
        edge = max(edge, 1.5 * float(needed))
    edge = max(1.2 * edge, 3 * float(elastic[0]) if elastic.size else 0.0)
    return float(min(edge, PASS * clock))


def lower_edge(model: ModalModel, recordings: Sequence[Recording], stated: float = 0.0) -> float:
    """Hz below which the records are not analysed: 0, or what keeps motion out that the model does not have.

    That is the stated edge where it lies close below the first elastic mode, and four tenths of that mode for accelerations of a free
    decay (a suspension swings under most of them), unless the model has rigid bodies.
    """
    elastic = model.frequency[model.omega > RIGID]
    if not elastic.size or elastic.size < model.modes:
        return 0.0
    first = float(elastic[0])
    edge = stated if 0.3 * first <= stated < first else 0.0
    if all(r.free and {c.quantity for c in r.channels} == {"acceleration"} for r in recordings):
        edge = max(edge, 0.4 * first)
    return float(edge)


def in_band(model: ModalModel, top: float, most: int = 16) -> ModalModel:
    """The model with the modes below ``top`` only (at least one)."""
    inside = np.flatnonzero(model.frequency <= top)
    return model.take(inside[:most] if inside.size else [0])


def make_trial(recording: Recording, use: Use, top: float, floor: NoiseFloor | None, most: int,
               bottom: float = 0.0) -> Trial:
    """Filter, decimate and, where a record is very long, cut to ``most`` samples (of those to be fitted)."""
    small = decimated(recording, top, bottom)
    if use == "fit" and small.n > most:
        period = small.period
        keep = max(period, most // period * period) if period else most
        small = small.window(0.0, keep * small.dt)
    noise = np.zeros(len(recording.channels)) if floor is None else floor.rms((bottom, min(top, float(floor.frequency[-1]))))
    if floor is not None and floor.sure == "bound":
        noise = np.minimum(noise, _above_the_band(recording, top))
    loud = small.force if small.force.shape[1] and np.abs(small.force).any() else small.response
    return Trial(small, use, noise, "" if floor is None else floor.how, float(np.sqrt(np.mean(np.square(loud - loud.mean(axis=0))))),
                 floor is None or floor.sure == "bound")


def _above_the_band(recording: Recording, top: float) -> Array:
    """Standard deviation (s,) of white noise of the level seen just above the analysed band; inf where the clock shows nothing there."""
    f = np.fft.rfftfreq(recording.n, recording.dt)
    above = (f > 1.1 * top) & (f < min(2.5 * top, 0.47 * recording.fs))
    if above.sum() < 16:
        return np.full(len(recording.channels), np.inf)
    window = np.ones(recording.n) if recording.period is not None else np.hanning(recording.n + 2)[1:-1]
    signal = recording.response - recording.response.mean(axis=0)
    psd = 2 * recording.dt * np.abs(np.fft.rfft(signal * window[:, None], axis=0)[above]) ** 2 / (window @ window)
    # the median of an exponential variable is ln 2 of its mean
    return np.asarray(np.sqrt(np.median(psd, axis=0) / np.log(2) * top))


def campaign_notes(trials: tuple[Trial, ...], noise_record: bool) -> list[str]:
    """What these records do not allow to be tested, one sentence each."""
    out = []
    fit = [t for t in trials if t.use == "fit"]
    if not noise_record:
        out.append(f"No record without excitation: the noise floor was taken {fit[0].floor}.")
    if all(t.recording.free for t in fit):
        out.append("Free decays without a measured force: gain and delay of a force cell, added mass and the scale of forces against the "
                   "model's mass cannot be tested; forces are relative to the model's modal mass.")
    levels = {round(float(np.log2(max(t.level, 1e-300))), 1) for t in fit}
    if len(levels) < 2 and not all(t.recording.free for t in fit):
        out.append("One level only: growth with amplitude is seen within the record, not between records.")
    if not any(t.recording.period is not None and t.recording.n // t.recording.period > 1 for t in fit):
        out.append("No repeated period: the scatter between periods, and even and odd distortions, cannot be tested.")
    if len(fit) < 2:
        out.append("A single record: a drift over the test day cannot be told from an effect that changes within the record.")
    return out
