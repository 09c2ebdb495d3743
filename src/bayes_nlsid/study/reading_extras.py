"""The tables of a study file for the commands beside the run: ``[frf]``."""

from __future__ import annotations

from collections.abc import Sequence

from bayes_nlsid.study.schema import FrfEntry
from bayes_nlsid.study.table import Table, nearest


def read_frf(table: Table | None, locations: Sequence[str]) -> FrfEntry | None:
    """``[frf]``; None if it is missing."""
    if table is None:
        return None
    drive, at = (_location(table, key, locations) for key in ("input", "output"))
    levels = table.numbers("levels", "force")
    if not levels or min(levels) <= 0 or len(set(levels)) != len(levels):
        raise table.wrong("levels", f"{list(levels)} are not different amplitudes above zero", 'write levels = ["0.5 N", "2 N"]')
    band = table.span("band", "frequency")
    if band[0] <= 0:
        raise table.wrong("band", "begins at zero", 'write band = ["15 Hz", "25 Hz"]')
    entry = FrfEntry(drive, at, tuple(sorted(levels)), band, table.integer("harmonics", None, low=1, high=63),
                     table.integer("samples", 100, low=2))
    table.close()
    return entry


def _location(table: Table, key: str, locations: Sequence[str]) -> str:
    name: str = table.text(key)
    if name not in locations:
        raise table.wrong(key, f"{name!r} is not a location of the structure", nearest(name, locations))
    return name
