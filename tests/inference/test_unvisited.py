"""Known optima against draws: exact draws pass, draws that lack an optimum are refused, optima without weight are left alone."""

from __future__ import annotations

import numpy as np
import pytest
from studies.calibration import hard

from bayes_nlsid.inference.prior import Prior
from bayes_nlsid.inference.target import Target
from bayes_nlsid.inference.unvisited import missed


def setting(d: int, share: float, thin: float) -> tuple[Target, hard.Posterior, np.ndarray]:
    """A needle in a broad normal distribution, its two optima in s."""
    start, at = hard.lent(d), np.full(d, 0.03)

    def log(x: np.ndarray) -> np.ndarray:
        broad = np.log(1 - share) - d * np.log(0.1) - 0.5 * np.sum((x / 0.1) ** 2, axis=1)
        return np.logaddexp(broad, np.log(share) - d * np.log(0.1 * thin) - 0.5 * np.sum(((x - at) / (0.1 * thin)) ** 2, axis=1))

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        needle = (rng.uniform(size=count) < share)[:, None]
        return np.where(needle, at + 0.1 * thin * rng.normal(size=(count, d)), 0.1 * rng.normal(size=(count, d)))

    one = hard.Posterior("needle", "", log, draw, np.stack([np.zeros(d), at]), (0.1, 0.1 * thin))
    bounds = start.problem.bounds
    priors = tuple(Prior(n, "", "uniform", low, high) for n, (low, high) in zip(start.problem.names, bounds.tolist(), strict=True))
    target = Target(hard.Written(start, one), priors)
    return target, one, target.to_s(one.optima * bounds[:, 1])


@pytest.mark.parametrize(("d", "share", "thin"), [(1, 0.2, 1e-2), (3, 0.1, 1e-3), (5, 0.3, 0.05)])
def test_exact_draws_pass_and_draws_without_the_needle_do_not(d: int, share: float, thin: float) -> None:
    target, one, middle = setting(d, share, thin)
    rng = np.random.default_rng(0)
    top = target.problem.bounds[:, 1]
    assert missed(target, middle, target.to_s(one.exact(4000, rng) * top), rng) == ()
    broad = 0.1 * rng.normal(size=(4000, d))
    told = missed(target, middle, target.to_s(broad * top), rng)
    assert len(told) == 1 and "have missed it" in told[0]
    expected = float(told[0].split("should hold ")[1].split(" %")[0])
    assert expected == pytest.approx(90 * share, rel=0.25)


def test_an_optimum_without_weight_is_no_reason() -> None:
    target, _, middle = setting(3, 1e-6, 1e-2)
    rng = np.random.default_rng(0)
    s = target.to_s(0.1 * rng.normal(size=(4000, 3)) * target.problem.bounds[:, 1])
    assert missed(target, middle, s, rng) == ()
    assert missed(target, middle, s + 100.0, rng) == ()       # nothing to judge by
