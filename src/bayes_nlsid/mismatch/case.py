"""A case folder: a nominal linear model that claims to be right, and recordings (format of the case contract, section 3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.case_file import load, read_meta, under

Array = NDArray[np.float64]
TOLERANCES = {"E_rel_sd": 0.03, "rho_rel_sd": 0.01, "joint_stiffness_log_sd": 0.3, "root_fix_log_sd": 0.5, "damping_rel_sd": 0.25}
CLASSES = ("none", "hardening", "softening", "clearance", "asymmetric", "coulomb", "quad_damping", "hysteresis", "stiffness_drift",
           "linear_stiffness", "added_mass", "unmodelled_mode", "force_gain", "force_delay", "sensor_gain", "sensor_delay",
           "sensor_drift", "clipping", "mains_hum", "base_motion", "other")


@final
@dataclass(frozen=True)
class CaseRecord:
    """One recording of the test day.

    Parameters
    ----------
    name, kind : str
        ``kind`` is ``"steady"`` (whole periods of a periodic force), ``"burst"`` (from rest) or ``"off"`` (shaker off).
    level : float
        Relative excitation level.
    start : float
        When on the test day it began, s.
    sealed : bool
        Only the force is known; the accelerations are to be predicted.
    time, force : ndarray (n,)
        s, N.
    accel : ndarray (n, s)
        m/s²; (n, 0) for a sealed record.
    periods : int
        Whole steady periods in the record (1 for bursts).
    """

    name: str
    kind: str
    level: float
    start: float
    sealed: bool
    time: Array
    force: Array
    accel: Array
    periods: int = 1

    def __post_init__(self) -> None:
        if self.time.shape != self.force.shape or (not self.sealed and len(self.accel) != len(self.time)):
            raise ValueError(f"record {self.name!r}: time {self.time.shape}, force {self.force.shape}, accel {self.accel.shape} disagree")


@final
@dataclass(frozen=True)
class Case:
    """Everything an engineer has before the mismatch is understood.

    Parameters
    ----------
    name : str
    rate : float
        Samples per second, Hz, common to all records.
    period : float
        Length of a steady period, s (0 if there is no periodic record).
    band : tuple of float
        Excited band, Hz.
    excited : ndarray of int
        Excited lines (multiples of ``1/period``); empty if none were stated.
    M, K : ndarray (N, N)
        kg, N/m, symmetric positive definite.
    K_parts, M_parts : dict of str to ndarray (N, N)
        What the tolerances scale; they sum to ``K`` and (the structural part of) ``M``.
    sensors : tuple of str
    sensor_rows : ndarray (s, N)
    shaker, base : ndarray (N,)
        Direction of the force; rigid motion of the base (zero if not stated).
    places : dict of str to ndarray (N,)
        Relative motion at each joint direction.
    mass_points : dict of str to ndarray (N,)
        Points that can carry mass.
    tolerances : dict of str to float
        One standard deviation each.
    damping : float
        Nominal damping ratio.
    classes : tuple of str
        Vocabulary of the answer.
    records : tuple of CaseRecord
    mains : float
        Hz.
    usable : ndarray of bool (s,)
        Channels without missing values.
    notes : tuple of str
        What was wrong with the data and what was lost, one sentence each.
    """

    name: str
    rate: float
    period: float
    band: tuple[float, float]
    excited: NDArray[np.int64]
    M: Array
    K: Array
    K_parts: dict[str, Array]
    M_parts: dict[str, Array]
    sensors: tuple[str, ...]
    sensor_rows: Array
    shaker: Array
    base: Array
    places: dict[str, Array]
    mass_points: dict[str, Array]
    tolerances: dict[str, float]
    damping: float
    classes: tuple[str, ...]
    records: tuple[CaseRecord, ...]
    mains: float = 50.0
    usable: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        size = len(self.M)
        if self.M.shape != (size, size) or self.K.shape != (size, size):
            raise ValueError(f"M {self.M.shape} and K {self.K.shape} must be square and of one size")
        if self.sensor_rows.shape != (len(self.sensors), size):
            raise ValueError(f"sensor_rows has shape {self.sensor_rows.shape}, expected {(len(self.sensors), size)}")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the usable sensors."""
        return tuple(n for n, ok in zip(self.sensors, self.usable, strict=True) if ok)

    @property
    def loudest(self) -> CaseRecord:
        """The open driven record of the highest level, a steady one if there is any."""
        return max((r for r in self.records if not r.sealed and r.kind != "off"), key=lambda r: (r.kind == "steady", r.level))

    def select(self, kind: str, sealed: bool = False) -> tuple[CaseRecord, ...]:
        """Records of one kind, in the order of the test day."""
        return tuple(r for r in self.records if r.kind == kind and r.sealed == sealed)


