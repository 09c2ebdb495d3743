"""Averaged backbones against closed forms and against time integration."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ellipk

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.model import Element
from bayes_nlsid.prediction.bands import backbone_bands
from bayes_nlsid.prediction.fast import fast_bands
from bayes_nlsid.structure.modal import ModalModel
from tests.simulation.problems import IWAN, Model, beam, oscillator, scattered

GRID = np.geomspace(1.3e-3, 2e-3, 4)


def test_duffing_frequency_is_the_elliptic_integral() -> None:
    a, c = np.geomspace(0.01, 0.1, 9), 2e5
    found = fast_bands([[c]], oscillator("cubic", zeta=1e-5), at="x", start_amplitude=0.1, amplitudes=a)
    w2 = (2 * np.pi * 10) ** 2 + c * a**2
    assert found.frequency[1] == pytest.approx(np.sqrt(w2) / (4 * ellipk(c * a**2 / (2 * w2))), rel=1e-4)


def test_linear_mode_is_itself() -> None:
    found = fast_bands(np.zeros((2, 0)), beam(), at="tip", start_amplitude=1e-3, mode=1)
    assert found.frequency == pytest.approx(np.full((3, 40), 57 * np.sqrt(1 - 0.006**2)), rel=1e-6)
    assert found.damping == pytest.approx(np.full((3, 40), 0.006), rel=1e-6)


def test_quadratic_drag_has_its_textbook_damping() -> None:
    # v|v| on a unit mass: equivalent damping ratio 4 c a / (3 pi)
    a, c, z = np.geomspace(0.01, 0.05, 5), 0.2, 0.001
    found = fast_bands([[c]], oscillator("v|v|", zeta=z), at="x", start_amplitude=0.06, amplitudes=a)
    assert found.damping[1] == pytest.approx(z + 4 * c * a / (3 * np.pi), rel=1e-3)


@pytest.mark.parametrize(("term", "centre"), [("iwan4", IWAN), ("iwan4_memory", IWAN), ("cubic", np.array([1e11, 1e11])),
                                              ("v|v|", np.array([2e3, 1e3]))])
def test_it_gives_what_time_integration_gives(term: str, centre: NDArray[np.float64]) -> None:
    theta = scattered(centre, 1)
    common = {"at": "tip", "start_amplitude": 2.4e-3, "amplitudes": GRID}
    quick = fast_bands(theta, beam(term), **common)  # type: ignore[arg-type]
    slow = backbone_bands(theta, beam(term), scheme="exponential", fs=600.0, duration=1.7, stop_amplitude=9e-4, **common)  # type: ignore[arg-type]
    assert np.isfinite(slow.samples_frequency).all()
    assert np.abs(quick.samples_frequency - slow.samples_frequency).max() < 3e-3
    assert np.abs(quick.samples_damping / slow.samples_damping - 1).max() < 0.01


def test_open_loops_of_a_fast_decay_are_counted() -> None:
    # one joint alone on a mass, damping up to 1.5 %: averaging with closed loops would be 3 to 6 % short
    linear = ModalModel(2 * np.pi * np.array([20.0]), np.array([1e-4]), ("x",), np.array([[1.0]]), ("x",), (), ("x",))
    model = Model(linear, (Element(LIBRARY["iwan4_memory"], ("x",)),))
    theta, grid = np.array([[60.0, 8e3, -0.4, 0.5]]), np.geomspace(1.2e-3, 3e-3, 6)
    quick = fast_bands(theta, model, at="x", start_amplitude=4e-3, amplitudes=grid)
    slow = backbone_bands(theta, model, at="x", start_amplitude=6e-3, amplitudes=grid, scheme="exponential", fs=4000.0, duration=3.0)
    assert (slow.samples_damping > 0.008).all()
    assert np.abs(quick.samples_damping / slow.samples_damping - 1).max() < 0.01
    assert np.abs(quick.samples_frequency / slow.samples_frequency - 1).max() < 3e-4


def test_interacting_modes_are_refused() -> None:
    # second mode at three times the first: the third harmonic of the cubic force drives it
    linear = ModalModel(2 * np.pi * np.array([10.0, 30.3]), np.array([0.001, 0.001]), ("x",), np.array([[1.0, 1.0]]), ("x",), (), ("x",))
    model = Model(linear, oscillator("cubic").elements)
    found = fast_bands([[2e5], [1.0]], model, at="x", start_amplitude=0.1)
    assert found.status == {"modes interact": 1, "ok": 1}
    assert np.isnan(found.samples_frequency[0]).all() and np.isfinite(found.samples_frequency[1]).all()


def test_what_it_cannot_do_is_said() -> None:
    for term in ("bouc_wen", "iwan5_memory", "square"):
        model = oscillator(term)
        with pytest.raises(ValueError, match="backbone_bands"):
            fast_bands(np.ones((1, model.size)), model, at="x", start_amplitude=0.1)
