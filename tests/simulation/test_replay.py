"""A recording simulated: steady periods, rates, quantities, starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.simulation.replay import predict_record
from tests.simulation.problems import IWAN, beam, oscillator, scattered

SHAKER = (Channel("force", "shaker", "force", "N"),)
CHANNELS = (Channel("a", "tip", "acceleration", "m/s^2"), Channel("d", "J1", "displacement", "m"))


def multisine(n: int, lines: int) -> NDArray[np.float64]:
    x = np.fft.rfft(np.random.default_rng(3).standard_normal((n, 1)), axis=0)
    x[lines:] = 0
    x[0] = 0
    return np.asarray(20 * np.fft.irfft(x, n=n, axis=0))


def recording(force: NDArray[np.float64], fs: float, period: int | None, n: int | None = None) -> Recording:
    n = n or len(force)
    free = force.size == 0
    return Recording("r", 1 / fs, np.zeros((n, 2)), CHANNELS, force, () if free else SHAKER, period=period)


def test_a_linear_model_is_replayed_as_its_frequency_response() -> None:
    model, fs, n = beam(free=(0, 1, 2)), 1024.0, 256
    theta = model.start() * np.array([[1.0], [1.01]])
    one = multisine(n, 60)
    found = predict_record(model, theta, recording(np.tile(one, (2, 1)), fs, n), tolerance=1e-4)
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / fs)[:, None]
    for i in range(2):
        omega, zeta = model.linear_values(theta[i])
        modal = np.fft.rfft(one, axis=0) * model.linear.rows(("shaker",)) / (omega**2 - w**2 + 2j * zeta * omega * w)
        a = np.fft.irfft(-w**2 * modal @ model.linear.rows(("tip",)).T, n=n, axis=0)[:, 0]
        d = np.fft.irfft(modal @ model.linear.rows(("J1",)).T, n=n, axis=0)[:, 0]
        assert np.abs(found.values[i, :n, 0] - a).max() < 1e-3 * np.abs(a).max()
        assert np.abs(found.values[i, n:, 1] - d).max() < 1e-3 * np.abs(d).max()
    assert (found.status == "ok").all() and found.drift.max() < 1e-3 and found.numerical_error <= 1e-4


def test_the_stated_error_is_the_error() -> None:
    model, fs, n = beam("iwan4"), 1024.0, 300
    source = recording(multisine(n, 80), fs, None)
    found = predict_record(model, IWAN, source, tolerance=3e-3)
    fine = predict_record(model, IWAN, source, substeps=8 * found.substeps)
    error = np.sqrt(np.mean(np.square(found.values - fine.values), axis=(0, 1)) / np.mean(np.square(fine.values), axis=(0, 1))).max()
    assert 0.1 * found.numerical_error < error < 3 * found.numerical_error
    assert found.numerical_error <= 3e-3


def test_a_free_decay_is_the_simulation_from_its_start() -> None:
    model, fs, n = beam("iwan4_memory"), 2048.0, 120
    theta = scattered(IWAN, 2)
    u0, v0 = np.array([[2e-3, 0, 0], [1e-3, 1e-4, 0]]), np.array([0.0, 0.1, 0.0])
    found = predict_record(model, theta, recording(np.zeros((n, 0)), fs, None), u0=u0, v0=v0, substeps=2)
    plain = simulate(model, theta, fs=2 * fs, samples=2 * n - 1, u0=u0, v0=v0, scheme="exponential", keep=("tip", "J1"), every=2)
    assert np.array_equal(found.values[..., 0], plain.acceleration[..., 0])
    assert np.array_equal(found.values[..., 1], plain.displacement[..., 1])


def test_a_motion_that_never_settles_is_said_to_be_so() -> None:
    # lightly damped and far too short a period for the number of periods that is allowed
    model = oscillator("cubic", zeta=1e-6)
    source = Recording("r", 1e-3, np.zeros((100, 1)), (Channel("d", "x", "displacement", "m"),), np.tile([[30.0], [-30.0]], (50,
                                                                                                                             1)) + 400.0,
                       (Channel("f", "x", "force", "N"),), period=100)
    found = predict_record(model, [[3e5]], source, substeps=1)
    assert found.status[0] == "not periodic" and found.drift[0] > 1e-3


def test_wrong_records_are_named() -> None:
    model = beam("iwan4")
    with pytest.raises(ValueError, match="no force"):
        predict_record(model, IWAN, recording(np.zeros((10, 0)), 100.0, None))
    elsewhere = Recording("r", 0.01, np.zeros((10, 2)), CHANNELS, np.zeros((10, 1)), (Channel("f", "tip", "force", "N"),))
    with pytest.raises(ValueError, match="no inputs"):
        predict_record(model, IWAN, elsewhere)


@pytest.mark.parametrize("period", [None, 200])
def test_a_gain_is_a_gain_of_the_recorded_force(period: int | None) -> None:
    model = oscillator("cubic", frequency=30.0, zeta=0.05, free=True)
    known, open_ = replace(model, free_gain=False), replace(model, free_gain=True)
    force = np.tile(multisine(200, 30)[:, :1], (2, 1))
    source = Recording("r", 1e-3, np.zeros((400, 1)), (Channel("d", "x", "displacement", "m"),), force, (Channel("f", "x", "force", "N"),),
                       period=period)
    theta = np.array([[30.0, 0.05, 3e8], [31.0, 0.04, 2e8]])
    gains = np.array([0.8, 1.3])
    assert open_.names[2] == "gain" and open_.start([0.0])[2] == 1.0
    found = predict_record(open_, np.insert(theta, 2, gains, axis=1), source, substeps=2)
    for i, gain in enumerate(gains):
        alone = predict_record(known, theta[i], replace(source, force=gain * force), substeps=2)
        # a batch settles as long as its slowest sample needs
        exact = 1e-12 if period is None else 1e-6
        np.testing.assert_allclose(found.values[i], alone.values[0], rtol=0, atol=exact * np.abs(alone.values).max())


def test_a_steady_state_begins_where_the_period_does() -> None:
    # forgotten within a fraction of the period: the run starts inside a period, the response must not
    model = oscillator("cubic", frequency=60.0, zeta=0.1)
    force = multisine(600, 60)[:, :1] * 20
    source = Recording("r", 1e-3, np.zeros((600, 1)), (Channel("d", "x", "displacement", "m"),), force, (Channel("f", "x", "force", "N"),),
                       period=600)
    steady = predict_record(model, [[1e8]], source, substeps=4)
    three = replace(source, response=np.zeros((1800, 1)), force=np.tile(force, (3, 1)), period=None)
    long = predict_record(model, [[1e8]], three, substeps=4)
    assert steady.ok.all()
    last = long.values[0, 1200:-10]
    np.testing.assert_allclose(steady.values[0, :590], last, atol=2e-3 * np.abs(last).max())
