"""Results of a modal test from a file: frequencies, damping and shapes as a table (CSV) or as universal datasets 55."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.isolation import Unreadable
from bayes_nlsid.recordings.readers import MAX_BYTES, read_file
from bayes_nlsid.structure.identified import IdentifiedModes, pair
from bayes_nlsid.structure.modal import ModalModel

FREQUENCY_SD, DAMPING_SD, SHAPE_SD = 1e-3, 0.1, 0.05
"""Relative standard deviations where the file gives none: what repeated modal tests of one assembly scatter by."""
LARGEST = 1e100   # of a shape in any unit; squares stay within the range of numbers
_FREQUENCY = {"Hz": 1.0, "kHz": 1e3, "rad/s": 1 / (2 * np.pi)}
_RATIO = {"%": 0.01, "1": 1.0, "-": 1.0, "ratio": 1.0}
_AXES = ("X", "Y", "Z", "RX", "RY", "RZ")


def read_modal_results(path: Path, locations: Sequence[str], sensors: Mapping[str, str] | None = None) -> IdentifiedModes:
    """Modes as a test program exported them.

    Parameters
    ----------
    path : Path
        ``.csv``, ``.txt``, ``.tsv``: one row for each mode; columns ``frequency [Hz]``, ``damping [%]`` (or ``[1]``), perhaps
        ``frequency_sd`` and ``damping_sd`` with units, and one column of the shape for each sensor.
        ``.uff``, ``.unv``: datasets 55, one for each mode; shapes are called ``<node><axis>``, for instance ``12Z``.
    locations : sequence of str
        Locations of the model.
    sensors : mapping, optional
        Name in the file of each location; a leading minus turns it round. By default names in the file that are locations.

    Returns
    -------
    IdentifiedModes
        Frequencies ascending; ``nominal`` counts from 0 and means nothing before `matched_to` is called.

    Raises
    ------
    InputError
        If the file cannot be read, a unit is missing, or no shape is found.
    """
    universal = path.suffix.lower() in (".uff", ".unv", ".uf")
    table = _universal(path) if universal else _text(path)
    wanted = dict(sensors or {name: name for name in table.shapes if name in locations})
    if not wanted:
        held = ", ".join(list(table.shapes)[:8]) or "there are none"
        raise InputError(str(path), f"none of its shapes ({held}) is called like a location",
                         'write [linear.sensors] with location = "name in the file"')
    columns = []
    for location, name in wanted.items():
        sign, plain = (-1.0, name[1:]) if name.startswith("-") and name not in table.shapes else (1.0, name)
        if plain not in table.shapes:
            raise InputError(str(path), f"holds no shape {plain!r} (for location {location!r})",
                             f"it holds {', '.join(list(table.shapes)[:12])}")
        if not (np.abs(table.shapes[plain]) < LARGEST).all():
            raise InputError(str(path), f"shape {plain!r} holds values that are no numbers", "export the modes again")
        columns.append(sign * table.shapes[plain])
    return _modes(path, table, tuple(wanted), np.array(columns))


def matched_to(measured: IdentifiedModes, model: ModalModel, wanted: Sequence[int]) -> IdentifiedModes:
    """Those of the modes that belong to ``wanted`` (0-based) modes of a model, each knowing which it is."""
    found = [(i, k) for i, k in pair(measured, model) if k in wanted]
    keep = [i for i, _ in found]
    left = [f"{measured.frequency[i]:.4g} Hz" for i in range(measured.modes) if i not in keep]
    notes = (*measured.notes, f"modes of the file that belong to none of the model's: {', '.join(left)}") if left else measured.notes
    return replace(measured, **{name: getattr(measured, name)[keep] for name in ("frequency", "zeta", "frequency_sd", "zeta_sd",
                                                                                "phase_scatter", "amplitude")},
                   shapes=measured.shapes[:, keep], shapes_sd=measured.shapes_sd[:, keep], nominal=tuple(k for _, k in found),
                   window=tuple(measured.window[i] for i in keep), status=tuple(measured.status[i] for i in keep), notes=notes)


@final
class _Table:
    """What a file says: (m,) Hz and ratios, standard deviations if given, complex shapes (m,) by name."""

    def __init__(self, frequency: NDArray[Any], zeta: NDArray[Any], shapes: dict[str, NDArray[Any]],
                 frequency_sd: NDArray[Any] | None = None, zeta_sd: NDArray[Any] | None = None) -> None:
        self.frequency, self.zeta, self.shapes, self.frequency_sd, self.zeta_sd = frequency, zeta, shapes, frequency_sd, zeta_sd


def _text(path: Path) -> _Table:
    contents = read_file(path)
    arrays = {name.strip(): np.atleast_1d(np.asarray(a, dtype=float)) for name, a in contents.arrays.items()}

    def column(name: str, factors: Mapping[str, float], example: str) -> NDArray[np.float64] | None:
        if name not in arrays:
            return None
        unit = contents.units.get(name, "").strip()
        if unit not in factors:
            raise InputError(str(path), f"column {name!r} has {f'the unknown unit {unit!r}' if unit else 'no unit'}",
                             f"head it {name} [{example}]")
        return factors[unit] * arrays[name]

    frequency, zeta = column("frequency", _FREQUENCY, "Hz"), column("damping", _RATIO, "%")
    if frequency is None or zeta is None:
        raise InputError(str(path), f"has no column {'frequency' if frequency is None else 'damping'}",
                         "head the columns frequency [Hz], damping [%] and one for each sensor")
    known = {"mode", "frequency", "damping", "frequency_sd", "damping_sd"}
    shapes: dict[str, NDArray[Any]] = {name: a.astype(complex) for name, a in arrays.items() if name.lower() not in known}
    return _Table(frequency, zeta, shapes, column("frequency_sd", _FREQUENCY, "Hz"), column("damping_sd", _RATIO, "%"))


def _universal(path: Path) -> _Table:
    from bayes_nlsid.recordings.universal import datasets, parsed

    try:
        if path.stat().st_size > MAX_BYTES:
            raise Unreadable("is larger than what is read at once", "export the modes alone")
        entries = [e for e in datasets(path.read_bytes()) if e.kind == 55]
        found = [h for h in parsed(entries) if h.get("analysis_type") in (2, 3, 7) and "r1" in h]
    except OSError as error:
        raise InputError(str(path), f"cannot be opened ({error.strerror})", "check the path") from error
    except Unreadable as error:
        raise InputError(str(path), error.problem, error.mend) from error
    if not found:
        raise InputError(str(path), "holds no mode", "export normal or complex modes as datasets 55")
    frequency, zeta = np.array([_pole(h) for h in found], dtype=float).T
    names = list(dict.fromkeys(name for h in found for name in _shape(h)))
    shapes = [_shape(h) for h in found]
    return _Table(frequency, zeta, {name: np.array([s[name] for s in shapes]) for name in names if all(name in s for s in shapes)})


def _pole(header: Mapping[str, Any]) -> tuple[float, float]:
    """Undamped frequency (Hz) and damping ratio of one dataset 55."""
    if header["analysis_type"] == 2:
        return float(header["freq"]), float(header["modal_damp_vis"])
    root = complex(header["eig"])
    return abs(root) / (2 * np.pi), -root.real / abs(root) if root else 0.0


def _shape(header: Mapping[str, Any]) -> dict[str, complex]:
    out: dict[str, complex] = {}
    for i, axis in enumerate(_AXES):
        values = header.get(f"r{i + 1}")
        if values is not None:
            out |= {f"{int(node)}{axis}": complex(v) for node, v in zip(header["node_nums"], values, strict=False)}
    return out


def _modes(path: Path, table: _Table, locations: tuple[str, ...], shapes: NDArray[Any]) -> IdentifiedModes:
    """Checked, ascending, with real shapes of largest entry 1."""
    good = np.isfinite(table.frequency) & (table.frequency > 0) & np.isfinite(table.zeta) & (table.zeta > 0) & (table.zeta < 1)
    if not good.all():
        i = int(np.argmin(good))
        raise InputError(str(path), f"mode {i + 1} has frequency {table.frequency[i]:g} Hz and damping ratio {table.zeta[i]:g}",
                         "give positive frequencies, and damping between 0 and 1 (or 0 and 100 %)")
    size = np.abs(shapes).max(axis=0)
    if not np.isfinite(shapes).all() or (size == 0).any():
        raise InputError(str(path), "holds a mode whose shape is zero or no number at the sensors", "drop that mode, or name other sensors")
    order = np.argsort(table.frequency, kind="stable")
    turn = np.exp(-0.5j * np.angle((shapes**2).sum(axis=0)))  # the phase that makes a shape as real as it can be
    real, rest = (shapes * turn).real, (shapes * turn).imag
    largest = real[np.abs(real).argmax(axis=0), np.arange(len(size))]
    scatter = np.sqrt((rest**2).sum(axis=0) / (np.abs(shapes) ** 2).sum(axis=0))
    frequency, zeta = table.frequency[order], table.zeta[order]
    given = table.frequency_sd is not None and table.zeta_sd is not None
    frequency_sd = FREQUENCY_SD * frequency if table.frequency_sd is None else table.frequency_sd[order]
    zeta_sd = DAMPING_SD * zeta if table.zeta_sd is None else table.zeta_sd[order]
    note = f"modes read from {path.name}" + ("" if given else f"; where it gives no standard deviation, {100 * FREQUENCY_SD:g} % of the "
                                                             f"frequency and {100 * DAMPING_SD:g} % of the damping are taken")
    m = len(frequency)
    shape = (real / largest)[:, order]
    return IdentifiedModes(frequency, zeta, shape, locations, locations, tuple(range(m)), frequency_sd, zeta_sd,
                           np.full(shape.shape, SHAPE_SD), scatter[order], np.zeros(m), ((0.0, 0.0),) * m, ("from a file",) * m, False,
                           (note,))
