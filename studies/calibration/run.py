"""Simulation-based calibration and interval coverage over virtual tests whose truths are drawn from the prior."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta, chi2
from studies.calibration import truth
from studies.calibration.cases import AMPLITUDES, CASES, Case
from studies.calibration.five_joints import FiveJoints

from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.forward import ForwardLikelihood, forward_likelihood
from bayes_nlsid.inference.likelihood import WhittleLikelihood, laplace
from bayes_nlsid.inference.reweighting import WORST_SHAPE, around_optimum, forward_posterior
from bayes_nlsid.study.store import versions

LEVELS = (0.50, 0.90, 0.95)
RANKS = 99              # posterior draws among which the truth is ranked
BINS = 10
SIMULATED = 300         # weighted draws per test
FOLDER = Path(__file__).parent / "results"
Array = np.ndarray


def one_test(case: Case | FiveJoints, scenario: truth.Scenario, theta: Array, channels: Array, seed: int) -> dict[str, Any]:
    """Posterior of one virtual test: ranks, quantiles, spreads, backbone coverage."""
    began = time.process_time()
    recording = case.recording(scenario, channels)
    found = case.regression(recording, seed)
    priors = case.priors(found.problem)
    likelihood = forward_likelihood(found, [recording], priors)
    weighted = around_optimum(likelihood, priors, SIMULATED, seed)
    chained = weighted.shape > WORST_SHAPE
    if chained:
        weighted = forward_posterior(found, likelihood, priors, seed=seed)[1]
    rng = np.random.default_rng(seed)
    draws = weighted.resampled(2000, rng)
    ranked = draws[rng.choice(len(draws), RANKS, replace=False)]
    bands = [np.quantile(x, [0.05, 0.95], axis=0) for x in case.backbone(draws)]
    true = case.backbone(theta[None])
    return {"truth": theta, "rank": (ranked < theta).sum(axis=0), "quantiles": weighted.quantiles([0.025, 0.05, 0.25, 0.75, 0.95, 0.975]),
            "sd": draws.std(axis=0), "mean": draws.mean(axis=0), "known": _known(case, likelihood, scenario, channels, priors),
            "frequency_inside": (bands[0][0] <= true[0][0]) & (true[0][0] <= bands[0][1]),
            "damping_inside": (bands[1][0] <= true[1][0]) & (true[1][0] <= bands[1][1]),
            "regression": _regression(found, theta, priors), "shape": weighted.shape, "chained": chained,
            "seconds": time.process_time() - began}


def _known(case: Case | FiveJoints, likelihood: ForwardLikelihood, scenario: truth.Scenario, channels: Array, priors: Any) -> Array:
    """Standard deviations that a posterior would have that knows the sensor noise exactly and has no nuisance but the initial state."""
    run = likelihood.error.runs[0]
    at = likelihood.expansion
    noise = case.shares(scenario)
    clean = np.sqrt(np.mean(channels**2, axis=0) / (1 + noise**2))
    shape = np.ones(run.spectrum.bins)
    if scenario.coloured:
        shape = 80.0 / np.maximum(run.spectrum.frequency, 5.0)
    variance = np.tile((shape[:, None] * (noise * clean / run.scale) ** 2), (2, 1)).ravel()
    slope = at.slope / np.sqrt(variance)[:, None]
    spread = np.array([likelihood.coordinates.to_s(p.quantile((np.arange(256) + 0.5) / 256)[:, None].repeat(len(priors), 1))[:, i].std()
                       for i, p in enumerate(priors)])
    count = len(at.s)
    information = slope.T @ slope + np.diag(np.concatenate([1 / spread**2, np.full(slope.shape[1] - count, 1e-4)]))
    stretch = np.exp(likelihood.coordinates.log_jacobian(at.s))
    return np.sqrt(np.diag(np.linalg.inv(information))[:count]) * stretch


def _regression(found: Fit, theta: Array, priors: Any) -> dict[str, Array]:
    """Where the truth lies in the Whittle posterior of the regression, in its standard deviations."""
    likelihood = WhittleLikelihood(found)
    spread = np.array([p.quantile((np.arange(256) + 0.5) / 256) for p in priors])
    at = likelihood.fit.theta
    coordinates = likelihood.problem.coordinates
    s_spread = coordinates.to_s(spread.T).std(axis=0)
    covariance = laplace(likelihood, at, s_spread)
    sd = np.sqrt(np.diag(covariance)) * np.exp(coordinates.log_jacobian(coordinates.to_s(at)))
    return {"z": (at - theta) / sd, "sd": sd}


def run(case: str, scenario: str, count: int, seed: int, tell: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Calibrate one case in one scenario over ``count`` virtual tests; what ``summarise`` makes of them."""
    chosen, noise = CASES[case], truth.SCENARIOS[scenario]
    first, second, third = np.random.SeedSequence([seed, *f"{case}/{scenario}".encode()]).spawn(3)
    theta = chosen.draw(count, np.random.default_rng(first))
    channels = chosen.measure(noise, theta, np.random.default_rng(second))
    tests = []
    for i, child in enumerate(third.spawn(count)):
        tests.append(one_test(chosen, noise, theta[i], channels[i], int(child.generate_state(1)[0])))
        if tell is not None and (i + 1) % 10 == 0:
            tell(f"{case}, {scenario}: {i + 1} of {count}")
    return {"case": case, "scenario": scenario, "count": count, "seed": seed, "versions": versions(),
            **summarise(chosen.names, tests, chosen.amplitudes)}


