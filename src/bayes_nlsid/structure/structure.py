"""Mass and stiffness matrices with named locations, and the modes they have (Eq. 1, 8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    Matrix: TypeAlias = NDArray[np.float64] | csr_array
else:
    Matrix = Any

LARGEST = 1e290    # (rad/s)², far from any structure and from the end of the range of numbers
SYMMETRY = 1e-9
"""Largest relative difference between a matrix and its transpose that counts as rounding."""


@final
@dataclass(frozen=True)
class Structure:
    """A linear structure M q̈ + C q̇ + K q = F with named location rows.

    Parameters
    ----------
    M, K : ndarray or sparse array (N, N)
        kg and N/m (kg m², N m/rad for rotations); M positive definite, K positive semi-definite.
    dofs : tuple of str, length N
        Names of the degrees of freedom.
    locations : dict of str to ndarray (N,)
        Row ``p_j`` of each location: a displacement, a rotation, a relative joint motion or the mean over a patch.
    sensors, inputs, joints : tuple of str
        Which locations carry sensors, take measured forces, are suspected of nonlinearity.
    C : ndarray or sparse array (N, N), optional
        N s/m.
    K_parts, M_parts : dict of str to matrix
        Named shares that may be scaled when the model is updated; what they leave of K or M stays fixed.
    notes : tuple of str
        What was assumed, for the report.

    Raises
    ------
    ValueError
        If sizes disagree, a matrix is not finite or not symmetric, M is not positive definite, K has negative eigenvalues,
        or a name is unknown or repeated.
    """

    M: Matrix
    K: Matrix
    dofs: tuple[str, ...]
    locations: Mapping[str, NDArray[np.float64]]
    sensors: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    C: Matrix | None = None
    K_parts: Mapping[str, Matrix] = field(default_factory=dict)
    M_parts: Mapping[str, Matrix] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.dofs)
        if n == 0 or len(set(self.dofs)) != n:
            raise ValueError(f"dofs must be given and distinct, got {n} names of which {len(set(self.dofs))} differ")
        named = {"M": self.M, "K": self.K, **({} if self.C is None else {"C": self.C})}
        named |= {f"K_parts[{k!r}]": v for k, v in self.K_parts.items()} | {f"M_parts[{k!r}]": v for k, v in self.M_parts.items()}
        for name, matrix in named.items():
            _check_symmetric(name, matrix, n)
        for name, row in self.locations.items():
            if np.shape(row) != (n,):
                raise ValueError(f"location {name!r} has shape {np.shape(row)}, expected {(n,)}")
            if not np.isfinite(row).all():
                raise ValueError(f"location {name!r} holds NaN or infinite entries")
        for role in ("sensors", "inputs", "joints"):
            unknown = set(getattr(self, role)) - set(self.locations)
            if unknown:
                raise ValueError(f"{role} name unknown locations {sorted(unknown)}; known are {sorted(self.locations)}")
        if not positive_definite(self.M):
            raise ValueError("M is not positive definite: every degree of freedom needs a mass; condense massless ones out first")
        if not _largest(self.K, self.M) < LARGEST:
            raise ValueError("K over M leaves the range of numbers; check the units of stiffness and mass")
        if not positive_definite(self.K - shift(self.K, self.M) * self.M):
            raise ValueError("K has negative eigenvalues beyond rounding; check the signs of its springs")

    @property
    def size(self) -> int:
        """Number of degrees of freedom N."""
        return len(self.dofs)

    def mass(self, direction: str = "w") -> float:
        """Mass (kg) that moves when every dof named ``<node>.<direction>`` moves by the same amount; 0 if none is named so."""
        along = np.array([float(name.rpartition(".")[2] == direction) for name in self.dofs])
        return float(along @ (self.M @ along))

    def rows(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Rows (len(names), N) of the named locations.

        Raises
        ------
        ValueError
            If a name is unknown.
        """
        unknown = [name for name in names if name not in self.locations]
        if unknown:
            raise ValueError(f"unknown locations {unknown}; known are {list(self.locations)}")
        return np.array([self.locations[name] for name in names], dtype=float).reshape(len(names), self.size)

    def scaled(self, factors: Mapping[str, float]) -> Structure:
        """The structure with named parts of K and M multiplied.

        Parameters
        ----------
        factors : dict of str to float
            Positive multiplier of each part; a name that stands in both K_parts and M_parts scales both.

        Raises
        ------
        ValueError
            If a part is unknown or a factor is not positive.
        """
        unknown = set(factors) - set(self.K_parts) - set(self.M_parts)
        if unknown:
            raise ValueError(f"unknown parts {sorted(unknown)}; known are {sorted({*self.K_parts, *self.M_parts})}")
        if not all(np.isfinite(f) and f > 0 for f in factors.values()):
            raise ValueError(f"factors must be positive, got {dict(factors)}")
        K, M = self.K, self.M
        K_parts, M_parts = dict(self.K_parts), dict(self.M_parts)
        for name, factor in factors.items():
            if name in K_parts:
                K = K + (factor - 1.0) * K_parts[name]
                K_parts[name] = factor * K_parts[name]
            if name in M_parts:
                M = M + (factor - 1.0) * M_parts[name]
                M_parts[name] = factor * M_parts[name]
        return replace(self, K=K, M=M, K_parts=K_parts, M_parts=M_parts)


