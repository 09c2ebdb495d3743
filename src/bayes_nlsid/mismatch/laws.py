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

from bayes_nlsid.forces import joint_laws
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
    onset : callable or None
        ``onset(p, peak)``: motion (m) above which the law with parameters p departs from a linear one, ``peak`` being the largest motion;
        None for laws that act at any motion.
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
    onset: Callable[[Array, float], float] | None = None
    signed: bool = False
    excess: bool = False
    convert: Callable[[Array], Array] | None = None


def _grid(*axes: Array) -> Array:
    mesh = np.meshgrid(*axes, indexing="ij")
    return np.stack([m.ravel() for m in mesh], axis=-1)


POWER_SPRING = Term("power_spring", "f*sign(q)*(abs(q)/d)**n",
                    (Param("f", "N", "force", meaning="force at d"), Param("d", "m", "displacement", meaning="reference, fixed"),
                     Param("n", "", "range", 1.2, 9.0, "exponent")),
                    joint_laws.power_spring, joint_laws.power_spring_slope, linear=False,
                    meaning="spring that stiffens like a power of displacement")

LEVELLING = Term("levelling_spring", "k*q*(abs(q)/d)**m/(1 + (abs(q)/d)**m)",
                 (Param("k", "N/m", "stiffness", meaning="stiffness gained at large motion"),
                  Param("d", "m", "displacement", meaning="motion at which half of it is there"),
                  Param("m", "", "range", 0.5, 4.0, "sharpness")),
                 joint_laws.levelling, joint_laws.levelling_slope, meaning="spring that stiffens with displacement and levels off")

EXPONENTIAL = Term("exponential_spring", "k*(d*sinh(q/d) - q)",
                   (Param("k", "N/m", "stiffness", meaning="stiffness scale"),
                    Param("d", "m", "displacement", meaning="motion over which stiffness grows by a factor")),
                   joint_laws.exponential_spring, joint_laws.exponential_spring_slope,
                   meaning="spring that stiffens exponentially with displacement, alike in both directions")

SATURATING = Term("saturating_spring", "-k*q*(abs(q)/d)**m/(1 + (abs(q)/d)**m)",
                  (Param("k", "N/m", "stiffness", meaning="stiffness lost at large motion"),
                   Param("d", "m", "displacement", meaning="motion at which half of it is lost"),
                   Param("m", "", "range", 0.5, 4.0, "sharpness")),
                  joint_laws.saturating, joint_laws.saturating_slope,
                  meaning="spring that softens with displacement and returns on the same line")

FALLING = Term("falling_spring", "-f*sign(q)*(abs(q)/d)**n",
               (Param("f", "N", "force", meaning="force lost at d"), Param("d", "m", "displacement", meaning="reference, fixed"),
                Param("n", "", "range", 1.2, 5.0, "exponent")),
               joint_laws.falling_spring, joint_laws.falling_spring_slope, meaning="spring that loses a power of displacement")

LOOSENING = Term("loosening_spring", "-k*q*(1 - (1 + (abs(q)/d)**m)**-p)",
                 (Param("k", "N/m", "stiffness", meaning="stiffness lost at large motion"),
                  Param("d", "m", "displacement", meaning="scale of the motion at which it is lost"),
                  Param("m", "", "range", 0.5, 4.0, "sharpness of the start"), Param("p", "", "range", 0.15, 3.0, "speed of the end")),
                 joint_laws.loosening, joint_laws.loosening_slope,
                 meaning="spring that loses stiffness, soon or gradually, and returns on the same line")

ROUNDED_GAP = Term("rounded_gap", "k*w*e*(log(1 + exp((q - e)/(w*e))) - log(1 + exp((-q - e)/(w*e))))",
                   (Param("k", "N/m", "stiffness", meaning="stiffness in contact"), Param("e", "m", "displacement", meaning="gap"),
                    Param("w", "", "range", 0.03, 0.3, "rounding over the gap")),
                   joint_laws.rounded_gap, joint_laws.rounded_gap_slope, meaning="gap on both sides with rough faces")