def read_case(path: str | Path) -> Case:
    """Read and check a case folder.

    Parameters
    ----------
    path : path of the folder with ``case.json``, ``nominal.npz`` and one ``.npz`` per record.

    Raises
    ------
    InputError
        With file, field and mend, for anything that makes the analysis impossible. What can be lived without becomes a note.
    """
    folder = Path(path)
    meta = read_meta(folder / "case.json")
    notes: list[str] = []
    rate = _number(meta, "fs_hz", folder)
    period = float(meta.get("period_s") or 0.0)
    model = _nominal(folder / "nominal.npz", notes)
    count = len(model["sensor_rows"])
    records = _records(folder, meta, rate, period, count, notes)
    low, high = _band(meta, rate, folder)
    names = tuple(str(n) for n in under(meta, "locations").get("sensors", ())) or tuple(f"S{i + 1}" for i in range(count))
    if len(names) != count:
        raise InputError(f"{folder / 'case.json'}: locations.sensors", f"{len(names)} names for {count} rows of sensor_select",
                         "give one name per sensor")
    usable = _usable(records, names, notes)
    tolerances = dict(TOLERANCES) | {k: float(v) for k, v in under(meta, "tolerances").items() if k in TOLERANCES}
    missing = sorted(set(TOLERANCES) - set(under(meta, "tolerances")))
    if missing:
        notes.append(f"Tolerances {', '.join(missing)} are not stated; usual values were taken.")
    _campaign_notes(records, notes)
    excited = np.asarray(meta.get("excited_lines") or [], dtype=np.int64)
    return Case(str(meta.get("case", folder.name)), rate, period, (low, high), excited, model["M"], model["K"], model["K_parts"],
                model["M_parts"], names, model["sensor_rows"], model["shaker"], model["base"], model["places"],
                _mass_points(meta, model, names, notes), tolerances, float(meta.get("nominal_damping_ratio") or 0.01),
                tuple(meta.get("classes") or CLASSES), records, float(meta.get("mains_hz") or 50.0), usable, tuple(notes))


def _number(meta: dict[str, Any], key: str, folder: Path) -> float:
    try:
        value = float(meta[key])
    except (KeyError, TypeError, ValueError):
        value = np.nan
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{folder / 'case.json'}: {key}", "missing or not a positive number", "state it in Hz or s")
    return value


def _band(meta: dict[str, Any], rate: float, folder: Path) -> tuple[float, float]:
    band = meta.get("band_hz")
    if not (isinstance(band, list) and len(band) == 2 and 0 < float(band[0]) < float(band[1]) < rate / 2):
        raise InputError(f"{folder / 'case.json'}: band_hz", "must be two increasing frequencies below half the sampling rate",
                         "state the excited band in Hz")
    return float(band[0]), float(band[1])


