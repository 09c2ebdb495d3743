"""Rows 5 to 7: selection, posterior and the whole chain on one recording of 50,000 samples in ten equations."""

from __future__ import annotations

from functools import partial

import numpy as np

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification import select as selecting
from bayes_nlsid.identification.condensed import Condensed, condense
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.ensemble import sample
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.prediction.fast import fast_bands
from benchmarks.case import JOINTS, RATE, START, Row, joints, problem, quick, recording, seconds

SAMPLES, SHORT = 50_000, 5_000
STARTS, WALKERS, EFFECTIVE = 50, 40, 4000
NAIVE = 0.5e-3
"""Effective samples for each evaluation of stretch moves in logarithms of the parameters: 0.5 in 1,000 was the most that a chain of ten
autocorrelation times showed."""
TERMS = tuple(t for t in LIBRARY.values() if t.index is not None)


def selection() -> tuple[list[Row], float]:
    """Row 5, and the CPU time of all of it, s."""
    bare = problem(recording(SAMPLES))
    candidates = [joints(t.name) for t in TERMS]
    held = []
    once = seconds(lambda: held.append(selecting.condensed_for(bare, candidates, bare.default_weight)))
    found = []
    run = seconds(lambda: found.append(selecting.select(bare, candidates, starts=STARTS, seed=1, shared=held[0])))
    result = found[0]
    chosen = ", ".join(e.term.name for e in result.backward)
    out = [Row("5", f"forward–backward run, {len(TERMS)} terms at 5 joints, {STARTS} starts, {SAMPLES:,} samples x 10 equations", "3 s",
               f"{run:.1f} s for {len(result.tried)} fits; chosen: {chosen}", run <= 3.0),
           Row("", "set-up of the same: tables of all laws, one factor of all columns", "", f"{once:.1f} s")]
    each = {}
    for count in (SHORT, SAMPLES):
        one = problem(recording(count), [joints("iwan4")])
        shared = condense(one, one.default_weight)
        fits: list[Fit] = []
        cpu = seconds(partial(_fit, one, shared, fits))
        each[count] = cpu / sum(s.evaluations for s in fits[0].starts), cpu
    ratio = each[SAMPLES][0] / each[SHORT][0]
    out.append(Row("5", f"a fit of 5 Iwan joints on {SAMPLES:,} samples against {SHORT:,}, condensed: time per evaluation", "within 20 %",
                   f"{quick(each[SAMPLES][0])} against {quick(each[SHORT][0])}: {ratio:.2f} (whole fits {each[SAMPLES][1]:.1f} and "
                   f"{each[SHORT][1]:.1f} s)", abs(ratio - 1) <= 0.2))
    return out, once + run


def _fit(one: Problem, shared: Condensed | None, out: list[Fit]) -> None:
    out.append(fit(one, starts=STARTS, seed=1, shared=shared))


def naive(count: int = 8) -> float:
    """CPU time of one log-likelihood as it is written down: laws along all samples, ten residuals, s."""
    data = recording(SAMPLES)
    linear = problem(data).model.linear
    q, rows = data.q, linear.rows(JOINTS)
    base = data.a + 2 * linear.zeta * linear.omega * data.v + linear.omega**2 * data.u - data.force
    rng = np.random.default_rng(2)

    def run() -> None:
        for _ in range(count):
            f_s, k_t, chi, beta = np.array([2000.0, 1e8, -0.5, 0.1]) * (1 + 0.01 * rng.standard_normal(4))
            phi = f_s * (1 + beta) / (k_t * (beta + (chi + 1) / (chi + 2)))
            slip = np.minimum(np.abs(q) / phi, 1.0)
            force = np.where(np.abs(q) < phi, -k_t * q * slip ** (chi + 1) / ((1 + beta) * (chi + 2)), f_s * np.sign(q) - k_t * q)
            np.sum((base + force @ rows) ** 2)

    return seconds(run, 3) / count


def posterior(before: float) -> list[Row]:
    """Rows 6 and 7; ``before``: CPU time of the selection, s."""
    one = problem(recording(SAMPLES), [joints("iwan4")])
    fits: list[Fit] = []
    likelihoods: list[WhittleLikelihood] = []
    drawn: list[Posterior] = []
    spent = {"selection": before, "fit": seconds(lambda: fits.append(fit(one, starts=20, seed=1)))}
    spent["likelihood"] = seconds(lambda: likelihoods.append(WhittleLikelihood(fits[0])))
    spent["sampling"] = seconds(lambda: drawn.append(sample(fits[0], likelihood=likelihoods[0], walkers=WALKERS, seed=1)))
    found, likelihood = drawn[0], likelihoods[0]
    curves = found.draws(1000, 0)
    spent["band"] = seconds(lambda: fast_bands(curves, one.model, at="tip", start_amplitude=START))
    theta = found.draws(80, 1)
    each, plain = seconds(lambda: likelihood.log_likelihood(theta), 5) / 80, naive()
    c = found.convergence
    ess = float(np.min(c.ess))
    efficiency = _efficiency(likelihood, found.draws(40, 2))
    out = [Row("6", f"one log-likelihood, {one.size:,} residuals: condensed, against laws along all samples", "",
               f"{quick(each)} against {quick(plain)}: {plain / each:.0f}x"),
           Row("6", "set-up: fit from 20 starts, noise spectrum, refit, factor of the weighted columns", "",
               f"{spent['fit'] + spent['likelihood']:.1f} s"),
           Row("6", f"{EFFECTIVE:,} effective samples, 20 parameters, after set-up", "20 s",
               f"{ess:.0f} effective samples (of the worst parameter, tau {float(np.max(c.tau)):.0f} of {c.steps} steps, burn-in included) "
               f"in {spent['sampling']:.1f} s; {_rate(plain, ess / spent['sampling'])}; status \"{found.status}\"",
               spent["sampling"] <= 20 and ess >= EFFECTIVE and c.converged),
           Row("6", "reweighting efficiency of the table by the exact likelihood", "0.8", f"{efficiency:.2f}", efficiency >= 0.8)]
    total = sum(spent.values())
    parts = ", ".join(f"{name} {value:.1f}" for name, value in spent.items())
    out.append(Row("7", f"whole chain: {SAMPLES / RATE:.1f} s of data to a band of 1,000 curves, CPU on one core", "60 s on two cores",
                   f"{total:.0f} s ({parts}), posterior \"{found.status}\"", total <= 60 and c.converged))
    return out


def _rate(plain: float, found: float) -> str:
    """Effective samples per second, beside stretch moves on the likelihood as it is written down."""
    return f"{found:.0f} a second, {found * plain / NAIVE:,.0f}x the plain set-up"


def _efficiency(likelihood: WhittleLikelihood, theta: np.ndarray) -> float:
    """Share of the draws that is left when they are weighted by the exact over the tabled likelihood."""
    exact = np.array([-0.5 * np.sum(likelihood.weights * likelihood.problem.exact_residual(t) ** 2) for t in theta])
    change = exact - likelihood.log_likelihood(theta)
    weight = np.exp(change - change.max())
    return float(weight.sum() ** 2 / (weight**2).sum() / len(weight))
