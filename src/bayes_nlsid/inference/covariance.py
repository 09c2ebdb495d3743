"""Covariance of the error of a simulated recording: sensor noise, unmeasured force through the structure, and nuisance directions.

    Σ = diag S_e(f) + Σ_k S_k U_k U_kᵀ,     log p(E) = −½ Eᵀ P E − ½ log|Σ| − ½ log|Xᵀ Σ⁻¹ X|

with P = Σ⁻¹ − Σ⁻¹ X (Xᵀ Σ⁻¹ X)⁻¹ Xᵀ Σ⁻¹: directions X (initial state, residual terms of modes left out) carry no information and are
integrated out in closed form under a flat prior (restricted likelihood, Patterson and Thompson, Biometrika 58 (1971) 545–554).
Recordings are independent of each other, so everything is done recording by recording.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
KNOT_SD = 3.0           # logarithm of a level of sensor noise: how far it may lie from its first guess
RANK = 1e-9


@final
@dataclass(frozen=True, eq=False)
class Layout:
    """One recording: N = 2 bins · s entries, frequencies first (real, then imaginary parts), channels within.

    Parameters
    ----------
    frequency : ndarray (bins,)
        Hz.
    channel : ndarray (s,) of int
        Which row of ``Levels.knots`` each channel takes.
    hats : ndarray (bins, J)
        Hat functions of the knots over frequency; rows sum to one.
    floor : ndarray (bins, s)
        Variance that sensor noise gives every entry, where it was measured; NaN columns are estimated.
    columns : tuple of ndarray (N, K_k)
        Response to unmeasured force of unit density on mode k, near its resonance.
    spill : ndarray (Q, bins, s)
        Variance that unmeasured force of unit density gives away from resonance.
    nuisance : ndarray (N, X)
        Orthonormal.
    keep : ndarray (N,) of bool
        Entries that count.
    """

    frequency: Array
    channel: NDArray[np.intp]
    hats: Array = field(repr=False)
    floor: Array = field(repr=False)
    columns: tuple[Array, ...] = field(repr=False)
    spill: Array = field(repr=False)
    nuisance: Array = field(repr=False)
    keep: NDArray[np.bool_] = field(repr=False)

    @property
    def size(self) -> int:
        """Number of entries."""
        return 2 * len(self.frequency) * len(self.channel)

    def sensor(self, levels: Levels) -> Array:
        """Variance (bins, s) of sensor noise."""
        free = np.exp(self.hats @ levels.knots[self.channel].T)
        return np.where(np.isfinite(self.floor), self.floor, free)

    def diagonal(self, levels: Levels) -> Array:
        """Diagonal part (N,) of Σ."""
        variance = self.sensor(levels) + np.einsum("q,qbs->bs", np.exp(levels.sources), self.spill)
        return np.asarray(np.concatenate([variance, variance]).ravel())


@final
@dataclass(frozen=True, eq=False)
class Levels:
    """What is unknown of Σ: logarithms of sensor variances at the knots (C, J), and of the density of unmeasured force per mode (Q,)."""

    knots: Array
    sources: Array

    @property
    def flat(self) -> Array:
        """All of it as one vector."""
        return np.concatenate([self.knots.ravel(), self.sources])

    def filled(self, values: Array) -> Levels:
        """The same shape with other values."""
        count = self.knots.size
        return Levels(values[:count].reshape(self.knots.shape), values[count:])


@final
@dataclass(frozen=True, eq=False)
class Whitening:
    """Σ^(−1/2) of one recording followed by the projection that removes nuisance directions."""

    weight: Array                     # (N,) D^(−1/2), 0 where an entry does not count
    basis: Array = field(repr=False)        # (N, K) orthonormal, of the whitened columns
    gain: Array = field(repr=False)         # (K,) their eigenvalues
    nuisance: Array = field(repr=False)     # (N, X) orthonormal after whitening
    log_determinant: float            # log|Σ| + log|Xᵀ Σ⁻¹ X|

    def root(self, z: Array) -> Array:
        """(I + U Uᵀ)^(−1/2) of z (..., N)."""
        return np.asarray(z - ((z @ self.basis) * (1 - 1 / np.sqrt(1 + self.gain))) @ self.basis.T)

    def apply(self, values: Array) -> Array:
        """Whitened, nuisance-free (..., N): its sum of squares is Eᵀ P E."""
        z = self.root(values * self.weight)
        return np.asarray(z - (z @ self.nuisance) @ self.nuisance.T)


def whitening(layout: Layout, levels: Levels) -> Whitening:
    """Factor Σ of one recording."""
    diagonal = layout.diagonal(levels)
    weight = np.where(layout.keep, 1 / np.sqrt(diagonal), 0.0)
    parts = [u * np.exp(0.5 * level) for u, level in zip(layout.columns, levels.sources, strict=True) if u.size]
    scaled = np.concatenate(parts, axis=1) * weight[:, None] if parts else np.zeros((layout.size, 0))
    gain, vectors = np.linalg.eigh(scaled.T @ scaled)
    big = gain > RANK * max(1.0, float(gain.max(initial=0.0)))
    gain, basis = gain[big], (scaled @ vectors[:, big]) / np.sqrt(gain[big])
    bare = Whitening(weight, basis, gain, np.zeros((layout.size, 0)), 0.0)
    left, values, _ = np.linalg.svd(bare.root((layout.nuisance * weight[:, None]).T).T, full_matrices=False)
    seen = values > 0
    determinant = float(np.log(diagonal[layout.keep]).sum() + np.log1p(gain).sum() + 2 * np.log(values[seen]).sum())
    return replace(bare, nuisance=left[:, seen], log_determinant=determinant)


@final
@dataclass(frozen=True, eq=False)
class Noise:
    """Layouts of all recordings with their levels: what a likelihood of simulated recordings needs.

    Parameters
    ----------
    layouts : tuple of Layout
    levels : Levels
    information : tuple of float
        Share of independent information that the taper of each recording leaves.
    """

    layouts: tuple[Layout, ...] = field(repr=False)
    levels: Levels
    information: tuple[float, ...]
    whitenings: tuple[Whitening, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "whitenings", tuple(whitening(x, self.levels) for x in self.layouts))

    def split(self, values: Array) -> list[Array]:
        """Values (..., N) recording by recording."""
        ends = np.cumsum([x.size for x in self.layouts])[:-1]
        return [np.asarray(part) for part in np.split(values, ends, axis=-1)]

    def whiten(self, values: Array) -> Array:
        """Whitened entries (..., N) with the taper's loss taken into account."""
        return np.concatenate([np.sqrt(share) * w.apply(part) for share, w, part in
                               zip(self.information, self.whitenings, self.split(values), strict=True)], axis=-1)

    @property
    def freedom(self) -> int:
        """Entries that count, less nuisance directions."""
        return sum(int(x.keep.sum()) - w.nuisance.shape[1] for x, w in zip(self.layouts, self.whitenings, strict=True))

    @property
    def log_normalisation(self) -> float:
        """What is added to −½|z|² for a log density."""
        return float(sum(-0.5 * share * (w.log_determinant + (int(x.keep.sum()) - w.nuisance.shape[1]) * np.log(2 * np.pi))
                         for share, x, w in zip(self.information, self.layouts, self.whitenings, strict=True)))

    def estimated(self, errors: Array) -> Noise:
        """Levels by restricted maximum likelihood from one error (N,), with weak priors around those given."""
        from scipy.optimize import minimize

        start, parts = self.levels.flat, self.split(errors)
        knots = self.levels.knots.size
        low = np.concatenate([start[:knots] - 4 * KNOT_SD, np.array([_least(self.layouts, self.levels, k)
                                                                    for k in range(len(self.levels.sources))])])
        high = np.concatenate([start[:knots] + 4 * KNOT_SD, np.full(len(start) - knots, np.inf)])

        def cost(values: Array) -> tuple[float, Array]:
            levels = self.levels.filled(values)
            total = 0.5 * float(np.sum(((values - start)[:knots] / KNOT_SD) ** 2))
            slope = np.concatenate([(values - start)[:knots] / KNOT_SD**2, np.zeros(len(values) - knots)])
            for layout, error in zip(self.layouts, parts, strict=True):
                value, gradient = restricted(layout, levels, error)
                total, slope = total + value, slope + gradient
            return total, slope

        found = minimize(cost, np.clip(start, low, high), jac=True, method="L-BFGS-B", bounds=np.stack([low, high], axis=1),
                         options={"maxiter": 20, "ftol": 1e-6})
        return replace(self, levels=self.levels.filled(found.x))


