"""Shares of the variance against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.inference.prior import Prior
from bayes_nlsid.prediction.sampling_plan import Plan, posterior_plan, scattered_plan
from bayes_nlsid.prediction.sensitivity import convergence, dependent_shares, last_move, sobol

Array = NDArray[np.float64]
A, B = 7.0, 0.1


def ishigami(x: Array) -> Array:
    """Ishigami's function, and beside it a sum (N, 2)."""
    one = np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])
    return np.stack([one, 3 * x[:, 0] + x[:, 1]], axis=1)


def plan(power: int = 11, seed: int = 1) -> Plan:
    spreads = [(j, Prior(f"x{j}", "", "uniform", -np.pi, np.pi)) for j in range(3)]
    return scattered_plan(np.zeros(3), spreads, 2**power, seed)


def test_ishigami() -> None:
    rows = plan(12)
    _, a, b, mixed, _, _ = rows.split(ishigami(rows.theta))
    found = sobol(a, b, mixed, seed=2)
    v1 = 0.5 * (1 + B * np.pi**4 / 5) ** 2
    v2, v13 = A**2 / 8, B**2 * np.pi**8 * (1 / 18 - 1 / 50)
    whole = v1 + v2 + v13
    assert found.samples == 2048
    assert found.first[0, :, 0] == pytest.approx([v1 / whole, v2 / whole, 0.0], abs=0.02)
    assert found.total[0, :, 0] == pytest.approx([(v1 + v13) / whole, v2 / whole, v13 / whole], abs=0.02)
    assert found.first[0, :, 1] == pytest.approx([0.9, 0.1, 0.0], abs=0.01) and found.total[0, 2, 1] == pytest.approx(0, abs=1e-12)
    for index in (found.first, found.total):
        assert (index[1] <= index[0] + 1e-12).all() and (index[0] <= index[2] + 1e-12).all()
        assert (index[2, :2] - index[1, :2]).max() < 0.2


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside = []
    for seed in range(40):
        rows = plan(8, seed)
        _, a, b, mixed, _, _ = rows.split(ishigami(rows.theta))
        found = sobol(a, b, mixed, seed)
        inside.append((found.first[1, :2, 1] <= [0.9, 0.1]) & (found.first[2, :2, 1] >= [0.9, 0.1]))
    # quasi-random points are better than the bootstrap knows
    assert np.mean(inside) > 0.85


def test_samples_without_a_value_are_left_out_and_few_are_refused() -> None:
    rows = plan(10)
    values = ishigami(rows.theta)
    values[5:40, 0] = np.nan
    _, a, b, mixed, _, _ = rows.split(values)
    found = sobol(a, b, mixed, seed=2)
    assert found.samples == 256 and found.first[0, :, 1] == pytest.approx([0.9, 0.1, 0.0], abs=0.05)
    a[:, 0] = np.nan
    found = sobol(a, b, mixed, seed=2)
    assert np.isnan(found.first[:, :, 0]).all() and np.isfinite(found.first[:, :, 1]).all() and np.isnan(found.explained[0])


def test_what_does_not_vary_has_no_shares() -> None:
    rows = plan(6)
    _, a, b, mixed, _, _ = rows.split(np.ones((len(rows.theta), 1)))
    found = sobol(a, b, mixed, seed=0)
    assert (found.first == 0).all() and (found.total == 0).all()


def test_dependent_parameters_of_a_linear_output() -> None:
    """Var = a² + b² + 2abρ; first (a + bρ)²/Var; total a²(1 − ρ²)/Var."""
    rng, rho = np.random.default_rng(3), 0.8
    x = rng.standard_normal((4000, 2)) @ np.linalg.cholesky([[1, rho], [rho, 1]]).T
    y = np.stack([2 * x[:, 0] + x[:, 1], x[:, 1] + 0.5 * rng.standard_normal(4000)], axis=1)
    found = dependent_shares(x * [1e6, 1e-3] + [3.0, 0.1], y, seed=1)
    variance = 4 + 1 + 4 * rho
    assert found.first[0, :, 0] == pytest.approx([(2 + rho) ** 2 / variance, (1 + 2 * rho) ** 2 / variance], abs=0.02)
    assert found.total[0, :, 0] == pytest.approx([4 * (1 - rho**2) / variance, (1 - rho**2) / variance], abs=0.01)
    assert found.explained == pytest.approx([1.0, 0.8], abs=0.02)
    assert (found.first[1] <= found.first[0] + 0.01).all() and (found.first[2] >= found.first[0] - 0.01).all()
    assert np.isnan(dependent_shares(x[:20], y[:20], seed=1).first).all(), "too few draws for a regression"


def test_plans() -> None:
    spreads = [(2, Prior("a", "", "normal", -80.0, 80.0, 1.0, 2.0)), (0, Prior("b", "", "loguniform", 1e-3, 1e3))]
    rows = scattered_plan([5.0, 6.0, 7.0], spreads, 500, seed=3)
    assert rows.base == 256 and rows.samples == 512 and rows.theta.shape == (512 + 2 * 256 + 5, 3) and (rows.theta[:, 1] == 6.0).all()
    band, a, b, mixed, middle, ends = rows.split(rows.theta)
    assert band[:, 2].mean() == pytest.approx(1.0, abs=0.02) and band[:, 2].std() == pytest.approx(2.0, abs=0.05)
    assert np.log10(band[:, 0]).mean() == pytest.approx(0.0, abs=0.02)
    # first block: the first of the spreads, column 2, is taken from B
    assert np.array_equal(mixed[0][:, 2], b[:, 2]) and np.array_equal(mixed[0][:, 0], a[:, 0])
    assert middle == pytest.approx([1.0, 6.0, 1.0]) and ends[0, :, 2] == pytest.approx([1 - 2 * 1.6449, 1 + 2 * 1.6449], rel=1e-4)
    assert np.array_equal(scattered_plan([5.0, 6.0, 7.0], spreads, 500, seed=3).theta, rows.theta)
    short = scattered_plan([5.0, 6.0, 7.0], spreads, 500, seed=3, indices=False)
    assert short.samples == 500 and short.base == 0
    draws = np.random.default_rng(0).standard_normal((30, 3)) * [1, 0, 1]
    assert posterior_plan(draws).varied == (0, 2) and posterior_plan(draws).theta.shape == (35, 3)
    with pytest.raises(ValueError, match="all the same"):
        posterior_plan(np.ones((4, 2)))
    with pytest.raises(ValueError, match="distinct"):
        scattered_plan([1.0], [], 100, 0)


def test_the_band_settles() -> None:
    curves = np.random.default_rng(4).standard_normal((1024, 3))
    counts, bands = convergence(curves)
    assert counts.tolist() == [16, 32, 64, 128, 256, 512, 1024] and bands.shape == (7, 3, 3)
    assert bands[-1] == pytest.approx(np.quantile(curves, (0.05, 0.5, 0.95), axis=0))
    assert (last_move(bands) < 0.1).all() and np.isnan(last_move(bands[:1])).all()
