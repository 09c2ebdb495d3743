"""Likelihood of recordings through simulation: the measured channels themselves, with sensor noise and unmeasured force as covariance.

The regression of Eq. 13 reads measured motion on both sides of the equation; noise there is amplified, coloured and, where strong,
biases. Here parameters and unknown initial state are simulated, and the difference to the measured channels is

    E = a_m − a_sim(theta) = e + G w + H alpha + Q rho,

sensor noise, unmeasured force through the tangent dynamics, initial state, residual terms of modes left out (``covariance``). A few
rounds of damped Gauss–Newton for theta and of restricted maximum likelihood for the levels of noise, then levels are held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.identification.output_error import OutputError, prepare
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.covariance import Noise
from bayes_nlsid.inference.forward_noise import KNOTS, Expansion, full_noise, plain_noise, with_states, without_outliers, without_states
from bayes_nlsid.inference.forward_search import BATCH, ITERATIONS, Search, marginal
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.prior import Prior, check_priors
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
TOLERANCE = 0.01        # relative error of the integrator before correction
ROUNDS = 2


@final
class ForwardLikelihood(Likelihood):
    """Gaussian likelihood of simulated channels; see the module.

    Parameters
    ----------
    error : OutputError
    noise : Noise
        Levels held; initial states among its nuisance directions.
    coordinates : Coordinates
    expansion : Expansion
    dropped : tuple of str
        Lines left out, in words.
    missing : ndarray (N,) or None
        What the integrator's step leaves out of E.
    """

    def __init__(self, error: OutputError, noise: Noise, coordinates: Coordinates, expansion: Expansion, dropped: tuple[str, ...] = (),
                 missing: Array | None = None) -> None:
        self.error, self.noise, self.coordinates, self.expansion, self.dropped = error, noise, coordinates, expansion, dropped
        self.missing = np.zeros(len(expansion.error)) if missing is None else missing

    @property
    def problem(self) -> Problem:
        """Whose parameters it reads."""
        return self.error.problem

    @property
    def weights(self) -> Array:
        """(N,) one over the variance of every entry."""
        return np.concatenate([share * w.weight**2 for share, w in zip(self.noise.information, self.noise.whitenings, strict=True)])

    @property
    def blocks(self) -> tuple[str, ...]:
        """Bands of neighbouring frequencies of each recording."""
        return tuple(f"{run.recording.name}, {part[0]:.4g}-{part[-1]:.4g} Hz" for run in self.error.runs
                     for part in np.array_split(run.spectrum.frequency, min(8, run.spectrum.bins)))

    def errors(self, theta: ArrayLike) -> Array:
        """E (W, N) of theta (W, P), the initial state following theta; infinite where a simulation fails."""
        values = np.asarray(theta, dtype=float)
        at = self.expansion
        out = np.empty((len(values), len(at.error)))
        for i in range(0, len(values), BATCH):
            some = values[i:i + BATCH]
            states = at.states + (self.coordinates.to_s(some) - at.s) @ at.follow.T
            out[i:i + BATCH] = self.error.difference(some, states) + self.missing
        return out

    def log_likelihood(self, theta: ArrayLike) -> Array:
        """(W,) of theta (W, P)."""
        return self.by_block(theta).sum(axis=1)

    def by_block(self, theta: ArrayLike) -> Array:
        """(W, B) of theta (W, P); the part of Σ that couples blocks is shared out over them by the whitened entries."""
        values = np.asarray(theta, dtype=float)
        out = np.full((len(values), len(self.blocks)), -np.inf)
        errors = self.errors(values)
        fine = np.isfinite(errors).all(axis=1)
        z2 = self.noise.whiten(errors[fine]) ** 2
        columns, at = [], 0
        for run in self.error.runs:
            bins, count = run.spectrum.bins, len(run.recording.channels)
            part = z2[:, at:at + 2 * bins * count].reshape(len(z2), 2, bins, count).sum(axis=(1, 3))
            columns += [x.sum(axis=1) for x in np.array_split(part, min(8, bins), axis=1)]
            at += 2 * bins * count
        constant = self.noise.log_normalisation / len(columns)
        out[fine] = constant - 0.5 * np.stack(columns, axis=1)
        return out

    def curvature(self, theta: NDArray[np.float64], coordinates: Coordinates) -> NDArray[np.float64]:
        """Information (P, P) in the given coordinates, from the derivative at the optimum."""
        stretch = np.exp(coordinates.log_jacobian(coordinates.to_s(theta))
                         - self.coordinates.log_jacobian(self.coordinates.to_s(theta)))
        return self.expansion.information * np.outer(stretch, stretch)

    def describe(self) -> str:
        """In words."""
        levels, floors = self.noise.levels, [x.floor for x in self.noise.layouts]
        measured = sum(int(np.isfinite(f).all(axis=0).sum()) for f in floors)
        total = sum(f.shape[1] for f in floors)
        return (f"simulated channels against measured ones, {sum(int(x.keep.sum()) for x in self.noise.layouts)} in-band Fourier "
                f"coefficients; sensor noise of {measured} of {total} channels as measured, of the others estimated at {KNOTS} knots; "
                f"unmeasured force on {len(levels.sources)} modes of density {', '.join(f'{d:.3g}' for d in np.exp(levels.sources))} "
                f"(kg^1/2 m/s²)²/Hz; initial states and residual terms of modes left out marginalised")


def forward_likelihood(fit: Fit, recordings: Sequence[Recording], priors: Sequence[Prior], *, floors: Sequence[NoiseFloor | None] = (),
                       starts: Sequence[ArrayLike] = (), tolerance: float = TOLERANCE, rounds: int = ROUNDS,
                       progress: Progress | None = None) -> ForwardLikelihood:
    """Fit parameters, initial states and noise levels by simulation, starting from the regression.

    Parameters
    ----------
    fit : Fit
        Of the regression, on the same recordings.
    recordings : sequence of Recording
        Matched to the modal data of ``fit.problem`` by name.
    priors : sequence of Prior
    floors : sequence of NoiseFloor or None
        Of each recording; one that is ``sure == "measured"`` fixes the sensor noise, the others are estimated along.
    starts : sequence of array_like (P,)
        Further points to start from, theta.
    tolerance : float
        Relative error of the integrator that is accepted before a fine run at the optimum takes it out.
    rounds : int
        Alternations of search and noise levels.
    progress : callable or None

    Returns
    -------
    ForwardLikelihood

    Raises
    ------
    ValueError
        If the fit failed, a recording has no modal data, or no start can be simulated.
    """
    if not np.isfinite(fit.theta).all():
        raise ValueError(f"the fit has failed ({', '.join(fit.reasons)}); the simulation needs a finite starting point")
    # hundreds of runs follow: the compiled loop is worth loading
    error, _ = prepare(fit, recordings, tolerance, ITERATIONS, compiled=True)
    search = Search(error, check_priors(error.problem, priors))
    best: Expansion | None = None
    best_cost = np.inf
    plain = plain_noise(error, floors)
    points = [fit.theta, *(np.asarray(x, dtype=float) for x in starts)]
    for i, theta in enumerate(points):
        if progress is not None:
            progress(0.3 * i / len(points), f"simulating from start {i + 1} of {len(points)}")
        found = search.descend(search.inside(theta), None, plain, adapt=True)
        if found is not None and found[1] < best_cost:
            best, best_cost = found
    if best is None:
        raise ValueError("the simulation from the regression failed; correct the identification first")
    search = search.corrected(best)
    found = search.descend(best.s, best.states, plain, adapt=True)
    best = found[0] if found is not None else best
    noise = full_noise(error, best, search.coordinates.to_theta(best.s), plain)
    dropped: tuple[str, ...] = ()
    for i in range(rounds):
        if progress is not None:
            progress(0.3 + 0.6 * i / rounds, "noise levels and parameters in turn")
        noise = with_states(noise, error, best).estimated(best.error)
        if i == 0:
            noise, dropped = without_outliers(error, noise, best)
        search = search.corrected(best) if i == rounds - 1 else search
        found = search.descend(best.s, best.states, without_states(noise, error))
        if found is not None:
            best = found[0]
    noise = with_states(noise, error, best)
    return ForwardLikelihood(search.error, noise, search.coordinates, marginal(best, noise, search), dropped, search.missing)
