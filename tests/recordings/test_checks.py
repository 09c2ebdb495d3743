"""Checks: silence on clean signals of many kinds, and a finding for every fault put into them."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.recordings.checks import Finding, check, resolution
from bayes_nlsid.recordings.recording import Channel, Recording, Role

FS, N = 2048.0, 8192
Signal = NDArray[np.float64]
T = np.arange(N) / FS


def multisine(rng: np.random.Generator) -> Signal:
    lines = np.unique(rng.integers(20, 1600, 60))
    spectrum = np.zeros(N // 2 + 1, dtype=complex)
    spectrum[lines] = rng.uniform(0.1, 1, len(lines)) * np.exp(1j * rng.uniform(0, 2 * np.pi, len(lines)))
    return np.asarray(np.fft.irfft(spectrum) * N / 2 + 1e-3 * rng.normal(size=N))


def decay(rng: np.random.Generator) -> Signal:
    start, f = rng.uniform(0, 1), rng.uniform(20, 300, 3)
    t = np.maximum(T - start, 0)
    wave = np.exp(-np.outer(t, 2 * np.pi * f * rng.uniform(1e-3, 1e-2, 3))) * np.sin(2 * np.pi * np.outer(t, f)) @ rng.uniform(0.2, 1, 3)
    return np.asarray(wave + 1e-3 * rng.normal(size=N))


def noise(rng: np.random.Generator) -> Signal:
    return np.asarray(np.convolve(rng.normal(size=N), np.ones(rng.integers(1, 8)), mode="same"))


def sine(rng: np.random.Generator) -> Signal:
    return np.asarray(np.sin(2 * np.pi * rng.uniform(10, 300) * T + rng.uniform(0, 6)))


def sweep(rng: np.random.Generator) -> Signal:
    return np.asarray(np.sin(2 * np.pi * (20 * T + rng.uniform(10, 60) * T**2)) * (1 + 0.5 * np.sin(T)))


CLEAN: tuple[Callable[[np.random.Generator], Signal], ...] = (multisine, decay, noise, sine, sweep)


def found(x: Signal, role: Role = "holdout", quantity: str = "acceleration") -> tuple[Finding, ...]:
    columns = x.reshape(len(x), -1)
    channels = tuple(Channel(f"S{i}", f"S{i}", quantity, "") for i in range(columns.shape[1]))  # type: ignore[arg-type]
    return check(Recording("run", 1 / FS, columns, channels, np.zeros((len(x), 0)), role=role))


def kinds(x: Signal, role: Role = "holdout") -> set[str]:
    return {f.kind for f in found(x, role)}


@pytest.mark.parametrize("make", CLEAN)
@pytest.mark.parametrize("bits", [None, 16, 12])
def test_clean_signals_are_silent(make: Callable[[np.random.Generator], Signal], bits: int | None) -> None:
    """Not one finding in 40 random signals, as computed or as a converter of 16 or 12 bits would store them."""
    for seed in range(40):
        x = make(np.random.default_rng(seed))
        if bits:
            step = 2.5 * np.abs(x).max() / 2**bits
            x = np.rint(x / step) * step
        assert found(x) == (), seed


@pytest.mark.parametrize("make", [multisine, noise, sine, sweep])
@pytest.mark.parametrize("bits", [None, 16, 12])
@pytest.mark.parametrize("both", [True, False])
def test_clipping_is_found(make: Callable[[np.random.Generator], Signal], bits: int | None, both: bool) -> None:
    for seed in range(10):
        x = make(np.random.default_rng(seed))
        if bits:
            step = 2.5 * np.abs(x).max() / 2**bits
            x = np.rint(x / step) * step
        limit = np.quantile(np.abs(x), 0.85 if make is sine else 0.97)  # of a sine, fewer samples are no top
        assert "clipping" in kinds(np.clip(x, -limit if both else -np.inf, limit)), seed


def test_a_plateau_is_no_clipping() -> None:
    """A positioning move: rest, move, rest at the end stop, back, three times; quantised with noise."""
    rng = np.random.default_rng(0)
    move = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 700))
    x = np.tile(np.concatenate([np.zeros(600), move, np.ones(600), 1 - move]), 3)
    for step in (0.0, 1e-3):
        y = x + 1e-4 * rng.normal(size=len(x)) if step == 0 else np.rint(x / step) * step
        assert "clipping" not in {f.kind for f in found(y, quantity="displacement")}


@pytest.mark.parametrize("make", [multisine, noise, sine])
@pytest.mark.parametrize("zero", [True, False])
def test_held_samples_are_found(make: Callable[[np.random.Generator], Signal], zero: bool) -> None:
    for seed in range(10):
        x = make(np.random.default_rng(seed))
        at = int(np.random.default_rng(seed).integers(1000, 7000))
        x[at:at + 12] = 0 if zero else x[at]
        (finding,) = [f for f in found(x) if f.kind == "held"]
        assert finding.severity == "error" and ("drops to zero" in finding.sentence) == zero
        assert f"{at / FS:.4g} s" in finding.sentence


@pytest.mark.parametrize("make", [decay, sine])
def test_spikes_are_found(make: Callable[[np.random.Generator], Signal]) -> None:
    for seed in range(10):
        x = make(np.random.default_rng(seed))
        at = np.random.default_rng(seed).choice(np.arange(3000, 8000, 50), 4, replace=False)
        x[at] += 2 * np.abs(x).max() * np.array([1, -1, 1, -1])
        (finding,) = [f for f in found(x) if f.kind == "spikes"]
        assert finding.sentence.startswith("has 4 single-sample spikes") and f"{at.min() / FS:.4g} s" in finding.sentence


def test_dead_channels_are_found() -> None:
    x = np.stack([multisine(np.random.default_rng(i)) for i in range(3)], axis=1)
    x[:, 1] = 0.25
    assert [(f.kind, f.channel, f.severity) for f in found(x)] == [("dead", "S1", "error")]
    x[:, 1] = 1e-9 * np.random.default_rng(9).normal(size=N)
    assert [(f.kind, f.channel) for f in found(x)] == [("dead", "S1")]
    assert found(np.zeros(N), role="noise")[0].severity == "note"


def test_offset_and_drift_are_found() -> None:
    for seed in range(10):
        x = noise(np.random.default_rng(seed))
        x /= x.std()
        assert kinds(x + 3) == {"offset"}
        assert kinds(x + 0.4 * T) == {"drift"}
    assert found(T**2 + 5, quantity="displacement") == ()


def test_alike_channels_are_found() -> None:
    x = np.stack([multisine(np.random.default_rng(i)) for i in range(3)], axis=1)
    x[:, 2] = -x[:, 0]
    (finding,) = found(x)
    assert (finding.kind, finding.channel) == ("alike", "S0") and "the negative of 'S2'" in finding.sentence
    x[:, 2] = x[:, 1]
    assert "the same as 'S2'" in found(x)[0].sentence


def test_aliasing_is_hinted_at() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        assert kinds(multisine(rng) + 2 * np.sin(2 * np.pi * 0.48 * FS * T)) == {"aliasing"}
    assert kinds(np.random.default_rng(0).normal(size=N)) == set()  # white noise is flat up to the end


def test_coarse_resolution_is_found() -> None:
    for seed in range(10):
        x = multisine(np.random.default_rng(seed))
        step = 0.2 * x.std()
        assert "coarse" in kinds(np.rint(x / step) * step)
        assert resolution(np.rint(x / step) * step) == pytest.approx(step)
        assert resolution(x) == 0


def test_too_short_and_order_of_findings() -> None:
    (finding,) = found(np.random.default_rng(0).normal(size=100))
    assert finding.kind == "short" and str(finding) == "error: holds only 100 samples; record at least 256."
    x = np.stack([noise(np.random.default_rng(i)) for i in range(2)], axis=1)
    x[:, 0] += 5 * x[:, 0].std()
    x[:, 1] = np.clip(x[:, 1], -1, 1)
    assert [f.severity for f in found(x)] == ["error", "note"]


def test_motion_that_goes_on_without_a_force_is_told() -> None:
    rng = np.random.default_rng(0)
    told = [{f.kind for f in found(make(rng), role="train")} for make in (multisine, noise, sine, decay)]
    assert told == [{"driven"}] * 3 + [set()]
    force = (Channel("F", "S0", "force", "N"),)
    x = multisine(rng)[:, None]
    assert check(Recording("run", 1 / FS, x, (Channel("S0", "S0", "acceleration", ""),), x, force)) == ()


def test_a_sweep_of_steady_amplitude_is_not_clipped() -> None:
    """Its samples reach the very extreme again and again; cut at 90 %, it is found."""
    t = np.arange(120_000) / 750.0
    sweep = np.round(40 * np.sin(2 * np.pi * (5 * t + 0.28 * t**2)), 7)
    assert "clipping" not in kinds(sweep)
    assert "clipping" in kinds(np.clip(sweep, -36, 36))
