"""Planar Timoshenko beams, plain or with a bolted half-lap joint in the middle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.structure.structure import Structure

End = Literal["free", "pinned", "clamped"]
Side = Literal["left", "right"]
Positions = tuple[tuple[str, float], ...]
_DIRECTIONS = ("u", "w", "rot")


MOST_ELEMENTS = 1000
"""Along the length; matrices are full, so that more would take gigabytes."""
HUGE = 1e30   # of a length, stiffness or density in SI, beyond which it is a slip; powers of it stay within the range of numbers


@final
@dataclass(frozen=True)
class LappedBeam:
    """Two beams that overlap by half their height and are held together by springs at stations, or one plain beam.

    Along x lies the left half from 0 to ``lap[1]`` and the right half from ``lap[0]`` to ``length``; in the lap each has half the height.
    The reference axis is mid-height, which is the lap interface, so both halves refer to the same axis and a joint spring acts on
    differences of their displacements there. The end faces of the halves do not touch.

    Parameters
    ----------
    length, width, height : float
        m; ``height`` is in the direction of bending.
    E, rho : float
        Pa, kg/m³.
    nu : float
        Poisson ratio, gives the shear modulus unless ``G`` (Pa) is stated.
    shear_factor : float or None
        Share of the section that carries shear; None takes Cowper's value for a rectangle, 10(1+ν)/(12+11ν).
    element_size : float
        Longest element, m.
    lap : tuple of float or None
        Start and end of the lap, m; None for a plain beam.
    stations : tuple of float
        Where joint springs act, m from the left end; joints are named J1, J2, ... in this order.
    patch : float
        Length of contact at each station over which the relative motion is averaged, m; 0 for a point.
    tangential, normal, rotation : float, tuple of float or None
        Joint springs, N/m, N/m and N m/rad, one for all or one per station. They become locations ``J1_slip``, ``J1_open``, ``J1_rot``;
        None leaves that direction out altogether.
    bolts : tuple of (float, float)
        Position (m) and mass (kg) of each bolt with nut and washers; half of it sits on either half of the lap.
    masses : tuple of (str, float, float)
        Name, position (m), mass (kg) of further point masses.
    boundary : str
        Left and right end, e.g. ``"clamped-free"``, of free, pinned, clamped; ``"free"`` means both.
    sensors, inputs, points : tuple of (str, float)
        Names and positions (m) of transverse motion; ``points`` have no role.
    side : {"left", "right"}
        To which half a sensor, input or point belongs that lies within the lap.

    Raises
    ------
    ValueError
        If a size is not positive, elements are too many, a position lies off the beam or a station off the lap, or counts disagree.
    """

    length: float
    width: float
    height: float
    E: float
    rho: float
    nu: float = 0.3
    G: float | None = None
    shear_factor: float | None = None
    element_size: float = 0.01
    lap: tuple[float, float] | None = None
    stations: tuple[float, ...] = ()
    patch: float = 0.0
    tangential: float | tuple[float, ...] | None = 1e8
    normal: float | tuple[float, ...] | None = 1e9
    rotation: float | tuple[float, ...] | None = None
    bolts: tuple[tuple[float, float], ...] = ()
    masses: tuple[tuple[str, float, float], ...] = ()
    boundary: str = "free"
    sensors: Positions = ()
    inputs: Positions = ()
    points: Positions = ()
    side: Side = "left"

    def __post_init__(self) -> None:
        for name in ("length", "width", "height", "E", "rho", "element_size"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"lapped beam: {name} must be positive, got {getattr(self, name)}")
            if not 1 / HUGE < getattr(self, name) < HUGE:
                raise ValueError(f"lapped beam: {name} = {getattr(self, name):g} is of no beam; check its unit")
        if self.length > MOST_ELEMENTS * self.element_size:
            raise ValueError(f"lapped beam: elements of {self.element_size:g} m are {self.length / self.element_size:.3g} along it, "
                             f"at most {MOST_ELEMENTS} are possible")
        if not -1 < self.nu < 0.5 or any(x is not None and not 1 / HUGE < x < HUGE for x in (self.G, self.shear_factor)):
            raise ValueError("lapped beam: nu must lie in (-1, 0.5), G and shear_factor must be positive")
        places = [x for _, x in (*self.sensors, *self.inputs, *self.points)] + [x for x, _ in self.bolts] + [x for _, x, _ in self.masses]
        if any(not 0 <= x <= self.length for x in places):
            raise ValueError(f"lapped beam: positions must lie between 0 and {self.length} m, got {sorted(places)}")
        if any(mass < 0 for mass in [m for _, m in self.bolts] + [m for _, _, m in self.masses]):
            raise ValueError("lapped beam: masses must not be negative")
        if self.side not in ("left", "right"):
            raise ValueError(f"lapped beam: side must be 'left' or 'right', got {self.side!r}")
        self.ends  # noqa: B018  (validates)
        self._check_lap()

    def _check_lap(self) -> None:
        if self.lap is None:
            if self.stations:
                raise ValueError("lapped beam: stations need a lap")
            return
        if not 0 < self.lap[0] < self.lap[1] < self.length:
            raise ValueError(f"lapped beam: lap {self.lap} must lie inside the beam of {self.length} m")
        half = self.patch / 2 - 1e-9 * self.length
        if not self.stations or self.patch < 0 or any(not (self.lap[0] <= x - half and x + half <= self.lap[1]) for x in self.stations):
            raise ValueError(f"lapped beam: stations {self.stations} with patches of {self.patch} m must lie within the lap {self.lap}")
        for name in ("tangential", "normal", "rotation"):
            self.springs(name)

    @property
    def ends(self) -> tuple[End, End]:
        """Support of the left and the right end."""
        words = tuple(self.boundary.split("-")) if "-" in self.boundary else (self.boundary, self.boundary)
        if len(words) != 2 or any(word not in ("free", "pinned", "clamped") for word in words):
            raise ValueError(f"lapped beam: boundary must join two of free, pinned, clamped by '-', got {self.boundary!r}")
        return words  # type: ignore[return-value]

    def springs(self, name: str) -> tuple[float, ...] | None:
        """Stiffness of one direction at each station, or None if the direction is left out."""
        value = getattr(self, name)
        if value is None:
            return None
        springs = (float(value),) * len(self.stations) if np.ndim(value) == 0 else tuple(float(v) for v in value)
        if len(springs) != len(self.stations) or any(not 0 <= k < HUGE for k in springs):
            raise ValueError(f"lapped beam: {name} must be one non-negative stiffness or one for each of {len(self.stations)} stations")
        return springs


def lapped_beam(beam: LappedBeam) -> Structure:
    """Finite-element model: 2-node Timoshenko elements with axial motion.

    Exact in statics. For a wave number k and elements of length h the frequency of a plain beam errs by (kh)⁴/1440 as that of an
    Euler-Bernoulli beam, and by (EI k²/κGA)(kh)²/24 where shear matters; a lap adds terms of order (kh)².

    Parts for updating: ``E`` (both moduli together), ``rho``, ``bolts``, each point mass by name, and each joint spring by its location.

    Parameters
    ----------
    beam : LappedBeam

    Returns
    -------
    Structure
        Locations: sensors, inputs, points and masses (transverse, m), joints ``J<i>_slip``, ``J<i>_open`` (right half minus left
        half, m), ``J<i>_rot`` (rad).
    """
    mesh = _Mesh.of(beam)
    K, M = np.zeros((mesh.size, mesh.size)), np.zeros((mesh.size, mesh.size))
    for half in mesh.halves:
        for first, second in half.elements:
            x0, x1 = mesh.x[first], mesh.x[second]
            in_lap = beam.lap is not None and beam.lap[0] <= 0.5 * (x0 + x1) <= beam.lap[1]
            height = beam.height / 2 if in_lap else beam.height
            offset = half.sign * beam.height / 4 if in_lap else 0.0
            k, m = frame_element(x1 - x0, beam.width, height, beam, offset)
            place = [3 * half.nodes[node] + d for node in (first, second) for d in range(3)]
            K[np.ix_(place, place)] += k
            M[np.ix_(place, place)] += m
    M_parts = {"rho": M}
    if beam.bolts:
        M_parts["bolts"] = np.diag(sum((mesh.point_mass(x, mass) for x, mass in beam.bolts), np.zeros(mesh.size)))
    for name, x, mass in beam.masses:
        M_parts[name] = np.diag(mesh.point_mass(x, mass))
    K_parts, locations, joints = {"E": K}, dict(_points(beam, mesh)), []
    for direction, (field, suffix) in enumerate((("tangential", "slip"), ("normal", "open"), ("rotation", "rot"))):
        for j, stiffness in enumerate(beam.springs(field) or ()):
            name = f"J{j + 1}_{suffix}"
            locations[name] = mesh.relative(beam.stations[j], beam.patch, direction)
            joints.append(name)
            K_parts[name] = stiffness * np.outer(locations[name], locations[name])
    keep = mesh.kept(beam.ends)
    cut = np.ix_(keep, keep)
    empty = np.zeros((len(keep), len(keep)))
    K_parts, M_parts = {k: v[cut] for k, v in K_parts.items()}, {k: v[cut] for k, v in M_parts.items()}
    return Structure(
        sum(M_parts.values(), empty), sum(K_parts.values(), empty),
        tuple(mesh.names[i] for i in keep), {name: row[keep] for name, row in locations.items()},
        sensors=tuple(n for n, _ in beam.sensors), inputs=tuple(n for n, _ in beam.inputs), joints=tuple(sorted(joints)),
        K_parts=K_parts, M_parts=M_parts,
        notes=(f"planar Timoshenko beam, {len(keep)} degrees of freedom, longest element {beam.element_size:g} m",))


def _points(beam: LappedBeam, mesh: _Mesh) -> dict[str, NDArray[np.float64]]:
    """Rows of transverse motion at every named position.

    Raises
    ------
    ValueError
        If one name stands for two positions.
    """
    rows: dict[str, NDArray[np.float64]] = {}
    half = 0 if beam.side == "left" or beam.lap is None else 1
    for name, x in (*beam.sensors, *beam.inputs, *beam.points, *((name, x) for name, x, _ in beam.masses)):
        row = mesh.row(mesh.point(x), 1, half)
        if name in rows and not np.array_equal(rows[name], row):
            raise ValueError(f"lapped beam: the name {name!r} stands for two positions")
        rows[name] = row
    return rows


def frame_element(length: float, width: float, height: float, material: LappedBeam,
                  offset: float = 0.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Stiffness and consistent mass (6, 6) of one element in (u, w, θ) of its two nodes.

    Shape functions solve the static Timoshenko equations exactly (Friedman & Kosmatka, Computers & Structures 47 (1993) 473); with
    an eccentric axis the axial displacement is that of the reference axis, linear, minus offset times the rotation, quadratic, so that two
    eccentric halves tied together at the nodes are exactly the element of the whole section.

    Parameters
    ----------
    length, width, height : float
        Of the element, m.
    material : LappedBeam
        For E, G, ρ and the shear factor.
    offset : float
        Height of the element's own axis above the reference axis, m.
    """
    G = material.G if material.G is not None else material.E / (2 * (1 + material.nu))
    cowper = 10 * (1 + material.nu) / (12 + 11 * material.nu)
    kappa = material.shear_factor if material.shear_factor is not None else cowper
    area, inertia = width * height, width * height**3 / 12
    # The eccentric section bends together with its partner across the interface, so shear follows from the whole: Φ of the pair.
    whole = inertia + area * offset**2
    phi = 12 * material.E * whole / (kappa * G * area * length**2)
    K, M = np.zeros((6, 6)), np.zeros((6, 6))
    points, weights = np.polynomial.legendre.leggauss(4)
    for point, weight in zip(points, weights, strict=True):
        s, ds = 0.5 * (point + 1), 0.5 * weight * length
        w, w_x, rot, rot_x = _bending(s, length, phi)
        u, u_x = np.zeros(6), np.zeros(6)
        u[[0, 3]], u_x[[0, 3]] = (1 - s, s), (-1 / length, 1 / length)
        u, u_x = u - offset * rot, u_x - offset * rot_x
        K += ds * (material.E * (area * np.outer(u_x, u_x) + inertia * np.outer(rot_x, rot_x))
                   + kappa * G * area * np.outer(w_x - rot, w_x - rot))
        M += ds * material.rho * (area * (np.outer(u, u) + np.outer(w, w)) + inertia * np.outer(rot, rot))
    return 0.5 * (K + K.T), 0.5 * (M + M.T)


