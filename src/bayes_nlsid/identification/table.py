"""A force law as a table: in-band forces from values of the law at fixed places, at a cost independent of the record.

Along a recorded motion the force of a law f(q) is linear in f itself: at every sample a static law contributes one value f(q), and
Masing's rules a chain of values f((q − q_reversal)/2) whose places do not depend on the parameters. With f interpolated between M
displacements the in-band transform is a matrix (entries, M) times the values of the law there, worked out once for each location. A law
f(q) + h(v) needs a second such matrix between M velocities.

Places stand at q_max (m/(M−1))², so that laws with a root at zero are met exactly, and values between them are interpolated by
cubics through four neighbours. Smooth laws are then met to about 1e-7 of their largest force with 200 places; a kink (slip, gap)
is blurred over one interval. Where a fit has told where the kink is, part of the places stand close around it.
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
Kind = Literal["odd", "even", "sum"]
"""Of what a table can hold: odd or even in displacement alone, or a sum of a law odd in displacement and one odd in velocity."""
ROWS = 64   # places of the table worked out at a time
FINE, NEAR = 40, 0.05     # places around a kink whose position is known, and how far they reach, relative
PROBED, SHARP = 4001, 20.0   # displacements at which a law is searched for a kink; change of its slope there, beside that around it


@final
@dataclass(frozen=True, eq=False)
class ForceTable:
    """In-band force of any law of one kind along the recorded motion of one location.

    Parameters
    ----------
    places : ndarray (M,)
        Displacements (m), or velocities (m/s) if ``rate``, ascending from 0.
    matrix : ndarray (n, M)
        In-band transform of one newton at each place.
    rate : bool

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    places: NDArray[np.float64]
    matrix: NDArray[np.float64]
    rate: bool = False

    def __post_init__(self) -> None:
        if self.matrix.shape[1:] != self.places.shape:
            raise ValueError(f"matrix has shape {self.matrix.shape}, expected (n, {len(self.places)})")

    def values(self, term: Term, p: ArrayLike) -> NDArray[np.float64]:
        """Force (..., M), N, of a law at the places for parameters p (..., n_p)."""
        still = np.zeros(1)
        with np.errstate(over="ignore", invalid="ignore"):
            return term.static_force(still, self.places, p) if self.rate else term.static_force(self.places, still, p)

    def force(self, term: Term, p: ArrayLike) -> NDArray[np.float64]:
        """In-band transform (..., n) for parameters p (..., n_p)."""
        return np.asarray(self.values(term, p) @ self.matrix.T, dtype=float)


def kind_of(term: Term, reach: float, rough: bool = False) -> Kind | None:
    """What table a law needs, found by evaluating it, so that a user's own terms need no declaration; None if a table cannot hold it.

    It must be odd or even in displacement, or the sum of a law odd in displacement and one odd in velocity, and without jumps; with
    ``rough`` jumps are blurred over one interval, which shifts a fit by some per cent of the jump: enough to begin a search.
    """
    if term.linear or term.memory not in ("none", "masing"):
        return None
    rng = np.random.default_rng(0)
    q = reach * np.concatenate([[0.0], rng.uniform(0, 1, 63)])
    p = _typical(term)
    rate, zero = np.concatenate([[0.0], rng.normal(0, 1, 63)]), np.zeros(64)
    with np.errstate(all="ignore"):
        still, moving = term.static_force(q, zero, p), term.static_force(q, rate, p)
        mirrored = term.static_force(-q, zero, p)
        passing, back = term.static_force(zero, rate, p), term.static_force(zero, -rate, p)
    if not np.isfinite([still, moving]).all() or (not rough and _jumps(term, p, 10 * reach, rate=False)):
        return None
    if not np.array_equal(still, moving):
        added = np.allclose(still + passing, moving, rtol=1e-12, atol=1e-12 * np.abs(moving).max())
        odd = np.array_equal(mirrored, -still) and np.array_equal(back, -passing) and term.memory == "none"
        return "sum" if added and odd and (rough or not _jumps(term, p, 10.0, rate=True)) else None
    if np.array_equal(mirrored, -still) and still[0] == 0:
        return "odd"
    return "even" if np.array_equal(mirrored, still) and term.memory == "none" else None


def _typical(term: Term) -> NDArray[np.float64]:
    """Parameters to probe a law with: the middle of a range, geometric where it spans decades, else 1."""
    middle = [np.sqrt(x.lower * x.upper) if 0 < 1e3 * x.lower < x.upper else 0.5 * (x.lower + x.upper) for x in term.params]
    return np.array([m if x.rule == "range" else 1.0 for m, x in zip(middle, term.params, strict=True)])


