"""Residual, bounds, coordinates: what Eq. 13 must satisfy whatever the model."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import Scenario, scenario
from bayes_nlsid.identification.spectrum import Spectrum, fast_length, tukey
from bayes_nlsid.model import Element, Model
from tests.identification.truth import beam, integrated, pack, prescribed, slider, turning

K3 = np.array([3e8, -2e8])


@lru_cache
def cubic_run():
    return integrated(beam(), lambda q, v: K3 * q**3, drive=lambda t: 20 * np.sin(2 * np.pi * (15 * t + 2 * t * t)), seconds=1.0)


def bouc_wen_run():
    """Bouc–Wen loop by DOP853, with its state beside the motion."""
    from scipy.integrate import solve_ivp
    model = beam(1, 1)
    b, w, zeta = model.shapes[0, 0], model.omega[0], model.zeta[0]
    alpha, beta, gamma, delta, nu = 4000.0, 200.0, 0.8, -0.3, 1.0

    def push(t):
        return 8 * np.sin(2 * np.pi * 18 * t) + 3 * np.sin(2 * np.pi * 11 * t)

    def rate(t, y):
        u, v, z = y
        qd = b * v
        dz = alpha * qd - beta * (gamma * abs(qd) * abs(z) ** (nu - 1) * z + delta * qd * abs(z) ** nu)
        return [v, push(t) - 2 * zeta * w * v - w**2 * u - b * (z - alpha * b * u), dz]

    time = np.arange(4096) / 4096
    y = solve_ivp(rate, (0, time[-1]), [0.0, 0.0, 0.0], method="DOP853", t_eval=time, rtol=1e-9, atol=1e-12, max_step=1e-3).y.T
    a = np.array([rate(t, row)[1] for t, row in zip(time, y, strict=True)])
    force = np.array([[push(t)] for t in time])
    return model, pack(model, 1 / 4096, y[:, :1], y[:, 1:2], a[:, None], force), np.array([alpha, beta, gamma, delta, nu])


def test_residual_vanishes_at_the_truth_of_another_integrator():
    data = cubic_run()
    for name in ("S2", "S3"):
        chosen = scenario(name, 3, 0)
        problem = Problem(Model(beam(), (Element(LIBRARY["cubic"], ("J1", "J2")),), chosen.equations), (data,), chosen)
        truth = problem.model.start(K3)
        assert problem.mse(truth) < 1e-24 * problem.mse(problem.model.start([0.0, 0.0]))


def test_one_mode_is_not_enough_for_a_coupled_joint():
    data = cubic_run()
    element = Element(LIBRARY["cubic"], ("J1", "J2"))
    score = {}
    for name in ("S1", "S2"):
        problem = Problem(Model(beam(), (element,), (0,)), (data,), scenario(name, 3, 0))
        score[name] = float(problem.mse(problem.model.start(K3)))
    assert score["S1"] > 1e6 * score["S2"]


def test_scenarios_are_nested():
    """S1 is S2 with one coupled mode; S2 is the main equation of S3."""
    data = cubic_run()
    model = Model(beam(), (Element(LIBRARY["cubic"], ("J1", "J2")),), (0,))
    s2, s3 = (Problem(model, (data,), scenario(n, 3, 0)) for n in ("S2", "S3"))
    theta = model.start(0.7 * K3)
    assert s3.residual(theta)[s3.equation == 0] == pytest.approx(s2.residual(theta), rel=1e-11, abs=1e-11)
    same = Problem(model, (data,), Scenario("mine", (0,), (0,)))
    assert np.array_equal(same.residual(theta), Problem(model, (data,), scenario("S1", 3, 0)).residual(theta))


@pytest.mark.parametrize("periodic", [True, False])
def test_parseval(periodic):
    """Over the whole band the sum of squares is that of the tapered samples; over part of it, of the band-passed ones."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(3, 1000))
    whole = Spectrum(1000, 1e-3, slice(None), (0.0, 500.0), periodic=periodic)
    taper = 1.0 if periodic else tukey(1000, 0.1)
    assert np.sum(whole.apply(x) ** 2, axis=1) == pytest.approx(np.sum((taper * x) ** 2, axis=1), rel=1e-12)
    part = Spectrum(1000, 1e-3, slice(None), (100.0, 200.0), periodic=True)
    spectrum = np.fft.rfft(x, axis=1)
    spectrum[:, :100] = spectrum[:, 201:] = 0
    assert np.sum(part.apply(x) ** 2, axis=1) == pytest.approx(np.sum(np.fft.irfft(spectrum, 1000, axis=1) ** 2, axis=1), rel=1e-12)