def _bending(s: float, h: float, phi: float) -> tuple[NDArray[np.float64], ...]:
    """Rows (6,) of w, w', θ, θ' at x = s h in terms of (u, w, θ) of both nodes."""
    w = np.array([0, 2 * s**3 - 3 * s**2 - phi * s + 1 + phi, h * (s**3 - (2 + phi / 2) * s**2 + (1 + phi / 2) * s),
                  0, -(2 * s**3 - 3 * s**2 - phi * s), h * (s**3 - (1 - phi / 2) * s**2 - phi / 2 * s)]) / (1 + phi)
    w_x = np.array([0, (6 * s**2 - 6 * s - phi) / h, 3 * s**2 - (4 + phi) * s + 1 + phi / 2,
                    0, -(6 * s**2 - 6 * s - phi) / h, 3 * s**2 - (2 - phi) * s - phi / 2]) / (1 + phi)
    rot = np.array([0, 6 / h * (s**2 - s), 3 * s**2 - (4 + phi) * s + 1 + phi,
                    0, -6 / h * (s**2 - s), 3 * s**2 - (2 - phi) * s]) / (1 + phi)
    rot_x = np.array([0, 6 / h * (2 * s - 1), 6 * s - 4 - phi, 0, -6 / h * (2 * s - 1), 6 * s - 2 + phi]) / (h * (1 + phi))
    return w, w_x, rot, rot_x


