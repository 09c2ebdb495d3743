"""From a description of a recording, as a study file gives it, to a `Recording` in SI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final, get_args

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.readers import Contents, read_file
from bayes_nlsid.recordings.recording import LEAST_REPEATED, SI_UNIT, Channel, Quantity, Recording, Role
from bayes_nlsid.recordings.units import to_si, unit_factor

SAME_RATE = 1e-3  # relative difference at which a stated rate contradicts a time array


@final
@dataclass(frozen=True)
class ChannelSpec:
    """One channel of a file.

    Parameters
    ----------
    array : str
        Name of the array; dotted for nested structs.
    quantity : {"acceleration", "velocity", "displacement", "force"}
        A force becomes an input, anything else a response.
    unit : str
        Unit in the file; empty to take the one written beside the name of the column.
    location : str
        Location of the model.
    name : str
        As the test engineer calls it; the location if empty.
    column : int, optional
        Column (from 0) of an array with several.
    polarity : {1, -1}
    per_volt : float, optional
        For a unit of voltage: SI units of the quantity for one volt; 1.0 declares that the volt itself stands in for them.
    offset : float
        What the channel reads at rest, in the unit of the file; taken from every sample.
    noise : float, optional
        Root mean square of the sensor's noise where it is known, SI; 0 for a simulation.

    Raises
    ------
    InputError
        If anything is not of this kind.
    """

    array: str
    quantity: Quantity
    unit: str
    location: str
    name: str = ""
    column: int | None = None
    polarity: int = 1
    per_volt: float | None = None
    offset: float = 0.0
    noise: float | None = None

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.location)
        where = f"channel {self.name!r}"
        if self.quantity not in SI_UNIT:
            raise InputError(where, f"quantity {self.quantity!r} is unknown", f"give one of {', '.join(SI_UNIT)}")
        if self.polarity not in (1, -1):
            raise InputError(where, f"polarity is {self.polarity!r}", "give 1 or -1")
        if self.column is not None and (isinstance(self.column, bool) or not isinstance(self.column, int) or self.column < 0):
            raise InputError(where, f"column is {self.column!r}", "count columns from 0")
        if self.per_volt is not None and not (_is_number(self.per_volt) and self.per_volt != 0):
            raise InputError(where, f"per_volt is {self.per_volt!r}", "give a finite sensitivity other than zero")
        if not _is_number(self.offset):
            raise InputError(where, f"offset is {self.offset!r}", "give a finite number in the unit of the file")
        if self.noise is not None and not (_is_number(self.noise) and self.noise >= 0):
            raise InputError(where, f"noise is {self.noise!r}", "give its rms in SI, zero or more")


@final
@dataclass(frozen=True)
class RecordingSpec:
    """One recording in a file.

    Parameters
    ----------
    file : str
        Path.
    name : str
    channels : tuple of ChannelSpec
    role : {"train", "holdout", "noise", "linear"}
    rate : float or str, optional
        Sampling rate, Hz, or the name of the array that holds it.
    time : str, optional
        Name of the array of times; checked for a constant step. One of ``rate`` and ``time`` is needed.
    time_unit : str
        Empty for the one written beside the name of the column, or s.
    window : tuple of float, optional
        (start, stop), s from the first sample: the part to read.
    period : int, optional
        Samples per period, if what is read is whole steady periods. For the role ``noise``: after how many samples the signal repeats
        but for noise; the window may then end within a period.
    start : float, optional
        When it was taken on the test day, s; by default the first time, or 0.

    Raises
    ------
    InputError
        If anything is not of this kind.
    """

    file: str
    name: str
    channels: tuple[ChannelSpec, ...]
    role: Role = "train"
    rate: float | str | None = None
    time: str | None = None
    time_unit: str = ""
    window: tuple[float, float] | None = None
    period: int | None = None
    start: float | None = None

    def __post_init__(self) -> None:
        where = f"recording {self.name!r}"
        object.__setattr__(self, "file", str(self.file))
        object.__setattr__(self, "channels", tuple(self.channels))
        if self.role not in get_args(Role):
            raise InputError(where, f"role {self.role!r} is unknown", f"give one of {', '.join(get_args(Role))}")
        if self.rate is None and self.time is None:
            raise InputError(where, "neither a rate nor a time array is given", "give rate in Hz, or the name of the time array")
        if not isinstance(self.rate, str) and self.rate is not None and not (_is_number(self.rate) and self.rate > 0):
            raise InputError(where, f"rate is {self.rate!r}", "give a positive number of Hz")
        if all(c.quantity == "force" for c in self.channels):
            raise InputError(where, "no response channel is given", "name at least one acceleration, velocity or displacement")
        names = [c.name for c in self.channels]
        if len(set(names)) != len(names):
            raise InputError(where, f"channel name {next(n for n in names if names.count(n) > 1)!r} stands twice", "give each its own name")
        if self.window is not None and not (len(self.window) == 2 and all(map(_is_number, self.window))
                                            and 0 <= self.window[0] < self.window[1]):
            raise InputError(where, f"window is {self.window!r}", "give [start, stop] in seconds from the first sample, start below stop")
        if self.period is not None and (isinstance(self.period, bool) or not isinstance(self.period, int) or self.period < 2):
            raise InputError(where, f"period is {self.period!r}", "give a whole number of samples, at least 2")


def read_recording(spec: RecordingSpec) -> Recording:
    """Read, cut, convert to SI and check one recording.

    Parameters
    ----------
    spec : RecordingSpec

    Returns
    -------
    Recording

    Raises
    ------
    InputError
        If the file cannot be read, an array or column is missing, lengths differ, time is not uniform, a unit does not fit, or
        samples are missing; says which and how to mend it.
    """
    contents = read_file(spec.file)
    where = f"{spec.file}: recording {spec.name!r}"
    columns = [_column(contents, c, where) for c in spec.channels]
    lengths = {c.name: len(x) for c, x in zip(spec.channels, columns, strict=True)}
    time = None if spec.time is None else _time(contents, spec, where)
    if time is not None:
        lengths["time"] = len(time)
    if len(set(lengths.values())) > 1:
        raise InputError(where, f"lengths differ: {', '.join(f'{k} {v}' for k, v in lengths.items())}", "give arrays of one length")
    rate = _scalar(contents, spec.rate, where) if isinstance(spec.rate, str) else spec.rate
    part = _part(spec, next(iter(lengths.values())), time, rate, where)
    dt = _dt(time, rate, part, where)
    samples = [_samples(contents, c, x, part, dt, where) for c, x in zip(spec.channels, columns, strict=True)]
    _check_period(spec, part.stop - part.start, where)
    groups = {kind: [i for i, c in enumerate(spec.channels) if (c.quantity == "force") == kind] for kind in (False, True)}
    stacked = {kind: np.stack([samples[i] for i in index], axis=1) if index else np.zeros((part.stop - part.start, 0))
               for kind, index in groups.items()}
    labels = {kind: tuple(_channel(contents, spec.channels[i]) for i in index) for kind, index in groups.items()}
    first = float(time[0]) if time is not None else 0.0
    return Recording(spec.name, dt, stacked[False], labels[False], stacked[True], labels[True], spec.role, spec.period,
                     (first if spec.start is None else spec.start) + part.start * dt, spec.file, contents.sha256, _notes(spec))


def _check_period(spec: RecordingSpec, n: int, where: str) -> None:
    if spec.period is None:
        return
    if spec.role == "noise" and n < spec.period + LEAST_REPEATED:
        raise InputError(where, f"{n} samples hold no {LEAST_REPEATED} that repeat after {spec.period}",
                         "give a longer window, or no period if the excitation is off")
    if spec.role != "noise" and n % spec.period:
        raise InputError(where, f"{n} samples are not a whole number of periods of {spec.period}",
                         "give a window of whole periods, or no period")


def _time(contents: Contents, spec: RecordingSpec, where: str) -> NDArray[np.float64]:
    """The time array (n,) in s."""
    name = spec.time or ""
    written = contents.units.get(name, "")
    unit = spec.time_unit or written or "s"
    if written and unit_factor(written, "time") != unit_factor(unit, "time"):
        raise InputError(where, f"time_unit {unit!r} contradicts {written!r} written in the file", "give the right one")
    values = to_si(_vector(contents, name, where), unit, "time")
    if len(values) < 2 or not np.isfinite(values[0]):
        raise InputError(where, f"time array {name!r} does not start with a finite number", "give the rate instead of the time array")
    return values


def _dt(time: NDArray[np.float64] | None, rate: float | None, part: slice, where: str) -> float:
    """Time step in s from the rate, the time array, or both if they agree."""
    if time is None:
        assert rate is not None  # the specification was checked
        return 1 / rate
    step = _step(time[part], part.start, where)
    if rate is not None and abs(step * rate - 1) > SAME_RATE:
        raise InputError(where, f"rate {rate:g} Hz contradicts the time array, which runs at {1 / step:g} Hz", "give only one of them")
    return step if rate is None else 1 / rate


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _channel(contents: Contents, spec: ChannelSpec) -> Channel:
    return Channel(spec.name, spec.location, spec.quantity, spec.unit or contents.units.get(spec.array, ""), spec.polarity)


def _notes(spec: RecordingSpec) -> tuple[str, ...]:
    return tuple(f"channel {c.name!r}: volts stand in for {SI_UNIT[c.quantity]}" for c in spec.channels if c.per_volt == 1.0)


def _find(contents: Contents, name: str, where: str) -> NDArray[np.generic]:
    if name in contents.unusable:
        raise InputError(where, f"array {name!r} holds {contents.unusable[name]}, not real numbers", "store it as plain numbers")
    if name not in contents.arrays:
        shown = [f"{k} {v.shape}" for k, v in list(contents.arrays.items())[:20]]
        more = f" and {len(contents.arrays) - 20} more" if len(contents.arrays) > 20 else ""
        raise InputError(where, f"array {name!r} is not in the file", f"it holds {', '.join(shown)}{more}")
    return contents.arrays[name]


def _vector(contents: Contents, name: str, where: str) -> NDArray[np.float64]:
    array = np.squeeze(_find(contents, name, where))
    if array.ndim != 1:
        raise InputError(where, f"array {name!r} has shape {array.shape}", "it must be one column")
    return np.asarray(array, dtype=float)


def _scalar(contents: Contents, name: str, where: str) -> float:
    value = _find(contents, name, where)
    if value.size != 1 or not (np.isfinite(float(value.ravel()[0])) and float(value.ravel()[0]) > 0):
        raise InputError(where, f"array {name!r} of shape {value.shape} is no sampling rate", "it must be one positive number, Hz")
    return float(value.ravel()[0])


def _column(contents: Contents, spec: ChannelSpec, where: str) -> NDArray[np.float64]:
    """The samples (n,) of a channel as stored; an array with fewer rows than columns is taken as one channel a row."""
    array = _find(contents, spec.array, where)
    array = np.squeeze(array) if array.ndim != 2 else array
    if array.ndim == 2 and 1 in array.shape and spec.column in (None, 0):
        array = array.ravel()
    if array.ndim == 1 and spec.column in (None, 0):
        return np.asarray(array, dtype=float)
    if array.ndim not in (1, 2):
        raise InputError(f"{where}, channel {spec.name!r}", f"array {spec.array!r} has shape {array.shape}", "give samples by channels")
    count = min(array.shape) if array.ndim == 2 else 1
    if spec.column is None:
        raise InputError(f"{where}, channel {spec.name!r}", f"array {spec.array!r} has {count} columns", f"give column = 0 to {count - 1}")
    if spec.column >= count:
        raise InputError(f"{where}, channel {spec.name!r}", f"array {spec.array!r} has no column {spec.column}",
                         f"count from 0, the last is {count - 1}")
    return np.asarray(array[:, spec.column] if array.shape[0] >= array.shape[1] else array[spec.column], dtype=float)


def _part(spec: RecordingSpec, n: int, time: NDArray[np.float64] | None, rate: float | None, where: str) -> slice:
    """Samples of the window."""
    if n < 2:
        raise InputError(where, f"holds {n} samples", "give a longer recording")
    if spec.window is None:
        return slice(0, n)
    start, stop = spec.window
    if time is None:
        assert rate is not None  # the specification was checked
        i, j = (round(min(t * rate, 2.0 * n)) for t in (start, stop))
        length = n / rate
    else:
        since = time - time[0]
        half = 0.5 * float(np.nanmedian(np.abs(np.diff(time))))
        length = float(np.nanmax(since)) + 2 * half
        late = [since >= t - half for t in (start, stop)]
        i, j = (int(np.argmax(x)) if x.any() else n for x in late)
        j = j if stop <= length + half else n + 1
    if i >= n - 1 or j > n or j - i < 2:
        raise InputError(where, f"window {start:g} to {stop:g} s does not lie within the {length:g} s of the recording",
                         "move the window")
    return slice(i, j)


def _step(time: NDArray[np.float64], first: int, where: str) -> float:
    """The constant step of a time array, after it was checked sample by sample."""
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise InputError(where, f"time is missing at sample {first + bad[0]}",
                         "give the rate instead of the time array, or a window without it")
    steps = np.diff(time)
    usual = float(np.median(steps))
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        raise InputError(where, f"time {'repeats' if steps[i] == 0 else 'runs backward'} after sample {first + i} (t = {time[i]:g} s)",
                         "sort the samples, give a window without it, or the rate instead of the time array")
    if (steps > 1.6 * usual).any():
        i = int(np.argmax(steps > 1.6 * usual))
        count = max(1, round(steps[i] / usual) - 1)
        raise InputError(where, f"about {count} samples are missing after sample {first + i} (t = {time[i]:g} s)",
                         "give a window without the gap")
    step = float(time[-1] - time[0]) / (len(time) - 1)
    off = np.abs(time - time[0] - step * np.arange(len(time)))
    if off.max() > 0.6 * step:  # rounding of printed times stays below this
        i = int(np.argmax(off))
        raise InputError(where, f"the time step is not constant (at sample {first + i} time is {off[i] / step:.2g} steps off)",
                         "resample the recording to a constant rate")
    return step


def _samples(contents: Contents, spec: ChannelSpec, values: NDArray[np.float64], part: slice, dt: float, where: str) -> NDArray[np.float64]:
    """One channel in SI with its polarity applied, every sample finite."""
    place = f"{where}, channel {spec.name!r}"
    written = contents.units.get(spec.array, "")
    unit = spec.unit or written
    if not unit:
        raise InputError(place, "no unit is given", "write unit = ...")
    try:
        volts = _is_voltage(unit)
        if spec.per_volt is not None and not volts:
            raise InputError(place, f"per_volt is given, but the unit is {unit!r}", "give unit V or mV, or drop per_volt")
        if volts and spec.per_volt is None:
            raise InputError(place, f"volts are no {spec.quantity}",
                             f"give per_volt, the {SI_UNIT[spec.quantity]} for one volt (1.0 if the volt stands in for it)")
        quantity = "voltage" if volts else spec.quantity
        factor = unit_factor(unit, quantity) * (spec.per_volt or 1.0)
        if written and spec.unit and abs(unit_factor(written, quantity) / unit_factor(unit, quantity) - 1) > 1e-9:
            raise InputError(place, f"unit {spec.unit!r} contradicts {written!r} written in the file", "give the right one")
    except InputError as error:
        if error.where == place:
            raise
        raise InputError(f"{place}, {error.where}", error.problem, error.mend) from error
    taken = values[part]
    bad = np.flatnonzero(~np.isfinite(taken))
    if bad.size:
        good = _longest_good(taken)
        mend = (f"give window = [{(part.start + good[0]) * dt:.6g}, {(part.start + good[1]) * dt:.6g}], or drop the channel"
                if good[1] - good[0] > 1 else "drop the channel")
        raise InputError(place, f"{bad.size} samples are missing or infinite, the first is sample {part.start + bad[0]} "
                         f"(t = {(part.start + bad[0]) * dt:g} s)", mend)
    return np.asarray(spec.polarity * factor * (taken - spec.offset), dtype=float)


def _is_voltage(unit: str) -> bool:
    try:
        unit_factor(unit, "voltage")
    except InputError:
        return False
    return True


def _longest_good(values: NDArray[np.float64]) -> tuple[int, int]:
    """(start, stop) of the longest stretch of finite samples."""
    bad = np.concatenate([[-1], np.flatnonzero(~np.isfinite(values)), [len(values)]])
    i = int(np.argmax(np.diff(bad)))
    return int(bad[i]) + 1, int(bad[i + 1])
