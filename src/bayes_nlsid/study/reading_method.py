"""The tables of a study file that say how to identify, sample, predict and report.

Every function raises `InputError` with file, table, key and mend where the table cannot be used as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.term import Term
from bayes_nlsid.study.building import user_terms
from bayes_nlsid.study.quantities import quantity
from bayes_nlsid.study.schema import (
    AlternativeEntry,
    ElementEntry,
    GroupEntry,
    IdentificationEntry,
    PosteriorEntry,
    PredictionEntry,
    PriorEntry,
    PublishedEntry,
    ReportEntry,
    UserTermEntry,
)
from bayes_nlsid.study.table import Table, nearest

SCENARIOS = ("S1", "S2", "S3")
RULES = ("coefficient", "stiffness", "force", "displacement", "velocity", "range")
PRIOR_KEYS = {"normal": ("mean", "sd"), "lognormal": ("median", "log_sd"), "uniform": ("", ""), "loguniform": ("", ""),
              "halfnormal": ("", "scale"), "logitnormal": ("mean", "sd")}
GROUPS = ("table1", "memory", "all", "user")


def read_terms(top: Table) -> tuple[UserTermEntry, ...]:
    """``[[terms]]``: name, formula, params; the expression is checked at once."""
    entries: list[UserTermEntry] = []
    for table in top.tables("terms"):
        name, formula = table.text("name"), table.text("formula")
        if name in LIBRARY or any(name == e.name for e in entries):
            raise table.wrong("name", f"{name!r} is already a term", "choose another name")
        if not re.fullmatch(r"[\w|*^-]+", name):
            raise table.wrong("name", f"{name!r} cannot be a name of a term", "use letters, digits and _, without blanks or brackets")
        entry = UserTermEntry(name, formula, read_params(table.table("params")), table.text("memory", "none", ("none", "masing")),
                              table.text("meaning", ""))
        table.close()
        try:
            user_terms((entry,))
        except InputError as error:
            raise InputError(f"{table.file.name}: {table.name} {error.where}", error.problem, error.mend) from None
        entries.append(entry)
    return tuple(entries)


def read_params(table: Table | None) -> tuple[tuple[str, tuple[Any, ...]], ...]:
    """``params`` of a law: every name with unit and rule, as ``user_term`` takes them; none without a table."""
    return () if table is None else tuple((key, _read_param(table, key)) for key in table.keys())


def _read_param(table: Table, key: str) -> tuple[Any, ...]:
    """``c = ["N/m^3", "coefficient"]`` or ``a = ["", "range", 0.0, 2.0]``."""
    value = table.items(key)
    if len(value) not in (2, 4) or not all(isinstance(v, str) for v in value[:2]):
        raise table.wrong(key, f"{value!r} is not understood", f'write {key} = ["unit", "rule"] or {key} = ["unit", "range", lower, upper]')
    if value[1] not in RULES:
        raise table.wrong(key, f"rule {value[1]!r} is not possible", nearest(value[1], RULES))
    return (*value[:2], *(quantity(v, "number", table.where(key)) for v in value[2:]))


def _library(terms: Sequence[UserTermEntry]) -> Mapping[str, Term]:
    return {**LIBRARY, **user_terms(terms)}


def candidate_names(table: Table, key: str, library: Mapping[str, Term], own: Sequence[str]) -> tuple[str, ...]:
    """Terms named one by one, by their number in Table 1, or by group (``table1``, ``memory``, ``all``, ``user``)."""
    by_index = {term.index: name for name, term in library.items() if term.index is not None}
    out: list[str] = []
    for word in table.items(key, []):
        if isinstance(word, int) and not isinstance(word, bool):
            if word not in by_index:
                raise table.wrong(key, f"{word} is not a number of Table 1", f"write a number from {min(by_index)} to {max(by_index)}")
            out.append(by_index[word])
        elif word == "table1":
            out += [by_index[i] for i in sorted(by_index)]
        elif word == "memory":
            out += [name for name, term in library.items() if term.memory != "none"]
        elif word == "user":
            out += list(own)
        elif word == "all":
            out += list(library)
        elif isinstance(word, str) and word in library:
            out.append(word)
        else:
            raise table.wrong(key, f"{word!r} is not a term", nearest(str(word), [*library, *GROUPS]))
    return tuple(dict.fromkeys(out))


def read_identification(table: Table | None, locations: Sequence[str], terms: Sequence[UserTermEntry]) -> IdentificationEntry | None:
    """``[identification]``; None if it is missing."""
    if table is None:
        return None
    library, own = _library(terms), [t.name for t in terms]
    modes = table.integers("modes", (1,))
    main = table.integer("main", modes[0], low=1)
    if main not in modes:
        raise table.wrong("main", f"{main} is not among modes {list(modes)}", "name one of them")
    free = table.integers("free_modes", ())
    if set(free) - set(modes):
        raise table.wrong("free_modes", f"{sorted(set(free) - set(modes))} are not among modes {list(modes)}", "add them to modes")
    name = table.text("scenario", "S2", SCENARIOS)
    if name != "S3" and set(free) - {main}:
        raise table.wrong("free_modes", f"{sorted(set(free) - {main})} have no equation in scenario {name}: that is of mode {main} alone",
                          'free only that one, or write scenario = "S3"')
    joints = _known(table, "joints", table.texts("joints", ()), locations)
    tied, excess = table.flag("tied", False), table.flag("excess", True)
    elements = tuple(_read_element(t, library, locations, joints, tied, excess) for t in table.tables("elements"))
    candidates = candidate_names(table, "candidates", library, own)
    if not candidates and not elements:
        raise table.wrong("candidates", "there is none, and no [[identification.elements]] either",
                          'write candidates = ["table1"], or name the terms whose form is known')
    if candidates and not joints:
        raise table.wrong("joints", "is missing", "name the locations where candidate terms may act")
    alternatives = tuple(_read_alternative(t, library, own, locations, joints, tied, excess) for t in table.tables("alternatives"))
    widening = table.number("widening", default=1.0)
    if widening < 1:
        raise table.wrong("widening", f"{widening:g} is below 1", "write 1 for the paper's bounds or more to widen them")
    if 0 < table.integer("places", 192, low=0) < 8:
        raise table.wrong("places", "is too small for a table of forces", "write 0 for none, or some 100 to 400")
    entry = IdentificationEntry(
        name, main, modes, free, table.span("band", "frequency", None), joints, candidates, elements,
        alternatives, tied, excess, widening, table.number("eps1", default=None, positive=True),
        table.number("eps2", default=None, positive=True), table.integer("starts", 50, low=1),
        table.number("rate", "frequency", None, positive=True), _spans(table, "mode_bands", len(modes)),
        table.flag("static_correction", False), _not_negative(table, "settle", "time"), table.integer("most", 6, low=1),
        table.number("frequency_widening", default=1.0, positive=True), table.number("damping_widening", default=1.0, positive=True),
        table.integer("places", 192, low=0), table.flag("output_error", False), table.flag("free_gain", False))
    table.close()
    return entry


def _not_negative(table: Table, key: str, dimension: str) -> float:
    """A number from 0 up, 0 by default."""
    number = float(table.number(key, dimension, 0.0))
    if number < 0:
        raise table.wrong(key, f"{number:g} is negative", "write 0 or more")
    return number


def _spans(table: Table, key: str, count: int) -> tuple[tuple[float, float], ...]:
    """One (from, to) in Hz for each mode, or nothing."""
    values = table.raw(key, [])
    if not isinstance(values, list) or (values and len(values) != count):
        raise table.wrong(key, f"does not give one band for each of {count} modes", f"write {key} = [[60, 100], ...]")
    out = []
    for value in values:
        if not isinstance(value, list) or len(value) != 2:
            raise table.wrong(key, f"{value!r} is not a pair", f"write {key} = [[60, 100], ...]")
        low, high = (quantity(v, "frequency", table.where(key)) for v in value)
        if not 0 < low < high:
            raise table.wrong(key, f"{value} does not run from a lower to a higher frequency", f"write {key} = [[60, 100], ...]")
        out.append((low, high))
    return tuple(out)


def _known(table: Table, key: str, names: Sequence[str], locations: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if name not in locations:
            raise table.wrong(key, f"{name!r} is not a location of the structure", nearest(name, locations))
    if len(set(names)) != len(names):
        raise table.wrong(key, f"names repeat: {list(names)}", "name each once")
    return tuple(names)


def _read_element(table: Table, library: Mapping[str, Term], locations: Sequence[str], joints: Sequence[str], tied: bool,
                  excess: bool) -> ElementEntry:
    name = table.text("term")
    if name not in library:
        raise table.wrong("term", f"{name!r} is not a term", nearest(name, list(library)))
    places = _known(table, "locations", table.texts("locations", tuple(joints)), locations)
    if not places:
        raise table.wrong("locations", "is missing", "name at least one location")
    fixed: list[tuple[str, float]] = []
    inner = table.table("fixed")
    if inner is not None:
        params = [p.name for p in library[name].params]
        for key in inner.keys():
            if key not in params:
                raise inner.wrong(key, f"is not a parameter of {name!r}", nearest(key, params))
            fixed.append((key, inner.number(key)))
    entry = ElementEntry(name, places, table.flag("tied", tied), table.flag("excess", excess), tuple(fixed))
    table.close()
    return entry


def _read_alternative(table: Table, library: Mapping[str, Term], own: Sequence[str], locations: Sequence[str], joints: Sequence[str],
                      tied: bool, excess: bool) -> AlternativeEntry:
    entry = AlternativeEntry(table.text("name"), candidate_names(table, "candidates", library, own),
                             tuple(_read_element(t, library, locations, joints, tied, excess) for t in table.tables("elements")))
    if not entry.candidates and not entry.elements:
        raise table.wrong("candidates", "there is none", "name terms or groups of terms")
    table.close()
    return entry


def read_posterior(table: Table | None) -> PosteriorEntry | None:
    """``[posterior]``; None if it is missing."""
    if table is None:
        return None
    priors = tuple(_read_prior(t) for t in table.tables("priors"))
    entry = PosteriorEntry(table.text("likelihood", "whittle", ("whittle", "plain")), table.integer("ensembles", 4, low=2),
                           table.integer("steps", None, low=10), table.integer("most", None, low=200),
                           table.integer("walkers", None, low=4), priors,
                           table.text("stage", None, ("regression", "forward", "both")),
                           tuple(_read_group(t) for t in table.tables("groups")))
    table.close()
    return entry


def _read_prior(table: Table) -> PriorEntry:
    kind = table.text("kind", choices=tuple(PRIOR_KEYS))
    place, spread = PRIOR_KEYS[kind]
    a = table.number(place) if place else 0.0
    b = table.number(spread) if spread else 1.0
    if not b > 0:
        raise table.wrong(spread, f"{b:g} is not positive", "write a spread above zero")
    if kind == "lognormal" and not a > 0:
        raise table.wrong(place, f"{a:g} is not positive", "write a median above zero")
    lower, upper = table.number("lower", default=None), table.number("upper", default=None)
    if lower is not None and upper is not None and not lower < upper:
        raise table.wrong("upper", f"{upper:g} is not above lower {lower:g}", "write lower < upper")
    entry = PriorEntry(table.text("parameter"), kind, a, b, lower, upper)
    table.close()
    return entry


def _read_group(table: Table) -> GroupEntry:
    names = table.texts("parameters")
    if not names or len(set(names)) != len(names):
        raise table.wrong("parameters", f"{list(names)} is empty or repeats itself", 'write for example parameters = ["iwan4[*].k_t"]')
    entry = GroupEntry(names, table.number("scatter", default=None, positive=True))
    table.close()
    return entry


def read_prediction(table: Table | None, locations: Sequence[str], recordings: Sequence[str]) -> PredictionEntry | None:
    """``[prediction]``; None if it is missing."""
    if table is None:
        return None
    at = _known(table, "at", (table.text("at"),), locations)[0]
    heldout = table.texts("heldout", ())
    for key, names in (("heldout", heldout), ("measured", table.texts("measured", ()))):
        for name in names:
            if name not in recordings:
                raise table.wrong(key, f"there is no recording {name!r}", nearest(name, recordings))
    if len(set(heldout)) != len(heldout):
        raise table.wrong("heldout", f"names repeat: {list(heldout)}", "name each once")
    amplitude = table.number("amplitude", "length", positive=True)
    entry = PredictionEntry(
        at, amplitude, table.integer("mode", 1, low=1), table.integer("samples", 100, low=2),
        table.number("seconds", "time", None, positive=True), table.number("fs", "frequency", None, positive=True),
        table.text("scheme", "hht", ("hht", "exponential")), read_amplitudes(table, amplitude), table.text("measured", None),
        table.span("band", "frequency", None), heldout, table.integer("draws", 100, low=2),
        table.text("score", "band", ("band", "all")), table.number("tolerance", "ratio", None, positive=True))
    table.close()
    return entry


def read_amplitudes(table: Table, start: float, default: tuple[float, ...] = ()) -> tuple[float, ...]:
    """``amplitudes`` (m) at which a decay from ``start`` (m) is read: above zero, ascending, none above the start."""
    if not table.has("amplitudes"):
        return default
    values: tuple[float, ...] = table.numbers("amplitudes", "length")
    if list(values) != sorted(set(values)) or any(a <= 0 for a in values):
        raise table.wrong("amplitudes", f"{list(values)} are not positive and ascending", 'write amplitudes = ["0.1 mm", "1 mm"]')
    if values and values[-1] > start:
        raise table.wrong("amplitudes", f"{values[-1]:g} m lies above amplitude = {start:g} m, from where the motion decays",
                          "raise amplitude, or leave the larger ones out")
    return values


def read_report(table: Table | None) -> ReportEntry:
    """``[report]``."""
    if table is None:
        return ReportEntry()
    published = []
    for inner in table.tables("published"):
        published.append(PublishedEntry(inner.text("label"), inner.span("frequency", "frequency", None),
                                        inner.span("damping", "ratio", None), inner.text("text", "")))
        inner.close()
    entry = ReportEntry(table.texts("notes", ()), tuple(published), table.span("window", "time", None))
    table.close()
    return entry
