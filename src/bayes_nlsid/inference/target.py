"""The log posterior in search coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.prior import Prior, check_priors, log_prior, sampling_coordinates


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

    def parts(self, s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Log density (W,) of s (W, P), and where the likelihood failed although the prior allows the point."""
        out = np.full(len(s), -np.inf)
        failed = np.zeros(len(s), dtype=bool)
        inside = ((s >= self.box[0]) & (s <= self.box[1])).all(axis=1)
        theta = self.to_theta(np.clip(s, *self.box))
        prior = np.where(inside, log_prior(self.coordinates, self.priors, np.clip(s, *self.box), theta), -np.inf)
        allowed = np.isfinite(prior)
        if allowed.any():
            value = self.likelihood.log_likelihood(theta[allowed])
            failed[allowed] = ~np.isfinite(value)
            out[allowed] = np.where(np.isfinite(value), prior[allowed] + value, -np.inf)
        return out, failed

    def __call__(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (W,) of s (W, P)."""
        return self.parts(np.asarray(s, dtype=float))[0]
