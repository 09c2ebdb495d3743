"""A small, strict table of units: what a sensor may be labelled with, and nothing that would have to be guessed."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.errors import InputError

PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "k": 1e3, "M": 1e6, "G": 1e9}
STANDARD_GRAVITY = 9.80665  # m/s^2, exact by definition (CGPM 1901)
POUND_FORCE = 0.45359237 * STANDARD_GRAVITY  # N, exact by definition

# factor to SI, exponents of (length, time, force, voltage), the SI prefixes that may stand before it
_BASE: dict[str, tuple[float, tuple[int, int, int, int], str]] = {
    "m": (1.0, (1, 0, 0, 0), "numcdkMG"),
    "in": (0.0254, (1, 0, 0, 0), ""),
    "ft": (0.3048, (1, 0, 0, 0), ""),
    "mil": (2.54e-5, (1, 0, 0, 0), ""),
    "s": (1.0, (0, 1, 0, 0), "num"),
    "min": (60.0, (0, 1, 0, 0), ""),
    "h": (3600.0, (0, 1, 0, 0), ""),
    "N": (1.0, (0, 0, 1, 0), "numkM"),
    "kgf": (STANDARD_GRAVITY, (0, 0, 1, 0), ""),
    "lbf": (POUND_FORCE, (0, 0, 1, 0), ""),
    "V": (1.0, (0, 0, 0, 1), "numk"),
    "g": (STANDARD_GRAVITY, (1, -2, 0, 0), "um"),
    "gn": (STANDARD_GRAVITY, (1, -2, 0, 0), "um"),
    "Gal": (0.01, (1, -2, 0, 0), ""),
}
_DIMENSION = {
    "time": (0, 1, 0, 0),
    "displacement": (1, 0, 0, 0),
    "velocity": (1, -1, 0, 0),
    "acceleration": (1, -2, 0, 0),
    "force": (0, 0, 1, 0),
    "voltage": (0, 0, 0, 1),
}
EXAMPLES = {
    "time": "s, ms, us, min, h",
    "displacement": "m, mm, um, nm, in, ft, mil",
    "velocity": "m/s, mm/s, in/s, ft/s",
    "acceleration": "m/s^2, mm/s^2, g, mg, gn, in/s^2, ft/s^2, Gal",
    "force": "N, mN, kN, lbf, kgf",
    "voltage": "V, mV, uV",
}
_SUPERSCRIPTS = str.maketrans({"⁻": "-", "¹": "1", "²": "2", "³": "3", "µ": "u", "μ": "u", "·": " ", "*": " ", "−": "-"})
_FACTOR = re.compile(r"([A-Za-z]+)(?:\^?([+-]?[1-9]))?")


def unit_factor(unit: str, quantity: str) -> float:
    """Factor that turns a value in ``unit`` into SI.

    Parameters
    ----------
    unit : str
        For example ``"mm/s^2"``, ``"m/s²"``, ``"m s^-2"``, ``"g"``; capital and small letters differ.
    quantity : {"time", "displacement", "velocity", "acceleration", "force", "voltage"}

    Returns
    -------
    float

    Raises
    ------
    InputError
        If the unit is not known, or measures another quantity.
    ValueError
        If the quantity is not known.
    """
    if quantity not in _DIMENSION:
        raise ValueError(f"quantity must be one of {sorted(_DIMENSION)}, not {quantity!r}")
    parsed = _parse(unit) if isinstance(unit, str) else None
    if parsed is None:
        raise InputError(f"unit {unit!r}", f"is not a unit that is known for {quantity}", f"use one of {EXAMPLES[quantity]}")
    factor, dimension = parsed
    if dimension != _DIMENSION[quantity]:
        found = next((name for name, value in _DIMENSION.items() if value == dimension), "no quantity of a test")
        raise InputError(f"unit {unit!r}", f"measures {found}, but the quantity is {quantity}", f"use one of {EXAMPLES[quantity]}")
    return factor


def is_unit(text: str) -> bool:
    """Whether a label is a unit of some quantity of a test."""
    found = _parse(text) if isinstance(text, str) else None
    return found is not None and found[1] in _DIMENSION.values()


def to_si(values: ArrayLike, unit: str, quantity: str) -> NDArray[np.float64]:
    """Values in SI.

    Parameters
    ----------
    values : array_like
        Any shape.
    unit, quantity : str
        As in `unit_factor`.

    Returns
    -------
    ndarray
        Same shape, float64; s, m, m/s, m/s², N or V.

    Raises
    ------
    InputError
        If the unit is not known, or measures another quantity.
    """
    return np.asarray(values, dtype=float) * unit_factor(unit, quantity)


def _parse(unit: str) -> tuple[float, tuple[int, ...]] | None:
    """Factor and dimension of a product of powers with at most one stroke; None if it cannot be read."""
    text = unit.strip().translate(_SUPERSCRIPTS)
    parts = text.split("/")
    if not text or len(parts) > 2:
        return None
    factor, dimension = 1.0, [0, 0, 0, 0]
    for part, sign in zip(parts, (1, -1), strict=False):
        names = part.strip().removeprefix("(").removesuffix(")").split() if sign < 0 else part.split()
        if not names:
            return None
        for name in names:
            match = _FACTOR.fullmatch(name)
            base = _base(match.group(1)) if match else None
            if match is None or base is None:
                return None
            power = sign * int(match.group(2) or 1)
            factor *= math.pow(base[0], power)
            dimension = [d + power * e for d, e in zip(dimension, base[1], strict=True)]
    return factor, tuple(dimension)


def _base(name: str) -> tuple[float, tuple[int, int, int, int]] | None:
    """A base unit, with its SI prefix if it may have one; whole names go before prefixes (``min`` is a minute, ``kg`` is nothing here)."""
    if name in _BASE:
        return _BASE[name][:2]
    for prefix, factor in PREFIXES.items():
        rest = name.removeprefix(prefix)
        if name.startswith(prefix) and rest in _BASE and prefix in _BASE[rest][2]:
            return factor * _BASE[rest][0], _BASE[rest][1]
    return None
