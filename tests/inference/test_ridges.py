"""Coordinates of the walk: one to one, with the right determinant, and straight where the posterior of an Iwan joint is bent."""

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.convergence import nested_rhat
from bayes_nlsid.inference.ensemble import sample
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.inference.prior import default_priors, sample_priors
from bayes_nlsid.inference.starting import centres, first_proposal, neighbourhoods, starting_fits
from bayes_nlsid.inference.target import Target
from bayes_nlsid.model import Element, Model
from tests.identification.truth import beam
from tests.inference.targets import Written, run


def problem(term="iwan4", excess=True, places=64):
    return Problem(Model(beam(), (Element(LIBRARY[term], ("J1",), excess=excess),)), (run(),), scenario("S2", 3, 0), places=places)


def target(one):
    likelihood = Written(fit(one, starts=2), lambda x: np.zeros(len(x)))
    return Target(likelihood, default_priors(one))


CASES = [("iwan4", True), ("iwan4", False), ("iwan5", True)]


@pytest.mark.parametrize(("term", "excess"), CASES)
def test_the_map_is_one_to_one_and_its_determinant_is_stated(term, excess):
    one = target(problem(term, excess))
    s = one.to_s(sample_priors(one.priors, 40, np.random.default_rng(0)))
    ridges = one.ridges
    z = ridges.to_walk(s)
    assert not np.allclose(z, s)
    assert ridges.to_s(z) == pytest.approx(s, abs=1e-9)
    numerical = [np.linalg.slogdet(ridges.turn(x))[1] for x in s]
    assert ridges.log_jacobian(z) == pytest.approx(numerical, abs=1e-3)


def test_beyond_the_range_of_the_law_there_is_no_density_and_no_warning():
    one = target(problem())
    z = np.repeat(one.ridges.to_walk(one.to_s(sample_priors(one.priors, 1, np.random.default_rng(1)))), 4, axis=0)
    z[0, 2], z[1, 3], z[2, 0], z[3, 1] = -3.0, -1.0, 1e4, -1e4
    assert np.isneginf(one.along(z)).all()


def test_below_macroslip_two_directions_leave_the_force_as_it_is():
    one = target(problem(places=0))
    theta = np.array([25.0, 5e3, -0.4, 0.2])
    z = one.ridges.to_walk(one.to_s(theta))
    moved = np.stack([z, z, z, z])
    moved[1, 1] += 0.3          # macroslip begins at twice the displacement
    moved[2, 3] += 0.1          # beta
    moved[3, 0] += 0.1          # C
    reach = one.problem.observed.peak("J1")[0]
    assert 10 ** z[1] > reach
    q = np.linspace(0, reach, 50)
    term = LIBRARY["iwan4"]
    force = [term.static_force(q, 0 * q, p) - p[1] * q for p in one.to_theta(one.ridges.to_s(moved))]
    assert force[1] == pytest.approx(force[0], rel=1e-9)
    assert force[2] == pytest.approx(force[0], rel=1e-9)
    assert not np.allclose(force[3], force[0], rtol=0.05)


@pytest.mark.parametrize("excess", [True, False])
def test_without_recordings_the_draws_follow_the_prior(excess):
    """A determinant that is left out or has the wrong sign shifts chi."""
    one = problem(excess=excess)
    start = fit(one, starts=2)
    priors = default_priors(one)
    found = sample(start, likelihood=Written(start, lambda x: np.zeros(len(x))), priors=priors, ensembles=2, walkers=40, steps=1500, seed=2)
    shares = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    for i, prior in enumerate(priors):
        within = np.mean(found.flat[:, i, None] < prior.quantile(shares), axis=0)
        assert within == pytest.approx(shares, abs=0.04), prior.name


def test_the_posterior_of_a_joint_below_macroslip_is_found_at_once():
    """Walkers begin spread along what is not informed, and the first proposal is good before they move."""
    one = problem()
    q = one.data[0].q[:, 0]
    truth = np.array([25.0, 5e3, -0.4, 0.2])
    force = LIBRARY["iwan4"].static_force(q, 0 * q, truth) - truth[1] * q
    row = one.model.linear.rows(("J1",))[0]
    from dataclasses import replace
    own = one.data[0]
    softer = -4e5 * q * np.abs(q)
    data = replace(own, force=own.force + np.outer(force - softer, row)[:, list(own.modes)])
    one = Problem(one.model, (data,), one.scenario, places=64)
    start = fit(one, starts=20, seed=1)
    likelihood = WhittleLikelihood(start)
    aim = Target(likelihood, default_priors(one))
    around = neighbourhoods(aim, centres(aim, starting_fits(start, likelihood)))
    proposal = first_proposal(aim, around, np.random.SeedSequence(0))
    assert proposal is not None
    z = proposal.sample(2000, np.random.default_rng(0))
    log = aim.along(z) - proposal.log_density(z)
    weight = np.exp(log - log.max())
    assert weight.sum() ** 2 / (weight**2).sum() > 60
    found = sample(start, likelihood=likelihood, ensembles=2, steps=400, seed=3)
    assert found.convergence.tau.max() < 40
    assert max(nested_rhat(found.theta[..., i]) for i in range(4)) < 1.02
