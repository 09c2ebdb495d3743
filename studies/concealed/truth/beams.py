"""Plane lapped beams in finite elements: the structure of a case, once as truth and once as the nominal model claims it.

Degrees of freedom per node are axial ``u``, transverse ``w`` and rotation ``theta`` (``theta = w'``; a point at height ``z`` moves
axially by ``u - z theta``).  Two element kinds exist so that truth and nominal need not share a beam theory: Euler-Bernoulli and
Timoshenko (Przemieniecki's shear-flexible element), each with consistent or lumped mass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

SHEAR_FACTOR = 5.0 / 6.0
POISSON = 0.3


@dataclass(frozen=True)
class Beam:
    """One straight beam: start ``x0`` m, ``length`` m, height profile as steps ``(x from, height)`` m."""

    name: str
    x0: float
    length: float
    heights: tuple[tuple[float, float], ...]
    E: float
    rho: float

    @property
    def x1(self) -> float:
        return self.x0 + self.length

    def height(self, x: float) -> float:
        """Height (m) of the section at ``x`` (m)."""
        return [h for start, h in self.heights if x >= start - 1e-9][-1]


@dataclass(frozen=True)
class Joint:
    """A bolt at ``x`` between beams ``lower`` and ``lower + 1``; stiffnesses in N/m."""

    x: float
    lower: int
    k_slip: float
    k_open: float
    c_slip: float = 0.0


@dataclass(frozen=True)
class Point:
    """A named place on a beam: sensor, shaker or mass point."""

    beam: int
    x: float


@dataclass(frozen=True)
class Layout:
    """Everything that defines one structure; SI units."""

    beams: tuple[Beam, ...]
    width: float
    joints: tuple[Joint, ...]
    root_fix: float
    root_rot: float
    tip_w: float
    tip_mass: float
    sensors: tuple[Point, ...]
    shaker: Point
    sensor_mass: float
    support: str = "clamped_free"


@dataclass(frozen=True)
class Mesh:
    """Element choice: ``size`` m, ``theory`` 'euler' or 'timoshenko', ``mass`` 'consistent' or 'lumped'."""

    size: float
    theory: str
    mass: str


@dataclass(frozen=True)
class Assembled:
    """Matrices of one layout on one mesh.

    ``M`` (N, N) kg, ``K`` (N, N) N/m, their named parts, and named vectors (N,): sensors ``S<i>``, mass points ``P<i>``, ``SHAKER``,
    ``BASE`` (rigid transverse motion) and joint directions.
    """

    M: np.ndarray
    K: np.ndarray
    K_parts: Mapping[str, np.ndarray]
    M_parts: Mapping[str, np.ndarray]
    vectors: Mapping[str, np.ndarray]
    joint_names: tuple[str, ...]
    dashpots: Mapping[str, float] = field(default_factory=dict)


def element(length: float, E: float, rho: float, width: float, height: float, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass (6, 6) of one beam element, order ``u1 w1 t1 u2 w2 t2`` (Przemieniecki 1968, with shear)."""
    area, inertia, L = width * height, width * height**3 / 12.0, length
    G = E / (2.0 * (1.0 + POISSON))
    shear = 12.0 * E * inertia / (SHEAR_FACTOR * G * area * L**2) if mesh.theory == "timoshenko" else 0.0
    k = np.zeros((6, 6))
    k[np.ix_([0, 3], [0, 3])] = E * area / L * np.array([[1.0, -1.0], [-1.0, 1.0]])
    b = [1, 2, 4, 5]
    k[np.ix_(b, b)] = (
        E
        * inertia
        / (L**3 * (1.0 + shear))
        * np.array(
            [
                [12.0, 6 * L, -12.0, 6 * L],
                [6 * L, (4 + shear) * L**2, -6 * L, (2 - shear) * L**2],
                [-12.0, -6 * L, 12.0, -6 * L],
                [6 * L, (2 - shear) * L**2, -6 * L, (4 + shear) * L**2],
            ]
        )
    )
    m = np.zeros((6, 6))
    mass = rho * area * L
    if mesh.mass == "lumped":
        m[[0, 1, 3, 4], [0, 1, 3, 4]] = mass / 2.0
        m[[2, 5], [2, 5]] = rho * inertia * L / 2.0 + mass * L**2 / 420.0
        return k, m
    m[np.ix_([0, 3], [0, 3])] = mass / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    m[np.ix_(b, b)] = _bending_mass(mass, rho * inertia, L, shear)
    return k, m


def _bending_mass(mass: float, rho_i: float, L: float, s: float) -> np.ndarray:
    """Consistent bending mass with rotary inertia for shear ratio ``s`` (zero gives Euler-Bernoulli with rotary inertia)."""
    d = (1.0 + s) ** 2
    a = np.array(
        [
            13 / 35 + 7 * s / 10 + s**2 / 3,
            (11 / 210 + 11 * s / 120 + s**2 / 24) * L,
            9 / 70 + 3 * s / 10 + s**2 / 6,
            -(13 / 420 + 3 * s / 40 + s**2 / 24) * L,
            (1 / 105 + s / 60 + s**2 / 120) * L**2,
            -(1 / 140 + s / 60 + s**2 / 120) * L**2,
        ]
    )
    t = np.array([[a[0], a[1], a[2], a[3]], [a[1], a[4], -a[3], a[5]], [a[2], -a[3], a[0], -a[1]], [a[3], a[5], -a[1], a[4]]])
    r = np.array([6 / 5, (1 / 10 - s / 2) * L, (2 / 15 + s / 6 + s**2 / 3) * L**2, (-1 / 30 - s / 6 + s**2 / 6) * L**2])
    q = np.array([[r[0], r[1], -r[0], r[1]], [r[1], r[2], -r[1], r[3]], [-r[0], -r[1], r[0], -r[1]], [r[1], r[3], -r[1], r[2]]])
    return mass / d * t + rho_i / (d * L) * q


