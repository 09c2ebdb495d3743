"""Files to named arrays: npz, text, MATLAB, HDF5, universal files and TDMS, each read from the bytes whose hash is kept.

A damaged, foreign, pickled or oversized file is bad input, whatever the parser beneath makes of it: only `InputError` leaves here.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.isolation import Unreadable, parse_apart
from bayes_nlsid.recordings.units import is_unit

MAX_BYTES = 2**30  # of a file, and of what it unpacks to
PARSER = Path(__file__).with_name("foreign.py")
Arrays = dict[str, NDArray[Any]]


@final
@dataclass(frozen=True)
class Contents:
    """What a file holds.

    Parameters
    ----------
    path : str
    arrays : dict of str to ndarray
        Numeric arrays as stored, columns last.
    units : dict of str to str
        Units found beside the names, if any.
    sha256 : str
        Of the bytes that were parsed.
    quantities : dict of str to str
        What an array measures, where the file says so.
    unusable : dict of str to str
        Arrays that are there but hold no real numbers, and what they hold.
    """

    path: str
    arrays: Arrays
    units: Mapping[str, str]
    sha256: str
    quantities: Mapping[str, str] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class Parsed:
    """What a reader makes of the bytes of a file."""

    arrays: Arrays
    units: Mapping[str, str] = field(default_factory=dict)
    quantities: Mapping[str, str] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)


def read_file(path: str | Path) -> Contents:
    """All numeric arrays of a file, by the reader of its suffix.

    Raises
    ------
    InputError
        If the file is missing, too large, of an unknown kind, or cannot be read as what its suffix says.
    """
    file = Path(path)
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        raise InputError(str(file), f"files of kind {file.suffix or 'without a suffix'!r} are not read",
                         f"give one of {', '.join(sorted(READERS))}")
    try:
        size = file.stat().st_size
        if size > MAX_BYTES:
            raise InputError(str(file), f"holds {size / 2**20:.0f} MiB, more than the {MAX_BYTES / 2**20:.0f} MiB that are read at once",
                             "cut it into shorter recordings")
        data = file.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        if isinstance(error, InputError):
            raise
        raise InputError(str(file), f"cannot be opened ({getattr(error, 'strerror', None) or error})", "check the path") from error
    if not data:
        raise InputError(str(file), "is empty", "export the recording again")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = reader(data)
    except Unreadable as error:
        raise InputError(str(file), error.problem, error.mend) from error
    except Exception as error:  # the parsers document no closed set of exceptions for damaged files
        detail = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(str(file), f"cannot be read as {file.suffix.lower()} ({detail})",
                         "it is damaged, cut short or of another kind: export it again") from error
    if not found.arrays:
        raise InputError(str(file), "holds no numeric array", "export the recording again")
    return Contents(str(file), found.arrays, found.units, hashlib.sha256(data).hexdigest(), found.quantities, found.unusable)


# ---------------------------------------------------------------------------------------------------------------------- npz

_KINDS = {"c": "complex numbers", "U": "text", "S": "text", "M": "dates", "m": "time spans", "V": "records of several fields"}


def _read_npz(data: bytes) -> Parsed:
    """Arrays of an npz archive; declared sizes are checked against the archive before anything is unpacked."""
    arrays: Arrays = {}
    unusable: dict[str, str] = {}
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise Unreadable("is not an npz archive", "it is cut short or of another kind: save it with numpy.savez")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
        _check_unpacked(sum(m.file_size for m in members))
        for member in members:
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, fortran, dtype = read(stream)
                name = member.filename.removesuffix(".npy")
                if dtype.hasobject:
                    raise Unreadable(f"array {name!r} holds pickled Python objects, which are never loaded", "save plain numeric arrays")
                count = int(np.prod([int(i) for i in shape], dtype=object)) if shape else 1
                if count * dtype.itemsize > member.file_size:
                    raise Unreadable(f"array {name!r} is cut short", "save the file again")
                if dtype.kind in "fiub":
                    values = np.frombuffer(stream.read(count * dtype.itemsize), dtype=dtype, count=count)
                    arrays[name] = values.reshape(shape, order="F" if fortran else "C")
                else:
                    unusable[name] = _KINDS.get(dtype.kind, f"entries of type {dtype}")
    return Parsed(arrays, unusable=unusable)


def _check_unpacked(size: int) -> None:
    if size > MAX_BYTES:
        raise Unreadable(f"unpacks to {size / 2**20:.0f} MiB, more than the {MAX_BYTES / 2**20:.0f} MiB that are read at once",
                       "cut it into shorter recordings")


# --------------------------------------------------------------------------------------------------------------------- text

_NAME = re.compile(r"\s*(.*?)\s*(?:[\[(]([^\[\]()]*)[\])])?\s*")
_COMMENT = ("#", "%", "//", "!")
_MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}


def _read_text(data: bytes) -> Parsed:
    """Columns of delimited text under a header row; units may follow the names in brackets."""
    if b"\0" in data[:4096] and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise Unreadable("is not text", "give the suffix that belongs to the file")
    lines, numbers = _lines(data)
    if len(lines) < 2:
        raise Unreadable("holds no header row followed by numbers", "write the names of the columns in the first row")
    separator = next((s for s in ("\t", ";", ",") if s in lines[0]), None)
    header = [_NAME.fullmatch(cell.strip().strip('"')) for cell in _cells(lines[0], separator)]
    names = [m.group(1).strip('"') if m else "" for m in header]
    if any(_number(cell) is not None for cell in _cells(lines[0], separator)):
        raise Unreadable("has no header row", "write the names of the columns in the first row")
    if len(set(names)) != len(names):
        raise Unreadable(f"repeats the column name {next(n for n in names if names.count(n) > 1)!r}", "give every column its own name")
    rows = lines[1:]
    if separator != "," and not any("." in row for row in rows[:100]) and any("," in row for row in rows):
        rows = [row.replace(",", ".") for row in rows]
    table = _table(rows, numbers[1:], separator, len(names))
    units = {name: m.group(2).strip() for name, m in zip(names, header, strict=True) if m is not None and m.group(2)}
    return Parsed({name: table[:, i] for i, name in enumerate(names) if name}, units)


def _lines(data: bytes) -> tuple[list[str], list[int]]:
    """Lines that are neither blank nor comments, and their numbers in the file."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")  # what older test systems write, for µ and ²; it never fails
    lines, numbers = [], []
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith(_COMMENT) and not re.fullmatch(r"sep=.", stripped):
            lines.append(line.strip(" "))
            numbers.append(number)
    return lines, numbers