@final
@dataclass(frozen=True)
class _Half:
    """One half: which mesh points it owns (point → node number), its elements as pairs of points, its side of the interface."""

    nodes: dict[int, int]
    elements: tuple[tuple[int, int], ...]
    sign: float


@final
@dataclass(frozen=True)
class _Mesh:
    """Points along x and the nodes of both halves."""

    x: NDArray[np.float64]
    halves: tuple[_Half, ...]
    names: tuple[str, ...]

    @classmethod
    def of(cls, beam: LappedBeam) -> _Mesh:
        half = beam.patch / 2
        breaks = [0.0, beam.length, *(x for _, x in (*beam.sensors, *beam.inputs, *beam.points, *[(0, b) for b, _ in beam.bolts])),
                  *(x for _, x, _ in beam.masses), *(beam.lap or ()), *(x + d for x in beam.stations for d in (-half, 0.0, half))]
        x = _divide(breaks, beam.element_size)
        spans = [(0.0, beam.length)] if beam.lap is None else [(0.0, beam.lap[1]), (beam.lap[0], beam.length)]
        halves: list[_Half] = []
        names: list[str] = []
        for letter, sign, (start, stop) in zip("LR", (-1.0, 1.0), spans, strict=False):
            tiny = 1e-9 * beam.length
            inside = [i for i in range(len(x)) if start - tiny <= x[i] <= stop + tiny]
            nodes = {i: len(names) // 3 + k for k, i in enumerate(inside)}
            names += [f"{letter}{k + 1}.{d}" for k in range(len(inside)) for d in _DIRECTIONS]
            halves.append(_Half(nodes, tuple(zip(inside[:-1], inside[1:], strict=True)), sign))
        return cls(x, tuple(halves), tuple(names))

    @property
    def size(self) -> int:
        return len(self.names)

    def point(self, position: float) -> int:
        return int(np.argmin(np.abs(self.x - position)))

    def row(self, point: int, direction: int, half: int) -> NDArray[np.float64]:
        """Unit row of one half; of the other half where this one does not reach."""
        row = np.zeros(self.size)
        owner = self.halves[half] if point in self.halves[half].nodes else self.halves[1 - half]
        row[3 * owner.nodes[point] + direction] = 1.0
        return row

    def relative(self, station: float, patch: float, direction: int) -> NDArray[np.float64]:
        """Right minus left half at a station, averaged over the patch with the trapezoidal rule."""
        tiny = 1e-9
        points = [i for i in range(len(self.x)) if abs(self.x[i] - station) <= patch / 2 + tiny]
        weights = np.ones(1)
        if len(points) > 1:
            step = np.diff(self.x[points])
            weights = 0.5 * (np.append(step, 0.0) + np.append(0.0, step)) / step.sum()
        pairs = zip(weights, points, strict=True)
        return sum((w * (self.row(i, direction, 1) - self.row(i, direction, 0)) for w, i in pairs), np.zeros(self.size))

    def point_mass(self, position: float, mass: float) -> NDArray[np.float64]:
        """Diagonal (N,) of a mass at a position, shared by the halves that reach it; it has no rotary inertia of its own."""
        point = self.point(position)
        owners = [half for half in self.halves if point in half.nodes]
        diagonal = np.zeros(self.size)
        for half in owners:
            diagonal[3 * half.nodes[point] + np.array([0, 1])] += mass / len(owners)
        return diagonal

    def kept(self, ends: tuple[End, End]) -> list[int]:
        """Degrees of freedom that the supports leave; a pinned right end may slide axially if the left end holds the beam."""
        first, last = self.halves[0].nodes[0], self.halves[-1].nodes[len(self.x) - 1]
        gone: set[int] = set()
        held = False
        for node, end in zip((first, last), ends, strict=True):
            if end == "clamped":
                gone |= {3 * node, 3 * node + 1, 3 * node + 2}
            if end == "pinned":
                gone |= {3 * node + 1} if held else {3 * node, 3 * node + 1}
            held = held or end != "free"
        return [i for i in range(self.size) if i not in gone]


def _divide(breaks: Sequence[float], size: float) -> NDArray[np.float64]:
    """Mesh points: every break, and equal steps no longer than ``size`` between neighbours."""
    stops = np.unique(np.round(np.asarray(breaks, dtype=float), 12))
    spans = [np.linspace(a, b, max(1, int(np.ceil((b - a) / size - 1e-9))) + 1)[:-1] for a, b in zip(stops[:-1], stops[1:], strict=True)]
    return np.append(np.concatenate(spans), stops[-1])
