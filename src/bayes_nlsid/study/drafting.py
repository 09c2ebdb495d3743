"""``nlsid new DIR --from FILE…``: a study written from the files it is pointed at, every guess commented, every gap marked FILL IN."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.units import unit_factor
from bayes_nlsid.study.store import write_atomic
from bayes_nlsid.study.survey import RecordingFound, Signal, described, kind_of, role_of, survey_recording
from bayes_nlsid.study.table import FILL_IN

_FILES = {"mass": "mass", "stiffness": "stiffness", "damping": "damping", "archive": "mass", "matrices": "mass", "locations": "locations"}


@final
@dataclass(frozen=True)
class _Findings:
    """What the files gave: paths of the structure by key, modes, recordings with roles, and the structure if it can be built."""

    structure: dict[str, Path]
    form: str
    modes: Path | None
    recordings: tuple[tuple[RecordingFound, str], ...]
    built: Any = None
    notes: list[str] = field(default_factory=list)


def draft_study(folder: Path, files: Sequence[Path]) -> Path:
    """Write ``study.toml`` into a folder; nothing that exists is touched.

    Parameters
    ----------
    folder : Path
        Made if missing.
    files : sequence of Path
        Recordings, matrices, tables of locations, modal results, in any order.

    Returns
    -------
    Path
        The study file. `read_study` reads it, or says which entries are to be filled in.

    Raises
    ------
    InputError
        If a file cannot be read, two files claim the same place, no recording is among them, or the study exists already.
    """
    study = folder / "study.toml"
    if folder.exists() and not folder.is_dir():
        raise InputError(str(folder), "is a file", "give a folder")
    if study.exists():
        raise InputError(str(study), "is already there", "give another folder")
    text = draft(_find(files), folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(folder), f"cannot be made ({error.strerror})", "give another folder") from None
    write_atomic(study, text.encode())
    return study


def _find(files: Sequence[Path]) -> _Findings:
    structure: dict[str, Path] = {}
    modes, form, recordings = None, "", []
    read: dict[str, Path] = {}
    for path in files:
        kind, contents = kind_of(path)
        if kind == "recording":
            assert contents is not None
            if read.setdefault(contents.sha256, path) is not path:
                raise InputError(str(path), f"holds the same as {read[contents.sha256].name}",
                                 "name it once: nothing may judge what it was fitted to")
            recordings.append(survey_recording(path, contents))
        elif kind == "modes":
            modes = path
        elif _FILES[kind] in structure:
            raise InputError(str(path), f"and {structure[_FILES[kind]].name} both look like the {_FILES[kind]}",
                             "give one of them, or name the files mass..., stiffness...")
        else:
            structure[_FILES[kind]] = path
            form = kind if kind in ("archive", "matrices", "mass") else form
    if not recordings:
        raise InputError(", ".join(map(str, files)), "holds no recording", "give at least one file with time records")
    if structure and "mass" not in structure:
        raise InputError(str(next(iter(structure.values()))), "comes without a mass matrix", "give the file of the mass matrix too")
    found = _Findings(structure, form, modes, _with_roles(recordings))
    return replace(found, built=_build(found))


def _with_roles(recordings: Sequence[RecordingFound]) -> tuple[tuple[RecordingFound, str], ...]:
    """Roles by name; one of several unnamed ones is kept for judging; at least one trains."""
    roles = [role_of(r.path) for r in recordings]
    free = [i for i, role in enumerate(roles) if not role]
    for i in free:
        roles[i] = "train"
    if "train" not in roles:
        roles[0] = "train"
    if len(free) > 1 and "holdout" not in roles:
        roles[free[-1]] = "holdout"
    return tuple(zip(recordings, roles, strict=True))


def _build(found: _Findings) -> Any:
    """The structure, if its files say enough; else None, and the draft asks."""
    from bayes_nlsid.structure.matrices import read_matrices

    if not found.structure:
        return None
    units: dict[str, Any] = {} if found.form == "archive" else {"length_unit": "m", "force_unit": "N"}  # names do not depend on units
    try:
        return read_matrices(**found.structure, **units)  # type: ignore[arg-type]
    except InputError as error:
        found.notes.append(str(error))
        return None


def draft(found: _Findings, folder: Path) -> str:
    """The text of the study."""
    where = _places(found, found.recordings[0][0])
    count = len(found.structure) + len(found.recordings) + bool(found.modes)
    parts = [f"""# A study drafted from {count} file{"s" * (count > 1)}. Lines marked "guess" say what the guess rests on; what begins with
