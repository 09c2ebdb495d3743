"""Likelihood of simulated recordings: its covariance against dense algebra, its optimum, weights and tests of adequacy on known truths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from studies.calibration import truth
from studies.calibration.cases import CASES

from bayes_nlsid.inference import adequacy as judge
from bayes_nlsid.inference.adequacy import Adequacy, adequacy
from bayes_nlsid.inference.arviz_export import pareto_smoothed
from bayes_nlsid.inference.covariance import Layout, Levels, Noise, restricted
from bayes_nlsid.inference.forward import ForwardLikelihood, forward_likelihood
from bayes_nlsid.inference.prior import log_prior
from bayes_nlsid.inference.reweighting import Surrogate, Weighted, around_optimum, forward_posterior
from bayes_nlsid.recordings.noise import NoiseFloor, noise_psd

CASE = CASES["static"]
QUIET = replace(truth.SCENARIOS["white"], noise=(0.01,))


def layout(seed: int = 0) -> tuple[Layout, Levels]:
    rng = np.random.default_rng(seed)
    bins, s = 14, 2
    f = np.linspace(50, 90, bins)
    hats = np.stack([np.interp(f, [50, 90], row) for row in np.eye(2)], axis=1)
    keep = rng.random(2 * bins * s) > 0.1
    columns = (rng.normal(size=(2 * bins * s, 3)), rng.normal(size=(2 * bins * s, 2)))
    floor = np.full((bins, s), np.nan)
    floor[:, 1] = 0.3
    return (Layout(f, np.array([0, 1]), hats, floor, columns, 0.1 * rng.random((2, bins, s)),
                   np.linalg.qr(rng.normal(size=(2 * bins * s, 4)))[0], keep),
            Levels(rng.normal(scale=0.4, size=(2, 2)), np.array([-0.5, 0.7])))


def dense(one: Layout, levels: Levels, error: np.ndarray) -> float:
    """The formula of the module, written down with full matrices."""
    sigma = np.diag(one.diagonal(levels)) + sum(np.exp(a) * u @ u.T for a, u in zip(levels.sources, one.columns, strict=True))
    sigma, x, e = sigma[np.ix_(one.keep, one.keep)], one.nuisance[one.keep], error[one.keep]
    inverse = np.linalg.inv(sigma)
    inner = x.T @ inverse @ x
    p = inverse - inverse @ x @ np.linalg.solve(inner, x.T @ inverse)
    return 0.5 * float(e @ p @ e) + 0.5 * np.linalg.slogdet(sigma)[1] + 0.5 * np.linalg.slogdet(inner)[1]


def test_whitened_likelihood_is_that_of_the_full_covariance() -> None:
    one, levels = layout()
    error = np.random.default_rng(1).normal(size=one.size)
    assert restricted(one, levels, error)[0] == pytest.approx(dense(one, levels, error), rel=1e-9)
    noise = Noise((one,), levels, (1.0,))
    free = int(one.keep.sum()) - 4
    total = noise.log_normalisation - 0.5 * float(np.sum(noise.whiten(error) ** 2))
    assert total == pytest.approx(-dense(one, levels, error) - 0.5 * free * np.log(2 * np.pi), rel=1e-9)
    assert noise.freedom == free


def test_nuisance_directions_carry_no_information() -> None:
    one, levels = layout(3)
    noise = Noise((one,), levels, (0.8,))
    error = np.random.default_rng(2).normal(size=one.size)
    moved = error + one.nuisance @ np.array([100.0, -50.0, 3.0, 7.0])
    assert np.sum(noise.whiten(moved) ** 2) == pytest.approx(np.sum(noise.whiten(error) ** 2), rel=1e-8)


def test_derivative_with_respect_to_levels() -> None:
    one, levels = layout(5)
    error = np.random.default_rng(4).normal(size=one.size)
    slope = restricted(one, levels, error)[1]
    for i in range(len(slope)):
        up, down = (levels.filled(levels.flat + h * np.eye(len(slope))[i]) for h in (1e-5, -1e-5))
        numerical = (restricted(one, up, error)[0] - restricted(one, down, error)[0]) / 2e-5
        assert slope[i] == pytest.approx(numerical, abs=1e-5)


def test_levels_of_noise_are_found() -> None:
    rng = np.random.default_rng(6)
    f = np.linspace(50, 90, 300)
    hats = np.stack([np.interp(f, [50, 90], row) for row in np.eye(2)], axis=1)
    true = np.log([[0.5, 2.0], [4.0, 4.0]])
    u = np.zeros((1200, 20))
    u[np.arange(20) * 7, np.arange(20)] = 5.0
    one = Layout(f, np.array([0, 1]), hats, np.full((300, 2), np.nan), (u,), np.zeros((1, 300, 2)), np.zeros((1200, 0)),
                 np.ones(1200, bool))
    levels = Levels(true, np.array([np.log(3.0)]))
    error = rng.normal(size=1200) * np.sqrt(one.diagonal(levels)) + np.sqrt(3.0) * u @ rng.normal(size=20)
    found = Noise((one,), Levels(np.zeros((2, 2)), np.array([0.0])), (1.0,)).estimated(error)
    assert found.levels.knots == pytest.approx(true, abs=0.35) and np.exp(found.levels.sources[0]) == pytest.approx(3.0, rel=0.8)


def test_pareto_smoothing_knows_heavy_tails() -> None:
    rng = np.random.default_rng(0)
    z = rng.standard_normal(2000)
    even, shape = pareto_smoothed(np.zeros(100))
    assert even == pytest.approx(np.full(100, 0.01)) and shape == -np.inf
    # target narrower than the proposal: bounded weights; wider by two: infinite variance
    assert pareto_smoothed(-0.5 * z**2)[1] < 0.5
    weights, shape = pareto_smoothed(0.4 * z**2)
    assert shape > 0.7 and weights.sum() == pytest.approx(1.0)
    assert pareto_smoothed(np.full(100, -np.inf))[1] == np.inf


def test_weighted_draws_have_the_quantiles_of_their_target() -> None:
    z = np.random.default_rng(1).standard_normal((40_000, 1)) * 1.5
    log = (-0.5 * z**2 + 0.5 * (z / 1.5) ** 2)[:, 0]
    weights, shape = pareto_smoothed(log)
    found = Weighted(z, weights, log, shape)
    assert found.quantiles([0.05, 0.5, 0.95])[:, 0] == pytest.approx([-1.645, 0.0, 1.645], abs=0.04)
    assert found.resampled(4000, np.random.default_rng(2)).std() == pytest.approx(1.0, abs=0.05)


@pytest.fixture(scope="module")
def one() -> tuple[np.ndarray, ForwardLikelihood]:
    theta = np.array([[truth.F0 + 0.05, 0.0041, -2.2e6, 4.3]])
    recording = CASE.recording(QUIET, truth.measure(QUIET, theta, np.random.default_rng(11))[0])
    found = CASE.regression(recording, 0)
    return theta[0], forward_likelihood(found, [recording], CASE.priors(found.problem))


def test_optimum_lies_within_its_own_error_of_the_truth(one: tuple[np.ndarray, ForwardLikelihood]) -> None:
    """Truth by Runge–Kutta with laws of its own; 1 % noise: frequency known to milli-hertz, so numerical bias would show."""
    theta, likelihood = one
    at = likelihood.expansion
    found = likelihood.coordinates.to_theta(at.s)
    sd = np.sqrt(np.diag(np.linalg.inv(at.information))) * np.exp(likelihood.coordinates.log_jacobian(at.s))
    assert np.abs((found - theta) / sd).max() < 4
    assert sd[0] < 0.01 and sd[2] < 1e5
    assert likelihood.log_likelihood(found[None])[0] >= likelihood.log_likelihood(found + 3 * sd * np.eye(4)).max()
    assert likelihood.by_block(found[None]).sum() == pytest.approx(likelihood.log_likelihood(found[None])[0])
    assert "sensor noise of 0 of 1 channels as measured" in likelihood.describe()


def test_expansion_and_simulation_agree_near_the_optimum(one: tuple[np.ndarray, ForwardLikelihood]) -> None:
    likelihood = one[1]
    at = likelihood.expansion
    root = np.linalg.cholesky(np.linalg.inv(at.information))
    theta = likelihood.coordinates.to_theta(at.s + np.random.default_rng(0).standard_normal((6, 4)) @ root.T)
    assert Surrogate(likelihood).log_likelihood(theta) == pytest.approx(likelihood.log_likelihood(theta), abs=0.7)


def test_a_draw_that_cannot_be_simulated_has_no_likelihood(one: tuple[np.ndarray, ForwardLikelihood]) -> None:
    bad = one[0][None] * [[1, 1, 1e6, 1]]
    assert one[1].log_likelihood(bad)[0] == -np.inf


def test_weights_around_the_optimum_and_chains_agree(one: tuple[np.ndarray, ForwardLikelihood]) -> None:
    """Two ways to one posterior: importance sampling from a t, and walkers on the expansion weighted by simulation."""
    likelihood = one[1]
    priors = CASE.priors(likelihood.problem)
    quick = around_optimum(likelihood, priors, 400, 0)
    found, weighted = forward_posterior(Surrogate(likelihood).fit, likelihood, priors, draws=500, ensembles=2, walkers=20, steps=800,
                                        seed=1)
    assert quick.shape < 0.7 and weighted.shape < 0.7 and found.status == "ok", found.reasons
    sd = found.flat.std(axis=0)
    assert np.abs((found.quantiles()[1] - quick.quantiles([0.5])[0]) / sd).max() < 0.3
    assert quick.resampled(2000, np.random.default_rng(0)).std(axis=0) == pytest.approx(sd, rel=0.2)
    assert np.isfinite(found.log_prob).all()
    s = likelihood.coordinates.to_s(found.flat[:1])
    assert log_prior(likelihood.coordinates, priors, s, found.flat[:1])[0] < np.inf


def examined(law: type[truth.Static], seed: int) -> tuple[Adequacy, NoiseFloor]:
    rng = np.random.default_rng(seed)
    theta = np.array([[truth.F0, truth.ZETA, -2.4e6, 4.0]])
    channels = truth.measure(QUIET, theta, rng, law)[0]
    recording = CASE.recording(QUIET, channels)
    found = CASE.regression(recording, 0)
    sd = 0.01 * np.sqrt(np.mean(channels**2) / 1.0001)
    quiet = replace(recording, name="quiet", role="noise", response=sd * rng.normal(size=(4096, 1)), force=np.zeros((4096, 1)))
    floor = noise_psd(recording, quiet)
    return adequacy(forward_likelihood(found, [recording], CASE.priors(found.problem), floors=(floor,)), (floor,)), floor


class Coulomb(truth.Static):
    """A little dry friction that the model does not have."""

    def force(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """N."""
        return super().force(u, v) + 0.03 * np.tanh(v / 0.02)


class Stiffening(truth.Static):
    """A cubic spring of 0.3 % of the linear force at 0.7 mm that the model does not have."""

    def force(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """N."""
        return super().force(u, v) + 1.5e9 * u**3


def test_a_force_that_passes_for_unmeasured_force_is_seen_once_it_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The levels of noise make room for a coherent force, and its score stays at 4; taken out, they fall and the score does not."""
    before: list[tuple[tuple[str, float], ...]] = []
    real = judge._once_allowed
    monkeypatch.setattr(judge, "_once_allowed", lambda a, b, scores: (before.append(scores), real(a, b, scores))[1])
    found, _ = examined(Stiffening, 7)
    assert abs(before[0][0][1]) < 5 and abs(found.scores[0][1]) > 8 and "cubic" in found.scores[0][0]
    assert found.misfit and "points along" in found.reasons[-1]