def _least(layouts: tuple[Layout, ...], levels: Levels, source: int) -> float:
    """Level of unmeasured force below which it could not be seen."""
    seen = [1e-4]
    for layout in layouts:
        u = layout.columns[source]
        if u.size:
            share = np.sum(u**2, axis=1) / np.exp(layout.hats @ levels.knots[layout.channel].T).repeat(2, axis=0).ravel()[:len(u)]
            seen.append(float(share.max()))
    return float(np.log(1e-3 / max(seen)))


def restricted(layout: Layout, levels: Levels, error: Array) -> tuple[float, Array]:
    """Minus the restricted log-likelihood of one error (N,) of one recording, and its derivative with respect to the levels."""
    w = whitening(layout, levels)
    z = w.apply(error)
    value = 0.5 * float(z @ z) + 0.5 * w.log_determinant
    outer = w.weight * w.root(z)                                          # P E
    inner = w.root(w.nuisance.T).T
    leverage = w.weight**2 * (1 - np.sum(w.basis**2 * (w.gain / (1 + w.gain)), axis=1) - np.sum(inner**2, axis=1))   # diagonal of P
    pull = (0.5 * (leverage - outer**2)).reshape(2, len(layout.frequency), len(layout.channel)).sum(axis=0)
    sensor = np.where(np.isfinite(layout.floor), 0.0, pull * layout.sensor(levels))
    knots = np.zeros(levels.knots.shape)
    np.add.at(knots, layout.channel, (layout.hats.T @ sensor).T)
    sources = np.zeros(len(levels.sources))
    for k, u in enumerate(layout.columns):
        density = np.exp(levels.sources[k])
        sources[k] = density * float(np.sum(pull * layout.spill[k]))
        if u.size:
            seen = w.apply(u.T)
            sources[k] += 0.5 * density * float(np.sum(seen**2) - np.sum((u.T @ outer) ** 2))
    return value, np.concatenate([knots.ravel(), sources])
