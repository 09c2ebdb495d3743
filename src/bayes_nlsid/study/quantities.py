"""Numbers with units in a study file: ``0.72`` is SI, ``"720 mm"`` says its unit."""

from __future__ import annotations

import re

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.units import EXAMPLES, unit_factor

# factor to SI by dimension; what a sensor measures is in recordings.units
_TABLES: dict[str, dict[str, float]] = {
    "number": {},
    "ratio": {"%": 0.01},
    "mass": {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237},
    "inertia": {"kg m^2": 1.0, "kg*m^2": 1.0, "kg m2": 1.0, "g m^2": 1e-3},
    "stiffness": {"N/m": 1.0, "kN/m": 1e3, "MN/m": 1e6, "GN/m": 1e9, "N/mm": 1e3, "kN/mm": 1e6, "N/um": 1e6},
    "rotational stiffness": {"N m/rad": 1.0, "Nm/rad": 1.0, "kN m/rad": 1e3, "kNm/rad": 1e3},
    "damping": {"N s/m": 1.0, "Ns/m": 1.0, "kg/s": 1.0, "N*s/m": 1.0, "kN s/m": 1e3},
    "density": {"kg/m^3": 1.0, "kg/m3": 1.0, "g/cm^3": 1e3, "g/cm3": 1e3},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm^2": 1e6},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "mHz": 1e-3},
}
_SENSED = {"length": "displacement", "time": "time", "velocity": "velocity", "acceleration": "acceleration", "force": "force"}
_WRITTEN = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


def units_of(dimension: str) -> str:
    """Units that may be written for a dimension, for messages."""
    return EXAMPLES[_SENSED[dimension]] if dimension in _SENSED else ", ".join(_TABLES[dimension]) or "none"


def quantity(value: object, dimension: str, where: str) -> float:
    """A number in SI from a bare number (already SI) or a text such as ``"25.4 mm"``.

    Parameters
    ----------
    value : object
        As TOML gave it.
    dimension : str
        ``"length"``, ``"mass"``, ``"stiffness"``, ...; ``"number"`` takes no unit.
    where : str
        File, table and key, for the message.

    Raises
    ------
    InputError
        If it is not a number, or its unit is unknown or measures something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(where, f"is {_kind(value)}, not a number", f"write a number{_example(dimension)}")
    if not isinstance(value, str):
        return _finite(float(value), where)
    match = _WRITTEN.fullmatch(value)
    if match is None:
        raise InputError(where, f"{value!r} does not begin with a number", f"write a number{_example(dimension)}")
    number, unit = float(match.group(1)), match.group(2)
    if not unit and (dimension in _SENSED or _TABLES[dimension]) and dimension != "ratio":
        raise InputError(where, f"{value!r} is a text without a unit", f"write {value.strip()} without quotes for SI, or add its unit "
                         f"({units_of(dimension)})")
    if not unit:
        return _finite(number, where)
    return _finite(number * _factor(unit, dimension, where), where)


def _factor(unit: str, dimension: str, where: str) -> float:
    if dimension in _SENSED:
        try:
            return unit_factor(unit, _SENSED[dimension])
        except InputError as error:
            raise InputError(where, f"unit {unit!r} {error.problem}", error.mend) from None
    factor = _TABLES[dimension].get(" ".join(unit.replace("²", "^2").replace("³", "^3").replace("µ", "u").replace("·", " ").split()))
    if factor is None:
        if not _TABLES[dimension]:
            raise InputError(where, f"unit {unit!r} is not understood here", "write the bare number, in SI")
        raise InputError(where, f"unit {unit!r} is not a unit of {dimension}", f"use one of {units_of(dimension)}")
    return factor


def _finite(number: float, where: str) -> float:
    if number != number or number in (float("inf"), float("-inf")):
        raise InputError(where, f"is {number}", "write a finite number")
    return number


def _kind(value: object) -> str:
    names = {bool: "true or false", list: "a list", dict: "a table", str: "a text", int: "a number", float: "a number"}
    return names.get(type(value), type(value).__name__)


def _example(dimension: str) -> str:
    if dimension == "number":
        return ""
    return f" in SI, or a text with its unit ({units_of(dimension)})"
