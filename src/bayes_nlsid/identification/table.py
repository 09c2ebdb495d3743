"""A force law as a table: in-band forces from values of the law at fixed displacements, at a cost independent of the record.

Along a recorded motion the force of a law f(q) is linear in f itself: at every sample a static law contributes one value f(q), and
Masing's rules a chain of values f((q − q_reversal)/2) whose places do not depend on the parameters. With f interpolated between M
displacements the in-band transform is a matrix (N, M) times the values of the law there, worked out once for each location.

Displacements stand at q_max (m/(M−1))², so that laws with a root at zero are met exactly, and values between them are interpolated by
cubics through four neighbours. Smooth laws are then met to about 1e-7 of their largest force with 200 places; a kink (slip, gap)
is blurred over one interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Memory, Term

Symmetry = Literal["odd", "even"]
ROWS = 64   # places of the table worked out at a time


@final
@dataclass(frozen=True, eq=False)
class ForceTable:
    """In-band force of any law of one kind along the recorded motion of one location.

    Parameters
    ----------
    places : ndarray (M,)
        Displacements, m, ascending from 0.
    matrix : ndarray (N, M)
        In-band contribution to the residual of one newton at each place.
    stuck : ndarray (N,)
        Contribution of a spring of 1 N/m.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    places: NDArray[np.float64]
    matrix: NDArray[np.float64]
    stuck: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.matrix.shape != (len(self.stuck), len(self.places)):
            raise ValueError(f"matrix has shape {self.matrix.shape}, expected {(len(self.stuck), len(self.places))}")

    def force(self, term: Term, p: ArrayLike, excess: bool) -> NDArray[np.float64]:
        """In-band contribution (..., N) for parameters p (..., n_p)."""
        values = np.asarray(p, dtype=float)
        with np.errstate(over="ignore", invalid="ignore"):
            law = term.static_force(self.places, np.zeros(1), values)
            if excess and term.stiffness is not None:
                return np.asarray(law @ self.matrix.T
                                  - np.asarray(term.stiffness(*np.moveaxis(values, -1, 0)))[..., None] * self.stuck, dtype=float)
        return np.asarray(law @ self.matrix.T, dtype=float)


def symmetry_of(term: Term, reach: float) -> Symmetry | None:
    """Whether a law depends on displacement alone, without jumps, and is odd or even in it; None if a table cannot hold it.

    Decided by evaluating the law, so that a user's own terms need no declaration.
    """
    if term.linear or term.memory not in ("none", "masing"):
        return None
    rng = np.random.default_rng(0)
    q = reach * np.concatenate([[0.0], rng.uniform(0, 1, 63)])
    p = np.array([0.5 * (x.lower + x.upper) if x.rule == "range" else 1.0 for x in term.params])
    rate = np.concatenate([[0.0], rng.normal(0, 1, 63)])
    with np.errstate(all="ignore"):
        still, moving = term.static_force(q, np.zeros(64), p), term.static_force(q, rate, p)
        mirrored = term.static_force(-q, np.zeros(64), p)
    if not (np.isfinite(still).all() and np.array_equal(still, moving)):
        return None
    if _jumps(term, p, 10 * reach):
        return None
    if np.array_equal(mirrored, -still) and still[0] == 0:
        return "odd"
    return "even" if np.array_equal(mirrored, still) and term.memory == "none" else None


def _jumps(term: Term, p: NDArray[np.float64], reach: float) -> bool:
    """Whether the largest step between neighbours fails to shrink on a grid twice as fine (a root shrinks by 0.71, a kink by 0.5)."""
    with np.errstate(all="ignore"):
        coarse, fine = (float(np.max(np.abs(np.diff(term.static_force(np.linspace(0, reach, n), np.zeros(n), p))))) for n in (2049, 4097))
    return not fine <= 0.85 * coarse


def build(contribution: Callable[[Term, NDArray[np.float64]], NDArray[np.float64]], memory: Memory, symmetry: Symmetry, reach: float,
          count: int) -> ForceTable:
    """Work the table out.

    Parameters
    ----------
    contribution : callable
        ``(term, p (B, n_p)) -> (B, N)``: exact in-band contribution of a term at the location.
    memory : {"none", "masing"}
    symmetry : {"odd", "even"}
    reach : float
        Largest |q|, m.
    count : int
        Number M of places, at least 8.

    Raises
    ------
    ValueError
        If there are too few places.
    """
    if count < 8:
        raise ValueError(f"a force table needs at least 8 places, got {count}")
    top = reach * (1 + 1e-9) if reach > 0 else 1.0
    places = top * (np.arange(count) / (count - 1)) ** 2
    unit = _interpolation(memory, symmetry, top, count)
    numbers = np.arange(count, dtype=float)[:, None]
    matrix = np.concatenate([contribution(unit, numbers[i:i + ROWS]) for i in range(0, count, ROWS)])
    spring = Term("stuck spring", "k*q", (Param("k", "N/m", "stiffness"),), lambda q, v, k: k * q, lambda q, v, k: (k, 0.0))
    return ForceTable(places, np.ascontiguousarray(matrix.T), contribution(spring, np.ones((1, 1)))[0])


def _interpolation(memory: Memory, symmetry: Symmetry, top: float, count: int) -> Term:
    """The law whose only parameter is the number of a place: what one newton there gives at any displacement."""

    def law(q: Any, v: Any, place: Any) -> Any:
        position = np.sqrt(np.minimum(np.abs(q) / top, 1.0)) * (count - 1)
        first = np.clip(np.floor(position) - 1, 0, count - 4)
        x, own = position - first, place - first
        weight = np.zeros(np.broadcast_shapes(np.shape(position), np.shape(own)))
        for k in range(4):
            others = [j for j in range(4) if j != k]
            cubic = np.prod([(x - j) / (k - j) for j in others], axis=0)
            weight = np.where(own == k, cubic, weight)
        return np.sign(q) * weight if symmetry == "odd" else weight

    return Term("interpolation", "", (Param("place", "", "range", 0.0, float(count)),), law, lambda q, v, place: (0.0, 0.0), memory=memory)
