"""Output error: the truth comes back from responses that another integrator made, also where the regression is biased."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.output_error import output_error
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.model import Element, Model
from bayes_nlsid.recordings.recording import Channel, Recording
from tests.identification.test_fit import noisy
from tests.identification.truth import beam, integrated

K3 = np.array([3e7, -2e7])


def drive(t):
    return 2 * np.sin(2 * np.pi * (15 * t + 5 * t * t))


def sweep(noise=0.0):
    """A sweep through the first mode: modal data with (biased) noise, and channels with independent noise."""
    model = beam(2)
    data = integrated(model, lambda q, v: K3 * q**3, drive=drive, seconds=1.0, rate=512.0)
    rows = model.rows(("J1", "TIP"))
    rng = np.random.default_rng(0)
    response = data.a @ rows.T
    response = response + noise * response.std(axis=0) * rng.normal(size=response.shape)
    time = np.arange(data.n) * data.dt
    channels = tuple(Channel(f"a{n}", n, "acceleration", "m/s^2") for n in ("J1", "TIP"))
    recording = Recording(data.name, data.dt, response, channels, np.array([[drive(t)] for t in time]),
                          (Channel("F", "TIP", "force", "N"),))
    return model, data, recording


def start_of(model, data, noise):
    rough = noisy(data, noise, 1, model) if noise else data
    problem = Problem(Model(model, (Element(LIBRARY["cubic"], ("J1", "J2")),), (0,)), (rough,), scenario("S2", 2, 0))
    return fit(problem)


def test_truth_is_the_minimum_and_noise_bias_of_the_regression_goes():
    model, data, recording = sweep(noise=0.03)
    start = start_of(model, data, 0.05)
    found = output_error(start, [recording], iterations=10)
    truth = start.problem.model.start(K3)
    scale = np.array([20.0, 0.01, *np.abs(K3)])
    before, after = (np.abs(x.theta - truth) / scale for x in (start, found))
    assert found.status == "ok" and found.rank == 4
    assert (after[:3] < [1e-3, 0.05, 0.2]).all() and after.sum() < 0.1 * before.sum()
    assert found.mse == pytest.approx(0.03**2 * 0.75, rel=0.5)       # what is left is the noise, of the band's share
    z = (found.s - found.problem.to_s(truth)) / np.sqrt(np.diag(found.covariance))
    assert (np.abs(z[:3]) < 4).all()
    assert found.starts[0].mse == found.mse and "output error" in found.reasons[0]


def test_free_decay_estimates_its_initial_state():
    """The modal state at the start is off by a tenth; it is estimated along and the frequency comes out right."""
    model = beam(2)
    data = integrated(model, lambda q, v: 0 * q, u0=np.array([2e-3, 5e-4]), seconds=1.0, rate=512.0)
    rows = model.rows(("J1", "TIP"))
    channels = tuple(Channel(f"a{n}", n, "acceleration", "m/s^2") for n in ("J1", "TIP"))
    recording = Recording(data.name, data.dt, data.a @ rows.T, channels, np.zeros((data.n, 0)))
    problem = Problem(Model(model, (), (0,)), (replace(data, u=1.1 * data.u, valid=slice(40, None)),), scenario("S1", 2, 0))
    found = output_error(fit(problem), [recording], iterations=15)
    assert found.theta == pytest.approx([20.0, 0.01], rel=2e-3)
    assert found.mse < 1e-4


def test_recordings_must_be_known():
    model, data, recording = sweep()
    start = start_of(model, data, 0.0)
    with pytest.raises(ValueError, match="no modal data"):
        output_error(start, [replace(recording, name="other")])
    with pytest.raises(ValueError, match="none"):
        output_error(start, [])


@pytest.mark.parametrize("refine", [False, True])
def test_an_unknown_gain_of_the_force_is_found(refine):
    model, data, recording = sweep()
    gain = 1.2
    problem = Problem(Model(model, (Element(LIBRARY["cubic"], ("J1", "J2")),), (0,), free_gain=True),
                      (replace(data, force=data.force / gain),), scenario("S2", 2, 0))
    found = fit(problem)
    if refine:
        found = output_error(found, [replace(recording, force=recording.force / gain)], iterations=8)
    assert found.values["gain"] == pytest.approx(gain, rel=2e-3)
    assert found.values["f[1]"] == pytest.approx(20.0, rel=1e-3)
    assert "gain" not in problem.piled(found.theta)


def test_a_gain_without_a_force_is_refused():
    model = beam(2)
    data = integrated(model, lambda q, v: 0 * q, u0=np.array([2e-3, 5e-4]), seconds=1.0, rate=512.0)
    with pytest.raises(ValueError, match="no recording holds a force"):
        Problem(Model(model, (), (0,), free_gain=True), (data,), scenario("S1", 2, 0))
