"""Effects with numbers: a class at a place with its parameters, and what it adds to the linear model or to the forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.mismatch.calibrate import Chain, Extension
from bayes_nlsid.mismatch.catalogue import Law
from bayes_nlsid.mismatch.linear import Attachment, Family

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
DELAY = 2e-5  # s, unit of delay parameters
GAIN = 0.1  # unit of gain parameters (log)


@final
@dataclass(frozen=True)
class Effect:
    """One missing effect.

    Parameters
    ----------
    cls, place : str
        Class and location in the vocabulary of the case.
    law : Law or None
        For forces.
    values : ndarray
        Parameters of the law's term, or of the linear effect (``names``); for a drift the coefficients of time and its square.
    names, units : tuple of str
    kind : str
        Variant of a linear effect (``maxwell``, ``crosstalk`` for class ``other``).
    """

    cls: str
    place: str
    law: Law | None = None
    values: Array = field(default_factory=lambda: np.zeros(0))
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    kind: str = ""

    @property
    def is_force(self) -> bool:
        """Whether it enters the equations as a force that depends on motion (drifting stiffness included)."""
        return self.law is not None or self.cls == "stiffness_drift"

    @property
    def key(self) -> tuple[str, str]:
        """(class, place)."""
        return self.cls, self.place


def along_period(law: Law, values: Array, d: Array, v: Array, dt: float, periodic: bool) -> Array:
    """Force (..., n) along a periodic motion (history begins at its largest displacement, so that one period is steady) or a burst."""
    if law.term.memory == "none":
        return np.asarray(law.term.static_force(d, v, values))
    if not periodic:
        return force_along(law.term, motion(d, v, dt), values, excess=law.excess)
    first = int(np.argmax(np.abs(d)))
    path = motion(np.append(np.roll(d, -first), d[first]), np.append(np.roll(v, -first), v[first]), dt)
    return np.asarray(np.roll(force_along(law.term, path, values, excess=law.excess)[..., :-1], first, axis=-1))


def pack(effect: Effect) -> Array:
    """Free parameters of a force effect in search coordinates."""
    if effect.law is None:
        return np.asarray(effect.values, dtype=float) / _unit(effect)
    return np.array([_to(effect, i, kind) for i, kind in enumerate(effect.law.free) if kind != "fixed"])


def unpack(effect: Effect, x: Array, reference: Effect) -> Effect:
    """The effect at search coordinates ``x``; ``reference`` gives the scale of linear ones."""
    if effect.law is None:
        return replace(effect, values=x * _unit(reference))
    values = np.array(effect.values, dtype=float)
    free = [i for i, kind in enumerate(effect.law.free) if kind != "fixed"]
    for i, value in zip(free, x, strict=True):
        param = effect.law.term.params[i]
        values[i] = np.exp(np.clip(value, -80, 80)) if effect.law.free[i] == "log" else value * _scale(reference, i)
        if param.rule == "range" and effect.law.term.name != "one_sided_spring":
            values[i] = np.clip(values[i], param.lower, param.upper)
    return replace(effect, values=values)


def _to(effect: Effect, i: int, kind: str) -> float:
    value = float(effect.values[i])
    return float(np.log(max(value, 1e-300))) if kind == "log" else value / _scale(effect, i)


def _scale(effect: Effect, i: int) -> float:
    return max(abs(float(effect.values[i])), 1e-12) if effect.law is not None and effect.law.term.name == "one_sided_spring" else 1.0


def _unit(effect: Effect) -> float:
    return max(float(np.abs(effect.values).max()), 1e-12)


# ---- linear effects ----------------------------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class LinearKind:
    """How a linear effect is parametrised: start, prior, names, and what it does at x."""

    start: Array
    sd: Array
    centre: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    natural: Callable[[Array], Array]
    attach: Callable[[Array, Complex], Attachment] | None = None
    chain: Callable[[Array, Complex, int], Chain] | None = None
    other: int = -1


def linear_kind(fam: Family, cls: str, place: str, channel: int, mass: float, frequency: float = 0.0, kind: str = "",
                stiffness: float = 1.0, other: int = -1, start: float = 0.0) -> LinearKind:
    """Parametrisation of a linear effect.

    Parameters
    ----------
    channel : index of the sensor channel, for channel effects.
    mass, stiffness : kg, N/m scales. frequency : Hz, for a resonator or a relaxing branch.
    other : channel that leaks into ``channel``, for crosstalk.
    start : coefficient found by the one-step test.
    """
    one = np.ones(1)
    direction = fam.points.get(place, fam.places.get(place))
    if cls == "added_mass" and direction is not None:
        return LinearKind(np.array([max(start, 0.01)]), 8 * one, 0 * one, ("mass",), ("kg",), lambda x: mass * x,
                          attach=lambda x, s: Attachment(direction, mass * x[0] * s ** 2))
    if cls == "unmodelled_mode" and direction is not None:
        def resonator(x: Array, s: Complex) -> Attachment:
            m, w, zeta = mass * np.exp(x[0]), 2 * np.pi * frequency * np.exp(x[1]), 0.02 * np.exp(x[2])
            return Attachment(direction, m * s ** 2 * (w ** 2 + 2 * zeta * w * s) / (s ** 2 + 2 * zeta * w * s + w ** 2))
        first = np.array([np.log(max(start, 1e-3)), 0.0, 0.0])
        return LinearKind(first, np.array([3.0, 0.3, 0.8]), np.array([-1.0, 0, 0]), ("mass", "frequency", "damping ratio"),
                          ("kg", "Hz", ""), lambda x: np.array([mass * np.exp(x[0]), frequency * np.exp(x[1]), 0.02 * np.exp(x[2])]),
                          attach=resonator)
    if cls == "other" and kind == "maxwell" and direction is not None:
        def branch(x: Array, s: Complex) -> Attachment:
            tau = np.exp(x[1]) / (2 * np.pi * frequency)
            return Attachment(direction, stiffness * np.exp(x[0]) * s * tau / (1 + s * tau))
        return LinearKind(np.array([np.log(max(start, 1e-3)), 0.0]), np.array([2.5, 1.5]), np.array([-1.0, 0.0]),
                          ("stiffness of the relaxing branch", "relaxation time"), ("N/m", "s"),
                          lambda x: np.array([stiffness * np.exp(x[0]), np.exp(x[1]) / (2 * np.pi * frequency)]), attach=branch)
    size = len(fam.sensors)
    if cls == "other" and kind == "crosstalk":
        def leak(x: Array, s: Complex, count: int) -> Chain:
            mix = np.eye(count)
            mix[other, channel] = GAIN * x[0]
            return Chain(np.ones((len(s), count), dtype=complex), mix)
        return LinearKind(np.array([start]), 2 * one, 0 * one, ("leak",), ("",), lambda x: GAIN * x, chain=leak, other=other)
    gain, everywhere = cls.endswith("gain"), cls.startswith("force")
    def factor(x: Array, s: Complex, count: int) -> Chain:
        sign = -1.0 if everywhere else 1.0
        value = np.exp(sign * GAIN * x[0]) * np.ones(len(s)) if gain else np.exp(-sign * DELAY * x[0] * s)
        out = np.ones((len(s), count), dtype=complex)
        if everywhere:
            out *= value[:, None]
        else:
            out[:, channel] = value
        return Chain(out)
    if cls not in ("force_gain", "force_delay", "sensor_gain", "sensor_delay") or size == 0:
        raise ValueError(f"no linear parametrisation for {cls!r} at {place!r}")
    natural = (lambda x: np.exp(GAIN * x)) if gain else (lambda x: DELAY * x)
    return LinearKind(np.array([start]), (3.0 if gain else 10.0) * one, 0 * one, ("gain" if gain else "delay",), ("" if gain else "s",),
                      natural, chain=factor)


def extension(kinds: tuple[LinearKind, ...], channels: int) -> Extension | None:
    """Several linear effects as one extension of the family."""
    if not kinds:
        return None
    sizes = [len(k.start) for k in kinds]
    edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)

    def parts(x: Array, s: Complex) -> tuple[tuple[Attachment, ...], Chain | None]:
        attachments, chain = [], None
        for k, first, last in zip(kinds, edges[:-1], edges[1:], strict=True):
            if k.attach is not None:
                attachments.append(k.attach(x[first:last], s))
            if k.chain is not None:
                new = k.chain(x[first:last], s, channels)
                if chain is None:
                    chain = new
                else:
                    mix = chain.mix if new.mix is None else new.mix if chain.mix is None else chain.mix @ new.mix
                    chain = Chain(chain.factor * new.factor, mix)
        return tuple(attachments), chain

    return Extension(np.concatenate([k.start for k in kinds]), parts, np.concatenate([k.sd for k in kinds]),
                     np.concatenate([k.centre for k in kinds]))