def _nominal(path: Path, notes: list[str]) -> dict[str, Any]:
    raw = load(path)
    for key in ("M", "K", "sensor_select", "shaker_vector"):
        if key not in raw:
            raise InputError(f"{path}: {key}", "missing", "store the matrices of the nominal model")
    M, K = np.asarray(raw["M"], dtype=float), np.asarray(raw["K"], dtype=float)
    size = len(M)
    for name, matrix in (("M", M), ("K", K)):
        if matrix.shape != (size, size) or size == 0:
            raise InputError(f"{path}: {name}", f"has shape {matrix.shape}, expected {(size, size)}", "store square matrices of one size")
        if not np.isfinite(matrix).all() or np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
            raise InputError(f"{path}: {name}", "is not finite and symmetric", "store the assembled matrix")
    for name, matrix in (("M", M), ("K", K)):
        try:
            np.linalg.cholesky((matrix + matrix.T) / 2)
        except np.linalg.LinAlgError:
            raise InputError(f"{path}: {name}", "is not positive definite",
                             "remove massless or free degrees of freedom (supports must be in K)") from None
    out: dict[str, Any] = {"M": M, "K": K}
    for key, target in (("sensor_select", "sensor_rows"), ("shaker_vector", "shaker"), ("base_vector", "base")):
        value = np.asarray(raw.get(key, np.zeros(size)), dtype=float)
        value = np.atleast_2d(value) if key == "sensor_select" else value.reshape(-1)
        if value.shape[-1] != size or not np.isfinite(value).all():
            raise InputError(f"{path}: {key}", f"has shape {value.shape}, its last axis must be {size}", "use the order of M and K")
        out[target] = value
    if not np.abs(out["base"]).any():
        notes.append("No base_vector is given: motion of the floor cannot be tested.")
    for key in ("K", "M"):
        out[f"{key}_parts"] = _parts(raw, key, out[key], path, notes)
    names = [str(n) for n in raw.get("location_names", ())]
    vectors = np.asarray(raw.get("location_vectors", np.zeros((0, size))), dtype=float)
    if vectors.shape != (len(names), size):
        raise InputError(f"{path}: location_vectors", f"has shape {vectors.shape}, expected {(len(names), size)}",
                         "give one row of relative motion per location name")
    out["places"] = dict(zip(names, vectors, strict=True))
    return out


def _parts(raw: dict[str, NDArray[Any]], key: str, whole: Array, path: Path, notes: list[str]) -> dict[str, Array]:
    if f"{key}_parts" not in raw:
        notes.append(f"No {key}_parts are given: {key} is scaled as a whole.")
        return {key: whole}
    parts = np.asarray(raw[f"{key}_parts"], dtype=float)
    names = [str(n) for n in raw.get(f"{key}_part_names", [f"{key}{i}" for i in range(len(parts))])]
    if parts.shape != (len(names), *whole.shape):
        raise InputError(f"{path}: {key}_parts", f"has shape {parts.shape}, expected {(len(names), *whole.shape)}",
                         f"store one matrix of the size of {key} per name")
    return dict(zip(names, parts, strict=True))


def _mass_points(meta: dict[str, Any], model: dict[str, Any], sensors: tuple[str, ...], notes: list[str]) -> dict[str, Array]:
    """Mass points carry no vectors of their own: ``P<i>`` lies under the sensor that the geometry names (else sensor i)."""
    listed = [str(n) for n in under(meta, "locations").get("mass_points", ())]
    below = {}
    for entry in under(meta, "geometry").get("sensors", ()):
        if isinstance(entry, dict) and entry.get("mass_point") and entry.get("name") in sensors:
            below[str(entry["mass_point"])] = sensors.index(entry["name"])
    out: dict[str, Array] = {}
    for name in listed or [f"P{i + 1}" for i in range(len(sensors))] + ["SHAKER"]:
        if name == "SHAKER":
            out[name] = model["shaker"]
        elif name in below:
            out[name] = model["sensor_rows"][below[name]]
        elif name[1:].isdigit() and name[0] == "P" and 0 < int(name[1:]) <= len(sensors):
            out[name] = model["sensor_rows"][int(name[1:]) - 1]
        else:
            notes.append(f"Mass point {name} has no known position and is left out.")
    return out


def _records(folder: Path, meta: dict[str, Any], rate: float, period: float, count: int, notes: list[str]) -> tuple[CaseRecord, ...]:
    out: list[CaseRecord] = []
    for entry in meta["records"]:
        if not isinstance(entry, dict) or "name" not in entry:
            raise InputError(f"{folder / 'case.json'}: records", "an entry has no name", "give every record its name")
        name, sealed = str(entry["name"]), bool(entry.get("sealed", False))
        path = folder / (f"{name}_force.npz" if sealed else f"{name}.npz")
        if not path.is_file():
            notes.append(f"Record {name} is listed but its file {path.name} is missing; it was left out.")
            continue
        record = _record(path, entry, load(path), rate, period, count, notes)
        if record is not None:
            out.append(record)
    if not any(not r.sealed and r.kind != "off" for r in out):
        raise InputError(f"{folder / 'case.json'}: records", "no open record with the shaker on could be read",
                         "provide at least one record with force and accelerations")
    return tuple(out)


