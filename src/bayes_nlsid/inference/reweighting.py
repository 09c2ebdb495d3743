"""Posterior of a likelihood that is dear: sample a cheap stand-in, then weight its draws by the true one.

The stand-in is the quadratic expansion of the simulated likelihood around its optimum, with the prior exact. Its draws are weighted by
true simulations, the weights Pareto-smoothed, and their shape k-hat says whether that is allowed. If not, the stand-in learns from the
simulations already made (a polynomial in the distance from the optimum) and is sampled again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.arviz_export import pareto_smoothed
from bayes_nlsid.inference.convergence import LEAST_ESS, Convergence
from bayes_nlsid.inference.ensemble import MOST_STEPS, sample
from bayes_nlsid.inference.forward import ForwardLikelihood
from bayes_nlsid.inference.likelihood import Likelihood, WhittleLikelihood, laplace
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.inference.prior import Prior, log_prior
from bayes_nlsid.inference.target import Target

Array = NDArray[np.float64]
WORST_SHAPE = 0.7       # k-hat beyond which weights are refused
DRAWS, TRIES = 1000, 3
FREEDOM, WIDEN = 7.0, 1.1    # of the multivariate t around the optimum; factor on its scale
RIDGE = 1e-3
Progress = Callable[[float, str], None]


@final
@dataclass(frozen=True, eq=False)
class Weighted:
    """Draws (S, P) with weights (S,) that sum to one, log-likelihoods (S,), k-hat and effective number."""

    theta: Array = field(repr=False)
    weights: Array = field(repr=False)
    log_likelihood: Array = field(repr=False)
    shape: float

    @property
    def effective(self) -> float:
        """1/Σ w²."""
        total = float(np.sum(self.weights**2))
        return 1 / total if total > 0 else 0.0

    def quantiles(self, probabilities: ArrayLike) -> Array:
        """(len(probabilities), P)."""
        order = np.argsort(self.theta, axis=0)
        values = np.take_along_axis(self.theta, order, axis=0)
        share = np.cumsum(self.weights[order], axis=0) - 0.5 * self.weights[order]
        asked = np.asarray(probabilities, dtype=float)
        return np.stack([np.interp(asked, share[:, i], values[:, i]) for i in range(values.shape[1])], axis=1)

    def resampled(self, count: int, rng: np.random.Generator) -> Array:
        """``count`` equally weighted draws (count, P), systematic resampling in random order."""
        place = (np.arange(count) + rng.uniform()) / count
        index = np.minimum(np.searchsorted(np.cumsum(self.weights), place), len(self.weights) - 1)
        return np.asarray(self.theta[rng.permutation(index)])


def around_optimum(likelihood: ForwardLikelihood, priors: Sequence[Prior], draws: int = 400, seed: int = 0) -> Weighted:
    """Posterior by importance sampling from a multivariate t around the optimum: no chain, hence quick; for well-informed parameters.

    Parameters
    ----------
    likelihood : ForwardLikelihood
    priors : sequence of Prior
        In the order of theta.
    draws : int
        Simulations.
    seed : int
    """
    rng = np.random.default_rng(seed)
    target = Target(likelihood, tuple(priors), likelihood.coordinates)
    at, size = likelihood.expansion, len(priors)
    root = np.linalg.cholesky(np.linalg.inv(at.information + np.diag(1 / target.prior_sd**2))) * WIDEN
    z = rng.standard_normal((draws, size)) / np.sqrt(rng.chisquare(FREEDOM, size=(draws, 1)) / FREEDOM)
    s = at.s + z @ root.T
    inside = ((s >= target.box[0]) & (s <= target.box[1])).all(axis=1)
    theta = likelihood.coordinates.to_theta(np.clip(s, *target.box))
    value = np.full(draws, -np.inf)
    value[inside] = likelihood.log_likelihood(theta[inside])
    proposal = -0.5 * (FREEDOM + size) * np.log1p(np.sum(z**2, axis=1) / FREEDOM)
    prior = log_prior(likelihood.coordinates, priors, np.clip(s, *target.box), theta)
    with np.errstate(invalid="ignore"):
        weights, shape = pareto_smoothed(np.where(inside & np.isfinite(value), value + prior - proposal, -np.inf))
    return Weighted(theta, weights, value, shape)


def around_fit(likelihood: WhittleLikelihood, priors: Sequence[Prior], draws: int = 1000, seed: int = 0) -> Weighted:
    """The same for the regression's likelihood, around its own fit."""
    rng = np.random.default_rng(seed)
    target = Target(likelihood, tuple(priors))
    size, centre = len(priors), np.clip(target.to_s(likelihood.fit.theta), *target.box)
    root = np.linalg.cholesky(laplace(likelihood, likelihood.fit.theta, target.prior_sd, target.coordinates)
                              + 1e-12 * np.diag(target.prior_sd**2)) * WIDEN
    z = rng.standard_normal((draws, size)) / np.sqrt(rng.chisquare(FREEDOM, size=(draws, 1)) / FREEDOM)
    s = centre + z @ root.T
    value = target(s)
    with np.errstate(invalid="ignore"):
        weights, shape = pareto_smoothed(value + 0.5 * (FREEDOM + size) * np.log1p(np.sum(z**2, axis=1) / FREEDOM))
    return Weighted(target.to_theta(np.clip(s, *target.box)), weights, value, shape)


