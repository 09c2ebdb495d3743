"""Where the walkers begin: around every plausible optimum of the multi-start fit, as wide as the local covariance, inside the bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.likelihood import Likelihood, laplace
from bayes_nlsid.inference.prior import sample_priors
from bayes_nlsid.inference.target import Target

Array = NDArray[np.float64]
DEPTH = 30.0   # log units (plus P) below the best optimum at which another is not worth a walker


def centres(target: Target, fits: tuple[Fit, ...]) -> Array:
    """Distinct optima (C, P) in s, best first, of all fits given; those far less probable than the best are left out."""
    points: list[Array] = []
    for found in fits:
        for theta in (found.theta, *(x.theta for x in found.optima())):
            if np.isfinite(theta).all():
                points.append(_inside(target, target.to_s(theta)))
    if not points:
        return np.zeros((0, len(target.priors)))
    s = np.array(points)
    value = target(s)
    order = [i for i in np.argsort(-value, kind="stable") if value[i] > value.max() - DEPTH - s.shape[1]]
    width = target.box[1] - target.box[0]
    kept: list[int] = []
    for i in order:
        if all(np.max(np.abs(s[i] - s[j]) / width) > 1e-3 for j in kept):
            kept.append(i)
    return s[kept]


def _inside(target: Target, s: Array) -> Array:
    """A point moved off the bounds by a thousandth of the box."""
    margin = 1e-3 * (target.box[1] - target.box[0])
    return np.clip(s, target.box[0] + margin, target.box[1] - margin)


def first_walkers(target: Target, middle: Array, count: int, seeds: list[np.random.SeedSequence]) -> list[tuple[Array, Array]]:
    """Positions (W, P) in s and log densities (W,) for every ensemble.

    Each walker takes one of the optima at random and a step from a normal distribution of twice the local covariance (information of the
    likelihood plus that of the prior, so that it exists in every direction). A step that leaves the bounds or meets zero density is drawn
    again, shorter each time.

    Raises
    ------
    InputError
        If no finite log density is found.
    """
    spread = target.prior_sd
    roots = [_root(laplace(target.likelihood, target.to_theta(s), spread, target.coordinates)) for s in middle]
    out = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        if len(middle):
            which = rng.integers(len(middle), size=count)
            s = _scatter(target, middle[which], np.array(roots)[which], rng)
        else:
            s = target.to_s(sample_priors(target.priors, count, rng))
        value = target(s)
        if not np.isfinite(value).any():
            raise InputError("sampling", "no point near the fit has a finite posterior density", "check bounds, priors and force laws")
        good = np.flatnonzero(np.isfinite(value))
        lost = np.flatnonzero(~np.isfinite(value))
        taken = rng.choice(good, len(lost))
        s[lost], value[lost] = s[taken], value[taken]
        out.append((s, value))
    return out


def _scatter(target: Target, middle: Array, roots: Array, rng: np.random.Generator) -> Array:
    s = middle.copy()
    open_rows = np.arange(len(s))
    scale = np.sqrt(2.0)
    for _ in range(25):
        trial = middle[open_rows] + scale * np.einsum("wij,wj->wi", roots[open_rows], rng.normal(size=(len(open_rows), s.shape[1])))
        trial = np.clip(trial, target.box[0], target.box[1]) if scale < 0.05 else trial
        fine = np.isfinite(target(trial))
        s[open_rows[fine]] = trial[fine]
        open_rows = open_rows[~fine]
        if not len(open_rows):
            break
        scale *= 0.8
    return s


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def starting_fits(fit: Fit, likelihood: Likelihood) -> tuple[Fit, ...]:
    """The fit that was given, and the refit that the likelihood made for itself, if it did."""
    own = getattr(likelihood, "fit", None)
    return (own, fit) if isinstance(own, Fit) and own is not fit else (fit,)