# "{FILL_IN}" could not be guessed. Numbers are SI unless they carry their unit. Check it with: nlsid check study.toml

title = {_text("Study of " + found.recordings[0][0].path.stem)}
seed = 1
""", _structure(found, folder, where), *_recordings(found, folder)]
    if found.modes is not None:
        parts.append(f"[linear]                          # modes that a test program found; [linear.sensors] may rename them\nfile = "
                     f"{_path(found.modes, folder)}\n")
    elif any(role == "linear" for _, role in found.recordings):
        name = next(r.path.stem for r, role in found.recordings if role == "linear")
        parts.append(f"[linear]\n{_line('recording', _text(name), 'guess: its name says that it is of low level')}\n")
    return "\n".join([*parts, _method(found, where)])


def _places(found: _Findings, recording: RecordingFound) -> dict[str, tuple[str, str]]:
    """(location, why) of every signal of a recording, by the name of its array and column."""
    signals = recording.signals
    if found.built is None:
        if found.structure:
            return {_key(s): (f"{FILL_IN}: location of {s.array}", "") for s in signals}
        first = found.recordings[0][0].signals
        name = _plain(next((s for s in _one_response(first) if s.quantity != "force"), first[0]))
        return {_key(s): (name, "an oscillator has one location") for s in signals}
    out = {}
    forces, responses = ([s for s in signals if (s.quantity == "force") is force] for force in (True, False))
    for known, members in ((found.built.inputs, forces), (found.built.sensors, responses)):
        for i, s in enumerate(members):
            same = next((n for n in found.built.locations if n.lower() in (s.array.lower(), _plain(s).lower())), None)
            if same is not None:
                out[_key(s)] = (same, "the same name")
            elif len(known) == len(members):
                out[_key(s)] = (known[i], "the order of the channels is that of the locations")
            else:
                out[_key(s)] = (f"{FILL_IN}: one of {', '.join(found.built.locations)}"[:120], "")
    return out


def _key(signal: Signal) -> str:
    return f"{signal.array}\0{signal.column}"


def _plain(signal: Signal) -> str:
    return signal.array.rpartition(".")[2] + ("" if signal.column is None else f"_{signal.column}")


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _path(path: Path, folder: Path) -> str:
    return _text(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def _line(key: str, value: str, comment: str = "") -> str:
    line = f"{key} = {value}"
    return f"{line:<33} # {comment}" if comment else line


def _structure(found: _Findings, folder: Path, where: dict[str, tuple[str, str]]) -> str:
    if not found.structure:
        first = found.recordings[0][0]
        peak = first.peak
        frequency = _text(f"{peak[0]:.4g} Hz") if peak else _text(f"{FILL_IN}: frequency of its mode, Hz")
        driven = any(s.quantity in ("force", "") for s in first.signals)
        mass = _text(f"{FILL_IN}: modal mass at the sensor, kg") if driven else "1.0"
        location = next(iter(where.values()))[0]
        return "\n".join([
            "# guess: no model was given, so one mode; for a finite-element model give its matrices to --from too", "[structure]",
            _line("kind", '"oscillator"'), _line("mass", mass, "kg" if driven else "guess: no force was measured, so only ratios matter"),
            _line("frequency", frequency, "guess: the strongest line of the strongest channel" if peak else ""),
            _line("zeta", "0.005", "guess: damping ratio; estimated below"), _line("location", _text(location)), ""])
    lines = ["[structure]", _line("kind", '"matrices"')]
    lines += [_line(key, _path(path, folder), "guess: by its name" if key in ("mass", "stiffness") and found.form == "mass" else "")
              for key, path in found.structure.items()]
    if found.form != "archive":
        lines += [_line("length_unit", _text(f"{FILL_IN}: unit of length of the model, m or mm")),
                  _line("force_unit", _text(f"{FILL_IN}: unit of force of the model, N or kN"))]
        if "locations" not in found.structure:
            lines.append(_line("locations", _text(f"{FILL_IN}: a table name, dof, coefficient, role of sensors, inputs and joints")))
    lines += [f"# note: {note}" for note in found.notes]
    if found.built is not None:
        for role in ("sensors", "inputs", "joints"):
            names = getattr(found.built, role)
            lines.append(f"# {role}: {', '.join(names[:12]) or 'none'}{', ...' if len(names) > 12 else ''}")
    modes = 10 if found.built is None else max(1, min(10, found.built.size - 1))
    return "\n".join([*lines, "", "[reduction]", _line("modes", str(modes), "guess: enough for most bands"), ""])


def _recordings(found: _Findings, folder: Path) -> list[str]:
    out = []
    alone = [r for r, role in found.recordings if role == "train"]
    judged = any(role == "holdout" for _, role in found.recordings)
    for recording, role in found.recordings:
        split = not judged and recording is alone[0] and recording.rate is not None
        lines = [f"[[recordings]]                    # {described(recording)}", _line("name", _text(recording.path.stem)),
                 _line("file", _path(recording.path, folder))]
        if recording.clock is None:
            lines.append(_line("rate", _text(f"{FILL_IN}: sampling rate in Hz"), "no array of it looks like a rate or a time"))
        else:
            lines.append(_line(recording.clock[0], _text(recording.clock[1]), "guess: by its name"))
        lines.append(_line("role", _text(role), "guess: by its name" if role_of(recording.path) else "guess: fitted"
                           if role == "train" else "guess: kept for judging"))
        seconds = recording.samples / recording.rate if recording.rate else 0.0
        if split:
            lines.append(_line("window", f"[0.0, {_down(0.7 * seconds)}]", "guess: the rest is kept for judging, below"))
        where = _places(found, recording)
        used = recording.signals if found.structure else _one_response(recording.signals)
        lines += [line for s in used for line in _channel(s, where)]
        left = [f"{s.array}{'' if s.column is None else f' column {s.column}'}" for s in recording.signals if s not in used]
        lines += [f"# guess: one mode needs one sensor, the strongest; left out: {', '.join(left)}"] if left else []
        out.append("\n".join([*lines, ""]))
        if split:
            rest = [_line("like", _text(recording.path.stem)), _line("name", _text(f"{recording.path.stem}, end")),
                    _line("role", '"holdout"'), _line("window", f"[{_down(0.7 * seconds)}, {_down(seconds)}]")]
            out.append("\n".join(["[[recordings]]", *rest, ""]))
    return out


def _one_response(signals: Sequence[Signal]) -> tuple[Signal, ...]:
    """Forces, signals of unknown kind, and the strongest response."""
    responses = [s for s in signals if s.quantity and s.quantity != "force"]
    strongest = max(responses, key=lambda s: s.rms, default=None)
    return tuple(s for s in signals if s is strongest or s not in responses)


def _down(seconds: float) -> str:
    """Seconds to four digits, never more than there are."""
    scale = 10.0 ** (3 - math.floor(math.log10(seconds)))
    return f"{math.floor(seconds * scale) / scale:.6g}" if seconds > 0 else "0.0"


def _channel(signal: Signal, where: dict[str, tuple[str, str]]) -> list[str]:
    lines = ["[[recordings.channels]]", _line("name", _text(_plain(signal))), _line("array", _text(signal.array))]
    if signal.column is not None:
        lines.append(_line("column", str(signal.column)))
    quantity = signal.quantity or f"{FILL_IN}: acceleration, velocity, displacement or force"
    lines.append(_line("quantity", _text(quantity), f"guess: {signal.why}" if signal.why else ""))
    if signal.unit:
        lines.append(f"# unit = {_text(signal.unit)}, as written in the file")
        try:
            unit_factor(signal.unit, "voltage")
            lines.append(_line("per_volt", _text(f"{FILL_IN}: SI units for one volt")))
        except InputError:
            pass
    else:
        lines.append(_line("unit", _text(f"{FILL_IN}: unit of {signal.array} in the file, for instance m/s^2, g, N")))
    place, why = where.get(_key(signal), (f"{FILL_IN}: location of {signal.array}", ""))
    return [*lines, _line("location", _text(place), f"guess: {why}" if why else "")]


def _method(found: _Findings, where: dict[str, tuple[str, str]]) -> str:
    first = found.recordings[0][0]
    peak = first.peak
    joints = list(found.built.joints) if found.built is not None else [] if found.structure else [next(iter(where.values()))[0]]
    listed = "[" + ", ".join(map(_text, joints or [f"{FILL_IN}: locations where a joint may act"])) + "]"
    heldout = [r.path.stem for r, role in found.recordings if role == "holdout"]
    trained = next(r for r, role in found.recordings if role == "train")
    heldout = heldout or ([f"{trained.path.stem}, end"] if trained.rate is not None else [])
    lines = ["[identification]", _line("scenario", '"S2"', "S1: one equation, one mode; S2: one equation, all modes; S3: all equations"),
             _line("modes", "[1]", "guess: modes that the nonlinear part sees, counted from 1"), _line("main", "1"),
             _line("free_modes", "[1]", "their frequency and damping are estimated too")]
    if peak is not None:
        low, high = 0.8 * peak[1], min(1.2 * peak[2], 0.45 * (first.rate or 0.0))
        lines.append(_line("band", f'["{max(low, 0.3 * peak[0]):.3g} Hz", "{max(high, 1.5 * peak[0]):.4g} Hz"]',
                           "guess: where its power lies; if no other mode is near, reach beyond three times the mode, for harmonics"))
    lines += [_line("joints", listed, "where force laws may act"), '# guess; see nlsid terms; "table1" is all of the published table',
              'candidates = ["cubic", "q|q|", "|q|v", "v|v|", "coulomb", "jenkins"]', _line("starts", "20"), "",
              "[posterior]", _line("ensembles", "4"), "", "[prediction]"]
    strongest = max((s for s in first.signals if s.quantity != "force"), key=lambda s: s.rms, default=first.signals[0])
    lines += [_line("at", _text(where[_key(strongest)][0]), "guess: the strongest channel"), _line("amplitude", _amplitude(strongest, peak),
                    "guess: its largest displacement, from its rms and frequency" if peak and strongest.unit else ""), _line("mode", "1"),
              _line("samples", "50"), _line("heldout", "[" + ", ".join(map(_text, heldout)) + "]"), ""]
    return "\n".join(lines)


def _amplitude(signal: Signal, peak: tuple[float, float, float] | None) -> str:
    """About the largest displacement of a channel, in m, if its unit is known."""
    orders = {"displacement": 0, "velocity": 1, "acceleration": 2}
    if peak is None or not signal.unit or signal.quantity not in orders:
        return _text(f"{FILL_IN}: where a released decay starts, m")
    try:
        factor = unit_factor(signal.unit, signal.quantity)
    except InputError:
        return _text(f"{FILL_IN}: where a released decay starts, m")
    return f"{3 * factor * signal.rms / (2 * math.pi * peak[0]) ** orders[signal.quantity]:.2g}"
