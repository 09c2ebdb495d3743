"""Other bases than the iterated one: SEREP, Craig–Bampton, and modes with static attachment shapes of the joints.

A nonlinear element feels the structure through the flexibility between its two ends, most of which sits in modes far above the band;
every basis here says in its notes how much of it is lost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.structure.reduction import (
    Guard,
    Reduced,
    Target,
    hold,
    inertia_relief,
    lowest,
    master_rows,
    project,
)
from bayes_nlsid.structure.structure import Structure
from bayes_nlsid.structure.structure import modes as full_modes


def serep(structure: Structure, masters: Sequence[str] | ArrayLike, modes: int, *, compare: int = 10) -> Reduced:
    """System equivalent reduction-expansion: T = Φ (A Φ)⁺ of rigid-body and the lowest elastic modes (O'Callahan et al. 1989).

    Frequencies of these modes are exact. With more masters than modes the coordinates depend on each other, and M and K are singular.

    Parameters
    ----------
    structure : Structure
    masters : sequence of str, or array_like (n, N)
    modes : int
        Elastic modes; rigid-body modes are added.
    compare : int
        Elastic modes that the report compares.

    Returns
    -------
    Reduced
        Its notes give the condition number of A Φ, the price of every error in the masters' motion.

    Raises
    ------
    ValueError
        If there are fewer masters than modes, or they do not see a combination of modes.
    """
    names, A = master_rows(structure, masters)
    found = full_modes(structure, max(modes, compare))
    basis = np.hstack([found.rigid, found.shapes[:, :modes]])
    if len(A) < basis.shape[1]:
        raise ValueError(f"serep: {len(A)} masters cannot follow {basis.shape[1]} modes, {found.rigid.shape[1]} of them rigid; add masters")
    seen = A @ basis
    condition = float(np.linalg.cond(seen))
    if not condition < 1e10:
        raise ValueError(f"serep: the masters do not see all combinations of {basis.shape[1]} modes (condition number {condition:.2g}); "
                         f"keep fewer modes or add masters")
    T = basis @ np.linalg.pinv(seen)
    target = Target.of(structure, lowest(found, min(compare, modes)), found.rigid.shape[1])
    matrices = project(structure.M, T), project(structure.K, T)
    note = f"condition number of the modes at the masters {condition:.2g}"
    return target.reduced(names, T, matrices, [target.step(T, *matrices)], f"serep, {modes} elastic modes", (note,))


def craig_bampton(structure: Structure, masters: Sequence[str] | ArrayLike, modes: int = 10, *, compare: int = 10,
                  guard: Guard = "raise") -> Reduced:
    """Static shapes of the masters and the lowest modes with all masters held: exact in statics, whatever the number of modes.

    Parameters
    ----------
    structure : Structure
    masters : sequence of str, or array_like (n, N)
    modes : int
        Fixed-interface modes; coordinates ``fixed1``, ... follow the masters.
    compare : int
    guard : {"raise", "constrain"}
        See `iirs`.

    Returns
    -------
    Reduced

    Raises
    ------
    ValueError
        As `iirs`.
    """
    from scipy.sparse.linalg import LinearOperator, eigsh

    held = hold(structure, masters, compare, guard)
    T, S = held.T, held.S
    if modes:
        # Modes with A φ = 0: S M φ = φ/ω², where S answers forces with all masters held.
        size = structure.size
        inverse = LinearOperator((size, size), matvec=lambda f: S(np.reshape(f, (size, 1)))[:, 0], dtype=float)
        start = inverse @ (structure.M @ np.random.default_rng(0).standard_normal(size))
        values, fixed = eigsh(structure.K, k=modes, M=structure.M, sigma=0.0, OPinv=inverse, v0=start)
        T = np.hstack([T, fixed[:, np.argsort(values)]])
    target = Target.of(structure, lowest(held.full, compare), held.rigid)
    matrices = project(structure.M, T), project(structure.K, T)
    names = (*held.names, *(f"fixed{i + 1}" for i in range(modes)))
    return target.reduced(names, T, matrices, [target.step(T, *matrices)], f"craig-bampton, {modes} fixed-interface modes", held.notes)


def attachment_modes(structure: Structure, modes: int | Sequence[int] = 10, *, at: Sequence[str] | None = None, compare: int = 10,
                     rigid: bool = True) -> Reduced:
    """Free modes and, for each joint, the static shape under its pair of forces, less what the modes already hold (Rixen 2004).

    Statics of the joints are exact, and the basis is orthonormal in mass.

    Parameters
    ----------
    structure : Structure
    modes : int or sequence of int
        The lowest so many elastic modes, or 0-based indices.
    at : sequence of str, optional
        Locations whose static shapes are added, the joints if omitted; none with an empty sequence: the plain modal basis.
    compare : int
    rigid : bool
        Keep the rigid-body modes.

    Returns
    -------
    Reduced
        Coordinates ``rigid1``..., ``mode1``..., and ``static[<location>]``.

    Raises
    ------
    ValueError
        If a mode does not exist, or a static shape is already held by the modes.
    """
    index = list(range(modes)) if isinstance(modes, int) else sorted(modes)
    found = full_modes(structure, max([*index, compare - 1]) + 1)
    if not index or index[-1] >= len(found.omega):
        raise ValueError(f"attachment modes: elastic modes {index} asked for, {len(found.omega)} found")
    places = list(structure.joints if at is None else at)
    basis = np.hstack([found.rigid, found.shapes[:, index]])
    names = [*(f"rigid{i + 1}" for i in range(found.rigid.shape[1])), *(f"mode{i + 1}" for i in index)]
    if places:
        basis = np.hstack([basis, _orthonormal(structure, inertia_relief(structure, structure.rows(places), found.rigid), basis, places)])
        names += [f"static[{name}]" for name in places]
    first = 0 if rigid else found.rigid.shape[1]
    T = basis[:, first:]
    target = Target.of(structure, lowest(found, compare), found.rigid.shape[1] - first)
    matrices = project(structure.M, T), project(structure.K, T)
    method = f"{len(index)} modes and {len(places)} attachment modes" if places else f"{len(index)} modes"
    return target.reduced(tuple(names[first:]), T, matrices, [target.step(T, *matrices)], method)


def _orthonormal(structure: Structure, shapes: NDArray[np.float64], basis: NDArray[np.float64],
                 names: Sequence[str]) -> NDArray[np.float64]:
    """Shapes (N, k) made orthonormal in mass to a basis that already is, and to each other, keeping their span and order."""
    out = basis
    for name, shape in zip(names, shapes.T, strict=True):
        size = np.sqrt(shape @ (structure.M @ shape))
        left = shape / size
        for _ in range(2):      # twice is enough
            left = left - out @ (out.T @ (structure.M @ left))
        norm = np.sqrt(left @ (structure.M @ left))
        if norm < 1e-8:
            raise ValueError(f"attachment modes: the static shape of {name!r} is already held by the others; leave it out")
        out = np.column_stack([out, left / norm])
    return out[:, basis.shape[1]:]
