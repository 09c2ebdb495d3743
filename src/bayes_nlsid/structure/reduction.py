"""Reduction to chosen rows of the motion: Guyan and the iterated improved reduced system (Eq. 2–5), and rigid-body removal.

Masters may be any rows A of the motion, averages over patches included, not only single degrees of freedom. One factorisation of
the saddle-point matrix [K Aᵀ; A 0] then gives both the static shapes T_G (right side [0; I]) and the operator S of Eq. 5 (right side
[f; 0]), without eliminating a degree of freedom; every T satisfies A T = I.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.structure.structure import Matrix, Modes, Structure, eigenmodes, factorise, mac, modes

Guard = Literal["raise", "constrain"]
UNSEEN = 1e-8
"""A rigid-body mode whose motion at the masters is below this fraction of the best seen one counts as unseen."""


@final
@dataclass(frozen=True)
class Reduced:
    """A structure seen through n generalised coordinates: q = T x.

    Parameters
    ----------
    structure : Structure
        The full model.
    masters : tuple of str, length n
        Names of the coordinates.
    T : ndarray (N, n)
    M, K : ndarray (n, n)
        Tᵀ M T, Tᵀ K T (Eq. 4).
    history : tuple of Step
        How well the elastic modes of the full model are met after each iteration, the static (Guyan) step first.
    condition : float
        Condition number of M.
    method : str
    rigid : int
        Number of rigid-body modes the coordinates can move in.
    status : str
        ``"ok"``, or in words which modes are not met.
    notes : tuple of str
    """

    structure: Structure
    masters: tuple[str, ...]
    T: NDArray[np.float64]
    M: NDArray[np.float64]
    K: NDArray[np.float64]
    history: tuple[Step, ...]
    condition: float
    method: str
    rigid: int = 0
    status: str = "ok"
    notes: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return len(self.masters)

    def rows(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Rows p_j T (len(names), n) of named locations (Eq. 6)."""
        return self.structure.rows(names) @ self.T

    def modes(self, count: int = 10) -> Modes:
        """Rigid and lowest elastic modes of the reduced model, shapes in the coordinates of the full model (N, m)."""
        return _small_modes(self.T, self.M, self.K, count, self.rigid)


@final
@dataclass(frozen=True)
class Step:
    """One iteration: relative frequency error and mass-weighted MAC of each elastic mode of the full model, and the share of each
    joint's elastic static flexibility that is lost (negative: too soft), in the order of the structure's joints."""

    frequency_error: NDArray[np.float64]
    mac: NDArray[np.float64]
    joint_loss: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def worst(self) -> float:
        """Largest frequency error."""
        return float(np.abs(self.frequency_error).max())


def guyan(structure: Structure, masters: Sequence[str] | ArrayLike, *, compare: int = 10, guard: Guard = "raise") -> Reduced:
    """Static reduction: exact in statics at the masters, and hence for the flexibility between joints that are masters.

    See `iirs` for the parameters and errors.
    """
    return iirs(structure, masters, iterations=0, compare=compare, guard=guard)


