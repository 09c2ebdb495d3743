"""Bands of response curves: quantiles of what single curves give, whoever computes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.prediction.continuation import response_curves
from bayes_nlsid.prediction.response_bands import response_bands
from tests.prediction.test_stability import INTERACTING
from tests.simulation.problems import oscillator

OPTIONS = {"drive": "x", "at": "x", "levels": [1.0, 6.0], "band": (8.0, 14.0)}
DRAWS = np.array([[1e5], [1.5e5], [2e5], [2.5e5], [3e5]])
MODEL = oscillator("cubic", zeta=0.01)


def test_bands_are_the_quantiles_of_the_curves() -> None:
    found = response_bands(DRAWS, MODEL, **OPTIONS, harmonics=7)  # type: ignore[arg-type]
    curves = response_curves(MODEL, DRAWS, **OPTIONS)  # type: ignore[arg-type]
    peaks = np.array([[c.peak("x") for c in row] for row in curves])
    assert found.peak_frequency == pytest.approx(peaks[..., 0]) and found.peak_amplitude == pytest.approx(peaks[..., 1])
    assert found.status == {"ok": 10} and found.samples_up.shape == (5, 2, len(found.frequency))
    inside = np.isfinite(found.up).all(axis=(0, 1))
    assert inside[1:-1].all()
    assert found.up[1, 1] == pytest.approx(np.quantile(found.samples_up[:, 1], 0.5, axis=0), nan_ok=True)
    assert [c.level for c in found.curves] == [1.0, 6.0]
    # the curve shown is that of the middle draw
    assert found.curves[1].peak("x") == pytest.approx(curves[2][1].peak("x"), rel=1e-8)


def test_harmonics_are_added_until_more_do_not_matter() -> None:
    model = oscillator("clearance", zeta=0.02)
    options = {**OPTIONS, "levels": [4.0], "band": (6.0, 14.0)}
    one = response_bands([[4e3, 0.02]], model, **options, harmonics=1)  # type: ignore[arg-type]
    chosen = response_bands([[4e3, 0.02]], model, **options)  # type: ignore[arg-type]
    assert one.harmonics == 1 and one.harmonic_error[0] > chosen.harmonic_error[0]
    assert chosen.harmonics >= 7 and chosen.harmonic_error[0] < 2e-3


def test_where_stability_is_lost_sweeps_have_no_value_and_it_is_counted() -> None:
    found = response_bands([[2e5], [2.001e5]], INTERACTING, drive="x", at="x", levels=[0.5, 4.0], band=(8.0, 20.0), harmonics=5)
    assert found.status == {"ok": 4} and found.lost == {"a second frequency appears": 2} and found.judged_by == "multipliers"
    gap = np.isnan(found.up[1]) & (found.frequency > 8.0) & (found.frequency < 20.0)
    assert not gap[0].any() and gap[1].any()
    assert found.frequency[gap[1]].min() > 10.1 and found.frequency[gap[1]].max() < 10.35
    assert not found.arrays()["curve1_stable"].all()


def test_a_peak_that_no_sweep_sees_is_no_peak() -> None:
    model = replace(INTERACTING, linear=replace(INTERACTING.linear, zeta=np.array([0.02, -0.001])))
    found = response_bands([[1e3]], model, drive="x", at="x", levels=[0.5], band=(8.0, 13.0), harmonics=3)
    assert found.status == {"the motion at the peak is not stable: a second frequency appears": 1} and np.isnan(found.peak_frequency).all()


def test_a_gain_of_the_force_is_applied() -> None:
    model = replace(MODEL, free_gain=True)
    twice = response_curves(model, [2.0, 1e5], **{**OPTIONS, "levels": [3.0]})[0][0]  # type: ignore[arg-type]
    plain = response_curves(MODEL, [1e5], **{**OPTIONS, "levels": [6.0]})[0][0]  # type: ignore[arg-type]
    assert twice.peak("x") == pytest.approx(plain.peak("x")) and twice.level == 3.0


def test_failed_curves_are_counted_and_left_out() -> None:
    draws = np.concatenate([np.tile([[1e5]], (12, 1)), [[np.nan]]])
    found = response_bands(draws, MODEL, **OPTIONS, harmonics=3)  # type: ignore[arg-type]
    assert found.status == {"no steady response found at the lower end of the band": 2, "ok": 24}
    assert np.isnan(found.peak_frequency[-1]).all() and np.isfinite(found.up[1, :, 5]).all()
