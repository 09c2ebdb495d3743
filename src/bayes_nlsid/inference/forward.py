"""Likelihood of recordings through simulation: the measured channels themselves, with sensor noise and unmeasured force as covariance.

The regression of Eq. 13 reads measured motion on both sides of the equation; noise there is amplified, coloured and, where strong,
biases. Here parameters and unknown initial state are simulated, and the difference to the measured channels is

    E = a_m − a_sim(theta) = e + G w + H alpha + Q rho,

sensor noise, unmeasured force through the tangent dynamics, initial state, residual terms of modes left out (``covariance``). A few
rounds of damped Gauss–Newton for theta and of restricted maximum likelihood for the levels of noise, then levels are held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.identification.output_error import OutputError, prepare
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.covariance import Layout, Levels, Noise
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.prior import Prior, check_priors, log_prior, sampling_coordinates
from bayes_nlsid.inference.unmeasured import forced_modes, residual_terms, unmeasured_force
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
KNOTS = 4               # of the spectrum of sensor noise over the band
STEP = 1e-3             # of the prior's standard deviation, or of the state's size: a numerical derivative
FRACTIONS = (1.0, 0.5, 0.25, 0.06, 0.01)
SETTLED = 0.01          # Newton decrement, squared posterior standard deviations, at which a search stops
ROUNDS, ITERATIONS = 2, 12
STATE_SD = 10.0         # prior of an initial state, in units of the motion's size
TOLERANCE = 0.01        # relative error of the integrator before correction
FINER = 8               # times the steps of a run that tells the integrator's error
OUTLIER = 14.0          # power over spectrum beyond which a line is left out as a resonance or hum that the model does not know
BATCH = 64


@final
@dataclass(frozen=True, eq=False)
class Expansion:
    """Quadratic expansion of the log posterior around an optimum, initial states marginalised.

    Parameters
    ----------
    s : ndarray (P,)
        Sampling coordinates of the optimum.
    states : ndarray (U,)
        Initial states there.
    error : ndarray (N,)
        E there.
    slope : ndarray (N, P + U)
        dE/d(s, states).
    follow : ndarray (U, P)
        How the best initial state moves with s.
    information : ndarray (P, P)
        Of the recordings alone, in s.
    gradient : ndarray (P,)
        Of minus the log-likelihood, in s.
    """

    s: Array
    states: Array = field(repr=False)
    error: Array = field(repr=False)
    slope: Array = field(repr=False)
    follow: Array = field(repr=False)
    information: Array = field(repr=False)
    gradient: Array = field(repr=False)


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
        levels, floors = self.noise.levels, [np.isfinite(x.floor).all(axis=0) for x in self.noise.layouts]
        measured = sum(int(f.sum()) for f in floors)
        total = sum(len(f) for f in floors)
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
    search = _Search(error, check_priors(error.problem, priors))
    best: Expansion | None = None
    plain = _plain_noise(error, floors)
    points = [fit.theta, *(np.asarray(x, dtype=float) for x in starts)]
    for i, theta in enumerate(points):
        if progress is not None:
            progress(0.3 * i / len(points), f"simulating from start {i + 1} of {len(points)}")
        found = search.descend(search.inside(theta), None, plain, adapt=True)
        if found is not None and (best is None or found[1] < best_cost):
            best, best_cost = found
    if best is None:
        raise ValueError("the simulation from the regression failed; correct the identification first")
    search = search.corrected(best)
    found = search.descend(best.s, best.states, plain, adapt=True)
    best = found[0] if found is not None else best
    noise = _full_noise(error, best, search, plain)
    dropped: tuple[str, ...] = ()
    for i in range(rounds):
        if progress is not None:
            progress(0.3 + 0.6 * i / rounds, "noise levels and parameters in turn")
        noise = _with_states(noise, error, best).estimated(best.error)
        if i == 0:
            noise, dropped = _without_outliers(error, noise, best)
        search = search.corrected(best) if i == rounds - 1 else search
        found = search.descend(best.s, best.states, _without_states(noise, error))
        if found is not None:
            best = found[0]
    noise = _with_states(noise, error, best)
    return ForwardLikelihood(search.error, noise, search.coordinates, _marginal(best, noise, search), dropped, search.missing)


@final
@dataclass(frozen=True, eq=False)
class _Search:
    """Damped Gauss–Newton for the mode of the posterior in (s, initial states).

    Simulations take few steps; what that leaves out is worked out once by a fine run at a point near the optimum and added to all of them
    (``missing`` (N,)), for it hardly changes over the width of a posterior.
    """

    error: OutputError
    priors: tuple[Prior, ...]
    missing: Array | None = field(default=None, repr=False)
    coordinates: Coordinates = field(init=False)
    box: Array = field(init=False, repr=False)
    spread: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "coordinates", sampling_coordinates(self.error.problem, self.priors))
        support = np.array([[p.lower for p in self.priors], [p.upper for p in self.priors]]).reshape(2, len(self.priors))
        object.__setattr__(self, "box", self.coordinates.to_s(support))
        shares = (np.arange(256) + 0.5) / 256
        draws = np.stack([p.quantile(shares) for p in self.priors], axis=-1)
        object.__setattr__(self, "spread", self.coordinates.to_s(draws).std(axis=0))

    def corrected(self, at: Expansion) -> _Search:
        """The same with the integrator's error at a point taken into account: Richardson's extrapolation of a second-order scheme."""
        x = np.concatenate([at.s, at.states])[None]
        coarse, fine = (self.values(x, refine, bare=True)[0] for refine in (1, FINER))
        change = (fine - coarse) * FINER**2 / (FINER**2 - 1)
        return replace(self, missing=change if np.isfinite(change).all() else self.missing)

    def inside(self, theta: Array) -> Array:
        """s of theta, moved off the bounds."""
        margin = 1e-3 * (self.box[1] - self.box[0])
        return np.clip(self.coordinates.to_s(np.clip(theta, *self.coordinates.to_theta(self.box))), self.box[0] + margin,
                       self.box[1] - margin)

    def prior_terms(self, s: Array) -> tuple[Array, Array]:
        """Gradient and (non-negative) curvature (P,) of minus the log prior in s."""
        h = 1e-4 * (self.box[1] - self.box[0])
        middle = np.clip(s, self.box[0] + h, self.box[1] - h)
        points = np.concatenate([middle[None], middle + np.diag(h), middle - np.diag(h)])
        values = -log_prior(self.coordinates, self.priors, points)
        up, down = values[1:1 + len(s)], values[1 + len(s):]
        return (up - down) / (2 * h), np.maximum((up - 2 * values[0] + down) / h**2, 0.0)

    def values(self, x: Array, refine: int = 1, bare: bool = False) -> Array:
        """E (S, N) of (s, states) (S, P + U)."""
        count = len(self.priors)
        theta = np.clip(self.coordinates.to_theta(x[:, :count]), *self.error.problem.bounds.T)
        out = np.concatenate([self.error.difference(theta[i:i + BATCH], x[i:i + BATCH, count:], refine) for i in range(0, len(x), BATCH)])
        return np.asarray(out if bare or self.missing is None else out + self.missing)

    def cost(self, x: Array, errors: Array, noise: Noise) -> Array:
        """Minus the log posterior (S,), infinite where the simulation failed or the prior is zero."""
        count = len(self.priors)
        fine = np.isfinite(errors).all(axis=1)
        out = np.full(len(x), np.inf)
        if fine.any():
            out[fine] = (0.5 * np.sum(noise.whiten(errors[fine]) ** 2, axis=1) + 0.5 * np.sum((x[fine, count:] / STATE_SD) ** 2, axis=1)
                         - log_prior(self.coordinates, self.priors, x[fine, :count]))
        return out

    def descend(self, s: Array, states: Array | None, noise: Noise, adapt: bool = False) -> tuple[Expansion, float] | None:
        """The mode from a start; None if it cannot be simulated. ``adapt``: white noise whose level follows the error."""
        count, extra = len(s), self.error.size[1]
        x = np.concatenate([s, np.zeros(extra) if states is None else states])
        move = STEP * np.concatenate([self.spread, np.ones(extra)])
        now = self.values(x[None])[0]
        if not np.isfinite(now).all():
            return None
        slope = np.zeros((len(now), len(x)))
        damping = 1e-6
        for _ in range(ITERATIONS):
            noise = _rescaled(noise, now) if adapt else noise
            slope = self.slope(x, now, move)
            step, decrement = self._newton(x, slope, now, noise, damping)
            if decrement < SETTLED:
                break
            trials = x + np.array(FRACTIONS)[:, None] * step
            trials[:, :count] = np.clip(trials[:, :count], *self.box)
            errors = self.values(trials)
            costs, before = self.cost(trials, errors, noise), self.cost(x[None], now[None], noise)[0]
            pick = int(np.argmin(costs))
            if not costs[pick] < before:
                damping *= 1e3
                if damping > 1e4:
                    break
                continue
            damping = max(1e-6, damping * (0.1 if pick == 0 else 3.0))
            x, now = trials[pick], errors[pick]
        cost = float(self.cost(x[None], now[None], noise)[0]) if not adapt else float(np.sum(now**2))
        empty = np.zeros((extra, count))
        return Expansion(x[:count], x[count:], now, slope, empty, np.zeros((count, count)), np.zeros(count)), cost

    def slope(self, x: Array, now: Array, move: Array) -> Array:
        """dE/dx (N, P + U) by one-sided differences that stay in the box."""
        count = len(self.priors)
        signed = move.copy()
        signed[:count] = np.where(x[:count] + move[:count] <= self.box[1], move[:count], -move[:count])
        with np.errstate(invalid="ignore"):
            out = ((self.values(x + np.diag(signed)) - now) / signed[:, None]).T
        return np.where(np.isfinite(out).all(axis=0), out, 0.0)

    def _newton(self, x: Array, slope: Array, now: Array, noise: Noise, damping: float) -> tuple[Array, float]:
        """Step and squared Newton decrement; entries held that a bound stops."""
        count = len(self.priors)
        z, g = noise.whiten(now), noise.whiten(slope.T)
        gradient, curvature = g @ z, g @ g.T
        slope_p, bend = self.prior_terms(x[:count])
        gradient[:count] += slope_p
        gradient[count:] += x[count:] / STATE_SD**2
        curvature += np.diag(np.concatenate([np.maximum(bend, 0.01 / self.spread**2), np.full(len(x) - count, 1 / STATE_SD**2)]))
        loose = np.ones(len(x), dtype=bool)
        edge = 1e-9 * (self.box[1] - self.box[0])
        loose[:count] = ~(((x[:count] <= self.box[0] + edge) & (gradient[:count] > 0))
                          | ((x[:count] >= self.box[1] - edge) & (gradient[:count] < 0)))
        part = curvature[np.ix_(loose, loose)]
        scale = np.sqrt(np.diag(part))
        step = np.zeros(len(x))
        step[loose] = -np.linalg.solve(part / np.outer(scale, scale) + damping * np.eye(len(part)), gradient[loose] / scale) / scale
        return step, float(-gradient @ step)


# -- noise: from white to what is found ----------------------------------------------------------------------------------------------

def _plain_noise(error: OutputError, floors: Sequence[NoiseFloor | None]) -> Noise:
    """White noise of one level per channel, or the measured one; residual terms as nuisance."""
    labels = list(dict.fromkeys((c.name, c.location, c.quantity) for run in error.runs for c in run.recording.channels))
    layouts = []
    for i, run in enumerate(error.runs):
        floor = floors[i] if i < len(floors) else None
        channel = np.array([labels.index((c.name, c.location, c.quantity)) for c in run.recording.channels], dtype=np.intp)
        f, s = run.spectrum.frequency, len(channel)
        measured = np.full((len(f), s), np.nan)
        if floor is not None and floor.sure == "measured":
            measured = _smooth(floor, f) * 0.5 * run.recording.fs / run.scale**2
        layouts.append(Layout(f, channel, _hats(f), measured, (), np.zeros((0, len(f), s)), _orthonormal(residual_terms(run)),
                              np.ones(2 * len(f) * s, dtype=bool)))
    return Noise(tuple(layouts), Levels(np.zeros((len(labels), max(x.hats.shape[1] for x in layouts))), np.zeros(0)),
                 tuple(run.spectrum.information for run in error.runs))


def _smooth(floor: NoiseFloor, frequency: Array) -> Array:
    """Measured density (bins, s), averaged over neighbours: a density from few segments is not to be divided by as it stands."""
    inside = (floor.frequency >= 0.7 * frequency[0]) & (floor.frequency <= 1.4 * frequency[-1])
    f, psd = floor.frequency[inside], floor.psd[inside]
    if len(f) < 8:
        return np.maximum(floor.at(frequency), 1e-300)
    width = max(1, len(f) // 12)
    kernel = np.hanning(2 * width + 3)[1:-1]
    padded = np.pad(psd, ((width, width), (0, 0)), mode="reflect" if len(f) > width else "edge")
    smooth = np.stack([np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T], axis=1)
    return np.maximum(np.stack([np.interp(frequency, f, column) for column in smooth.T], axis=1), 1e-300)


def _hats(frequency: Array) -> Array:
    """Hat functions (bins, J) of evenly spaced knots; fewer where there are few frequencies."""
    count = KNOTS if len(frequency) >= 48 else 2 if len(frequency) >= 12 else 1
    if count == 1:
        return np.ones((len(frequency), 1))
    at = np.linspace(frequency[0], frequency[-1], count)
    return np.stack([np.interp(frequency, at, row) for row in np.eye(count)], axis=1)


def _orthonormal(columns: Array) -> Array:
    if not columns.size:
        return columns
    left, values, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return np.asarray(left[:, values > 1e-6 * values[0]])


def _rescaled(noise: Noise, error: Array) -> Noise:
    """The same with every channel's level as found in the error: robust, so that a resonance not yet fitted does not set it."""
    knots = np.full(noise.levels.knots.shape, -np.inf)
    for layout, part in zip(noise.layouts, noise.split(error), strict=True):
        power = part.reshape(2, len(layout.frequency), len(layout.channel))
        level = np.log(np.maximum(np.mean(power**2, axis=(0, 1)), 1e-24))
        np.maximum.at(knots, layout.channel, level[:, None])
    layouts = tuple(replace(x, floor=np.full(x.floor.shape, np.nan)) for x in noise.layouts)
    return Noise(layouts, Levels(knots, noise.levels.sources), noise.information)


