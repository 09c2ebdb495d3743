"""The likelihood: one object with one method, to be replaced as a whole.

The residual of Eq. 13 is not white: sensor noise enters through the dynamic stiffness, which vanishes at resonance and grows like
(ω/Ω)² towards low frequencies; unmeasured force enters directly. ``WhittleLikelihood`` takes the spectrum of the residual as it is
found; ``PlainLikelihood`` is the paper's regression read as a Gaussian, kept for comparison.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.condensed import Regression, condense, tabled
from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.elimination import jacobian
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.noise import WIDTH, freedom, smoothed_variance
from bayes_nlsid.identification.problem import Problem

REFITS = 16           # starts of the refit with the likelihood's own weights
ENTRIES = 4_000_000   # residual entries held at once


class Likelihood(ABC):
    """Log density of the recordings given theta, up to a constant that does not depend on theta."""

    @property
    @abstractmethod
    def problem(self) -> Problem:
        """Whose residual it reads."""

    @property
    @abstractmethod
    def weights(self) -> NDArray[np.float64]:
        """(N,) one over the variance of every entry of the residual."""

    @property
    @abstractmethod
    def blocks(self) -> tuple[str, ...]:
        """Names of the blocks, groups of entries that may be left out together."""

    @abstractmethod
    def log_likelihood(self, theta: ArrayLike) -> NDArray[np.float64]:
        """(W,) of theta (W, P); −inf where a force law fails."""

    @abstractmethod
    def by_block(self, theta: ArrayLike) -> NDArray[np.float64]:
        """(W, B) of theta (W, P), block by block; rows sum to ``log_likelihood``."""

    @abstractmethod
    def describe(self) -> str:
        """In words, for the report; part of the identity of a run."""

    def curvature(self, theta: NDArray[np.float64], coordinates: Coordinates) -> NDArray[np.float64]:
        """Information (P, P) of the recordings around theta (P,), in the given coordinates: here that of the residual of Eq. 13."""
        slope = self._slope(theta)
        stretch = coordinates.log_jacobian(coordinates.to_s(theta)) - self.problem.coordinates.log_jacobian(self.problem.to_s(theta))
        slope = slope * np.exp(stretch)
        slope = np.where(np.isfinite(slope), slope, 0.0)
        return np.asarray(slope.T @ slope)

    def _slope(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative (n, P) of the weighted residual by the problem's search coordinates, in any entries of the same sums of squares."""
        return jacobian(self.problem, theta) * np.sqrt(self.weights)[:, None]


