"""Backbone bands against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipk

from bayes_nlsid.prediction.bands import Bands, backbone_bands, quantiles
from tests.simulation.problems import IWAN, beam, oscillator


def test_duffing_bands_follow_the_elliptic_integral() -> None:
    model = oscillator("cubic", zeta=0.008)
    draws = np.array([[2e4], [3e4], [4e4]])
    bands = backbone_bands(draws, model, at="x", start_amplitude=0.1, amplitudes=np.array([0.03, 0.05, 0.08]), scheme="exponential",
                           fs=2000)
    w2 = (2 * np.pi * 10) ** 2 + draws * bands.amplitude**2
    exact = np.sqrt(w2) / (4 * ellipk(draws * bands.amplitude**2 / (2 * w2)))
    assert np.abs(bands.samples_frequency - exact).max() < 2e-3
    assert bands.frequency[1] == pytest.approx(exact[1], abs=2e-3)
    assert bands.frequency == pytest.approx(np.quantile(bands.samples_frequency, (0.05, 0.5, 0.95), axis=0))
    assert bands.status == {"ok": 3}


def test_linear_decay_has_constant_frequency_and_damping_with_the_known_error_of_the_step() -> None:
    model = oscillator(zeta=0.01)
    kwargs = {"at": "x", "start_amplitude": 1e-3, "amplitudes": np.geomspace(2e-4, 8e-4, 5), "fs": 500.0}
    hht = backbone_bands(np.zeros((1, 0)), model, scheme="hht", **kwargs)  # type: ignore[arg-type]
    exact = backbone_bands(np.zeros((1, 0)), model, scheme="exponential", **kwargs)  # type: ignore[arg-type]
    true = 10 * np.sqrt(1 - 0.01**2)
    assert np.abs(exact.frequency[1] - true).max() < 1e-5 and np.abs(exact.damping[1] - 0.01).max() < 1e-6
    # the error printed is the one that the eigenvalues of the step tell
    shift = true / (1 + hht.period_error[0]) - true
    assert hht.numerical_error_frequency == pytest.approx(shift, rel=1e-2)
    assert hht.frequency[1] - true == pytest.approx(shift, rel=1e-2)
    assert hht.numerical_error_damping == pytest.approx(hht.false_damping[0], rel=5e-2)


def test_numerical_error_of_hht_falls_with_the_square_of_the_step() -> None:
    kwargs = {"at": "tip", "start_amplitude": 2e-3, "amplitudes": np.array([1e-3, 1.5e-3]), "duration": 1.5, "stop_amplitude": 5e-4}
    coarse, fine = (backbone_bands(IWAN[None], beam("iwan4"), fs=fs, **kwargs) for fs in (1000.0, 2000.0))  # type: ignore[arg-type]
    assert coarse.numerical_error_frequency / fine.numerical_error_frequency == pytest.approx(4.0, rel=0.1)


def test_files_come_back_as_they_were(tmp_path: Path) -> None:
    model = oscillator("cubic", zeta=0.02)
    bands = backbone_bands(np.array([[2e4], [-1e9]]), model, at="x", start_amplitude=0.1, fs=1000)
    assert bands.status["ok"] == 1 and sum(bands.status.values()) == 2
    path = bands.save(tmp_path / "backbone.npz")
    again = Bands.load(path)
    for name in ("amplitude", "frequency", "damping", "samples_frequency", "samples_damping", "numerical_error_frequency", "period_error"):
        assert np.array_equal(getattr(again, name), getattr(bands, name), equal_nan=True)
    assert (again.status, again.location, again.mode, again.scheme, again.fs) == (bands.status, "x", 0, "hht", 1000.0)
    with np.load(path) as data:
        assert {"amplitude", "frequency_q05", "frequency_q50", "frequency_q95", "damping_q05", "damping_q50", "damping_q95",
                "samples_frequency", "samples_damping", "numerical_error_frequency"} <= set(data.files)


def test_quantiles_need_nine_samples_in_ten() -> None:
    curves = np.ones((20, 2))
    curves[:3, 0], curves[:2, 1] = np.nan, np.nan
    found = quantiles(curves, np.ones(20, dtype=bool))
    assert np.isnan(found[:, 0]).all() and (found[:, 1] == 1).all()
    assert np.isnan(quantiles(curves, np.zeros(20, dtype=bool))).all()


@pytest.mark.parametrize(("change", "word"), [({"mode": 3}, "mode"), ({"start_amplitude": -1.0}, "start_amplitude"),
                                              ({"stop_amplitude": 1.0}, "stop_amplitude"), ({"amplitudes": [0.02, 0.01]}, "ascending")])
def test_wrong_arguments_are_named(change: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        backbone_bands(np.zeros((1, 1)), oscillator("cubic"), **({"at": "x", "start_amplitude": 0.1} | change))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="duration"):
        backbone_bands(np.zeros((1, 1)), oscillator("cubic", zeta=0.0), at="x", start_amplitude=0.1)
