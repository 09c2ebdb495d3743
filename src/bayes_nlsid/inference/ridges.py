"""Coordinates in which walkers move: what the recordings fix of an Iwan joint is one axis, what they leave open another.

Below macroslip the force of an Iwan joint is k_t q − C sgn(q)|q|^(χ+2). Recordings fix C and χ, and k_t only where the stuck spring is
not part of the linear model. In f_s and k_t, or their logarithms, such a posterior is a thin curved sheet along which walkers creep.
Instead of them the walkers take C, and beside it the displacement φ_max at which macroslip begins, or k_t where it is informed. The map
is one to one and its determinant is known, so that draws follow the same posterior.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces import laws
from bayes_nlsid.identification.coordinates import LN10, Coordinates
from bayes_nlsid.identification.problem import Piece, Problem

Array = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Ridge:
    """One Iwan joint.

    Parameters
    ----------
    piece : Piece
        Whose f_s and k_t are free.
    slip, stick : int
        Their entries in theta.
    reference : float
        Displacement at which C is read as a stiffness, m.
    stuck : bool
        Whether the linear model contains k_t, so that recordings see it in macroslip only.
    """

    piece: Piece
    slip: int
    stick: int
    reference: float
    stuck: bool

    def parts(self, theta: Array) -> tuple[Array, Array, Array]:
        """χ + 1, ln of f_s over k_t φ_max, ln of C φ_max^(χ+1) over k_t; NaN where χ or β leave the range of the law."""
        known = dict(zip((p.name for p in self.piece.element.term.params), np.moveaxis(self.piece.values(theta), -1, 0), strict=True))
        m, beta, drop = known["chi"] + 1, known["beta"], known.get("theta", 1.0)
        m = np.where((m > 0) & (beta >= 0) & (drop * m < m + 1), m, np.nan)
        return m, np.log((beta + m / (m + 1)) / (1 + beta)), np.log((m + 1 - drop * m) / ((1 + beta) * (m + 1)))


@final
@dataclass(frozen=True, eq=False)
class Ridges:
    """Map between search coordinates s and those of the walk z, which differ in two entries of every Iwan joint.

    Parameters
    ----------
    problem : Problem
    coordinates : Coordinates
        Of s.
    """

    problem: Problem
    coordinates: Coordinates
    joints: tuple[Ridge, ...] = field(init=False)

    def __post_init__(self) -> None:
        found = []
        for piece in self.problem.pieces:
            at = {piece.element.term.params[slot].name: column for slot, column in zip(piece.slots, piece.columns, strict=True)}
            both = [at[name] for name in ("f_s", "k_t") if name in at]
            if piece.element.term.law in (laws.iwan4, laws.iwan5) and len(both) == 2 and self.coordinates.logarithmic[both].all():
                reach = max(self.problem.observed.peak(name)[0] for name in piece.locations)
                found.append(Ridge(piece, both[0], both[1], reach if reach > 0 else 1.0, piece.element.excess))
        object.__setattr__(self, "joints", tuple(found))

    def _known(self, z: Array) -> Array:
        """Theta (..., P), good in the entries that s and z share; a proposal may lie anywhere."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.coordinates.to_theta(z)

    def to_walk(self, s: Array) -> Array:
        """z (..., P) of s (..., P)."""
        z = s.copy()
        if not self.joints:
            return z
        theta = self.coordinates.to_theta(s)
        for joint in self.joints:
            m, slip, soft = joint.parts(theta)
            force, stiffness = LN10 * s[..., joint.slip], LN10 * s[..., joint.stick]
            onset = force - stiffness - slip
            bend = stiffness + soft - m * (onset - np.log(joint.reference))
            z[..., joint.slip] = bend / LN10
            if joint.stuck:
                z[..., joint.stick] = onset / LN10
        return z

    def to_s(self, z: Array) -> Array:
        """s (..., P) of z (..., P); NaN where there is none."""
        s = z.copy()
        if not self.joints:
            return s
        theta = self._known(z)
        for joint in self.joints:
            m, slip, soft = joint.parts(theta)
            bend, other = LN10 * z[..., joint.slip], LN10 * z[..., joint.stick]
            if joint.stuck:
                onset, stiffness = other, bend - soft + m * (other - np.log(joint.reference))
            else:
                onset, stiffness = np.log(joint.reference) + (other + soft - bend) / m, other
            s[..., joint.slip], s[..., joint.stick] = (onset + stiffness + slip) / LN10, stiffness / LN10
        return s

    def log_jacobian(self, z: Array) -> Array:
        """log |ds/dz| (...): 0 for a joint whose stuck spring the linear model contains, else −log(χ + 1)."""
        out = np.zeros(z.shape[:-1])
        informed = [joint for joint in self.joints if not joint.stuck]
        theta = self._known(z) if informed else z
        for joint in informed:
            out = out - np.log(joint.parts(theta)[0])
        return out

    def turn(self, s: Array) -> Array | None:
        """Derivatives ds/dz (P, P) at s (P,); None where z is s."""
        if not self.joints:
            return None
        z, step = self.to_walk(s), 1e-6 * np.eye(len(s))
        moved = np.stack([self.to_s(z + step), self.to_s(z - step)])
        return np.where(np.isfinite(moved).all(axis=0), moved[0] - moved[1], 0.0).T / 2e-6
