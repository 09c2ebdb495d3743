"""Which parameters to try: quasi-random points of independent distributions arranged for Sobol indices, or draws of a posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.inference.prior import Prior

Array = NDArray[np.float64]
LOW, HIGH = 0.05, 0.95


@final
@dataclass(frozen=True)
class Plan:
    """Rows of theta to be evaluated, in blocks that follow each other.

    Parameters
    ----------
    theta : ndarray (N, P)
        ``samples`` rows for the bands; then ``len(varied)`` times ``base`` rows for Sobol indices (none if ``base`` is 0); then one row
        with every parameter at its median, and two for each varied parameter: at its 5 % and at its 95 % point, all others at their
        medians.
    samples : int
        Rows of the bands. With indices they are the points A and B in turn: A₀, B₀, A₁, B₁, …
    base : int
        Points n of A and of B, a power of two.
    varied : tuple of int
        Columns that vary.
    independent : bool
        Whether they vary independently of each other; a posterior does not.

    Raises
    ------
    ValueError
        If the number of rows does not fit.
    """

    theta: Array
    samples: int
    base: int
    varied: tuple[int, ...]
    independent: bool

    def __post_init__(self) -> None:
        wanted = self.samples + self.base * len(self.varied) + 1 + 2 * len(self.varied)
        if len(self.theta) != wanted or (self.base and self.samples != 2 * self.base):
            raise ValueError(f"plan: {len(self.theta)} rows, expected {wanted}; samples {self.samples} for base {self.base}")

    def split(self, values: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Values (N, ...) of all rows by purpose: bands, A and B (n, ...), AB (d, n, ...), the middle (...), the ends (d, 2, ...)."""
        d, rest = len(self.varied), values[self.samples:]
        mixed, ends = rest[:self.base * d].reshape(d, self.base, *values.shape[1:]), rest[self.base * d:]
        band = values[:self.samples]
        half = band[:2 * self.base]
        return band, half[0::2], half[1::2], mixed, ends[0], ends[1:].reshape(d, 2, *values.shape[1:])


def scattered_plan(centre: ArrayLike, spreads: Sequence[tuple[int, Prior]], samples: int, seed: int, indices: bool = True) -> Plan:
    """Independent distributions, by scrambled Sobol points.

    Parameters
    ----------
    centre : array_like (P,)
        Values of the parameters that do not vary.
    spreads : sequence of (column, distribution)
        Of those that do.
    samples : int
        At least so many for the bands; with indices rounded up to twice a power of two.
    seed : int
    indices : bool
        Whether rows for Sobol indices are wanted: as many again as half the samples, times the number of parameters that vary.

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        If nothing varies, a column repeats, or there are too many parameters for the sampler.
    """
    from scipy.stats import qmc

    columns = [column for column, _ in spreads]
    if not spreads or len(set(columns)) != len(columns) or samples < 2:
        raise ValueError(f"columns {columns} must be distinct and not empty, and samples at least 2")
    d = len(spreads)
    power = int(np.ceil(np.log2(samples))) - (1 if indices else 0)
    points = qmc.Sobol(2 * d if indices else d, scramble=True, rng=np.random.default_rng(seed)).random_base2(max(power, 1))
    base = len(points) if indices else 0
    share = np.clip(points, 1e-12, 1 - 1e-12)
    A, B = share[:, :d], share[:, d:]
    band = np.stack([A, B], axis=1).reshape(-1, d) if indices else A[:samples]
    mixed = [np.where(np.arange(d) == j, B, A) for j in range(d)] if indices else []
    ends = [np.where(np.arange(d) == j, end, 0.5)[None] for j in range(d) for end in (LOW, HIGH)]
    shares = np.concatenate([band, *mixed, np.full((1, d), 0.5), *ends])
    theta = np.tile(np.asarray(centre, dtype=float), (len(shares), 1))
    for j, (column, spread) in enumerate(spreads):
        theta[:, column] = spread.quantile(shares[:, j])
    return Plan(theta, len(band), base, tuple(columns), True)


def posterior_plan(draws: ArrayLike) -> Plan:
    """Draws of a posterior as they are, with all that hangs together in them.

    Parameters
    ----------
    draws : array_like (S, P)

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        If no parameter varies.
    """
    theta = np.atleast_2d(np.asarray(draws, dtype=float))
    varied = tuple(int(i) for i in np.flatnonzero(np.ptp(theta, axis=0) > 0))
    if not varied:
        raise ValueError("the draws are all the same, so there is nothing to learn from them")
    middle = np.median(theta, axis=0)
    ends = []
    for column in varied:
        for share in (LOW, HIGH):
            one = middle.copy()
            one[column] = np.quantile(theta[:, column], share)
            ends.append(one)
    return Plan(np.concatenate([theta, middle[None], np.array(ends)]), len(theta), 0, varied, False)
