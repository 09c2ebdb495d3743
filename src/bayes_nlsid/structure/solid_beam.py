"""Solid model of two beams joined by a bolted half lap: bricks, interface patches with virtual nodes, springs, bolts (Section 3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.structure.bricks import EDGES, face_weights, solid_matrices
from bayes_nlsid.structure.solid_mesh import NEAR, Fineness, HalfMesh, half_mesh
from bayes_nlsid.structure.structure import Structure

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Springs = float | tuple[float, ...] | None
_AXES = "xyz"
_DIRECTIONS = (("normal", "open"), ("tangential", "slip"), ("rotation", "rot"), ("lateral", "side"), ("roll", "roll"), ("yaw", "yaw"))


@final
@dataclass(frozen=True)
class SolidBeam:
    """Two equal halves of rectangular section that overlap by half their height and are bolted together.

    x runs across the width, y along the height (the direction of bending), z along the beam. The interface is divided into patches:
    one around each hole, ``pitch`` long, and one at either end of the lap if anything is left there. The mean motion of a patch on either
    half is a virtual node; springs join opposite virtual nodes and do not stiffen the faces.

    Parameters
    ----------
    length, width, height : float
        Of the assembled beam, m.
    lap : float
        Length of the overlap in the middle of the beam, m.
    E, rho, nu : float
        Pa, kg/m³, -.
    bolts : int
        Number of holes, side by side along the lap's axis and symmetric about its middle.
    pitch, hole : float
        Distance and diameter of holes, m.
    washer : float
        Radius, m, of the washers' footprints on the outer faces.
    rigid_washers : bool
        Whether the footprints move as rigid bodies. Bolt, washer and nut are far stiffer than the wall they clamp.
    bolt_mass : float
        Of one bolt with washers and nut, kg, spread over the wall of its hole, half on either half.
    normal, tangential : float, tuple of float or None
        Joint springs along y and z, N/m, one for all or one per patch; locations ``J1_open``, ``J1_slip``; None leaves them out.
    rotation : float, tuple of float or None
        Springs against relative rotation about x, N m/rad, ``J1_rot``. Averaging patches are free in it.
    lateral, roll, yaw : float, tuple of float or None
        Springs along x, about z and about y: only of the full model, where a joint with springs along y and z alone leaves three relative
        motions of the halves free.
    points : int or tuple of float
        Number of equidistant points along the middle of the upper face, or their distances from the left end, m; locations ``P1``...
        measure and take forces along y.
    inputs : tuple of str
        Points that take measured forces.
    symmetric : bool
        Model the half x ≥ 0 with u_x = 0 at x = 0; matrices and rows are those of the whole beam. All modes that bend in the yz plane or
        stretch the beam are kept, all others left out, and with them the free motions above.
    order : int
        Gauss points per direction for the stiffness, see `bricks.solid_matrices`.
    fineness : Fineness

    Raises
    ------
    ValueError
        If a size is not positive, holes or washers do not fit, counts disagree, or a spring needs the full model.
    """

    length: float
    width: float
    height: float
    lap: float
    E: float
    rho: float
    nu: float = 0.3
    bolts: int = 3
    pitch: float = 0.03
    hole: float = 0.0085
    washer: float = 0.008
    rigid_washers: bool = True
    bolt_mass: float = 0.0
    normal: Springs = 1e8
    tangential: Springs = 1e8
    rotation: Springs = None
    lateral: Springs = None
    roll: Springs = None
    yaw: Springs = None
    points: int | tuple[float, ...] = 12
    inputs: tuple[str, ...] = ()
    symmetric: bool = True
    order: int = 3
    fineness: Fineness = field(default_factory=Fineness)

    def __post_init__(self) -> None:
        for name in ("length", "width", "height", "lap", "E", "rho", "pitch", "hole", "washer"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"solid beam: {name} must be positive, got {getattr(self, name)}")
        if not -1 < self.nu < 0.5 or self.bolt_mass < 0 or self.order not in (2, 3, 4):
            raise ValueError("solid beam: nu must lie in (-1, 0.5), bolt_mass must not be negative, order must be 2, 3 or 4")
        if self.bolts < 1 or self.bolts * self.pitch > self.lap * (1 + NEAR) or self.lap >= self.length:
            raise ValueError(f"solid beam: {self.bolts} bolts at a pitch of {self.pitch} m need a lap of at least as much, shorter than "
                             f"the beam; got {self.lap} m")
        if not self.hole / 2 < self.washer < min(self.width, self.pitch) / 2:
            raise ValueError(f"solid beam: the washer's radius {self.washer} m must lie between that of the hole, {self.hole / 2} m, and "
                             f"half the width and pitch, {min(self.width, self.pitch) / 2} m")
        for name, _ in _DIRECTIONS:
            if self.springs(name) is not None and self.symmetric and name in ("lateral", "roll", "yaw"):
                raise ValueError(f"solid beam: {name} springs do nothing in the symmetric half; give symmetric=False")
        if any(not 0 <= x <= self.length for x in self.positions):
            raise ValueError(f"solid beam: points must lie between 0 and {self.length} m, got {self.positions}")

    @property
    def patches(self) -> tuple[tuple[float, float], ...]:
        """Bounds along z of the interface's patches, m from the middle of the lap."""
        edge = self.bolts * self.pitch / 2
        inner = tuple((z - self.pitch / 2, z + self.pitch / 2) for z in self.holes)
        return ((-self.lap / 2, -edge), *inner, (edge, self.lap / 2)) if self.lap / 2 - edge > NEAR * self.length else inner

    @property
    def holes(self) -> tuple[float, ...]:
        """z of the holes' axes, m."""
        return tuple((i - (self.bolts - 1) / 2) * self.pitch for i in range(self.bolts))

    @property
    def positions(self) -> tuple[float, ...]:
        """Distances of the points from the left end, m."""
        return tuple(np.linspace(0, self.length, self.points).tolist()) if isinstance(self.points, int) else tuple(self.points)

    def springs(self, name: str) -> tuple[float, ...] | None:
        """Stiffness of one direction at each patch, or None if the direction is left out."""
        value = getattr(self, name)
        if value is None:
            return None
        count = len(self.patches)
        springs = (float(value),) * count if np.ndim(value) == 0 else tuple(float(v) for v in value)
        if len(springs) != count or any(not np.isfinite(k) or k < 0 for k in springs):
            raise ValueError(f"solid beam: {name} must be one non-negative stiffness or one for each of {count} patches")
        return springs


