"""Backbones of decays whose frequency and damping are known in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from bayes_nlsid.recordings.decay import Backbone, measured_backbone


def linear(t: NDArray[np.float64], frequency: float, zeta: float, phase: float = 0.3) -> NDArray[np.float64]:
    pole = 2 * np.pi * frequency * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return np.asarray(1e-3 * np.real(np.exp(pole * t + 1j * phase)))


@pytest.mark.parametrize(("fs", "frequency", "zeta", "seconds"), [(8192, 78.5, 0.002, 12), (8192, 80.0, 0.02, 3), (4096, 15.0, 0.05, 4)])
def test_linear_decay_is_exact(fs: int, frequency: float, zeta: float, seconds: float) -> None:
    t = np.arange(0, seconds, 1 / fs)
    result = measured_backbone(t, linear(t, frequency, zeta))
    known = np.isfinite(result.damping)
    assert result.status == "ok" and known.sum() > 35
    assert np.abs(result.damping[known] - zeta).max() < 1e-6 * zeta
    assert np.abs(result.frequency[known] / (frequency * np.sqrt(1 - zeta**2)) - 1).max() < 1e-6


@pytest.mark.parametrize(("fs", "frequency", "zeta", "band"), [
    (8192, 78.5, 0.002, (47.0, 118.0)), (2048, 280.0, 0.0005, (168.0, 420.0)), (1000, 120.0, 0.003, (72.0, 180.0)),
    (2048, 280.0, 0.0005, None),
])
def test_band_pass_and_few_samples_per_cycle(fs: int, frequency: float, zeta: float, band: tuple[float, float] | None) -> None:
    t = np.arange(0, 8, 1 / fs)
    grid = np.geomspace(2e-5, 5e-4, 9)
    result = measured_backbone(t, linear(t, frequency, zeta), band, grid)
    known = np.isfinite(result.damping)
    assert known.sum() >= 5
    assert np.abs(result.damping[known] / zeta - 1).max() < 3e-3
    assert np.abs(result.frequency[known] / frequency - 1).max() < 1e-5


def test_band_pass_removes_other_modes_and_offset() -> None:
    t = np.arange(0, 10, 1 / 4096)
    x = linear(t, 80, 0.002) + linear(t, 300, 0.001) + 1e-3
    result = measured_backbone(t, x, (50.0, 130.0), np.geomspace(2e-5, 3e-4, 8))
    assert result.status == "ok"
    assert np.abs(result.damping / 0.002 - 1).max() < 3e-3 and np.abs(result.frequency / 80 - 1).max() < 1e-5


def test_duffing_decay_follows_the_elliptic_backbone() -> None:
    """x'' + 2ζω x' + ω² x + β x³ = 0: the period at amplitude A is 4 K(m) / √(ω² + βA²), m = βA² / 2(ω² + βA²)."""
    omega, zeta, beta = 2 * np.pi * 20, 0.002, 1.5e10
    t = np.arange(0, 12, 1 / 2048)
    run = solve_ivp(lambda _, y: [y[1], -2 * zeta * omega * y[1] - omega**2 * y[0] - beta * y[0] ** 3], (0, t[-1]), [1e-3, 0.0],
                    method="DOP853", t_eval=t, rtol=1e-10, atol=1e-14)
    result = measured_backbone(t, run.y[0], amplitudes=np.geomspace(6e-5, 9e-4, 20))
    square = omega**2 + beta * result.amplitude**2
    exact = np.sqrt(square) / (4 * ellipk(beta * result.amplitude**2 / (2 * square)))
    assert exact[-1] / exact[0] > 1.2
    assert np.abs(result.frequency / exact - 1).max() < 1e-4
    # the action J decays as exp(−2ζωt), hence d ln A / dt = −2ζω / (d ln J / d ln A), with dJ = (energy' / frequency) dA
    a = np.linspace(1e-6, 1e-3, 20001)
    period = 4 * ellipk(beta * a**2 / (2 * (omega**2 + beta * a**2))) / np.sqrt(omega**2 + beta * a**2)
    rate = (omega**2 * a + beta * a**3) * period
    action = np.concatenate([[0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(a))]) + 0.5 * rate[0] * a[0]
    growth = np.interp(result.amplitude, a, a * rate / action)
    assert np.abs(result.damping * 2 * np.pi * exact / (2 * zeta * omega / growth) - 1).max() < 3e-3