def _record(path: Path, entry: dict[str, Any], raw: dict[str, NDArray[Any]], rate: float, period: float, count: int,
            notes: list[str]) -> CaseRecord | None:
    name, sealed = str(entry["name"]), bool(entry.get("sealed", False))
    for key in ("time", "force") + (() if sealed else ("accel",)):
        if key not in raw:
            raise InputError(f"{path}: {key}", "missing", "store time (s), force (N) and accel (m/s²)")
    time, force = np.asarray(raw["time"], dtype=float).reshape(-1), np.asarray(raw["force"], dtype=float).reshape(-1)
    accel = np.zeros((len(time), 0)) if sealed else np.asarray(raw["accel"], dtype=float)
    if len(force) != len(time) or len(accel) != len(time) or len(time) < 16 or (not sealed and accel.shape[1:] != (count,)):
        raise InputError(f"{path}: accel", f"time {time.shape}, force {force.shape}, accel {accel.shape} do not fit {count} sensors",
                         "store n samples of each, one column per sensor")
    step = (time[-1] - time[0]) / (len(time) - 1)
    if not np.isfinite(step) or abs(step * rate - 1) > 1e-3:
        notes.append(f"Record {name} is sampled at {1 / step:.5g} Hz instead of {rate:.5g} Hz; it was left out.")
        return None
    if not np.isfinite(force).all():
        notes.append(f"The force of record {name} has missing values; the record was left out.")
        return None
    kind = kind_of(str(entry.get("kind", "")), name, float(entry.get("level", 1.0)), force, rate, period)
    periods = 1
    if kind == "steady":
        block = round(period * rate)
        periods = len(time) // block
        time, force, accel = time[:periods * block], force[:periods * block], accel[:periods * block]
        if periods < 2:
            notes.append(f"Record {name} holds one period only: its noise is taken from other records.")
    return CaseRecord(name, kind, float(entry.get("level", 1.0)), float(entry.get("start_s", 0.0)), sealed, time, force, accel, periods)


def kind_of(text: str, name: str, level: float, force: Array, rate: float, period: float) -> str:
    text = text.lower()
    if "off" in text or name == "noise" or level == 0:
        return "off"
    if ("steady" in text or "multisine" in text or "period" in text) and period > 0 and len(force) >= round(period * rate):
        return "steady"
    return "burst"


def _usable(records: tuple[CaseRecord, ...], names: tuple[str, ...], notes: list[str]) -> NDArray[np.bool_]:
    usable = np.ones(len(names), dtype=bool)
    for i, name in enumerate(names):
        bad = [r.name for r in records if not r.sealed and not np.isfinite(r.accel[:, i]).all()]
        dead = [r.name for r in records if not r.sealed and r.kind != "off" and np.ptp(np.nan_to_num(r.accel[:, i])) == 0]
        if bad or dead:
            usable[i] = False
            what = f"missing values in {', '.join(bad)}" if bad else f"no signal in {', '.join(dead)}"
            notes.append(f"Channel {name} has {what}; it was left out of the analysis.")
    if not usable.any():
        raise InputError("records: accel", "every channel has missing values", "repair at least one channel")
    return usable


def _campaign_notes(records: tuple[CaseRecord, ...], notes: list[str]) -> None:
    open_ = [r for r in records if not r.sealed]
    steady = [r for r in open_ if r.kind == "steady"]
    if not any(r.kind == "off" for r in open_):
        notes.append("No shaker-off record: disturbances that act without the shaker cannot be told from noise as surely.")
    if not steady:
        notes.append("No periodic record: even and odd distortions and the scatter between periods cannot be tested.")
    levels = sorted({round(r.level, 6) for r in open_ if r.kind != "off"})
    if len(levels) < 2:
        notes.append("One level only: growth with amplitude cannot be tested.")
    repeat = [a.name for i, a in enumerate(steady) for b in steady[i + 1:] if len(a.force) == len(b.force)
              and abs(a.level - b.level) < 1e-9 and a.force @ b.force > 0.98 * np.linalg.norm(a.force) * np.linalg.norm(b.force)]
    if not repeat:
        notes.append("No record was repeated later on the test day: a drift is seen only through the model.")
