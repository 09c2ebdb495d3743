"""Block mesh of one half of a half-lap beam: a body of full height, and a lap of half height with rings of bricks around its holes.

x runs across the width, y along the height, z along the beam; the origin is the middle of the lap's interface. The half has its body at
negative z and its lap below the interface (y < 0); the other half is this one turned by 180° about x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
NEAR = 1e-7
"""Nodes nearer than this fraction of the beam's length are one."""


@final
@dataclass(frozen=True)
class Fineness:
    """Numbers of bricks.

    Parameters
    ----------
    across : int
        Over the width; even. Four times as many stand around each hole.
    through : int
        Over half the height.
    footprint, around : int
        Rings from the hole to the edge of the washer, and from there to the border of the hole's rectangle.
    end : int
        Along each of the strips between the last rectangle and the end of the lap.
    near, far : int
        Along the body: over the ``near_length`` (m) that follows the lap, and over the rest.

    Raises
    ------
    ValueError
        If a number is not positive or ``across`` is odd.
    """

    across: int = 2
    through: int = 2
    footprint: int = 2
    around: int = 2
    end: int = 2
    near: int = 6
    far: int = 12
    near_length: float = 0.12

    def __post_init__(self) -> None:
        counts = (self.across, self.through, self.footprint, self.around, self.end, self.near, self.far)
        if min(counts) < 1 or self.across % 2 or not self.near_length > 0:
            raise ValueError(f"fineness: all numbers must be positive and across even, got {counts} and {self.near_length}")


@final
@dataclass(frozen=True)
class HalfMesh:
    """Nodes (n, 3), m, bricks (e, 20) and faces (f, 8) of the interface y = 0 of the half with negative z."""

    nodes: Points
    bricks: NDArray[np.intp]
    interface: NDArray[np.intp]


def half_mesh(width: float, height: float, body: float, lap: float, holes: tuple[float, ...], pitch: float, hole: float, washer: float,
              fineness: Fineness, symmetric: bool) -> HalfMesh:
    """Mesh of one half.

    Parameters
    ----------
    width, height, body, lap : float
        Section, lengths of the body and of the lap, m.
    holes : tuple of float
        z of their axes, ``pitch`` apart, ascending.
    pitch, hole, washer : float
        Distance of holes, diameter of a hole, radius of the washer, m.
    fineness : Fineness
    symmetric : bool
        Only the part with x ≥ 0.
    """
    f = fineness
    lap_cells: list[Points] = []
    for z in holes:
        lap_cells += [cell + [0.0, z] for cell in _hole_cells(width, pitch, hole / 2, washer, f)]
    xs = np.linspace(-width / 2, width / 2, f.across + 1)
    for start, stop in ((-lap / 2, holes[0] - pitch / 2), (holes[-1] + pitch / 2, lap / 2)):
        if stop - start > NEAR * (body + lap):
            lap_cells += _grid(xs, np.linspace(start, stop, f.end + 1))
    near = min(f.near_length, body / 2)
    far = np.linspace(-lap / 2 - body, -lap / 2 - near, f.far + 1)
    body_cells = _grid(xs, np.concatenate([far, np.linspace(-lap / 2 - near, -lap / 2, f.near + 1)[1:]]))
    if symmetric:
        lap_cells, body_cells = ([c for c in cells if c[:, 0].mean() > 0] for cells in (lap_cells, body_cells))
    lower = np.linspace(-height / 2, 0.0, f.through + 1)
    bricks = [b for cell in lap_cells for b in _lifted(cell, lower)]
    bricks += [b for cell in body_cells for b in _lifted(cell, np.concatenate([lower, -lower[-2::-1]]))]
    nodes, numbers = _merged(np.array(bricks).reshape(-1, 3), NEAR * (body + lap))
    connected = numbers.reshape(-1, 20)
    # A brick is lifted from its upper face (local nodes 0-3) to its lower one, so the interface is made of the first kind of face.
    top = connected[:, [0, 1, 2, 3, 8, 9, 10, 11]]
    flat = (np.abs(nodes[top, 1]) < NEAR * height).all(axis=1) & (nodes[top, 2].mean(axis=1) > -lap / 2)
    return HalfMesh(nodes, connected, top[flat])


def _hole_cells(width: float, pitch: float, radius: float, washer: float, f: Fineness) -> list[Points]:
    """Eight-node quadrilaterals (8, 2) in (x, z) between a circular hole and the rectangle width x pitch around it."""
    n = f.across
    t = np.arange(n) / n
    corners = np.array([[-width, -pitch], [width, -pitch], [width, pitch], [-width, pitch]]) / 2
    border = np.concatenate([a + t[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    sectors = len(border)
    levels = np.concatenate([np.linspace(0, 1, f.footprint + 1), np.linspace(1, 2, f.around + 1)[1:]])

    def place(level: float, sector: float) -> Points:
        angle = 2 * np.pi * sector / sectors - 3 * np.pi / 4
        ray = np.array([np.cos(angle), np.sin(angle)])
        if level <= 1:
            return (radius + level * (washer - radius)) * ray
        first = int(np.floor(sector))
        share = sector - first
        outside = (1 - share) * border[first % sectors] + share * border[(first + 1) % sectors]
        return (2 - level) * washer * ray + (level - 1) * outside

    return [_quadrilateral(place, levels[i], levels[i + 1], k) for i in range(len(levels) - 1) for k in range(sectors)]


def _quadrilateral(place: Callable[[float, float], Points], inner: float, outer: float, k: int) -> Points:
    corners = [place(inner, k), place(outer, k), place(outer, k + 1), place(inner, k + 1)]
    middles = [(corners[0] + corners[1]) / 2, place(outer, k + 0.5), (corners[2] + corners[3]) / 2, place(inner, k + 0.5)]
    return np.array(corners + middles)


def _grid(xs: Points, zs: Points) -> list[Points]:
    out = []
    for x0, x1 in zip(xs[:-1], xs[1:], strict=True):
        for z0, z1 in zip(zs[:-1], zs[1:], strict=True):
            corners = np.array([[x0, z0], [x1, z0], [x1, z1], [x0, z1]])
            out.append(np.vstack([corners, (corners + np.roll(corners, -1, axis=0)) / 2]))
    return out


def _lifted(cell: Points, ys: Points) -> list[Points]:
    """Bricks over a quadrilateral in (x, z), from the upper to the lower y because (x, z, y) is left-handed."""
    def at(corners: Points, y: float) -> Points:
        return np.column_stack([corners[:, 0], np.full(len(corners), y), corners[:, 1]])

    return [np.vstack([at(cell[:4], y1), at(cell[:4], y0), at(cell[4:], y1), at(cell[4:], y0), at(cell[:4], (y0 + y1) / 2)])
            for y0, y1 in zip(ys[:-1], ys[1:], strict=True)]


def _merged(points: Points, near: float) -> tuple[Points, NDArray[np.intp]]:
    """Distinct points in order of z, y, x, and the number of each given one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(near, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    count, label = connected_components(graph, directed=False)
    first = np.full(count, len(points))
    np.minimum.at(first, label, np.arange(len(points)))
    nodes = np.where(np.abs(points[first]) < near, 0.0, points[first])
    order = np.lexsort(np.round(nodes, 9).T)
    position = np.empty(count, dtype=np.intp)
    position[order] = np.arange(count)
    return nodes[order], position[label]
