"""Eq. 14: the bi-symmetric logarithm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayes_nlsid import symlog

POSITIVE = np.logspace(-300, 60, 2001)
SIZES = np.concatenate([-POSITIVE[::-1], [0.0], POSITIVE])


@pytest.mark.parametrize("c", [1.0, 1e-6, 1e4])
def test_round_trip_over_360_decades(c: float) -> None:
    # The coordinate is of order 10 to 100, so its rounding alone costs s ln(10) eps of p.
    np.testing.assert_allclose(symlog.inverse(symlog.forward(SIZES, c), c), SIZES, rtol=1e-13, atol=0)


def test_scale_of_each_parameter_broadcasts() -> None:
    c = np.array([1e-9, 1.0, 1e12])
    p = np.array([[3e-9, -2.0, 5e12], [0.0, 1e60, -1e-290]])
    s = symlog.forward(p, c)
    assert s.shape == (2, 3)
    np.testing.assert_allclose(s[0], np.sign(p[0]) * np.log10(1 + np.abs(p[0]) / c), rtol=1e-14)
    np.testing.assert_allclose(symlog.inverse(s, c), p, rtol=1e-13)


@pytest.mark.parametrize("c", [1.0, 1e-8])
def test_monotone_odd_and_continuous_through_zero(c: float) -> None:
    s = symlog.forward(SIZES, c)
    assert (np.diff(s) > 0).all()
    np.testing.assert_array_equal(s, -s[::-1])
    near = c * np.array([-1e-9, 1e-9])
    np.testing.assert_allclose(symlog.forward(near, c), near / c / np.log(10), rtol=1e-8)


def test_printed_values() -> None:
    np.testing.assert_allclose(symlog.forward([9.0, -99.0, 999.0]), [1.0, -2.0, 3.0], rtol=1e-15)
    np.testing.assert_allclose(symlog.inverse([1.0, -2.0, 3.0], 2.0), [18.0, -198.0, 1998.0], rtol=1e-14)


@given(st.floats(-60, 60), st.floats(-12, 12))
def test_log_jacobian_is_the_derivative(s: float, decade: float) -> None:
    c = 10.0**decade
    side = 1.0 if s >= 0 else -1.0  # a one-sided difference: the second derivative jumps at zero
    h = 1e-5 * side
    slope = (-symlog.inverse(s + 2 * h, c) + 4 * symlog.inverse(s + h, c) - 3 * symlog.inverse(s, c)) / (2 * h)
    assert np.log(abs(slope)) == pytest.approx(float(symlog.log_jacobian(s, c)), abs=1e-5)


def test_density_keeps_its_mass_under_the_change_of_variable() -> None:
    s = np.linspace(-8, 8, 40_001)
    p = symlog.inverse(s, 0.01)
    density = np.exp(-0.5 * p**2) / np.sqrt(2 * np.pi) * np.exp(symlog.log_jacobian(s, 0.01))
    assert np.trapezoid(density, s) == pytest.approx(1.0, abs=1e-7)


def test_extremes_do_not_overflow_on_the_way() -> None:
    assert symlog.forward(1e300, 1e-300) == pytest.approx(600.0)
    assert symlog.inverse(600.0, 1e-300) == pytest.approx(1e300, rel=1e-12)
    assert np.isinf(symlog.inverse(400.0))


@pytest.mark.parametrize("c", [0.0, -1.0, np.nan, np.inf])
def test_scale_must_be_positive(c: float) -> None:
    with pytest.raises(ValueError, match="c must be positive"):
        symlog.forward(1.0, c)