def solid_beam(beam: SolidBeam) -> Structure:
    """Finite-element model of 20-node bricks.

    Parts for updating: ``E``, ``rho``, ``bolts``, and each joint spring by its location.

    Parameters
    ----------
    beam : SolidBeam

    Returns
    -------
    Structure
        Locations: ``P1``... (y at the points, sensors); virtual nodes ``V1a_y``, ``V1a_z`` (left half), ``V1b_y``, ``V1b_z`` (right);
        joints ``J1_open``, ``J1_slip`` and, with rotational springs, ``J1_rot``: right half minus left half.
    """
    mesh = half_mesh(beam.width, beam.height, (beam.length - beam.lap) / 2, beam.lap, beam.holes, beam.pitch, beam.hole, beam.washer,
                     beam.fineness, beam.symmetric)
    solid = _Assembly.of(beam, mesh)
    locations = {**solid.points(), **solid.virtual()}
    K_parts, joints = {"E": solid.projected(solid.K)}, []
    for name, suffix in _DIRECTIONS:
        for j, stiffness in enumerate(beam.springs(name) or ()):
            location = f"J{j + 1}_{suffix}"
            locations[location] = solid.relative(j, suffix)
            joints.append(location)
            K_parts[location] = _square(locations[location], stiffness)
    M_parts = {"rho": solid.projected(solid.M)}
    if beam.bolt_mass:
        M_parts["bolts"] = solid.projected(solid.bolt_masses())
    size = len(solid.dofs)
    rigid = "rigid washer footprints" if beam.rigid_washers else "washers without stiffness"
    return Structure(
        _total(M_parts, size), _total(K_parts, size), solid.dofs, locations, sensors=tuple(f"P{i + 1}" for i in range(len(beam.positions))),
        inputs=beam.inputs, joints=tuple(sorted(joints)), K_parts=K_parts, M_parts=M_parts,
        notes=(f"solid model of {2 * len(mesh.bricks)} 20-node bricks, {size} degrees of freedom"
               + (", half by symmetry" if beam.symmetric else "") + f", {rigid}",))


def _square(row: NDArray[np.float64], stiffness: float) -> csr_array:
    from scipy.sparse import csr_array

    sparse = csr_array(row[None, :])
    return (stiffness * (sparse.T @ sparse)).tocsr()


