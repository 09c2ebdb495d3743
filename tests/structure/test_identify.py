"""Modes from data: exact without noise, honest standard deviations with it, close modes, amplitude-dependent decays, forces."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.identified import pair
from bayes_nlsid.structure.identify import identify_modes
from bayes_nlsid.structure.modal import ModalModel

FS = 1024.0
NAMES = ("S1", "S2", "S3")
SHAPES = np.array([[1.0, 0.8, -0.6], [0.4, -1.0, 0.5], [-0.3, 0.2, 1.0]])


def truth(frequency: list[float], zeta: list[float]) -> ModalModel:
    m = len(frequency)
    return ModalModel(2 * np.pi * np.array(frequency), np.array(zeta), (*NAMES, "F"), np.vstack([SHAPES[:, :m], [[0.5] * m]]),
                      sensors=NAMES, inputs=("F",))


def channels(quantity: str = "acceleration") -> tuple[Channel, ...]:
    return tuple(Channel(f"c{i + 1}", n, quantity, "-") for i, n in enumerate(NAMES))  # type: ignore[arg-type]


def decay(model: ModalModel, amplitude: list[float], seconds: float, noise: float, seed: int, quantity: str = "acceleration") -> Recording:
    """Sum of decaying exponentials with random phases, plus white noise of the stated rms."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * FS)) / FS
    s = model.omega * (-model.zeta + 1j * np.sqrt(1 - model.zeta**2))
    u = np.exp(np.outer(t, s)) * np.array(amplitude) * np.exp(2j * np.pi * rng.random(model.modes))
    order = {"displacement": 0, "velocity": 1, "acceleration": 2}[quantity]
    response = np.real(u * s**order) @ model.rows(NAMES).T
    response += noise * rng.standard_normal(response.shape)
    return Recording("decay", 1 / FS, response, channels(quantity), np.zeros((t.size, 0)))


def shape_error(found: np.ndarray, model: ModalModel, k: int) -> float:
    true = model.rows(NAMES)[:, k]
    true = true / true[np.argmax(np.abs(true))]
    return float(np.abs(found - true).max())


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_noise_free_decay_is_found_to_many_digits(quantity: str) -> None:
    model = truth([40.0, 97.0, 181.0], [0.004, 0.002, 0.003])
    recording = decay(model, [1e-3, 1e-4, 1e-4], 8.0, 0.0, 3, quantity)
    found = identify_modes(recording, model, window=(0.5, 4.0))
    np.testing.assert_allclose(found.frequency, model.frequency, rtol=1e-6)
    np.testing.assert_allclose(found.zeta, model.zeta, rtol=1e-3)
    assert max(shape_error(found.shapes[:, k], model, k) for k in range(3)) < 1e-3
    assert (found.phase_scatter < 1e-3).all() and not found.signed
    true_amplitude = 1e-3 * np.abs(SHAPES[:, 0]).max() * np.exp(-0.004 * model.omega[0] * 0.5)
    assert found.amplitude[0] == pytest.approx(true_amplitude, rel=1e-3)


def test_nominal_model_may_be_several_per_cent_off() -> None:
    model = truth([40.0, 97.0, 181.0], [0.004, 0.002, 0.003])
    off = truth([42.5, 93.0, 188.0], [0.001, 0.001, 0.001])
    found = identify_modes(decay(model, [1e-3, 1e-4, 1e-4], 8.0, 1e-3, 3), off)
    np.testing.assert_allclose(found.frequency, model.frequency, rtol=1e-3)
    assert found.nominal == (0, 1, 2) and pair(found, off) == ((0, 0), (1, 1), (2, 2))


def test_stated_standard_deviations_cover_the_truth() -> None:
    model = truth([40.0, 97.0], [0.004, 0.003])
    misses = []
    for seed in range(14):
        found = identify_modes(decay(model, [1e-3, 1e-4], 6.0, 3e-2, seed), model)
        assert found.modes == 2
        misses += list((found.frequency - model.frequency) / found.frequency_sd) + list((found.zeta - model.zeta) / found.zeta_sd)
    misses = np.array(misses)
    assert 0.7 < np.sqrt(np.mean(misses**2)) < 1.4
    assert 0.88 < np.mean(np.abs(misses) < 2) < 0.995
    assert abs(np.mean(misses)) < 0.35