@final
@dataclass(frozen=True, eq=False)
class GaussianResidual:
    """Independent Gaussian entries of given variance, each record's information reduced by its taper.

    Where force tables hold all laws the sum of squares is that of the condensed residual (``identification.condensed``): its cost does not
    depend on the length of the recordings.

    Parameters
    ----------
    problem : Problem
    variance : ndarray (N,)
    block : ndarray (N,) of int
        Block of every entry.
    """

    problem: Problem
    variance: NDArray[np.float64] = field(repr=False)
    block: NDArray[np.intp] = field(repr=False)
    weights: NDArray[np.float64] = field(init=False, repr=False)
    offset: NDArray[np.float64] = field(init=False, repr=False)
    _condensed: Regression | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.variance.shape != (self.problem.size,) or not (np.isfinite(self.variance).all() and (self.variance > 0).all()):
            raise ValueError(f"variance must be ({self.problem.size},), finite and positive; noise-free data carry no likelihood, state "
                             f"a noise")
        information = np.array([s.information for s in self.problem.observed.spectra])[self.problem.record]
        object.__setattr__(self, "weights", information / self.variance)
        object.__setattr__(self, "offset", -0.5 * information * np.log(2 * np.pi * self.variance))
        condensed = condense(self.problem, self.weights) if tabled(self.problem) else None
        object.__setattr__(self, "_condensed", None if condensed is None else condensed.of(self.problem))

    def slope(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative (n, P) of the weighted residual by the search coordinates of the problem."""
        if self._condensed is not None:
            return self._condensed.slope(theta)
        return jacobian(self.problem, theta) * np.sqrt(self.weights)[:, None]

    def total(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """(W,) log-likelihood."""
        if self._condensed is not None:
            with np.errstate(all="ignore"):
                squares = np.sum(self._condensed.residual(theta) ** 2, axis=1)
            return _finite(-0.5 * squares + self.offset.sum())
        out = np.empty(len(theta))
        step = max(1, ENTRIES // self.problem.size)
        for i in range(0, len(theta), step):
            with np.errstate(all="ignore"):
                residual = self.problem.residual(theta[i:i + step])
                # Not a BLAS product: its order of summation, and so the last bit, would depend on the number of threads.
                out[i:i + step] = -0.5 * np.einsum("wn,wn,n->w", residual, residual, self.weights) + self.offset.sum()
        return _finite(out)

    def by_block(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """(W, B) log-likelihood."""
        count = int(self.block.max()) + 1
        out = np.empty((len(theta), count))
        for i, row in enumerate(theta):
            with np.errstate(all="ignore"):
                entry = -0.5 * self.weights * self.problem.residual(row) ** 2 + self.offset
            out[i] = np.bincount(self.block, entry, count)
        return _finite(out)


def _finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, -np.inf)


def _rows(theta: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(theta, dtype=float)
    if values.ndim != 2:
        raise ValueError(f"theta has shape {values.shape}, expected (W, P)")
    return values


def frequency_blocks(problem: Problem, per_cell: int = 8) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Blocks of neighbouring frequencies: index (N,) and names, ``per_cell`` for every equation of every recording."""
    index = np.empty(problem.size, dtype=np.intp)
    names: list[str] = []
    for cell in problem.cells:
        count = min(per_cell, cell.bins)
        within = np.arange(cell.bins) * count // cell.bins
        index[cell.entries] = len(names) + np.tile(within, 2)
        frequency = problem.frequency[cell.entries][:cell.bins]
        names += [f"{problem.data[cell.record].name}, mode {cell.equation + 1}, "
                  f"{frequency[within == b][0]:.4g}-{frequency[within == b][-1]:.4g} Hz"
                  for b in range(count)]
    return index, tuple(names)


@final
class WhittleLikelihood(Likelihood):
    """Independent in-band Fourier coefficients of the residual, with the residual's own smoothed spectrum as variance.

    The spectrum is estimated per recording and equation from the residual of a fit (``noise.smoothed_variance``), the fit is repeated
    with its inverse as weights, the spectrum taken again from that, and then held fixed. It is never put below the sensor noise that the
    recordings state. Smoothness: a Hann window of ``width`` frequencies to each side. The estimated variance has few degrees of freedom
    and was taken from the same residual, which the fit made smaller: it is raised by N/(N − P) and, for its own uncertainty, by
    ν/(ν − 2).

    Conservative under sensor noise, slightly short (85 % for nominal 90 %) under unmeasured force, for single-mode data band-limited and
    high-passed at half the lowest elastic frequency or above; wrong when force laws are missing, which ``mismatch`` must test.

    Parameters
    ----------
    start : Fit
    width : int
        Frequencies to each side.
    iterations : int
        Weighted refits.

    Raises
    ------
    ValueError
        If the fit failed, or leaves no residual at all (noise-free data).
    """

    def __init__(self, start: Fit, width: int = WIDTH, iterations: int = 1) -> None:
        if not np.isfinite(start.theta).all():
            raise ValueError(f"the fit has failed ({', '.join(start.reasons)}); a likelihood needs a finite starting point")
        problem, current = start.problem, start
        for _ in range(iterations):
            weights = 1 / whittle_variance(problem, current.theta, width)
            # Other weights may favour another optimum: look for it, beside the one that is known.
            again = fit(problem, starts=REFITS, seed=start.seed, weights=weights, warm=current.theta)
            current = again if np.isfinite(again.mse) else current
        self.width = width
        self.fit = current
        self._gaussian = _gaussian(problem, whittle_variance(problem, current.theta, width), current.theta)

    @property
    def problem(self) -> Problem:
        """Whose residual it reads."""
        return self.fit.problem

    @property
    def variance(self) -> NDArray[np.float64]:
        """(N,) of every entry of the residual, (kg^1/2 m/s²)²."""
        return self._gaussian.variance

    @property
    def weights(self) -> NDArray[np.float64]:
        """(N,) one over variance, reduced by the taper."""
        return self._gaussian.weights

    @property
    def blocks(self) -> tuple[str, ...]:
        """Bands of neighbouring frequencies."""
        return frequency_blocks(self.problem)[1]

    def log_likelihood(self, theta: ArrayLike) -> NDArray[np.float64]:
        """(W,) of theta (W, P)."""
        return self._gaussian.total(_rows(theta))

    def _slope(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._gaussian.slope(theta)

    def by_block(self, theta: ArrayLike) -> NDArray[np.float64]:
        """(W, B) of theta (W, P)."""
        return self._gaussian.by_block(_rows(theta))

    def describe(self) -> str:
        """In words."""
        return (f"Whittle likelihood of the in-band residual of Eq. 13, {self.problem.size} Fourier coefficients; variance from its own "
                f"spectrum, "
                f"smoothed over {self.width} frequencies to each side ({freedom(self.width):.0f} degrees of freedom), held at the fit")


@final
class PlainLikelihood(Likelihood):
    """Independent Gaussian residual of one variance per recording and equation: the paper's regression as a posterior.

    Its intervals are honest only for white unmeasured force and noiseless sensors; under accelerometer noise they are up to 36
    times too long and biased. Kept for comparison, and it warns.
    """

    def __init__(self, start: Fit) -> None:
        warnings.warn("PlainLikelihood takes the residual of Eq. 13 as white, which is honest only for white unmeasured force; "
                      "use WhittleLikelihood for anything but comparison", UserWarning, stacklevel=2)
        if not np.isfinite(start.theta).all():
            raise ValueError(f"the fit has failed ({', '.join(start.reasons)}); a likelihood needs a finite starting point")
        residual = start.problem.residual(start.theta)
        variance = np.empty(start.problem.size)
        for cell in start.problem.cells:
            variance[cell.entries] = np.mean(residual[cell.entries] ** 2)
        self.fit = start
        self._gaussian = _gaussian(start.problem, variance * _spent(start.problem), start.theta)

    @property
    def problem(self) -> Problem:
        """Whose residual it reads."""
        return self.fit.problem

    @property
    def weights(self) -> NDArray[np.float64]:
        """(N,) one over variance."""
        return self._gaussian.weights

    @property
    def blocks(self) -> tuple[str, ...]:
        """Bands of neighbouring frequencies."""
        return frequency_blocks(self.problem)[1]

    def log_likelihood(self, theta: ArrayLike) -> NDArray[np.float64]:
        """(W,) of theta (W, P)."""
        return self._gaussian.total(_rows(theta))

    def _slope(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._gaussian.slope(theta)

    def by_block(self, theta: ArrayLike) -> NDArray[np.float64]:
        """(W, B) of theta (W, P)."""
        return self._gaussian.by_block(_rows(theta))

    def describe(self) -> str:
        """In words."""
        return (f"independent Gaussian residual of Eq. 13, one variance per recording and equation, {self.problem.size} Fourier "
                "coefficients (the paper's regression)")


def whittle_variance(problem: Problem, theta: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.float64]:
    """Variance (N,) from the smoothed spectrum of the residual at theta, at least the stated sensor noise and rounding."""
    freed = freedom(width)
    found = smoothed_variance(problem, problem.residual(theta), width) * _spent(problem) * freed / (freed - 2 if freed > 2 else freed)
    rounding = problem.rounding_floor * problem.samples / float(np.sum(problem.weight))
    return np.maximum(np.maximum(found, problem.noise_variance), rounding)


def _spent(problem: Problem) -> float:
    """Degrees of freedom that the fit took out of the residual."""
    return problem.size / max(1.0, problem.size - len(problem.names))


def _gaussian(problem: Problem, variance: NDArray[np.float64], theta: NDArray[np.float64]) -> GaussianResidual:
    return GaussianResidual(problem.with_kinks(theta), variance, frequency_blocks(problem)[0])


def laplace(likelihood: Likelihood, theta: NDArray[np.float64], prior_sd: NDArray[np.float64], coordinates: Coordinates | None = None,
            turn: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Covariance (P, P) around theta: information of the likelihood plus that of the prior, 1/sd² (P,), so that it always exists.

    In the given coordinates, None: those of the problem; or in others z, of whose derivatives ds/dz ``turn`` (P, P) consists. ``prior_sd``
    must be in the same.
    """
    information = likelihood.curvature(theta, likelihood.problem.coordinates if coordinates is None else coordinates)
    if turn is not None:
        information = turn.T @ information @ turn
    values, vectors = np.linalg.eigh(information * np.outer(prior_sd, prior_sd))
    return (vectors / (1 + np.maximum(values, 0.0))) @ vectors.T * np.outer(prior_sd, prior_sd)
