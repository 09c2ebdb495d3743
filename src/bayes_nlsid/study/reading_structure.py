"""``[structure]`` and ``[reduction]`` of a study file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.units import unit_factor
from bayes_nlsid.structure.beam import LappedBeam
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.structure import Structure
from bayes_nlsid.study.building import build_structure
from bayes_nlsid.study.schema import ReductionEntry, StructureEntry
from bayes_nlsid.study.table import Table, nearest

_DIMENSION = {
    "length": "length", "width": "length", "height": "length", "E": "pressure", "rho": "density", "nu": "number", "G": "pressure",
    "shear_factor": "number", "element_size": "length", "lap": "length", "stations": "length", "patch": "length",
    "tangential": "stiffness", "normal": "stiffness", "rotation": "rotational stiffness",
}
_SERIES = ("lap", "stations")
_PLACES = ("sensors", "inputs", "points")
_SPRINGS = ("tangential", "normal", "rotation")
GROUPS = ("sensors", "inputs", "joints")


def read_structure(table: Table) -> tuple[StructureEntry, Structure | ModalModel]:
    """The structure's entry and the structure itself, which is built to be sure that it can be.

    Raises
    ------
    InputError
        If a key is wrong, or the builder refuses the values.
    """
    kind = table.text("kind", choices=("beam", "matrices", "oscillator"))
    read: dict[str, Callable[[Table], StructureEntry]] = {"beam": _beam, "matrices": _matrices, "oscillator": _oscillator}
    entry = read[kind](table)
    table.close()
    try:
        built = build_structure(entry)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{table.file.name}: {table.name}", str(error), "correct these values") from None
    return entry, built


def _beam(table: Table) -> StructureEntry:
    values: dict[str, Any] = {}
    for spec in fields(LappedBeam):
        name = spec.name
        if spec.default is MISSING and not table.has(name):
            table.raw(name)  # raises the sentence of a missing key
        if name in _PLACES:
            value: Any = _positions(table, name)
        elif name in ("boundary", "side"):
            value = table.text(name, None)
        elif name == "bolts":
            value = tuple((t.number("at", "length"), t.number("mass", "mass")) for t in _closing(table, name, ("at", "mass")))
        elif name == "masses":
            value = tuple((t.text("name"), t.number("at", "length"), t.number("mass", "mass"))
                          for t in _closing(table, name, ("name", "at", "mass")))
        elif name in _SERIES:
            value = table.numbers(name, _DIMENSION[name], None)
        elif name in _SPRINGS:
            value = _springs(table, name)
        else:
            value = table.number(name, _DIMENSION.get(name, "number"), None)
        if value is not None and value != ():
            values[name] = value
    if "lap" in values and len(values["lap"]) != 2:
        raise table.wrong("lap", f"{len(values['lap'])} values are given", "write lap = [start, end]")
    return StructureEntry("beam", tuple(values.items()))


def _closing(table: Table, key: str, known: tuple[str, ...]) -> list[Table]:
    """Inner tables, each closed against unknown keys before its values are taken."""
    inner = list(table.tables(key))
    for one in inner:
        for name in known:
            one.has(name)
        one.close()
    return inner


def _springs(table: Table, name: str) -> Any:
    """One stiffness, one for each station, or false to leave the direction out."""
    value = table.raw(name, None)
    if value is None:
        return None
    if value is False:
        return False
    many = table.numbers(name, _DIMENSION[name])
    return many if isinstance(value, list) else many[0]


def _positions(table: Table, name: str) -> tuple[tuple[str, float], ...]:
    """``[structure.sensors]``: name = position."""
    inner = table.table(name)
    return () if inner is None else tuple((key, inner.number(key, "length")) for key in inner.keys())


def _matrices(table: Table) -> StructureEntry:
    """``mass`` names an npz archive of everything, or the file of a finite-element program that ``stiffness`` belongs to."""
    from bayes_nlsid.structure.matrix_files import SEVERAL

    files: list[tuple[str, Path]] = [("mass", table.path("mass"))]
    complete = files[0][1].suffix.lower() in (".npz", *SEVERAL)
    for key in ("stiffness", "damping", "locations"):
        if table.has(key):
            files.append((key, table.path(key)))
    if not complete and "stiffness" not in dict(files):
        raise table.wrong("stiffness", "is missing", "name the stiffness matrix that goes with mass, or give one npz archive as mass")
    values: dict[str, Any] = {key: table.texts(key, None) for key in GROUPS}
    values |= {key: table.text(key, None) for key in ("length_unit", "force_unit", "mass_name", "stiffness_name", "damping_name")}
    rotations = table.items("rotations", None)
    values["rotations"] = None if rotations is None else tuple(map(str, rotations))
    for key, dimension in (("length_unit", "displacement"), ("force_unit", "force")):
        try:
            unit_factor(values[key] or {"displacement": "m", "force": "N"}[dimension], dimension)
        except InputError as error:
            raise table.wrong(key, f"{values[key]!r} {error.problem}", error.mend) from None
    return StructureEntry("matrices", tuple((k, v) for k, v in values.items() if v is not None), tuple(files))


def _oscillator(table: Table) -> StructureEntry:
    """Mass with stiffness or frequency, damping coefficient or ratio."""
    mass = table.number("mass", "mass", 1.0, positive=True)
    if table.has("stiffness") == table.has("frequency"):
        raise table.wrong("stiffness", "and frequency must not both be given or both be missing", "give one of them")
    if table.has("damping") and table.has("zeta"):
        raise table.wrong("damping", "and zeta are both given", "keep one of them")
    stiffness = table.number("stiffness", "stiffness", None)
    if stiffness is not None and stiffness < 0:
        raise table.wrong("stiffness", f"is {stiffness:g}", "give a positive value, or 0 for a mass that moves freely")
    values = {"mass": mass, "stiffness": stiffness,
              "frequency": table.number("frequency", "frequency", None, positive=True), "damping": table.number("damping", "damping", None),
              "zeta": table.number("zeta", "ratio", None), "location": table.text("location", "x"), "sensors": table.texts("sensors", None),
              "inputs": table.texts("inputs", None)}
    return StructureEntry("oscillator", tuple((k, v) for k, v in values.items() if v is not None))


def read_reduction(table: Table | None, structure: StructureEntry) -> ReductionEntry:
    """``[reduction]``; the default keeps the full model."""
    if table is None:
        return ReductionEntry()
    method = table.text("method", "none", ("none", "guyan", "iirs"))
    if structure.kind == "oscillator" and method != "none":
        raise table.wrong("method", "an oscillator has nothing to reduce", 'remove [reduction] or write method = "none"')
    masters = table.texts("masters", GROUPS)
    entry = ReductionEntry(method, masters, table.integer("modes", None, low=1), table.integer("iterations", 30, low=1),
                           table.number("damping", "ratio", None, positive=True))
    if entry.damping is not None and entry.damping >= 1:
        raise table.wrong("damping", f"{entry.damping:g} is not below critical damping", 'write a ratio such as 0.001 or "0.1 %"')
    if method == "none" and table.has("masters"):
        raise table.wrong("masters", "is given, but method is none",
                          f"write a method ({nearest('iirs', ('guyan', 'iirs'))}), or remove masters")
    table.close()
    return entry