def test_close_modes_are_parted() -> None:
    model = truth([60.0, 61.2, 140.0], [0.003, 0.003, 0.003])
    misses = []
    for seed in range(4):
        found = identify_modes(decay(model, [1e-4, 1e-4, 1e-5], 6.0, 1e-3, seed), model)
        assert found.modes == 3
        np.testing.assert_allclose(found.frequency, model.frequency, rtol=1e-3)
        np.testing.assert_allclose(found.zeta, model.zeta, rtol=0.15)
        assert max(shape_error(found.shapes[:, k], model, k) for k in range(2)) < 0.1
        misses += list((found.frequency - model.frequency) / found.frequency_sd)
    assert np.sqrt(np.mean(np.square(misses))) < 2


def test_a_softening_decay_is_read_at_its_quiet_end() -> None:
    """Frequency and damping that depend on amplitude like those of a bolted joint: 80 (1 − 0.02 A/mm) Hz, 0.1 % (1 + 20 A/mm)."""
    a, phase, trace = 1e-3, 0.0, []
    for _ in range(round(20 * FS)):
        trace.append(a * np.cos(phase))
        phase += 2 * np.pi * 80 * (1 - 20 * a) / FS
        a *= np.exp(-1e-3 * (1 + 2e4 * a) * 2 * np.pi * 80 / FS)
    rng = np.random.default_rng(1)
    response = np.outer(trace, SHAPES[:, 0]) + 1e-8 * rng.standard_normal((len(trace), 3))
    recording = Recording("decay", 1 / FS, response, channels("displacement"), np.zeros((len(trace), 0)))
    found = identify_modes(recording, truth([79.0], [0.002]))
    assert found.frequency[0] == pytest.approx(80.0, abs=0.005)
    assert found.zeta[0] == pytest.approx(1e-3, rel=0.05)
    assert found.amplitude[0] < 1e-5 and found.window[0][0] > 5


def test_an_uninvited_neighbour_does_not_spoil_a_mode() -> None:
    model, both = truth([97.0], [0.003]), truth([97.0, 99.5], [0.003, 0.003])
    found = identify_modes(decay(both, [1e-4, 1e-5], 6.0, 1e-3, 2), model)
    assert found.frequency[0] == pytest.approx(97.0, abs=0.02) and found.zeta[0] == pytest.approx(0.003, rel=0.1)


def test_a_mode_that_is_not_there_is_left_out_and_named() -> None:
    model, fewer = truth([40.0, 97.0, 181.0], [0.004, 0.002, 0.003]), truth([40.0, 97.0], [0.004, 0.002])
    found = identify_modes(decay(fewer, [1e-3, 1e-4], 6.0, 1e-2, 3), model)
    assert found.nominal == (0, 1) and any("mode 3" in note for note in found.notes)


def forced(model: ModalModel, seed: int, noise: float, period: bool, seconds: float = 8.0) -> Recording:
    """Exact response to a random-phase multisine, or to a burst followed by silence (long padding makes it exact)."""
    rng = np.random.default_rng(seed)
    n = round(seconds * FS)
    total = n if period else 8 * n
    f = np.fft.rfftfreq(total, 1 / FS)
    if period:
        drive = np.where((f > 10) & (f < 250), np.exp(2j * np.pi * rng.random(f.size)), 0) * np.sqrt(n)
    else:
        burst = np.zeros(total)
        burst[:n] = rng.standard_normal(n)
        drive = np.where((f > 10) & (f < 250), np.fft.rfft(burst), 0)
    w = 2 * np.pi * f
    w0, z = model.omega[:, None], model.zeta[:, None]
    u = drive * model.rows(["F"]).T / (w0**2 - w**2 + 2j * z * w0 * w)
    response = np.fft.irfft(-w**2 * (model.rows(NAMES) @ u), n=total).T[:n]
    force = np.fft.irfft(drive, n=total)[:n, None]
    if period:
        response, force = np.tile(response, (3, 1)), np.tile(force, (3, 1))
    response = response + noise * rng.standard_normal(response.shape)
    return Recording("forced", 1 / FS, response, channels(), force, (Channel("f", "F", "force", "N"),), period=n if period else None)


