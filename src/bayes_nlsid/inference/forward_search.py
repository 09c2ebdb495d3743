"""The mode of the posterior of simulated recordings: damped Gauss–Newton in parameters and initial states."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.output_error import OutputError
from bayes_nlsid.inference.covariance import Noise
from bayes_nlsid.inference.forward_noise import Expansion, rescaled, without_states
from bayes_nlsid.inference.prior import Prior, log_prior, sampling_coordinates

Array = NDArray[np.float64]
STEP = 1e-3             # of the prior's standard deviation, or of the state's size: a numerical derivative
FRACTIONS = (1.0, 0.5, 0.25, 0.06, 0.01)
SETTLED = 0.01          # Newton decrement, squared posterior standard deviations, at which a search stops
ITERATIONS = 12
STATE_SD = 10.0         # prior of an initial state, in units of the motion's size
FINER = 8               # times the steps of a run that tells the integrator's error
BATCH = 64


@final
@dataclass(frozen=True, eq=False)
class Search:
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

    def corrected(self, at: Expansion) -> Search:
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
            noise = rescaled(noise, now) if adapt else noise
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


def marginal(at: Expansion, noise: Noise, search: Search) -> Expansion:
    """Expansion with initial states marginalised: information, gradient, and how the states follow."""
    count = len(at.s)
    z, g = noise.whiten(at.error), noise.whiten(at.slope[:, :count].T)
    with_states = without_states(noise, search.error)
    own, states = with_states.whiten(at.slope[:, :count].T), with_states.whiten(at.slope[:, count:].T)
    follow = np.zeros((len(at.states), count))
    if states.size:
        follow = -np.asarray(np.linalg.lstsq(states.T, own.T, rcond=1e-10)[0], dtype=float)
    return replace(at, follow=follow, information=g @ g.T, gradient=g @ z)
