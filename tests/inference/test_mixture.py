"""The mixture that proposes: its density, what it learns, and that proposals from it leave the target as it is."""

import emcee
import numpy as np
import pytest
from scipy import stats

from bayes_nlsid.inference.ensemble import _fresh_class, moves
from bayes_nlsid.inference.mixture import FREEDOM, Mixture, learn_mixture

SEED = np.random.SeedSequence(4)


def two():
    return Mixture(np.array([0.3, 0.7]), np.array([[0.0, 0.0], [4.0, 1.0]]),
                   np.array([[[1.0, 0.0], [0.5, 0.2]], [[0.3, 0.0], [-0.1, 0.6]]]))


def test_density_is_that_of_t_distributions():
    s = np.random.default_rng(0).normal(size=(50, 2)) * 3
    truth = np.log(sum(w * stats.multivariate_t(m, r @ r.T, df=FREEDOM).pdf(s)
                       for w, m, r in zip(two().weights, two().means, two().roots, strict=True)))
    difference = two().log_density(s) - truth
    assert difference == pytest.approx(np.full(50, difference[0]), abs=1e-10)


def test_draws_follow_the_density():
    s = two().sample(40_000, np.random.default_rng(1))
    assert np.mean(s[:, 0] > 2) == pytest.approx(0.7, abs=0.02)
    first = stats.multivariate_t(two().means[0], two().roots[0] @ two().roots[0].T, df=FREEDOM)
    near = s[s[:, 0] < 1.5]
    expected = first.rvs(40_000, random_state=2)
    assert near[:, 1].std() == pytest.approx(expected[expected[:, 0] < 1.5][:, 1].std(), rel=0.06)


def test_a_curved_ridge_is_covered_and_a_normal_cloud_needs_one_piece():
    rng = np.random.default_rng(3)
    x = rng.normal(size=6000)
    ridge = np.stack([x, x**2 + 0.02 * rng.normal(size=6000)], axis=1)
    found = learn_mixture(ridge, SEED)
    assert found is not None and len(found.weights) >= 8
    off = np.abs(np.diff(found.sample(2000, np.random.default_rng(0))[:, [0, 1]] ** [2, 1], axis=1)[:, 0])
    assert np.median(off) < 0.05    # one bell over the whole ridge is off by about one
    cloud = learn_mixture(rng.normal(size=(6000, 3)) @ np.array([[1e-3, 0, 0], [5.0, 1, 0], [2.0, 3.0, 1e4]]), SEED)
    assert cloud is not None and len(cloud.weights) == 1


def test_too_little_to_learn_from():
    rng = np.random.default_rng(5)
    assert learn_mixture(rng.normal(size=(20, 6)), SEED) is None
    still = rng.normal(size=(500, 2))
    still[:, 1] = 3.0
    assert learn_mixture(still, SEED) is None
    assert learn_mixture(np.repeat(rng.normal(size=(10, 3)), 100, axis=0), SEED) is None    # walkers that do not move are not many draws


@pytest.mark.parametrize("parts", ["fresh alone", "all moves"])
def test_a_wrong_mixture_changes_nothing_but_speed(parts):
    """Proposals from a mixture that is shifted, tilted and too wide: mean and covariance of the target come out all the same."""
    covariance = np.array([[1.0, 0.8], [0.8, 1.0]])
    root = np.linalg.inv(covariance)
    wrong = Mixture(np.array([0.5, 0.5]), np.array([[0.8, -0.5], [-1.0, 0.0]]), np.stack([np.diag([1.5, 1.0]), np.diag([1.0, 2.0])]))
    chosen = [(_fresh_class()(wrong), 1.0)] if parts == "fresh alone" else moves(wrong)
    sampler = emcee.EnsembleSampler(40, 2, lambda x: -0.5 * np.einsum("ni,ij,nj->n", x, root, x), moves=chosen, vectorize=True)
    start = emcee.State(np.random.default_rng(0).normal(size=(40, 2)), random_state=np.random.RandomState(1).get_state())
    sampler.run_mcmc(start, 2500)
    draws = sampler.get_chain(discard=300, flat=True)
    assert draws.mean(axis=0) == pytest.approx(np.zeros(2), abs=0.05)
    assert np.cov(draws.T) == pytest.approx(covariance, abs=0.06)


def test_parts_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="sum to one"):
        Mixture(np.array([0.5, 0.6]), np.zeros((2, 1)), np.ones((2, 1, 1)))
    with pytest.raises(ValueError, match="fit together"):
        Mixture(np.array([1.0]), np.zeros((2, 1)), np.ones((2, 1, 1)))
    with pytest.raises(ValueError, match="singular"):
        Mixture(np.array([1.0]), np.zeros((1, 1)), np.zeros((1, 1, 1)))
