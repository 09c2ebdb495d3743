"""The catalogue of missing physics: one row for each class of effect that a nominal model and its recordings may lack.

A row says in words what it claims, which law carries the claim, where it can sit, how likely it is beforehand, what it is confused
with and which test would separate it. Adding a class means adding a row (and, for a new kind of law, one Term).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Term

Array = NDArray[np.float64]
Kind = Literal["none", "force", "drift", "attachment", "input", "channel", "output", "incoherent", "other"]


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
    free : tuple of {"log", "linear", "fixed"}
        How each parameter moves in the joint estimation.
    scaled : tuple of int
        Parameters that are multiplied when the force is multiplied (forces and stiffnesses).
    signed : bool
        Whether the factor may be negative.
    excess : bool
        Leave out the spring at rest, which the linear model has.
    """

    term: Term
    shapes: Callable[[Size], Array]
    free: tuple[str, ...]
    scaled: tuple[int, ...]
    signed: bool = False
    excess: bool = False


@final
@dataclass(frozen=True)
class Row:
    """One class of the catalogue.

    Parameters
    ----------
    name : str
        Class in the vocabulary of a diagnosis.
    kind : str
        How it enters: a force at a place, a stiffness that drifts there, a linear attachment, the input chain, a sensor channel, a
        distortion of a channel, an incoherent disturbance.
    claim : str
        In words, ``{place}`` filled in.
    sits : str
        ``joints``, ``points``, ``sensors``, ``force``, ``base``, ``any`` or ``-``.
    prior : float
        Relative weight of the class before the data.
    phase : str
        displacement, velocity, memory, acceleration, input or channel.
    confused : tuple of str
    test : str
        What would separate it from those.
    laws : tuple of Law
    """

    name: str
    kind: Kind
    claim: str
    sits: str
    prior: float
    phase: str
    confused: tuple[str, ...]
    test: str
    laws: tuple[Law, ...] = ()
    preferred: str = ""


def _grid(*axes: Array) -> Array:
    mesh = np.meshgrid(*axes, indexing="ij")
    return np.stack([m.ravel() for m in mesh], axis=-1)


POWER_SPRING = Term("power_spring", "f*sign(q)*(abs(q)/d)**n",
                    (Param("f", "N", "force", meaning="force at d"), Param("d", "m", "displacement", meaning="reference, fixed"),
                     Param("n", "", "range", 1.2, 9.0, "exponent")),
                    lambda q, v, f, d, n: f * np.sign(q) * (np.abs(q) / d) ** n,
                    lambda q, v, f, d, n: (f * n / d * (np.abs(q) / d) ** (n - 1), 0 * q), linear=False,
                    meaning="spring that stiffens like a power of displacement")

SATURATING = Term("saturating_spring", "-k*q*(abs(q)/d)**m/(1 + (abs(q)/d)**m)",
                  (Param("k", "N/m", "stiffness", meaning="stiffness lost at large motion"),
                   Param("d", "m", "displacement", meaning="motion at which half of it is lost"),
                   Param("m", "", "range", 0.5, 4.0, "sharpness")),
                  lambda q, v, k, d, m: -k * q * (np.abs(q) / d) ** m / (1 + (np.abs(q) / d) ** m),
                  lambda q, v, k, d, m: (-k * (np.abs(q) / d) ** m * (1 + m + (np.abs(q) / d) ** m) / (1 + (np.abs(q) / d) ** m) ** 2,
                                         0 * q),
                  meaning="spring that softens with displacement and returns on the same line")

ONE_SIDED = Term("one_sided_spring", "k*where(q > e, q - e, 0)",
                 (Param("k", "N/m", "coefficient", meaning="stiffness on one side"),
                  Param("e", "m", "range", -1.0, 1.0, "where it begins")),
                 lambda q, v, k, e: k * np.where(q > e, q - e, 0.0),
                 lambda q, v, k, e: (k * np.where(q > e, 1.0, 0.0), 0 * q), parity="none",
                 meaning="stiffness that differs between opening and closing")

