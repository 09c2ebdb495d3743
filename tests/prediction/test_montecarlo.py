"""Very many backbones: the right path for each, chunks that survive, the same numbers whoever computes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.model import Model
from bayes_nlsid.prediction import montecarlo
from bayes_nlsid.prediction.bands import backbone_bands
from bayes_nlsid.prediction.fast import fast_bands
from bayes_nlsid.prediction.montecarlo import Backbones, Decay, backbones, numerical_error
from bayes_nlsid.structure.modal import ModalModel
from tests.simulation.problems import IWAN, beam, oscillator, scattered

CUBIC = oscillator("cubic", zeta=0.01)
DECAY = Decay("x", 0.1, amplitudes=(0.02, 0.05, 0.09), fs=2000.0, scheme="exponential")


def same(one: Backbones, other: Backbones) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name in ("frequency", "damping"))
               for name in ("amplitude", "frequency", "damping", "status", "path"))


def test_it_is_what_each_path_gives() -> None:
    theta = np.linspace(1e4, 4e4, 5)[:, None]
    common = {"at": "x", "start_amplitude": 0.1, "amplitudes": DECAY.amplitudes}
    quick, slow = backbones(CUBIC, theta, DECAY), backbones(CUBIC, theta, DECAY, path="time")
    assert set(quick.path) == {"fast"} and set(slow.path) == {"time"} and set(quick.status) == {"ok"} == set(slow.status)
    assert quick.frequency == pytest.approx(fast_bands(theta, CUBIC, **common).samples_frequency, rel=1e-12)  # type: ignore[arg-type]
    bands = backbone_bands(theta, CUBIC, **common, fs=2000.0, scheme="exponential")  # type: ignore[arg-type]
    assert slow.frequency == pytest.approx(bands.samples_frequency, rel=1e-12)
    assert np.abs(quick.frequency - slow.frequency).max() < 3e-3
    error = numerical_error(CUBIC, theta, quick, DECAY)
    assert np.abs(error.frequency).max() < 3e-3 and np.abs(error.damping).max() < 3e-4
    coarse = Decay("x", 0.1, amplitudes=DECAY.amplitudes, fs=500.0)
    of_hht = numerical_error(CUBIC, theta, backbones(CUBIC, theta, coarse, path="time"), coarse)
    assert of_hht.frequency[0] == pytest.approx(-10 * of_hht.period_error, rel=0.1) and of_hht.fs == 500.0


def test_where_modes_interact_time_integration_takes_over() -> None:
    linear = ModalModel(2 * np.pi * np.array([10.0, 30.3]), np.array([0.01, 0.01]), ("x",), np.array([[1.0, 1.0]]), ("x",), (), ("x",))
    model = Model(linear, CUBIC.elements)
    theta = np.array([[2e5], [1.0]])
    found = backbones(model, theta, DECAY)
    assert found.path.tolist() == ["time", "fast"] and np.isfinite(found.frequency).any(axis=1).all()
    refused = backbones(model, theta, DECAY, path="fast")
    assert refused.status.tolist() == ["modes interact", "ok"] and np.isnan(refused.frequency[0]).all()


def test_memory_that_averaging_does_not_know_goes_the_long_way() -> None:
    model = oscillator("bouc_wen", zeta=0.01)
    theta = np.array([[2e3, 30.0, 0.8, -0.3, 1.0]])
    found = backbones(model, theta, Decay("x", 0.02, amplitudes=(0.005, 0.01), fs=1000.0, duration=3.0))
    assert found.path.tolist() == ["time"]
    with pytest.raises(ValueError, match="averaging"):
        backbones(model, theta, Decay("x", 0.02), path="fast")


def test_a_run_that_is_stopped_goes_on_and_gives_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(montecarlo, "FAST_CHUNK", 4)
    theta = scattered(IWAN, 22)
    model, decay = beam("iwan4"), Decay("tip", 2.4e-3, amplitudes=(1.3e-3, 2e-3))
    whole = backbones(model, theta, decay)
    computed: list[int] = []
    real = montecarlo._chunk

    def counted(shared: object, part: np.ndarray) -> object:
        if len(computed) == 3:
            raise KeyboardInterrupt
        computed.append(len(part))
        return real(shared, part)  # type: ignore[arg-type]

    monkeypatch.setattr(montecarlo, "_chunk", counted)
    with pytest.raises(KeyboardInterrupt):
        backbones(model, theta, decay, folder=tmp_path)
    assert len(list(tmp_path.glob("chunk_*.npz"))) == 3
    (tmp_path / "chunk_000001.npz").write_bytes(b"half of a file")
    computed.clear()
    monkeypatch.setattr(montecarlo, "_chunk", lambda shared, part: computed.append(len(part)) or real(shared, part))
    again = backbones(model, theta, decay, folder=tmp_path)
    assert computed == [4, 4, 4, 2], "the damaged chunk and the missing ones, no other"
    assert same(whole, again)


def test_two_processes_give_the_same_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(montecarlo, "FAST_CHUNK", 8)
    theta = scattered(IWAN, 30)
    decay = Decay("tip", 2.4e-3, amplitudes=(1.3e-3, 2e-3))
    assert same(backbones(beam("iwan4_memory"), theta, decay), backbones(beam("iwan4_memory"), theta, decay, workers=2))


def test_one_sample_that_hardly_decays_does_not_hold_up_the_others() -> None:
    model = oscillator("cubic", zeta=0.01, free=True)
    theta = np.tile([10.0, 0.02, 1e4], (9, 1))
    theta[4, 1] = 1e-9
    found = backbones(model, theta, Decay("x", 0.1, amplitudes=(0.02, 0.06), fs=400.0), path="time")
    assert np.isfinite(np.delete(found.frequency, 4, axis=0)).all() and np.isnan(found.frequency[4, 0])


def test_what_cannot_be_asked_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="mode 1 does not exist"):
        backbones(CUBIC, np.array([[1e4]]), Decay("x", 0.1, mode=1))
    monkeypatch.setattr(montecarlo, "MOST_BYTES", 16)
    with pytest.raises(ValueError, match="backbones at 3 amplitudes are"):
        backbones(CUBIC, np.array([[1e4], [2e4]]), DECAY)


def test_forces_that_outdo_the_linear_spring_are_refused_quietly() -> None:
    found = backbones(CUBIC, np.array([[-1e6], [1e4]]), DECAY, path="fast")
    assert found.status.tolist()[1] == "ok" and found.status[0] != "ok" and np.isnan(found.frequency[0]).all()


def test_an_undamped_mode_needs_no_duration_on_the_fast_path() -> None:
    found = backbones(oscillator("v|v|", zeta=0.0), [[0.2]] @ np.eye(1), Decay("x", 0.05, amplitudes=(0.01, 0.04)))
    assert found.damping[0] == pytest.approx(4 * 0.2 * found.amplitude / (3 * np.pi), rel=1e-2)
