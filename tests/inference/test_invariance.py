"""The posterior depends neither on the constant of Eq. 14 nor on the units: metres and kilograms, or millimetres and tonnes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from studies.calibration import truth
from studies.calibration.cases import CASES

from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.forward import forward_likelihood
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.inference.prior import Prior, default_priors
from bayes_nlsid.inference.reweighting import around_fit, around_optimum
from bayes_nlsid.model import Model
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.chains import oscillator
from bayes_nlsid.structure.sensing import modal_data

CASE = CASES["static"]
QUIET = replace(truth.SCENARIOS["white"], noise=(0.01,))
SHARES = [0.05, 0.25, 0.5, 0.75, 0.95]


@pytest.fixture(scope="module")
def recording() -> Recording:
    theta = np.array([[truth.F0 + 0.05, 0.0041, -2.2e6, 4.3]])
    return CASE.recording(QUIET, truth.measure(QUIET, theta, np.random.default_rng(11))[0])


def identified(recording: Recording, c: float = 1.0, mass: float = 1.0) -> tuple[Fit, tuple[Prior, ...]]:
    linear = oscillator(mass=mass, frequency=truth.F0, zeta=truth.ZETA, location="M")
    data = modal_data(recording, linear, [0], ["M"], truth.BAND)
    problem = Problem(Model(linear, CASE.elements, (0,)), (data,), scenario("S1", 1), None, 1.0, (1.0, 4.0), c)
    return fit(problem, starts=1, seed=0), default_priors(problem)


def both(recording: Recording, c: float = 1.0, mass: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles (5, P) of the regression's posterior and of the simulation's."""
    found, priors = identified(recording, c, mass)
    simulated = forward_likelihood(found, [recording], priors)
    first, second = around_fit(WhittleLikelihood(found), priors, 2000, 0), around_optimum(simulated, priors, 800, 0)
    assert max(first.shape, second.shape) < 0.7
    return first.quantiles(SHARES), second.quantiles(SHARES)


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Largest distance of quantiles in standard deviations, from the quartiles of the first."""
    return float(np.max(np.abs(one - other) / ((one[3] - one[1]) / 1.349)))


def test_any_constant_gives_the_same_posterior(recording: Recording) -> None:
    middle = both(recording)
    for c in (1e-3, 1e3, 1e7):     # the last as large as the coefficient itself: other coordinates, not only another number
        for one, other in zip(middle, both(recording, c), strict=True):
            assert apart(one, other) < 0.15


def test_millimetres_and_tonnes_give_the_same_posterior(recording: Recording) -> None:
    """The force stays N; 1 kg is a thousandth of a tonne; N/m² becomes N/mm², N s²/m² N s²/mm²."""
    small = replace(recording, response=1e3 * recording.response)
    units = np.array([1.0, 1.0, 1e-6, 1e-6])
    for one, other in zip(both(recording), both(small, 1.0, 1e-3), strict=True):
        assert apart(one * units, other) < 0.15


def test_the_comparison_can_fail(recording: Recording) -> None:
    one = both(recording)[1]
    assert apart(one, one + 0.3 * np.diff(one, axis=0)[1]) > 0.15