FRICTION = Term("rounded_friction", "f*tanh(v/w)",
                (Param("f", "N", "force", meaning="sliding force"), Param("w", "m/s", "velocity", meaning="velocity of rounding")),
                lambda q, v, f, w: f * np.tanh(v / w),
                lambda q, v, f, w: (0 * q, f / w / np.cosh(np.clip(v / w, -300, 300)) ** 2), dissipative=True,
                meaning="dry friction, rounded at rest")

POWER_DAMPER = Term("power_damper", "f*sign(v)*(abs(v)/w)**n",
                    (Param("f", "N", "force", meaning="force at w"), Param("w", "m/s", "velocity", meaning="reference, fixed"),
                     Param("n", "", "range", 1.2, 4.0, "exponent")),
                    lambda q, v, f, w, n: f * np.sign(v) * (np.abs(v) / w) ** n,
                    lambda q, v, f, w, n: (0 * q, f * n / w * (np.abs(v) / w) ** (n - 1)), dissipative=True,
                    meaning="damping that grows with velocity")

_HARDENING = Law(POWER_SPRING, lambda z: _grid(np.array([1.0]), np.array([z.displacement]), np.array([2.0, 3.0, 4.0, 5.0])),
                 ("log", "fixed", "log"), (0,))
_SOFTENING = Law(SATURATING, lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.5, 1.0, 2.0, 5.0]), np.array([1.0, 2.0])),
                 ("log", "log", "log"), (0,))
_CLEARANCE = Law(LIBRARY["clearance"], lambda z: _grid(np.array([1.0]), z.displacement * np.array([0.5, 1.2, 2.0, 3.0, 4.0, 5.0, 6.0])),
                 ("log", "log"), (0,))
_ASYMMETRIC = Law(ONE_SIDED, lambda z: _grid(np.array([1.0]), z.displacement * np.array([-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0])),
                  ("linear", "linear"), (0,), signed=True)
_COULOMB = Law(FRICTION, lambda z: _grid(np.array([1.0]), z.velocity * np.array([0.003, 0.02, 0.1, 0.3, 1.0])), ("log", "log"), (0,))
_QUADRATIC = Law(POWER_DAMPER, lambda z: _grid(np.array([1.0]), np.array([z.velocity]), np.array([1.6, 2.0, 2.5, 3.0])),
                 ("log", "fixed", "log"), (0,))
# force and stiffness of an Iwan element scale together; the ratio f_s/k_t sets where it slips
_IWAN = Law(LIBRARY["iwan4_memory"],
            lambda z: _grid(z.displacement * np.array([0.15, 0.4, 1.0, 2.5, 6.0]), np.array([1.0]), np.array([-0.5, 0.5]), np.array([0.3])),
            ("log", "log", "linear", "log"), (0, 1), excess=True)
_JENKINS = Law(LIBRARY["jenkins_memory"], lambda z: _grid(z.displacement * np.array([0.15, 0.4, 1.0, 1.8, 2.6]), np.array([1.0])),
               ("log", "log"), (0, 1), excess=True)