def _total(parts: dict[str, csr_array], size: int) -> csr_array:
    from scipy.sparse import csr_array

    return sum(parts.values(), csr_array((size, size))).tocsr()


@final
@dataclass(frozen=True)
class _Assembly:
    """Both halves, before rigid groups and symmetry take degrees of freedom away: motion q = T x, 3 per node, half ``a`` first."""

    beam: SolidBeam
    nodes: tuple[NDArray[np.float64], NDArray[np.float64]]
    mesh: HalfMesh
    K: csr_array
    M: csr_array
    T: csr_array
    dofs: tuple[str, ...]

    @classmethod
    def of(cls, beam: SolidBeam, mesh: HalfMesh) -> _Assembly:
        from scipy.sparse import block_diag, csr_array, diags_array

        K, M = solid_matrices(mesh.nodes, mesh.bricks, beam.E, beam.nu, beam.rho, beam.order)
        turn = np.array([1.0, -1.0, -1.0])
        D = diags_array(np.tile(turn, len(mesh.nodes)))
        nodes = (mesh.nodes, mesh.nodes * turn)
        whole = 2.0 if beam.symmetric else 1.0
        T, dofs = _constraints(beam, nodes)
        return cls(beam, nodes, mesh, csr_array(whole * block_diag([K, D @ K @ D])), csr_array(whole * block_diag([M, M])), T, dofs)

    def projected(self, matrix: csr_array) -> csr_array:
        """Tᵀ matrix T."""
        product = (self.T.T @ matrix @ self.T).tocsr()
        return ((product + product.T) * 0.5).tocsr()

    def row(self, entries: dict[int, float]) -> NDArray[np.float64]:
        """Row of x from one of q."""
        row = np.zeros(self.T.shape[0])
        row[list(entries)] = list(entries.values())
        return np.asarray(row @ self.T)

    def bolt_masses(self) -> csr_array:
        """Half of each bolt on the wall of its hole in either half, equal on all nodes."""
        from scipy.sparse import csr_array, diags_array

        diagonal = np.zeros(self.T.shape[0])
        count = len(self.nodes[0])
        for half, nodes in enumerate(self.nodes):
            for z in self.beam.holes:
                wall = np.flatnonzero(np.hypot(nodes[:, 0], nodes[:, 2] - z) < self.beam.hole / 2 * (1 + 1e-6))
                share = np.where(self.beam.symmetric & (nodes[wall, 0] > 0), 2.0, 1.0)
                for axis in range(3):
                    diagonal[3 * (half * count + wall) + axis] += self.beam.bolt_mass / 2 * share / share.sum()
        return csr_array(diags_array(diagonal))

    def points(self) -> dict[str, NDArray[np.float64]]:
        """Rows of y at the points, interpolated along the edges of bricks on the middle of the upper face."""
        edges = np.column_stack([EDGES[:, 0], np.arange(8, 20), EDGES[:, 1]])
        h, count = self.beam.height, len(self.nodes[0])
        found: list[tuple[float, float, NDArray[np.intp]]] = []
        for half, nodes in enumerate(self.nodes):
            lines = np.unique(self.mesh.bricks[:, edges].reshape(-1, 3), axis=0)
            on = (np.abs(nodes[lines, 0]) < NEAR * h).all(axis=1) & (np.abs(nodes[lines, 1] - h / 2) < NEAR * h).all(axis=1)
            found += [(nodes[line[0], 2], nodes[line[2], 2], line + half * count) for line in lines[on]]
        rows = {}
        for i, position in enumerate(self.beam.positions):
            z = position - self.beam.length / 2
            inside = [(a, b, line) for a, b, line in found if min(a, b) - NEAR <= z <= max(a, b) + NEAR]
            if not inside:
                raise ValueError(f"solid beam: the point at {position} m from the left end lies over a hole; move it")
            a, b, line = inside[0]
            s = 2 * (z - a) / (b - a) - 1
            weights = (s * (s - 1) / 2, 1 - s**2, s * (s + 1) / 2)
            rows[f"P{i + 1}"] = self.row({3 * int(n) + 1: w for n, w in zip(line, weights, strict=True)})
        return rows

    def virtual(self) -> dict[str, NDArray[np.float64]]:
        """Mean motion along y and z of each patch on either half."""
        return {f"V{j + 1}{'ab'[half]}_{_AXES[axis]}": self.mean(half, j, axis)
                for half in (0, 1) for j in range(len(self.beam.patches)) for axis in (1, 2)}

    def mean(self, half: int, patch: int, axis: int) -> NDArray[np.float64]:
        """Mean translation of a patch along an axis."""
        at, weight, _ = self._patch(half, patch)
        return self.row({3 * int(n) + axis: float(w) for n, w in zip(at, weight, strict=True)})

    def relative(self, patch: int, suffix: str) -> NDArray[np.float64]:
        """Right minus left half: mean translation, or mean rotation in the sense of least squares."""
        match suffix:
            case "side" | "open" | "slip":
                axis = ("side", "open", "slip").index(suffix)
                return self.mean(1, patch, axis) - self.mean(0, patch, axis)
            case "rot":
                return self._rotation(1, patch, 0) - self._rotation(0, patch, 0)
            case "yaw":
                return self._rotation(1, patch, 1) - self._rotation(0, patch, 1)
        return self._rotation(1, patch, 2) - self._rotation(0, patch, 2)

    def _rotation(self, half: int, patch: int, axis: int) -> NDArray[np.float64]:
        at, weight, place = self._patch(half, patch)
        arm = place - np.where(np.arange(3) == 0, 0.0, weight @ place)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        size = weight @ (arm[:, first] ** 2 + arm[:, second] ** 2)
        entries = {3 * int(n) + second: float(w * d[first] / size) for n, w, d in zip(at, weight, arm, strict=True)}
        return self.row(entries | {3 * int(n) + first: float(-w * d[second] / size) for n, w, d in zip(at, weight, arm, strict=True)})

    def _patch(self, half: int, patch: int) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """Nodes of a patch, weights (integrals over the area) that sum to 1, and places."""
        nodes, faces = self.nodes[half], self.mesh.interface
        low, high = self.beam.patches[patch]
        middle = nodes[faces, 2].mean(axis=1)
        own = faces[(low < middle) & (middle < high)]
        weight = np.zeros(len(nodes))
        np.add.at(weight, own, face_weights(self.mesh.nodes, own))
        at = np.flatnonzero(weight)
        return at + half * len(nodes), weight[at] / weight.sum(), nodes[at]