def test_taper_keeps_a_strong_line_below_the_band_out_of_it():
    n, dt = 4000, 1e-3
    drift = np.sin(2 * np.pi * 1.3 * dt * np.arange(n))
    leak = {taper: np.mean(Spectrum(n, dt, slice(None), (50.0, 200.0), taper=taper).apply(drift) ** 2) for taper in (0.0, 0.1)}
    assert leak[0.1] < 1e-4 * leak[0.0]


@pytest.mark.parametrize("n, expected", [(1, 1), (7, 6), (1024, 1024), (1021, 1000), (100003, 100000)])
def test_fast_length(n, expected):
    assert fast_length(n) == expected


def test_batches_equal_single_evaluations():
    chosen = scenario("S3", 3, 0)
    elements = (Element(LIBRARY["cubic"], ("J1", "J2")), Element(LIBRARY["iwan4_memory"], ("J1",)),
                Element(LIBRARY["v|v|"], ("J1", "J2"), tied=True))
    problem = Problem(Model(beam(), elements, (0, 1)), (cubic_run(),), chosen)
    s = np.random.default_rng(1).uniform(problem.to_s(problem.bounds[:, 0]), problem.to_s(problem.bounds[:, 1]), (5, len(problem.names)))
    theta = problem.to_theta(s)
    together = problem.residual(theta.reshape(5, 1, -1))[:, 0]
    for row, whole in zip(theta, together, strict=True):
        assert problem.residual(row) == pytest.approx(whole, rel=1e-12, abs=1e-12 * np.abs(whole).max())


def test_sliders_and_bouc_wen_leave_nothing():
    """Memory along the path against sliders followed sample by sample and against an integrated Bouc–Wen loop."""
    model, dt = beam(), 1 / 1024

    def joint(q, v):
        out = np.empty_like(q)
        for j, (k, slip) in enumerate(((3000.0, 1.2), (5000.0, 0.9))):
            path, place = turning(q[:, j], v[:, j], dt)
            out[:, j] = slider(path, k, slip)[place] - k * q[:, j]
        return out

    chosen = scenario("S3", 3, 0)
    problem = Problem(Model(model, (Element(LIBRARY["jenkins_memory"], ("J1", "J2")),), (0,)), (prescribed(model, joint),), chosen)
    stuck = problem.mse(problem.model.start([1e6, 3000.0, 1e6, 5000.0]))
    assert problem.mse(problem.model.start([1.2, 3000.0, 0.9, 5000.0])) < 1e-20 * stuck
    one, data, truth = bouc_wen_run()
    loop = Problem(Model(one, (Element(LIBRARY["bouc_wen"], ("J1",)),), (0,)), (data,), scenario("S1", 1, 0))
    soft = truth.copy()
    soft[1] = 1e-2
    assert loop.mse(loop.model.start(truth)) < 1e-7 * loop.mse(loop.model.start(soft))


