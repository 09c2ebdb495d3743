"""What every figure shares apart from matplotlib: SI prefixes, unit signs, short names of parameters."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_PREFIXES = ((1e-9, "n"), (1e-6, "µ"), (1e-3, "m"), (1.0, ""), (1e3, "k"), (1e6, "M"), (1e9, "G"))
_PREFIXABLE = ("m", "s", "N", "V", "Hz", "N/m", "m/s", "N s/m", "N m/rad", "J")
_RAISED = str.maketrans("0123456789-.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻·")


def unit_sign(unit: str) -> str:
    """A unit as people write it: ``N/m^3`` → ``N/m³``."""
    return re.sub(r"\^(-?[\d.]+)", lambda m: m.group(1).translate(_RAISED), unit)


def prefixed(values: ArrayLike, unit: str) -> tuple[float, str]:
    """A factor and a unit such that ``factor * values`` reads well, e.g. (1e3, "mm").

    Parameters
    ----------
    values : array_like
        The largest finite magnitude decides.
    unit : str
        SI unit; compound units whose prefix would be ambiguous stay as they are.
    """
    array = np.abs(np.asarray(values, dtype=float))
    finite = array[np.isfinite(array)]
    largest = float(finite.max()) if finite.size else 0.0
    if unit not in _PREFIXABLE or largest == 0.0:
        return 1.0, unit_sign(unit)
    best = max((entry for entry in _PREFIXES if entry[0] <= largest * 1.0000001), default=_PREFIXES[0])
    return 1.0 / best[0], best[1] + unit_sign(unit)


def scaled(values: ArrayLike, unit: str) -> tuple[float, str]:
    """Like `prefixed`, and for units without prefixes a power of ten: (1e-6, "10⁶ N/m³"), so that no axis needs an offset."""
    factor, sign = prefixed(values, unit)
    array = np.abs(np.asarray(values, dtype=float))
    largest = float(array[np.isfinite(array)].max(initial=0.0))
    if unit in _PREFIXABLE or largest == 0.0 or 1e-2 <= largest < 1e4:
        return factor, sign
    power = 3 * int(np.floor(np.log10(largest) / 3))
    return 10.0**-power, f"10{str(power).translate(_RAISED)} {sign}".strip()


def axis_label(what: str, unit: str) -> str:
    """``what (unit)``, or just ``what`` for a pure number."""
    return f"{what} ({unit})" if unit else what


def engineering(value: float, unit: str = "", digits: int = 3) -> str:
    """One number with a prefixed unit, for tables and captions: ``2.05 kN``."""
    if not np.isfinite(value):
        return "–"
    factor, sign = prefixed([value], unit)
    scaled = value * factor
    text = f"{scaled:#.{digits}g}".rstrip(".") if scaled else "0"
    if "e" in text:
        mantissa, power = text.split("e")
        text = f"{mantissa}·10{str(int(power)).translate(_RAISED)}"
    return f"{text} {sign}".strip()


def percent(share: float | None, digits: int = 3) -> str:
    """A share as ``12.3 %``; a dash where there is none."""
    return "–" if share is None or not np.isfinite(share) else f"{100 * share:.{digits}g} %"


def floor_text(entry: Mapping[str, Any]) -> str:
    """The noise floor of a held-out record; ``at most`` where signal may be in it."""
    return ("at most " if entry.get("noise_sure") == "bound" else "") + percent(entry["noise_floor"], 2)


def with_sd(value: float, sd: float, factor: float = 1.0, unit: str = "") -> str:
    """``80.537 ± 0.004``: a value with as many decimals as its standard deviation tells."""
    value, sd = factor * value, factor * sd
    if not (np.isfinite(value) and np.isfinite(sd)) or sd <= 0:
        return f"{value:.5g} {unit}".strip()
    decimals = int(np.clip(-np.floor(np.log10(sd)), 0, 9))
    return f"{value:.{decimals}f} ± {sd:.{decimals}f} {unit}".strip()


def digits_for(low: float, high: float) -> int:
    """Significant digits that still show the width of an interval, between 3 and 8."""
    size, width = max(abs(low), abs(high)), abs(high - low)
    if not (np.isfinite(size) and np.isfinite(width)) or width == 0.0:
        return 4
    return int(np.clip(np.ceil(np.log10(size / width)) + 2, 3, 8))


def places(locations: Sequence[str]) -> str:
    """Locations as people read them: ``J1, J2``, and ``J1 … J5`` for more than two."""
    return ", ".join(locations) if len(locations) <= 2 else f"{locations[0]} … {locations[-1]}"


def brief(text: str) -> str:
    """A text whose tied locations are abbreviated: ``cubic[J1+J2+J3].k`` → ``cubic[J1 … J3].k``; all else stays."""
    return re.sub(r"\[([^\[\]+\s]+(?:\+[^\[\]+\s]+){2,})\]", lambda m: f"[{places(m.group(1).split('+'))}]", text)


def brief_names(names: Sequence[str]) -> list[str]:
    """Every name abbreviated as in `brief`, but whole where two different names would come to read the same."""
    short = [brief(name) for name in names]
    meant: dict[str, set[str]] = {}
    for name, abbreviated in zip(names, short, strict=True):
        meant.setdefault(abbreviated, set()).add(name)
    return [name if len(meant[abbreviated]) > 1 else abbreviated for name, abbreviated in zip(names, short, strict=True)]


def thinned(length: int, most: int) -> slice:
    """Every k-th sample so that at most ``most`` remain."""
    return slice(None, None, max(1, -(-length // most)))