def _cells(line: str, separator: str | None) -> list[str]:
    """Cells of one line; without a separator, whatever stands between blanks, a bracketed unit staying with its name."""
    if separator is not None:
        return line.split(separator)
    return re.sub(r"\s+(?=[\[(])", "", line).split()


def _number(cell: str) -> float | None:
    try:
        return float(cell.replace(",", ".").strip().strip('"'))
    except ValueError:
        return None


def _table(rows: list[str], numbers: list[int], separator: str | None, width: int) -> NDArray[np.float64]:
    """Rows as numbers; the slow road is taken only to find missing cells, or to say where the text is no number."""
    try:
        table = np.loadtxt(rows, delimiter=separator, comments=None, ndmin=2)
        if table.shape[1] == width:
            return np.asarray(table, dtype=float)
    except ValueError:
        pass
    out = np.empty((len(rows), width))
    for i, (row, number) in enumerate(zip(rows, numbers, strict=True)):
        cells = _cells(row, separator)
        if len(cells) == width + 1 and not cells[-1].strip():
            cells = cells[:-1]
        if len(cells) != width:
            raise Unreadable(f"line {number} has {len(cells)} cells, the header {width}", "mend that line, or export the file again")
        for j, cell in enumerate(cells):
            text = cell.strip().strip('"').lower()
            try:
                out[i, j] = np.nan if text in _MISSING else float(text)
            except ValueError:
                raise Unreadable(f"line {number}, column {j + 1} is no number: {cell.strip()[:30]!r}",
                               "mend that cell, or leave it empty and choose a window without it") from None
    return out


# --------------------------------------------------------------------------------------- MATLAB, HDF5, TDMS, universal files

def _read_foreign(kind: str, data: bytes) -> Parsed:
    """Arrays of a file whose parser is compiled code that a damaged file can crash: it runs in a process of its own."""
    archive = parse_apart(PARSER, (kind, str(MAX_BYTES)), data, MAX_BYTES)
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        units = json.loads(opened.read("labels.json"))
    return Parsed(_read_npz(archive).arrays, {name: unit for name, unit in units.items() if is_unit(unit)})


def _read_universal(data: bytes) -> Parsed:
    from bayes_nlsid.recordings.universal import read_universal

    arrays, units, quantities = read_universal(data)
    return Parsed(arrays, {name: unit for name, unit in units.items() if is_unit(unit)}, quantities)


_HDF5, _MATLAB, _TDMS = (partial(_read_foreign, kind) for kind in ("hdf5", "mat", "tdms"))
READERS: dict[str, Callable[[bytes], Parsed]] = {
    ".npz": _read_npz, ".csv": _read_text, ".txt": _read_text, ".tsv": _read_text, ".mat": _MATLAB, ".h5": _HDF5, ".hdf5": _HDF5,
    ".uff": _read_universal, ".unv": _read_universal, ".uf": _read_universal, ".tdms": _TDMS,
}
