"""The files of a case folder: ``case.json`` checked field by field, archives read without trusting what they say of themselves."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.matrices import read_archive

LARGEST = 10**9   # of a line, a size or a count that a case states


def read_meta(path: Path) -> dict[str, Any]:
    """``case.json``, without entries that are null: what is left is of the kind that its field says, or absent.

    Raises
    ------
    InputError
        With file, field and mend.
    """
    if not path.is_file():
        raise InputError(str(path), "file not found", "give the folder of a case (case.json, nominal.npz, one .npz per record)")
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        raise InputError(str(path), f"not valid JSON ({' '.join(str(error).split())[:120]})", "repair the file") from None
    if not isinstance(meta, dict) or not isinstance(meta.get("records"), list) or not meta["records"]:
        raise InputError(f"{path}: records", "missing or empty", "list the records with name, level, kind, start_s, sealed")
    meta = {key: value for key, value in meta.items() if value is not None}
    for key, (fits, what) in _FIELDS.items():
        if key in meta and not fits(meta[key]):
            raise InputError(f"{path}: {key}", f"is not {what}", "correct it, or leave it out")
    meta["tolerances"] = {key: value for key, value in meta.get("tolerances", {}).items() if value is not None}
    for key, value in meta["tolerances"].items():
        if not (_number(value) and value > 0):
            raise InputError(f"{path}: tolerances.{key}", "is not a number above zero", "state it as a share of the value")
    for key in ("locations", "geometry"):
        if key in meta:
            meta[key] = {name: value for name, value in under(meta, key).items() if value is not None}
    for key in ("sensors", "joints", "mass_points", "other"):
        if not _texts(under(meta, "locations").get(key, [])):
            raise InputError(f"{path}: locations.{key}", "is not a list of names", "list the names as texts")
    if not isinstance(under(meta, "geometry").get("sensors", []), list):
        raise InputError(f"{path}: geometry.sensors", "is not a list", "list the sensors, each with its name and place")
    meta["records"] = [_entry(entry, path) for entry in meta["records"]]
    return meta


def _entry(entry: Any, path: Path) -> Any:
    if not isinstance(entry, dict):
        return entry
    entry = {key: value for key, value in entry.items() if value is not None}
    for key, (fits, what) in _OF_A_RECORD.items():
        if key in entry and not fits(entry[key]):
            raise InputError(f"{path}: records, {key} of {str(entry.get('name', 'an entry'))[:60]!r}", f"is not {what}",
                             "correct it, or leave it out")
    return entry


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300 and math.isfinite(value)


def _positive(value: Any) -> bool:
    return _number(value) and value >= 0


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) and v for v in value)


def _lines(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v < LARGEST for v in value)


def _pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_number(v) for v in value)


def _file_name(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) < 200 and value.isprintable() and Path(value).name == value


_FIELDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "fs_hz": (_positive, "a number, Hz"), "period_s": (_positive, "a number from zero up, s"), "mains_hz": (_positive, "a number, Hz"),
    "nominal_damping_ratio": (_positive, "a number from zero up"), "band_hz": (_pair, "a pair of frequencies, Hz"),
    "excited_lines": (_lines, "a list of whole numbers from zero up"), "classes": (_texts, "a list of names"),
    "locations": (lambda value: isinstance(value, dict), "a table"), "tolerances": (lambda value: isinstance(value, dict), "a table")}
_OF_A_RECORD: dict[str, tuple[Callable[[Any], bool], str]] = {
    "name": (_file_name, "the name of a file in the folder"), "level": (_positive, "a number from zero up"),
    "start_s": (_number, "a number, s"),
    "kind": (lambda value: isinstance(value, str), "a text"), "sealed": (lambda value: isinstance(value, bool), "true or false")}


def under(meta: dict[str, Any], key: str) -> dict[str, Any]:
    """A table inside ``case.json``; empty where there is none."""
    value = meta.get(key)
    return value if isinstance(value, dict) else {}


def load(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of one archive of the folder, numbers and names; numbers are real.

    Raises
    ------
    InputError
        If it is missing, damaged, too large, or holds something else.
    """
    if not path.is_file():
        raise InputError(str(path), "file not found", "put it beside case.json")
    arrays = read_archive(path)
    for name, array in arrays.items():
        if array.dtype.kind not in ("fiubU" if name.endswith("_names") else "fiub"):
            raise InputError(f"{path}: {name}", f"holds entries of type {array.dtype}", "store real numbers, and names as texts")
    return arrays
