"""Force laws of the catalogue: several for each class, since nobody knows the formula that a real joint follows.

Within a class the laws differ in how they set in, how sharp they are and whether they level off; the search takes the one that explains
most, so that a class does not lose for want of a formula.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Term

Array = NDArray[np.float64]


@final
@dataclass(frozen=True)
class Size:
    """How large the motion at a place is: the scales from which shapes of laws are tried.

    ``displacement``, ``velocity``: rms in the strongest record, m and m/s; ``peak``: largest displacement, m;
    ``stiffness``: a force scale, N/m.
    """

    displacement: float
    velocity: float
    peak: float
    stiffness: float = 1.0


@final
@dataclass(frozen=True)
class Law:
    """A force law as the search uses it.

    Parameters
    ----------
    term : Term
        Its first parameter is a factor of the force, or (``excess`` memory terms) becomes one by ``unit``.
    shapes : callable
        ``shapes(size) -> (K, n_p)``: parameters with unit scale of force, one row for each shape tried.
    free : tuple of {"log", "linear", "signed", "fixed"}
        How each parameter moves in the joint estimation; ``signed`` in units of its first value.
    scaled : tuple of int
        Parameters that are multiplied when the force is multiplied (forces and stiffnesses).
    signed : bool
        Whether the factor may be negative.
    excess : bool
        Leave out the spring at rest, which the linear model has.
    convert : callable or None
        From these parameters to those of the library's term of the same memory, if they differ.
    """

    term: Term
    shapes: Callable[[Size], Array]
    free: tuple[str, ...]
    scaled: tuple[int, ...]
    signed: bool = False
    excess: bool = False
    convert: Callable[[Array], Array] | None = None


def _grid(*axes: Array) -> Array:
    mesh = np.meshgrid(*axes, indexing="ij")
    return np.stack([m.ravel() for m in mesh], axis=-1)


def _soft(y: Array) -> Array:
    return np.asarray(np.logaddexp(0.0, y))


def _step(y: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-np.clip(y, -700, 700))))


POWER_SPRING = Term("power_spring", "f*sign(q)*(abs(q)/d)**n",
                    (Param("f", "N", "force", meaning="force at d"), Param("d", "m", "displacement", meaning="reference, fixed"),
                     Param("n", "", "range", 1.2, 9.0, "exponent")),
                    lambda q, v, f, d, n: f * np.sign(q) * (np.abs(q) / d) ** n,
                    lambda q, v, f, d, n: (f * n / d * (np.abs(q) / d) ** (n - 1), 0 * q), linear=False,
                    meaning="spring that stiffens like a power of displacement")

LEVELLING = Term("levelling_spring", "k*q*(abs(q)/d)**m/(1 + (abs(q)/d)**m)",
                 (Param("k", "N/m", "stiffness", meaning="stiffness gained at large motion"),
                  Param("d", "m", "displacement", meaning="motion at which half of it is there"),
                  Param("m", "", "range", 0.5, 4.0, "sharpness")),
                 lambda q, v, k, d, m: k * q * (np.abs(q) / d) ** m / (1 + (np.abs(q) / d) ** m),
                 lambda q, v, k, d, m: (k * (np.abs(q) / d) ** m * (1 + m + (np.abs(q) / d) ** m) / (1 + (np.abs(q) / d) ** m) ** 2, 0 * q),
                 meaning="spring that stiffens with displacement and levels off")

SATURATING = Term("saturating_spring", "-k*q*(abs(q)/d)**m/(1 + (abs(q)/d)**m)",
                  (Param("k", "N/m", "stiffness", meaning="stiffness lost at large motion"),
                   Param("d", "m", "displacement", meaning="motion at which half of it is lost"),
                   Param("m", "", "range", 0.5, 4.0, "sharpness")),
                  lambda q, v, k, d, m: -k * q * (np.abs(q) / d) ** m / (1 + (np.abs(q) / d) ** m),
                  lambda q, v, k, d, m: (-k * (np.abs(q) / d) ** m * (1 + m + (np.abs(q) / d) ** m) / (1 + (np.abs(q) / d) ** m) ** 2,
                                         0 * q),
                  meaning="spring that softens with displacement and returns on the same line")

FALLING = Term("falling_spring", "-f*sign(q)*(abs(q)/d)**n",
               (Param("f", "N", "force", meaning="force lost at d"), Param("d", "m", "displacement", meaning="reference, fixed"),
                Param("n", "", "range", 1.2, 5.0, "exponent")),
               lambda q, v, f, d, n: -f * np.sign(q) * (np.abs(q) / d) ** n,
               lambda q, v, f, d, n: (-f * n / d * (np.abs(q) / d) ** (n - 1), 0 * q),
               meaning="spring that loses a power of displacement")

ROUNDED_GAP = Term("rounded_gap", "k*w*e*(log(1 + exp((q - e)/(w*e))) - log(1 + exp((-q - e)/(w*e))))",
                   (Param("k", "N/m", "stiffness", meaning="stiffness in contact"), Param("e", "m", "displacement", meaning="gap"),
                    Param("w", "", "range", 0.01, 0.6, "rounding over the gap")),
                   lambda q, v, k, e, w: k * w * e * (_soft((q - e) / (w * e)) - _soft((-q - e) / (w * e))),
                   lambda q, v, k, e, w: (k * (_step((q - e) / (w * e)) + _step((-q - e) / (w * e))), 0 * q),
                   meaning="gap on both sides with rough faces")

def _stop_slope(y: Array, k: Array, n: Array) -> Array:
    return np.asarray(k * n * np.where(y > 0, np.maximum(y, 1e-12) ** (n - 1), 0.0))


ONE_STOP = Term("one_stop", "k*e*max(sign(k)*q/e - 1, 0)**n",
                (Param("k", "N/m", "coefficient", meaning="stiffness scale; negative: the stop is on the other side"),
                 Param("e", "m", "displacement", meaning="gap"), Param("n", "", "range", 1.0, 2.0, "exponent, 1.5 for a round body")),
                lambda q, v, k, e, n: k * e * np.maximum(np.sign(k) * q / e - 1, 0.0) ** n,
                lambda q, v, k, e, n: (_stop_slope(np.sign(k) * q / e - 1, np.abs(k), n), 0 * q),
                parity="none", meaning="stop on one side beyond a gap")

TWO_STOPS = Term("two_stops", "k*(max(q - e, 0) - r*max(-q - u*e, 0))",
                 (Param("k", "N/m", "stiffness", meaning="stiffness of the stop at e"), Param("e", "m", "displacement", meaning="gap"),
                  Param("r", "", "range", 0.05, 20.0, "stiffness of the other stop over this one"),
                  Param("u", "", "range", 0.2, 5.0, "gap on the other side over this one")),
                 lambda q, v, k, e, r, u: k * (np.maximum(q - e, 0.0) - r * np.maximum(-q - u * e, 0.0)),
                 lambda q, v, k, e, r, u: (k * (np.where(q > e, 1.0, 0.0) + r * np.where(-q > u * e, 1.0, 0.0)), 0 * q),
                 parity="none", meaning="unequal stops on both sides")

ONE_SIDED = Term("one_sided_spring", "k*where(q > e*d, q - e*d, 0)",
                 (Param("k", "N/m", "coefficient", meaning="stiffness on one side"),
                  Param("e", "", "range", -3.0, 3.0, "where it begins, over d"),
                  Param("d", "m", "displacement", meaning="reference, fixed")),
                 lambda q, v, k, e, d: k * np.where(q > e * d, q - e * d, 0.0),
                 lambda q, v, k, e, d: (k * np.where(q > e * d, 1.0, 0.0), 0 * q), parity="none",
                 meaning="stiffness that differs between opening and closing")

BENT = Term("bent_spring", "k*d*(sqrt((q/d - e)**2 + w**2) - sqrt(e**2 + w**2))/2",
            (Param("k", "N/m", "coefficient", meaning="difference of stiffness between the two directions"),
             Param("e", "", "range", -3.0, 3.0, "where it changes, over d"),
             Param("w", "", "range", 0.02, 20.0, "over how much motion, over d"),
             Param("d", "m", "displacement", meaning="reference, fixed")),
            lambda q, v, k, e, w, d: 0.5 * k * d * (np.sqrt((q / d - e) ** 2 + w ** 2) - np.sqrt(e ** 2 + w ** 2)),
            lambda q, v, k, e, w, d: (0.5 * k * (q / d - e) / np.sqrt((q / d - e) ** 2 + w ** 2), 0 * q), parity="none",
            meaning="stiffness that changes gradually from one direction to the other")


def _exponential(q: Array, k: Array, d: Array) -> tuple[Array, Array]:
    """Force and slope of rough faces that close, straight beyond three times their length."""
    y = np.clip(q / d, -30.0, 3.0)
    grown = np.expm1(y)
    return k * np.abs(d) * (grown - y + (q / d - y) * grown), k * np.sign(d) * grown


CLOSING = Term("closing_faces", "k*abs(d)*(exp(q/d) - 1 - q/d)",
               (Param("k", "N/m", "coefficient", meaning="stiffness scale"),
                Param("d", "m", "coefficient", meaning="length over which the faces close; its sign is the direction")),
               lambda q, v, k, d: _exponential(q, k, d)[0], lambda q, v, k, d: (_exponential(q, k, d)[1], 0 * q), parity="none",
               meaning="rough faces whose stiffness grows exponentially as they close")

FRICTION = Term("rounded_friction", "f*tanh(v/w)",
                (Param("f", "N", "force", meaning="sliding force"), Param("w", "m/s", "velocity", meaning="velocity of rounding")),
                lambda q, v, f, w: f * np.tanh(v / w),
                lambda q, v, f, w: (0 * q, f / w / np.cosh(np.clip(v / w, -300, 300)) ** 2), dissipative=True,
                meaning="dry friction, rounded at rest")


def _slow_slope(v: Array, f: Array, w: Array, a: Array, s: Array) -> Array:
    root, fall = np.sqrt(v ** 2 + w ** 2), a * np.exp(-np.abs(v) / (s * w))
    return np.asarray(f * (w ** 2 / root ** 3 * (1 + fall) - np.abs(v) / root * fall / (s * w)))


SLOW_FRICTION = Term("falling_friction", "f*v/sqrt(v**2 + w**2)*(1 + a*exp(-abs(v)/(s*w)))",
                     (Param("f", "N", "force", meaning="sliding force at speed"),
                      Param("w", "m/s", "velocity", meaning="velocity of rounding"),
                      Param("a", "", "range", 0.0, 2.0, "how much higher it is when slow"),
                      Param("s", "", "range", 1.0, 100.0, "velocity over w at which it has fallen")),
                     lambda q, v, f, w, a, s: f * v / np.sqrt(v ** 2 + w ** 2) * (1 + a * np.exp(-np.abs(v) / (s * w))),
                     lambda q, v, f, w, a, s: (0 * q, _slow_slope(v, f, w, a, s)), dissipative=True,
                     meaning="dry friction that falls with speed")

POWER_DAMPER = Term("power_damper", "f*sign(v)*(abs(v)/w)**n",
                    (Param("f", "N", "force", meaning="force at w"), Param("w", "m/s", "velocity", meaning="reference, fixed"),
                     Param("n", "", "range", 1.2, 4.0, "exponent")),
                    lambda q, v, f, w, n: f * np.sign(v) * (np.abs(v) / w) ** n,
                    lambda q, v, f, w, n: (0 * q, f * n / w * (np.abs(v) / w) ** (n - 1)), dissipative=True,
                    meaning="damping that grows with velocity")

LOOP = Term("bouc_wen_loop", "k*q",
            (Param("f", "N", "force", meaning="yield force"), Param("k", "N/m", "stiffness", meaning="stiffness of the loop at its start"),
             Param("g", "", "range", 0.2, 1.5, "share of the bending that dissipates"),
             Param("n", "", "range", 1.0, 4.0, "sharpness of the knee")),
            lambda q, v, f, k, g, n: k * q, lambda q, v, f, k, g, n: (k + 0 * q, 0 * q), memory="bouc_wen",
            stiffness=lambda f, k, g, n: k + 0 * f, dissipative=True,
            meaning="Bouc–Wen loop, stated by its yield force")


def _loop(p: Array) -> Array:
    """Library parameters (alpha, beta, gamma, delta, nu) of loops (f, k, g, n)."""
    p = np.atleast_2d(p)
    f, k, g, n = (p[:, i] for i in range(4))
    return np.stack([k, k / np.maximum(f, 1e-300) ** n, g, 1 - g, n], axis=1)


HARDENING = (Law(POWER_SPRING, lambda z: _grid(np.array([1.0]), np.array([z.displacement]), np.array([2.0, 3.0, 4.0, 5.0])),
                 ("log", "fixed", "log"), (0,)),
             Law(LEVELLING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.7, 1.5, 3.0]), np.array([1.0, 2.0])),
                 ("log", "log", "log"), (0,)))
SOFTENING = (Law(SATURATING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.5, 1.0, 2.0, 5.0]), np.array([1.0, 2.0])),
                 ("log", "log", "log"), (0,)),
             Law(FALLING, lambda z: _grid(np.array([1.0]), np.array([z.displacement]), np.array([2.0, 3.0])),
                 ("log", "fixed", "log"), (0,)))
_GAPS = np.array([0.5, 1.2, 2.0, 3.0, 4.0, 5.0, 6.0])
CLEARANCE = (Law(LIBRARY["clearance"], lambda z: _grid(np.array([1.0]), z.displacement * _GAPS), ("log", "log"), (0,)),
             Law(ROUNDED_GAP, lambda z: _grid(np.array([1.0]), z.displacement * _GAPS[:5], np.array([0.1])), ("log", "log", "log"), (0,)),
             Law(ONE_STOP, lambda z: _grid(np.array([1.0, -1.0]), z.displacement * _GAPS[:5], np.array([1.0, 1.5])),
                 ("signed", "log", "log"), (0,)),
             Law(TWO_STOPS, lambda z: _grid(np.array([1.0]), z.displacement * _GAPS[:4], np.array([0.3, 1.0]), np.array([0.6, 1.6])),
                 ("log", "log", "log", "log"), (0,)))
ASYMMETRIC = (Law(ONE_SIDED, lambda z: _grid(np.array([1.0]), np.array([-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0]), np.array([z.displacement])),
                  ("signed", "linear", "fixed"), (0,), signed=True),
              Law(BENT, lambda z: _grid(np.array([1.0]), np.array([-0.7, 0.0, 0.7]), np.array([0.3, 1.0, 4.0]), np.array([z.displacement])),
                  ("signed", "linear", "log", "fixed"), (0,), signed=True),
              Law(CLOSING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([-3.0, -1.0, 1.0, 3.0])), ("signed", "signed"), (0,),
                  signed=True))
COULOMB = (Law(FRICTION, lambda z: _grid(np.array([1.0]), z.velocity * np.array([0.003, 0.02, 0.1, 0.3, 1.0])), ("log", "log"), (0,)),
           Law(SLOW_FRICTION, lambda z: _grid(np.array([1.0]), z.velocity * np.array([0.02, 0.1, 0.4]), np.array([0.4]),
                                        np.array([3.0, 10.0])),
               ("log", "log", "linear", "log"), (0,)))
QUADRATIC = (Law(POWER_DAMPER, lambda z: _grid(np.array([1.0]), np.array([z.velocity]), np.array([1.6, 2.0, 2.5, 3.0])),
                 ("log", "fixed", "log"), (0,)),)
# force and stiffness of an element with memory scale together; the ratio f/k sets where it slips
HYSTERESIS = (Law(LIBRARY["iwan4_memory"], lambda z: _grid(z.displacement * np.array([0.15, 0.4, 1.0, 2.5, 6.0]), np.array([1.0]),
                                                           np.array([-0.5, 0.5]), np.array([0.3])),
                  ("log", "log", "linear", "log"), (0, 1), excess=True),
              Law(LIBRARY["jenkins_memory"], lambda z: _grid(z.displacement * np.array([0.15, 0.4, 1.0, 1.8, 2.6]), np.array([1.0])),
                  ("log", "log"), (0, 1), excess=True),
              Law(LOOP, lambda z: _grid(z.displacement * np.array([0.3, 1.0, 3.0]), np.array([1.0]), np.array([0.5, 1.0]), np.array([1.0])),
                  ("log", "log", "linear", "log"), (0, 1), excess=True, convert=_loop))
