"""Random structures: what the engineer's model says (nominal) and what stands in the laboratory (truth)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .beams import Beam, Joint, Layout, Mesh, Point


@dataclass(frozen=True)
class Tolerances:
    """One standard deviation of what the engineer is unsure of; written to case.json under the same names."""

    E_rel_sd: float
    rho_rel_sd: float
    joint_stiffness_log_sd: float
    root_fix_log_sd: float
    damping_rel_sd: float


TIGHT = Tolerances(0.02, 0.008, 0.12, 0.5, 0.2)
LOOSE = Tolerances(0.05, 0.008, 0.35, 0.5, 0.2)


@dataclass(frozen=True)
class Scenery:
    """Nominal and true structure of one case, with how they differ."""

    nominal: Layout
    truth: Layout
    nominal_mesh: Mesh
    truth_mesh: Mesh
    factors: dict[str, float]
    damping: Callable[[np.ndarray], np.ndarray]
    damping_ratio: float
    tolerances: Tolerances


def draw_layout(rng: np.random.Generator, sensors: int, hide_joints: bool) -> Layout:
    """A random chain of two or three lapped, possibly stepped beams with a random support."""
    three = rng.random() < 0.25
    E, rho = [(70e9, 2700.0), (205e9, 7850.0), (112e9, 4430.0)][int(rng.choice(3, p=[0.4, 0.45, 0.15]))]
    lengths = rng.uniform(0.24, 0.36, 3) if three else rng.uniform(0.34, 0.52, 2)
    laps = rng.uniform(0.07, 0.11, 2) if three else rng.uniform(0.12, 0.20, 1)
    # All places lie on a millimetre grid, in the truth give or take a jig's error.
    lengths, laps = np.round(lengths, 3), np.round(laps, 3)
    beams, x = [], 0.0
    stepped = int(rng.integers(len(lengths))) if rng.random() < 0.5 else -1
    for i, length in enumerate(lengths):
        height = round(rng.uniform(0.006, 0.0095), 4)
        heights = ((x, height),)
        if i == stepped:
            # The step stays outside the laps.
            free = (x + (laps[i - 1] if i else 0.0), x + length - (laps[i] if i < len(laps) else 0.0))
            at = round(free[0] + (free[1] - free[0]) * rng.uniform(0.3, 0.7), 3)
            heights = ((x, height), (at, round(height * rng.uniform(0.75, 1.25), 4)))
        beams.append(Beam("ABC"[i], x, float(length), heights, E * (1 + 0.01 * rng.standard_normal()), rho))
        x = round(float(x + length - (laps[i] if i < len(laps) else 0.0)), 3)
    joints = []
    for i, lap in enumerate(laps):
        count = 2 if three else int(rng.integers(2, 5))
        start = beams[i].x1 - lap
        for fraction in (np.arange(count) + 0.5) / count:
            at = start + lap * (fraction + rng.uniform(-0.06, 0.06))
            joints.append(Joint(round(float(at), 3), i, 10 ** rng.uniform(6.1, 6.9), 10 ** rng.uniform(6.3, 7.1)))
    support = str(rng.choice(["clamped_free", "clamped_sprung", "hinged", "suspended"], p=[0.45, 0.25, 0.15, 0.15]))
    root_fix, root_rot, tip_w = {
        "clamped_free": (10 ** rng.uniform(8, 9), 10 ** rng.uniform(3.9, 4.7), 0.0),
        "clamped_sprung": (10 ** rng.uniform(8, 9), 10 ** rng.uniform(3.9, 4.7), 10 ** rng.uniform(4.0, 5.0)),
        "hinged": (10 ** rng.uniform(8, 9), 10 ** rng.uniform(2.3, 3.0), 10 ** rng.uniform(4.5, 5.5)),
        "suspended": (10 ** rng.uniform(3.2, 3.6), 10 ** rng.uniform(0.3, 1.0), 10 ** rng.uniform(3.0, 3.4)),
    }[support]
    end = beams[-1].x1
    places = _sensor_places(rng, beams, laps, sensors, end, hide_joints)
    shaker = _on_beam(beams, end * rng.uniform(0.12, 0.88), rng)
    return Layout(
        tuple(beams),
        round(rng.uniform(0.03, 0.05), 4),
        tuple(joints),
        root_fix,
        root_rot,
        tip_w,
        round(rng.uniform(0.03, 0.25), 3) if rng.random() < 0.4 else 0.0,
        places,
        shaker,
        0.003,
        support,
    )


def _on_beam(beams: list[Beam], x: float, rng: np.random.Generator) -> Point:
    inside = [i for i, b in enumerate(beams) if b.x0 + 0.004 <= x <= b.x1 - 0.004]
    if not inside:
        inside = [int(np.argmin([min(abs(b.x0 - x), abs(b.x1 - x)) for b in beams]))]
    return Point(int(rng.choice(inside)), round(float(x), 3))


def _sensor_places(rng: np.random.Generator, beams: list[Beam], laps: np.ndarray, count: int, end: float, hide: bool) -> tuple[Point, ...]:
    """Sensors spread over the length; with ``hide`` none sits on a lap."""
    zones = [(beams[i].x1 - lap - 0.015, beams[i].x1 + 0.015) for i, lap in enumerate(laps)]
    points: list[Point] = []
    edges = np.linspace(0.03, end - 0.004, count + 1)
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        for _ in range(40):
            x = float(rng.uniform(low, high) if not hide else rng.uniform(0.03, end - 0.004))
            clear = all(abs(x - p.x) > 0.012 for p in points)
            if clear and not (hide and any(a < x < b for a, b in zones)):
                break
        points.append(_on_beam(beams, x, rng))
    return tuple(sorted(points, key=lambda p: p.x))


def draw_scenery(rng: np.random.Generator, sensors: int, hide_joints: bool, loose: bool) -> Scenery:
    """Nominal layout, and a truth whose parameters are drawn from the stated tolerances and whose beam theory and mesh differ."""
    nominal = draw_layout(rng, sensors, hide_joints)
    tolerance = LOOSE if loose else TIGHT
    # How far the truth lies outside the nominal model's family: from hardly visible to a few parts in a thousand of the response.
    mess = 10 ** rng.uniform(-1.2, 0.0)
    factors: dict[str, float] = {}

    def drawn(name: str, sd: float) -> float:
        factors[name] = float(np.exp(sd * rng.standard_normal()))
        return factors[name]

    beams = tuple(
        replace(b, E=b.E * drawn(f"E_{b.name}", tolerance.E_rel_sd), rho=b.rho * drawn(f"rho_{b.name}", tolerance.rho_rel_sd))
        for b in nominal.beams
    )
    ratio = round(rng.uniform(0.005, 0.013), 4)
    joints = tuple(
        replace(
            j,
            k_slip=j.k_slip * drawn(f"J{i}_slip", tolerance.joint_stiffness_log_sd),
            k_open=j.k_open * drawn(f"J{i}_open", tolerance.joint_stiffness_log_sd),
            c_slip=j.k_slip * 2 * ratio * mess * rng.uniform(0.03, 0.2) / (2 * np.pi * 300.0),
        )
        for i, j in enumerate(nominal.joints, start=1)
    )
    # Positions are known to a few hundredths of a millimetre at worst (a drilled jig).
    sensors_true = tuple(Point(p.beam, p.x + 6e-5 * mess * rng.standard_normal()) for p in nominal.sensors)
    truth = replace(
        nominal,
        beams=beams,
        joints=joints,
        sensors=sensors_true,
        root_rot=nominal.root_rot * drawn("ROOT_rot", tolerance.joint_stiffness_log_sd),
        tip_w=nominal.tip_w * (drawn("TIP_w", tolerance.joint_stiffness_log_sd) if nominal.tip_w > 0 else 1.0),
        root_fix=nominal.root_fix * drawn("root_fix", tolerance.root_fix_log_sd),
    )
    meshes = [
        Mesh(0.009, "timoshenko", "consistent"),
        Mesh(float(rng.uniform(0.012, 0.016)), "euler", str(rng.choice(["consistent", "lumped"]))),
    ]
    if rng.random() < 0.35:
        meshes = [
            Mesh(0.009, "euler", "consistent"),
            Mesh(float(rng.uniform(0.012, 0.016)), "timoshenko", str(rng.choice(["consistent", "lumped"]))),
        ]
    return Scenery(
        nominal, truth, meshes[1], meshes[0], factors, _damping(rng, ratio, tolerance.damping_rel_sd, nominal.support), ratio, tolerance
    )


def _damping(rng: np.random.Generator, ratio: float, sd: float, support: str) -> Callable[[np.ndarray], np.ndarray]:
    """Damping ratio as a smooth random function of frequency with relative scatter ``sd``; suspension modes are damped more."""
    rates, phases = rng.uniform(2.0, 9.0, 6), rng.uniform(0, 2 * np.pi, 6)

    def curve(frequency: np.ndarray) -> np.ndarray:
        wave = np.cos(np.outer(np.log(np.maximum(frequency, 1.0)), rates) + phases).sum(axis=1) / np.sqrt(3.0)
        value = ratio * np.exp(sd * wave)
        return np.where(frequency < 18.0, np.maximum(value, 0.06), value) if support == "suspended" else value

    return curve
