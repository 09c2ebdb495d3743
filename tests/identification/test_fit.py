"""fit and select: what was simulated must come back, and noise must not be fitted."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_nlsid.forces.library import LIBRARY, TABLE_1
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.identification.elimination import jacobian
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.noise import freedom, smoothed_variance
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.identification.select import Selection, Step, key, select
from bayes_nlsid.model import Element, Model
from tests.identification.test_problem import bouc_wen_run
from tests.identification.truth import beam, integrated, prescribed, slider, turning

DT = 1 / 1024


def make(element, data, name="S2", free=(0,), **options):
    return Problem(Model(beam(), (element,), free), data if isinstance(data, tuple) else (data,), scenario(name, 3, 0), **options)


@lru_cache
def static_run():
    """Softening at J1, quadratic damping at J2, little enough that modes stay themselves."""
    def joint(q, v):
        return np.stack([-4e5 * q[..., 0] * np.abs(q[..., 0]), 3.0 * v[..., 1] * np.abs(v[..., 1])], axis=-1)
    return prescribed(beam(), joint, seconds=3.0)


@lru_cache
def slider_run():
    def joint(q, v):
        out = np.empty_like(q)
        for j, (k, slip) in enumerate(((3000.0, 1.2), (5000.0, 0.9))):
            path, place = turning(q[:, j], v[:, j], DT)
            out[:, j] = slider(path, k, slip)[place] - k * q[:, j]
        return out
    return prescribed(beam(), joint, seconds=3.0)


@lru_cache
def iwan_run(memory=True):
    """Segalman's distribution of sliders at J1, summed slider by slider (excess over the stuck spring)."""
    f_s, k_t, chi, beta = 1.5, 3000.0, -0.4, 0.3
    phi = f_s * (1 + beta) / (k_t * (beta + (chi + 1) / (chi + 2)))
    edges = phi * np.linspace(0, 1, 1201) ** 2
    # Each slice carries its share of stiffness and yields at its own mean, so that stiffness and slip force of the whole are exact.
    share = np.diff(edges ** (chi + 1)) / phi ** (chi + 1)
    mean = np.diff(edges ** (chi + 2)) * (chi + 1) / (chi + 2) / np.diff(edges ** (chi + 1))
    end = beta / (beta + (chi + 1) / (chi + 2)) * f_s / phi
    k = np.append((k_t - end) * share, end)
    slip = np.append(mean, phi)

    def joint(q, v):
        out = np.zeros_like(q)
        path, place = turning(q[:, 0], v[:, 0], DT) if memory else (q[:, 0], np.arange(len(q)))
        force, last = np.zeros_like(k), 0.0
        series = np.empty(len(path))
        for i, here in enumerate(path):
            force = np.clip(force + k * (here - last), -k * slip, k * slip) if memory else np.clip(k * here, -k * slip, k * slip)
            series[i], last = force.sum(), here
        out[:, 0] = series[place] - k_t * q[:, 0]
        return out
    return prescribed(beam(), joint, seconds=3.0), np.array([f_s, k_t, chi, beta])


def noisy(data, level, seed=0, model=None):
    """White noise on the modal accelerations, integrated exactly."""
    rng = np.random.default_rng(seed)
    sigma = level * data.a.std(axis=0)
    frequency = np.fft.rfftfreq(data.n, data.dt)[:, None]
    spectrum = np.fft.rfft(rng.normal(size=data.a.shape) * sigma, axis=0) * (frequency > 3)
    w = 2j * np.pi * np.maximum(frequency, frequency[1])
    a, v, u = (np.fft.irfft(spectrum / w**k if k else spectrum, data.n, axis=0) for k in range(3))
    rows = (model or beam()).rows(data.locations)
    return replace(data, a=data.a + a, v=data.v + v, u=data.u + u, q=(data.u + u) @ rows.T, qd=(data.v + v) @ rows.T,
                   noise=2 * sigma**2 * data.dt)