@final
class Surrogate(Likelihood):
    """The quadratic expansion of a simulated likelihood, and a polynomial that corrects it once there is something to learn from."""

    def __init__(self, exact: ForwardLikelihood, learnt: _Polynomial | None = None) -> None:
        self.exact, self.learnt = exact, learnt
        at = exact.expansion
        self._level = float(exact.noise.log_normalisation - 0.5 * np.sum(exact.noise.whiten(at.error) ** 2))

    @property
    def problem(self) -> Problem:
        """Whose parameters it reads."""
        return self.exact.problem

    @property
    def fit(self) -> Fit:
        """The optimum as a fit, from which walkers start."""
        theta = self.exact.coordinates.to_theta(self.exact.expansion.s)
        size = len(theta)
        return Fit(theta, self.problem.to_s(theta), 0.0, np.eye(size), size, (), "ok", (), self.problem, self.problem.weight, 0)

    @property
    def weights(self) -> Array:
        """What the expansion consists of: identifies it."""
        at = self.exact.expansion
        learnt = self.learnt.coefficients if self.learnt is not None else np.zeros(0)
        return np.concatenate([at.s, at.gradient, at.information.ravel(), learnt])

    @property
    def blocks(self) -> tuple[str, ...]:
        """One."""
        return ("all",)

    def log_likelihood(self, theta: ArrayLike) -> Array:
        """(W,) of theta (W, P)."""
        at = self.exact.expansion
        move = self.exact.coordinates.to_s(np.asarray(theta, dtype=float)) - at.s
        value = self._level - move @ at.gradient - 0.5 * np.einsum("wi,ij,wj->w", move, at.information, move)
        return np.asarray(value if self.learnt is None else value + self.learnt(move))

    def by_block(self, theta: ArrayLike) -> Array:
        """(W, 1)."""
        return self.log_likelihood(theta)[:, None]

    def curvature(self, theta: NDArray[np.float64], coordinates: Coordinates) -> NDArray[np.float64]:
        """That of the exact likelihood at its optimum."""
        return self.exact.curvature(theta, coordinates)

    def describe(self) -> str:
        """In words."""
        return self.exact.describe()

    def taught(self, theta: Array, true: Array, target: Target) -> Surrogate:
        """The same with what true log-likelihoods (S,) at theta (S, P) add to the expansion."""
        bare = Surrogate(self.exact)
        move = self.exact.coordinates.to_s(theta) - self.exact.expansion.s
        fine = np.isfinite(true)
        height = true + log_prior(self.exact.coordinates, target.priors, self.exact.coordinates.to_s(theta), theta)
        near = fine & (height > np.max(height[fine]) - 4 * (3 + theta.shape[1]))
        if near.sum() < 2 * theta.shape[1] + 10:
            return self
        return Surrogate(self.exact, _fitted(move[near], (true - bare.log_likelihood(theta))[near]))


@final
@dataclass(frozen=True, eq=False)
class _Polynomial:
    """Polynomial (degree 2, or 3 where there are points enough) in standardised moves, constant beyond the radius it was fitted in."""

    middle: Array
    root: Array
    radius: float
    degree: int
    coefficients: Array

    def __call__(self, move: Array) -> Array:
        z = (move - self.middle) @ self.root
        size = np.linalg.norm(z, axis=1)
        return _features(z * np.minimum(1.0, self.radius / np.maximum(size, 1e-300))[:, None], self.degree) @ self.coefficients


def _features(z: Array, degree: int) -> Array:
    columns = [np.ones(len(z))]
    for d in range(1, degree + 1):
        columns += [np.prod(z[:, list(i)], axis=1) for i in combinations_with_replacement(range(z.shape[1]), d)]
    return np.stack(columns, axis=1)


def _fitted(move: Array, difference: Array) -> _Polynomial:
    middle = move.mean(axis=0)
    root: Array = np.linalg.inv(np.linalg.cholesky(np.cov(move.T).reshape(move.shape[1], -1)
                                            + 1e-12 * np.diag(move.var(axis=0) + 1e-300))).T
    z = (move - middle) @ root
    degree = 3 if len(_features(z[:1], 3)[0]) * 3 < len(z) else 2
    design = _features(z, degree)
    penalty = RIDGE * len(z) * np.eye(design.shape[1])
    penalty[0, 0] = 0.0
    coefficients = np.asarray(np.linalg.solve(design.T @ design + penalty, design.T @ difference), dtype=float)
    return _Polynomial(middle, np.asarray(root, dtype=float), float(np.quantile(np.linalg.norm(z, axis=1), 0.98)), degree, coefficients)


