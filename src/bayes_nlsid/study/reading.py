"""A study file to a checked `Study`: every mistake is one sentence with file, key and mend."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.reading import ChannelSpec, RecordingSpec
from bayes_nlsid.recordings.units import unit_factor
from bayes_nlsid.study.consistency import check_consistency
from bayes_nlsid.study.reading_extras import read_compare, read_frf, read_montecarlo
from bayes_nlsid.study.reading_method import read_identification, read_posterior, read_prediction, read_report, read_terms
from bayes_nlsid.study.reading_plan import read_plan
from bayes_nlsid.study.reading_structure import read_reduction, read_structure
from bayes_nlsid.study.schema import LinearEntry, Study
from bayes_nlsid.study.store import file_digest
from bayes_nlsid.study.table import FILL_IN, Table, gaps, nearest, parse_toml

ROLES = ("train", "holdout", "noise", "linear")
QUANTITY_DIMENSION = {"acceleration": "acceleration", "velocity": "velocity", "displacement": "length", "force": "force"}
QUANTITIES = tuple(QUANTITY_DIMENSION)


def read_study(path: Path | str) -> Study:
    """Read and check a study file, and that everything it names exists.

    Parameters
    ----------
    path : Path or str
        TOML file; other files are named relative to it.

    Returns
    -------
    Study

    Raises
    ------
    InputError
        On the first thing that cannot be used.
    """
    file = Path(path)
    content = parse_toml(file, "give the path of a study file, or make one with nlsid new DIR")
    left = gaps(content)
    if left:
        raise InputError(file.name, f"{len(left)} entr{'y is' if len(left) == 1 else 'ies are'} still to be filled in: {'; '.join(left)}",
                         f'replace the texts that begin with "{FILL_IN}"')
    top = Table(file, "", content)
    title = top.text("title")
    seed = top.integer("seed", 0)
    outline = top.table("structure")
    if outline is None:
        raise InputError(f"{file.name}: [structure]", "is missing", 'add [structure] with kind = "beam", "matrices" or "oscillator"')
    structure, built = read_structure(outline)
    locations = tuple(built.locations)
    reduction = read_reduction(top.table("reduction"), structure)
    terms = read_terms(top)
    plan = read_plan(top.table("plan"), locations, terms)
    recordings = _read_recordings(top, locations, needed=plan is None)
    linear = _read_linear(top.table("linear"), recordings, locations)
    identification = read_identification(top.table("identification"), locations, terms)
    posterior = read_posterior(top.table("posterior"))
    names = tuple(r.name for r in recordings)
    prediction = read_prediction(top.table("prediction"), locations, names)
    report = read_report(top.table("report"))
    frf = read_frf(top.table("frf"), locations)
    scatter = top.table("montecarlo")
    compared = read_compare(top.table("compare"), identification is not None)
    top.close()
    montecarlo = read_montecarlo(scatter, locations, prediction, posterior is not None)
    later = {"posterior": posterior, "prediction": prediction, "frf": frf, "montecarlo": montecarlo}
    _check_order(file, identification is not None, later, recordings)
    others = [linear.file] if linear.file else []
    files = dict.fromkeys([*(p for _, p in structure.files), *others, *(Path(r.file) for r in recordings)])
    inputs = tuple((_relative(p, file.parent), file_digest(p)) for p in files)
    study = Study(file.resolve(), title, seed, structure, reduction, recordings, linear, identification, terms, posterior, prediction,
                  report, frf, montecarlo, locations, ((file.name, file_digest(file)), *inputs), plan, compared)
    check_consistency(study, built)
    return study


def _relative(path: Path, folder: Path) -> str:
    """As seen from the study's folder, so that the same study says the same wherever it lies; whole where they share nothing."""
    here = folder.resolve()
    shared = path.anchor == here.anchor and os.path.commonpath([path, here]) != here.anchor
    return Path(os.path.relpath(path, here)).as_posix() if shared else path.as_posix()


