"""Force laws as tables: exact where they must be, of fourth order where laws are smooth, absent where they cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.forces.expression import user_term
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.identification.table import build, kind_of, kink_of
from bayes_nlsid.model import Element, Model
from bayes_nlsid.structure.modal import ModalData, ModalModel

OMEGA, N, DT = 2 * np.pi * 20.0, 2048, 1 / 512


def problem(term: str, places: int, excess: bool = True) -> Problem:
    """A decaying motion of 1 mm seen by one joint, with a force that nothing explains."""
    t = DT * np.arange(N)
    u = 1e-3 * np.exp(-0.6 * t) * np.cos(OMEGA * t + 0.4)
    v = np.gradient(u, DT)
    a = np.gradient(v, DT)
    one = np.ones((1, 1))
    data = ModalData("decay", DT, (0,), u[:, None], v[:, None], a[:, None], np.zeros((N, 1)), ("J",), u[:, None], v[:, None],
                     slice(8, N - 8), (5.0, 150.0), np.full(1, 1e-6))
    linear = ModalModel(np.array([OMEGA]), np.array([0.005]), ("J",), one, joints=("J",))
    library = {**LIBRARY, "mine": user_term("mine", "a*q*abs(q)/(b + abs(q))", {"a": ("N/m", "stiffness"), "b": ("m", "displacement")})}
    return Problem(Model(linear, (Element(library[term], ("J",), excess=excess),), (0,)), (data,), scenario("S1", (0,)), places=places)


def draws(one: Problem, count: int = 30) -> np.ndarray:
    low, high = one.to_s(one.bounds.T)
    return one.to_theta(low + (high - low) * np.random.default_rng(3).uniform(0.2, 0.8, (count, one.model.size)))


@pytest.mark.parametrize("term", ["iwan4", "iwan4_memory", "jenkins", "jenkins_memory", "jenkins_prager", "clearance", "mine"])
@pytest.mark.parametrize("excess", [True, False])
def test_table_equals_walking_through_the_samples(term: str, excess: bool) -> None:
    exact, table = problem(term, 0, excess), problem(term, 192, excess)
    theta = draws(exact)
    expected, found = exact.nonlinear_force(theta), table.nonlinear_force(theta)
    full = problem(term, 0, False).nonlinear_force(theta)   # the force itself, spring included, sets the scale
    error = np.sqrt(np.mean((found - expected) ** 2, axis=1) / np.mean(full**2, axis=1).clip(1e-300))
    assert np.median(error) < 1e-3
    assert np.max(error) < 2e-2


def test_smooth_laws_are_met_to_fourth_order() -> None:
    exact = problem("mine", 0)
    theta = exact.model.start([1e4, 4e-4])
    expected = exact.nonlinear_force(theta)
    counts = np.array([12, 24, 48, 96])
    errors = [np.sqrt(np.mean((problem("mine", int(m)).nonlinear_force(theta) - expected) ** 2)) for m in counts]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert 3.5 < order < 5.5


@pytest.mark.parametrize("term", ["iwan5", "iwan5_memory", "bouc_wen", "cubic", "coulomb"])
def test_no_table_for_jumps_other_memory_or_linear_terms(term: str) -> None:
    assert kind_of(LIBRARY[term], 1.0) is None


def test_without_a_table_the_same_numbers_come_from_either_setting() -> None:
    theta = draws(problem("iwan5", 0))
    np.testing.assert_array_equal(problem("iwan5", 64).nonlinear_force(theta), problem("iwan5", 0).nonlinear_force(theta))


def test_fit_with_a_table_ends_where_the_exact_one_does_and_says_what_it_is_worth() -> None:
    exact, table = problem("iwan4_memory", 0), problem("iwan4_memory", 192)
    one, other = fit(exact, starts=6, seed=2), fit(table, starts=6, seed=2)
    assert exact.mse(other.theta, one.weights) == pytest.approx(one.mse, rel=1e-3)
    coarse = fit(replace(problem("iwan4_memory", 8)), starts=6, seed=2)
    assert any("interpolating" in reason for reason in coarse.reasons)


def test_too_few_places_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 8"):
        build(lambda term, p: np.zeros((len(p), 4)), "none", "odd", 1.0, 5)


KINKS = [("iwan4", [2.0, 1e4, -0.5, 0.1], 2.0 * 1.1 / (1e4 * (0.1 + 1 / 3))), ("jenkins", [3.0, 1e4], 3e-4),
         ("clearance", [1e4, 1.1e-3], 5.5e-4), ("iwan4", [50.0, 1e4, -0.5, 0.1], 0.0), ("mine", [1e4, 4e-4], 0.0)]


@pytest.mark.parametrize(("term", "p", "kink"), KINKS)
def test_kinks_are_found_where_they_are_and_nowhere_else(term: str, p: list[float], kink: float) -> None:
    law = problem(term, 0).model.elements[0].term
    assert kink_of(law, np.array(p), 1e-3) == pytest.approx(kink, rel=2e-3)


@pytest.mark.parametrize("term", ["iwan4", "iwan4_memory", "jenkins"])
def test_places_close_around_a_kink_meet_laws_near_it_better(term: str) -> None:
    exact, plain = problem(term, 0), problem(term, 128)
    centre = {"jenkins": [3.0, 1e4]}.get(term, [2.0, 1e4, -0.5, 0.1])
    theta = exact.model.start(centre)
    near = np.repeat(theta[None], 12, axis=0)
    near[:, 2:4] *= 1 + 0.005 * np.random.default_rng(0).normal(size=(12, 2))
    sharp = plain.with_kinks(theta)
    assert sharp.kinks and sharp is not plain and not plain.kinks
    expected = exact.nonlinear_force(near)
    before, after = (np.sqrt(np.mean((one.nonlinear_force(near) - expected) ** 2)) for one in (plain, sharp))
    assert after < 0.3 * before
    smooth = problem("mine", 128)
    assert smooth.with_kinks(smooth.model.start([1e4, 4e-4])) is smooth
