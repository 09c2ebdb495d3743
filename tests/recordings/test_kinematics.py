"""Integration in the frequency domain against analytic motions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.recordings.filtering import band_pass
from bayes_nlsid.recordings.kinematics import Kinematics, kinematics
from bayes_nlsid.recordings.recording import Channel, Quantity, Recording

FS = 2048.0
QUANTITIES: tuple[Quantity, ...] = ("displacement", "velocity", "acceleration")


def record(x: NDArray[np.float64], quantity: Quantity, period: int | None = None, force: NDArray[np.float64] | None = None) -> Recording:
    columns = x.reshape(len(x), -1)
    channels = tuple(Channel(f"S{i}", f"S{i}", quantity, "") for i in range(columns.shape[1]))
    inputs = () if force is None else (Channel("F", "F", "force", "N"),)
    return Recording("test", 1 / FS, columns, channels, np.zeros((len(x), 0)) if force is None else force[:, None], inputs, period=period)


def motions(k: Kinematics) -> tuple[NDArray[np.float64], ...]:
    return k.displacement, k.velocity, k.acceleration


def multisine(lines: NDArray[np.int_], n: int, seed: int) -> tuple[NDArray[np.float64], ...]:
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(lines))
    omega = 2 * np.pi * lines * FS / n
    wave = np.exp(1j * (np.outer(np.arange(n) / FS, omega) + phase))
    return tuple(np.real(wave @ ((1j * omega) ** k / omega)) for k in range(3))


@pytest.mark.parametrize("measured", range(3))
def test_periodic_motion_is_exact(measured: int) -> None:
    n = 4096
    truth = multisine(np.arange(41, 1600, 7), n, seed=1)
    result = kinematics(record(truth[measured] + 3.0, QUANTITIES[measured], period=n), (20.0, 800.0))
    assert result.valid == slice(0, n)
    for found, expected in zip(motions(result), truth, strict=True):
        assert np.max(np.abs(found[:, 0] - expected)) < 1e-9 * np.max(np.abs(expected))
    assert result.error[0] < 1e-6


@pytest.mark.parametrize("measured", range(3))
@pytest.mark.parametrize(("frequency", "zeta", "phase"), [(80.0, 0.002, 0.0), (80.0, 0.003, 0.7), (25.0, 0.01, 2.0), (280.0, 0.0005, 4.0)])
def test_decaying_sinusoid_away_from_its_edges(measured: int, frequency: float, zeta: float, phase: float) -> None:
    pole = 2 * np.pi * frequency * (-zeta + 1j * np.sqrt(1 - zeta**2))
    t = np.arange(round(4 * FS)) / FS
    wave = np.exp(pole * t + 1j * phase)
    truth = [np.real(pole**k * wave) for k in range(3)]
    result = kinematics(record(truth[measured] + 0.1 * abs(pole) ** measured, QUANTITIES[measured]), (20.0, 400.0))
    assert 0.5 * len(t) < result.valid.stop - result.valid.start
    for found, expected in zip(motions(result), truth, strict=True):
        inside = expected[result.valid]
        error = np.sqrt(np.mean((found[result.valid, 0] - inside) ** 2) / np.mean(inside**2))
        assert error < 1e-3
        assert error < 3 * result.error[0]


def test_filter_is_common_so_that_linear_equations_survive() -> None:
    """m a + c v + k x = F holds after filtering to rounding, although most of the force lies outside the band."""
    n = 8192
    x, v, a = multisine(np.arange(3, 3500, 11), n, seed=2)
    m, c, k = 2.0, 30.0, 4e5
    result = kinematics(record(a, "acceleration", period=n, force=m * a + c * v + k * x), (60.0, 300.0))
    left = m * result.acceleration[:, 0] + c * result.velocity[:, 0] + k * result.displacement[:, 0]
    assert np.max(np.abs(left - result.force[:, 0])) < 1e-9 * np.max(np.abs(result.force))


def test_integrated_white_noise_has_the_predicted_spectrum() -> None:
    """One-sided density of displacement is that of acceleration times gain²/ω⁴: mean over lines of the ratio is one."""
    n, sd = 2**16, 2.0
    noise = np.random.default_rng(3).normal(0, sd, n)
    band = (20.0, 400.0)
    result = kinematics(record(noise, "acceleration", period=n), band)
    f = np.fft.rfftfreq(n, 1 / FS)
    psd = 2 / (FS * n) * np.abs(np.fft.rfft(result.displacement[:, 0])) ** 2
    predicted = 2 * sd**2 / FS / (2 * np.pi * np.maximum(f, 1.0)) ** 4 * result.gain(f) ** 2
    inside = predicted > 1e-6 * predicted.max()
    ratio = psd[inside] / predicted[inside]
    assert abs(ratio.mean() - 1) < 5 / np.sqrt(inside.sum())
    assert np.all(psd[f > result.stop[1]] < 1e-20 * psd.max())
    assert result.error[0] == pytest.approx(1.0, abs=0.1)  # nothing but noise, and the estimate says so


def test_error_estimate_follows_noise() -> None:
    n = 8192
    truth = multisine(np.arange(400, 1600, 40), n, seed=4)
    noise = np.random.default_rng(5).normal(0, 0.05 * truth[2].std(), n)
    result = kinematics(record(truth[2] + noise, "acceleration", period=n), (50.0, 500.0))
    actual = max(np.sqrt(np.mean((f[:, 0] - x) ** 2) / np.mean(x**2)) for f, x in zip(motions(result), truth, strict=True))
    assert 0.5 < result.error[0] / actual < 2


def test_burst_between_silences_needs_no_edges() -> None:
    t = np.arange(8192) / FS
    burst = np.exp(-0.5 * ((t - 2) / 0.1) ** 2) * np.sin(2 * np.pi * 150 * t)
    result = kinematics(record(burst, "acceleration"), (20.0, 800.0))
    assert result.valid == slice(0, 8192)
    assert np.max(np.abs(result.acceleration[:, 0] - burst)) < 1e-6


def test_decimation_keeps_the_samples() -> None:
    n = 4096
    truth = multisine(np.arange(41, 400, 7), n, seed=6)
    full = kinematics(record(truth[2], "acceleration", period=n), (20.0, 220.0))
    fewer = kinematics(record(truth[2], "acceleration", period=n), (20.0, 220.0), fs=FS / 4)
    assert fewer.dt == pytest.approx(4 / FS) and fewer.period == n // 4
    for a, b in zip(motions(fewer), motions(full), strict=True):
        assert np.allclose(a, b[::4], rtol=0, atol=1e-12 * np.abs(b).max())
    t = np.arange(8192) / FS
    decay = record(np.exp(-t) * np.cos(2 * np.pi * 80 * t), "acceleration")
    one, four = kinematics(decay, (20.0, 220.0)), kinematics(decay, (20.0, 220.0), fs=FS / 4)
    assert 4 * four.valid.start >= one.valid.start and 4 * (four.valid.stop - 1) <= one.valid.stop - 1


def test_filter_is_one_inside_and_zero_outside() -> None:
    f = np.linspace(0, 600, 6001)
    gain = band_pass(f, (50.0, 300.0), (25.0, 375.0))
    assert np.all(gain[(f >= 50) & (f <= 300)] == 1) and np.all(gain[(f <= 25) | (f >= 375)] == 0)
    assert np.all(np.diff(gain[f < 50]) >= 0) and np.all(np.diff(gain[f > 300]) <= 0)
    assert np.array_equal(gain, band_pass(-f, (50.0, 300.0), (25.0, 375.0)))


@pytest.mark.parametrize(("band", "fs", "message"), [
    ((0.0, 100.0), None, "between 0 and the Nyquist"), ((100.0, 50.0), None, "must ascend"), ((20.0, 2000.0), None, "Nyquist"),
    ((0.1, 100.0), None, "two periods of the lower band"), ((20.0, 100.0), 900.0, "whole number"), ((20.0, 400.0), FS / 4, "below twice"),
])
def test_impossible_bands_and_rates(band: tuple[float, float], fs: float | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kinematics(record(np.sin(np.arange(4096.0)), "acceleration"), band, fs)
