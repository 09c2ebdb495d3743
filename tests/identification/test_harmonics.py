"""Motion that a band takes from the laws: against a solution by hand, and what it does to a coefficient."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.harmonics import lost_motion
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.model import Element, Model
from bayes_nlsid.structure.modal import ModalData, ModalModel

FREQUENCY, CUBIC, AMPLITUDE, FS, PERIODS = 20.0, 4e8, 2e-3, 1000.0, 40
OMEGA = 2 * np.pi * FREQUENCY
THIRD = CUBIC * AMPLITUDE**3 / 4 / (8 * OMEGA**2)  # amplitude at 3f, to first order in the cubic force


def problem(top: float, harmonic: bool) -> Problem:
    """Steady motion at f, with the third harmonic or without it, and the force that makes it under ẍ + ω²x + c x³ = F."""
    t = np.arange(round(PERIODS * FS / FREQUENCY)) / FS
    one, three = np.cos(OMEGA * t), np.cos(3 * OMEGA * t)
    third = THIRD * harmonic
    u = AMPLITUDE * one + THIRD * three
    whole = -OMEGA**2 * (AMPLITUDE * one + 9 * THIRD * three) + OMEGA**2 * u + CUBIC * u**3
    seen = AMPLITUDE * one + third * three
    v = -OMEGA * (AMPLITUDE * np.sin(OMEGA * t) + 3 * third * np.sin(3 * OMEGA * t))
    a = -OMEGA**2 * (AMPLITUDE * one + 9 * third * three)
    fields = [x[:, None] for x in (seen, v, a, whole)]
    data = ModalData("steady", 1 / FS, (0,), *fields, ("x",), seen[:, None], v[:, None], slice(None), (5.0, top), np.zeros(1),
                     periodic=True)
    linear = ModalModel(np.array([OMEGA]), np.array([0.0]), ("x",), np.ones((1, 1)))
    model = Model(linear, (Element(LIBRARY["cubic"], ("x",)),), ())
    return Problem(model, (data,), scenario("S2", [0], 0))


def test_it_is_the_third_harmonic_of_a_cubic_spring() -> None:
    cut = problem(45.0, harmonic=False)
    assert lost_motion(cut, [CUBIC]) == pytest.approx(THIRD / AMPLITUDE, rel=1e-3)
    assert lost_motion(cut, [2 * CUBIC]) == pytest.approx(2 * THIRD / AMPLITUDE, rel=1e-3)
    assert lost_motion(problem(90.0, harmonic=True), [CUBIC]) < 0.02 * THIRD / AMPLITUDE  # fifth and up
    assert lost_motion(cut.with_elements([]), []) == 0.0


def test_what_is_lost_biases_the_coefficient_by_as_much_as_is_told() -> None:
    """The fundamental of (a cos θ + ε a cos 3θ)³ is 3/4 a³ (1 + ε): without the harmonic the coefficient comes out larger by ε."""
    cut, whole = (fit(problem(top, seen), starts=2, seed=1).theta[0] for top, seen in ((45.0, False), (90.0, True)))
    assert whole == pytest.approx(CUBIC, rel=1e-6)
    assert cut / CUBIC - 1 == pytest.approx(THIRD / AMPLITUDE, rel=0.05)
