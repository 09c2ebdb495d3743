"""Noise floors against noises of known density."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.recordings.noise import NoiseFloor, as_stated, noise_psd, quiet_stretch
from bayes_nlsid.recordings.recording import Channel, Recording

FS = 2048.0


def record(x: NDArray[np.float64], name: str = "run", role: str = "train", period: int | None = None) -> Recording:
    channels = tuple(Channel(f"S{i}", f"S{i}", "acceleration", "m/s^2") for i in range(x.shape[1]))
    return Recording(name, 1 / FS, x, channels, np.zeros((len(x), 0)), role=role, period=period)  # type: ignore[arg-type]


def white(n: int, sd: float, seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(0, sd, (n, 2))


def expect_level(floor: NoiseFloor, sd: float, tolerance: float) -> None:
    """White noise of variance sd² has the one-sided density 2 sd²/fs."""
    inner = floor.psd[2:-2]
    assert np.all(np.abs(inner.mean(axis=0) / (2 * sd**2 / FS) - 1) < tolerance)
    assert np.all(np.abs(floor.rms() / sd - 1) < tolerance)
    assert np.all(np.abs(floor.rms((100.0, 356.0)) / (sd / 2) - 1) < 2 * tolerance)  # a quarter of the power


def test_from_a_noise_record() -> None:
    signal = record(np.cos(np.arange(4096.0))[:, None] * np.ones(2))
    floor = noise_psd(signal, record(white(8192, 0.3, 1), "off", "noise"))
    assert floor.sure == "measured" and "'off'" in floor.how
    expect_level(floor, 0.3, 0.06)


@pytest.mark.parametrize("periods", [2, 5])
def test_from_steady_periods_whatever_the_signal(periods: int) -> None:
    n = 4096
    signal = np.tile(100 * np.random.default_rng(2).normal(size=(n, 2)), (periods, 1))
    floor = noise_psd(record(signal + white(periods * n, 0.2, 3), period=n))
    assert floor.sure == "measured" and f"{periods} steady periods" in floor.how
    expect_level(floor, 0.2, 0.06)


def test_coloured_noise_keeps_its_colour() -> None:
    n = 2**15
    x = white(n, 1.0, 4)
    x[1:] += 0.9 * x[:-1]  # density 2/fs |1 + 0.9 e^{−iω}|²
    floor = noise_psd(record(x, role="noise"))
    exact = 2 / FS * np.abs(1 + 0.9 * np.exp(-2j * np.pi * floor.frequency / FS)) ** 2
    inside = (floor.frequency > 10) & (floor.frequency < 900)
    assert np.abs((floor.psd[inside, 0] / exact[inside]).mean() - 1) < 0.05


@pytest.mark.parametrize(("quiet", "words"), [("before", "before the event"), ("after", "after the decay")])
def test_from_a_quiet_beginning_or_end(quiet: str, words: str) -> None:
    t = np.arange(16384) / FS
    start = 2.0 if quiet == "before" else 0.0
    rate = 0.5 if quiet == "before" else 4.0
    event = np.where(t >= start, np.exp(-rate * (t - start)) * np.sin(2 * np.pi * 90 * (t - start)), 0)[:, None] * np.array([50.0, 20.0])
    floor = noise_psd(record(event + white(len(t), 0.1, 5)))
    assert floor.sure == "estimated" and words in floor.how
    expect_level(floor, 0.1, 0.12)


def test_from_the_lower_envelope() -> None:
    t = np.arange(16384) / FS
    decay = np.exp(-0.5 * t) * (np.sin(2 * np.pi * 90 * t) + 0.5 * np.sin(2 * np.pi * 410 * t))
    floor = noise_psd(record(10 * decay[:, None] * np.ones(2) + white(len(t), 0.05, 6)))
    assert floor.sure == "bound" and "lower envelope" in floor.how
    far = (floor.frequency > 550) & (floor.frequency < 1000)
    assert np.all(np.abs(floor.psd[far].mean(axis=0) / (2 * 0.05**2 / FS) - 1) < 0.15)
    assert np.all(floor.rms() > 0.04)


def test_steady_signal_has_no_quiet_stretch() -> None:
    assert quiet_stretch(record(white(8192, 1.0, 7))) is None
    assert quiet_stretch(record(np.zeros((8192, 2)))) is None


def test_forces_have_a_floor_too() -> None:
    n = 2048
    force = np.tile(np.random.default_rng(8).normal(size=(n, 1)), (4, 1)) + np.random.default_rng(9).normal(0, 0.1, (4 * n, 1))
    base = record(np.tile(white(n, 1.0, 10), (4, 1)), period=n)
    run = Recording("f", 1 / FS, base.response, base.channels, force, (Channel("F", "F", "force", "N"),), period=n)
    floor = noise_psd(run)
    assert floor.force_psd[2:-2].mean() == pytest.approx(2 * 0.1**2 / FS, rel=0.08)
    assert np.all(floor.psd < 1e-20)


def test_misuse_is_named() -> None:
    run, other = record(white(1024, 1, 1)), record(white(1024, 1, 1)[:, :1], "other", "noise")
    with pytest.raises(ValueError, match="must be the same"):
        noise_psd(run, other)
    with pytest.raises(ValueError, match="at least 16"):
        noise_psd(record(white(8, 1, 1)))
    with pytest.raises(ValueError, match="must ascend"):
        noise_psd(record(white(1024, 1, 1), role="noise")).rms((5.0, 2.0))


def test_from_what_repeats_in_a_noise_record() -> None:
    """130 samples of a period of 4096 come a second time: what differs is noise, whatever the signal."""
    n = 4096
    signal = 100 * np.random.default_rng(2).normal(size=(n, 2))
    twice = record(np.concatenate([signal, signal[:130]]) + white(n + 130, 0.2, 3), "again", "noise", n)
    floor = noise_psd(record(signal), twice)
    assert floor.sure == "measured" and "130 samples" in floor.how
    assert np.all(np.abs(floor.rms() / 0.2 - 1) < 0.2)
    with pytest.raises(ValueError, match="hold no 32 that repeat"):
        record(signal, role="noise", period=n)


def test_a_sweep_without_a_quiet_part_is_judged_by_the_quietest_part_of_its_spectrum() -> None:
    t = np.arange(2**14) / FS
    sweep = np.sin(2 * np.pi * (10 * t + 15 * t**2))[:, None] * np.ones(2)  # 10 to 250 Hz
    plain = record(sweep + white(len(t), 0.01, 5))
    forced = Recording(plain.name, plain.dt, plain.response, plain.channels, sweep[:, :1], (Channel("F", "S0", "force", "N"),))
    floor = noise_psd(forced)
    assert floor.sure == "bound" and "quietest quarter" in floor.how
    assert np.all(np.abs(floor.rms() / 0.01 - 1) < 0.25)
    assert np.all(noise_psd(plain).rms() > 0.1), "without the rule the sweep itself is taken for noise"


def test_noise_stated_for_some_channels() -> None:
    floor = noise_psd(record(white(4096, 0.3, 1), role="noise"))
    stated = as_stated(floor, [0.05, None])
    assert stated.rms() == pytest.approx([0.05, floor.rms()[1]]) and "S0 as stated" in stated.how
    assert as_stated(floor, [0.0, 0.0]).rms().tolist() == [0.0, 0.0] and as_stated(floor, [None, None]) is floor
