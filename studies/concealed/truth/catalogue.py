"""What can be missing from the nominal model, and the formulas the truth uses for it.

Every class has several formulas; their names and parameters go into the answer.  Lengths and speeds are drawn relative to the motion
the linear structure shows at the place under the highest level, so that an effect is neither absent nor absurd.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

CLASSES = (
    "none",
    "hardening",
    "softening",
    "clearance",
    "asymmetric",
    "coulomb",
    "quad_damping",
    "hysteresis",
    "stiffness_drift",
    "linear_stiffness",
    "added_mass",
    "unmodelled_mode",
    "force_gain",
    "force_delay",
    "sensor_gain",
    "sensor_delay",
    "sensor_drift",
    "clipping",
    "mains_hum",
    "base_motion",
    "other",
)
NONLINEAR = ("hardening", "softening", "clearance", "asymmetric", "coulomb", "quad_damping", "hysteresis", "stiffness_drift")
LINEAR = ("linear_stiffness", "added_mass", "unmodelled_mode")
INPUT = ("force_gain", "force_delay")
SENSOR = ("sensor_gain", "sensor_delay", "sensor_drift", "clipping")
AMBIENT = ("mains_hum", "base_motion")
MAY_BE_RARE = ("hardening", "clearance", "softening", "hysteresis", "clipping")
OTHER_KINDS = ("parametric", "relaxation", "telegraph", "crosstalk", "cell_curvature", "dropouts")


def group(cls: str) -> str:
    """Class group for tables: nonlinear, linear, input, sensor, ambient, other, none."""
    for name, members in (("nonlinear", NONLINEAR), ("linear", LINEAR), ("input", INPUT), ("sensor", SENSOR), ("ambient", AMBIENT)):
        if cls in members:
            return name
    return cls


@dataclass(frozen=True)
class Formula:
    """A law with one free knob.

    ``build(knob) -> (8,)`` parameters; ``start`` and ``limits`` of the knob; ``rising``: does the effect grow with the knob.
    """

    name: str
    kind: int
    build: Callable[[float], tuple[float, ...]]
    start: float
    limits: tuple[float, float]
    rising: bool


@dataclass(frozen=True)
class Place:
    """Linear motion at a place at the highest level: rms ``d`` m, ``v`` m/s; own spring ``k_own`` and static stiffness ``k_static`` N/m."""

    name: str
    d: float
    v: float
    k_own: float
    k_static: float


def places_for(cls: str, joints: list[str], own: dict[str, float], kind: str = "") -> list[str]:
    """Joint names where ``cls`` can sit; softening, memory and drift need a spring they can take stiffness from."""
    slip = [j for j in joints if j.endswith("_slip")]
    opening = [j for j in joints if j.endswith("_open")]
    ends = ["ROOT_rot", "TIP_w"]
    sprung = [e for e in ends if own.get(e, 0.0) > 0.0]
    if cls == "hardening":
        return [*opening, *slip, *ends]
    if cls in ("clearance", "asymmetric"):
        return [*opening, *ends]
    if cls in ("softening", "hysteresis"):
        return [*slip, *opening, *sprung] if cls == "softening" else [*slip, *sprung]
    if cls in ("coulomb", "quad_damping"):
        return [*slip, *opening, *ends] if cls == "quad_damping" else [*slip, *ends]
    if cls in ("stiffness_drift", "linear_stiffness") or kind in ("parametric", "telegraph"):
        return [*slip, *opening, *sprung]
    return [*slip, *opening, *sprung]


def _p(*values: float) -> tuple[float, ...]:
    return tuple(float(v) for v in (*values, *([0.0] * (8 - len(values)))))


def draw_formula(cls: str, rng: np.random.Generator, at: Place, rare: bool, kind: str = "") -> Formula:
    """Draw one formula of ``cls`` for a place."""
    length = at.d * (rng.uniform(2.2, 3.2) if rare else rng.uniform(0.8, 2.0))
    k = at.k_static
    if cls in ("hardening", "clearance", "asymmetric"):
        return _stiffening(cls, rng, at, length, rare)
    if cls == "softening":
        name, number = _pick(rng, ("root_loss", 10), ("arctangent_loss", 11), ("exponential_loss", 12), ("log_loss", 13))
        share = rng.uniform(0.4, 0.85) * at.k_own
        return Formula(name, number, lambda x: _p(share, x), length, (at.d * (1.2 if rare else 0.2), at.d * 1e3), False)
    if cls == "coulomb":
        name, number = _pick(rng, ("arctangent", 30), ("falling", 31), ("error_function", 32), ("rational", 33))
        vs, drop, far = at.v * rng.uniform(0.03, 0.15), rng.uniform(0.15, 0.45), rng.uniform(4.0, 12.0)
        return Formula(name, number, lambda x: _p(x, vs, drop, far), 0.05 * k * at.d, (0.0, 50 * k * at.d), True)
    if cls == "quad_damping":
        name, number = _pick(rng, ("power", 40), ("root", 41), ("late", 42))
        power = rng.choice([rng.uniform(1.7, 1.9), rng.uniform(2.1, 2.4)])
        vs, late = at.v, rng.uniform(0.2, 0.6)
        return Formula(
            name, number, lambda x: _p(x, vs, power if number == 40 else late), 0.05 * k * at.d / at.v, (0.0, 50 * k * at.d / at.v), True
        )
    if cls == "hysteresis":
        name, number = _pick(rng, ("graded_sliders", 50), ("fractional_friction", 51), ("skewed_hysteron", 52), ("intrinsic_time", 53))
        share = rng.uniform(0.4, 0.85) * at.k_own
        shape = {50: rng.uniform(-0.4, 0.6), 51: rng.uniform(1.3, 1.8), 52: rng.uniform(1.2, 1.9), 53: rng.uniform(0.3, 0.8)}[number]
        skew = rng.uniform(0.55, 0.8)
        return Formula(
            name, number, lambda x: _p(share, x, shape, skew, 0, 0, 0, 1.0), length, (at.d * (1.0 if rare else 0.15), at.d * 1e3), False
        )
    if cls == "stiffness_drift":
        name = str(rng.choice(["relaxing", "linear_loss", "step", "warming"]))
        return Formula(name, 0, lambda x: _p(-x), 0.1 * at.k_own, (0.0, 0.85 * at.k_own), True)
    if kind in ("parametric", "telegraph"):
        return Formula(kind, 0, lambda x: _p(x), 0.1 * at.k_own, (0.0, 0.85 * at.k_own), True)
    fast, slow, mix = 10 ** rng.uniform(-3.6, -3.0), 10 ** rng.uniform(-2.6, -1.9), rng.uniform(0.35, 0.65)
    return Formula("two_branch_relaxation", 60, lambda x: _p(x, fast, slow, mix, 1 - mix), 0.1 * k, (0.0, 30 * k), True)


def _pick(rng: np.random.Generator, *options: tuple[str, int]) -> tuple[str, int]:
    return options[int(rng.integers(len(options)))]


def _stiffening(cls: str, rng: np.random.Generator, at: Place, length: float, rare: bool) -> Formula:
    k = at.k_static
    if cls == "hardening":
        name, number = _pick(rng, ("sinh", 1), ("saturating", 2), ("power", 3), ("log", 4))
        power = rng.uniform(3.3, 4.6) if rare else rng.choice([rng.uniform(2.2, 2.8), rng.uniform(3.2, 3.8)])
        x0 = length if number != 1 else max(length, at.d)
        return Formula(name, number, lambda x: _p(x, x0, power), 0.1 * k, (0.0, 200 * k), True)
    if cls == "clearance":
        name, number = _pick(rng, ("rounded_two_sided", 20), ("round_bodies", 27), ("unequal_stops", 22), ("stops_with_loss", 28))
        gap = max(length, at.d)
        second = {20: rng.uniform(0.02, 0.08), 27: 0.0, 22: rng.uniform(1.1, 1.6), 28: rng.uniform(0.1, 0.4) / at.v}[number]
        ratio = rng.uniform(0.5, 1.4)
        return Formula(name, number, lambda x: _p(x, gap, second, ratio), k, (0.0, 300 * k), True)
    # contact on one side only differs between the two directions, whatever the gap: a gap that closes has two faces
    name, number = _pick(rng, ("rounded_bilinear", 24), ("closing_asperities", 25), ("even_saturating", 26), ("round_body", 21),
                         ("stop_with_loss", 23))
    width = at.d * (rng.uniform(0.1, 0.4) if number == 24 else rng.uniform(1.5, 3.0))
    offset = at.d * rng.uniform(-0.6, 0.6)
    if number in (21, 23):
        width, offset = at.d * rng.uniform(0.2, 1.6), rng.uniform(0.1, 0.4) / at.v
    return Formula(name, number, lambda x: _p(x, width, offset), 0.1 * k, (0.0, (20 if number in (24, 25, 26) else 300) * k), True)