@pytest.mark.parametrize("period", [True, False])
def test_forced_response_gives_modes_and_the_sign_of_shapes(period: bool) -> None:
    model = truth([40.0, 97.0, 181.0], [0.01, 0.006, 0.004])
    misses = []
    for seed in range(4):
        found = identify_modes(forced(model, seed, 0.05, period), model)
        assert found.modes == 3 and found.signed
        misses += list((found.frequency - model.frequency) / found.frequency_sd) + list((found.zeta - model.zeta) / found.zeta_sd)
        for k in range(3):
            true = model.rows(NAMES)[:, k] / np.abs(model.rows(NAMES)[:, k]).max()
            np.testing.assert_allclose(found.shapes[:, k], true, atol=0.05)
    np.testing.assert_allclose(found.frequency, model.frequency, rtol=2e-3)
    assert 0.55 < np.sqrt(np.mean(np.square(misses))) < 1.7


def test_bad_settings_are_refused() -> None:
    model = truth([40.0], [0.01])
    recording = decay(model, [1e-3], 4.0, 1e-3, 1)
    with pytest.raises(ValueError, match="distinct indices"):
        identify_modes(recording, model, modes=[3])
    with pytest.raises(ValueError, match="window"):
        identify_modes(recording, model, window=(1.0, 9.0))
    with pytest.raises(ValueError, match="span"):
        identify_modes(recording, model, span=0.5)


def test_a_dead_channel_does_no_harm() -> None:
    model = truth([40.0, 97.0], [0.004, 0.003])
    recording = decay(model, [1e-3, 1e-4], 6.0, 1e-2, 4)
    response = recording.response.copy()
    response[:, 2] = 0.0
    found = identify_modes(Recording("decay", recording.dt, response, recording.channels, recording.force), model)
    np.testing.assert_allclose(found.frequency, model.frequency, rtol=1e-3)
    assert (found.shapes[2] == 0).all()


def test_pure_noise_and_very_short_recordings_hold_no_modes() -> None:
    model = truth([40.0, 97.0], [0.004, 0.003])
    rng = np.random.default_rng(7)
    for n in (60, 6000):
        noise = Recording("noise", 1 / FS, rng.standard_normal((n, 3)), channels(), np.zeros((n, 0)))
        found = identify_modes(noise, model)
        assert found.modes == 0 and found.shapes.shape == (3, 0) and len(found.notes) >= 2


def test_strongly_damped_modes_and_forced_noise() -> None:
    model = truth([40.0, 97.0], [0.04, 0.03])
    found = identify_modes(forced(model, 3, 0.05, True), model)
    np.testing.assert_allclose(found.frequency, model.frequency, rtol=0.01)
    np.testing.assert_allclose(found.zeta, model.zeta, rtol=0.1)
    recording = forced(model, 3, 0.05, True)
    rng = np.random.default_rng(1)
    claimed = 0
    for _ in range(3):
        deaf = Recording("deaf", recording.dt, rng.standard_normal(recording.response.shape), recording.channels, recording.force,
                         recording.inputs, period=recording.period)
        claimed += identify_modes(deaf, model).modes
    assert claimed <= 1


def test_damping_that_depends_on_amplitude_is_not_called_certain() -> None:
    """Quadratic damping lets the ratio fall all along: 0.4 % plus 3 % per mm. The truth at rest lies within what is said."""
    model = truth([40.0], [0.004])
    a, phase, trace = 2e-3, 0.0, []
    for _ in range(round(3 * FS)):
        trace.append(a * np.cos(phase))
        phase += 2 * np.pi * 40 / FS
        a *= np.exp(-(0.004 + 30 * a) * 2 * np.pi * 40 / FS)
    response = np.outer(trace, SHAPES[:, 0]) + 1e-6 * np.random.default_rng(1).standard_normal((len(trace), 3))
    found = identify_modes(Recording("decay", 1 / FS, response, channels("displacement"), np.zeros((len(trace), 0))), model)
    assert found.zeta[0] > 0.005 and abs(found.zeta[0] - 0.004) < 3 * found.zeta_sd[0]
    assert any("depend on amplitude" in note for note in found.notes)
    assert found.frequency_sd[0] < 1e-2