def _nodes(layout: Layout, index: int, size: float) -> np.ndarray:
    """Node positions of one beam: every place that carries something is a node, the rest is divided evenly."""
    beam = layout.beams[index]
    fixed = {beam.x0, beam.x1}
    fixed |= {x for x, _ in beam.heights if beam.x0 < x < beam.x1}
    fixed |= {j.x for j in layout.joints if index in (j.lower, j.lower + 1)}
    keys = sorted(fixed)
    for x in sorted(p.x for p in (*layout.sensors, layout.shaker) if p.beam == index):
        # Elements of a hair's length would spoil the arithmetic: such a point uses the node that is there.
        if min(abs(x - k) for k in keys) > 4e-4:
            keys.append(x)
    ordered = np.array(sorted(keys))
    pieces = [np.linspace(a, b, max(1, int(np.ceil((b - a) / size))) + 1)[:-1] for a, b in zip(ordered[:-1], ordered[1:], strict=True)]
    return np.concatenate([*pieces, ordered[-1:]])


def assemble(layout: Layout, mesh: Mesh) -> Assembled:
    """Matrices, parts and named vectors of ``layout`` on ``mesh``."""
    nodes = [_nodes(layout, i, mesh.size) for i in range(len(layout.beams))]
    starts = np.cumsum([0, *[3 * n.size for n in nodes]])
    N = int(starts[-1])

    def dof(beam: int, x: float, which: int) -> int:
        return int(starts[beam]) + 3 * int(np.argmin(np.abs(nodes[beam] - x))) + which

    K_parts: dict[str, np.ndarray] = {}
    M_parts: dict[str, np.ndarray] = {}
    for i, beam in enumerate(layout.beams):
        K, M = np.zeros((N, N)), np.zeros((N, N))
        for e, (a, b) in enumerate(zip(nodes[i][:-1], nodes[i][1:], strict=True)):
            k, m = element(b - a, beam.E, beam.rho, layout.width, beam.height((a + b) / 2), mesh)
            where = slice(int(starts[i]) + 3 * e, int(starts[i]) + 3 * e + 6)
            K[where, where] += k
            M[where, where] += m
        K_parts[f"E_{beam.name}"], M_parts[f"rho_{beam.name}"] = K, M
    vectors, names, dashpots = _joint_vectors(layout, dof, N)
    for joint, (slip, opening) in zip(layout.joints, zip(names[:-2:2], names[1:-2:2], strict=True), strict=True):
        K_parts[slip] = joint.k_slip * np.outer(vectors[slip], vectors[slip])
        K_parts[opening] = joint.k_open * np.outer(vectors[opening], vectors[opening])
    for name, k in (("ROOT_rot", layout.root_rot), ("TIP_w", layout.tip_w)):
        if k > 0.0:
            K_parts[name] = k * np.outer(vectors[name], vectors[name])
    fix = np.zeros((N, N))
    for which in (0, 1):
        fix[dof(0, layout.beams[0].x0, which), dof(0, layout.beams[0].x0, which)] = layout.root_fix
    K_parts["root_fix"] = fix
    attached = np.zeros(N)
    for p in layout.sensors:
        attached[[dof(p.beam, p.x, 0), dof(p.beam, p.x, 1)]] += layout.sensor_mass
    last = len(layout.beams) - 1
    attached[[dof(last, layout.beams[last].x1, 0), dof(last, layout.beams[last].x1, 1)]] += layout.tip_mass
    M = np.sum(list(M_parts.values()), axis=0) + np.diag(attached)
    K = np.sum(list(K_parts.values()), axis=0)
    return Assembled(M, K, K_parts, M_parts, vectors, tuple(names), dashpots)


def _joint_vectors(layout: Layout, dof, N: int):
    """Named vectors (N,) of joints, supports, sensors, mass points, shaker and base; joint names in order; dashpots N s/m."""
    vectors: dict[str, np.ndarray] = {}
    dashpots: dict[str, float] = {}
    names: list[str] = []
    for i, joint in enumerate(layout.joints, start=1):
        lo, up = joint.lower, joint.lower + 1
        slip, opening = np.zeros(N), np.zeros(N)
        slip[dof(up, joint.x, 0)], slip[dof(up, joint.x, 2)] = 1.0, layout.beams[up].height(joint.x) / 2
        slip[dof(lo, joint.x, 0)], slip[dof(lo, joint.x, 2)] = -1.0, layout.beams[lo].height(joint.x) / 2
        opening[dof(up, joint.x, 1)], opening[dof(lo, joint.x, 1)] = 1.0, -1.0
        vectors[f"J{i}_slip"], vectors[f"J{i}_open"] = slip, opening
        names += [f"J{i}_slip", f"J{i}_open"]
        dashpots[f"J{i}_slip"] = joint.c_slip
    last = len(layout.beams) - 1
    vectors["ROOT_rot"] = _unit(N, dof(0, layout.beams[0].x0, 2))
    vectors["TIP_w"] = _unit(N, dof(last, layout.beams[last].x1, 1))
    names += ["ROOT_rot", "TIP_w"]
    for i, p in enumerate(layout.sensors, start=1):
        vectors[f"S{i}"] = vectors[f"P{i}"] = _unit(N, dof(p.beam, p.x, 1))
    vectors["SHAKER"] = _unit(N, dof(layout.shaker.beam, layout.shaker.x, 1))
    base = np.zeros(N)
    base[1::3] = 1.0
    vectors["BASE"] = base
    return vectors, names, dashpots


def _unit(N: int, index: int) -> np.ndarray:
    out = np.zeros(N)
    out[index] = 1.0
    return out
