"""Which parameter the scatter comes from: Sobol indices with confidence intervals, their like for dependent parameters, convergence.

The first-order index of a parameter is the share of the variance that would go if it were known; the total index the share that would stay
if everything else were known. For independent parameters both are estimated as by Saltelli et al. (2010, ``scipy.stats.sobol_indices``).
Draws of a posterior hang together, so that these formulas do not hold; there the same two shares are read off a regression of the output
on the draws, quadratic in the parameters (Kucherenko, Tarantola and Annoni 2012 for their meaning). Intervals are those of a bootstrap over
the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.prediction.bands import quantiles

Array = NDArray[np.float64]
RESAMPLES = 200
CONFIDENCE = 0.9
MOST_FEATURES = 150
ENOUGH = 0.9


@final
@dataclass(frozen=True)
class Indices:
    """Shares of the variance of outputs along an axis.

    Parameters
    ----------
    first, total : ndarray (3, d, K)
        Estimate, and the ends of its 90 % confidence interval; NaN where too few samples have a value.
    explained : ndarray (K,)
        Share of the variance that the method accounts for: 1 for Sobol indices, that of the regression for dependent parameters.
    samples : int
        Base points that entered.
    """

    first: Array
    total: Array
    explained: Array
    samples: int


def sobol(f_A: Array, f_B: Array, f_AB: Array, seed: int) -> Indices:
    """Sobol indices with confidence intervals.

    Parameters
    ----------
    f_A, f_B : ndarray (n, K)
        Outputs at two independent sets of points.
    f_AB : ndarray (d, n, K)
        At the points A with parameter d taken from B.
    seed : int
        Of the bootstrap.

    Returns
    -------
    Indices
        Of the largest power of two of points whose outputs are all finite, where at least 90 % of the points have one.
    """
    from scipy.stats import sobol_indices

    d, n, k = f_AB.shape
    finite = np.isfinite(f_A) & np.isfinite(f_B) & np.isfinite(f_AB).all(axis=0)
    shown = finite.mean(axis=0) >= ENOUGH
    empty = np.full((3, d, k), np.nan)
    rows = np.flatnonzero(finite[:, shown].all(axis=1)) if shown.any() else np.zeros(0, dtype=int)
    if len(rows) < 16:
        return Indices(empty, empty.copy(), np.full(k, np.nan), 0)
    rows = rows[:2 ** int(np.log2(len(rows)))]
    a, b, ab = f_A[rows][:, shown], f_B[rows][:, shown], f_AB[:, rows][:, :, shown]
    found = sobol_indices(func={"f_A": a.T, "f_B": b.T, "f_AB": ab.transpose(0, 2, 1)}, n=len(rows))
    first, total = empty, empty.copy()
    first[0][:, shown], total[0][:, shown] = (np.reshape(v, (shown.sum(), d)).T for v in (found.first_order, found.total_order))
    middle = 0.5 * (a.mean(axis=0) + b.mean(axis=0))
    a, b, ab = a - middle, b - middle, ab - middle
    share = np.random.default_rng(seed).multinomial(len(rows), np.full(len(rows), 1 / len(rows)), size=RESAMPLES) / len(rows)
    variance = 0.5 * share @ (a**2 + b**2) - (0.5 * share @ (a + b)) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        for index, part in ((first, b * (ab - a)), (total, 0.5 * (a - ab) ** 2)):
            again = np.einsum("rn,dnk->rdk", share, part, optimize=True) / variance[:, None]
            again = np.where(np.isfinite(again), again, 0.0)  # no variance, no share
            index[1][:, shown], index[2][:, shown] = np.quantile(again, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], axis=0)
    return Indices(first, total, np.where(shown, 1.0, np.nan), len(rows))


def dependent_shares(x: Array, y: Array, seed: int) -> Indices:
    """The same shares for parameters that depend on each other, by regression on the draws.

    Parameters
    ----------
    x : ndarray (S, d)
        Draws, none of them constant.
    y : ndarray (S, K)
        Outputs; NaN where there is none.
    seed : int

    Returns
    -------
    Indices
        ``explained`` says how much of the variance the regression follows; indices are shares of that part.
    """
    d, k = x.shape[1], y.shape[1]
    empty = np.full((3, d, k), np.nan)
    shown = np.isfinite(y).mean(axis=0) >= ENOUGH
    rows = np.isfinite(y[:, shown]).all(axis=1) & np.isfinite(x).all(axis=1) if shown.any() else np.zeros(len(y), dtype=bool)
    features, owners = _features(x[rows])
    count = int(rows.sum())
    if count < 2 * features.shape[1] + 20:
        return Indices(empty, empty.copy(), np.full(k, np.nan), 0)
    values = y[rows][:, shown]
    whole = np.full(count, 1.0)
    first, total, explained = empty, empty.copy(), np.full(k, np.nan)
    first[0][:, shown], total[0][:, shown], explained[shown] = _shares(features, owners, values, whole)
    rng = np.random.default_rng(seed)
    again = [_shares(features, owners, values, rng.multinomial(count, np.full(count, 1 / count)).astype(float))
             for _ in range(RESAMPLES // 2)]
    for index, which in ((first, 0), (total, 1)):
        spread = np.array([entry[which] for entry in again])
        index[1][:, shown], index[2][:, shown] = np.quantile(spread, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], axis=0)
    return Indices(first, total, explained, count)


def _features(x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Columns 1, z, z², z z' (S, m) of standardised parameters, and which parameter (m, d) each contains; products only while few."""
    z = (x - x.mean(axis=0)) / x.std(axis=0)
    d = z.shape[1]
    columns, owners = [np.ones(len(z))], [np.zeros(d, dtype=bool)]
    pairs = [(i, i) for i in range(d)] + [(i, j) for i in range(d) for j in range(i)]
    for i, j in [(i, -1) for i in range(d)] + pairs[:max(d, min(len(pairs), MOST_FEATURES - d, (len(z) - 20) // 4 - d))]:
        columns.append(z[:, i] if j < 0 else z[:, i] * z[:, j])
        owners.append((np.arange(d) == i) | (np.arange(d) == j))
    return np.stack(columns, axis=1), np.array(owners)


def _shares(features: Array, owners: NDArray[np.bool_], y: Array, weight: Array) -> tuple[Array, Array, Array]:
    """First and total shares (d, K) of what the whole regression explains, and the share (K,) it explains."""
    d = owners.shape[1]
    target = y - (weight @ y) / weight.sum()
    weighted = features * weight[:, None]
    gram, right = weighted.T @ features, weighted.T @ target
    size = np.maximum(np.einsum("n,nk,nk->k", weight, target, target), 1e-300)
    gram = gram + 1e-9 * np.diag(np.diag(gram))

    def follows(which: NDArray[np.bool_]) -> Array:
        solved = np.linalg.solve(gram[np.ix_(which, which)], right[which])
        return np.einsum("mk,mk->k", right[which], solved) / size

    everything = follows(np.ones(len(owners), dtype=bool))
    scale = np.maximum(everything, 1e-12)
    alone = [follows(np.asarray(~owners[:, np.arange(d) != i].any(axis=1))) / scale for i in range(d)]
    without = [1 - follows(~owners[:, i]) / scale for i in range(d)]
    return np.clip(alone, 0, 1), np.clip(without, 0, 1), everything


def convergence(curves: Array, least: int = 16) -> tuple[NDArray[np.intp], Array]:
    """How the band settles as samples are added.

    Parameters
    ----------
    curves : ndarray (S, K)
        NaN where a sample has no value.
    least : int
        Fewest samples.

    Returns
    -------
    counts : ndarray (C,) of int
        Samples used, doubling up to all.
    bands : ndarray (C, 3, K)
        The 5, 50 and 95 % quantiles of the first so many.
    """
    total = len(curves)
    counts = [total // 2**i for i in range(20) if total // 2**i >= least or i == 0][::-1]
    return np.array(counts, dtype=np.intp), np.array([quantiles(curves[:n], np.ones(n, dtype=bool)) for n in counts])


def last_move(bands: Array) -> Array:
    """By how much (K,) the edges of the band moved when the samples were last doubled, as a share of its width; NaN for one step only."""
    if len(bands) < 2:
        return np.full(bands.shape[-1], np.nan)
    width = bands[-1, 2] - bands[-1, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = np.abs(bands[-1, [0, 2]] - bands[-2, [0, 2]]).max(axis=0) / width
    return np.where(width > 0, moved, 0.0 * width)


