"""Has the sampler converged, and what did the recordings inform?

The walkers of one ensemble are not independent chains: they propose from each other, so R-hat over them is blind to an ensemble that sits
in one of two modes. Independent ensembles are compared by nested R-hat (Margossian et al. 2024), the ensemble as superchain. The
effective sample size is the smaller of that from the integrated autocorrelation time of the ensemble mean and that from
walkers taken as chains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

RHAT, LENGTH, LEAST_ESS = 1.01, 50.0, 400.0    # limits: nested R-hat, chain length over tau, effective samples
LEAST_ACCEPTANCE, STUCK_SHARE = 0.05, 0.10
REDRAWN_SHARE = 0.5    # of walkers replaced before sampling began, which hints at poor starts but biases nothing that is kept
CONTRACTION, NEAR, PILED = 0.2, 0.01, 0.10
CONFLICT = 2.0         # prior standard deviations between prior mean and posterior median beyond which the two are said to disagree
DECADE = 10.0          # ratio of 95 % to 5 % quantile beyond which a parameter is not called determined
Array = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Convergence:
    """Diagnostics of one run.

    Parameters
    ----------
    ensembles, steps, walkers : int
        Steps after burn-in.
    converged : bool
    rhat_max, ess_min : float
        Over all parameters; NaN and 0 without parameters or draws.
    stuck_walkers : int
        Re-drawn during burn-in, plus those that stand still after it.
    rhat, tau, ess : ndarray (P,)
        Nested R-hat; integrated autocorrelation time in steps; effective samples.
    acceptance : ndarray (M, W)
        Share of accepted proposals after burn-in.
    contraction : ndarray (P,)
        1 − posterior sd / prior sd, in s.
    piled : ndarray (P,)
        Share of draws within 1 % of a bound, in s.
    identifiable : ndarray (P,) of bool
    status : {"ok", "not_converged", "not_identifiable"}
    reasons : tuple of str
    """

    ensembles: int
    steps: int
    walkers: int
    converged: bool
    rhat_max: float
    ess_min: float
    stuck_walkers: int
    rhat: Array = field(repr=False)
    tau: Array = field(repr=False)
    ess: Array = field(repr=False)
    acceptance: Array = field(repr=False)
    contraction: Array = field(repr=False)
    piled: Array = field(repr=False)
    identifiable: NDArray[np.bool_] = field(repr=False)
    status: str
    reasons: tuple[str, ...]


def autocorrelation(chains: Array) -> Array:
    """Autocovariance (N,) of chains (N, C) around their common mean, averaged over the chains, unbiased by length only at lag 0."""
    n = len(chains)
    size = 1 << (2 * n - 1).bit_length()
    transform = np.fft.rfft(chains - chains.mean(), size, axis=0)
    return np.fft.irfft(np.mean(np.abs(transform) ** 2, axis=1), size)[:n] / n


def integrated_time(ensembles: Array) -> float:
    """Integrated autocorrelation time in steps of (M, N, W), Sokal's window of 5 times itself; infinite if nothing moves.

    Lags are averaged over walkers and ensembles, each ensemble around its own mean: what keeps ensembles apart is for nested R-hat to see.
    """
    m, n, _ = ensembles.shape
    if n < 4:
        return np.inf
    covariance = np.mean([autocorrelation(ensembles[i]) for i in range(m)], axis=0)
    if not covariance[0] > 1e-28 * max(1e-300, float(np.max(np.abs(ensembles)) ** 2)):
        return np.inf
    times = 2 * np.cumsum(covariance / covariance[0]) - 1
    window = np.flatnonzero(np.arange(n) >= 5 * times)
    return float(max(1.0, times[window[0] if len(window) else n - 1]))


def nested_rhat(ensembles: Array) -> float:
    """Nested R-hat of (M, N, W): ensembles as superchains of W walkers; NaN for one ensemble, infinite if nothing moves but they differ."""
    if len(ensembles) < 2:
        return float("nan")
    between = float(np.var(ensembles.mean(axis=(1, 2)), ddof=1))
    walkers = ensembles.mean(axis=1)
    within = float(np.mean(np.var(walkers, axis=1, ddof=1) + np.mean(np.var(ensembles, axis=1, ddof=1), axis=1)))
    if within <= 0:
        return 1.0 if between <= 0 else np.inf
    return float(np.sqrt(1 + between / within))


def chain_ess(chains: Array) -> float:
    """Effective sample size of chains (N, C) by Geyer's initial monotone sequence on split chains (Vehtari et al. 2021)."""
    n = len(chains) // 2
    if n < 4:
        return 0.0
    split = np.concatenate([chains[:n], chains[n:2 * n]], axis=1)
    within = float(np.mean(np.var(split, axis=0, ddof=1)))
    total = within * (n - 1) / n + float(np.var(split.mean(axis=0), ddof=1))
    if total <= 0 or within <= 0:
        return 0.0
    size = 1 << (2 * n - 1).bit_length()
    transform = np.fft.rfft(split - split.mean(axis=0), size, axis=0)
    covariance = np.fft.irfft(np.mean(np.abs(transform) ** 2, axis=1), size)[:n] / n
    rho = 1 - (within - covariance * n / (n - 1)) / total
    rho[0] = 1.0
    pairs = rho[:2 * (n // 2)].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    pairs = np.minimum.accumulate(pairs[:negative[0]] if len(negative) else pairs)
    tau = max(-1 + 2 * float(pairs.sum()), 1 / np.log10(split.size))
    return split.size / tau


def stuck(log_prob: Array, acceptance: Array, dimensions: int) -> NDArray[np.bool_]:
    """(M, W): walkers that hardly move, or whose mean log-probability is far below that of their ensemble (by P/2 + 10)."""
    with np.errstate(invalid="ignore"):
        level = log_prob.mean(axis=1)
        low = level < np.median(level, axis=1, keepdims=True) - (dimensions / 2 + 10)
    return (acceptance < LEAST_ACCEPTANCE) | low | ~np.isfinite(level)


def assess(s: Array, log_prob: Array, acceptance: Array, *, names: Sequence[str], nonlinear: Sequence[bool], prior_sd: Array, box: Array,
           prior_mean: Array | None = None, logarithmic: Sequence[bool] | None = None, redrawn: int = 0, stopped: str = "") -> Convergence:
    """Diagnostics of draws.

    Parameters
    ----------
    s : ndarray (M, N, W, P)
        Search coordinates after burn-in.
    log_prob : ndarray (M, N, W)
    acceptance : ndarray (M, W)
    names : sequence of str, length P
    nonlinear : sequence of bool, length P
        Parameters of force laws; only these are judged by contraction, since a good modal test may say more than a recording.
    prior_sd, prior_mean : ndarray (P,)
        Standard deviation and mean of the prior, in s; without the mean nothing is said of a posterior that lies far from its prior.
    box : ndarray (2, P)
        Bounds in s.
    logarithmic : sequence of bool, length P
        Entries whose s is the decimal logarithm; a force law's parameter whose 90 % interval spans more than a decade is not determined.
    redrawn : int
        Walkers replaced during burn-in.
    stopped : str
        Why the run ended early, if it did.

    Returns
    -------
    Convergence
    """
    m, n, w, p = s.shape
    if n < 8:
        nothing = np.full(p, np.nan)
        return Convergence(m, n, w, False, float("nan"), 0.0, redrawn, nothing, nothing, np.zeros(p), acceptance, nothing, nothing,
                           np.zeros(p, bool), "not_converged", (stopped or f"only {n} steps after burn-in",))
    tau = np.array([integrated_time(s[..., i]) for i in range(p)])
    rhat = np.array([nested_rhat(s[..., i]) for i in range(p)])
    flat = s.transpose(1, 0, 2, 3).reshape(n, m * w, p)
    ess = np.array([min(m * w * n / tau[i], chain_ess(flat[..., i])) for i in range(p)])
    still = stuck(log_prob, acceptance, p)
    draws = s.reshape(-1, p)
    contraction = 1 - draws.std(axis=0) / prior_sd
    near = NEAR * (box[1] - box[0])
    piled = np.mean((draws < box[0] + near) | (draws > box[1] - near), axis=0)
    low, high = np.quantile(draws, (0.05, 0.95), axis=0)
    spread = np.where(np.zeros(p, bool) if logarithmic is None else np.asarray(logarithmic, dtype=bool), high - low, 0.0)
    vague = np.asarray(nonlinear, dtype=bool) & ((contraction < CONTRACTION) | (spread > np.log10(DECADE)))
    identifiable = ~(vague | (piled > PILED))
    reasons = [stopped] if stopped else []
    reasons += _convergence_reasons(names, n, tau, rhat, ess, acceptance, still, redrawn, m * w)
    converged = not reasons
    if converged:
        reasons += _identification_reasons(draws, names, nonlinear, prior_sd, contraction, piled, prior_mean)
        reasons += [f"{name} is known only to within a factor of {10**wide:.2g} between its 5 % and 95 % points"
                    for name, wide, flag in zip(names, spread, vague & (contraction >= CONTRACTION), strict=True) if flag]
    status = "not_converged" if not converged else "ok" if identifiable.all() else "not_identifiable"
    return Convergence(m, n, w, converged, float(np.max(rhat, initial=1.0)) if m > 1 else float("nan"),
                       float(np.min(ess, initial=np.inf)) if p else 0.0,
                       redrawn + int(still.sum()), rhat, tau, ess, acceptance, contraction, piled, identifiable, status, tuple(reasons))


def _convergence_reasons(names: Sequence[str], n: int, tau: Array, rhat: Array, ess: Array, acceptance: Array, still: NDArray[np.bool_],
                         redrawn: int, walkers: int) -> list[str]:
    reasons = []
    apart = [name for name, r in zip(names, rhat, strict=True) if not r <= RHAT]
    if apart and len(acceptance) > 1:
        worst = float(np.nanmax(rhat))
        apart_text = ", ".join(apart)
        if worst > 1.1 and n > LENGTH * np.min(tau):
            reasons.append(f"the ensembles disagree on {apart_text} (nested R-hat {worst:.3g}): several modes, or not enough steps to "
                           f"travel between them")
        else:
            reasons.append(f"nested R-hat of {apart_text} is above {RHAT} (largest {worst:.4g})")
    elif len(acceptance) < 2:
        reasons.append("one ensemble alone cannot show that it found every mode; run at least two")
    short = [name for name, t in zip(names, tau, strict=True) if not n >= LENGTH * t]
    if short:
        reasons.append(f"{n} steps are fewer than {LENGTH:g} autocorrelation times of {', '.join(short)} (largest {np.max(tau):.3g} steps)"
                       + (f": about {int(np.ceil(LENGTH * np.max(tau))) - n} more are needed" if np.isfinite(np.max(tau)) else ""))
    few = [name for name, e in zip(names, ess, strict=True) if not e >= LEAST_ESS]
    if few:
        reasons.append(f"fewer than {LEAST_ESS:g} effective samples of {', '.join(few)} (least {np.min(ess):.0f})")
    if (acceptance.mean(axis=1) < LEAST_ACCEPTANCE).any():
        reasons.append(f"an ensemble stands still: {100 * acceptance.mean(axis=1).min():.1f} % of its proposals were accepted")
    elif still.sum() > STUCK_SHARE * walkers or redrawn > REDRAWN_SHARE * walkers:
        reasons.append(f"{int(still.sum())} walkers stand still and {redrawn} were re-drawn during burn-in, of {walkers}")
    return reasons


def _identification_reasons(draws: Array, names: Sequence[str], nonlinear: Sequence[bool], prior_sd: Array, contraction: Array,
                            piled: Array, prior_mean: Array | None = None) -> list[str]:
    """Parameters at their bounds, and directions in which the posterior is as wide as the prior, in words."""
    reasons = [f"{name} is at a bound of its range in {100 * share:.0f} % of the draws: a one-sided statement, or a bound to widen"
               for name, share in zip(names, piled, strict=True) if share > PILED]
    judged = [i for i, flag in enumerate(nonlinear) if flag]
    if not judged:
        return reasons
    scaled = (draws[:, judged] - draws[:, judged].mean(axis=0)) / prior_sd[judged]
    values, vectors = np.linalg.eigh(np.cov(scaled.T).reshape(len(judged), len(judged)))
    told: set[int] = set()
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < (1 - CONTRACTION) ** 2 / 2:
            break
        loaded = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) >= 0.35]
        shared = _tied(scaled, loaded)
        if len(shared) > 1:
            reasons.append(f"{_together([names[judged[i]] for i in shared])} enter only through one number (correlation "
                           f"{_correlation(scaled[:, shared[0]], scaled[:, shared[1]]):.2f}): read that combination, not the parts")
            told |= set(shared)
    for i, k in enumerate(judged):
        if contraction[k] < CONTRACTION and i not in told:
            away = 0.0 if prior_mean is None else abs(float(np.median(draws[:, k])) - prior_mean[k]) / prior_sd[k]
            reasons.append(f"{names[k]} is not informed: its posterior is as wide as its prior (contraction {contraction[k]:.2f})"
                           if away < CONFLICT else f"{names[k]} lies {away:.1f} standard deviations of its prior away from it and is no "
                           f"less uncertain: prior and recordings disagree, or the force law is not the right one")
    return reasons


def _correlation(a: Array, b: Array) -> float:
    return float(np.mean((a - a.mean()) * (b - b.mean())) / (a.std() * b.std()))


def _tied(scaled: Array, loaded: list[int]) -> list[int]:
    """Of the entries loaded on one wide direction, those that are known together though not apart: correlated beyond 0.9."""
    if len(loaded) < 2:
        return []
    first = scaled[:, loaded[0]]
    return [loaded[0], *(i for i in loaded[1:] if abs(_correlation(first, scaled[:, i])) > 0.9)]


def _together(names: list[str]) -> str:
    """``iwan4[J1].f_s, iwan4[J1].beta`` as ``f_s and beta of iwan4[J1]``."""
    owners = {name.rpartition(".")[0] for name in names}
    parts = [name.rpartition(".")[2] for name in names]
    if len(owners) == 1 and (owner := owners.pop()):
        return f"{', '.join(parts[:-1])} and {parts[-1]} of {owner}"
    return f"{', '.join(names[:-1])} and {names[-1]}"
