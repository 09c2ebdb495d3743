"""Universal files (UFF): time records from datasets 58 in text or binary, unit system from dataset 164.

Headers are parsed by pyuff. Where a dataset ends and its samples are found here, because pyuff 2.5 looks for the end mark inside binary
samples too (ladisk/pyuff#61), takes line ends behind them for samples, never compares their number with the header, fails on header
fields that exporters leave blank (#88), on exponents written with D, and on values separated by single blanks (#20, #22, #52).
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.isolation import Unreadable

Arrays = dict[str, NDArray[Any]]
QUANTITY = {8: "displacement", 9: "force", 11: "velocity", 12: "acceleration", 13: "force"}
DIRECTION = {0: "", **{sign * (i + 1): f"{'+' if sign > 0 else '-'}{axis}" for i, axis in enumerate(("X", "Y", "Z", "RX", "RY", "RZ"))
                       for sign in (1, -1)}}
_LENGTH_FORCE = {1: ("m", "N"), 2: ("ft", "lbf"), 3: ("m", "kgf"), 5: ("mm", "mN"), 7: ("in", "lbf"), 8: ("mm", "kgf"), 10: ("mm", "N")}
_OF_LENGTH = {"displacement": "", "velocity": "/s", "acceleration": "/s^2"}
_BYTES = {2: 4, 4: 8, 5: 8, 6: 16}  # of one ordinate, by ordinate data type
_HEADER = 11  # lines of a dataset 58 before its samples
_END = re.compile(rb"(?m)^ {0,5}-1[ \t]*\r?$")
_FUNCTIONS = {2: "auto spectra", 3: "cross spectra", 4: "frequency response functions", 6: "coherences", 9: "power spectral densities",
              12: "spectra"}


@final
@dataclass(frozen=True)
class Dataset:
    """One dataset of a universal file.

    Parameters
    ----------
    kind : int
        Its number, for instance 58.
    order : str
        ``"<"`` or ``">"`` for binary samples, empty for text.
    header : tuple of str
        Its first lines (all of them where samples do not follow in binary).
    body : bytes
        What comes after the header.
    """

    kind: int
    order: str
    header: tuple[str, ...]
    body: bytes


def datasets(data: bytes) -> list[Dataset]:
    """Every dataset of a universal file, in order.

    Raises
    ------
    Unreadable
        If it is not a universal file, or a dataset is not ended.
    """
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    out, position = [], 0
    while (start := _END.search(data, position)) is not None:
        lines, at = _lines(data, start.end() + 1, 1)
        kind = lines[0][:6].strip() if lines else ""
        if not kind.isdigit():
            raise Unreadable("is not a universal file: a line -1 is not followed by the number of a dataset")
        binary = lines[0][6:7].lower() == "b"
        stop, found = (_binary if binary else _text)(data, at, int(kind), lines[0])
        out.append(found)
        position = stop
    if not out:
        raise Unreadable("is not a universal file: it holds no line -1 that begins a dataset")
    return out


def _lines(data: bytes, position: int, count: int) -> tuple[list[str], int]:
    """``count`` lines from a position on, and where the next begins."""
    out = []
    for _ in range(count):
        if position >= len(data):
            break
        end = data.find(b"\n", position)
        end = len(data) if end < 0 else end
        raw = data[position:end].rstrip(b"\r")
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
        out.append("".join(c if c.isprintable() else " " for c in text))
        position = end + 1
    return out, position


def _text(data: bytes, at: int, kind: int, first: str) -> tuple[int, Dataset]:
    end = _END.search(data, at)
    if end is None:
        raise Unreadable(f"dataset {kind} is not ended by a line -1: the file is cut short")
    count = _HEADER if kind == 58 else data.count(b"\n", at, end.start())
    header, body = _lines(data[:end.start()], at, count)
    return end.end(), Dataset(kind, "", tuple(header), data[body:end.start()])


def _binary(data: bytes, at: int, kind: int, first: str) -> tuple[int, Dataset]:
    """Binary samples have the length that the header gives; only behind them is the end mark looked for."""
    if kind != 58:
        raise Unreadable(f"holds a binary dataset {kind}, which is not known")
    order, form = first[7:13].strip(), first[13:19].strip()
    if order not in ("1", "2") or form not in ("2", "0", ""):
        raise Unreadable("holds numbers that are not in IEEE format", "export it with IEEE numbers, or as text")
    header, body = _lines(data, at, _HEADER)
    fields = header[6].split() if len(header) == _HEADER else []
    if len(fields) < 3 or not all(f.isdigit() for f in fields[:3]) or int(fields[0]) not in _BYTES:
        raise Unreadable("holds a binary dataset 58 whose header is broken")
    size = _BYTES[int(fields[0])] * int(fields[1])
    if fields[2] == "0":
        size += int(fields[1]) * (4 if int(fields[0]) in (2, 5) else 8)
    if body + size > len(data):
        raise Unreadable("holds a binary dataset 58 that is cut short")
    end = re.compile(rb"[\r\n ]*-1[ \t]*(\r|\n|$)").match(data, body + size) or _END.search(data, body + size)
    if end is None:
        raise Unreadable("holds a binary dataset 58 that is not ended by a line -1: the file is cut short")
    return end.end(), Dataset(kind, "<" if order == "1" else ">", tuple(header), data[body:body + size])


def parsed(entries: list[Dataset]) -> list[dict[str, Any]]:
    """What pyuff reads of each dataset: the header of a 58, the whole of others; an empty dictionary for kinds it does not know.

    Raises
    ------
    Unreadable
        Naming the dataset that cannot be read.
    """
    import pyuff

    text = "".join(f"    -1\n{e.kind:6d}\n" + "".join(f"{line[:80].rstrip()}\n" for line in _filled(e)) + "    -1\n" for e in entries)
    with tempfile.TemporaryDirectory(prefix="nlsid") as folder:
        path = Path(folder) / "headers.uff"
        path.write_text(text, encoding="utf-8")
        file = pyuff.UFF(str(path))
        if file.get_n_sets() != len(entries):
            raise Unreadable("is not a universal file that can be told into datasets")
        out = []
        for i, entry in enumerate(entries):
            try:
                found = file.read_sets(i, header_only=entry.kind == 58)
            except Exception:  # pyuff raises bare exceptions that say no more than the number
                raise Unreadable(f"dataset {i + 1} (number {entry.kind}) is broken") from None
            out.append(dict(found) if isinstance(found, dict) else {})
    return out


def _filled(entry: Dataset) -> list[str]:
    """Header lines with blank numbers written as 0 and exponents written with E, as pyuff needs them."""
    lines = list(entry.header)
    if entry.kind != 58:
        return lines
    lines += [""] * (_HEADER - len(lines))
    lines[5] = _zeros(lines[5], (5, 10, 5, 10, -11, 10, 4, -11, 10, 4))
    lines[6] = _zeros(lines[6].replace("D", "E").replace("d", "E"), (10, 10, 10, 13, 13, 13))
    for i in range(7, 11):
        lines[i] = _zeros(lines[i], (10, 5, 5, 5))
    return lines


def _zeros(line: str, widths: tuple[int, ...]) -> str:
    """Blank fields of positive width filled with 0; text fields have negative widths."""
    out, at = "", 0
    for width in widths:
        field = f"{line[at:at + abs(width)]:<{abs(width)}}"
        out += field if field.strip() or width < 0 else "0".rjust(width)
        at += abs(width)
    return out + line[at:]


def read_universal(data: bytes) -> tuple[Arrays, dict[str, str], dict[str, str]]:
    """Arrays of the time records, called ``<node><direction>`` (``12+Z``, a repeated one ``12+Z #2``), units and quantities.

    ``rate`` (Hz) or ``time`` (s) are there when all records share them, and ``rate of <name>`` or ``time of <name>`` in any case.

    Raises
    ------
    Unreadable
        If a dataset is broken, or none is a time record.
    """
    entries = [e for e in datasets(data) if e.kind in (58, 164)]
    headers = parsed(entries)
    system = next((h.get("units_code") for h in headers if h.get("type") == 164), None)
    arrays: Arrays = {}
    clocks: dict[str, list[NDArray[Any]]] = {"rate": [], "time": []}
    units: dict[str, str] = {}
    quantities: dict[str, str] = {}
    others = []
    for entry, header in zip(entries, headers, strict=True):
        if entry.kind != 58:
            continue
        if header["ord_data_type"] not in (2, 4) or not (header["func_type"] == 1 or header["abscissa_spec_data_type"] == 17):
            others.append(_FUNCTIONS.get(header["func_type"], "other functions"))
            continue
        name = _name(header, arrays)
        samples = _samples(entry, header)
        clock = "rate" if header["abscissa_spacing"] else "time"
        arrays[name] = samples[:, -1]
        arrays[f"{clock} of {name}"] = np.asarray(_rate(float(header["abscissa_inc"]))) if clock == "rate" else samples[:, 0]
        clocks[clock].append(arrays[f"{clock} of {name}"])
        quantity = QUANTITY.get(header["ordinate_spec_data_type"])
        if quantity is not None:
            quantities[name] = quantity
        units[name] = _unit(header, quantity, system)
    if not quantities and not any(clocks.values()):
        what = f"{len(others)} {others[0]}" if others else "no function"
        raise Unreadable(f"holds {what} and no time record", "export the time histories as datasets 58 of function type 1")
    for clock, values in clocks.items():
        if values and not clocks["rate" if clock == "time" else "time"] and all(np.array_equal(v, values[0]) for v in values):
            arrays[clock] = values[0]
    return arrays, units, quantities


def _name(header: dict[str, Any], taken: Arrays) -> str:
    """``12+Z``; for a scalar without a node the name of the entity, or the first line."""
    node, said = header["rsp_node"], [header.get(k, "").strip() for k in ("rsp_ent_name", "id1")]
    name = f"{node}{DIRECTION.get(header['rsp_dir'], '')}" if node else next((s for s in said if s and s.upper() != "NONE"), "channel")
    count, free = 1, name
    while free in taken:
        count += 1
        free = f"{name} #{count}"
    return free


def _rate(step: float) -> float:
    """Hz: the shortest number that gives the step as it was printed (E13.5 holds six digits)."""
    if not (step > 0 and np.isfinite(step)):
        raise Unreadable("holds a record whose time step is not positive")
    for digits in range(1, 16):
        rate = float(f"{1 / step:.{digits}g}")
        if f"{1 / rate:.5e}" == f"{step:.5e}":
            return rate
    return 1 / step


def _unit(header: dict[str, Any], quantity: str | None, system: Any) -> str:
    """The label beside the ordinate, or what the unit system of dataset 164 makes of the quantity."""
    label = str(header.get("ordinate_axis_units_lab", "")).strip()
    if label and label.upper() != "NONE":
        return label
    if quantity is None or system not in _LENGTH_FORCE:
        return ""
    length, force = _LENGTH_FORCE[system]
    return force if quantity == "force" else length + _OF_LENGTH[quantity]


def _samples(entry: Dataset, header: dict[str, Any]) -> NDArray[np.float64]:
    """(n, 1) ordinates, or (n, 2) abscissae and ordinates; their number must be the one that the header gives."""
    double, even = header["ord_data_type"] == 4, bool(header["abscissa_spacing"])
    count = int(header["num_pts"]) * (1 if even else 2)
    if entry.order:
        values = np.frombuffer(entry.body, dtype=f"{entry.order}f{8 if double else 4}").astype(float)
    else:
        values = _numbers(entry.body, [20] if double and even else [13, 20] if double else [13], count)
    if len(values) != count or count < 2:
        raise Unreadable(f"dataset 58 of node {header['rsp_node']} holds {len(values)} numbers where its header says {count}")
    return values.reshape(-1, 1 if even else 2)


def _numbers(body: bytes, widths: list[int], count: int) -> NDArray[np.float64]:
    """Numbers in columns of fixed width, or between blanks where that gives the number of them that is due."""
    text = body.decode("latin-1").replace("D", "E").replace("d", "e")
    try:
        free = np.fromstring(text, sep=" ")
    except (ValueError, DeprecationWarning):
        free = np.zeros(0)
    if len(free) == count:
        return free
    out: list[float] = []
    try:
        for line in text.splitlines():
            at, k = 0, 0
            while line[at:].strip():
                width = widths[k % len(widths)]
                out.append(float(line[at:at + width]))
                at, k = at + width, k + 1
    except ValueError:
        raise Unreadable("holds a dataset 58 with samples that are no numbers") from None
    return np.array(out)