ONE_STOP = Term("one_stop", "k*e*max(sign(k)*q/e - 1, 0)**n",
                (Param("k", "N/m", "coefficient", meaning="stiffness scale; negative: the stop is on the other side"),
                 Param("e", "m", "displacement", meaning="gap"), Param("n", "", "range", 1.0, 2.0, "exponent, 1.5 for a round body")),
                joint_laws.one_stop, joint_laws.one_stop_slope, parity="none", meaning="stop on one side beyond a gap")

TWO_STOPS = Term("two_stops", "k*(max(q - e, 0) - r*max(-q - u*e, 0))",
                 (Param("k", "N/m", "stiffness", meaning="stiffness of the stop at e"), Param("e", "m", "displacement", meaning="gap"),
                  Param("r", "", "range", 0.15, 7.0, "stiffness of the other stop over this one"),
                  Param("u", "", "range", 0.2, 5.0, "gap on the other side over this one")),
                 joint_laws.two_stops, joint_laws.two_stops_slope, parity="none", meaning="unequal stops on both sides")

ROUND_STOPS = Term("round_stops", "k*e*sign(q)*max(abs(q)/e - 1, 0)**n",
                   (Param("k", "N/m", "stiffness", meaning="stiffness scale"), Param("e", "m", "displacement", meaning="gap"),
                    Param("n", "", "range", 1.0, 2.5, "exponent, 1.5 for round bodies")),
                   joint_laws.round_stops, joint_laws.round_stops_slope, meaning="gap between round bodies on both sides")

_LOSSY = (Param("e", "m", "displacement", meaning="gap"), Param("n", "", "range", 1.0, 2.5, "exponent, 1.5 for round bodies"),
          Param("u", "m/s", "velocity", meaning="speed of approach that doubles the force"))
LOSSY_STOP = Term("lossy_stop", "k*e*max(sign(k)*q/e - 1, 0)**n*max(1 + sign(k)*v/u, 0)",
                  (Param("k", "N/m", "coefficient", meaning="stiffness scale; negative: the stop is on the other side"), *_LOSSY),
                  joint_laws.lossy_stop, joint_laws.lossy_stop_slope, parity="none",
                  meaning="stop on one side beyond a gap that loses energy in contact")

LOSSY_STOPS = Term("lossy_stops", "k*e*sign(q)*max(abs(q)/e - 1, 0)**n*max(1 + sign(q)*v/u, 0)",
                   (Param("k", "N/m", "stiffness", meaning="stiffness scale"), *_LOSSY),
                   joint_laws.lossy_stops, joint_laws.lossy_stops_slope,
                   meaning="gap on both sides whose stops lose energy in contact")

ONE_SIDED = Term("one_sided_spring", "k*where(q > e*d, q - e*d, 0)",
                 (Param("k", "N/m", "coefficient", meaning="stiffness on one side"),
                  Param("e", "", "range", -3.0, 3.0, "where it begins, over d"),
                  Param("d", "m", "displacement", meaning="reference, fixed")),
                 joint_laws.one_sided, joint_laws.one_sided_slope, parity="none",
                 meaning="stiffness that differs between opening and closing")

BENT = Term("bent_spring", "k*d*(sqrt((q/d - e)**2 + w**2) - sqrt(e**2 + w**2))/2",
            (Param("k", "N/m", "coefficient", meaning="difference of stiffness between the two directions"),
             Param("e", "", "range", -3.0, 3.0, "where it changes, over d"),
             Param("w", "", "range", 0.02, 20.0, "over how much motion, over d"),
             Param("d", "m", "displacement", meaning="reference, fixed")),
            joint_laws.bent, joint_laws.bent_slope, parity="none",
            meaning="stiffness that changes gradually from one direction to the other")

CLOSING = Term("closing_faces", "k*abs(d)*(exp(q/d) - 1 - q/d)",
               (Param("k", "N/m", "coefficient", meaning="stiffness scale"),
                Param("d", "m", "coefficient", meaning="length over which the faces close; its sign is the direction")),
               joint_laws.closing, joint_laws.closing_slope, parity="none",
               meaning="rough faces whose stiffness grows exponentially as they close")

