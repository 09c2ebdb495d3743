"""Condensing changes the number of entries and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification import condensed
from bayes_nlsid.identification.condensed import condense, regression
from bayes_nlsid.identification.elimination import jacobian
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.model import Element, Model
from tests.identification.truth import beam, prescribed

JOINTS = ("J1", "J2")
RNG = np.random.default_rng(1)


def problem(*terms: str, free: tuple[int, ...] = (0, 1, 2), tied: bool = False, places: int = 24, gain: bool = False) -> Problem:
    data = [prescribed(beam(), lambda q, v: 1e3 * np.tanh(500 * q), seconds=2.0, seed=i, name=f"run {i}") for i in (0, 1)]
    elements = tuple(Element(LIBRARY[t], JOINTS, tied=tied) for t in terms)
    return Problem(Model(beam(), elements, free, gain), tuple(data), scenario("S3", 3, 0), places=places)


def draws(one: Problem, count: int = 4) -> np.ndarray:
    low, high = one.to_s(one.bounds.T)
    return one.to_theta(low + (high - low) * np.random.default_rng(3).uniform(0.3, 0.7, (count, one.model.size)))


@pytest.mark.parametrize("weights", ["equal", "unequal", "product"])
@pytest.mark.parametrize(("terms", "options"), [(("iwan4", "q|q|"), {}), (("iwan4_memory", "v|v|"), {"tied": True}),
                                                (("jenkins_prager",), {"free": (1,)}), (("clearance", "cubic"), {"gain": True})])
def test_sum_of_squares_and_slopes_stay(terms: tuple[str, ...], options: dict[str, object], weights: str,
                                        monkeypatch: pytest.MonkeyPatch) -> None:
    one = problem(*terms, **options)  # type: ignore[arg-type]
    w = one.weight if weights == "equal" else one.weight * RNG.uniform(0.5, 2, one.size)
    if weights == "product":
        monkeypatch.setattr(condensed, "LARGE", 0.0)
    short = regression(one, w)
    assert short.root is None and short.size < 0.5 * one.size
    theta = draws(one)
    expected = np.sqrt(w) * one.residual(theta)
    found = short.residual(theta)
    assert np.sum(found**2, axis=1) == pytest.approx(np.sum(expected**2, axis=1), rel=1e-9)
    assert found @ found.T == pytest.approx(expected @ expected.T, rel=1e-8, abs=1e-9 * np.abs(expected @ expected.T).max())
    slope = np.sqrt(w)[:, None] * jacobian(one, theta[0])
    products, ours = slope.T @ slope, short.slope(theta[0])
    assert ours.T @ ours == pytest.approx(products, rel=1e-5, abs=1e-7 * np.abs(products).max())


def test_a_part_of_what_was_condensed_serves_a_smaller_problem() -> None:
    whole = problem("iwan4", "q|q|", "jenkins")
    shared = condense(whole, whole.weight)
    assert shared is not None
    for terms in (("iwan4",), ("q|q|", "jenkins"), ()):
        part = whole.with_elements([e for e in whole.model.elements if e.term.name in terms])
        short = shared.of(part)
        assert short is not None
        theta = draws(part)
        assert np.sum(short.residual(theta)**2, axis=1) == pytest.approx(np.sum(part.weight * part.residual(theta)**2, axis=1), rel=1e-9)
    assert shared.of(whole.with_elements([Element(LIBRARY["cubic"], JOINTS)])) is None
    assert shared.of(problem("iwan4")) is None
    other = whole.with_elements([Element(LIBRARY["iwan4"], JOINTS)])
    assert regression(other, 2 * whole.weight, shared).residual(draws(other)) == pytest.approx(
        regression(other, 2 * whole.weight).residual(draws(other)))


@pytest.mark.parametrize("core", [("iwan4",), (), ("jenkins", "q|q|"), ("q|q|", "iwan4", "jenkins")])
def test_what_problems_have_in_common_is_factored_once(core: tuple[str, ...]) -> None:
    whole = problem("iwan4", "q|q|", "jenkins")
    shared = condense(whole, whole.weight)
    assert shared is not None
    quick = shared.around(whole.with_elements([e for e in whole.model.elements if e.term.name in core]))
    assert quick.core is not None
    for terms in (("iwan4", "jenkins"), ("q|q|", "jenkins", "iwan4"), ("jenkins",), ()):
        part = whole.with_elements([Element(LIBRARY[name], JOINTS) for name in terms])
        short, plain = quick.of(part), shared.of(part)
        assert short is not None and plain is not None
        theta = draws(part)
        assert np.sum(short.residual(theta)**2, axis=1) == pytest.approx(np.sum(plain.residual(theta)**2, axis=1), rel=1e-9)
    assert shared.around(whole.with_elements([Element(LIBRARY["cubic"], JOINTS)])) is shared


def test_parameters_that_are_known_are_held_while_starts_are_screened_and_move_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    one = problem("jenkins_prager", "clearance")
    regressed = regression(one, one.weight)
    low, high = one.to_s(one.bounds.T)
    s = one.to_s(draws(one))
    moving = np.arange(10) >= 6
    assert regressed.jacobian(s, low, high, moving) == pytest.approx(regressed.jacobian(s, low, high)[..., moving], rel=1e-12)
    known = fit(problem("jenkins_prager"), starts=4, seed=1)
    found = fit(one, starts=12, seed=2, warm=known.values)
    monkeypatch.setattr("bayes_nlsid.identification.fit.SURVIVORS", 12)      # all go on, so that nothing is held
    free = fit(one, starts=12, seed=2, warm=known.values)
    assert found.mse <= known.mse and found.mse == pytest.approx(free.mse, rel=0.02)


@pytest.mark.parametrize("term", ["bouc_wen", "iwan5"])
def test_laws_without_a_table_are_walked_through_the_samples(term: str) -> None:
    one = problem(term)
    long = regression(one, one.weight)
    assert long.root is not None and long.size == one.size
    theta = draws(one, 2)
    assert long.residual(theta) == pytest.approx(np.sqrt(one.weight) * one.residual(theta), rel=1e-9, abs=1e-9)


def test_a_law_that_jumps_is_searched_for_blurred_and_fitted_as_it_is() -> None:
    truth = np.array([900.0, 1.2e6, -0.4, 0.3, 0.6])
    term = LIBRARY["iwan5"]

    def joint(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        f_s, k_t, chi, beta, theta = truth
        phi = f_s * (1 + beta) / (k_t * (beta + (chi + 1) / (chi + 2)))
        r = np.minimum(np.abs(q[:, 0]) / phi, 1)
        stuck = k_t * q[:, 0] * (1 + (theta * (chi + 1) / (chi + 2) - 1) / (1 + beta) * r ** (chi + 1))
        return np.stack([np.where(r < 1, stuck, theta * f_s * np.sign(q[:, 0])) - k_t * q[:, 0], 0 * q[:, 0]], axis=-1)

    data = prescribed(beam(), joint, seconds=3.0, size=1.5e-3)
    one = Problem(Model(beam(), (Element(term, ("J1",)),), (0,)), (data,), scenario("S1", 1, 0), places=96)
    found = fit(one, starts=20, seed=1)
    exact = fit(replace(one, places=0), starts=20, seed=1)
    assert found.mse == pytest.approx(float(one.mse(found.theta, found.weights)), rel=0.02)
    assert found.mse < 1.5 * exact.mse + 1e-3 * fit(one.with_elements(()), starts=1).mse