def _constraints(beam: SolidBeam, nodes: tuple[NDArray[np.float64], NDArray[np.float64]]) -> tuple[csr_array, tuple[str, ...]]:
    """T of q = T x: nodes of rigid footprints follow six coordinates of the washer; the plane of symmetry does not move along x."""
    from scipy.sparse import csr_array

    count = len(nodes[0])
    free = np.ones(6 * count, dtype=bool)
    if beam.symmetric:
        free[np.flatnonzero(np.abs(np.concatenate(nodes)[:, 0]) < NEAR * beam.width) * 3] = False
    groups: list[tuple[str, NDArray[np.intp], NDArray[np.float64]]] = []
    if beam.rigid_washers:
        for half, own in enumerate(nodes):
            outer = np.abs(np.abs(own[:, 1]) - beam.height / 2) < NEAR * beam.height
            for i, z in enumerate(beam.holes):
                inside = np.flatnonzero(outer & (np.hypot(own[:, 0], own[:, 2] - z) < beam.washer * (1 + 1e-6)))
                groups.append((f"washer{i + 1}{'ab'[half]}", inside + half * count, own[inside] - [0.0, own[inside, 1].mean(), z]))
    slave = np.zeros(6 * count, dtype=bool)
    for _, inside, _ in groups:
        slave[(3 * inside[:, None] + np.arange(3)).ravel()] = True
    kept = np.flatnonzero(free & ~slave)
    dofs = [f"n{i // 3 + 1}.{_AXES[i % 3]}" for i in kept]
    rows, columns, values = [kept], [np.arange(len(kept))], [np.ones(len(kept))]
    for name, inside, arm in groups:
        for k in (1, 2, 3) if beam.symmetric else range(6):
            axis = np.eye(3)[k % 3]
            motion = np.tile(axis, (len(inside), 1)) if k < 3 else np.cross(axis, arm)
            rows.append((3 * inside[:, None] + np.arange(3)).ravel())
            columns.append(np.full(3 * len(inside), len(dofs)))
            values.append(motion.ravel())
            dofs.append(f"{name}.{_AXES[k]}" if k < 3 else f"{name}.r{_AXES[k - 3]}")
    T = csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(6 * count, len(dofs)))
    T.eliminate_zeros()
    return T, tuple(dofs)