FRICTION = Term("rounded_friction", "f*tanh(v/w)",
                (Param("f", "N", "force", meaning="sliding force"), Param("w", "m/s", "velocity", meaning="velocity of rounding")),
                joint_laws.rounded_friction, joint_laws.rounded_friction_slope, dissipative=True,
                meaning="dry friction, rounded at rest")

SLOW_FRICTION = Term("falling_friction", "f*v/sqrt(v**2 + w**2)*(1 + a*exp(-abs(v)/(s*w)))",
                     (Param("f", "N", "force", meaning="sliding force at speed"),
                      Param("w", "m/s", "velocity", meaning="velocity of rounding"),
                      Param("a", "", "range", 0.0, 2.0, "how much higher it is when slow"),
                      Param("s", "", "range", 1.0, 100.0, "velocity over w at which it has fallen")),
                     joint_laws.falling_friction, joint_laws.falling_friction_slope, dissipative=True,
                     meaning="dry friction that falls with speed")

POWER_DAMPER = Term("power_damper", "f*sign(v)*(abs(v)/w)**n",
                    (Param("f", "N", "force", meaning="force at w"), Param("w", "m/s", "velocity", meaning="reference, fixed"),
                     Param("n", "", "range", 1.2, 4.0, "exponent")),
                    joint_laws.power_damper, joint_laws.power_damper_slope, dissipative=True,
                    meaning="damping that grows with velocity")

LEVELLING_DAMPER = Term("levelling_damper", "c*v*(abs(v)/w)**m/(1 + (abs(v)/w)**m)",
                        (Param("c", "N s/m", "coefficient", meaning="damping gained at high speed"),
                         Param("w", "m/s", "velocity", meaning="speed at which half of it is there"),
                         Param("m", "", "range", 0.5, 4.0, "sharpness")),
                        joint_laws.levelling_damper, joint_laws.levelling_damper_slope, dissipative=True,
                        meaning="damping that grows with velocity and levels off")

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


def _at(index: int, share: float = 1.0) -> Callable[[Array, float], float]:
    """Onset at a share of a parameter that is a length."""
    return lambda p, peak: share * abs(float(p[index]))


def power_onset(p: Array, peak: float) -> float:
    """Displacement at which a power spring (exponent ``p[2]``) has a tenth of the stiffness that it has at the largest one."""
    return float(peak * 0.1 ** (1 / max(float(p[2]) - 1, 0.1)))


def _slip(share: float) -> Callable[[Array, float], float]:
    """Onset at a share of the displacement at which an element of force ``p[0]`` and stiffness ``p[1]`` slips."""
    return lambda p, peak: share * float(p[0] / max(float(p[1]), 1e-300))


HARDENING = (Law(POWER_SPRING, lambda z: _grid(np.array([1.0]), np.array([z.displacement]), np.array([2.0, 3.0, 4.0, 5.0])),
                 ("log", "fixed", "log"), (0,), power_onset),
             Law(LEVELLING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.7, 1.5, 3.0]), np.array([1.0, 2.0])),
                 ("log", "log", "log"), (0,), _at(1, 0.1)),
             Law(EXPONENTIAL, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.5, 0.8, 1.3])), ("log", "log"), (0,), _at(1)))
SOFTENING = (Law(SATURATING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.5, 1.0, 2.0, 5.0]), np.array([1.0, 2.0])),
                 ("log", "log", "log"), (0,), _at(1, 0.1)),
             Law(FALLING, lambda z: _grid(np.array([1.0]), np.array([z.displacement]), np.array([2.0, 3.0])),
                 ("log", "fixed", "log"), (0,), power_onset),
             Law(LOOSENING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.5, 1.0, 2.0, 5.0]), np.array([1.0, 2.0]),
                                            np.array([0.5])),
                 ("log", "log", "log", "log"), (0,), _at(1, 0.1)))
