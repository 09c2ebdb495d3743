"""``[plan]`` of a study file: what could be measured and how, and what the joints are suspected to be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.term import Term
from bayes_nlsid.recordings.units import unit_factor
from bayes_nlsid.study.building import library
from bayes_nlsid.study.quantities import quantity
from bayes_nlsid.study.schema import PlanEntry, PlanJointEntry, UserTermEntry
from bayes_nlsid.study.table import Table, nearest

SENSED = ("acceleration", "velocity", "displacement")


def read_plan(table: Table | None, locations: Sequence[str], terms: Sequence[UserTermEntry]) -> PlanEntry | None:
    """``[plan]``; None if it is missing."""
    if table is None:
        return None
    sensed = table.text("quantity", "acceleration", SENSED)
    places = {key: table.texts(key) for key in ("sensors", "inputs")}
    for key, names in places.items():
        unknown = [n for n in names if n not in locations]
        if unknown or not names or len(set(names)) != len(names):
            raise table.wrong(key, f"{unknown[0]!r} is not a location of the structure" if unknown else "must name different locations",
                              nearest(unknown[0] if unknown else "", locations))
    levels, band = table.numbers("levels", "force"), table.span("band", "frequency")
    if not levels or min(levels) <= 0 or band[0] <= 0:
        raise table.wrong("levels" if band[0] > 0 else "band", "must be above zero",
                          'write levels = ["1 N", "10 N"], band = ["10 Hz", "200 Hz"]')
    noise = _noise(table, sensed)
    seconds = table.number("seconds", "time", 20.0, positive=True)
    joints = tuple(_joint(inner, locations, library(terms)) for inner in table.tables("joints"))
    if not joints:
        raise table.wrong("joints", "there is none", "add [[plan.joints]] with term, locations and values")
    table.close()
    return PlanEntry(places["sensors"], places["inputs"], band, tuple(sorted(set(levels))), noise, seconds, sensed, joints)


def _noise(table: Table, sensed: str) -> float:
    """rms noise of a sensor within the band, with its unit."""
    value = table.raw("noise")
    number, _, unit = value.strip().partition(" ") if isinstance(value, str) else (str(value), "", "")
    try:
        noise = float(number) * (unit_factor(unit, sensed) if unit else 1.0)
    except (ValueError, InputError) as error:
        said = error.problem if isinstance(error, InputError) else "is not a number with a unit"
        raise table.wrong("noise", f"{value!r} {said}", 'write noise = "0.01 m/s^2", the rms noise of a sensor within the band') from None
    if not 0 < noise < float("inf"):
        raise table.wrong("noise", f"{value!r} is not positive", 'write noise = "0.01 m/s^2"')
    return noise


def _joint(table: Table, locations: Sequence[str], known: Mapping[str, Term]) -> PlanJointEntry:
    """``[[plan.joints]]``: term, locations, and a value for each parameter."""
    name, places = table.text("term"), table.texts("locations")
    if name not in known:
        raise table.wrong("term", f"{name!r} is not a term", nearest(name, list(known)))
    unknown = [p for p in places if p not in locations]
    if unknown or not places:
        raise table.wrong("locations", f"{unknown[0]!r} is not a location of the structure" if unknown else "is empty",
                          nearest(unknown[0] if unknown else "", locations))
    inner = table.table("values")
    values = []
    for param in known[name].params:
        if inner is None or not inner.has(param.name):
            raise table.wrong("values", f"lacks {param.name}", f"write values = {{ {param.name} = ... }}, in {param.unit or 'no unit'}")
        value = quantity(inner.raw(param.name), "number", inner.where(param.name))
        if not value > 0:
            raise inner.wrong(param.name, f"{value:g} is not positive", "plans are made for positive values")
        values.append((param.name, value))
    if inner is not None:
        inner.close()
    tied, excess = table.flag("tied", False), table.flag("excess", True)
    table.close()
    return PlanJointEntry(name, places, tuple(values), tied, excess)