def test_what_an_unseen_force_would_do_is_that_of_one_more_coefficient(one: tuple[np.ndarray, ForwardLikelihood]) -> None:
    """Against the covariance of parameters and coefficient together; the prior limits it."""
    likelihood = one[1]
    at = likelihood.expansion
    column = at.slope[:, 2] / np.linalg.norm(at.slope[:, 2]) + 1e-3 * np.random.default_rng(0).normal(size=len(at.error))
    found = judge._unseen(likelihood, {"like k2": column}, {"like k2": 0.0}, ())
    slope = likelihood.noise.whiten(np.concatenate([at.slope[:, :4].T, column[None]]))
    size = np.linalg.norm(slope, axis=1)
    slope = slope / size[:, None]
    together, given = np.linalg.inv(slope @ slope.T), np.linalg.inv(slope[:4] @ slope[:4].T)
    assert [x.widening for x in found] == pytest.approx(np.sqrt(np.diag(together)[:4] / np.diag(given)), rel=1e-3)
    assert found[2].widening == max(x.widening for x in found) > 1.2 and found[2].force == "like k2"
    more = judge._unseen(likelihood, {"like k2": column}, {"like k2": 3.0}, ())
    assert more[2].widening**2 - 1 == pytest.approx(10 * (found[2].widening**2 - 1), rel=1e-6)
    priors = CASE.priors(likelihood.problem)
    capped = judge._unseen(likelihood, {"like k2": column}, {"like k2": 1e6}, priors)
    sd = np.sqrt(np.diag(np.linalg.inv(at.information))) * np.exp(likelihood.coordinates.log_jacobian(at.s))
    assert capped[2].widening == pytest.approx(4e5 / sd[2], rel=0.35)      # the prior's standard deviation, in coordinates that bend


def test_a_right_model_is_adequate_and_hidden_friction_is_seen() -> None:
    right, _ = examined(truth.Static, 3)
    assert not right.misfit, right.reasons
    assert right.innovation < right.innovation_limit
    assert len(right.unseen) == 4 and all(x.widening >= 1 for x in right.unseen) and right.record()["unseen"][2]["force"]
    wrong, _ = examined(Coulomb, 4)
    assert wrong.misfit and wrong.record()["reasons"]