@final
@dataclass(frozen=True)
class Modes:
    """Rigid-body and elastic modes, mass-normalised.

    Parameters
    ----------
    rigid : ndarray (N, r)
        Rigid-body modes, kg^-1/2; any mass-orthonormal basis of the null space of K.
    omega : ndarray (m,)
        Elastic natural frequencies, rad/s, ascending.
    shapes : ndarray (N, m)
        kg^-1/2.
    """

    rigid: NDArray[np.float64]
    omega: NDArray[np.float64]
    shapes: NDArray[np.float64]

    @property
    def frequency(self) -> NDArray[np.float64]:
        """(m,) Hz."""
        return self.omega / (2 * np.pi)


DENSE_LIMIT = 800
"""Up to this size the dense eigen-solver is used; above, shift-invert on the sparse factors."""


def modes(structure: Structure, count: int = 10) -> Modes:
    """The rigid-body modes and the lowest ``count`` elastic modes (Eq. 8).

    Parameters
    ----------
    structure : Structure
    count : int
        Number of elastic modes wanted; fewer are returned when the structure has fewer.

    Raises
    ------
    ValueError
        If ``count`` is not positive.
    """
    if count < 1:
        raise ValueError(f"count must be positive, got {count}")
    return eigenmodes(structure.K, structure.M, count)


def eigenmodes(K: Matrix, M: Matrix, count: int, rigid: int | None = None) -> Modes:
    """Modes of a pair of matrices that is already known to be symmetric, M positive definite, K positive semi-definite.

    ``rigid`` is the number of rigid-body modes where it is known beforehand, as it is for reduced matrices, whose own rounding is worse.

    Raises
    ------
    ValueError
        If rounding hides the gap between rigid-body and elastic modes.
    """
    from scipy.linalg import eigh

    n = K.shape[0]
    if n <= DENSE_LIMIT or count + 6 >= n - 1:
        # Turned round, M x = μ (K − σM) x with μ = 1/(λ − σ): stiff joint springs then cannot drown the low modes in rounding.
        wanted, sigma = min(n, count + 7), shift(K, M)
        _, vectors = eigh(dense(M), dense(K - sigma * M), subset_by_index=[n - wanted, n - 1])
    else:
        from scipy.sparse.linalg import LinearOperator, eigsh

        sigma = shift(K, M)
        factor = factorise(K - sigma * M)
        inverse = LinearOperator((n, n), matvec=factor, dtype=float)
        # A fixed start vector makes Lanczos, and with it every file this project writes, the same on every run.
        start = np.random.default_rng(0).standard_normal(n)
        _, vectors = eigsh(K, k=count + 7, M=M, sigma=sigma, OPinv=inverse, v0=start)
    # So near to zero a shift mixes traces of the rigid-body modes into the others; one Rayleigh-Ritz step parts them again.
    vectors = vectors / np.sqrt(np.einsum("ij,ij->j", vectors, M @ vectors))
    values, mixing = eigh(vectors.T @ (K @ vectors), vectors.T @ (M @ vectors))
    vectors = vectors @ mixing
    rigid = rigid_count(values, rounding(K, M)) if rigid is None else rigid
    if (values[rigid:] <= 0).any():
        raise ValueError("rigid-body and elastic modes cannot be parted: stiffness spans too many orders of magnitude for double "
                         "precision; lower the stiffest springs")
    elastic = slice(rigid, min(rigid + count, len(values)))
    return Modes(vectors[:, :rigid], np.sqrt(values[elastic]), vectors[:, elastic])


