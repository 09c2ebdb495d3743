"""Parts of a recording: the free decay after an impact or a shut-off, and a part to fit beside a part to predict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.noise import noise_psd
from bayes_nlsid.recordings.recording import Recording, Role

OFF = 0.02       # of its largest value: a force below is off
DECAYED = 0.5    # the end of a decay must be below this part of its beginning
ABOVE_NOISE = 3.0  # the decay ends where its level is so many times the noise
LEVELS = 200     # blocks in which the level is looked at


def free_decay_window(recording: Recording, noise_record: Recording | None = None, role: Role | None = None) -> Recording:
    """The free decay in a recording.

    It begins when the measured force has fallen below 2 % of its largest value for good, or, where none was measured, when the level of
    the responses (each relative to its largest sample) is highest. It ends where every response has come down to three times its noise.

    Parameters
    ----------
    recording : Recording
    noise_record : Recording, optional
        For the noise floor.
    role : {"train", "holdout", "noise", "linear"}, optional
        Of the window; that of the recording by default.

    Returns
    -------
    Recording
        The window; a measured force stays in it, since a shaker that is shut off still holds on to the structure.

    Raises
    ------
    ValueError
        If there is no decay: steady periods, or a level that does not come down.
    """
    if recording.period is not None:
        raise ValueError(f"recording {recording.name!r} holds steady periods, not a decay; give an impact or a shut-off")
    if recording.n < 2 * LEVELS:
        raise ValueError(f"recording {recording.name!r} has {recording.n} samples, too few to look for a decay (at least {2 * LEVELS})")
    size = recording.n // LEVELS
    level, floor = _levels(recording, size), noise_psd(recording, noise_record).rms()
    begin = _begin(recording, level, size)
    first = min(-(-begin // size), len(level) - 1)
    above = np.flatnonzero((level[first:] > ABOVE_NOISE * floor).any(axis=1))
    last = first + (int(above[-1]) + 1 if above.size else 1)
    part = level[first:last]
    if len(part) < 4 or not (part[-1] < DECAYED * part[0])[part[0] > ABOVE_NOISE * floor].all():
        raise ValueError(f"recording {recording.name!r}: no free decay was found after {begin * recording.dt:.4g} s; "
                         "give the window yourself")
    window = recording.window(begin * recording.dt, min(recording.n, last * size) * recording.dt)
    return replace(window, name=f"{recording.name} decay", role=role or recording.role)


def split(recording: Recording, fraction: float = 0.5, gap: float = 0.0) -> tuple[Recording, Recording]:
    """A beginning to fit (role ``train``) and an end to predict (role ``holdout``).

    Parameters
    ----------
    recording : Recording
        Steady periods are split between periods.
    fraction : float
        Part of the recording, from its beginning, to fit.
    gap : float
        Time left out between the two, s; of periodic recordings rounded up to whole periods.

    Returns
    -------
    tuple of Recording

    Raises
    ------
    ValueError
        If one of the two would be empty.
    """
    if not (0 < fraction < 1 and np.isfinite(gap) and gap >= 0):
        raise ValueError(f"fraction {fraction} must lie between 0 and 1 and gap {gap} s must not be negative")
    unit = recording.period or 1
    middle = round(fraction * recording.n / unit) * unit
    after = middle + -(-round(gap / recording.dt) // unit) * unit
    if middle < max(2, unit) or recording.n - after < max(2, unit):
        raise ValueError(f"recording {recording.name!r}: nothing would be left on one side of {fraction:g} with a gap of {gap:g} s"
                         + (" between whole periods" if recording.period else ""))
    train, holdout = recording.window(0.0, middle * recording.dt), recording.window(after * recording.dt, recording.n * recording.dt)
    return replace(train, name=f"{recording.name} train", role="train"), replace(holdout, name=f"{recording.name} holdout", role="holdout")


def _levels(recording: Recording, size: int) -> NDArray[np.float64]:
    """Root mean square (blocks, s) of each block about the mean of the recording."""
    count = recording.n // size
    x = (recording.response - recording.response.mean(axis=0))[:count * size]
    return np.asarray(np.sqrt(np.mean(x.reshape(count, size, -1) ** 2, axis=1)), dtype=float)


def _begin(recording: Recording, level: NDArray[np.float64], size: int) -> int:
    """First sample of the decay."""
    if recording.inputs:
        largest = np.abs(recording.force).max(axis=0)
        on = (np.abs(recording.force) > OFF * np.where(largest > 0, largest, 1.0)).any(axis=1)
        return int(np.flatnonzero(on)[-1]) + 1 if on.any() else 0
    scale = np.where(level.max(axis=0) > 0, level.max(axis=0), 1.0)
    loudest = int(np.argmax(np.sum(level / scale, axis=1)))
    low, high = max(0, loudest - 1) * size, (loudest + 1) * size
    peaks = np.abs(recording.response[low:high] - recording.response.mean(axis=0)) / scale
    return low + int(np.argmax(peaks.max(axis=1)))
