"""Values that scatter around a common one: against direct integration over the common value and the scatter, and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.stats import halfnorm, multivariate_normal, norm

from bayes_nlsid.inference.ensemble import sample
from bayes_nlsid.inference.pooling import LEAST, MOST, Pool
from bayes_nlsid.inference.prior import Prior, check_priors, groups, log_prior, pool, sample_priors
from tests.inference.targets import Written, lend

BOX = np.array([[-8.0, 8.0], [-8.0, 8.0], [-7.0, 8.0]])
WIDE = np.tile([-np.inf, np.inf], (3, 1))


def hyper(tau: float, scatter: float) -> float:
    """Density of the scatter between joints, cut where the grid ends."""
    mass = halfnorm.cdf(MOST) - halfnorm.cdf(LEAST)
    return halfnorm.pdf(tau, scale=scatter) / mass


@pytest.mark.parametrize("z", [[0.1, 0.2, 0.15], [-1.0, 2.0, 0.3], [3.0, 3.4, 2.9]])
@pytest.mark.parametrize(("mean", "sd"), [(0.5, 1.2), (0.0, np.inf)])
def test_density_is_the_integral_over_common_value_and_scatter(z, mean, sd):
    found, values = Pool(0.5, BOX, mean, sd), np.array(z)
    low, high = found.edges
    mass = norm.cdf(high, mean, sd) - norm.cdf(low, mean, sd) if np.isfinite(sd) else high - low

    def integrand(mu: float, log_tau: float) -> float:
        tau = np.exp(log_tau)
        common = norm.pdf(mu, mean, sd) if np.isfinite(sd) else 1.0
        return tau * hyper(tau, 0.5) * common / mass * np.prod(np.exp(-0.5 * ((values - mu) / tau) ** 2) / (np.sqrt(2 * np.pi) * tau))

    # beyond ten standard deviations of its conditional distribution the common value adds nothing
    def span(log_tau: float) -> tuple[float, float]:
        width = 10 * np.exp(log_tau) / np.sqrt(3)
        return max(low, values.mean() - width), min(high, values.mean() + width)

    direct = dblquad(integrand, np.log(0.5 * LEAST), np.log(0.5 * MOST), lambda t: span(t)[0], lambda t: span(t)[1],
                     epsabs=0, epsrel=1e-7)[0]
    assert np.exp(found.log_density(values) + found.log_inside) == pytest.approx(direct, rel=2e-3)


def test_for_every_scatter_it_is_the_normal_distribution_with_a_common_part():
    found = Pool(0.3, WIDE, 1.0, 0.8)
    z = np.random.default_rng(0).normal(size=(5, 3))
    for k in (0, 20, 63):
        exact = multivariate_normal(np.ones(3), 0.64 + found.tau[k] ** 2 * np.eye(3)).logpdf(z)
        assert found.by_node(z)[:, k] - found.log_weight[k] == pytest.approx(exact, rel=1e-9)


def test_the_density_of_two_joints_integrates_to_one_within_their_bounds():
    found = Pool(0.4, np.array([[-1.0, 0.5], [-0.3, 1.0]]), 0.2, 0.5)
    total = dblquad(lambda y, x: np.exp(found.log_density(np.array([x, y]))), -1.0, 0.5, -0.3, 1.0, epsabs=1e-4)[0]
    assert total == pytest.approx(1.0, abs=2e-3)
    assert found.log_density(np.array([0.6, 0.0])) == -np.inf


def test_draws_and_quantiles_are_those_of_the_density():
    found = Pool(0.4, np.array([[-1.0, 0.5], [-0.3, 1.0]]), 0.2, 0.5)
    z = found.sample(40_000, np.random.default_rng(1))
    edges = np.linspace(-1.0, 0.5, 7)
    counted = np.histogram(z[:, 0], edges)[0] / len(z)
    direct = [dblquad(lambda y, x: np.exp(found.log_density(np.array([x, y]))), a, b, -0.3, 1.0, epsabs=1e-4)[0]
              for a, b in zip(edges, edges[1:], strict=False)]
    assert counted == pytest.approx(direct, abs=0.01)
    alone = Pool(0.4, found.box[:1], 0.2, 0.5)
    q = float(alone.quantile(0.3))
    assert quad(lambda x: np.exp(alone.log_density(np.array([x]))), -1.0, q)[0] == pytest.approx(0.3, abs=1e-4)


def test_common_value_and_scatter_of_draws():
    """What is drawn of mu and tau given z has the moments of the conditional distribution; and drawn with z, those of the prior."""
    found, rng = Pool(0.5, WIDE, 0.0, 2.0), np.random.default_rng(2)
    z = found.sample(30_000, rng)
    mu, tau = found.common(z, rng)
    assert [mu.mean(), mu.std()] == pytest.approx([0.0, 2.0], abs=0.05)
    assert np.quantile(tau, [0.1, 0.5, 0.9]) == pytest.approx(halfnorm.ppf([0.1, 0.5, 0.9], scale=0.5), abs=0.03)
    same = np.tile([1.0, 1.2, 0.8], (4000, 1))
    mu, tau = found.common(same, rng)
    assert mu.mean() == pytest.approx(1.0, abs=0.02) and np.median(tau) < 0.4


def test_a_flat_common_value_is_drawn_too():
    found = Pool(0.5, BOX)
    z = found.sample(5000, np.random.default_rng(0))
    mu, _ = found.common(z, np.random.default_rng(1))
    assert mu.mean() == pytest.approx(0.25, abs=0.4) and np.abs(mu - z.mean(axis=1)).mean() < 0.5


@pytest.mark.parametrize("bad", [{"scatter": 0.0}, {"sd": 0.0}, {"box": np.zeros((2, 2))}, {"box": np.zeros(3)}, {"box": WIDE}])
def test_wrong_pools_are_refused(bad):
    with pytest.raises(ValueError, match="scatter|box|bounds"):
        Pool(**({"scatter": 0.3, "box": BOX} | bad))


# -- in priors --------------------------------------------------------------------------------------------------------------------------


def shared(count: int = 2, scatter: float = 0.02, sd: float = 0.5) -> tuple[Prior, ...]:
    """Priors of a lent problem whose coefficients are said to be nominally equal, over their upper bounds."""
    problem = lend(count).problem
    top = problem.bounds[:, 1]
    return tuple(Prior(n, "", "normal", -t, t, 0.0, sd * t, "all", scatter * t) for n, t in zip(problem.names, top, strict=True))


def test_the_group_is_one_density_whatever_c():
    """By log_prior in two search coordinates with different constants: the same density of theta."""
    first = Prior("a", "N", "lognormal", 1.0, 1e4, 100.0, 0.5, "g", 0.3)
    second = replace(first, name="b", lower=2.0)
    theta = np.array([[80.0, 120.0], [10.0, 500.0], [1.5, 3.0]])
    z = np.log(theta)
    direct = pool((first, second)).log_density(z) - z.sum(axis=1)
    from bayes_nlsid.identification.coordinates import Coordinates
    for scale in (np.zeros(2), np.array([1e-3, 1e3])):
        coordinates = Coordinates(scale)
        s = coordinates.to_s(theta)
        assert log_prior(coordinates, (first, second), s) - coordinates.log_jacobian(s).sum(axis=1) == pytest.approx(direct, rel=1e-9)
    outside = Coordinates(np.zeros(2))
    assert log_prior(outside, (first, second), outside.to_s(np.array([[80.0, 1.9]])))[0] == -np.inf
    assert groups((first, second)) == {"g": (0, 1)}


def test_joint_draws_resemble_each_other_as_the_prior_says():
    first = Prior("a", "N", "lognormal", 1e-3, 1e7, 100.0, 1.0, "g", 0.2)
    lone = Prior("x", "", "uniform", 0.0, 1.0)
    draws = sample_priors((first, lone, replace(first, name="b")), 20_000, np.random.default_rng(0))
    z = np.log(draws[:, [0, 2]])
    assert np.var(z[:, 0]) == pytest.approx(1 + 0.04, rel=0.05)
    assert np.var(z[:, 0] - z[:, 1]) == pytest.approx(2 * 0.04, rel=0.08)     # E tau² of a half-normal is its scale squared
    assert np.corrcoef(draws[:, 1], z[:, 0])[0, 1] == pytest.approx(0.0, abs=0.03)


def test_groups_that_disagree_are_refused():
    problem = lend(2).problem
    with pytest.raises(ValueError, match="group 'all' differ"):
        check_priors(problem, shared())
    with pytest.raises(ValueError, match="a group needs a positive scatter"):
        Prior("a", "", "uniform", 0.0, 1.0, group="g")
    with pytest.raises(ValueError, match="a group needs a positive scatter"):
        Prior("a", "", "uniform", 0.0, 1.0, scatter=0.1)


def test_an_uninformed_joint_is_drawn_towards_the_others():
    """Three joints, two of them measured: the posterior of the third follows the common value, and shrinkage is that of the normal
    model, found by direct integration over the scatter."""
    start = lend(3)
    top = float(start.problem.bounds[:, 1].min())
    unit = top / start.problem.bounds[:, 1]      # Written hands theta over its own bound; all three in units of the smallest
    priors = tuple(Prior(n, "", "normal", -top, top, 0.0, 0.2 * top, "all", 0.03 * top) for n in start.problem.names)
    measured, error = np.array([0.10, 0.14]), 0.02

    def likelihood(x: np.ndarray) -> np.ndarray:
        seen = (x / unit)[:, :2]
        return -0.5 * np.sum(((seen - measured) / error) ** 2, axis=1)

    found = sample(start, likelihood=Written(start, likelihood), priors=priors, seed=2, ensembles=2, most=6000)
    draws = found.flat / top

    def moments(tau: float) -> tuple[float, np.ndarray, np.ndarray]:
        prior = 0.04 + tau**2 * np.eye(3)
        gain = prior[:, :2] @ np.linalg.inv(prior[:2, :2] + error**2 * np.eye(2))
        return (multivariate_normal(np.zeros(2), prior[:2, :2] + error**2 * np.eye(2)).pdf(measured), gain @ measured,
                np.diag(prior - gain @ prior[:2]))

    def mean_of(function) -> float:
        grid = np.linspace(0.03 * LEAST, 0.03 * MOST, 4001)
        weight = np.array([hyper(t, 0.03) * moments(t)[0] for t in grid])
        return float(np.trapezoid(weight * np.array([function(*moments(t)[1:]) for t in grid]), grid) / np.trapezoid(weight, grid))

    exact = [mean_of(lambda m, v, i=i: m[i]) for i in range(3)]
    spread = [np.sqrt(mean_of(lambda m, v, i=i: m[i] ** 2 + v[i]) - exact[i] ** 2) for i in range(3)]
    assert found.convergence.converged, found.reasons
    assert draws.mean(axis=0) == pytest.approx(exact, abs=0.004)
    assert draws.std(axis=0) == pytest.approx(spread, rel=0.12)
    # towards each other, and the unmeasured one between them, far narrower than the prior of the common value
    assert 0.101 < draws[:, 0].mean() < draws[:, 2].mean() < draws[:, 1].mean() < 0.139
    assert draws[:, 2].std() < 0.3 * 0.2
