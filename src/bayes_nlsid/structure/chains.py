"""Small structures: one oscillator, and masses in a row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.structure import Structure

FREE = 1e-4
"""rad/s: the frequency that stands for no stiffness."""


def oscillator(*, mass: float = 1.0, stiffness: float | None = None, frequency: float | None = None, damping: float | None = None,
               zeta: float | None = None, location: str = "J1", sensors: Sequence[str] = (), inputs: Sequence[str] = ()) -> ModalModel:
    """A single degree of freedom m ẍ + c ẋ + k x = F, whose whole motion is one location.

    Units need not be mechanical: for a circuit recorded in volts the "mass" only fixes the scale of the "force".

    Parameters
    ----------
    mass : float
        kg.
    stiffness, frequency : float
        N/m or Hz; exactly one. A stiffness of zero is a free mass, a drive for instance: its frequency is set to `FREE`, too low to matter.
    damping, zeta : float
        N s/m or damping ratio; at most one, none means undamped.
    location : str
        Name of the motion, also a joint.
    sensors, inputs : sequence of str
        Further names of the same motion; the location itself where none is given.

    Raises
    ------
    ValueError
        If a value is missing, doubled or not positive.
    """
    if (stiffness is None) == (frequency is None):
        raise ValueError("oscillator: give either stiffness (N/m) or frequency (Hz)")
    if damping is not None and zeta is not None:
        raise ValueError("oscillator: give either damping (N s/m) or zeta (ratio), not both")
    if mass <= 0 or (stiffness is None and (frequency or 0.0) <= 0) or (stiffness or 0.0) < 0:
        raise ValueError(f"oscillator: mass {mass} and stiffness {stiffness} or frequency {frequency} must be positive")
    if stiffness == 0 and zeta is not None:
        raise ValueError("oscillator: a mass without stiffness has no damping ratio; give damping (N s/m)")
    omega = max(np.sqrt(stiffness / mass), FREE) if stiffness is not None else 2 * np.pi * float(frequency or 0.0)
    ratio = zeta if zeta is not None else (damping or 0.0) / (2 * mass * omega)
    if not 0 <= ratio or (ratio >= 1 and stiffness != 0):
        raise ValueError(f"oscillator: damping must not be negative and below critical, got ratio {ratio:g}")
    places = tuple(dict.fromkeys((location, *sensors, *inputs)))
    return ModalModel(np.array([omega]), np.array([ratio]), places, np.full((len(places), 1), mass**-0.5),
                      sensors=tuple(sensors) or (location,), inputs=tuple(inputs) or (location,), joints=(location,))


def spring_mass_chain(masses: Sequence[float], springs: Sequence[float], *, ends: str = "fixed-free",
                      inputs: Sequence[int] = (1,)) -> Structure:
    """Masses in a row joined by springs.

    Parameters
    ----------
    masses : sequence of float, length N
        kg. Degrees of freedom and sensors are S1..SN.
    springs : sequence of float
        N/m from left to right, springs to the ground included: N−1, plus one for each fixed end. Joint ``J<i>`` is the extension
        of spring i; spring i is also the part of that name, mass i the part ``m<i>``.
    ends : str
        ``"free-free"``, ``"fixed-free"``, ``"free-fixed"`` or ``"fixed-fixed"``.
    inputs : sequence of int
        Driven masses, 1-based; locations F1, F2, ... by mass.

    Raises
    ------
    ValueError
        If the number of springs does not fit, a value is not positive or an input does not exist.
    """
    n = len(masses)
    sides = ends.split("-")
    if len(sides) != 2 or any(side not in ("fixed", "free") for side in sides):
        raise ValueError(f"spring_mass_chain: ends must join two of fixed, free by '-', got {ends!r}")
    grounded = [side == "fixed" for side in sides]
    if n == 0 or len(springs) != n - 1 + sum(grounded):
        raise ValueError(f"spring_mass_chain: {n} masses with ends {ends!r} need {n - 1 + sum(grounded)} springs, got {len(springs)}")
    if min(*masses, *springs, 1.0) <= 0:
        raise ValueError("spring_mass_chain: masses and springs must be positive")
    if any(not 1 <= i <= n for i in inputs):
        raise ValueError(f"spring_mass_chain: inputs {tuple(inputs)} must be between 1 and {n}")
    unit = np.vstack([np.zeros(n), np.eye(n), np.zeros(n)])
    extension = np.diff(unit, axis=0)[0 if grounded[0] else 1:n + 1 if grounded[1] else n]
    locations = {f"S{i + 1}": np.eye(n)[i] for i in range(n)} | {f"F{i}": np.eye(n)[i - 1] for i in inputs}
    locations |= {f"J{i + 1}": row for i, row in enumerate(extension)}
    K_parts = {f"J{i + 1}": k * np.outer(row, row) for i, (k, row) in enumerate(zip(springs, extension, strict=True))}
    M_parts = {f"m{i + 1}": m * np.outer(np.eye(n)[i], np.eye(n)[i]) for i, m in enumerate(masses)}
    zero = np.zeros((n, n))
    return Structure(sum(M_parts.values(), zero), sum(K_parts.values(), zero), tuple(f"S{i + 1}" for i in range(n)), locations,
                     sensors=tuple(f"S{i + 1}" for i in range(n)), inputs=tuple(f"F{i}" for i in inputs),
                     joints=tuple(K_parts), K_parts=K_parts, M_parts=M_parts)
