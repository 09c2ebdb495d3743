"""Where the walkers begin: around every plausible optimum of the multi-start fit, as wide as the local covariance, inside the bounds; and
the first proposal that they share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.likelihood import Likelihood, laplace
from bayes_nlsid.inference.prior import sample_priors
from bayes_nlsid.inference.proposal import Proposal, learn_proposal
from bayes_nlsid.inference.target import Target

Array = NDArray[np.float64]
LESSON = 4       # draws for each that is to be kept, of which a first proposal is learnt
ROUNDS, FINE = 18, 0.3   # rounds of learning, and the acceptance at which it is good enough
FAIR, MORE = 0.1, 4      # acceptance from which so many times the draws are worth taking, in the last rounds
HOLDS = 4.0      # log units that a parameter may lose when it is moved by itself
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


def first_walkers(target: Target, around: tuple[Array, Array], count: int,
                  seeds: list[np.random.SeedSequence]) -> list[tuple[Array, Array]]:
    """Positions (W, P) in s and log densities (W,) for every ensemble.

    Each walker takes one of the neighbourhoods at random and a step from a normal distribution of twice its covariance, in the coordinates
    of the walk. A step that leaves the bounds or leads far down is drawn again, shorter each time.

    Raises
    ------
    InputError
        If no finite log density is found.
    """
    middle, roots = around
    out = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        if len(middle):
            which = rng.integers(len(middle), size=count)
            s = _scatter(target, middle[which], roots[which], rng)
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


def neighbourhoods(target: Target, middle: Array) -> tuple[Array, Array]:
    """Centre (C, P) and root of the covariance (C, P, P) around each optimum (C, P), in coordinates of the walk.

    The curvature at an optimum that noise has pushed to a wall (a slip just within the largest motion) tells of a parameter that is not
    informed beyond it. So each parameter is also moved by itself as far as the density holds, and what it can move is added.
    """
    spread = target.walk_sd
    places, roots = np.empty_like(middle), np.empty((len(middle), *2 * (len(spread),)))
    for c, s in enumerate(middle):
        covariance = laplace(target.likelihood, target.to_theta(s), spread, target.coordinates, target.ridges.turn(s))
        places[c], added = _reach(target, target.ridges.to_walk(s), np.sqrt(np.diag(covariance)), spread)
        roots[c] = _root(covariance + np.diag(added))
    return places, roots


def _reach(target: Target, z: Array, sd: Array, spread: Array) -> tuple[Array, Array]:
    """Centre (P,) and added variance (P,): where each entry of z (P,) can go, the others held, without losing ``HOLDS`` of log density."""
    place, added = z.copy(), np.zeros(len(z))
    for i in np.flatnonzero(4 * sd < spread):
        steps = sd[i] * 2.0 ** np.arange(np.log2(4 * spread[i] / sd[i]))
        trial = np.repeat(place[None], 1 + 2 * len(steps), axis=0)
        trial[1:, i] += np.concatenate([steps, -steps])
        value = target.along(trial)
        holds = (value[1:] > value[0] - HOLDS).reshape(2, -1)
        up, down = (steps[np.argmin(side) - 1] if not side.all() else steps[-1] for side in holds)
        up, down = up if holds[0, 0] else 0.0, down if holds[1, 0] else 0.0
        if max(up, down) > 4 * sd[i]:
            place[i] += 0.5 * (up - down)
            added[i] = (0.25 * (up + down)) ** 2
    return place, added


def _worth(target: Target, middle: Array) -> Array:
    """Log density below which a point around a centre (C, P) is no place to begin."""
    return np.asarray(np.nan_to_num(target.along(middle), nan=-np.inf, neginf=-np.inf) - DEPTH - 2 * middle.shape[1])


def first_proposal(target: Target, around: tuple[Array, Array], seed: np.random.SeedSequence) -> Proposal | None:
    """A proposal learnt before any walker moves, by adaptive importance sampling (Cappé et al. 2004).

    Draws from the normal distributions around the optima teach the first; draws from that one, kept in proportion to their weights as far
    as enough of them remain, the next, and so on until an independence chain would accept a third. It costs less than the first steps of
    a chain and is only ever a proposal.

    Parameters
    ----------
    target : Target
    around : tuple of ndarray
        As ``neighbourhoods`` gives it.
    seed : SeedSequence

    Returns
    -------
    Proposal or None
        None without optima, or where the draws teach nothing.
    """
    draw, learn = seed.spawn(2)
    rng, size = np.random.default_rng(draw), len(target.priors)
    wanted = max(200, 3 * size * (size + 3))
    middle, roots = around
    if not len(middle):
        return None
    which = rng.integers(len(middle), size=LESSON * wanted)
    z = middle[which] + np.einsum("wij,wj->wi", roots[which], rng.normal(size=(len(which), size)))
    kept = z[target.along(z) >= _worth(target, middle)[which]]
    best, highest, large = None, 0.0, 0
    for _ in range(ROUNDS):
        proposal = learn_proposal(kept, learn)
        if proposal is None:
            break
        z = proposal.sample(LESSON * wanted, rng)
        log = target.along(z) - proposal.log_density(z)
        accepted = _accepted(log)
        if accepted >= highest:
            best, highest = replace(proposal, accepted=accepted), accepted
        if accepted > FINE or large == 3 or not np.isfinite(log).any():
            break
        kept = z[rng.uniform(size=len(z)) < np.exp(np.minimum(log - _level(log, wanted), 0.0))]
        if accepted > FAIR or large:
            wanted, large = MORE * wanted if large == 0 else wanted, large + 1
    return best


def _accepted(log: Array) -> float:
    """Share of proposals that an independence chain with the logarithms of these weights would accept."""
    weight = np.sort(np.exp(log - log.max(initial=-np.inf))) if np.isfinite(log).any() else np.zeros(1)
    total = weight.sum()
    # the mean over pairs of the smaller weight: the i-th smallest is the smaller one of all pairs with larger ones
    return float(np.sum(weight * (2 * np.arange(len(weight))[::-1] + 1)) / len(weight) / total) if total > 0 else 0.0


def _level(log: Array, wanted: int) -> float:
    """Log weight beyond which all are kept, so that about so many remain of them."""
    finite = np.sort(log[np.isfinite(log)])
    low, high = finite[0] - 1.0, finite[-1]
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.exp(np.minimum(finite - middle, 0.0)).sum() > wanted else (low, middle)
    return float(low)


def _scatter(target: Target, middle: Array, roots: Array, rng: np.random.Generator) -> Array:
    z, low = middle.copy(), _worth(target, middle)
    open_rows = np.arange(len(z))
    scale = np.sqrt(2.0)
    for _ in range(25):
        step = scale * np.einsum("wij,wj->wi", roots[open_rows], rng.normal(size=(len(open_rows), z.shape[1])))
        trial = middle[open_rows] + step
        value = target.along(trial)
        fine = np.isfinite(value) & (value >= low[open_rows])
        z[open_rows[fine]] = trial[fine]
        open_rows = open_rows[~fine]
        if not len(open_rows):
            break
        scale *= 0.8
    return target.ridges.to_s(z)


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def starting_fits(fit: Fit, likelihood: Likelihood) -> tuple[Fit, ...]:
    """The fit that was given, and the refit that the likelihood made for itself, if it did."""
    own = getattr(likelihood, "fit", None)
    return (own, fit) if isinstance(own, Fit) and own is not fit else (fit,)