def iirs(structure: Structure, masters: Sequence[str] | ArrayLike, *, iterations: int = 5, tolerance: float = 0.01,
         least_mac: float = 0.95, compare: int = 10, guard: Guard = "raise") -> Reduced:
    """Iterated improved reduced system, T ← T_G + S M T M_r⁻¹ K_r (Eq. 3).

    Parameters
    ----------
    structure : Structure
    masters : sequence of str, or array_like (n, N)
        Locations, or rows, that stay. Rows may be averages.
    iterations : int
        At most so many; few are best. They improve the modes and worsen the joint: the static flexibility between masters is exact
        before the first and lost by some per cent per iteration.
    tolerance, least_mac : float
        Stop as soon as every compared mode has at most this relative frequency error and at least this MAC.
    compare : int
        Number of elastic modes to meet (at most n less the rigid-body modes).
    guard : {"raise", "constrain"}
        What to do if the masters do not see some rigid-body motion, when [K Aᵀ; A 0] is singular: refuse, or hold the unseen motion
        still by extra rows (M N)ᵀ. A plain factorisation would not fail, but return a polluted T.

    Returns
    -------
    Reduced

    Raises
    ------
    ValueError
        If masters are unknown, dependent, or do not see all rigid-body modes while ``guard`` is ``"raise"``.
    """
    if iterations < 0 or not 0 < tolerance or compare < 1:
        raise ValueError(f"iirs: iterations {iterations} must be >= 0, tolerance {tolerance} and compare {compare} positive")
    held = hold(structure, masters, compare, guard)
    full, names, rigid, T_s, S = held.full, held.names, held.rigid, held.T, held.S
    count = min(len(full.omega), len(names) - rigid)
    if count < 1:
        raise ValueError(f"{len(names)} masters only follow the {rigid} rigid-body modes; add masters to follow elastic ones")
    target = Target.of(structure, lowest(full, count), rigid)
    T, M_r, K_r = T_s, project(structure.M, T_s), project(structure.K, T_s)
    history = [target.step(T, M_r, K_r)]
    while len(history) <= iterations and not _met(history[-1], tolerance, least_mac):
        T = T_s + S(structure.M @ (T @ np.linalg.solve(M_r, K_r)))
        M_r, K_r = project(structure.M, T), project(structure.K, T)
        history.append(target.step(T, M_r, K_r))
    method = "guyan" if len(history) == 1 else f"iirs, {len(history) - 1} iteration{'s'[:len(history) > 2]}"
    return target.reduced(names, T, (M_r, K_r), history, method, held.notes, tolerance, least_mac)


def without_rigid_body(reduced: Reduced) -> Reduced:
    """The same model on the complement of its rigid-body modes, x = L z with L = null(Φ_rᵀ M_r) (Eq. 15–18).

    Elastic frequencies are unchanged; the coordinates z have no names of their own.
    """
    rigid = eigenmodes(reduced.K, reduced.M, 1, reduced.rigid).rigid
    if rigid.shape[1] == 0:
        return reduced
    from scipy.linalg import null_space

    L = null_space(rigid.T @ reduced.M)
    M, K = L.T @ reduced.M @ L, L.T @ reduced.K @ L
    return replace(reduced, masters=tuple(f"z{i + 1}" for i in range(L.shape[1])), T=reduced.T @ L, M=0.5 * (M + M.T), K=0.5 * (K + K.T),
                   condition=float(np.linalg.cond(M)), rigid=0, method=reduced.method + ", rigid-body motion removed")


