"""Effects with numbers: a class at a place with its parameters, and what it adds to the linear model or to the forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.march import compiled_wanted, march
from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.forces.term import Term
from bayes_nlsid.mismatch.calibrate import Chain, Extension
from bayes_nlsid.mismatch.laws import Law
from bayes_nlsid.mismatch.linear import Attachment, Family
from bayes_nlsid.mismatch.paths import LawAlong

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
        Parameters of the law's term, or of the linear effect (``names``); for a drift the stiffness at each of ``knots``, N/m.
    names, units : tuple of str
    kind : str
        Variant of a linear effect (``maxwell``, ``crosstalk`` for class ``other``).
    knots : ndarray
        Of a drift: times of the fitted records on the scale of the test day (−1 to 1). It holds its value before and after.
    """

    cls: str
    place: str
    law: Law | None = None
    values: Array = field(default_factory=lambda: np.zeros(0))
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    kind: str = ""
    knots: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def is_force(self) -> bool:
        """Whether it enters the equations as a force that depends on motion (drifting stiffness included)."""
        return self.law is not None or self.cls == "stiffness_drift"

    @property
    def key(self) -> tuple[str, str]:
        """(class, place)."""
        return self.cls, self.place


def effect_of(cls: str, place: str, law: Law, values: Array) -> Effect:
    """The effect of a law with these parameters, named as its term names them."""
    params = law.term.params
    return Effect(cls, place, law, values, tuple(p.name for p in params), tuple(p.unit for p in params))


def along_period(law: Law, values: Array, d: Array, v: Array, dt: float, periodic: bool) -> Array:
    """Force (..., n) along a periodic motion (history begins at its largest displacement, so that one period is steady) or a burst."""
    if law.term.memory == "none":
        return np.asarray(law.term.static_force(d, v, values))
    first = int(np.argmax(np.abs(d))) if periodic else 0
    if law.term.name in ("iwan4_memory", "jenkins_memory"):
        return np.asarray(np.roll(_sliding(law, values, np.roll(d, -first)), first, axis=-1))
    p = np.asarray(values, dtype=float)
    if law.convert is not None:
        return _looping(law, p, d, periodic)
    path = motion(np.append(np.roll(d, -first), d[first]), np.append(np.roll(v, -first), v[first]), dt)
    force = force_along(law.term, path, p, excess=law.excess)[..., :-1]
    return np.asarray(np.roll(force, first, axis=-1))


