"""The log posterior in search coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.prior import Prior, check_priors, log_prior, sample_priors, sampling_coordinates
from bayes_nlsid.inference.ridges import Ridges


@final
@dataclass(frozen=True, eq=False)
class Target:
    """Log posterior density of s, up to a constant.

    Parameters
    ----------
    likelihood : Likelihood
    priors : tuple of Prior
        In the order of theta.
    coordinates : Coordinates or None
        None takes ``sampling_coordinates``.
    """

    likelihood: Likelihood
    priors: tuple[Prior, ...]
    coordinates: Coordinates = field(default=None, repr=False)  # type: ignore[assignment]
    box: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "priors", check_priors(self.problem, self.priors))
        if self.coordinates is None:
            object.__setattr__(self, "coordinates", sampling_coordinates(self.problem, self.priors))
        support = np.array([[p.lower for p in self.priors], [p.upper for p in self.priors]]).reshape(2, len(self.priors))
        object.__setattr__(self, "box", self.to_s(np.clip(support, *self.problem.bounds.T)))

    @property
    def problem(self) -> Problem:
        """Bounds, coordinates and names."""
        return self.likelihood.problem

    @cached_property
    def ridges(self) -> Ridges:
        """Coordinates in which walkers move."""
        return Ridges(self.problem, self.coordinates)

    def to_s(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Sampling coordinates (..., P)."""
        return self.coordinates.to_s(theta)

    def to_theta(self, s: ArrayLike) -> NDArray[np.float64]:
        """Physical parameters (..., P)."""
        return self.coordinates.to_theta(s)

    @property
    def prior_sd(self) -> NDArray[np.float64]:
        """Standard deviation (P,) of each prior in sampling coordinates, from its quantiles."""
        return self._prior_quantiles().std(axis=0)

    @property
    def prior_mean(self) -> NDArray[np.float64]:
        """Mean (P,) of each prior in sampling coordinates, from its quantiles."""
        return self._prior_quantiles().mean(axis=0)

    def _prior_quantiles(self) -> NDArray[np.float64]:
        shares = (np.arange(512) + 0.5) / 512
        return self.to_s(np.stack([p.quantile(shares) for p in self.priors], axis=-1))

    @property
    def walk_sd(self) -> NDArray[np.float64]:
        """Standard deviation (P,) of the prior in coordinates of the walk."""
        if not self.ridges.joints:
            return self.prior_sd
        return self.ridges.to_walk(self.to_s(sample_priors(self.priors, 512, np.random.default_rng(0)))).std(axis=0)

    def parts(self, s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Log density (W,) of s (W, P), and where the likelihood failed although the prior allows the point."""
        out = np.full(len(s), -np.inf)
        failed = np.zeros(len(s), dtype=bool)
        inside = ((s >= self.box[0]) & (s <= self.box[1])).all(axis=1)     # what is NaN is not
        held = np.clip(np.where(np.isfinite(s), s, self.box[0]), *self.box)
        theta = self.to_theta(held)
        prior = np.where(inside, log_prior(self.coordinates, self.priors, held, theta), -np.inf)
        allowed = np.isfinite(prior)
        if allowed.any():
            value = self.likelihood.log_likelihood(theta[allowed])
            failed[allowed] = ~np.isfinite(value)
            out[allowed] = np.where(np.isfinite(value), prior[allowed] + value, -np.inf)
        return out, failed

    def along(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (W,) in coordinates of the walk, z (W, P)."""
        value = self(self.ridges.to_s(z))
        return np.where(np.isfinite(value), value + self.ridges.log_jacobian(z), -np.inf)

    def __call__(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (W,) of s (W, P)."""
        return self.parts(np.asarray(s, dtype=float))[0]
