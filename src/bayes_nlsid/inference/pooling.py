"""Nominally equal joints: values that scatter around a common one, both unknown (hierarchical prior).

In the variable z in which the prior is normal or flat (the parameter, its logarithm, its logit), values of J joints are

    z_j = mu + tau eta_j,    eta_j ~ N(0, 1),    mu ~ the stated prior,    tau ~ half-normal(scatter).

Given tau the common value integrates out in closed form, so only the mean and the scatter of the z_j count; tau is a sum over a fixed
grid. The J values remain the only unknowns: no funnel for a sampler to fall into, and nothing to add to theta. Joints are never taken
to be more alike than a hundredth of ``scatter``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import cumulative_simpson
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri

Array = NDArray[np.float64]
NODES, LEAST, MOST = 64, 0.01, 4.0      # of the grid of tau, over scatter
MIDDLES = 512                           # quantiles of mu by which the mass inside the bounds is summed
GRID, REACH = 8001, 7.0                 # of the distribution of one joint by itself


@final
@dataclass(frozen=True, eq=False)
class Pool:
    """Joint prior of z (..., J) of nominally equal joints, cut at the bounds of each and renormalised as a whole.

    Parameters
    ----------
    scatter : float
        Scale of the half-normal prior of tau, in units of z.
    box : ndarray (J, 2)
        Bounds of each z.
    mean, sd : float
        Of the normal prior of mu; an infinite sd is flat.

    Raises
    ------
    ValueError
        If scatter or sd is not positive, or the box is not (J, 2), finite where mu is flat and ascending.
    """

    scatter: float
    box: Array = field(repr=False)
    mean: float = 0.0
    sd: float = np.inf

    def __post_init__(self) -> None:
        if not (0 < self.scatter < np.inf and self.sd > 0):
            raise ValueError(f"scatter {self.scatter} and sd {self.sd} must be positive")
        if self.box.ndim != 2 or self.box.shape[1] != 2 or not (self.box[:, 0] < self.box[:, 1]).all():
            raise ValueError(f"box has shape {self.box.shape}, expected (J, 2), ascending")
        if np.isinf(self.sd) and not np.isfinite(self.box).all():
            raise ValueError("a flat common value needs finite bounds")

    @cached_property
    def tau(self) -> Array:
        """(K,) grid of the scatter between joints."""
        return np.asarray(self.scatter * np.geomspace(LEAST, MOST, NODES))

    @cached_property
    def log_weight(self) -> Array:
        """(K,) log probability of every node: half-normal density times the width of its cell in log tau."""
        log = np.log(self.tau) - 0.5 * (self.tau / self.scatter) ** 2
        log[[0, -1]] += np.log(0.5)
        return np.asarray(log - logsumexp(log))

    @property
    def edges(self) -> tuple[float, float]:
        """Where the common value may lie: within the bounds of any of the joints."""
        return float(self.box[:, 0].min()), float(self.box[:, 1].max())

    def _common(self, centre: Array, width: Array) -> Array:
        """log of the integral over mu of N(mu; centre, width²) times its prior."""
        low, high = self.edges
        if np.isinf(self.sd):
            return _log_between((low - centre) / width, (high - centre) / width) - np.log(high - low)
        variance = self.sd**2 + width**2
        narrow = self.sd * width / np.sqrt(variance)
        middle = (self.mean * width**2 + centre * self.sd**2) / variance
        whole = _log_between(np.array((low - self.mean) / self.sd), np.array((high - self.mean) / self.sd))
        return (-0.5 * np.log(2 * np.pi * variance) - 0.5 * (centre - self.mean) ** 2 / variance
                + _log_between((low - middle) / narrow, (high - middle) / narrow) - whole)

    def by_node(self, z: ArrayLike) -> Array:
        """log of the density (..., K) of z (..., J) and of each tau together, not cut at the bounds."""
        values = np.asarray(z, dtype=float)
        count = values.shape[-1]
        centre = values.mean(axis=-1)[..., None]
        squares = np.sum((values - centre) ** 2, axis=-1)[..., None]
        own = -0.5 * (count - 1) * np.log(2 * np.pi * self.tau**2) - 0.5 * np.log(count) - 0.5 * squares / self.tau**2
        return np.asarray(own + self._common(centre, self.tau / np.sqrt(count)) + self.log_weight)

    @cached_property
    def log_inside(self) -> float:
        """log of the probability that all joints lie within their bounds."""
        mu = self.middles((np.arange(MIDDLES) + 0.5) / MIDDLES)
        log = np.zeros((MIDDLES, NODES))
        for low, high in self.box:
            log = log + _log_between((low - mu[:, None]) / self.tau, (high - mu[:, None]) / self.tau)
        return float(logsumexp(log + self.log_weight - np.log(MIDDLES)))

    def log_density(self, z: ArrayLike) -> Array:
        """Natural logarithm of the density (...) of z (..., J); −inf outside the bounds."""
        values = np.asarray(z, dtype=float)
        inside = np.asarray(((values >= self.box[:, 0]) & (values <= self.box[:, 1])).all(axis=-1))
        safe = np.where(inside[..., None], values, 0.0)
        return np.asarray(np.where(inside, logsumexp(self.by_node(safe), axis=-1) - self.log_inside, -np.inf))

    def middles(self, share: Array) -> Array:
        """Common values below which the given share of their prior lies."""
        low, high = self.edges
        if np.isinf(self.sd):
            return np.asarray(low + share * (high - low))
        return _cut_normal(share, np.array(self.mean), np.array(self.sd), low, high)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draws (count, J) of all joints together."""
        kept = np.zeros((0, len(self.box)))
        while len(kept) < count:
            mu, tau = self.middles(rng.uniform(size=count)), rng.choice(self.tau, count, p=np.exp(self.log_weight))
            z = mu[:, None] + tau[:, None] * rng.normal(size=(count, len(self.box)))
            inside = np.all((z >= self.box[:, 0]) & (z <= self.box[:, 1]), axis=1)
            kept = np.concatenate([kept, z[inside]])
        return kept[:count]

    def common(self, z: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Common value and scatter (S,) each that belong to draws z (S, J), from their conditional distribution."""
        count = z.shape[1]
        log = self.by_node(z)
        weight = np.cumsum(np.exp(log - logsumexp(log, axis=1, keepdims=True)), axis=1)
        tau = self.tau[np.minimum((weight < rng.uniform(size=(len(z), 1))).sum(axis=1), NODES - 1)]
        centre, width, share = z.mean(axis=1), tau / np.sqrt(count), rng.uniform(size=len(z))
        if np.isinf(self.sd):
            return _cut_normal(share, centre, width, *self.edges), tau
        variance = self.sd**2 + width**2
        middle = (self.mean * width**2 + centre * self.sd**2) / variance
        return _cut_normal(share, middle, self.sd * width / np.sqrt(variance), *self.edges), tau

    @cached_property
    def _alone(self) -> tuple[Array, Array]:
        """Values and cumulative probability of the first joint by itself."""
        one = Pool(self.scatter, self.box[:1], self.mean, self.sd)
        low, high = one.edges
        if np.isfinite(self.sd):
            far = REACH * np.hypot(self.sd, MOST * self.scatter)
            low, high = max(low, self.mean - far), min(high, self.mean + far)
        z = np.linspace(low, high, GRID)
        share = cumulative_simpson(np.exp(one.log_density(z[:, None])), x=z, initial=0.0)
        return z, np.maximum.accumulate(share / share[-1])

    def quantile(self, share: ArrayLike) -> Array:
        """Value below which the given share of the first joint's own distribution lies."""
        z, cumulative = self._alone
        return np.asarray(np.interp(np.asarray(share, dtype=float), cumulative, z))


def _log_between(low: Array, high: Array) -> Array:
    """log of the standard normal probability between two points, with its digits in both tails."""
    flip = low > 0
    top, bottom = np.where(flip, -low, high), np.where(flip, -high, low)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = log_ndtr(top), log_ndtr(bottom)
        return np.asarray(a + np.log1p(-np.exp(np.minimum(b - a, 0.0))))


def _cut_normal(share: Array, mean: Array, sd: Array, low: float, high: float) -> Array:
    """Quantiles of normal distributions cut at two points."""
    a, b = (low - mean) / sd, (high - mean) / sd
    upper = a > 0      # work in the tail where the normal distribution has digits
    z = np.where(upper, -ndtri(ndtr(-a) + share * (ndtr(-b) - ndtr(-a))), ndtri(ndtr(a) + share * (ndtr(b) - ndtr(a))))
    return np.asarray(np.clip(mean + sd * z, low, high))
