"""The sampler against posteriors known in closed form, and its promises: resumed runs, workers, refusals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import emcee
import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.arviz_export import to_inference_data, write_netcdf
from bayes_nlsid.inference.ensemble import _snooker_class, moves, sample
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.inference.prior import Prior, default_priors
from bayes_nlsid.model import Element, Model
from tests.identification.truth import beam
from tests.inference.targets import Written, lend, run


def flat_priors(problem):
    return tuple(Prior(n, "", "uniform", low, high) for n, (low, high) in zip(problem.names, problem.bounds.tolist(), strict=True))


def gaussian(x):
    """Independent normals at 0.2 and −0.1 with sd 0.03 and 0.05 of the bound."""
    return -0.5 * (((x[:, 0] - 0.2) / 0.03) ** 2 + ((x[:, 1] + 0.1) / 0.05) ** 2)


def settled(likelihood, start, **options):
    return sample(start, likelihood=likelihood, priors=flat_priors(start.problem), seed=3, **{"most": 4000, **options})


@pytest.mark.parametrize("scale", [0.01, pytest.param(100.0, marks=pytest.mark.slow)])
def test_moves_leave_a_gaussian_as_it_is(scale):
    """Own snooker alone and the whole mix, whatever the unit: variance and mean of a 4-dimensional normal."""
    for chosen in ([(_snooker_class()(), 1.0)], moves()):
        sampler = emcee.EnsembleSampler(40, 4, lambda x: -0.5 * np.sum((x / scale) ** 2, axis=1), moves=chosen, vectorize=True)
        start = emcee.State(scale * np.random.default_rng(0).normal(size=(40, 4)), random_state=np.random.RandomState(1).get_state())
        sampler.run_mcmc(start, 1200)
        draws = sampler.get_chain(discard=200, flat=True) / scale
        assert draws.var(axis=0) == pytest.approx(np.ones(4), abs=0.2)
        assert draws.mean(axis=0) == pytest.approx(np.zeros(4), abs=0.15)


def test_a_known_gaussian_is_recovered_and_a_wrong_one_is_not():
    start = lend(2)
    found = settled(Written(start, gaussian), start, ensembles=2)
    x = found.flat / start.problem.bounds[:, 1]
    assert found.status == "ok" and found.convergence.rhat_max < 1.01 and found.convergence.ess_min > 400
    assert x.mean(axis=0) == pytest.approx([0.2, -0.1], abs=0.004)
    assert x.std(axis=0) == pytest.approx([0.03, 0.05], rel=0.06)
    wrong = settled(Written(start, lambda t: gaussian(t) / 2), start, steps=150, most=500, ensembles=2).flat / start.problem.bounds[:, 1]
    assert (wrong.std(axis=0) > 1.25 * np.array([0.03, 0.05])).all()    # the check above can fail


def test_posterior_of_a_coefficient_in_closed_form():
    """Gaussian residual, linear coefficient, normal prior: mean and sd follow by algebra."""
    element = Element(LIBRARY["q|q|"], ("J1",))
    problem = Problem(Model(beam(), (element,)), (run(2.0, 5),), scenario("S2", 3, 0))
    start = fit(problem)
    likelihood = WhittleLikelihood(start)
    prior = default_priors(problem)[0]
    column, base, w = problem.columns[0], problem.base, likelihood.weights
    information = np.sum(w * column**2) + 1 / prior.b**2
    mean, sd = -np.sum(w * column * base) / information, information**-0.5
    assert abs(mean) < 0.5 * prior.upper      # truncation plays no part
    found = sample(start, likelihood=likelihood, seed=1, ensembles=2, steps=400)
    assert found.status == "ok"
    assert found.flat.mean() == pytest.approx(mean, abs=0.1 * sd)
    assert found.flat.std() == pytest.approx(sd, rel=0.08)
    assert abs(mean + 4e5) < 4 * sd


def test_the_posterior_does_not_depend_on_c():
    """A coefficient at two standard deviations, where symlog as a prior would move the median by a factor of a hundred."""
    quantiles = []
    bound = lend(1).problem.bounds[0, 1]
    for c in (1.0, 20 * bound):
        start = lend(1, c)
        likelihood = Written(start, lambda x: -0.5 * ((x[:, 0] - 0.06) / 0.03) ** 2)
        found = sample(start, likelihood=likelihood, seed=2, ensembles=2, steps=250, most=500, block=50)
        quantiles.append(found.quantiles([0.16, 0.5, 0.84])[:, 0] / start.problem.bounds[0, 1])
        assert found.convergence.rhat_max < 1.05
    sd = 0.5 * (quantiles[1][2] - quantiles[1][0])
    for other in quantiles:
        assert other == pytest.approx(quantiles[0], abs=0.2 * sd)


def test_resumed_runs_are_the_same_to_the_last_bit(tmp_path):
    start = lend(2)
    options = {"steps": 50, "block": 50, "ensembles": 2, "most": 300}
    whole = settled(Written(start, gaussian), start, **options)
    calls = []
    part = settled(Written(start, gaussian), start, store=tmp_path, stop=lambda: calls.append(1) or len(calls) == 3, **options)
    assert part.status == "not_converged" and "stopped on request" in part.reasons[0]
    files = sorted(tmp_path.glob("*.npz"))
    assert len(files) == 6
    files[4].unlink()                                   # killed between the two ensembles of a block
    files[-1].write_bytes(files[-1].read_bytes()[:200])   # and the disk lost the end of another file
    again = settled(Written(start, gaussian), start, store=tmp_path, **options)
    assert np.array_equal(again.theta, whole.theta) and np.array_equal(again.log_prob, whole.log_prob)
    with pytest.raises(InputError, match="another model, data, prior"):
        sample(start, likelihood=Written(start, gaussian), priors=flat_priors(start.problem), seed=4, store=tmp_path, **options)


SCRIPT = """
import sys
from tests.inference.test_sampling import settled, slow
from tests.inference.targets import Written, lend
if __name__ == "__main__":
    settled(Written(lend(2), slow), lend(2), store=sys.argv[1], steps=150, block=25, ensembles=2, most=300)
