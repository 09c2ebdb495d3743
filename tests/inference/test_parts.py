"""Priors, likelihoods, diagnostics, storage: each against what is known in closed form."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from bayes_nlsid.errors import InputError
from bayes_nlsid.executors import packed
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference import convergence as cv
from bayes_nlsid.inference.likelihood import GaussianResidual, PlainLikelihood, WhittleLikelihood, frequency_blocks, laplace
from bayes_nlsid.inference.posterior import Posterior, load
from bayes_nlsid.inference.prior import Prior, check_priors, default_priors, log_prior
from bayes_nlsid.inference.target import Target
from bayes_nlsid.model import Element, Model
from tests.identification.truth import beam, prescribed
from tests.identification.truth import pack as modal
from tests.inference.targets import lend, run

PRIORS = [Prior("p", "N", "normal", -3.0, 5.0, 1.0, 2.0), Prior("p", "N", "normal", 4.0, 5.0, 0.0, 1.0),
          Prior("p", "", "lognormal", 0.1, 50.0, 2.0, 0.7),
          Prior("p", "", "uniform", -2.0, 7.0), Prior("p", "", "loguniform", 1e-6, 1e3), Prior("p", "", "halfnormal", 0.0, 3.0, 0.0, 1.5),
          Prior("p", "", "logitnormal", -1.0, 0.0, 0.5, 1.2), Prior("p", "N", "lognormal", 0.1, 50.0, 2.0, 0.7, "p", 0.3),
          Prior("p", "", "logitnormal", -1.0, 0.0, 0.5, 1.2, "p", 0.3), Prior("p", "", "loguniform", 1e-2, 1e3, group="p", scatter=0.5)]


@pytest.mark.parametrize("prior", PRIORS, ids=lambda p: p.kind + p.group)
def test_densities_integrate_to_one_and_quantiles_invert_them(prior):
    if prior.kind == "loguniform":
        total = quad(lambda t: np.exp(prior.log_density(np.exp(t)) + t), np.log(prior.lower), np.log(prior.upper))[0]
    else:
        total = quad(lambda p: np.exp(prior.log_density(p)), prior.lower, prior.upper)[0]
    # what of a group's prior lies inside its bounds is a sum over some hundred quantiles
    exact = 1e-4 if prior.group else 1e-6
    assert total == pytest.approx(1.0, rel=exact)
    shares = np.array([0.01, 0.3, 0.5, 0.99])
    for share, p in zip(shares, prior.quantile(shares), strict=True):
        start = prior.lower
        if prior.kind == "loguniform":
            below = quad(lambda t: np.exp(prior.log_density(np.exp(t)) + t), np.log(start), np.log(p))[0]
        else:
            below = quad(lambda x: np.exp(prior.log_density(x)), start, p, limit=200)[0]
        assert below == pytest.approx(share, abs=exact)
    assert prior.log_density(prior.upper + 1.0) == -np.inf and prior.log_density(prior.lower - 1.0) == -np.inf


@settings(max_examples=30, deadline=None)
@given(st.floats(-8, 8), st.floats(0.05, 4), st.floats(0, 1))
def test_truncated_normal_far_in_its_tail(mean, sd, share):
    """Against scipy's survival functions; far tails must neither overflow nor lose the mass."""
    low, high = 0.0, 3.0
    prior = Prior("p", "", "normal", low, high, mean, sd) if abs(mean) < 5 * sd else None
    if prior is None:
        return
    mass = norm.cdf(high, mean, sd) - norm.cdf(low, mean, sd)
    p = float(prior.quantile(share))
    assert low <= p <= high
    assert prior.log_density(p) == pytest.approx(norm.logpdf(p, mean, sd) - np.log(mass), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("c", [1.0, 1e6, 1e-3])
def test_prior_in_search_coordinates_integrates_to_one(c):
    """The Jacobian makes it a density of s, whatever c."""
    problem = lend(1, c).problem
    priors = default_priors(problem)
    low, high = problem.to_s(problem.bounds.T)[:, 0]
    s = np.linspace(low, high, 400_001)
    assert np.trapezoid(np.exp(log_prior(problem.coordinates, priors, s[:, None])), s) == pytest.approx(1.0, rel=1e-4)


def test_default_priors_say_what_the_modal_test_knew():
    model = replace(beam(), omega_sd=np.full(3, 1e-3), zeta_sd=np.full(3, 0.05))
    elements = (Element(LIBRARY["cubic"], ("J1",)), Element(LIBRARY["iwan4_memory"], ("J2",)))
    problem = Problem(Model(model, elements, (0,)), (run(),), scenario("S2", 3, 0))
    priors = {p.name: p for p in default_priors(problem)}
    assert priors["f[1]"].b == pytest.approx(0.02) and priors["zeta[1]"].b == pytest.approx(5e-4)
    assert priors["cubic[J1].c"].b == pytest.approx(0.1 * priors["cubic[J1].c"].upper)
    assert {priors[f"iwan4_memory[J2].{n}"].kind for n in ("f_s", "k_t")} == {"loguniform"}
    assert priors["iwan4_memory[J2].chi"].kind == "uniform"
    assert "90 % between" in priors["f[1]"].sentence


def test_wrong_priors_are_refused():
    problem = lend(2).problem
    priors = default_priors(problem)
    with pytest.raises(ValueError, match="priors are given for"):
        check_priors(problem, priors[:1])
    with pytest.raises(ValueError, match="outside its bounds"):
        check_priors(problem, (replace(priors[0], upper=2 * priors[0].upper), priors[1]))
    for bad in ({"kind": "gamma"}, {"b": 0.0}, {"lower": 1.0, "upper": 0.0}, {"kind": "lognormal", "lower": -1.0},
                {"kind": "halfnormal", "lower": -1.0},
                {"lower": 50.0, "upper": 51.0}):
        with pytest.raises(ValueError, match="prior of 'p'"):
            replace(Prior("p", "", "normal", -1.0, 1.0), **bad)


# -- likelihood ---------------------------------------------------------------------------------------------------------------------


def two_ways(problem, theta, variance):
    """The quadratic form and the plain sum."""
    gaussian = GaussianResidual(problem, variance, frequency_blocks(problem)[0])
    information = np.array([s.information for s in problem.observed.spectra])[problem.record]
    direct = [float(np.sum(information * norm.logpdf(problem.residual(t), 0, np.sqrt(variance)))) for t in theta]
    return gaussian, np.array(direct) , -0.5 * np.sum((1 - information) * np.log(2 * np.pi * variance)) * 0


@pytest.mark.parametrize("free", [(), (0, 1)])
def test_the_quadratic_form_is_the_sum_of_squares(free):
    elements = tuple(Element(LIBRARY[n], ("J1", "J2")) for n in ("q|q|", "v|v|"))
    problem = Problem(Model(beam(), elements, free), (run(),), scenario("S3", 3, 0))
    rng = np.random.default_rng(0)
    theta = rng.uniform(problem.bounds[:, 0], problem.bounds[:, 1], (6, len(problem.names)))
    variance = np.exp(rng.normal(size=problem.size))
    gaussian, direct, _ = two_ways(problem, theta, variance)
    assert gaussian.total(theta) == pytest.approx(direct, rel=1e-9)
    assert gaussian.by_block(theta).sum(axis=1) == pytest.approx(direct, rel=1e-9)


def test_laws_that_need_evaluation_agree_with_the_sum_too():
    problem = Problem(Model(beam(), (Element(LIBRARY["jenkins_memory"], ("J1",)),), (0,)), (run(),), scenario("S2", 3, 0))
    theta = problem.to_theta(np.random.default_rng(0).uniform(*problem.to_s(problem.bounds.T), (4, 4)))
    gaussian, direct, _ = two_ways(problem, theta, np.full(problem.size, 0.3))
    assert gaussian.total(theta) == pytest.approx(direct, rel=1e-10)


def test_a_failing_law_is_impossible_not_an_error():
    from bayes_nlsid.forces.parameter import Param
    broken = replace(LIBRARY["cubic"], name="broken", linear=False, law=lambda q, v, c: np.where(c > 0, c, np.nan) * q**3,
                     params=(Param("c", "", "range", -2e9, 2e9),))
    problem = Problem(Model(beam(), (Element(broken, ("J1",)),)), (run(),), scenario("S2", 3, 0))
    likelihood = WhittleLikelihood(fit(problem, starts=6))
    target = Target(likelihood, default_priors(problem))
    value, failed = target.parts(target.to_s(np.array([[-1e5], [1e5]])))
    assert value[0] == -np.inf and np.isfinite(value[1]) and failed.tolist() == [True, False]


def test_plain_likelihood_warns():
    with pytest.warns(UserWarning, match="white"):
        plain = PlainLikelihood(lend(1))
    assert "regression" in plain.describe()
    assert np.unique(plain.weights).size == 1


def coloured(seed):
    """A record with 2 % accelerometer noise of falling spectrum, integrated exactly; one mode, known frequency."""
    model = beam(1, 1)
    clean = prescribed(model, lambda q, v: 0 * q, seconds=8.0)
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(clean.n, clean.dt)
    shape = (frequency > 4) * 30 / np.maximum(frequency, 1)
    noise = np.fft.rfft(rng.normal(size=clean.n)) * shape * 0.02 * clean.a.std()
    w = 2j * np.pi * np.maximum(frequency, frequency[1])
    a, v, u = (clean_part + np.fft.irfft(noise / w**k if k else noise, clean.n)[:, None]
               for k, clean_part in enumerate((clean.a, clean.v, clean.u)))
    return modal(model, clean.dt, u, v, a, clean.force, band=(12.0, 60.0))


def test_whittle_covers_under_sensor_noise_and_plain_does_not_know():
    """Laplace intervals of f and zeta over repeated noise: Whittle covers (it is conservative) and is many times shorter than plain."""
    z, ratio = [], []
    for seed in range(40):
        problem = Problem(Model(beam(1, 1), (), (0,)), (coloured(seed),), scenario("S1", 1, 0))
        start = fit(problem)
        whittle = WhittleLikelihood(start)
        spread = Target(whittle, default_priors(problem), problem.coordinates).prior_sd
        sd = np.sqrt(np.diag(laplace(whittle, whittle.fit.theta, spread)))
        z.append((whittle.fit.s - problem.to_s(np.array([20.0, 0.01]))) / sd)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ratio.append(np.sqrt(np.diag(laplace(PlainLikelihood(start), start.theta, spread)))[0] / sd[0])
    cover = np.mean(np.abs(z) < 1.645, axis=0)
    assert (cover >= 0.85).all()
    assert np.median(ratio) > 3


# -- convergence --------------------------------------------------------------------------------------------------------------------


def ar1(rho, shape, rng):
    x = rng.normal(size=shape)
    for i in range(1, shape[1]):
        x[:, i] = rho * x[:, i - 1] + np.sqrt(1 - rho**2) * x[:, i]
    return x


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_autocorrelation_time_of_a_known_process(rho):
    chains = ar1(rho, (3, 4000, 16), np.random.default_rng(1))
    exact = (1 + rho) / (1 - rho)
    assert cv.integrated_time(chains) == pytest.approx(exact, rel=0.1)
    assert cv.chain_ess(chains[0]) == pytest.approx(4000 * 16 / exact, rel=0.15)


def judge(s, acceptance=0.3, log_prob=None, names=None, prior=5.0, **options):
    m, n, w, p = s.shape
    density = -0.5 * np.sum(s**2, axis=-1) if log_prob is None else log_prob
    return cv.assess(s, density, np.full((m, w), acceptance), names=names or [f"p{i}" for i in range(p)],
                     nonlinear=[True] * p, prior_sd=np.full(p, prior), box=np.array([[-50.0] * p, [50.0] * p]), **options)


def test_good_draws_are_called_good():
    found = judge(ar1(0.5, (4, 2000, 20, 2), np.random.default_rng(0)))
    assert found.status == "ok" and found.converged and found.reasons == () and found.rhat_max < 1.01


def test_two_modes_are_flagged():
    """Each ensemble mixes perfectly, in its own mode: nothing within an ensemble shows it."""
    s = ar1(0.5, (4, 2000, 20, 2), np.random.default_rng(0))
    s[2:, ..., 1] += 8.0
    found = judge(s)
    assert not found.converged and found.status == "not_converged" and "disagree on p1" in found.reasons[0]
    alone = judge(s[:1])
    assert alone.status == "not_converged" and "one ensemble" in alone.reasons[0]


def test_an_ensemble_that_stands_still_is_not_converged():
    s = ar1(0.0, (4, 2000, 20, 1), np.random.default_rng(0))
    s[:] = s[:, :1]
    assert judge(s, acceptance=0.0).status == "not_converged"
    some = ar1(0.0, (4, 2000, 20, 1), np.random.default_rng(0))
    some[1] = 0.1
    acceptance = np.full((4, 20), 0.3)
    acceptance[1] = 0.0
    found = cv.assess(some, -0.5 * some[..., 0] ** 2, acceptance, names=["p"], nonlinear=[True], prior_sd=np.ones(1) * 5,
                      box=np.array([[-50.0], [50.0]]))
    assert found.status == "not_converged" and any("stands still" in r for r in found.reasons) and found.stuck_walkers == 20


def test_short_chains_are_not_converged():
    found = judge(ar1(0.95, (4, 400, 20, 1), np.random.default_rng(0)))
    assert found.status == "not_converged" and any("autocorrelation times" in r for r in found.reasons)
    assert judge(np.zeros((4, 0, 20, 1))).status == "not_converged"


def test_uninformed_and_tied_parameters_are_named():
    rng = np.random.default_rng(0)
    ridge = 5.0 * rng.normal(size=(4, 3000, 20))
    s = np.stack([ridge, -ridge + 0.05 * rng.normal(size=ridge.shape), 5.0 * rng.normal(size=ridge.shape),
                  0.1 * rng.normal(size=ridge.shape)], axis=-1)
    names = ["iwan4[J1].f_s", "iwan4[J1].beta", "iwan4[J2].chi", "f[1]"]
    found = judge(s, names=names)
    text = " / ".join(found.reasons)
    assert found.converged and found.status == "not_identifiable"
    assert any(f"{pair} of iwan4[J1] enter only through one number" in text for pair in ("f_s and beta", "beta and f_s"))
    assert "iwan4[J2].chi is not informed" in text and "f[1]" not in text
    assert found.identifiable.tolist() == [False, False, False, True]


def test_a_posterior_far_from_its_prior_and_as_wide_is_a_disagreement():
    s = np.random.default_rng(0).normal(size=(4, 2000, 20, 1)) + 3.0
    told = judge(s, prior=1.0, prior_mean=np.zeros(1)).reasons
    assert len(told) == 1 and "3.0 standard deviations of its prior away" in told[0]
    assert "not informed" in judge(s, prior=1.0, prior_mean=np.full(1, 2.0)).reasons[0]


def test_draws_at_a_bound_are_told():
    s = 50.0 - np.abs(np.random.default_rng(0).normal(size=(4, 2000, 20, 1))) * 0.5
    found = judge(s)
    assert found.status == "not_identifiable" and "at a bound" in found.reasons[0]


def test_a_parameter_spread_over_a_decade_is_not_called_determined():
    s = np.random.default_rng(0).normal(size=(4, 2000, 20, 2)) * np.array([0.4, 0.1])   # log10: 90 % within ± 0.66 and ± 0.16
    found = judge(s, logarithmic=[True, True])
    assert found.identifiable.tolist() == [False, True] and found.status == "not_identifiable"
    assert found.reasons == (f"p0 is known only to within a factor of {10 ** (2 * 1.645 * 0.4):.2g} between its 5 % and 95 % points",)
    assert judge(s, logarithmic=[False, False]).identifiable.all()


def test_walkers_replaced_before_sampling_do_not_spoil_what_came_after():
    s = ar1(0.5, (4, 2000, 20, 2), np.random.default_rng(0))
    assert judge(s, redrawn=30).converged and judge(s, redrawn=30).stuck_walkers == 30
    assert not judge(s, redrawn=41).converged


# -- storage ------------------------------------------------------------------------------------------------------------------------


def a_posterior():
    problem = lend(2).problem
    s = ar1(0.0, (2, 500, 8, 2), np.random.default_rng(0))
    return Posterior(problem.names, tuple(p.unit for p in problem.model.parameters), 1e5 * s, -0.5 * np.sum(s**2, axis=-1), judge(s),
                     default_priors(problem),
                     7, "in words", 100, 3, np.ones((1, 2)))


def test_posterior_returns_from_disk(tmp_path):
    one = a_posterior()
    one.save(tmp_path / "p.npz")
    two = load(tmp_path / "p.npz")
    assert np.array_equal(one.theta, two.theta) and np.array_equal(one.log_prob, two.log_prob)
    assert one.priors == two.priors and one.convergence.reasons == two.convergence.reasons and two.failures == 3
    assert np.array_equal(one.convergence.tau, two.convergence.tau)
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]
    (tmp_path / "p.npz").write_bytes((tmp_path / "p.npz").read_bytes()[:500])
    with pytest.raises(InputError, match="cannot be read as a posterior"):
        load(tmp_path / "p.npz")


def test_draws_and_quantiles():
    one = a_posterior()
    assert np.array_equal(one.draws(50, 1), one.draws(50, 1)) and one.draws(50, 1).shape == (50, 2)
    assert len(np.unique(one.draws(8000, 1), axis=0)) == 8000
    assert one.quantiles()[1] == pytest.approx([0, 0], abs=3e3) and one.quantiles().shape == (3, 2)
    assert one.summary()[0]["name"] == one.names[0]
    with pytest.raises(ValueError, match="cannot take 0"):
        one.draws(0, 1)


def test_a_target_travels_to_another_process():
    target = Target(WhittleLikelihood(lend(2)), default_priors(lend(2).problem))
    s = target.to_s(lend(2).theta)[None]
    assert np.array_equal(pickle.loads(packed(target))(s), target(s))
