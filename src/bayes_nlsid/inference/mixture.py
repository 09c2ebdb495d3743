"""A mixture of multivariate t distributions, learnt from the chain's own burn-in, from which proposals are drawn.

Parameters that act through one combination leave a posterior along a curved and sometimes forked ridge (below macroslip f_s, k_t, chi and
beta of an Iwan element; the frequency of a mode and the softening of its joints). Moves that follow the walkers' differences creep along
it; a mixture covers it piece by piece, and a proposal from it forgets where it came from (independence chain, Tierney 1994). It is
learnt during burn-in and then stands still, so that the posterior stays exactly what it was.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FREEDOM = 8.0                     # of every t, at least, and one for each parameter: tails heavier than those of the draws, so that no
#                                   walker is left behind
SIZES = (1, 2, 4, 8, 16, 32)      # numbers of components that are tried
DRAWS_EACH = 3                    # draws for every number of the mixture, at least
LOOKED_AT, TAUGHT = 40_000, 8000   # draws looked at, and used of those that differ
ROUNDS = 40                       # of expectation and maximisation
FLOOR = 1e-10                     # least variance of a component, relative to that of all draws, in every direction


@final
@dataclass(frozen=True, eq=False)
class Mixture:
    """Components of the same tail and own place and shape.

    Parameters
    ----------
    weights : ndarray (K,)
        Positive; they sum to one.
    means : ndarray (K, P)
    roots : ndarray (K, P, P)
        Lower triangular, root rootᵀ the scale matrix of a component.

    Raises
    ------
    ValueError
        If the parts do not fit together, or a root is singular.
    """

    weights: Array
    means: Array = field(repr=False)
    roots: Array = field(repr=False)

    def __post_init__(self) -> None:
        count, size = self.means.shape
        if self.weights.shape != (count,) or self.roots.shape != (count, size, size):
            raise ValueError(f"weights {self.weights.shape}, means {self.means.shape} and roots {self.roots.shape} do not fit together")
        if not ((self.weights > 0).all() and abs(self.weights.sum() - 1) < 1e-9):
            raise ValueError("weights must be positive and sum to one")
        if not (np.diagonal(self.roots, axis1=1, axis2=2) > 0).all():
            raise ValueError("a root is singular: the diagonals must be positive")

    @property
    def freedom(self) -> float:
        """Degrees of freedom of every component."""
        return max(FREEDOM, float(self.means.shape[1]))

    @cached_property
    def _whitening(self) -> Array:
        return np.asarray(np.linalg.inv(self.roots), dtype=float)

    @cached_property
    def _level(self) -> Array:
        return np.asarray(np.log(self.weights) - np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1))

    def log_density(self, s: Array) -> Array:
        """(n,) of s (n, P), up to a constant."""
        size = s.shape[1]
        z = np.einsum("kij,nkj->nki", self._whitening, s[:, None, :] - self.means)
        each = self._level - 0.5 * (self.freedom + size) * np.log1p(np.sum(z**2, axis=-1) / self.freedom)
        return np.asarray(np.logaddexp.reduce(each, axis=1))

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws (count, P)."""
        which = rng.choice(len(self.weights), size=count, p=self.weights)
        tail = np.sqrt(rng.chisquare(self.freedom, size=count) / self.freedom)
        z = rng.normal(size=(count, self.means.shape[1])) / tail[:, None]
        return np.asarray(self.means[which] + np.einsum("nij,nj->ni", self.roots[which], z))


def learn_mixture(draws: Array, seed: np.random.SeedSequence) -> Mixture | None:
    """The mixture that describes draws best by the Bayesian information criterion.

    Parameters
    ----------
    draws : ndarray (n, P)
        Of a chain.
    seed : SeedSequence
        Of the first partition.

    Returns
    -------
    Mixture or None
        None where there are too few draws for one component, or they do not move in some direction.
    """
    taken = np.unique(draws[:: max(1, len(draws) // LOOKED_AT)], axis=0)    # a walker that stood still is no peak
    taken = taken[np.random.default_rng(seed).permutation(len(taken))[:TAUGHT]]
    count, size = taken.shape
    centre = taken.mean(axis=0)
    spread = taken.std(axis=0)
    if not (spread > 1e-12 * (np.abs(centre) + 1e-12)).all():
        return None
    try:
        root = np.linalg.cholesky(np.cov((taken / spread).T).reshape(size, size)) * spread[:, None]
    except np.linalg.LinAlgError:
        return None
    z = np.linalg.solve(root, (taken - centre).T).T
    best: tuple[float, tuple[Array, Array, Array]] | None = None
    for components in SIZES:
        numbers = components * (1 + size * (size + 3) // 2)
        if numbers * DRAWS_EACH > count:
            break
        parts, log_likelihood = _expectation_maximisation(z, components, np.random.default_rng(seed))
        criterion = numbers * np.log(count) - 2 * log_likelihood
        if best is not None and criterion > best[0]:
            break
        best = criterion, parts
    if best is None:
        return None
    weights, means, covariances = best[1]
    return Mixture(weights / weights.sum(), centre + means @ root.T, root @ np.linalg.cholesky(covariances))


def _expectation_maximisation(z: Array, components: int, rng: np.random.Generator) -> tuple[tuple[Array, Array, Array], float]:
    """Weights, means, covariances of a Gaussian mixture (Dempster, Laird and Rubin 1977), and its log-likelihood."""
    from scipy.cluster.vq import kmeans2

    label = kmeans2(z, components, minit="++", seed=rng, missing="warn")[1] if components > 1 else np.zeros(len(z), dtype=int)
    share = np.eye(components)[label]
    value = -np.inf
    for _ in range(ROUNDS):
        parts = _maximised(z, share)
        each = _log_gauss(z, *parts)
        total = np.logaddexp.reduce(each, axis=1)
        share = np.exp(each - total[:, None])
        before, value = value, float(total.sum())
        if value - before < 1e-5 * len(z):
            break
    return parts, value


def _maximised(z: Array, share: Array) -> tuple[Array, Array, Array]:
    mass = share.sum(axis=0) + 1e-9
    means = share.T @ z / mass[:, None]
    size = z.shape[1]
    covariances = np.empty((len(mass), size, size))
    for k in range(len(mass)):
        off = z - means[k]
        covariances[k] = (off * share[:, k, None]).T @ off / mass[k] + FLOOR * np.eye(size)
    return mass / mass.sum(), means, covariances


def _log_gauss(z: Array, weights: Array, means: Array, covariances: Array) -> Array:
    """(n, K) log of weight times density, up to a constant."""
    out = np.empty((len(z), len(weights)))
    for k in range(len(weights)):
        root = np.linalg.cholesky(covariances[k])
        white = np.linalg.solve(root, (z - means[k]).T)
        out[:, k] = np.log(weights[k]) - np.log(np.diagonal(root)).sum() - 0.5 * np.sum(white**2, axis=0)
    return out - 0.5 * z.shape[1] * np.log(2 * np.pi)