def summarise(names: tuple[str, ...], tests: list[dict[str, Any]], amplitudes: Array = AMPLITUDES) -> dict[str, Any]:
    """Coverage with standard errors, rank chi-squares, sharpness, backbone coverage."""
    n = len(tests)
    quantiles = np.array([t["quantiles"] for t in tests])        # (n, 6, P)
    theta = np.array([t["truth"] for t in tests])
    inside = {level: (quantiles[:, 2 - i] <= theta) & (theta <= quantiles[:, 3 + i]) for i, level in enumerate(LEVELS)}
    ranks = np.array([t["rank"] for t in tests])
    z = np.abs(np.array([t["regression"]["z"] for t in tests]))
    known = np.array([t["known"] for t in tests])
    sd = np.array([t["sd"] for t in tests])
    out: dict[str, Any] = {"parameters": list(names), "coverage": {}, "coverage_se": {}, "each": {}, "regression_coverage": {}}
    for level, cut in zip(LEVELS, (0.6745, 1.6449, 1.9600), strict=True):
        key = f"{100 * level:.0f}"
        out["coverage"][key] = float(inside[level].mean())
        # parameters of one test are correlated: the error comes from the scatter between tests
        out["coverage_se"][key] = float(inside[level].mean(axis=1).std(ddof=1) / np.sqrt(n)) if n > 1 else None
        out["each"][key] = [float(x) for x in inside[level].mean(axis=0)]
        out["regression_coverage"][key] = float((z < cut).mean())
    out["rank_p"] = [rank_p(r) for r in ranks.T]
    out["ranks"] = ranks.T.tolist()
    out["length_over_known"] = [float(x) for x in np.median(sd / known, axis=0)]
    out["regression_length_over_forward"] = [float(x) for x in np.median(np.array([t["regression"]["sd"] for t in tests]) / sd, axis=0)]
    out["backbone"] = {"amplitude_m": amplitudes.tolist(), "frequency90": np.mean([t["frequency_inside"] for t in tests], axis=0).tolist(),
                       "damping90": np.mean([t["damping_inside"] for t in tests], axis=0).tolist()}
    out["chained"] = int(sum(t["chained"] for t in tests))
    out["refused"] = int(sum(t["shape"] > WORST_SHAPE for t in tests))
    out["seconds_per_test"] = float(np.median([t["seconds"] for t in tests]))
    return out


def rank_p(ranks: Array) -> float:
    """p-value that ranks (n,) among ``RANKS`` draws are uniform: chi-square over bins (Talts et al. 2018)."""
    counts = np.bincount(ranks * BINS // (RANKS + 1), minlength=BINS)
    expected = len(ranks) / BINS
    return float(chi2.sf(np.sum((counts - expected) ** 2) / expected, BINS - 1))


def line(result: dict[str, Any]) -> str:
    """One result as a row of text."""
    def shares(coverage: dict[str, float]) -> str:
        return "/".join(f"{100 * coverage[k]:.0f}" for k in ("50", "90", "95"))

    def row(values: list[float], form: str) -> str:
        return " ".join(format(x, form) for x in values)

    band = result["backbone"]["frequency90"] + result["backbone"]["damping90"]
    return (f"{result['case']:7s} {result['scenario']:16s} n={result['count']}  cover {shares(result['coverage'])} "
            f"(90 ± {100 * (result['coverage_se']['90'] or 0):.1f}; each {row([100 * x for x in result['each']['90']], '.0f')})  "
            f"rank p {row(result['rank_p'], '.2f')}  length/known {row(result['length_over_known'], '.2f')}  "
            f"backbone {100 * min(band):.0f}-{100 * max(band):.0f}  regression {shares(result['regression_coverage'])}  "
            f"chained {result['chained']} refused {result['refused']}  {result['seconds_per_test']:.2f} s")


def keep(result: dict[str, Any], folder: Path = FOLDER) -> Path:
    """Store one result."""
    return stored(result, f"{result['case']}-{result['scenario']}", folder)


def stored(result: dict[str, Any], name: str, folder: Path = FOLDER) -> Path:
    """Write a result of any study of calibration under a name."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json".replace(" ", "-")
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return path


def interval(hits: int, count: int) -> list[float]:
    """Clopper–Pearson, 90 %."""
    return [float(beta.ppf(0.05, hits, count - hits + 1)) if hits else 0.0,
            float(beta.ppf(0.95, hits + 1, count - hits)) if hits < count else 1.0]
