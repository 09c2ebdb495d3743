"""The step of one linear mode: exactness, order, spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from bayes_nlsid.simulation.schemes import spectrum, steps


@settings(max_examples=40, deadline=None)
@given(st.floats(1e-3, 1e5), st.floats(0.0, 3.0), st.floats(1e-5, 1e-1))
def test_exponential_step_is_the_matrix_exponential(omega: float, zeta: float, h: float) -> None:
    if omega * h > 50:
        h = 50 / omega
    s = steps([omega], [zeta], h, "exponential")
    a = np.array([[0, omega], [-omega, -2 * zeta * omega]])
    exact = expm(a * h)
    mine = s.amplification[0] * np.array([[1, omega], [1 / omega, 1]])
    assert np.abs(mine - exact).max() < 1e-11


def test_exponential_step_is_exact_for_a_ramp_of_force() -> None:
    omega, zeta, h = 40.0, 0.03, 0.02
    s = steps([omega], [zeta], h, "exponential")
    c, k = 2 * zeta * omega, omega**2
    # u = t/k − c/k² solves the equation under the force t
    def exact(t: float) -> np.ndarray:
        return np.array([t / k - c / k**2, 1 / k])

    after = s.amplification[0] @ exact(0.3) + s.old[0] * 0.3 + s.new[0] * (0.3 + h)
    assert after == pytest.approx(exact(0.3 + h), rel=1e-12)


def test_hht_with_alpha_zero_is_the_trapezoidal_rule() -> None:
    omega, h = 30.0, 0.01
    s = steps([omega], [0.0], h, "hht", 0.0)
    period, damping = spectrum(s, [omega], [0.0])
    # trapezoidal rule: angle per step 2 atan(omega h / 2), no damping
    assert 1 / (1 + period[0]) == pytest.approx(2 * np.arctan(omega * h / 2) / (omega * h), rel=1e-10)
    assert abs(damping[0]) < 1e-12


def test_spectrum_tells_the_frequency_that_a_simulation_shows() -> None:
    omega, zeta, h = 2 * np.pi * 10, 0.01, 1 / 300
    s = steps([omega], [zeta], h, "hht", -0.2)
    period, damping = spectrum(s, [omega], [zeta])
    x = np.array([1.0, 0.0, -(omega**2)])
    track = []
    for _ in range(3000):
        x = s.amplification[0] @ x
        track.append(x[0])
    up = [i + track[i] / (track[i] - track[i + 1]) for i in range(100, 2999) if track[i] < 0 <= track[i + 1]]
    measured = (up[-1] - up[0]) / (len(up) - 1) * h
    true = 2 * np.pi / (omega * np.sqrt(1 - zeta**2))
    assert measured / true - 1 == pytest.approx(period[0], rel=2e-3)
    peaks = [max(abs(v) for v in track[i:i + 31]) for i in (100, 1300)]
    rate = np.log(peaks[0] / peaks[1]) / (1200 * h)
    assert rate * measured / (2 * np.pi) == pytest.approx(zeta + damping[0], rel=2e-2)


def test_exponential_step_has_no_error_beyond_nyquist() -> None:
    omega, zeta = np.array([100.0, 5000.0]), np.array([0.01, 0.02])
    period, damping = spectrum(steps(omega, zeta, 1e-3, "exponential"), omega, zeta)
    assert np.abs(period).max() < 1e-12 and np.abs(damping).max() < 1e-12


@pytest.mark.parametrize(("argument", "word"), [({"step": 0.0}, "step"), ({"alpha": 0.1}, "alpha"), ({"scheme": "euler"}, "scheme")])
def test_wrong_arguments_are_named(argument: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        steps([1.0], [0.1], **({"step": 0.1} | argument))  # type: ignore[arg-type]