def _full_noise(error: OutputError, at: Expansion, search: _Search, plain: Noise) -> Noise:
    """Sensor noise started from the quiet lines of the error, and unmeasured force on every mode in the band."""
    modes = forced_modes(error)
    theta = search.coordinates.to_theta(at.s)
    found = unmeasured_force(error, theta, at.states, modes)
    layouts = tuple(replace(layout, columns=u.columns, spill=u.spill) for layout, u in zip(plain.layouts, found, strict=True))
    knots = np.full(plain.levels.knots.shape, -np.inf)
    for layout, part in zip(layouts, plain.split(at.error), strict=True):
        power = np.mean(part.reshape(2, len(layout.frequency), len(layout.channel)) ** 2, axis=0)
        for j, hat in enumerate(layout.hats.T):
            some = power[hat >= 0.5 * hat.max()]
            level = np.log(np.maximum(np.median(some, axis=0) / 0.69, 1e-24))
            np.maximum.at(knots[:, j], layout.channel, level)
        knots[:, layout.hats.shape[1]:] = np.where(np.isfinite(knots[:, layout.hats.shape[1]:]), knots[:, layout.hats.shape[1]:], 0.0)
    sources = []
    for k in range(len(modes)):
        ratio = [1e-300]
        for layout, part in zip(layouts, plain.split(at.error), strict=True):
            if layout.columns[k].size:
                ratio.append(float(np.sum((layout.columns[k].T @ part) ** 2)
                                   / max(np.sum((layout.columns[k].T @ layout.columns[k]) ** 2), 1e-300)))
        sources.append(np.log(0.3 * max(ratio)) if max(ratio) > 1e-300 else -20.0)
    return Noise(layouts, Levels(knots, np.array(sources)), plain.information)


