"""A user's own law from text: read exactly, differentiated exactly, refused politely."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.expression import Formula, user_term
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import force_along, motion
from tests.forces.cases import ordinary, ringing

COEFFICIENT = {"c": ("N", "coefficient")}


@pytest.mark.parametrize("term", LIBRARY.values(), ids=LIBRARY.keys())
def test_slopes_of_the_library_are_found_from_its_formulas(term) -> None:  # noqa: ANN001
    p = ordinary(term)
    size = 3e-5 if len(p) > 1 else 1.0
    q, v = size * np.array([-0.9, 0.35, 0.8, -0.1]), 300 * size * np.array([0.4, -0.2, 0.7, -0.9])
    formula = Formula(term.formula, tuple(x.name for x in term.params))
    for found, expected in zip(formula.slope(q, v, *p), term.slope(q, v, *p), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


leaves = st.sampled_from(["q", "v", "a", "0.7", "2", "pi"])
formulas = st.recursive(leaves, lambda inner: st.one_of(
    st.tuples(inner, st.sampled_from(["+", "-", "*"]), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
    st.tuples(st.sampled_from(["sin", "cos", "tanh", "-"]), inner).map(lambda t: f"{t[0]}({t[1]})"),
    inner.map(lambda x: f"exp(-({x})**2)"), inner.map(lambda x: f"sqrt(1 + ({x})**2)"), inner.map(lambda x: f"log(2 + ({x})**2)"),
    st.tuples(inner, inner).map(lambda t: f"({t[0]})/(1 + ({t[1]})**2)"),
    st.tuples(inner, inner).map(lambda t: f"(1 + ({t[0]})**2)**tanh({t[1]})"),
), max_leaves=8)


@given(formulas, st.floats(-1, 1), st.floats(-1, 1))
def test_values_and_slopes_of_any_smooth_formula(text: str, q: float, v: float) -> None:
    formula = Formula(text, ("a",))
    names = {f: getattr(np, f) for f in ("sin", "cos", "tanh", "exp", "sqrt", "log", "pi")}

    def value(q: complex, v: complex) -> complex:
        return eval(text, {**names, "a": 0.3, "q": q, "v": v})  # noqa: S307 - the reference: text made by this test

    assert float(formula(q, v, 0.3)) == pytest.approx(value(q, v), rel=1e-12, abs=1e-12)
    # The complex step has no cancellation: exact to rounding.
    along, across = value(q + 1e-30j, v).imag / 1e-30, value(q, v + 1e-30j).imag / 1e-30
    slopes = formula.slope(q, v, 0.3)
    assert [float(s) for s in slopes] == pytest.approx([along, across], rel=1e-9, abs=1e-9)


def test_comparisons_minimum_and_maximum() -> None:
    formula = Formula("where(q >= 0, minimum(c*q, 1), maximum(2*c*q, -3)) + abs(v)*sign(v)", ("c",))
    q, v = np.array([-4.0, -1.0, 0.2, 5.0]), np.array([1.0, -2.0, 3.0, -4.0])
    np.testing.assert_allclose(formula(q, v, 2.0), [-3 + 1, -3 - 2, 0.4 + 3, 1 - 4])
    along, across = formula.slope(q, v, 2.0)
    np.testing.assert_array_equal(along, [0, 0, 2, 0])
    np.testing.assert_array_equal(across, [1, 1, 1, 1])


def test_term_knows_what_its_formula_is() -> None:
    cubic = user_term("mine", "c*q**3", COEFFICIENT)
    assert (cubic.parity, cubic.linear, cubic.dissipative, cubic.stiffness) == ("odd", True, False, None)
    drag = user_term("drag", "c*v*abs(v)", COEFFICIENT)
    assert (drag.parity, drag.linear, drag.dissipative) == ("odd", True, True)
    bias = user_term("bias", "c*q**2", COEFFICIENT)
    assert bias.parity == "even"
    spring = user_term("soft", "k*q/(1 + abs(q)/d)", {"k": ("N/m", "stiffness"), "d": ("m", "displacement")})
    assert not spring.linear and float(spring.stiffness(7.0, 1e-4)) == pytest.approx(7.0)  # type: ignore[misc]
    assert spring.params[0].rule == "stiffness" and spring.params[1].unit == "m"
    assert user_term("mixed", "c*(q + q**2)", COEFFICIENT).parity == "none"
    ranged = user_term("ranged", "c*tanh(a*v)", COEFFICIENT | {"a": ("s/m", "range", 1, 1e4)})
    assert (ranged.params[1].lower, ranged.params[1].upper) == (1.0, 1e4)


def test_term_with_memory_follows_masing() -> None:
    params = {"f_s": ("N", "force"), "k_t": ("N/m", "stiffness")}
    term = user_term("own jenkins", "minimum(maximum(k_t*q, -f_s), f_s)", params, memory="masing")
    path = motion(*ringing(200, 1 / 2000), 1 / 2000)
    np.testing.assert_allclose(force_along(term, path, [800.0, 1e8], excess=True),
                               force_along(LIBRARY["jenkins_memory"], path, [800.0, 1e8], excess=True), atol=1e-9)
    assert term.dissipative


def test_term_can_be_sent_to_another_process() -> None:
    term = pickle.loads(pickle.dumps(user_term("mine", "c*q**3*exp(-v**2)", COEFFICIENT)))
    q = np.array([0.1, -0.4])
    np.testing.assert_allclose(term.law(q, q, 2.0), 2 * q**3 * np.exp(-(q**2)))
    np.testing.assert_allclose(term.slope(q, q, 2.0)[1], -4 * q**4 * np.exp(-(q**2)))


@pytest.mark.parametrize("text", [
    "__import__('os').system('true')", "q.real", "c*q^3", "(lambda: 1)()", "q if v else 1", "c*foo(q)", "c*[q][0]", "{q}", "c*(q < 1)",
    "c*q; 1", "c = q", "c*1e999*q", "c*q*1j", "", "  ", "c*'a'", "True*c*q", "where(q < v < 1, c, 0)", "where(q, c, 0)", "c*min(q, v)",
    "abs(q, v)*c", "abs(x=q)*c", "c*q\x00", "(" * 500 + "c*q" + ")" * 500, "-" * 1500 + "c*q", "c*q" + " + c*q" * 600,
    "c*x", "c", "q", "c/q",
    "c*sqrt(q)", "c*log(abs(q))", "c*q//2", "c*q@v", "~c*q", "not q", "c*q == 1", "*q", "f'{q}'", "(c := q)", "abs*c*q", "q**-0.5*c"])
def test_everything_else_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="term 'x'"):
        user_term("x", text, COEFFICIENT)


@pytest.mark.parametrize("params", [{"q": ("N", "coefficient")}, {"abs": ("N", "coefficient")}, {"c d": ("N", "coefficient")},
                                    {"c": "N"}, {"c": ("N",)}, {"c": ("N", "anything")}, {"c": ("N", "range", 2, 1)},
                                    {"c": ("N", "range", "a", 1)}, {"c": ("N", "coefficient"), "idle": ("", "coefficient")},
                                    {"c": ("furlong", "coefficient")}, {"c": ("kN/mm", "coefficient")}, {"c": ("N", "stiffness")},
                                    {"c": ("N/m", "force")}, {"c": ("N", ["force"])}])
def test_parameters_are_checked(params: dict) -> None:
    with pytest.raises(InputError, match="study.toml: .terms. x"):
        user_term("x", "c*q", params, where="study.toml: [terms] x")


@pytest.mark.parametrize("unit", ["", "N/m^3", "N s^2/m^2", "N·s/m", "N m/rad", "N^(1-c)/m", "1/s", "kg"])
def test_units_without_prefix_are_taken_as_written(unit: str) -> None:
    assert user_term("x", "c*q**3", {"c": (unit, "coefficient")}).params[0].unit == unit


@pytest.mark.parametrize(("text", "memory"), [("c*v", "masing"), ("c*q**2", "masing"), ("c*q", "sliders")])
def test_memory_must_make_sense(text: str, memory: str) -> None:
    with pytest.raises(InputError, match="emory"):
        user_term("x", text, COEFFICIENT, memory=memory)  # type: ignore[arg-type]
