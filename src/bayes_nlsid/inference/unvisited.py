"""Have the walkers been where the fit says they should? A check that agreement between ensembles cannot give.

All ensembles may agree and all may have missed the same narrow optimum. So the mass of the posterior around every known optimum is
worked out without walkers, by importance sampling inside an ellipsoid, and held against the share of draws in it. Ratios of masses are
exact whatever the shape of the posterior; only ellipsoids that hold a share worth counting are judged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import chi2

from bayes_nlsid.inference.likelihood import laplace
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.inference.target import Target

Array = NDArray[np.float64]
POINTS = 400            # evaluations for each optimum
INSIDE = 0.9            # share of a normal distribution inside the ellipsoid
FEWEST = 20             # effective evaluations below which a mass is not known
LEAST, FACTOR = 0.02, 3.0    # share of the draws from which an optimum counts; how many times too few are too few


def with_known_optima(found: Posterior, target: Target, middle: Array, seed: int) -> Posterior:
    """The posterior, refused where draws and known optima contradict each other.

    Parameters
    ----------
    found : Posterior
    target : Target
    middle : ndarray (C, P)
        Optima in s.
    seed : int
    """
    if len(middle) < 2 or not len(found.flat) or not found.convergence.converged:
        return found
    reasons = missed(target, middle, target.to_s(found.flat), np.random.default_rng([seed, len(middle)]))
    if not reasons:
        return found
    c = found.convergence
    return replace(found, convergence=replace(c, converged=False, status="not_converged", reasons=(*reasons, *c.reasons)))


def missed(target: Target, middle: Array, s: Array, rng: np.random.Generator) -> tuple[str, ...]:
    """One sentence for every optimum (C, P) that holds more of the posterior than of the draws s (N, P)."""
    regions = [_region(target, at, s, rng) for at in middle]
    log_mass, share = np.array([r[0] for r in regions]), np.array([r[1] for r in regions])
    judge = int(np.argmax(share))
    if share[judge] < LEAST or not np.isfinite(log_mass[judge]):
        return ()
    out = []
    for k in range(len(middle)):
        expected = share[judge] * np.exp(min(log_mass[k] - log_mass[judge], 50.0))
        # what the draws lack, the judge has too much of
        expected /= 1 + max(expected - share[k], 0.0)
        if k != judge and expected > LEAST and share[k] < expected / FACTOR:
            out.append(f"an optimum that the fit knows should hold {100 * min(expected, 1.0):.2g} % of the draws and holds "
                       f"{100 * share[k]:.2g} %: the walkers have missed it; raise steps, or start from more ensembles")
    return tuple(out)


def _region(target: Target, at: Array, s: Array, rng: np.random.Generator) -> tuple[float, float]:
    """log of the posterior mass in the ellipsoid around a point, up to the same constant for all, and the share of draws in it."""
    size = len(at)
    covariance = laplace(target.likelihood, target.to_theta(at), target.prior_sd, target.coordinates)
    root = np.linalg.cholesky(covariance + 1e-14 * np.diag(target.prior_sd**2))
    radius = np.sqrt(chi2.ppf(INSIDE, size))
    z = rng.standard_normal((POINTS, size))
    z = z[np.linalg.norm(z, axis=1) <= radius]
    log = target(at + z @ root.T) + 0.5 * np.sum(z**2, axis=1)
    inside = float(np.mean(np.linalg.norm(np.linalg.solve(root, (s - at).T), axis=0) <= radius))
    if not np.isfinite(log).any() or 2 * logsumexp(log) - logsumexp(2 * log) < np.log(FEWEST):
        return -np.inf, inside      # a sum of a few large weights is no mass
    return float(logsumexp(log) - np.log(len(z)) + np.sum(np.log(np.diag(root)))), inside