def test_recordings_are_not_joined():
    """Two recordings give the residuals of each, and memory starts afresh in the second."""
    a = cubic_run()
    b = integrated(beam(), lambda q, v: 0 * q, u0=np.array([2e-3, 0.0, 0.0]), seconds=0.7, name="second")
    chosen = scenario("S2", 3, 0)
    model = Model(beam(), (Element(LIBRARY["jenkins_memory"], ("J1",)),), (0,))
    both, first, second = (Problem(model, data, chosen) for data in ((a, b), (a,), (b,)))
    theta = model.start([2.0, 1e4])
    assert np.array_equal(both.residual(theta), np.concatenate([first.residual(theta), second.residual(theta)]))
    assert both.samples == first.samples + second.samples
    assert set(both.record) == {0, 1}


def test_free_decay_has_no_trivial_solution():
    """With no force at all the acceleration still enters with coefficient 1: no theta inside the bounds gives a
    small residual but the truth."""
    data = integrated(beam(), lambda q, v: 0 * q, u0=np.array([3e-3, 0.0, 0.0]), seconds=2.0)
    problem = Problem(Model(beam(), (), (0,)), (data,), scenario("S1", 3, 0))
    truth = problem.model.start()
    inertia = np.sum(problem.observed.inertia**2) / problem.samples
    assert problem.mse(truth) < 1e-24 * inertia
    corners = np.array([[f, z] for f in problem.bounds[0] for z in problem.bounds[1]])
    assert (problem.mse(corners) > 1e-3 * inertia).all()


@pytest.mark.parametrize("order", [0, 1, 2], ids=["displacement", "velocity", "acceleration"])
def test_noise_floor_is_the_mean_square_of_noise_alone(order):
    """Noise that is white in what was measured, integrated or differentiated exactly in-band, averaged over realisations."""
    model = beam(1, 1)
    n, dt, sigma = 4096, 1 / 1024, 0.3 / 600.0 ** (2 - order)
    rng = np.random.default_rng(3)
    frequency = np.fft.rfftfreq(n, dt)
    w = 2j * np.pi * np.maximum(frequency, frequency[1])
    colour = np.zeros((3, 1))
    colour[order] = 2 * sigma**2 * dt
    score, weighted = [], []
    for _ in range(40):
        noise = np.fft.rfft(rng.normal(scale=sigma, size=n)) * ((frequency > 4) & (frequency < 200)) / w**order
        u, v, a = (np.fft.irfft(noise * w**k, n)[:, None] for k in range(3))
        data = replace(pack(model, dt, u, v, a, np.zeros((n, 1)), noise=1.0, band=(8.0, 120.0), periodic=True), colour=colour)
        problem = Problem(Model(model), (data,), scenario("S1", 1, 0))
        score.append(float(problem.mse(np.zeros(0))))
        weighted.append(float(problem.mse(np.zeros(0), problem.noise_weight)))
    assert np.mean(score) == pytest.approx(problem.floor, rel=0.05)
    assert np.mean(weighted) == pytest.approx(problem.floor, rel=0.2)


def test_bounds_follow_the_motion():
    data = cubic_run()
    elements = (Element(LIBRARY["cubic"], ("J1", "J2")), Element(LIBRARY["clearance"], ("J1",)))
    narrow, wide = (Problem(Model(beam(), elements, (0,)), (data,), scenario("S2", 3, 0), widening=w) for w in (1.0, 2.0))
    box = dict(zip(narrow.names, narrow.bounds, strict=True))
    assert box["f[1]"] == pytest.approx([19.0, 21.0]) and box["zeta[1]"] == pytest.approx([0.008, 0.012])
    part = narrow.observed.spectra[0].samples
    q = np.max(np.abs(data.q[part, 0]))
    u, v, a = (np.max(np.abs(x[part, 0])) for x in (data.u, data.v, data.a))
    force = (a + 2 * 0.01 * beam().omega[0] * v + beam().omega[0] ** 2 * u) / 0.9
    assert box["cubic[J1].c"] == pytest.approx([-force / q**3, force / q**3], rel=1e-9)
    assert box["clearance[J1].d"][1] == pytest.approx(q, rel=1e-9)
    assert box["clearance[J1].k_d"][1] == pytest.approx(force / q, rel=1e-9)
    assert dict(zip(wide.names, wide.bounds, strict=True))["cubic[J1].c"] == pytest.approx(2 * box["cubic[J1].c"])