_GAPS = np.array([0.5, 1.2, 2.0, 3.0, 4.0, 5.0, 6.0])
CLEARANCE = (Law(LIBRARY["clearance"], lambda z: _grid(np.array([1.0]), z.displacement * _GAPS), ("log", "log"), (0,), _at(1, 0.5)),
             Law(ROUNDED_GAP, lambda z: _grid(np.array([1.0]), z.displacement * _GAPS[:5], np.array([0.1])), ("log", "log", "log"), (0,),
                 _at(1)),
             Law(ROUND_STOPS, lambda z: _grid(np.array([1.0]), z.displacement * _GAPS[:5], np.array([1.5])), ("log", "log", "log"), (0,),
                 _at(1)),
             Law(TWO_STOPS, lambda z: _grid(np.array([1.0]), z.displacement * _GAPS[:4], np.array([0.3, 1.0]), np.array([0.6, 1.6])),
                 ("log", "log", "log", "log"), (0,), _at(1)),
             Law(LOSSY_STOPS, lambda z: _grid(np.array([1.0]), z.displacement * _GAPS[:5], np.array([1.5]), z.velocity * np.array([4.0])),
                 ("log", "log", "log", "log"), (0,), _at(1)))
ASYMMETRIC = (Law(ONE_SIDED, lambda z: _grid(np.array([1.0]), np.array([-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0]), np.array([z.displacement])),
                  ("signed", "linear", "fixed"), (0,), lambda p, peak: abs(float(p[1] * p[2])), signed=True),
              Law(BENT, lambda z: _grid(np.array([1.0]), np.array([-0.7, 0.0, 0.7]), np.array([0.3, 1.0, 4.0]), np.array([z.displacement])),
                  ("signed", "linear", "log", "fixed"), (0,), lambda p, peak: abs(float(p[1] * p[3])), signed=True),
              Law(CLOSING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([-3.0, -1.0, 1.0, 3.0])), ("signed", "signed"), (0,),
                  signed=True),
              # contact on one side only differs between the two directions, whatever its gap; a gap that closes has two faces
              Law(ONE_STOP, lambda z: _grid(np.array([1.0, -1.0]), z.displacement * _GAPS[:5], np.array([1.0, 1.5])),
                  ("signed", "log", "log"), (0,), _at(1)),
              Law(LOSSY_STOP, lambda z: _grid(np.array([1.0, -1.0]), z.displacement * _GAPS[:5], np.array([1.5]),
                                              z.velocity * np.array([4.0])),
                  ("signed", "log", "log", "log"), (0,), _at(1)))
COULOMB = (Law(FRICTION, lambda z: _grid(np.array([1.0]), z.velocity * np.array([0.003, 0.02, 0.1, 0.3, 1.0])), ("log", "log"), (0,)),
           Law(SLOW_FRICTION, lambda z: _grid(np.array([1.0]), z.velocity * np.array([0.02, 0.1, 0.4]), np.array([0.4]),
                                        np.array([3.0, 10.0])),
               ("log", "log", "linear", "log"), (0,)))
QUADRATIC = (Law(POWER_DAMPER, lambda z: _grid(np.array([1.0]), np.array([z.velocity]), np.array([1.6, 2.0, 2.5, 3.0])),
                 ("log", "fixed", "log"), (0,)),
             Law(LEVELLING_DAMPER, lambda z: _grid(np.array([1.0]), z.velocity * np.array([1.0, 3.0]), np.array([1.0, 2.0])),
                 ("log", "log", "log"), (0,)))
# force and stiffness of an element with memory scale together; the ratio f/k sets where it slips
HYSTERESIS = (Law(LIBRARY["iwan4_memory"], lambda z: _grid(z.displacement * np.array([0.15, 0.4, 1.0, 2.5, 6.0]), np.array([1.0]),
                                                           np.array([-0.5, 0.5]), np.array([0.3])),
                  ("log", "log", "linear", "log"), (0, 1), _slip(0.1), excess=True),
              Law(LIBRARY["jenkins_memory"], lambda z: _grid(z.displacement * np.array([0.15, 0.4, 1.0, 1.8, 2.6]), np.array([1.0])),
                  ("log", "log"), (0, 1), _slip(1.0), excess=True),
              Law(LOOP, lambda z: _grid(z.displacement * np.array([0.3, 1.0, 3.0]), np.array([1.0]), np.array([0.5, 1.0]), np.array([1.0])),
                  ("log", "log", "linear", "log"), (0, 1), _slip(1.0), excess=True, convert=_loop))
