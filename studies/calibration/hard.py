"""Fifty posteriors made to deceive a sampler, with exact draws beside them: is 'converged' ever said wrongly?

Families: two modes (1 to 4 dimensions, 4 to 40 standard deviations apart, weights 0.5 to 0.95; the fit knows both optima, or only one);
ridges (curved, a hundredth to a thousandth as wide as long, 2 to 5 dimensions, some of them ending on a bound); walkers that get stuck
(funnels, and needles that hold a tenth of the mass in a thousandth of the width). A run is wrong where it says converged and the
distribution of a parameter is further than 0.12 (largest difference of cumulative probabilities) from that of exact draws, or the
share of the second mode or of the needle is off by more than 4.5 of the standard errors of four hundred independent draws: either
happens by chance in about one of a hundred thousand cases.

``python -m studies.calibration.hard``; results/hard.json.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import ks_2samp
from studies.calibration import truth
from studies.calibration.cases import CASES, Case
from studies.calibration.run import stored

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.fit import Fit, Start, fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.ensemble import sample
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.prior import Prior
from bayes_nlsid.model import Element, Model
from bayes_nlsid.study.store import versions

TERMS = ("q|q|", "v|v|", "cubic", "v^3", "quintic")
FAR, OFF = 0.12, 4.5
CLAIMED = 400           # effective draws that "converged" promises
EXACT = 20_000
MOST = 8000             # steps of an ensemble
Array = np.ndarray


@dataclass(frozen=True)
class Posterior:
    """Log density of x (W, d) in the box from −1 to 1, exact draws, and the optima that a fit would know."""

    family: str
    words: str
    log: Callable[[Array], Array]
    draw: Callable[[int, np.random.Generator], Array]
    optima: Array
    widths: tuple[float, ...]
    part: Callable[[Array], Array] | None = None     # which x (W, d) belong to the second mode

    def exact(self, count: int, rng: np.random.Generator) -> Array:
        """Draws (count, d) inside the box."""
        kept = np.zeros((0, self.optima.shape[1]))
        while len(kept) < count:
            x = self.draw(count, rng)
            kept = np.concatenate([kept, x[(np.abs(x) <= 1).all(axis=1)]])
        return kept[:count]


@final
class Written(Likelihood):
    """Log-likelihood written by hand, of parameters over their upper bounds."""

    def __init__(self, start: Fit, posterior: Posterior) -> None:
        self.fit, self.function, self.known = start, posterior.log, posterior

    @property
    def problem(self) -> Problem:
        """That of the fit, which only lends its parameters."""
        return self.fit.problem

    @property
    def weights(self) -> Array:
        """None."""
        return np.zeros(self.problem.size)

    @property
    def blocks(self) -> tuple[str, ...]:
        """One."""
        return ("all",)

    def log_likelihood(self, theta: ArrayLike) -> Array:
        """(W,)."""
        return self.function(np.asarray(theta) / self.problem.bounds[:, 1])

    def by_block(self, theta: ArrayLike) -> Array:
        """(W, 1)."""
        return self.log_likelihood(theta)[:, None]

    def curvature(self, theta: Array, coordinates: Coordinates) -> Array:
        """Minus the second derivative at a point, by differences as wide as the nearest optimum is."""
        x, d = theta / self.problem.bounds[:, 1], len(theta)
        h = 0.05 * self.known.widths[int(np.argmin(np.sum((self.known.optima - x) ** 2, axis=1)))]
        a, b = (h * np.eye(d))[:, None], (h * np.eye(d))[None]
        points = np.stack([x + a + b, x + a - b, x - a + b, x - a - b]).reshape(-1, d)
        f = self.function(points).reshape(4, d, d)
        bend = -(f[0] - f[1] - f[2] + f[3]) / (4 * h**2)
        stretch = np.exp(coordinates.log_jacobian(coordinates.to_s(theta))) / self.problem.bounds[:, 1]
        return np.asarray(bend * np.outer(stretch, stretch))

    def describe(self) -> str:
        """In words."""
        return "written by hand"


def two_modes(rng: np.random.Generator) -> Posterior:
    """Two normal distributions of different width."""
    d, apart, weight = int(rng.integers(1, 5)), float(np.exp(rng.uniform(np.log(4), np.log(40)))), float(rng.uniform(0.5, 0.95))
    sd = np.exp(rng.uniform(np.log(0.005), np.log(0.02), 2))
    way = rng.normal(size=d)
    first = rng.uniform(-0.1, 0.1, d)
    middles = np.stack([first, first + apart * sd.max() * way / np.linalg.norm(way)])
    known = 2 if rng.uniform() < 0.75 or apart > 8 else 1

    def log(x: Array) -> Array:
        parts = [np.log(w) - d * np.log(s) - 0.5 * np.sum(((x - m) / s) ** 2, axis=1)
                 for w, s, m in zip((weight, 1 - weight), sd, middles, strict=True)]
        return np.logaddexp(*parts)

    def draw(count: int, rng: np.random.Generator) -> Array:
        which = (rng.uniform(size=count) > weight).astype(int)
        return middles[which] + sd[which, None] * rng.normal(size=(count, d))

    return Posterior("two modes", f"{d} dimensions, {apart:.0f} sd apart, weight {weight:.2f}, {known} known", log, draw, middles[:known],
                     tuple(sd[:known]), lambda x: np.argmin([np.sum(((x - m) / s) ** 2, axis=1)
                                                             for m, s in zip(middles, sd, strict=True)], axis=0) == 1)


def ridge(rng: np.random.Generator) -> Posterior:
    """x2 follows a parabola of x1, further coordinates lines; the ridge may run into a bound."""
    d, width, bend = int(rng.integers(2, 6)), float(10 ** rng.uniform(-3, -2)), float(rng.uniform(0.5, 4))
    middle, long = (0.0, 0.25) if rng.uniform() < 0.6 else (0.8, 0.3)
    slopes = rng.uniform(-1, 1, d - 2)

    def expected(x1: Array) -> Array:
        return np.stack([bend * (x1**2 - 0.1), *(0.8 * s * x1 for s in slopes)], axis=1)

    def log(x: Array) -> Array:
        return -0.5 * ((x[:, 0] - middle) / long) ** 2 - 0.5 * np.sum(((x[:, 1:] - expected(x[:, 0])) / width) ** 2, axis=1)

    def draw(count: int, rng: np.random.Generator) -> Array:
        x1 = middle + long * rng.normal(size=count)
        return np.concatenate([x1[:, None], expected(x1) + width * rng.normal(size=(count, d - 1))], axis=1)

    at = np.array([min(middle, 0.5)])
    return Posterior("ridge", f"{d} dimensions, width {width:.1g}, bend {bend:.1f}, from {middle}", log, draw,
                     np.concatenate([at[:, None], expected(at)], axis=1), (width,))


def sticky(rng: np.random.Generator) -> Posterior:
    """A funnel, or a needle in a broad normal distribution."""
    if rng.uniform() < 0.5:
        d, steep = int(rng.integers(2, 5)), float(rng.uniform(3, 7))

        def spread(v: Array) -> Array:
            return 0.03 * np.exp(steep * v)

        def log_funnel(x: Array) -> Array:
            s = spread(x[:, 0])[:, None]
            return -0.5 * (x[:, 0] / 0.3) ** 2 - np.sum(np.log(s) + 0.5 * (x[:, 1:] / s) ** 2, axis=1)

        def draw_funnel(count: int, rng: np.random.Generator) -> Array:
            v = 0.3 * rng.normal(size=count)
            return np.concatenate([v[:, None], spread(v)[:, None] * rng.normal(size=(count, d - 1))], axis=1)

        return Posterior("stuck", f"funnel of {d} dimensions, steepness {steep:.1f}", log_funnel, draw_funnel, np.zeros((1, d)),
                         (0.03,))
    d, thin, share = int(rng.integers(1, 4)), float(10 ** rng.uniform(-4, -2)), float(rng.uniform(0.05, 0.2))
    at = rng.uniform(-0.1, 0.1, d)

    def log(x: Array) -> Array:
        broad = np.log(1 - share) - d * np.log(0.1) - 0.5 * np.sum((x / 0.1) ** 2, axis=1)
        return np.logaddexp(broad, np.log(share) - d * np.log(0.1 * thin) - 0.5 * np.sum(((x - at) / (0.1 * thin)) ** 2, axis=1))

    def draw(count: int, rng: np.random.Generator) -> Array:
        needle = (rng.uniform(size=count) < share)[:, None]
        return np.where(needle, at + 0.1 * thin * rng.normal(size=(count, d)), 0.1 * rng.normal(size=(count, d)))

    return Posterior("stuck", f"needle of {100 * share:.0f} %, {d} dimensions, {thin:.1g} as wide", log, draw, np.stack([np.zeros(d), at]),
                     (0.1, 0.1 * thin),
                     lambda x: np.sum(((x - at) / (0.1 * thin)) ** 2, axis=1) < 25 + 5 * d)


FAMILIES = (two_modes, ridge, sticky)


def lent(count: int) -> Fit:
    """A fit with so many signed coefficients, of which only names and bounds are used."""
    case = CASES["static"]
    assert isinstance(case, Case)
    white = truth.SCENARIOS["white"]
    rng = np.random.default_rng(0)
    base = case.regression(case.recording(white, case.measure(white, case.draw(1, rng), rng)[0]), 0).problem
    elements = tuple(Element(LIBRARY[name], ("M",)) for name in TERMS[:count])
    return fit(Problem(Model(base.model.linear, elements), base.data, base.scenario), starts=1)


def one_test(posterior: Posterior, start: Fit, seed: int) -> dict[str, Any]:
    """What the run says and how far its draws are from exact ones."""
    began = time.process_time()
    bounds = start.problem.bounds
    optima = np.clip(posterior.optima, -0.99, 0.99) * bounds[:, 1]
    known = tuple(Start(x, 1.0 + 0.01 * i, "converged", 1, 0.0) for i, x in enumerate(optima))
    found_at = replace(start, theta=known[0].theta, s=start.problem.to_s(known[0].theta), starts=known)
    priors = tuple(Prior(n, "", "uniform", low, high) for n, (low, high) in zip(start.problem.names, bounds.tolist(), strict=True))
    found = sample(found_at, likelihood=Written(found_at, posterior), priors=priors, seed=seed, most=MOST)
    exact = posterior.exact(EXACT, np.random.default_rng(seed))
    draws = found.flat / bounds[:, 1]
    far = max(float(ks_2samp(draws[:, i], exact[:, i]).statistic) for i in range(draws.shape[1])) if len(draws) else 1.0
    c, shares = found.convergence, None
    wrong = far > FAR
    if posterior.part is not None and len(draws):
        shares = [float(posterior.part(draws).mean()), float(posterior.part(exact).mean())]
        wrong |= abs(shares[0] - shares[1]) > OFF * np.sqrt(max(shares[1] * (1 - shares[1]), 1e-4) / CLAIMED)
    return {"family": posterior.family, "words": posterior.words, "converged": bool(c.converged), "distance": far, "second_mode": shares,
            "false": bool(c.converged and wrong), "ess": float(c.ess_min), "rhat": float(c.rhat_max), "steps": int(c.steps),
            "reasons": list(found.reasons)[:2], "seconds": time.process_time() - began}


def run(count: int, seed: int, tell: Callable[[str], None] | None = None) -> dict[str, Any]:
    """``count`` posteriors, the families in turn."""
    fits = {d: lent(d) for d in range(1, 6)}
    tests = []
    for i, child in enumerate(np.random.SeedSequence([seed, 50]).spawn(count)):
        posterior = FAMILIES[i % len(FAMILIES)](np.random.default_rng(child))
        tests.append(one_test(posterior, fits[posterior.optima.shape[1]], int(child.generate_state(1)[0])))
        if tell is not None:
            t = tests[-1]
            second = "" if t["second_mode"] is None else ", second mode {:.3f} for {:.3f}".format(*t["second_mode"])
            tell(f"{i + 1} of {count}: {t['family']}, {t['words']}: {'converged' if t['converged'] else 'not converged'}, "
                 f"{t['distance']:.3f} from exact{second}{', FALSE' if t['false'] else ''}, {t['seconds']:.0f} s")
    return {"count": count, "seed": seed, "versions": versions(), "false_converged": sum(t["false"] for t in tests),
            "converged": sum(t["converged"] for t in tests), "tests": tests}


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m studies.calibration.hard", description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-store", action="store_true", help="print only")
    options = parser.parse_args()
    result = run(options.count, options.seed, lambda text: print(text, file=sys.stderr, flush=True))
    if not options.no_store:
        stored(result, "hard")
    print(f"{result['converged']} of {result['count']} said converged, {result['false_converged']} of them falsely")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
