"""The tables of a study file for the commands beside the run: ``[frf]``, ``[montecarlo]`` and ``[compare]``.

Every function raises `InputError` with file, table, key and mend where the table cannot be used as it stands.
"""

from __future__ import annotations

from collections.abc import Sequence

from bayes_nlsid.study.reading_method import read_amplitudes
from bayes_nlsid.study.schema import CompareEntry, FrfEntry, MonteCarloEntry, PredictionEntry, SpreadEntry
from bayes_nlsid.study.table import Table, nearest

MOST_SAMPLES = 2**22


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


def read_compare(table: Table | None, identified: bool) -> CompareEntry | None:
    """``[compare]``; without it the three scenarios are compared, and nothing where nothing is identified."""
    if table is None:
        return CompareEntry() if identified else None
    if not identified:
        raise table.wrong("scenarios", "compares what is not identified", "add [identification]")
    scenarios = table.texts("scenarios", ("S1", "S2", "S3"))
    wrong = [s for s in scenarios if s not in ("S1", "S2", "S3")]
    if wrong or not scenarios or len(set(scenarios)) != len(scenarios):
        raise table.wrong("scenarios", f"{list(scenarios)} are not different names among S1, S2, S3", 'write scenarios = ["S1", "S2"]')
    entry = CompareEntry(tuple(scenarios), table.integer("samples", 100, low=20, high=5000))
    table.close()
    return entry


def read_montecarlo(table: Table | None, locations: Sequence[str], prediction: PredictionEntry | None,
                    posterior: bool) -> MonteCarloEntry | None:
    """``[montecarlo]``; None if it is missing."""
    if table is None:
        return None
    source = table.text("source", "posterior" if posterior else "fit", ("posterior", "fit"))
    if source == "posterior" and not posterior:
        raise table.wrong("source", "is the posterior, but there is no [posterior]", 'add [posterior], or write source = "fit"')
    spreads = list(_scatter(table))
    spreads += [_read_spread(inner) for inner in table.tables("parameters")]
    if source == "posterior" and spreads:
        key = "scatter" if table.has("scatter") else "parameters"
        raise table.wrong(key, "states distributions beside draws of the posterior", 'write source = "fit", or remove it')
    if source == "fit" and not spreads:
        raise table.wrong("scatter", "is missing, and there is no [[montecarlo.parameters]] either",
                          'write scatter = "5 %", or the distribution of each parameter')
    at = _location(table, "at", locations) if prediction is None or table.has("at") else prediction.at
    amplitude = table.number("amplitude", "length", *(() if prediction is None else (prediction.amplitude,)), positive=True)
    mode = table.integer("mode", 1 if prediction is None else prediction.mode, low=1)
    amplitudes = read_amplitudes(table, amplitude, () if prediction is None or table.has("amplitude") else prediction.amplitudes)
    entry = MonteCarloEntry(source, at, amplitude, mode, amplitudes, tuple(spreads),
                            table.integer("samples", 1000, low=16, high=MOST_SAMPLES),
                            table.flag("indices", True), table.text("path", "auto", ("auto", "fast", "time")))
    table.close()
    return entry


def _scatter(table: Table) -> Sequence[SpreadEntry]:
    """``scatter = "5 %"``: every parameter normal around the fit."""
    scatter = table.number("scatter", "ratio", None, positive=True)
    return () if scatter is None else (SpreadEntry("*", spread=scatter, relative=True),)


def _read_spread(table: Table) -> SpreadEntry:
    name = table.text("parameter")
    kind = table.text("kind", "normal", ("normal", "lognormal", "uniform", "loguniform"))
    lower, upper = table.number("lower", default=None), table.number("upper", default=None)
    if kind in ("uniform", "loguniform"):
        for key, value in (("lower", lower), ("upper", upper)):
            if value is None:
                raise table.wrong(key, "is missing", f"a {kind} distribution needs lower and upper")
        entry = SpreadEntry(name, kind, lower=lower, upper=upper)
    elif kind == "normal":
        relative = table.has("scatter")
        spread = table.number("scatter", "ratio", positive=True) if relative else table.number("sd", positive=True)
        entry = SpreadEntry(name, kind, table.number("mean", default=None), spread, relative, lower, upper)
    else:
        entry = SpreadEntry(name, kind, table.number("median", default=None, positive=True), table.number("log_sd", positive=True), False,
                            lower, upper)
    if lower is not None and upper is not None and not lower < upper:
        raise table.wrong("upper", f"{upper:g} is not above lower {lower:g}", "write lower < upper")
    if kind == "loguniform" and not (lower or 0) > 0:
        raise table.wrong("lower", f"{lower:g} is not positive", "write a lower end above zero")
    table.close()
    return entry


def _location(table: Table, key: str, locations: Sequence[str]) -> str:
    name: str = table.text(key)
    if name not in locations:
        raise table.wrong(key, f"{name!r} is not a location of the structure", nearest(name, locations))
    return name
