"""Proposals learnt from a chain: each parameter bent into a normal one by its own quantiles, then a mixture of all of them together.

A parameter between two walls (a prior that nothing informs, a slip displacement that must lie beyond the largest motion) is no bell, and
twenty such parameters together need more bells than a chain can teach. Bent one by one, most posteriors need a single bell.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bayes_nlsid.inference.mixture import Mixture, learn_mixture

Array = NDArray[np.float64]
KNOTS = np.linspace(-2.4, 2.4, 25)   # of the normal variable; straight on beyond them
TAUGHT = 20_000                      # draws from which quantiles are taken
LEAST = 1e-3                         # distance of two knots, relative to the mean one: draws may repeat


@final
@dataclass(frozen=True, eq=False)
class Margins:
    """Piecewise straight, rising maps from each parameter to a variable that is normal among the draws.

    Parameters
    ----------
    places : ndarray (P, K)
        Where the normal variable has the values ``KNOTS``; ascending.

    Raises
    ------
    ValueError
        If they do not ascend, or are not K for each parameter.
    """

    places: Array = field(repr=False)

    def __post_init__(self) -> None:
        if self.places.ndim != 2 or self.places.shape[1] != len(KNOTS):
            raise ValueError(f"places have shape {self.places.shape}, expected (P, {len(KNOTS)})")
        if not (np.diff(self.places, axis=1) > 0).all():
            raise ValueError("places must ascend")

    @cached_property
    def _slopes(self) -> Array:
        return np.asarray(np.diff(KNOTS) / np.diff(self.places, axis=1))

    def bend(self, s: Array) -> tuple[Array, Array]:
        """Normal variables (n, P) of s (n, P), and the log of the determinant (n,)."""
        out, log = np.empty_like(s), np.zeros(len(s))
        for i, places in enumerate(self.places):
            k = np.clip(np.searchsorted(places, s[:, i]) - 1, 0, len(KNOTS) - 2)
            slope = self._slopes[i, k]
            out[:, i] = KNOTS[k] + (s[:, i] - places[k]) * slope
            log += np.log(slope)
        return out, log

    def straighten(self, u: Array) -> Array:
        """s (n, P) of normal variables (n, P)."""
        out = np.empty_like(u)
        k = np.clip(np.searchsorted(KNOTS, u) - 1, 0, len(KNOTS) - 2)
        for i, places in enumerate(self.places):
            out[:, i] = places[k[:, i]] + (u[:, i] - KNOTS[k[:, i]]) / self._slopes[i, k[:, i]]
        return out


@final
@dataclass(frozen=True, eq=False)
class Proposal:
    """A mixture of bent parameters, as a density of the parameters themselves.

    ``accepted``: share of its draws that an independence chain is expected to accept; 0 where nobody asked.
    """

    margins: Margins
    mixture: Mixture
    accepted: float = 0.0

    def log_density(self, s: Array) -> Array:
        """(n,) of s (n, P), up to a constant."""
        bent, log = self.margins.bend(s)
        return self.mixture.log_density(bent) + log

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws (count, P)."""
        return self.margins.straighten(self.mixture.sample(count, rng))


def learn_proposal(draws: Array, seed: np.random.SeedSequence) -> Proposal | None:
    """What describes draws (n, P) of a chain; None where they are too few, or do not move in some direction (see ``learn_mixture``)."""
    taken = draws[:: max(1, len(draws) // TAUGHT)]
    spread = np.ptp(taken, axis=0)
    if len(taken) < len(KNOTS) or not (spread > 1e-12 * (np.abs(taken).max(axis=0) + 1e-12)).all():
        return None
    places = np.quantile(taken, ndtr(KNOTS), axis=0).T
    span = np.maximum(places[:, -1:] - places[:, :1], 1e-9 * spread[:, None])
    steps = np.maximum(np.diff(places, axis=1), LEAST * span / len(KNOTS))
    margins = Margins(np.concatenate([places[:, :1], places[:, :1] + np.cumsum(steps, axis=1)], axis=1))
    mixture = learn_mixture(margins.bend(draws)[0], seed)
    return None if mixture is None else Proposal(margins, mixture)