def rigid_count(values: NDArray[np.float64], noise: float) -> int:
    """How many of the ascending eigenvalues (rad/s)² are zero: below ``noise``, and a million times below the next."""
    for count in range(min(6, len(values)), 0, -1):
        largest = np.abs(values[:count]).max()
        following = values[count] if count < len(values) else np.inf
        if largest < noise and largest < 1e-6 * following:
            return count
    return 0


def rounding(K: Matrix, M: Matrix) -> float:
    """Size of eigenvalues (rad/s)² that rounding alone can produce: a few hundred machine precisions of the largest one."""
    return 1e3 * np.finfo(float).eps * np.sqrt(K.shape[0]) * _largest(K, M)


def shift(K: Matrix, M: Matrix) -> float:
    """A negative shift (rad/s)² that keeps K − σM safely positive definite when K has rigid-body modes."""
    return -10 * rounding(K, M)


def _largest(K: Matrix, M: Matrix) -> float:
    """Order of magnitude of the largest eigenvalue: the largest ratio of diagonals, never zero."""
    with np.errstate(over="ignore"):   # infinite, which `Structure` refuses
        ratio = np.abs(K.diagonal()) / np.maximum(np.abs(M.diagonal()), np.finfo(float).tiny)
    return float(max(ratio.max(), np.finfo(float).tiny))


def positive_definite(matrix: Matrix) -> bool:
    """Whether a symmetric matrix is positive definite, by factorisation."""
    if isinstance(matrix, np.ndarray):
        try:
            np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            return False
        return True
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    try:
        factor = splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return False
    # Without row exchanges U = D Lᵀ, and the signs of its diagonal are those of the eigenvalues (Sylvester).
    return bool(np.array_equal(factor.perm_r, factor.perm_c) and (factor.U.diagonal() > 0).all())


def factorise(matrix: Matrix) -> Any:
    """A function that solves ``matrix x = b`` for a symmetric, possibly indefinite, matrix; b (N,) or (N, k)."""
    if isinstance(matrix, np.ndarray):
        from scipy.linalg import lu_factor, lu_solve

        factors = lu_factor(matrix)
        return lambda b: lu_solve(factors, b)
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve


def dense(matrix: Matrix) -> NDArray[np.float64]:
    """The matrix as an ndarray."""
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray(), dtype=float)


def mac(a: ArrayLike, b: ArrayLike, weight: Matrix | None = None) -> NDArray[np.float64]:
    """Modal assurance criterion between the columns of two sets of shapes.

    Parameters
    ----------
    a : array_like (s, m)
    b : array_like (s, k)
    weight : matrix (s, s), optional
        Mass matrix for a weighted MAC; unity if omitted.

    Returns
    -------
    ndarray (m, k)
        Between 0 and 1; 0 where a shape vanishes.

    Raises
    ------
    ValueError
        If the first axes differ.
    """
    x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if x.ndim != 2 or y.ndim != 2 or x.shape[0] != y.shape[0]:
        raise ValueError(f"mac: shapes have shapes {x.shape} and {y.shape}; both must be (s, modes) with the same s")
    wy = y if weight is None else weight @ y
    wx = x if weight is None else weight @ x
    size = np.outer(np.einsum("ij,ij->j", x, wx), np.einsum("ij,ij->j", y, wy))
    return np.divide((x.T @ wy) ** 2, size, out=np.zeros_like(size), where=size > 0)


def _check_symmetric(name: str, matrix: Matrix, n: int) -> None:
    if matrix.shape != (n, n):
        raise ValueError(f"{name} has shape {matrix.shape}, expected {(n, n)}: one row for each of the {n} dofs")
    entries = matrix if isinstance(matrix, np.ndarray) else matrix.tocsr().data
    if not np.isfinite(entries).all():
        raise ValueError(f"{name} holds NaN or infinite entries")
    largest = float(np.abs(entries).max()) if entries.size else 0.0
    difference = float(abs(matrix - matrix.T).max()) if largest else 0.0
    if difference > SYMMETRY * largest:
        raise ValueError(f"{name} is not symmetric: entries differ by up to {difference:.3g} of {largest:.3g}; give the full matrix, "
                         f"or its mean with its transpose")
