"""What files hold, as far as it can be told without being told: recordings with their clock and channels, matrices, tables, modes."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.readers import Contents, read_file
from bayes_nlsid.recordings.units import unit_factor
from bayes_nlsid.structure.matrix_files import FORMATS, SEVERAL

Kind = Literal["recording", "archive", "mass", "stiffness", "damping", "matrices", "locations", "modes"]
_TIME = re.compile(r"(.*\.)?(t|time|zeit|temps|x_values)( of .*)?", re.IGNORECASE)
_RATE = re.compile(r"(.*[._])?(fs|rate|sampling_?rate|sample_?rate|sampling_?frequency|f_?s_?hz|fs_hz)( of .*)?", re.IGNORECASE)
_QUANTITY = (("force", r"force|load|^f\d*$|kraft|drive|shaker"), ("acceleration", r"acc|^a\d*$|^s\d+$|beschl|ddot|response|^y\d*$"),
             ("velocity", r"vel|^v\d*$|laser|ldv"), ("displacement", r"disp|^[xqzuw]\d*$|weg|lvdt"))
_FEW = 16  # samples below which an array is no signal


@final
@dataclass(frozen=True)
class Signal:
    """One channel that was found.

    Parameters
    ----------
    array : str
    column : int or None
    quantity : str
        Empty if nothing tells it.
    unit : str
        As written in the file; empty if it is not.
    why : str
        What the guess of the quantity rests on.
    rms : float
        In the unit of the file, mean removed.
    """

    array: str
    column: int | None
    quantity: str
    unit: str
    why: str
    rms: float


@final
@dataclass(frozen=True)
class RecordingFound:
    """A file with signals. ``clock`` is ``("rate", name)``, ``("time", name)`` or None; ``rate`` in Hz where it could be read."""

    path: Path
    clock: tuple[str, str] | None
    rate: float | None
    samples: int
    signals: tuple[Signal, ...]
    peak: tuple[float, float, float] | None  # Hz: strongest line of the strongest response, and the band that holds 99 % of it


def kind_of(path: Path) -> tuple[Kind, Contents | None]:
    """What a file is for, and its contents where they had to be read to tell.

    Raises
    ------
    InputError
        If it cannot be read, or is nothing that a study is made of.
    """
    suffix, stem = path.suffix.lower(), path.stem.lower()
    if path.is_dir():
        raise InputError(str(path), "is a folder", "name the files in it")
    if not path.is_file():
        raise InputError(str(path), "there is no such file", "check the path")
    if suffix == ".toml":
        return "locations", None
    if suffix in SEVERAL:
        return "matrices", None
    if suffix in FORMATS:
        if re.search(r"damp|(^|[_\-.])[bc]\d*$", stem):
            return "damping", None
        return ("stiffness" if re.search(r"stif|(^|[_\-.\d])k(aa|gg|xx|mat)?\d*$", stem) else "mass"), None
    if suffix in (".csv", ".txt", ".tsv"):
        head = _header(path)
        if {"name", "dof", "coefficient"} <= head:
            return "locations", None
        if {"frequency", "damping"} <= head:
            return "modes", None
    if suffix in (".uff", ".unv", ".uf") and _only_modes(path):
        return "modes", None
    contents = read_file(path)
    names = set(contents.arrays)
    if {"M", "K"} <= names and contents.arrays["M"].ndim == 2:
        return "archive", contents
    return ("locations" if "location_vectors" in names else "recording"), contents


def _header(path: Path) -> set[str]:
    """Names in the first line of a table, without units."""
    with path.open("rb") as file:
        line = next((raw for raw in file.read(4096).decode("utf-8-sig", errors="replace").splitlines()
                     if raw.strip() and not raw.startswith(("#", "%"))), "")
    separator = next((s for s in ("\t", ";", ",") if s in line), ",")
    return {re.sub(r"\s*[\[(].*", "", cell).strip().lower() for cell in next(csv.reader(io.StringIO(line), delimiter=separator), [])}


def _only_modes(path: Path) -> bool:
    from bayes_nlsid.recordings.isolation import Unreadable
    from bayes_nlsid.recordings.universal import datasets

    try:
        kinds = {e.kind for e in datasets(path.read_bytes())}
    except (Unreadable, OSError):
        return False
    return 55 in kinds and 58 not in kinds


def survey_recording(path: Path, contents: Contents) -> RecordingFound:
    """Clock, channels and spectrum of a file with signals.

    Raises
    ------
    InputError
        If nothing in it is long enough to be a signal.
    """
    lengths = [max(a.shape) for a in contents.arrays.values() if a.ndim in (1, 2) and a.size >= _FEW]
    if not lengths:
        raise InputError(str(path), f"holds no array of {_FEW} samples or more", "give a file with time records")
    samples = max(set(lengths), key=lengths.count)
    clock, rate = _clock(contents, samples)
    signals = []
    for name, array in contents.arrays.items():
        values = np.squeeze(array)
        clockwork = _TIME.fullmatch(name) or _RATE.fullmatch(name)
        if clockwork or values.ndim not in (1, 2) or values.size < _FEW or max(values.shape) != samples:
            continue
        columns = [values] if values.ndim == 1 else list(values.T if values.shape[0] >= values.shape[1] else values)
        for i, column in enumerate(columns):
            signals.append(_signal(contents, name, None if values.ndim == 1 else i, np.asarray(column, dtype=float)))
    return RecordingFound(path, clock, rate, samples, tuple(signals), _peak(contents, signals, rate))


def _clock(contents: Contents, samples: int) -> tuple[tuple[str, str] | None, float | None]:
    """The array that holds the rate, or the one that holds the times."""
    for name, array in contents.arrays.items():
        if _RATE.fullmatch(name) and array.size == 1 and float(array.ravel()[0]) > 0:
            return ("rate", name), float(array.ravel()[0])
    for name, array in contents.arrays.items():
        if _TIME.fullmatch(name) and array.size == samples:
            unit = unit_factor(contents.units[name], "time") if _measures(contents, name, "time") else 1.0
            time = unit * np.asarray(array, dtype=float).ravel()
            usual, whole = float(np.median(np.diff(time))), float(time[-1] - time[0]) / (samples - 1)
            step = whole if abs(whole - usual) < 0.01 * usual else usual  # printed times are rounded; a gap would spoil the whole
            return ("time", name), 1 / step if step > 0 else None
    return None, None


def _measures(contents: Contents, name: str, quantity: str) -> bool:
    try:
        unit_factor(contents.units.get(name, ""), quantity)
    except InputError:
        return False
    return True


def _signal(contents: Contents, name: str, column: int | None, values: NDArray[np.float64]) -> Signal:
    unit = contents.units.get(name, "")
    rms = float(np.std(values[np.isfinite(values)])) if np.isfinite(values).any() else 0.0
    if name in contents.quantities:
        return Signal(name, column, contents.quantities[name], unit, "the file says so", rms)
    for quantity in ("acceleration", "velocity", "displacement", "force"):
        if _measures(contents, name, quantity):
            return Signal(name, column, quantity, unit, f"its unit is {unit}", rms)
    last = name.rpartition(".")[2]
    for quantity, pattern in _QUANTITY:
        if re.search(pattern, last, re.IGNORECASE):
            return Signal(name, column, quantity, unit, f"it is called {last}", rms)
    return Signal(name, column, "", unit, "", rms)


def _peak(contents: Contents, signals: Sequence[Signal], rate: float | None) -> tuple[float, float, float] | None:
    """Hz: where the strongest response is strongest, and between which frequencies 99 % of its power lies."""
    responses = [s for s in signals if s.quantity and s.quantity != "force"]
    if rate is None or not responses:
        return None
    values = samples_of(contents, max(responses, key=lambda s: s.rms))
    values = np.where(np.isfinite(values), values, 0.0)[:2**20]
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values)))) ** 2
    total = np.cumsum(power)
    if not total[-1] > 0:
        return None
    frequency = np.fft.rfftfreq(len(values), 1 / rate)
    low, high = (float(frequency[int(np.searchsorted(total, share * total[-1]))]) for share in (0.005, 0.995))
    return float(frequency[int(np.argmax(power))]), low, high


def samples_of(contents: Contents, signal: Signal) -> NDArray[np.float64]:
    """(n,) samples of a signal as stored."""
    values = np.squeeze(np.asarray(contents.arrays[signal.array], dtype=float))
    if signal.column is None:
        return values
    return np.asarray(values[:, signal.column] if values.shape[0] >= values.shape[1] else values[signal.column], dtype=float)


def role_of(path: Path) -> str:
    """Role that the name of a file suggests; empty if none."""
    patterns: Mapping[str, str] = {"noise": r"noise|quiet|background|ambient|rausch", "linear": r"linear|low|modal|small",
                                   "holdout": r"hold|valid|test|check|unseen"}
    return next((role for role, pattern in patterns.items() if re.search(pattern, path.stem, re.IGNORECASE)), "")


def described(found: Any) -> str:
    """One comment line about a recording."""
    rate = f"{found.rate:.6g} Hz" if found.rate else "of unknown rate"
    return f"{found.samples} samples, {rate}" + (f", {found.samples / found.rate:.4g} s" if found.rate else "")