def static_flexibility(structure: Structure, rows: ArrayLike, rigid: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Elastic static flexibility between rows, m/N: the sum of b φ φᵀ bᵀ / ω² over *all* elastic modes.

    Free structures are loaded with self-equilibrating forces (inertia relief) and the rigid-body part of the answer is removed.

    Parameters
    ----------
    structure : Structure
    rows : array_like (L, N)
    rigid : ndarray (N, r), optional
        Mass-normalised rigid-body modes, if already known.

    Returns
    -------
    ndarray (L, L)
    """
    b = np.asarray(rows, dtype=float)
    G = b @ inertia_relief(structure, b, modes(structure, 1).rigid if rigid is None else rigid)
    return np.asarray(0.5 * (G + G.T), dtype=float)


def inertia_relief(structure: Structure, rows: NDArray[np.float64], rigid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Elastic static shapes (N, L) under unit forces at rows (L, N), balanced by the inertia of rigid motion (N, r), and free of it."""
    if rigid.shape[1] == 0:
        return np.asarray(factorise(structure.K)(np.ascontiguousarray(rows.T)))
    MR = structure.M @ rigid
    return np.asarray(_saddle(structure.K, MR.T)(rows.T - MR @ (rigid.T @ rows.T), np.zeros((rigid.shape[1], len(rows)))))


def master_rows(structure: Structure, masters: Sequence[str] | ArrayLike) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    if isinstance(masters, (list, tuple)) and all(isinstance(name, str) for name in masters):
        names = tuple(str(name) for name in masters)
        A = structure.rows(names)
    else:
        A = np.asarray(masters, dtype=float)
        if A.ndim != 2 or A.shape[1] != structure.size:
            raise ValueError(f"masters has shape {A.shape}, expected (n, {structure.size}) or a sequence of location names")
        names = tuple(f"x{i + 1}" for i in range(len(A)))
    size = np.linalg.norm(A, axis=1)
    if len(A) == 0 or (size == 0).any():
        raise ValueError("masters must be given and none may be zero")
    if np.linalg.matrix_rank(A / size[:, None], tol=1e-10) < len(A):
        raise ValueError(f"masters {list(names)} are linearly dependent; leave out those that repeat others")
    return names, A


@final
@dataclass(frozen=True)
class Held:
    """A structure by its masters: names, modes of the whole, static shapes T (N, n), the operator S that answers forces with the masters
    held, the number of rigid-body modes that the masters can follow, and what there is to say about them."""

    names: tuple[str, ...]
    full: Modes
    T: NDArray[np.float64]
    S: Any
    rigid: int
    notes: tuple[str, ...]


def hold(structure: Structure, masters: Sequence[str] | ArrayLike, compare: int, guard: Guard) -> Held:
    """Masters, checked and held; raises as `iirs`."""
    names, A = master_rows(structure, masters)
    full = modes(structure, compare)
    constraint, notes = _unseen(structure, A, full.rigid, guard)
    T, S = _statics(structure.K, A, constraint)
    return Held(names, full, T, S, full.rigid.shape[1] - (0 if constraint is None else len(constraint)), notes)


def lowest(found: Modes, count: int) -> Modes:
    """The rigid and the first so many elastic modes."""
    return Modes(found.rigid, found.omega[:count], found.shapes[:, :count])


def _unseen(structure: Structure, A: NDArray[np.float64], rigid: NDArray[np.float64],
            guard: Guard) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Extra rows (k, N) that hold unseen rigid-body modes, and what to say about them."""
    if rigid.shape[1] == 0:
        return None, ()
    seen = (A / np.linalg.norm(A, axis=1)[:, None]) @ rigid
    _, values, directions = np.linalg.svd(seen, full_matrices=True)
    values = np.concatenate([values, np.zeros(rigid.shape[1] - len(values))])
    lost = values < UNSEEN * max(values.max(), np.finfo(float).tiny)
    if not lost.any():
        return None, (f"masters see all {rigid.shape[1]} rigid-body modes, singular values {', '.join(f'{v:.2g}' for v in values)}",)
    hidden = rigid @ directions[lost].T
    largest = [structure.dofs[int(np.argmax(np.abs(column)))] for column in hidden.T]
    sentence = (f"the masters see only {rigid.shape[1] - lost.sum()} of {rigid.shape[1]} rigid-body modes; unseen motions are largest at "
                f"{', '.join(largest)}")
    if guard == "raise":
        raise ValueError(f"iirs: {sentence}; add a master there, or pass guard='constrain' to hold these motions still")
    return (structure.M @ hidden).T, (sentence + "; they are held still",)


def _statics(K: Matrix, A: NDArray[np.float64], constraint: NDArray[np.float64] | None) -> tuple[NDArray[np.float64], Any]:
    """T_G (N, n) and the operator S, from one factorisation."""
    rows = A if constraint is None else np.vstack([A, constraint])
    solve = _saddle(K, rows)
    T_s = solve(np.zeros((K.shape[0], len(A))), np.eye(len(rows))[:, :len(A)])
    return T_s, lambda f: solve(f, np.zeros((len(rows), f.shape[1])))


def _saddle(K: Matrix, rows: NDArray[np.float64]) -> Any:
    """Function (f (N, k), d (r, k)) → x (N, k) with K x + rowsᵀ μ = f, rows x = d; rows scaled to the size of K."""
    scale = float(np.abs(K.diagonal()).mean()) / np.linalg.norm(rows, axis=1)
    scaled = rows * scale[:, None]
    n, r = K.shape[0], len(rows)
    if isinstance(K, np.ndarray):
        solve = factorise(np.block([[K, scaled.T], [scaled, np.zeros((r, r))]]))
    else:
        from scipy.sparse import block_array, csc_array
        from scipy.sparse.linalg import splu

        sparse_rows = csc_array(scaled)
        solve = splu(csc_array(block_array([[K, sparse_rows.T], [sparse_rows, None]]))).solve
    return lambda f, d: solve(np.vstack([f, d * scale[:, None]]))[:n]


def project(matrix: Matrix, T: NDArray[np.float64]) -> NDArray[np.float64]:
    product = T.T @ (matrix @ T)
    return np.asarray(0.5 * (product + product.T), dtype=float)


@final
@dataclass(frozen=True)
class Target:
    """What a reduced model is measured against: elastic modes and static joint flexibility of the full structure."""

    structure: Structure
    modes: Modes
    flexibility: NDArray[np.float64]    # (joints,) m/N
    rigid: int                          # rigid-body modes the reduced model can move in

    @classmethod
    def of(cls, structure: Structure, full: Modes, rigid: int) -> Target:
        rows = structure.rows(structure.joints)
        return cls(structure, full, np.diag(static_flexibility(structure, rows, full.rigid)) if len(rows) else np.zeros(0), rigid)

    def step(self, T: NDArray[np.float64], M: NDArray[np.float64], K: NDArray[np.float64]) -> Step:
        """Each full mode against the reduced mode that resembles it most."""
        small = _small_modes(T, M, K, len(M), self.rigid)
        if len(small.omega) == 0 or len(self.modes.omega) == 0:
            return Step(np.full(len(self.modes.omega), np.inf), np.zeros(len(self.modes.omega)), np.ones(len(self.flexibility)))
        likeness = mac(self.modes.shapes, small.shapes, self.structure.M)
        best = likeness.argmax(axis=1)
        kept = np.sum((self.structure.rows(self.structure.joints) @ small.shapes / small.omega) ** 2, axis=1)
        loss = 1 - np.divide(kept, self.flexibility, out=np.ones(len(kept)), where=self.flexibility > 0)
        return Step(small.omega[best] / self.modes.omega - 1, likeness.max(axis=1), loss)

    def reduced(self, names: tuple[str, ...], T: NDArray[np.float64], matrices: tuple[NDArray[np.float64], NDArray[np.float64]],
                history: Sequence[Step], method: str, notes: tuple[str, ...] = (), tolerance: float = 0.01,
                least_mac: float = 0.95) -> Reduced:
        """The reduced model, with a status and what it loses at the joints in words."""
        last, joints = history[-1], self.structure.joints
        status = "ok" if _met(last, tolerance, least_mac) else _missed(last, self.modes, tolerance, least_mac)
        lost = ", ".join(f"{name} {100 * x:.2g} %" for name, x in zip(joints, last.joint_loss, strict=True))
        said = (f"static flexibility of the joints lost by {method}: {lost}",) if joints else ()
        return Reduced(self.structure, names, T, *matrices, tuple(history), float(np.linalg.cond(matrices[0])), method, self.rigid, status,
                       (*notes, *said))


SINGULAR = 1e12
"""Condition number of a reduced mass matrix beyond which its coordinates count as dependent."""


def _small_modes(T: NDArray[np.float64], M: NDArray[np.float64], K: NDArray[np.float64], count: int, rigid: int) -> Modes:
    """Modes of a reduced model in the coordinates of the full one; dependent coordinates (SEREP) are freed of what they repeat."""
    values, vectors = np.linalg.eigh(M)
    if values[0] < values[-1] / SINGULAR:
        kept = values > values[-1] / SINGULAR
        basis = vectors[:, kept] / np.sqrt(values[kept])
        T, M, K = T @ basis, np.eye(int(kept.sum())), project(K, basis)
    small = eigenmodes(K, M, min(count, len(M)), rigid)
    return Modes(T @ small.rigid, small.omega, T @ small.shapes)


def _met(step: Step, tolerance: float, least_mac: float) -> bool:
    return bool(step.worst <= tolerance and step.mac.min() >= least_mac)


def _missed(step: Step, target: Modes, tolerance: float, least_mac: float) -> str:
    missed = [f"{target.frequency[k]:.4g} Hz (error {100 * step.frequency_error[k]:.2g} %, MAC {step.mac[k]:.3f})"
              for k in range(len(step.mac)) if abs(step.frequency_error[k]) > tolerance or step.mac[k] < least_mac]
    return "modes not met: " + "; ".join(missed)


def dynamic_flexibility(structure: Structure, rows: ArrayLike, frequency: float) -> NDArray[np.float64]:
    """Undamped flexibility b (K − ω²M)⁻¹ bᵀ between rows (L, N) at a frequency (Hz), m/N, rigid-body motion included."""
    b = np.asarray(rows, dtype=float)
    omega2 = (2 * np.pi * frequency) ** 2
    matrix = structure.K - omega2 * structure.M
    solve = factorise(matrix if isinstance(matrix, np.ndarray) else matrix.tocsc())
    return np.asarray(b @ solve(np.ascontiguousarray(b.T)), dtype=float)