def _looping(law: Law, p: Array, d: Array, periodic: bool) -> Array:
    """A rate law node by node; it forgets within some cycles how it began, so that half a period before is enough of a start."""
    assert law.convert is not None and law.term.stiffness is not None
    before = d[len(d) // 2:] if periodic else d[:0]
    force = march(law.term.memory, np.concatenate([before, d]), law.convert(p))[:, len(before):]
    if law.excess:
        force = force - np.asarray(law.term.stiffness(*np.atleast_2d(p).T))[:, None] * d
    return force.reshape(*p.shape[:-1], len(d))


def _sliding(law: Law, values: Array, d: Array, bins: int = 14) -> Array:
    """Masing elements as a few parallel sliders, for the search: within 1 % of ``force_along`` and many times as fast.

    The state of a slider after a monotone piece is clip(x + move, −a, a); such maps are closed under composition, so the states
    at all turning points come from a prefix scan, and the samples between them from one more clip.
    """
    p = np.atleast_2d(values)
    stiffness, slip = _sliders(law, p, bins)                                       # (B, k)
    if compiled_wanted():
        from bayes_nlsid.forces.compiled import march_sliders

        moves = np.diff(d, prepend=0.0)
        force = march_sliders(moves, np.ascontiguousarray(stiffness), np.ascontiguousarray(slip), np.ones(len(p)))
        if law.excess:
            force -= stiffness.sum(1)[:, None] * d
        return np.asarray(force.reshape(*np.shape(values)[:-1], len(d)))
    turn = np.concatenate([[0], 1 + np.flatnonzero((d[1:-1] - d[:-2]) * (d[2:] - d[1:-1]) < 0), [len(d) - 1]])
    piece = np.clip(np.searchsorted(turn, np.arange(len(d)), side="right") - 1, 0, len(turn) - 2)
    start = np.clip(d[0], -slip, slip)
    shift = np.broadcast_to(np.diff(d[turn]), (*slip.shape, len(turn) - 1)).copy()
    low, high = np.repeat(-slip[..., None], shift.shape[-1], axis=-1), np.repeat(slip[..., None], shift.shape[-1], axis=-1)
    span = 1
    while span < shift.shape[-1]:
        # map of pieces i−span+1…i after the one that ends where it begins
        lower, upper, m = low[..., span:], high[..., span:], shift[..., span:]
        before_l, before_h, before_m = low[..., :-span], high[..., :-span], shift[..., :-span]
        new_l, new_h = np.clip(before_l + m, lower, upper), np.clip(before_h + m, lower, upper)
        shift = np.concatenate([shift[..., :span], before_m + m], axis=-1)
        low, high = np.concatenate([low[..., :span], new_l], axis=-1), np.concatenate([high[..., :span], new_h], axis=-1)
        span *= 2
    state = np.concatenate([start[..., None], np.clip(start[..., None] + shift, low, high)], axis=-1)
    force = np.zeros((len(p), len(d)))
    move = d - d[turn][piece]
    for k in range(slip.shape[1]):
        a = slip[:, k, None]
        force += stiffness[:, k, None] * np.clip(state[:, k][:, piece] + move, -a, a)
    if law.excess:
        force -= stiffness.sum(1)[:, None] * d
    return force.reshape(*np.shape(values)[:-1], len(d))


def _sliders(law: Law, p: Array, bins: int) -> tuple[Array, Array]:
    """Stiffness and slip displacement (B, k) of parallel sliders equal to the element (Segalman 2005, equation 19 onwards)."""
    if law.term.name == "jenkins_memory":
        return p[:, 1:2], p[:, 0:1] / np.maximum(p[:, 1:2], 1e-300)
    f_s, k_t, m, beta = p[:, 0:1], p[:, 1:2], np.maximum(p[:, 2:3] + 1.0, 1e-6), np.maximum(p[:, 3:4], 0.0)
    edges = np.linspace(0.0, 1.0, bins + 1) ** 1.7
    reach = f_s * (1 + beta) / np.maximum(k_t * (beta + m / (m + 1)), 1e-290)
    share = edges[1:] ** m - edges[:-1] ** m
    moment = m / (m + 1) * (edges[1:] ** (m + 1) - edges[:-1] ** (m + 1))
    centre = moment / np.maximum(share, 1e-300)
    stiffness = np.concatenate([share, np.broadcast_to(beta, (len(p), 1))], axis=1) * k_t / (1 + beta)
    return stiffness, np.concatenate([centre, np.ones((len(p), 1))], axis=1) * reach


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
        if param.rule == "range":
            values[i] = np.clip(values[i], param.lower, param.upper)
    return replace(effect, values=values)


def _to(effect: Effect, i: int, kind: str) -> float:
    value = float(effect.values[i])
    return float(np.log(max(value, 1e-300))) if kind == "log" else value / _scale(effect, i)


def _scale(effect: Effect, i: int) -> float:
    return max(abs(float(effect.values[i])), 1e-12) if effect.law is not None and effect.law.free[i] == "signed" else 1.0


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


def law_of(effect: Effect, time: float, periodic: bool) -> LawAlong:
    """The force of an effect along a motion, in a record taken at ``time`` (−1 to 1 over the test day of the fitted records)."""
    if effect.law is None:
        stiffness = float(np.interp(time, effect.knots, effect.values))
        return LawAlong(lambda d, v, dt: stiffness * d, lambda d, v: (np.full(len(d), stiffness), np.zeros(len(d))),
                        _code(LIBRARY["spring"]), np.array([stiffness]))
    force = partial(_along, effect, periodic)
    if effect.law.term.memory != "none":
        return LawAlong(force)
    return LawAlong(force, partial(_slope, effect), _code(effect.law.term), np.asarray(effect.values, dtype=float))


def _along(effect: Effect, periodic: bool, d: Array, v: Array, dt: float) -> Array:
    assert effect.law is not None
    with np.errstate(over="ignore", invalid="ignore"):
        return along_period(effect.law, effect.values, d, v, dt, periodic)


def _slope(effect: Effect, d: Array, v: Array) -> tuple[Array, Array]:
    assert effect.law is not None
    with np.errstate(over="ignore", invalid="ignore"):
        stiffness, damping = effect.law.term.slope(d, v, *effect.values)
    return np.broadcast_to(stiffness, d.shape), np.broadcast_to(damping, d.shape)


def _code(term: Term) -> tuple[int, float] | None:
    """Number of a law for compiled code, where that is to be had."""
    if not compiled_wanted():
        return None
    from bayes_nlsid.forces.compiled import law_code

    return law_code(term)


def weakened(effect: Effect, factor: float) -> Effect:
    """The same effect with its force scaled."""
    if effect.law is None:
        return replace(effect, values=factor * effect.values)
    values = np.array(effect.values, dtype=float)
    values[list(effect.law.scaled)] *= factor
    return replace(effect, values=values)


def packed(effect: Effect, reference: Effect) -> Array:
    """Search coordinates of ``effect`` on the scales of ``reference``."""
    if effect.law is None:
        return np.asarray(effect.values / max(float(np.abs(reference.values).max()), 1e-12))
    out = pack(effect)
    free = [i for i, kind in enumerate(effect.law.free) if kind != "fixed"]
    for k, i in enumerate(free):
        if effect.law.free[i] == "signed":
            out[k] = effect.values[i] / max(abs(float(reference.values[i])), 1e-12)
    return out