def _check_order(file: Path, identification: bool, later: Mapping[str, object], recordings: Sequence[RecordingSpec]) -> None:
    """Everything that uses a model needs one to be identified."""
    for asked, entry in later.items():
        if entry is not None and not identification:
            raise InputError(f"{file.name}: [{asked}]", "needs a table [identification], which is missing",
                             f"add [identification] or remove [{asked}]")
    if identification and not any(r.role == "train" for r in recordings):
        raise InputError(f"{file.name}: [[recordings]]", 'none has role = "train", so there is nothing to identify from',
                         'give one of them role = "train"')


def _read_recordings(top: Table, locations: Sequence[str], *, needed: bool = True) -> tuple[RecordingSpec, ...]:
    entries: list[RecordingSpec] = []
    for table in top.tables("recordings"):
        entry = _read_recording(table, entries, locations)
        if any(entry.name == other.name for other in entries):
            raise table.wrong("name", f"{entry.name!r} is used twice", "give every recording a name of its own")
        entries.append(entry)
    if needed and not entries:
        raise InputError(f"{top.file.name}: [[recordings]]", "there is none", "add at least one [[recordings]] entry")
    return tuple(entries)


def _read_recording(table: Table, earlier: Sequence[RecordingSpec], locations: Sequence[str]) -> RecordingSpec:
    """One entry; ``like`` takes over file, clock, window and channels of an earlier one."""
    like = table.text("like", None)
    base = next((r for r in earlier if r.name == like), None)
    if like is not None and base is None:
        raise table.wrong("like", f"{like!r} is not a recording above", nearest(like, [r.name for r in earlier]))
    file = table.path("file") if base is None else table.path("file", Path(base.file))
    name = table.text("name", file.stem)
    role = table.text("role", "train", ROLES)
    rate, time = _read_clock(table, base)
    time_unit = table.text("time_unit", base.time_unit if base else "")
    period = table.integer("period", None, low=2)
    start = table.number("start", "time", base.start if base else None)
    window = table.span("window", "time", base.window if base else None)
    channels = tuple(_read_channel(c, locations) for c in table.tables("channels"))
    if not channels and base is None:
        raise table.wrong("channels", "there is none", f"add [[recordings.channels]] for every signal of {file.name} to be used")
    channels = channels or (base.channels if base is not None else ())
    table.close()
    try:
        return RecordingSpec(str(file), name, channels, role, rate, time, time_unit, window, period, start)
    except InputError as error:
        raise InputError(f"{table.file.name}: {table.name} {error.where}", error.problem, error.mend) from None


def _read_clock(table: Table, base: RecordingSpec | None) -> tuple[float | str | None, str | None]:
    """``rate`` as a number (Hz), a text with its unit, or the name of the array that holds it; or ``time``, the name of an array."""
    has_rate, has_time = table.has("rate"), table.has("time")
    if has_rate and has_time:
        raise table.wrong("time", "is given beside rate", "keep one of them")
    if has_time:
        return None, table.text("time")
    if has_rate:
        value = table.raw("rate")
        if isinstance(value, str) and not value.strip()[:1].isdigit():
            return value, None
        return table.number("rate", "frequency", positive=True), None
    if base is not None:
        return base.rate, base.time
    raise table.wrong("rate", "is missing", 'add rate = 12800 (Hz), rate = "name of the array that holds it", or time = "name"')