"""


def slow(x):
    time.sleep(2e-4)
    return gaussian(x)


def test_a_killed_run_goes_on_where_it_was(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(tmp_path)], cwd=Path(__file__).parents[2],
                               env={**os.environ, "PYTHONPATH": os.pathsep.join(["src", "."])})
    try:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("*.npz"))) < 5 and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    finally:
        process.wait()
    finished = len(list(tmp_path.glob("ensemble*.npz")))
    assert 5 <= finished < 20    # of 24
    start = lend(2)
    options = {"steps": 150, "block": 25, "ensembles": 2, "most": 300}
    assert np.array_equal(settled(Written(start, slow), start, store=tmp_path, **options).theta,
                          settled(Written(start, gaussian), start, **options).theta)


def test_workers_do_not_change_the_draws():
    elements = (Element(LIBRARY["q|q|"], ("J1",)), Element(LIBRARY["jenkins_memory"], ("J2",), fixed=(("k_t", 4000.0),)))
    problem = Problem(Model(beam(), elements), (run(2.0, 5, 1.0),), scenario("S2", 3, 0))
    start = fit(problem, starts=4)
    one, two = (sample(start, seed=9, steps=50, block=50, ensembles=2, most=100, workers=w) for w in (1, 2))
    assert np.array_equal(one.theta, two.theta) and np.array_equal(one.log_prob, two.log_prob)
    other = sample(start, seed=10, steps=50, block=50, ensembles=2, most=100)
    assert not np.array_equal(one.theta, other.theta)


def begin_at(points):
    """Replace the starts: ensemble e begins at ``points[e]`` (W, P), in units of the bounds."""
    def first(target, middle, count, seeds):
        out = []
        for e, _ in enumerate(seeds):
            s = target.to_s(points[e] * target.problem.bounds[:, 1])
            out.append((s, target(s)))
        return out
    return first


def test_two_modes_far_apart_are_flagged_or_joined(monkeypatch):
    """Modes so narrow and far apart that no walker finds the other: each ensemble looks settled, together they must not.

    A mixture learnt from all ensembles knows both, and gives each its half.
    """
    from bayes_nlsid.inference import ensemble
    start = lend(1)

    def two(x):
        return np.logaddexp(-0.5 * ((x[:, 0] - 0.5) / 1e-4) ** 2, -0.5 * ((x[:, 0] + 0.5) / 1e-4) ** 2)

    monkeypatch.setattr(ensemble, "first_proposal", lambda *_: None)
    scatter = 1e-4 * np.random.default_rng(0).normal(size=(2, 20, 1))
    monkeypatch.setattr(ensemble, "first_walkers", begin_at(scatter + 0.5))
    same = settled(Written(start, two), start, ensembles=2, steps=200, most=1200)
    monkeypatch.setattr(ensemble, "first_walkers", begin_at(scatter + np.array([0.5, -0.5])[:, None, None]))
    joined = settled(Written(start, two), start, ensembles=2, steps=600, most=1400)
    monkeypatch.setattr(ensemble, "learn_proposal", lambda *_: None)
    apart = settled(Written(start, two), start, ensembles=2, steps=300, most=1200)
    assert same.status == "ok"
    assert joined.convergence.converged and np.mean(joined.flat > 0) == pytest.approx(0.5, abs=0.05)
    assert apart.status == "not_converged" and any("disagree" in r for r in apart.reasons)


@pytest.mark.slow
def test_modes_that_can_be_reached_get_their_weight():
    """Nine to one, ten standard deviations apart: full-length differential moves travel between them."""
    start = lend(2)

    def two(x):
        a = np.log(0.9) - 0.5 * np.sum(((x - 0.15) / 0.02) ** 2, axis=1)
        return np.logaddexp(a, np.log(0.1) - 0.5 * np.sum(((x + 0.05) / 0.02) ** 2, axis=1))

    found = settled(Written(start, two), start, walkers=40, ensembles=2, steps=1500)
    share = np.mean(found.flat[:, 0] / start.problem.bounds[0, 1] > 0.05)
    assert share == pytest.approx(0.9, abs=0.06)


def test_stuck_walkers_are_redrawn_in_burn_in_and_counted(monkeypatch):
    """A needle far below the main peak holds the walker that starts in it."""
    from bayes_nlsid.inference import ensemble
    start = lend(2)

    def trap(x):
        needle = -200 - 0.5 * np.sum(((x + 0.9) / 1e-7) ** 2, axis=1)
        return np.logaddexp(-0.5 * np.sum(((x - 0.2) / 0.01) ** 2, axis=1), needle)

    points = 0.2 + 0.01 * np.random.default_rng(0).normal(size=(2, 20, 2))
    points[:, 0] = -0.9
    monkeypatch.setattr(ensemble, "first_walkers", begin_at(points))
    freed = settled(Written(start, trap), start, ensembles=2, steps=200)
    assert freed.convergence.stuck_walkers == 0    # a proposal from the mixture frees it
    for name in ("learn_proposal", "first_proposal"):
        monkeypatch.setattr(ensemble, name, lambda *_: None)
    found = settled(Written(start, trap), start, ensembles=2, steps=200)
    assert found.convergence.stuck_walkers == 2
    assert (found.flat > 0).all()


def test_ctrl_c_returns_what_there_is():
    start = lend(1)
    calls = [0]

    def interrupt(x):
        calls[0] += 1
        if calls[0] > 2600:
            raise KeyboardInterrupt
        return -0.5 * (x[:, 0] / 0.1) ** 2

    found = sample(start, likelihood=Written(start, interrupt), seed=0, steps=5000, ensembles=2, block=100)
    assert found.status == "not_converged" and "keyboard" in found.reasons[0] and found.theta.shape[1] > 0


def test_progress_and_refusals():
    start = lend(1)
    likelihood = Written(start, lambda x: -0.5 * (x[:, 0] / 0.1) ** 2)
    seen = []
    sample(start, likelihood=likelihood, seed=0, steps=100, most=400, ensembles=2, block=50,
           progress=lambda share, text: seen.append((share, text)))
    assert seen[-1][0] == 1.0 and "steps of about" in seen[0][1] and all(0 <= share <= 1 for share, _ in seen)
    for wrong in ({"walkers": 3}, {"walkers": 21}, {"ensembles": 0}, {"block": 1}, {"most": 10}):
        with pytest.raises(ValueError, match="walkers"):
            sample(start, likelihood=likelihood, **wrong)
    with pytest.raises(InputError, match="finite posterior density"):
        sample(start, likelihood=Written(start, lambda x: np.full(len(x), -np.inf)))


def test_failed_evaluations_are_counted_with_their_place():
    start = lend(1)
    likelihood = Written(start, lambda x: np.where(x[:, 0] > 0.05, -np.inf, -0.5 * (x[:, 0] / 0.1) ** 2))
    found = sample(start, likelihood=likelihood, seed=0, steps=100, most=400, ensembles=2, block=50)
    assert found.failures > 0 and (found.failed_at / start.problem.bounds[0, 1] > 0.05).all()


def test_inference_data_and_netcdf(tmp_path):
    problem = Problem(Model(beam(), (Element(LIBRARY["q|q|"], ("J1",)),), (0,)), (run(2.0, 5),), scenario("S2", 3, 0))
    start = fit(problem)
    likelihood = WhittleLikelihood(start)
    found = sample(start, likelihood=likelihood, seed=1, steps=60, most=400, ensembles=2, block=20)
    data = to_inference_data(found, likelihood, blocks_of=40)
    assert set(data.groups()) == {"posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data"}
    assert "physical parameter" in data["constant_data"].attrs["prior_space"]
    chain = data["posterior"]["q|q|[J1].c"]
    assert chain.shape == (2 * 20, found.theta.shape[1]) and chain.attrs["units"] == "N/m^2"
    assert np.array_equal(chain.values[20], found.theta[1, :, 0, 2])
    part = data["log_likelihood"]["blocks"]
    theta = data["posterior"].sel(chain=part.chain, draw=part.draw)
    rows = np.stack([theta[n].values for n in found.names], axis=-1).reshape(-1, 3)
    assert part.values.sum(axis=-1).reshape(-1) == pytest.approx(likelihood.log_likelihood(rows), rel=1e-9)
    write_netcdf(data, tmp_path / "posterior.nc")
    import arviz
    again = arviz.from_netcdf(tmp_path / "posterior.nc", engine="h5netcdf")
    assert np.array_equal(again["posterior"]["f[1]"].values, data["posterior"]["f[1]"].values)
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]