CATALOGUE: tuple[Row, ...] = (
    Row("none", "none", "nothing is missing: the nominal model within its tolerances explains the recordings", "-", 6.0, "-", (),
        "more periods and a higher level would lower the smallest effect that can be seen"),
    Row("hardening", "force", "a spring at {place} stiffens with amplitude", "joints", 1.0, "displacement", ("clearance", "asymmetric"),
        "one more level: the onset of a gap is sharp, that of a hardening spring smooth", (_HARDENING,)),
    Row("softening", "force", "a spring at {place} softens with amplitude and returns on the same line", "joints", 1.0, "displacement",
        ("hysteresis", "stiffness_drift"), "a slow reversal test: loss per cycle of a pure spring is zero", (_SOFTENING,)),
    Row("clearance", "force", "a gap at {place} closes above a certain motion", "joints", 1.0, "displacement", ("hardening", "clipping"),
        "a slow sine at large level: contact begins at one displacement", (_CLEARANCE,)),
    Row("asymmetric", "force", "stiffness at {place} differs between the two directions (preload, one-sided contact)", "joints", 1.0,
        "displacement", ("clearance", "hardening"), "a change of static preload moves the even distortion", (_ASYMMETRIC,), "_open"),
    Row("coulomb", "force", "dry friction at {place}", "joints", 1.0, "velocity", ("hysteresis", "quad_damping"),
        "a very low level, where dry friction sticks", (_COULOMB,)),
    Row("quad_damping", "force", "damping at {place} grows with amplitude", "joints", 1.0, "velocity", ("hysteresis", "coulomb"),
        "two levels a factor of ten apart: loss factor rises with velocity, falls for friction", (_QUADRATIC,)),
    Row("hysteresis", "force", "friction with memory (micro-slip loops) at {place}", "joints", 1.0, "memory", ("softening", "quad_damping"),
        "a slow reversal test: loops follow reversal curves and loss grows with a power of amplitude", (_IWAN, _JENKINS)),
    Row("stiffness_drift", "drift", "stiffness at {place} changes over the test day", "joints", 1.0, "displacement",
        ("softening", "hysteresis"), "a repeat of the low level at the end of the day"),
    Row("linear_stiffness", "attachment", "linear stiffness at {place} lies outside its tolerance", "joints", 1.0, "displacement",
        ("other", "added_mass"), "a local drive-point measurement at the joint"),
    Row("added_mass", "attachment", "mass is missing at {place}", "points", 1.0, "acceleration", ("unmodelled_mode", "sensor_gain"),
        "a second known mass there, or weighing"),
    Row("unmodelled_mode", "attachment", "an attachment that resonates at {place} is not in the model", "points", 1.0, "displacement",
        ("added_mass", "linear_stiffness"), "touch it: its notch disappears; or a sensor on it"),
    Row("force_gain", "input", "the force cell reads wrong by a factor", "force", 1.0, "input", ("added_mass",),
        "weigh the structure, or calibrate the force cell on a known mass"),
    Row("force_delay", "input", "the force channel is delayed", "force", 1.0, "input", ("sensor_delay",),
        "a calibration mass: its phase must be zero"),
    Row("sensor_gain", "channel", "the gain of channel {place} is wrong", "sensors", 1.0, "channel", ("added_mass", "sensor_delay"),
        "swap two channels: a wrong gain moves with its cable"),
    Row("sensor_delay", "channel", "channel {place} is delayed", "sensors", 1.0, "channel", ("sensor_gain",),
        "swap two channels: a delay moves with its channel"),
    Row("sensor_drift", "incoherent", "channel {place} wanders at low frequency", "sensors", 1.0, "channel", ("clipping", "mains_hum"),
        "a long record with the shaker off"),
    Row("clipping", "output", "channel {place} is clipped", "sensors", 1.0, "channel", ("clearance", "sensor_drift"), "raise its range"),
    Row("mains_hum", "incoherent", "mains hum on {place}", "sensors", 1.0, "channel", ("asymmetric",),
        "a record with the amplifier on and the shaker at rest"),
    Row("base_motion", "incoherent", "the floor moves", "base", 1.0, "input", ("other",), "an accelerometer on the floor"),
    Row("other", "other", "something outside the catalogue acts at {place}", "any", 2.0, "-", (),
        "the latent force plotted against motion at the place shows what kind it is"),
)

ROWS: dict[str, Row] = {row.name: row for row in CATALOGUE}


def catalogue_rows() -> list[dict[str, str]]:
    """The catalogue as a table, all cells text: class, claim, where it sits, phase, confused with, what separates it."""
    return [{"class": r.name, "claim": r.claim.format(place="a place"), "sits": r.sits, "phase": r.phase,
             "confused with": ", ".join(r.confused), "separated by": r.test,
             "laws": ", ".join(law.term.name for law in r.laws)} for r in CATALOGUE]