def test_a_joint_without_motion_keeps_a_finite_bound():
    """The middle joint of a symmetric beam does not move in the first mode."""
    model = beam()
    still = replace(model, shapes=np.array([[0.9, 0.5, -0.7], [0.0, -0.8, 0.6], [1.0, 1.0, 1.0]]))
    data = integrated(still, lambda q, v: 0 * q, u0=np.array([3e-3, 0.0, 0.0]), seconds=1.0)
    problem = Problem(Model(still, (Element(LIBRARY["cubic"], ("J1", "J2")),), (0,)), (data,), scenario("S1", 3, 0))
    assert np.isfinite(problem.bounds).all() and (problem.bounds[:, 0] < problem.bounds[:, 1]).all()
    with pytest.raises(ValueError, match="none of"):
        Problem(Model(still, (Element(LIBRARY["cubic"], ("J2",)),), (0,)), (data,), scenario("S1", 3, 0))


def test_coordinates_return_and_their_jacobian_is_the_slope():
    chosen = Coordinates(np.array([1.0, 1e6, 0.0, 1e-6]))
    theta = np.array([[-3e12, 0.0, 1e-6, 1e-9], [0.5, -2e5, 7e12, -1.0]])
    s = chosen.to_s(theta)
    assert chosen.to_theta(s) == pytest.approx(theta, rel=1e-10, abs=1e-20)
    h = 1e-6
    slope = (chosen.to_theta(s + h) - chosen.to_theta(s - h)) / (2 * h)
    assert np.log(slope) == pytest.approx(chosen.log_jacobian(s), abs=1e-5)


def test_wrong_arguments_name_the_mend():
    data, model = cubic_run(), beam()
    with pytest.raises(ValueError, match="no equation"):
        Problem(Model(model, (), (1,)), (data,), scenario("S1", 3, 0))
    with pytest.raises(ValueError, match="not observed in modes"):
        Problem(Model(model), (replace(data, modes=(0, 1, 3)),), scenario("S2", 3, 0))
    with pytest.raises(ValueError, match="must lie inside"):
        Problem(Model(model), (data,), scenario("S1", 3, 0), band=(1.0, 100.0))
    with pytest.raises(ValueError, match="last axis must be 2"):
        Problem(Model(model, (), (0,)), (data,), scenario("S1", 3, 0)).residual(np.zeros(3))
    with pytest.raises(ValueError, match="among the coupled"):
        Scenario("x", (0, 1), (0,))
    with pytest.raises(ValueError, match="'S1', 'S2' or 'S3'"):
        scenario("S4", 3, 0)


def test_bounds_of_linear_values_follow_how_well_they_are_known():
    """Three standard deviations of a modal test where it was vague; a factor of 30 where a damping ratio was no more than assumed."""
    known = replace(beam(), omega_sd=np.array([0.03, 0, 0]), zeta_sd=np.array([0.5, 1.0, 0.01]))
    model = Model(known, (), (0, 1, 2))
    problem = Problem(model, (cubic_run(),), scenario("S3", 3, 0))
    nominal = {f"f[{k + 1}]": f for k, f in enumerate(known.frequency)} | {f"zeta[{k + 1}]": z for k, z in enumerate(known.zeta)}
    box = {name: bound / nominal[name] for name, bound in zip(problem.names, problem.bounds, strict=True)}
    assert box["f[1]"] == pytest.approx([0.91, 1.09]) and box["f[2]"] == pytest.approx([0.95, 1.05])
    assert box["zeta[1]"] == pytest.approx([0.01, 2.5]) and box["zeta[2]"] == pytest.approx([1 / 30, 30])
    assert box["zeta[3]"] == pytest.approx([0.8, 1.2])
