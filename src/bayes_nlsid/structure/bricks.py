"""20-node serendipity bricks: shape functions, stiffness and consistent mass of linear elastic solids, integrals over faces.

Corners come first, then the twelve middles of edges. Geometry is interpolated like motion (isoparametric), so edges may be curved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float)
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])
"""(12, 2) corners that each middle node lies between."""
REFERENCE = np.vstack([_CORNERS, _CORNERS[EDGES].mean(axis=1)])
"""(20, 3) places of the nodes in the reference cube."""
FACES = {-1.0: (0, 1, 2, 3, 8, 9, 10, 11), 1.0: (4, 5, 6, 7, 12, 13, 14, 15)}
"""Local nodes of the two faces at which the third reference coordinate is -1 and 1."""


def shape_functions(points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values (p, 20) and gradients (p, 3, 20) of the shape functions at points (p, 3) of the reference cube."""
    x = np.atleast_2d(np.asarray(points, dtype=float))
    values, slopes = np.zeros((len(x), 20)), np.zeros((len(x), 3, 20))
    for i, node in enumerate(REFERENCE):
        factor = 1 + x * node                                   # at a middle node one of the three is 1, and 1 − x² takes its place
        middle = np.flatnonzero(node == 0)
        inner = np.where(node == 0, -2 * x, node)
        if middle.size:
            factor[:, middle[0]] = 1 - x[:, middle[0]] ** 2
        last = 1.0 if middle.size else (x @ node - 2)
        product = factor.prod(axis=1)
        values[:, i] = product * last / (4 if middle.size else 8)
        for d in range(3):
            others = np.delete(factor, d, axis=1).prod(axis=1)
            own = inner[:, d] * others * last + (0 if middle.size else product * node[d])
            slopes[:, d, i] = own / (4 if middle.size else 8)
    return values, slopes


def gauss(order: int, dimensions: int = 3) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (order^d, d) and weights of the product Gauss rule on the reference cube."""
    x, w = np.polynomial.legendre.leggauss(order)
    points = np.stack(np.meshgrid(*[x] * dimensions, indexing="ij"), axis=-1).reshape(-1, dimensions)
    weights = np.prod(np.stack(np.meshgrid(*[w] * dimensions, indexing="ij"), axis=-1).reshape(-1, dimensions), axis=1)
    return points, weights


def elasticity(E: float, nu: float) -> NDArray[np.float64]:
    """Isotropic elasticity (6, 6), Pa, for strains (xx, yy, zz, xy, yz, zx), the last three as angles."""
    lame, shear = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    D = np.diag([2 * shear] * 3 + [shear] * 3)
    D[:3, :3] += lame
    return D


def solid_matrices(nodes: NDArray[np.float64], bricks: NDArray[np.intp], E: float, nu: float, rho: float,
                   order: int = 3) -> tuple[csr_array, csr_array]:
    """Stiffness and consistent mass of a solid; motion of node i along x, y, z stands at 3i, 3i+1, 3i+2.

    Parameters
    ----------
    nodes : ndarray (n, 3)
        m.
    bricks : ndarray (e, 20)
        Node numbers, in the order of `REFERENCE`.
    E, nu, rho : float
        Pa, -, kg/m³.
    order : int
        Gauss points per direction for the stiffness; 3 is exact for parallelepipeds, 2 is softer (reduced integration). The mass always
        takes 3.

    Returns
    -------
    K, M : sparse array (3n, 3n)

    Raises
    ------
    ValueError
        If a brick is turned inside out.
    """
    K = np.zeros((len(bricks), 60, 60))
    D = elasticity(E, nu)
    for G, volume in _gradients(nodes, bricks, order):
        B = np.zeros((len(bricks), 6, 60))
        for row, parts in enumerate((((0, 0),), ((1, 1),), ((2, 2),), ((0, 1), (1, 0)), ((1, 2), (2, 1)), ((0, 2), (2, 0)))):
            for axis, derivative in parts:
                B[:, row, axis::3] = G[:, derivative]
        K += np.matmul(B.transpose(0, 2, 1), np.matmul(D, B)) * volume[:, None, None]
    one = np.zeros((len(bricks), 20, 20))
    points, weights = gauss(3)
    values, slopes = shape_functions(points)
    for N, dN, weight in zip(values, slopes, weights, strict=True):
        one += np.outer(N, N) * (rho * weight * np.linalg.det(dN @ nodes[bricks]))[:, None, None]
    M = np.zeros_like(K)
    for axis in range(3):
        M[:, axis::3, axis::3] = one
    places = (3 * bricks[:, :, None] + np.arange(3)).reshape(len(bricks), 60)
    return _assembled(K, places, 3 * len(nodes)), _assembled(M, places, 3 * len(nodes))


def face_weights(nodes: NDArray[np.float64], faces: NDArray[np.intp]) -> NDArray[np.float64]:
    """Integral of each shape function over 8-node faces, (f, 8), m²; faces (f, 8) as in `FACES`."""
    points, weights = gauss(3, 2)
    values, slopes = shape_functions(np.column_stack([points, -np.ones(len(points))]))
    local = list(FACES[-1.0])
    out = np.zeros(faces.shape)
    for N, dN, weight in zip(values[:, local], slopes[:, :2, local], weights, strict=True):
        tangents = dN @ nodes[faces]
        out += np.linalg.norm(np.cross(tangents[:, 0], tangents[:, 1]), axis=1)[:, None] * weight * N
    return out


def _gradients(nodes: NDArray[np.float64], bricks: NDArray[np.intp], order: int) -> Any:
    """For each Gauss point: gradients (e, 3, 20), 1/m, and the volume (e,) it stands for, m³."""
    points, weights = gauss(order)
    corners = nodes[bricks]
    for slope, weight in zip(shape_functions(points)[1], weights, strict=True):
        J = slope @ corners
        volume = np.linalg.det(J)
        if (volume <= 0).any():
            raise ValueError(f"bricks {np.flatnonzero(volume <= 0)[:5].tolist()} are turned inside out: check the order of their nodes, "
                             f"or refine the mesh")
        yield np.linalg.solve(J, np.broadcast_to(slope, (len(bricks), 3, 20))), weight * volume


def _assembled(blocks: NDArray[np.float64], places: NDArray[np.intp], size: int) -> csr_array:
    from scipy.sparse import coo_array

    count = places.shape[1]
    row, column = np.repeat(places, count, axis=1).ravel(), np.tile(places, (1, count)).ravel()
    matrix = coo_array((blocks.ravel(), (row, column)), shape=(size, size)).tocsr()
    return ((matrix + matrix.T) * 0.5).tocsr()