def forward_posterior(fit: Fit, likelihood: ForwardLikelihood, priors: Sequence[Prior], *, draws: int = DRAWS, ensembles: int = 4,
                      walkers: int | None = None, steps: int | None = None, most: int = MOST_STEPS, seed: int = 0,
                      store: Path | None = None, progress: Progress | None = None, workers: int = 1) -> tuple[Posterior, Weighted]:
    """Sample the stand-in with ensembles of walkers, weight ``draws`` of them by simulation, learn and repeat while k-hat is above 0.7.

    Parameters
    ----------
    fit : Fit
        Of the regression.
    likelihood : ForwardLikelihood
    priors : sequence of Prior
    draws : int
        True simulations for each try.
    ensembles, walkers, steps, most, seed, store, progress, workers
        As in ``sample``.

    Returns
    -------
    Posterior
        Of equally weighted draws; ``status`` "not_converged" where the chains did not converge or the weights cannot be relied on.
    Weighted
        The last weighting.

    Raises
    ------
    KeyboardInterrupt
        If the chains were stopped: half a posterior is not a result.
    """
    surrogate = Surrogate(likelihood)
    target = Target(surrogate, tuple(priors))
    seeds = np.random.SeedSequence(seed).spawn(TRIES)
    for i in range(TRIES):
        def tell(share: float, sentence: str, i: int = i) -> None:
            if progress is not None:
                progress((i + 0.8 * share) / TRIES, sentence)

        chain = sample(surrogate.fit, likelihood=surrogate, priors=priors, ensembles=ensembles, walkers=walkers, steps=steps, most=most,
                       seed=int(seeds[i].generate_state(1)[0]), store=None if store is None else store / f"try{i}", progress=tell,
                       workers=workers)
        if any("stopped from the keyboard" in reason for reason in chain.reasons):
            raise KeyboardInterrupt
        if not len(chain.flat):
            break
        tell(1.0, f"{draws} draws simulated")
        theta = _spread(chain, draws)
        true = likelihood.log_likelihood(theta)
        weights, shape = pareto_smoothed(np.where(np.isfinite(true), true - surrogate.log_likelihood(theta), -np.inf))
        found = Weighted(theta, weights, true, shape)
        if shape <= WORST_SHAPE and found.effective >= LEAST_ESS:
            break
        surrogate = surrogate.taught(theta, true, target)
    else:
        i = TRIES - 1
    if not len(chain.flat):
        return chain, Weighted(np.zeros((0, len(priors))), np.zeros(0), np.zeros(0), float("inf"))
    return _equal(chain, found, likelihood, priors, np.random.default_rng(seeds[i].spawn(1)[0])), found


def _spread(chain: Posterior, count: int) -> Array:
    """Draws (count, P) evenly over the chain, ensemble by ensemble."""
    flat = chain.theta.transpose(1, 2, 0, 3).reshape(-1, chain.theta.shape[-1])
    return np.asarray(flat[np.linspace(0, len(flat) - 1, min(count, len(flat))).round().astype(int)])


def _equal(chain: Posterior, found: Weighted, likelihood: ForwardLikelihood, priors: Sequence[Prior],
           rng: np.random.Generator) -> Posterior:
    """Posterior of equally weighted draws with the diagnostics of chain and weights together."""
    ensembles = chain.theta.shape[0]
    count = len(found.theta) // ensembles * ensembles
    weights = found.weights if found.weights.sum() > 0 else np.full(len(found.theta), 1 / len(found.theta))
    place = (np.arange(count) + rng.uniform()) / count
    index = rng.permutation(np.minimum(np.searchsorted(np.cumsum(weights), place), len(weights) - 1))
    theta = found.theta[index]
    s = likelihood.coordinates.to_s(theta)
    density = found.log_likelihood[index] + log_prior(likelihood.coordinates, priors, s, theta)
    c, reasons = chain.convergence, list(chain.reasons)
    trusted = found.shape <= WORST_SHAPE and found.effective >= LEAST_ESS
    if not trusted:
        reasons.insert(0, f"weights of the simulated likelihood are not to be trusted (k-hat {found.shape:.2f}, limit {WORST_SHAPE}; "
                          f"{found.effective:.0f} effective of {len(found.theta)} draws): the posterior is far from normal, or has "
                          "another optimum")
    converged = c.converged and trusted
    contraction = 1 - s.std(axis=0) / Target(likelihood, tuple(priors), likelihood.coordinates).prior_sd
    fields: dict[str, object] = {"converged": converged, "status": c.status if converged else "not_converged",
                                 "reasons": tuple(reasons), "ess": np.minimum(c.ess, found.effective),
                                 "ess_min": min(c.ess_min, found.effective), "contraction": contraction, "walkers": 1,
                                 "acceptance": c.acceptance.mean(axis=1, keepdims=True)}
    convergence: Convergence = replace(c, **fields)  # type: ignore[arg-type]
    return replace(chain, theta=theta.reshape(ensembles, -1, 1, theta.shape[1]), log_prob=density.reshape(ensembles, -1, 1),
                   convergence=convergence)
