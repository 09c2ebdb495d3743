"""Proposals of bent parameters: a density that integrates to one, draws that follow it, walls that one bell alone would not respect."""

import numpy as np
import pytest

from bayes_nlsid.inference.mixture import learn_mixture
from bayes_nlsid.inference.proposal import KNOTS, Margins, learn_proposal

SEED = np.random.SeedSequence(4)


def box(count, seed):
    """Six numbers without any information between walls, and one that leans on the first."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(count, 7))
    x[:, 6] = x[:, 0] + 0.01 * rng.normal(size=count)
    return x


def share(proposal, draws):
    """Of proposals that an independence chain in ``box`` accepts."""
    z = proposal.sample(len(draws), np.random.default_rng(0))
    inside = ((z[:, :6] > 0) & (z[:, :6] < 1)).all(axis=1)

    def log(x):
        return -0.5 * ((x[:, 6] - x[:, 0]) / 0.01) ** 2 - proposal.log_density(x)

    return np.mean(np.where(inside, np.exp(np.minimum(0.0, log(z) - log(draws))), 0.0))


def test_walls_are_kept():
    draws = box(6000, 0)
    bent, plain = learn_proposal(draws, SEED), learn_mixture(draws, SEED)
    assert bent is not None and plain is not None
    assert share(bent, box(4000, 1)) > max(0.3, 1.5 * share(plain, box(4000, 1)))


def test_the_density_integrates_to_what_the_mixture_does():
    rng = np.random.default_rng(2)
    found = learn_proposal(rng.exponential(size=(5000, 1)) ** 2, SEED)
    assert found is not None
    x = np.linspace(-30, 80, 400_001)[:, None]
    u, _ = found.margins.bend(x)
    mine = np.trapezoid(np.exp(found.log_density(x)), x[:, 0])
    plain = np.linspace(-12, 12, 40_001)[:, None]
    assert mine == pytest.approx(np.trapezoid(np.exp(found.mixture.log_density(plain)), plain[:, 0]), rel=0.01)
    drawn = found.sample(20_000, rng)[:, 0]
    for point in (0.1, 0.5, 2.0, 6.0):
        below = x[:, 0] < point
        assert np.mean(drawn < point) == pytest.approx(np.trapezoid(np.exp(found.log_density(x[below])), x[below, 0]) / mine, abs=0.02)
    assert found.margins.straighten(u) == pytest.approx(x, abs=1e-9)


def test_too_little_and_nonsense():
    assert learn_proposal(np.zeros((500, 2)), SEED) is None
    assert learn_proposal(np.random.default_rng(0).normal(size=(10, 2)), SEED) is None
    with pytest.raises(ValueError, match="ascend"):
        Margins(np.zeros((2, len(KNOTS))))
    with pytest.raises(ValueError, match="shape"):
        Margins(np.arange(6.0).reshape(2, 3))