def test_linear_coefficients_return_in_closed_form():
    elements = (Element(LIBRARY["q|q|"], ("J1", "J2")), Element(LIBRARY["v|v|"], ("J1", "J2")))
    problem = Problem(Model(beam(), elements, (0, 1, 2)), (static_run(),), scenario("S3", 3, 0))
    found = fit(problem)
    assert len(found.starts) == 1 and found.ok and found.rank == len(found.theta)
    expected = problem.model.start([-4e5, 0.0, 0.0, 3.0])
    assert found.theta == pytest.approx(expected, rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("name", ["S2", "S3"])
def test_sliders_return(name):
    found = fit(make(Element(LIBRARY["jenkins_memory"], ("J1", "J2")), slider_run(), name), starts=20, seed=1)
    assert found.ok
    assert found.theta == pytest.approx([20.0, 0.01, 1.2, 3000.0, 0.9, 5000.0], rel=1e-7)


def test_iwan_with_memory_returns():
    data, truth = iwan_run()
    found = fit(make(Element(LIBRARY["iwan4_memory"], ("J1",)), data), starts=20, seed=1)
    assert found.ok
    # 1201 sliders stand for a continuous distribution: agreement to parts in a thousand, beta (the jump at macroslip) less.
    assert found.theta[:5] == pytest.approx([20.0, 0.01, *truth[:3]], rel=3e-3)
    assert found.theta[5] == pytest.approx(truth[3], rel=0.03)


def test_bouc_wen_returns():
    model, data, truth = bouc_wen_run()
    problem = Problem(Model(model, (Element(LIBRARY["bouc_wen"], ("J1",), fixed=(("nu", 1.0), ("gamma", 0.8))),), (0,)), (data,),
                      scenario("S1", 1, 0))
    found = fit(problem, starts=8, seed=1)
    assert found.theta[2:] == pytest.approx(truth[[0, 1, 3]], rel=5e-3)


@settings(max_examples=12, deadline=None)
@given(st.floats(-6, 12))
def test_any_size_of_parameter_is_found(decades):
    """The same law in other units of its own: coefficients from 1e-6 to 1e12 come back alike, linear and nonlinear."""
    factor = 10.0**decades
    cubic = LIBRARY["cubic"]
    scaled = replace(cubic, law=lambda q, v, c: c * q**3 * 1e9 / factor, slope=lambda q, v, c: (3 * c * q**2 * 1e9 / factor, 0.0))
    data = prescribed(beam(), lambda q, v: np.stack([2e9 * q[:, 0] ** 3, 0 * q[:, 1]], axis=-1), seconds=1.0)
    found = fit(make(Element(scaled, ("J1",)), data))
    assert found.theta[2] == pytest.approx(2.0 * factor, rel=1e-8)
    curved = replace(scaled, linear=False, params=(Param("c", "", "coefficient"),))
    found = fit(make(Element(curved, ("J1",)), data), starts=4, seed=2)
    assert found.theta[2] == pytest.approx(2.0 * factor, rel=1e-5)


def test_bounds_hold_and_are_reported():
    """Twice the damping that the bounds allow: the ratio stops at its bound, is named, and more room lets it through."""
    truth = replace(beam(), zeta=np.array([0.02, 0.01, 0.01]))
    data = integrated(truth, lambda q, v: 0 * q, u0=np.array([1e-3, 0.0, 0.0]), seconds=1.0)
    tight = fit(Problem(Model(beam(), (), (0,)), (data,), scenario("S1", 3, 0)))
    assert tight.theta[1] == pytest.approx(0.012) and "zeta[1]" in " ".join(tight.reasons)
    loose = fit(Problem(Model(beam(), (), (0,)), (data,), scenario("S1", 3, 0), linear_widening=(1.0, 10.0)))
    assert loose.theta == pytest.approx([20.0, 0.02], rel=1e-9)


def test_jacobian_is_the_derivative():
    data, truth = iwan_run()
    elements = (Element(LIBRARY["iwan4_memory"], ("J1",)), Element(LIBRARY["cubic"], ("J2",)))
    problem = Problem(Model(beam(), elements, (0, 1)), (data,), scenario("S3", 3, 0))
    theta = problem.model.start([*truth, 1e6])
    s, h = problem.to_s(theta), 1e-5
    numeric = np.stack([(problem.residual(problem.to_theta(s + h * e)) - problem.residual(problem.to_theta(s - h * e))) / (2 * h)
                        for e in np.eye(len(s))], axis=1)
    assert jacobian(problem, theta) == pytest.approx(numeric, abs=2e-4 * np.abs(numeric).max())


def test_starts_are_kept_and_seeded():
    problem = make(Element(LIBRARY["jenkins_memory"], ("J1", "J2")), slider_run())
    few, more = fit(problem, starts=4, seed=5), fit(problem, starts=8, seed=5)
    assert [s.status for s in more.starts] and len(more.starts) == 8
    for a, b in zip(few.starts, more.starts, strict=False):
        if a.status == b.status == "converged":
            assert np.array_equal(a.theta, b.theta)
    assert np.array_equal(fit(problem, starts=4, seed=5).theta, few.theta)
    optima = more.optima()
    assert optima[0].mse == more.mse and len(optima) >= 1


def test_warm_start_is_used_exactly():
    problem = make(Element(LIBRARY["jenkins_memory"], ("J1", "J2")), slider_run())
    truth = {"jenkins_memory[J1].f_s": 1.2, "jenkins_memory[J1].k_t": 3000.0, "jenkins_memory[J2].f_s": 0.9,
             "jenkins_memory[J2].k_t": 5000.0}
    assert fit(problem, starts=1, warm=truth).mse < 1e-20
    with pytest.raises(ValueError, match="warm has shape"):
        fit(problem, warm=np.zeros(2))
    with pytest.raises(ValueError, match="starts"):
        fit(problem, starts=0)


def test_unseen_directions_keep_the_width_of_their_box():
    """Below slip a slider is a spring: with excess it has no force at all, and the fit says so."""
    data = integrated(beam(), lambda q, v: 0 * q, u0=np.array([1e-3, 0.0, 0.0]), seconds=1.0)
    problem = make(Element(LIBRARY["jenkins_memory"], ("J1",)), data)
    found = fit(problem, starts=4, seed=0)
    assert found.rank == 2 and "inform 2 of 4" in found.reasons[0]
    width = np.diff(problem.to_s(problem.bounds.T), axis=0)[0]
    assert np.sqrt(np.diag(found.covariance))[2:] == pytest.approx(width[2:] / np.sqrt(12), rel=0.01)


def test_covariance_is_the_spread_over_noise():
    """White unmeasured force is the case in which the plain covariance is right: compare with repeated fits."""
    clean, element = static_run(), Element(LIBRARY["q|q|"], ("J1",))
    rng = np.random.default_rng(0)
    theta, sd = [], []
    for _ in range(80):
        data = replace(clean, force=clean.force + rng.normal(scale=0.1, size=clean.force.shape))
        problem = Problem(Model(beam(), (element, Element(LIBRARY["v|v|"], ("J2",))), (0,)), (data,), scenario("S2", 3, 0))
        found = fit(problem)
        theta.append(found.s)
        sd.append(np.sqrt(np.diag(found.covariance)))
    assert np.std(theta, axis=0) == pytest.approx(np.mean(sd, axis=0), rel=0.3)


def test_smoothed_variance_is_unbiased_and_as_free_as_it_says():
    problem = make(Element(LIBRARY["cubic"], ("J1",)), static_run(), "S3")
    rng = np.random.default_rng(0)
    values = smoothed_variance(problem, 3.0 * rng.normal(size=problem.size))
    assert values.mean() == pytest.approx(9.0, rel=0.05)
    assert values.var() == pytest.approx(2 * 9.0**2 / freedom(), rel=0.35)


CANDIDATES = [Element(term, ("J1", "J2")) for term in TABLE_1 if term.linear and term.name not in ("cubic", "v|v|")] + [
    Element(LIBRARY[name], ("J1", "J2")) for name in ("cubic", "v|v|", "jenkins", "jenkins_memory")]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_selection_finds_both_terms_and_stops_at_the_noise(noise):
    data = noisy(static_run(), noise) if noise else static_run()
    problem = Problem(Model(beam(), (), (0,)), (data,), scenario("S3", 3, 0))
    pool = [c for c in CANDIDATES if c.term.linear]
    found = select(problem, pool, seed=1)
    assert {e.term.name for e in found.forward[:2]} == {"q|q|", "v|v|"}
    assert found.backward == found.forward and len(found.forward) == 2
    assert found.fit.mse < 1.2 * problem.floor if noise else found.fit.mse < 1e-20 * found.mse_linear
    assert len(found.tried) >= 3 * len(pool) - 3 and not found.path[2].accepted


def test_selection_takes_nothing_from_a_linear_recording():
    data = noisy(prescribed(beam(), lambda q, v: 0 * q, seconds=2.0), 0.03)
    for run in (data, replace(data, noise=np.zeros(3))):     # with and without a stated noise
        problem = Problem(Model(beam(), (), (0,)), (run,), scenario("S2", 3, 0))
        found = select(problem, CANDIDATES, starts=3, seed=1)
        assert found.forward == () and found.fit.mse == pytest.approx(found.mse_linear)


def test_only_what_was_kept_has_aliases():
    """A second term that was added and dropped again leaves no doubt about the first."""
    first, second = (Element(LIBRARY[name], ("J1", "J2")) for name in ("jenkins_memory", "cubic"))
    path = (Step(1, "add", key(first), 1.0, True, "", ("a",)), Step(2, "add", key(second), 0.9, True, "", ("b", "c")),
            Step(3, "remove", key(second), 1.0, True, ""))
    base = fit(Problem(Model(beam(), (), (0,)), (static_run(),), scenario("S2", 3, 0)))
    assert Selection((first, second), (first,), path, (), base, 2.0).aliases == ("a",)
    assert Selection((first, second), (first, second), path[:2], (), base, 2.0).aliases == ("a", "b", "c")


def test_selection_tells_a_loop_from_a_spring():
    """Damping that grows with amplitude: the slider with memory wins over the same law without."""
    pool = [Element(LIBRARY[name], ("J1", "J2")) for name in ("jenkins", "jenkins_memory", "q|q|", "cubic")]
    found = select(Problem(Model(beam(), (), (0,)), (slider_run(),), scenario("S2", 3, 0)), pool, starts=6, seed=1)
    assert [e.term.name for e in found.backward] == ["jenkins_memory"]


def test_selection_ignores_order_and_number_of_threads():
    problem = Problem(Model(beam(), (), (0,)), (noisy(static_run(), 0.01),), scenario("S2", 3, 0))
    pool = [Element(LIBRARY[name], ("J1", "J2")) for name in ("jenkins", "q|q|", "v|v|", "cubic")]
    messages = []
    one = select(problem, pool, starts=2, seed=3, progress=lambda share, text: messages.append(share))
    two = select(problem, pool[::-1], starts=2, seed=3, workers=2)
    assert np.array_equal(one.fit.theta, two.fit.theta)
    assert [(s.element, s.mse) for s in one.path] == [(s.element, s.mse) for s in two.path]
    assert messages[-1] == 1.0 and messages == sorted(messages)


def test_a_bad_candidate_is_recorded_not_raised():
    model = beam()
    problem = Problem(Model(model, (), (0,)), (replace(static_run(), locations=("J1", "J2")),), scenario("S1", 3, 0))
    still = Element(LIBRARY["spring"], ("J1",), excess=True)
    found = select(problem, [Element(LIBRARY["q|q|"], ("J1", "J2")), still], seed=0)
    assert {t.element for t in found.tried} >= {key(still)}
    with pytest.raises(ValueError, match="share a name"):
        select(problem, [still, still])


def test_papers_thresholds_stop_the_search():
    problem = Problem(Model(beam(), (), (0,)), (static_run(),), scenario("S2", 3, 0))
    pool = [Element(LIBRARY[name], ("J1", "J2")) for name in ("q|q|", "v|v|", "cubic")]
    linear = float(fit(problem).mse)
    assert len(select(problem, pool, eps1=2 * linear).forward) == 0
    assert len(select(problem, pool, eps2=2 * linear).forward) == 0
    assert len(select(problem, pool, eps2=1e-12 * linear).forward) == 2


def test_decay_and_sweep_together_fix_what_either_leaves_open():
    """Two recordings at different levels: one fit, smaller uncertainty than from either."""
    low = noisy(prescribed(beam(), cubic_joint, size=3e-4, seconds=2.0, seed=1), 0.01, 1)
    high = noisy(prescribed(beam(), cubic_joint, size=1e-3, seconds=2.0, seed=2), 0.01, 2)
    element = Element(LIBRARY["cubic"], ("J1", "J2"))
    sd = {name: np.sqrt(np.diag(fit(make(element, data)).covariance)) for name, data in
          (("low", low), ("high", high), ("both", (low, high)))}
    assert (sd["both"][:2] < np.minimum(sd["low"], sd["high"])[:2] * 1.05).all()


def cubic_joint(q, v):
    return np.stack([2e8 * q[:, 0] ** 3, -1e8 * q[:, 1] ** 3], axis=-1)


def test_a_statistic_that_is_beyond_doubt_need_not_be_worked_out():
    """The estimate stands on the same side of its limit as the statistic, and is the statistic where that is in doubt."""
    from bayes_nlsid.identification.select import TENFOLD, _Search
    data = prescribed(beam(), lambda q, v: np.stack([-4e5 * q[:, 0] * np.abs(q[:, 0]), 0 * q[:, 1]], axis=-1), seconds=2.0)
    data = replace(data, force=data.force + np.random.default_rng(0).normal(scale=0.05, size=data.force.shape))
    bare = Problem(Model(beam()), (data,), scenario("S2", 3, 0))
    search = _Search(bare, None, None, 1, 0, None, 1, None)
    without = fit(bare)
    with_it = fit(bare.with_elements([Element(LIBRARY["q|q|"], ("J1",))]))
    variance = search.variance(with_it)
    true = search.statistic(with_it, without, variance)
    for limit in true * np.array([1e-9, 1e-3, 0.05, 0.5, 2.0, 1e3, 1e12]):
        found = search.estimate(with_it, without, variance, limit)
        assert (found > limit) == (true > limit) and (found > TENFOLD * limit) == (true > TENFOLD * limit)
    assert search.estimate(with_it, without, variance, true) == true