def _read_channel(table: Table, locations: Sequence[str]) -> ChannelSpec:
    quantity, unit = table.text("quantity", choices=QUANTITIES), table.text("unit", "")  # empty: the one written in the file, if any
    per_volt = table.number("per_volt", default=None)
    volts = unit.strip().endswith("V")
    if volts and per_volt is None:
        raise table.wrong("unit", f"{unit!r} is a voltage and the quantity is {quantity}",
                          "add per_volt = ... , what one volt stands for in SI, or give the unit of the quantity")
    if per_volt is not None and unit and not volts:
        raise table.wrong("per_volt", f"is given beside unit {unit!r}", "give unit V or mV, or drop per_volt")
    try:
        if unit:
            unit_factor(unit, "voltage" if volts else quantity)
    except InputError as error:
        raise table.wrong("unit", f"{unit!r} {error.problem}", error.mend) from None
    location = table.text("location")
    if location not in locations:
        raise table.wrong("location", f"{location!r} is not a location of the structure", nearest(location, locations))
    polarity = table.integer("polarity", 1, low=-1, high=1)
    name = table.text("name", location if quantity != "force" else f"force at {location}")
    array, column = table.text("array"), table.integer("column", None)
    offset = table.number("offset", default=0.0)
    noise = None if not table.has("noise") else table.number("noise", QUANTITY_DIMENSION[quantity])
    if noise is not None and noise < 0:
        raise table.wrong("noise", f"{noise:g} is negative", "write the rms of the sensor's noise, 0 for a simulation")
    if polarity == 0 or per_volt == 0:
        key = "polarity" if polarity == 0 else "per_volt"
        raise table.wrong(key, "is 0", "write 1, or -1 for a sensor mounted the other way round" if key == "polarity"
                          else "give the sensitivity")
    table.close()
    return ChannelSpec(array, quantity, unit, location, name, column, polarity, per_volt, offset, noise)


def _read_update(table: Table) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """``update = ["E"]``, or a table ``[linear.update]`` of groups that share one factor: ``joints = ["J1_slip", "J2_slip"]``."""
    if not isinstance(table.raw("update", None), dict):
        return tuple((name, (name,)) for name in table.texts("update", ()))
    inner = table.table("update")
    groups = () if inner is None else tuple((key, inner.texts(key)) for key in inner.keys())
    for key, parts in groups:
        if not parts:
            raise table.wrong("update", f"group {key!r} names no parts", "name parts of the structure, or remove the group")
    return groups


def _read_modal_test(table: Table, recording: str | None, locations: Sequence[str]) -> tuple[Path | None, tuple[tuple[str, str], ...]]:
    """``file`` with modes that another program found, and ``[linear.sensors]``: location = name in that file."""
    file, inner = table.path("file", None), table.table("sensors")
    sensors = () if inner is None else tuple((key, inner.text(key)) for key in inner.keys())
    if file is not None and recording is not None:
        raise table.wrong("file", "is given beside recording", "keep one of them: modes come from one source")
    unknown = [name for name, _ in sensors if name not in locations]
    if unknown:
        raise table.wrong("sensors", f"{unknown[0]!r} is not a location of the structure", nearest(unknown[0], locations))
    if file is not None:
        from bayes_nlsid.structure.modal_results import read_modal_results

        read_modal_results(file, locations, dict(sensors))
    return file, sensors


def _read_linear(table: Table | None, recordings: Sequence[RecordingSpec], locations: Sequence[str]) -> LinearEntry:
    if table is None:
        return LinearEntry()
    names = [r.name for r in recordings]
    recording = table.text("recording", None)
    if recording is not None and recording not in names:
        raise table.wrong("recording", f"there is no recording {recording!r}", nearest(recording, names))
    update = _read_update(table)
    file, sensors = _read_modal_test(table, recording, locations)
    entry = LinearEntry(recording, table.span("window", "time", None), table.integers("modes", ()), update,
                        table.numbers("damping", "ratio", ()), table.flag("use_measured", True), file, sensors)
    if update and recording is None and file is None:
        raise table.wrong("update", "names parts to update, but no recording to take modes from", 'add recording = "name" or file = "..."')
    if any(not 0 < z < 1 for z in entry.damping):
        raise table.wrong("damping", f"{list(entry.damping)} holds a ratio outside 0 to 1", 'write ratios such as 0.001 or "0.1 %"')
    table.close()
    return entry