def _jumps(term: Term, p: NDArray[np.float64], reach: float, rate: bool) -> bool:
    """Whether the largest step between neighbours fails to shrink on a grid twice as fine (a root shrinks by 0.71, a kink by 0.5)."""
    def step(n: int) -> float:
        x, still = np.linspace(0, reach, n), np.zeros(n)
        with np.errstate(all="ignore"):
            return float(np.max(np.abs(np.diff(term.static_force(still, x, p) if rate else term.static_force(x, still, p)))))

    return not step(4097) <= 0.85 * step(2049)


def build(transform: Callable[[Term, NDArray[np.float64]], NDArray[np.float64]], memory: Memory, symmetry: Symmetry, reach: float,
          count: int, rate: bool = False, kink: float = 0.0) -> ForceTable:
    """Work the table out.

    Parameters
    ----------
    transform : callable
        ``(term, p (B, n_p)) -> (B, n)``: exact in-band transform of a term's force along the motion of the location.
    memory : {"none", "masing"}
    symmetry : {"odd", "even"}
    reach : float
        Largest |q|, m, or |v|, m/s.
    count : int
        Number M of places, at least 8.
    rate : bool
        Between velocities instead of displacements.
    kink : float
        Around which places stand close, 0 for none.

    Raises
    ------
    ValueError
        If there are too few places.
    """
    if count < 8:
        raise ValueError(f"a force table needs at least 8 places, got {count}")
    top = reach * (1 + 1e-9) if reach > 0 else 1.0
    roots = _spread(count, np.sqrt(kink / top) if 0 < kink < top else 0.0)
    places = top * roots**2
    unit = _interpolation(memory, symmetry, top, roots, rate)
    numbers = np.arange(count, dtype=float)[:, None]
    matrix = np.concatenate([transform(unit, numbers[i:i + ROWS]) for i in range(0, count, ROWS)])
    return ForceTable(places, np.ascontiguousarray(matrix.T), rate)


def _spread(count: int, kink: float) -> NDArray[np.float64]:
    """Square roots (M,) of the places relative to the largest, closer around that of a kink; 0 for none."""
    if not kink:
        return np.arange(count) / (count - 1)
    low, high = kink * (1 - 0.5 * NEAR), min(1.0, kink * (1 + 0.5 * NEAR))
    wide = np.linspace(0.0, 1.0, count - min(FINE, count // 2))
    wide = wide[(wide < low) | (wide > high)]
    return np.sort(np.concatenate([wide, np.linspace(low, high, count - len(wide))]))


def kink_of(term: Term, p: NDArray[np.float64], reach: float) -> float:
    """Displacement (m) within reach at which the slope of a law jumps for parameters p (n_p,); 0 where there is none."""
    q = reach * np.linspace(0.02, 1.0, PROBED)
    with np.errstate(all="ignore"):
        jump = np.abs(np.diff(np.diff(term.static_force(q, np.zeros(1), p))))
    if not np.isfinite(jump).all() or not jump.any():
        return 0.0
    k = int(np.argmax(jump))
    around = np.r_[jump[max(0, k - 40):max(0, k - 3)], jump[k + 4:k + 41]]
    return float(q[k + 1]) if 40 < k < len(jump) - 40 and jump[k] > SHARP * np.max(around) else 0.0


def _interpolation(memory: Memory, symmetry: Symmetry, top: float, roots: NDArray[np.float64], rate: bool) -> Term:
    """The law whose only parameter is the number of a place: what one newton there gives at any displacement (or velocity)."""
    count = len(roots)

    def law(q: Any, v: Any, place: Any) -> Any:
        x = v if rate else q
        at = np.sqrt(np.minimum(np.abs(x) / top, 1.0))
        first = np.clip(np.searchsorted(roots, at, side="right") - 2, 0, count - 4)
        own = place - first
        weight = np.zeros(np.broadcast_shapes(np.shape(at), np.shape(own)))
        for k in range(4):
            mine = roots[first + k]
            cubic = np.prod([(at - roots[first + j]) / (mine - roots[first + j]) for j in range(4) if j != k], axis=0)
            weight = np.where(own == k, cubic, weight)
        return np.sign(x) * weight if symmetry == "odd" else weight

    return Term("interpolation", "", (Param("place", "", "range", 0.0, float(count)),), law, lambda q, v, place: (0.0, 0.0), memory=memory)
