"""A case folder whose records are not what the engine for periodic campaigns needs, as a campaign for the general engine.

Real data seldom come as steady multisines at several levels of a supported structure. This reader takes what is there: a mass without a
spring, one record, no band, no noise record, free decays with zero force, records at different rates, channels with gaps. What cannot be
used is left out with a sentence; only a case without a model or without any record is refused.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.campaign import (
    MOST,
    PASS,
    Campaign,
    Trial,
    Use,
    alive,
    campaign_notes,
    energetic_band,
    in_band,
    lower_edge,
    make_trial,
    parted,
)
from bayes_nlsid.mismatch.case import CLASSES, TOLERANCES, kind_of
from bayes_nlsid.mismatch.case_file import load, read_meta, under
from bayes_nlsid.recordings.checks import check
from bayes_nlsid.recordings.noise import noise_psd
from bayes_nlsid.recordings.recording import Channel, Quantity, Recording
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
FREE = 1e-4          # rad/s that stands for no stiffness
MODES = 24
SPLIT = 0.7
RESPONSES: dict[str, Quantity] = {"accel": "acceleration", "velocity": "velocity", "displacement": "displacement"}


def needs_general(path: str | Path) -> bool:
    """Whether the engine for periodic campaigns cannot use a case folder: no two open records of steady periods or bursts from rest with a
    measured force, a stiffness that is not positive definite, no band, or motion measured otherwise than as acceleration."""
    folder = Path(path)
    if not (folder / "case.json").is_file():
        return False   # the other reader says what is missing
    meta = read_meta(folder / "case.json")
    raw = load(folder / "nominal.npz")
    if "K" not in raw:
        return False
    try:
        K = np.asarray(raw["K"], dtype=float)
        np.linalg.cholesky((K + K.T) / 2)
    except (np.linalg.LinAlgError, ValueError):
        return True
    if not isinstance(meta.get("band_hz"), list):
        return True
    period, rate = float(meta.get("period_s") or 0.0), float(meta.get("fs_hz") or 0.0)
    steady, bursts, moving = 0, 0, 0
    for entry in meta["records"]:
        name = str(entry.get("name", "")) if isinstance(entry, dict) else ""
        file = folder / f"{name}.npz"
        if not file.is_file() or entry.get("sealed"):
            continue
        raw = load(file)
        if "accel" not in raw or "force" not in raw:
            return True
        force = np.asarray(raw["force"], dtype=float).reshape(-1)
        kind = kind_of(str(entry.get("kind", "")), name, float(entry.get("level", 1.0)), force, rate, period)
        if kind == "off":
            continue
        if not np.abs(force).any():
            return True   # a free decay
        steady += kind == "steady" and _repeats(force, round(period * rate))
        moving += kind == "burst" and _under_way(force)   # neither periodic nor from rest to rest
        bursts += kind == "burst"
    return steady == 0 and (bursts < 2 or moving > 0)


def _repeats(force: Array, block: int) -> bool:
    """Whether a force is a whole number of equal periods."""
    periods = len(force) // block if block else 0
    if periods < 2:
        return periods == 1
    waves = force[:periods * block].reshape(periods, block)
    return bool(np.abs(waves[0] - waves[-1]).max() < 0.2 * np.abs(waves[0]).max())


def _under_way(force: Array) -> bool:
    """Whether a force still acts at the end of its record."""
    tail = force[-max(1, len(force) // 50):]
    return bool(np.sqrt(np.mean(tail ** 2)) > 0.1 * np.sqrt(np.mean(force ** 2)))


def campaign_from_case(path: str | Path) -> Campaign:
    """Read a case folder leniently.

    Raises
    ------
    InputError
        If there is no usable model or no usable record.
    """
    folder = Path(path)
    meta = read_meta(folder / "case.json")
    notes: list[str] = []
    model, sensors = _model(folder, meta, notes)
    records = _records(folder, meta, sensors, notes)
    fit = [r for r, use in records if use == "fit"]
    if not fit:
        why = next((note.rstrip(".") for note in reversed(notes) if "left out" in note), "")
        raise InputError(f"{folder / 'case.json'}: records", f"no open record could be used{why and f' ({why})'}",
                         "provide at least one record with time and accel, velocity or displacement")
    band = meta.get("band_hz")
    clock = min(r.fs for r in fit)
    if isinstance(band, list) and len(band) == 2 and 0 <= float(band[0]) < float(band[1]):
        top = float(min(1.3 * float(band[1]), PASS * clock))
    else:
        top = energetic_band(model, fit)
        notes.append(f"No band is stated: records were analysed up to {top:.3g} Hz, where the motion is.")
    noises = {r.name: r for r, use in records if use == "noise"}
    bottom = lower_edge(model, fit, float(band[0]) if isinstance(band, list) and len(band) == 2 else 0.0)
    trials = _trials(records, noises, (bottom, top), notes)
    model = in_band(model, top)
    places = _places(model, meta)
    tolerances = TOLERANCES | {k: float(v) for k, v in under(meta, "tolerances").items() if k in TOLERANCES}
    notes += campaign_notes(trials, bool(noises))
    own = {"frequency": 0.5 * float(np.hypot(tolerances["E_rel_sd"], tolerances["rho_rel_sd"])), "damping": tolerances["damping_rel_sd"],
           "gain": tolerances["rho_rel_sd"]}
    return Campaign(str(meta.get("case", folder.name)), model, model, trials, places, tuple(meta.get("classes") or CLASSES), own,
                    float(meta.get("mains_hz") or 50.0), top, tuple(notes))


def _model(folder: Path, meta: dict[str, Any], notes: list[str]) -> tuple[ModalModel, tuple[str, ...]]:
    """Modes with the rows of every location; rigid bodies keep a place at a frequency too low to matter."""
    from scipy.linalg import eigh

    path = folder / "nominal.npz"
    raw = load(path)
    for key in ("M", "K", "sensor_select"):
        if key not in raw:
            raise InputError(f"{path}: {key}", "missing", "store the matrices of the nominal model")
    M, K = (np.atleast_2d(np.asarray(raw[k], dtype=float)) for k in ("M", "K"))
    size = len(M)
    for name, matrix in (("M", M), ("K", K)):
        if matrix.shape != (size, size) or not np.isfinite(matrix).all():
            raise InputError(f"{path}: {name}", f"has shape {matrix.shape} or is not finite, expected {(size, size)}",
                             "store square matrices")
    try:
        values, vectors = eigh((K + K.T) / 2, (M + M.T) / 2)
    except np.linalg.LinAlgError:
        raise InputError(f"{path}: M", "is not positive definite", "remove degrees of freedom without mass") from None
    scale = float(np.abs(values).max()) or 1.0
    negative = values < -1e-9 * scale
    if negative.any():
        notes.append(f"The stiffness matrix is not positive definite: {int(negative.sum())} of its modes would grow by themselves; they "
                     "were taken as rigid-body modes.")
    rigid = values <= 1e-12 * scale
    omega = np.where(rigid | negative, FREE, np.sqrt(np.maximum(values, FREE ** 2)))
    zeta = np.full(size, float(meta.get("nominal_damping_ratio") or 0.01))
    C = raw.get("C")
    if C is not None and np.shape(C) == (size, size):
        zeta = np.maximum(np.einsum("ij,ij->j", vectors, np.asarray(C, dtype=float) @ vectors), 0) / (2 * omega)
    elif (rigid | negative).any():
        # a rigid body has no damping ratio: a rate of one per second is where calibration starts
        zeta = np.where(rigid | negative, 1.0 / (2 * omega), zeta)
        notes.append("Damping of the rigid-body motion is not stated; it was estimated from nothing.")
    rows = np.atleast_2d(np.asarray(raw["sensor_select"], dtype=float))
    if rows.shape[-1] != size:
        raise InputError(f"{path}: sensor_select", f"has shape {rows.shape}, its last axis must be {size}", "use the order of M and K")
    names = tuple(str(n) for n in under(meta, "locations").get("sensors", ())) or tuple(f"S{i + 1}" for i in range(len(rows)))
    if len(names) != len(rows):
        names = tuple(f"S{i + 1}" for i in range(len(rows)))
        notes.append("The names of the sensors do not fit their number; S1, S2, ... were used.")
    located: dict[str, Array] = dict(zip(names, rows, strict=True))
    shaker = np.asarray(raw.get("shaker_vector", np.zeros(size)), dtype=float).reshape(-1)
    located["SHAKER"] = shaker if shaker.shape == (size,) else np.zeros(size)
    vectors_of = np.asarray(raw.get("location_vectors", np.zeros((0, size))), dtype=float).reshape(-1, size)
    labels = [str(n) for n in raw.get("location_names", ())]
    joints = [n for n, v in zip(labels, vectors_of, strict=False) if np.abs(v).any()]
    located |= {n: v for n, v in zip(labels, vectors_of, strict=False) if n in joints}
    order = np.argsort(omega, kind="stable")[:MODES]
    inputs = ("SHAKER",) if np.abs(located["SHAKER"]).any() else ()
    model = ModalModel(omega[order], zeta[order], tuple(located), np.array(list(located.values())) @ vectors[:, order], sensors=names,
                       inputs=inputs, joints=tuple(joints))
    return model, names


def _records(folder: Path, meta: dict[str, Any], sensors: tuple[str, ...], notes: list[str]) -> list[tuple[Recording, Use]]:
    out: list[tuple[Recording, Use]] = []
    for entry in meta["records"]:
        if not isinstance(entry, dict) or "name" not in entry:
            notes.append("An entry of records has no name; it was left out.")
            continue
        name, sealed = str(entry["name"]), bool(entry.get("sealed", False))
        file = folder / (f"{name}_force.npz" if sealed else f"{name}.npz")
        if not file.is_file():
            notes.append(f"Record {name} is listed but its file {file.name} is missing; it was left out.")
            continue
        try:
            found = _record(name, entry, load(file), meta, sensors, sealed, notes)
        except (ValueError, TypeError) as error:
            notes.append(f"Record {name} was left out: {error}")
            continue
        if found is not None:
            off = not sealed and ("off" in str(entry.get("kind", "")).lower() or name == "noise")
            out.append((found, "sealed" if sealed else "noise" if off else "fit"))
    return _with_judge(out, notes)


def _record(name: str, entry: dict[str, Any], raw: dict[str, NDArray[Any]], meta: dict[str, Any], sensors: tuple[str, ...], sealed: bool,
            notes: list[str]) -> Recording | None:
    key = next((k for k in RESPONSES if k in raw), None)
    if key is None and not sealed:
        notes.append(f"Record {name} holds none of {', '.join(RESPONSES)}; it was left out.")
        return None
    force = np.asarray(raw["force"], dtype=float).reshape(-1) if "force" in raw else None
    response = np.asarray(raw[key], dtype=float) if key is not None else np.zeros((len(force) if force is not None else 0, len(sensors)))
    response = response.reshape(len(response), -1)
    n = len(response)
    if response.shape[1] != len(sensors) or n < 64 or (force is not None and len(force) != n):
        notes.append(f"Record {name} has {response.shape[1]} channels of {n} samples where {len(sensors)} sensors are stated; "
                     "it was left out.")
        return None
    time = np.asarray(raw["time"], dtype=float).reshape(-1) if "time" in raw else np.arange(n) / float(meta.get("fs_hz") or 1.0)
    dt = float((time[-1] - time[0]) / (n - 1)) if len(time) == n else 1 / float(meta.get("fs_hz") or 1.0)
    if not (np.isfinite(dt) and dt > 0):
        notes.append(f"The clock of record {name} does not run; it was left out.")
        return None
    if force is not None and not np.isfinite(force).all():
        notes.append(f"The force of record {name} has missing values; the record was left out.")
        return None
    usable = [i for i in range(len(sensors)) if np.isfinite(response[:, i]).all() and (sealed or np.ptp(response[:, i]) > 0)]
    for i in sorted(set(range(len(sensors))) - set(usable)):
        notes.append(f"Channel {sensors[i]} of record {name} has missing values or no signal; it was left out.")
    if not usable:
        return None
    quantity = RESPONSES[key or "accel"]
    channels = tuple(Channel(sensors[i], sensors[i], quantity, {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m"}[quantity])
                     for i in usable)
    driven = force is not None and bool(np.abs(force).any())
    period = round(float(meta.get("period_s") or 0.0) / dt)
    kind = kind_of(str(entry.get("kind", "")), name, float(entry.get("level", 1.0)), force if force is not None else np.zeros(n), 1 / dt,
                 float(meta.get("period_s") or 0.0))
    periodic = driven and force is not None and kind == "steady" and period > 1 and n >= period and _repeats(force, period)
    keep = n // period * period if periodic else n
    inputs = (Channel("force", "SHAKER", "force", "N"),) if driven else ()
    applied = np.asarray(force).reshape(-1, 1)[:keep] if driven else np.zeros((keep, 0))
    recording = Recording(name, dt, response[:keep][:, usable], channels, applied, inputs, period=period if periodic else None,
                          start=float(entry.get("start_s", 0.0) or 0.0))
    if not sealed:
        notes.extend(f"Record {name}: {f.sentence}" for f in check(recording))
    return recording


def _with_judge(records: list[tuple[Recording, Use]], notes: list[str]) -> list[tuple[Recording, Use]]:
    """One open record, the last of at least three, or the end of each, is kept to judge by."""
    fit = [i for i, (_, use) in enumerate(records) if use == "fit"]
    if len(fit) >= 3:
        kept = min(fit, key=lambda i: abs(fit.index(i) - len(fit) // 2))
        records[kept] = (records[kept][0], "judge")
        notes.append(f"Record {records[kept][0].name} was not fitted but kept to judge by.")
        return _living(records)
    out: list[tuple[Recording, Use]] = []
    for recording, use in records:
        periods = recording.n // recording.period if recording.period else 0
        if use != "fit" or periods == 1:
            out.append((recording, use))
            continue
        if not periods:
            first, second, quiet = parted(recording, SPLIT)
            out += [(first, "fit"), (replace(second, name=f"{second.name} (rest)"), "judge")]
            if quiet is not None and quiet.n >= 64 and not any(use == "noise" for _, use in out):
                out.append((quiet, "noise"))
            continue
        whole = recording.n * recording.dt
        cut = min(max(1, round(SPLIT * periods)), periods - 1) * (recording.period or 0) * recording.dt
        out += [(recording.window(0.0, cut), "fit"), (replace(recording.window(cut, whole), name=f"{recording.name} (rest)"), "judge")]
    notes.append(f"Few open records: the last {100 * (1 - SPLIT):.0f} % of each (the first, where the loudest motion comes late) was not "
                 "fitted but kept to judge by.")
    return out


def _living(records: list[tuple[Recording, Use]]) -> list[tuple[Recording, Use]]:
    """Free decays without their quiet ends, the longest of which stands in for a noise record where there is none."""
    out: list[tuple[Recording, Use]] = []
    ends: list[Recording] = []
    for recording, use in records:
        cut, quiet = alive(recording) if recording.free and use in ("fit", "judge") else (recording, None)
        out.append((cut, use))
        ends += [quiet] if quiet is not None and quiet.n >= 64 else []
    if ends and not any(use == "noise" for _, use in out):
        out.append((max(ends, key=lambda r: r.n), "noise"))
    return out


def _trials(records: list[tuple[Recording, Use]], noises: dict[str, Recording], band: tuple[float, float], notes: list[str]
            ) -> tuple[Trial, ...]:
    fitted = [r for r, use in records if use == "fit"]
    most = max(4000, MOST // (len(fitted) * max(len(r.channels) for r in fitted)))
    out = []
    for recording, use in records:
        if use == "noise":
            continue
        reference = next((n for n in noises.values() if n.channels == recording.channels and abs(n.dt / recording.dt - 1) < 1e-6), None)
        try:
            floor = None if use == "sealed" else noise_psd(recording, reference)
            out.append(make_trial(recording, use, band[1], floor, most, 0.0 if use == "sealed" else band[0]))
        except ValueError as error:
            notes.append(f"Record {recording.name} was left out: {error}.")
    return tuple(out)


def _places(model: ModalModel, meta: dict[str, Any]) -> tuple[str, ...]:
    """Joints, or, where none is stated, every location that moves and is no copy of another."""
    kept: list[str] = []
    for name in model.joints or model.locations:
        row = model.rows([name])[0]
        if np.abs(row).max() > 0 and not any(np.allclose(row, model.rows([k])[0], rtol=1e-9, atol=0) for k in kept):
            kept.append(name)
    return tuple(kept)