def _with_states(noise: Noise, error: OutputError, at: Expansion) -> Noise:
    """Residual terms and initial states as nuisance directions."""
    count = len(at.s)
    layouts = []
    for layout, run, columns in zip(noise.layouts, error.runs, noise.split(at.slope[:, count:].T), strict=True):
        used = columns[np.linalg.norm(columns, axis=1) > 0].T
        layouts.append(replace(layout, nuisance=_orthonormal(np.concatenate([residual_terms(run), used], axis=1))))
    return replace(noise, layouts=tuple(layouts))


def _without_states(noise: Noise, error: OutputError) -> Noise:
    """Residual terms alone as nuisance, for a search in which initial states are unknowns of their own."""
    return replace(noise, layouts=tuple(replace(layout, nuisance=_orthonormal(residual_terms(run)))
                                        for layout, run in zip(noise.layouts, error.runs, strict=True)))


def _without_outliers(error: OutputError, noise: Noise, at: Expansion) -> tuple[Noise, tuple[str, ...]]:
    """Leave out lines far above the spectrum away from the resonances of the model, three to each side, and say which."""
    layouts, words = [], []
    for run, layout, part in zip(error.runs, noise.layouts, noise.split(at.error), strict=True):
        bins, s = len(layout.frequency), len(layout.channel)
        power = np.mean(part.reshape(2, bins, s) ** 2, axis=0)
        near = np.zeros(bins, dtype=bool)
        for u in layout.spill:
            near |= u.sum(axis=1) == 0
        out = (power > OUTLIER * layout.diagonal(noise.levels).reshape(2, bins, s)[0]) & ~near[:, None]
        for i, channel in enumerate(run.recording.channels):
            if out[:, i].any():
                lines = layout.frequency[out[:, i]]
                words.append(f"{run.recording.name}, {channel.name}: {len(lines)} lines between {lines[0]:.4g} and {lines[-1]:.4g} Hz stand "
                             f"far above the noise and away from the modes of the model; they were left out")
                out[:, i] = np.convolve(out[:, i], np.ones(7), "same") > 0
        out &= ~near[:, None]
        keep = layout.keep & ~np.concatenate([out, out]).ravel()
        layouts.append(replace(layout, keep=keep) if keep.mean() > 0.5 else layout)
    changed = replace(noise, layouts=tuple(layouts))
    return (changed.estimated(at.error), tuple(words)) if words else (noise, ())


# -- the end of the search -----------------------------------------------------------------------------------------------------------

def _marginal(at: Expansion, noise: Noise, search: _Search) -> Expansion:
    """Expansion with initial states marginalised: information, gradient, and how the states follow."""
    count = len(at.s)
    z, g = noise.whiten(at.error), noise.whiten(at.slope[:, :count].T)
    with_states = _without_states(noise, search.error)
    own, states = with_states.whiten(at.slope[:, :count].T), with_states.whiten(at.slope[:, count:].T)
    follow = -np.linalg.lstsq(states.T, own.T, rcond=1e-10)[0] if states.size else np.zeros((len(at.states), count))
    return replace(at, follow=follow, information=g @ g.T, gradient=g @ z)