def test_damping_that_grows_with_the_root_of_amplitude() -> None:
    omega, zeta = 2 * np.pi * 80, 0.005
    t = np.arange(0, 10, 1 / 4096)
    envelope = 1e-3 / (1 + omega * zeta * t / 2) ** 2
    grid = np.geomspace(1e-5, 8e-4, 15)
    result = measured_backbone(t, envelope * np.cos(omega * t), amplitudes=grid)
    assert np.abs(result.damping / (zeta * np.sqrt(grid / 1e-3)) - 1).max() < 2e-3
    assert np.abs(result.frequency / 80 - 1).max() < 1e-6


def test_noise_and_standard_errors() -> None:
    """Over many noises the mean is right and the scatter is what the local fit says."""
    t = np.arange(0, 8, 1 / 2048)
    grid = np.geomspace(4e-5, 5e-4, 6)
    noisy = linear(t, 80, 0.003) + 2e-6 * np.random.default_rng(1).normal(size=(48, len(t)))
    result = measured_backbone(t, noisy, (50.0, 130.0), grid)
    assert result.damping.shape == (48, 6) and result.status == "ok"
    for value, sd, truth in ((result.damping, result.damping_sd, 0.003), (result.frequency, result.frequency_sd, 80 * np.sqrt(1 - 9e-6))):
        scatter = value.std(axis=0, ddof=1)
        assert np.all(np.abs(value.mean(axis=0) - truth) < 4 * scatter / np.sqrt(48) + 1e-4 * truth)
        assert np.all((sd.mean(axis=0) / scatter > 0.6) & (sd.mean(axis=0) / scatter < 2.2))


def test_outside_what_was_passed_nothing_is_claimed() -> None:
    t = np.arange(0, 4, 1 / 4096)
    result = measured_backbone(t, linear(t, 80, 0.002), amplitudes=[1e-9, 1e-4, 1e-2])
    assert np.array_equal(np.isnan(result.frequency), [True, False, True])
    assert np.array_equal(np.isnan(result.damping_sd), [True, False, True])


def test_what_is_no_decay_says_so() -> None:
    t = np.arange(0, 4, 1 / 4096)
    beating = np.cos(2 * np.pi * 80 * t) + 0.5 * np.cos(2 * np.pi * 83 * t)
    assert "rises" in measured_backbone(t, beating).status
    assert measured_backbone(t, np.zeros_like(t)).status == "no oscillation"
    assert measured_backbone(t, np.where(t == t[-1], np.nan, 1.0)).status == "not finite"
    mixed = measured_backbone(t, np.stack([linear(t, 80, 0.002), np.full_like(t, np.nan), np.zeros_like(t)]), amplitudes=[1e-4, 2e-4])
    assert mixed.status == "1 of 3: not finite; 1 of 3: no oscillation"
    assert np.isfinite(mixed.frequency[0]).all() and np.isnan(mixed.frequency[1:]).all()


def test_offset_of_the_amplitude_scale() -> None:
    """Scaling the signal moves the backbone along the amplitude axis and changes nothing else."""
    t = np.arange(0, 6, 1 / 4096)
    x = linear(t, 80, 0.003) * (1 + 0.1 * np.exp(-t))
    one, two = measured_backbone(t, x), measured_backbone(t, 1e3 * x)
    assert np.allclose(two.amplitude, 1e3 * one.amplitude, rtol=1e-12)
    assert np.allclose(two.damping, one.damping, rtol=1e-8, equal_nan=True)


@pytest.mark.parametrize(("time", "shape", "band", "amplitudes", "message"), [
    (np.arange(10.0), (9,), None, None, "last axis"), (np.arange(100.0) ** 2, (100,), None, None, "constant step"),
    (np.arange(100.0), (100,), (0.3, 0.2), None, "must ascend"), (np.arange(100.0), (100,), None, [2.0, 1.0], "ascending"),
])
def test_wrong_arguments(time: NDArray[np.float64], shape: tuple[int, ...], band: tuple[float, float] | None,
                         amplitudes: list[float] | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measured_backbone(time, np.ones(shape), band, amplitudes)


def test_backbone_checks_its_shapes() -> None:
    one = np.ones(3)
    assert np.isnan(Backbone(one, one, one).damping_sd).all()
    with pytest.raises(ValueError, match="last axis"):
        Backbone(one, np.ones(2), one)
    with pytest.raises(ValueError, match="frequency_sd"):
        Backbone(one, one, one, frequency_sd=np.ones(2))
