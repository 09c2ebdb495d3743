"""Windows: where a decay begins and ends is known by construction."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.recordings.windows import free_decay_window, split

FS = 2048.0


def run(x: NDArray[np.float64], force: NDArray[np.float64] | None = None, period: int | None = None) -> Recording:
    channels = tuple(Channel(f"S{i}", f"S{i}", "acceleration", "m/s^2") for i in range(x.shape[1]))
    inputs = () if force is None else (Channel("F", "F", "force", "N"),)
    return Recording("run", 1 / FS, x, channels, np.zeros((len(x), 0)) if force is None else force[:, None], inputs, period=period)


def ring(n: int, hit: float, rate: float, seed: int) -> NDArray[np.float64]:
    t = np.arange(n) / FS - hit
    x = np.where(t >= 0, np.exp(-rate * t) * np.cos(2 * np.pi * 80 * t), 0)[:, None] * np.array([100.0, -30.0])
    return np.asarray(x + np.random.default_rng(seed).normal(0, 0.05, (n, 2)))


@pytest.mark.parametrize("hit", [0.0, 0.5, 1.7])
def test_decay_after_an_unmeasured_impact(hit: float) -> None:
    record = run(ring(16384, hit, 2.0, 1))
    decay = free_decay_window(record, role="holdout")
    assert decay.start == pytest.approx(hit, abs=0.02) and decay.role == "holdout" and decay.name == "run decay"
    end = hit + np.log(100 / np.sqrt(2) / 0.15) / 2.0  # where the louder channel reaches three times its noise
    assert decay.start + decay.n / FS == pytest.approx(min(end, 8.0), abs=0.3)


def test_decay_after_the_force_is_off() -> None:
    t = np.arange(16384) / FS
    force = np.where(t < 2, 10 * np.sin(2 * np.pi * 80 * t), 0.05 * np.sin(2 * np.pi * 80 * t))
    x = np.where(t < 2, 1.0, np.exp(-2 * (t - 2)))[:, None] * np.cos(2 * np.pi * 80 * t)[:, None]
    decay = free_decay_window(run(x, force))
    assert decay.start == pytest.approx(2.0, abs=0.01) and decay.inputs


def test_what_is_no_decay_is_refused() -> None:
    steady = np.random.default_rng(0).normal(size=(8192, 2))
    with pytest.raises(ValueError, match="no free decay"):
        free_decay_window(run(steady))
    with pytest.raises(ValueError, match="steady periods"):
        free_decay_window(run(steady, period=4096))
    with pytest.raises(ValueError, match="too few"):
        free_decay_window(run(steady[:100]))


def test_split_keeps_every_sample_and_names_roles() -> None:
    record = run(ring(1000, 0.0, 2.0, 2))
    train, holdout = split(record, 0.3)
    assert np.array_equal(np.concatenate([train.response, holdout.response]), record.response)
    assert (train.n, train.role, holdout.role, holdout.start) == (300, "train", "holdout", pytest.approx(300 / FS))


def test_split_of_periods_stays_between_them() -> None:
    record = run(np.tile(np.random.default_rng(3).normal(size=(100, 2)), (5, 1)), period=100)
    train, holdout = split(record, 0.5, gap=0.001)
    assert (train.n, train.period, holdout.n, holdout.period) == (200, 100, 200, 100)


@pytest.mark.parametrize(("fraction", "gap"), [(0.0, 0.0), (1.0, 0.0), (0.5, -1.0), (0.5, 10.0), (0.0001, 0.0)])
def test_split_refuses_to_leave_nothing(fraction: float, gap: float) -> None:
    with pytest.raises(ValueError, match="fraction|nothing would be left"):
        split(run(ring(1000, 0.0, 2.0, 4)), fraction, gap)
