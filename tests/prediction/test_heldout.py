"""Held-out prediction: the right model is at the noise floor with honest bands, a wrong one is not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.prediction.heldout import heldout
from bayes_nlsid.recordings.noise import noise_psd
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.simulation.integration import simulate
from tests.simulation.problems import IWAN, beam, scattered

FS = 512.0
CHANNELS = (Channel("a", "tip", "acceleration", "m/s^2"), Channel("b", "shaker", "acceleration", "m/s^2"))
MODEL = beam("iwan4")


def sweep(t: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(40 * np.sin(2 * np.pi * (15 * t + 5 * t**2)) * np.minimum(t / 0.2, 1) ** 2)


def record(n: int, noise: float, forced: bool = False, u0: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Recording:
    fine = 8
    force = sweep(np.arange((n - 1) * fine + 1) / (fine * FS))[:, None]
    applied = force if forced else None
    clean = simulate(MODEL, IWAN, fs=FS * fine, samples=(n - 1) * fine + 1, u0=u0, force=applied, keep=("tip", "shaker"), every=fine,
                     scheme="exponential", store=("acceleration",)).acceleration[0]
    y = clean + noise * np.random.default_rng(4).standard_normal(clean.shape)
    inputs = (Channel("f", "shaker", "force", "N"),) if forced else ()
    return Recording("r", 1 / FS, y, CHANNELS, force[::fine] if forced else np.zeros((n, 0)), inputs)


def quiet(noise: float) -> Recording:
    y = noise * np.random.default_rng(9).standard_normal((4096, 2))
    return Recording("noise", 1 / FS, y, CHANNELS, np.zeros((4096, 0)), role="noise")


def test_a_decay_is_predicted_to_the_noise_by_the_truth_and_not_by_the_linear_model() -> None:
    decay = record(900, 0.1, u0=(6e-3, 1e-4, 0.0))
    floor = noise_psd(decay, quiet(0.1))
    found = heldout(MODEL, IWAN, decay, noise=floor)
    assert found.start == "estimate" and found.scored.start > 0
    assert found.nrmse == pytest.approx(found.noise_floor, rel=0.15)
    assert found.coverage90 == pytest.approx(0.9, abs=0.05)
    linear = heldout(beam(), np.zeros((1, 0)), decay, noise=floor)
    assert linear.nrmse > 20 * found.nrmse and linear.coverage90 < 0.2


def test_bands_of_scattered_draws_cover_and_widen() -> None:
    decay = record(700, 0.1, u0=(6e-3, 0.0, 0.0))
    floor = noise_psd(decay, quiet(0.1))
    found = heldout(MODEL, scattered(IWAN, 12, 0.02), decay, noise=floor, band=(8.0, 120.0), seed=1)
    sharp = heldout(MODEL, IWAN, decay, noise=floor, band=(8.0, 120.0))
    assert np.mean(found.q95 - found.q05) > 1.5 * np.mean(sharp.q95 - sharp.q05)
    assert found.coverage90 > 0.85
    assert found.status == {"ok": 12}
    again = heldout(MODEL, scattered(IWAN, 12, 0.02), decay, noise=floor, band=(8.0, 120.0), seed=1)
    assert np.array_equal(again.q50, found.q50)


def test_a_forced_record_from_rest_needs_no_start() -> None:
    forced = record(700, 0.05, True)
    found = heldout(MODEL, IWAN, forced, noise=noise_psd(forced, quiet(0.05)))
    assert found.start == "rest" and found.scored == slice(0, 700)
    assert found.nrmse < 1.3 * found.noise_floor + 2e-3
    assert found.coverage90 == pytest.approx(0.9, abs=0.06)


def test_draws_that_fail_are_counted_and_left_out() -> None:
    decay = record(300, 0.1, u0=(3e-3, 0.0, 0.0))
    model = beam("cubic")
    found = heldout(model, np.array([[0.0, 0.0], [-1e20, -1e20]]), decay, noise=noise_psd(decay, quiet(0.1)))
    assert found.status.get("ok") == 1 and sum(found.status.values()) == 2
    assert np.isfinite(found.q50).all()
