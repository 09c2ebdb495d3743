"""Table 1 term by term."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.integrate import quad

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.expression import Formula
from bayes_nlsid.forces.library import LIBRARY, TABLE_1, find_term, library_rows
from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.stepping import start_state, trial
from bayes_nlsid.forces.term import Term
from tests.forces.cases import IWAN, ordinary, phi_max

every = pytest.mark.parametrize("term", LIBRARY.values(), ids=LIBRARY.keys())


def _points(term: Term) -> tuple[np.ndarray, np.ndarray]:
    """Small motions in all four quadrants, no kink of the law among them."""
    size = 0.3 * np.array([1e-5, 3.3e-5, 9.1e-5]) if len(term.params) > 1 else np.array([0.2, 0.7, 1.3])
    q, v = np.meshgrid(np.concatenate([size, -size]), np.concatenate([1e3 * size, -1e3 * size]))
    return q.ravel(), v.ravel()


def test_table_is_complete_and_numbered() -> None:
    assert [term.index for term in TABLE_1] == list(range(1, 47))
    assert len(LIBRARY) == len(TABLE_1) + 7
    assert all(LIBRARY[term.name] is term for term in TABLE_1)


@every
def test_formula_says_what_the_law_does(term: Term) -> None:
    p = ordinary(term)
    q, v = _points(term)
    text = Formula(term.formula, tuple(x.name for x in term.params))
    np.testing.assert_allclose(text(q, v, *p), term.law(q, v, *p), rtol=1e-12)


@every
def test_parity(term: Term) -> None:
    p = ordinary(term)
    q, v = _points(term)
    sign = {"odd": -1.0, "even": 1.0}[term.parity]
    np.testing.assert_allclose(term.law(-q, -v, *p), sign * np.asarray(term.law(q, v, *p)), rtol=1e-14)


@every
def test_at_rest_force_is_zero_and_slopes_are_finite(term: Term) -> None:
    p = ordinary(term)
    assert float(term.law(0.0, 0.0, *p)) == 0.0
    assert np.isfinite([float(np.asarray(s)) for s in term.slope(0.0, 0.0, *p)]).all()


@every
def test_slope_is_the_derivative(term: Term) -> None:
    p = ordinary(term)
    q, v = _points(term)
    along, across = (np.broadcast_to(s, q.shape) for s in term.slope(q, v, *p))
    force = np.abs(np.broadcast_to(term.law(q, v, *p), q.shape)).max()
    for slope, x, shift in ((along, q, (1.0, 0.0)), (across, v, (0.0, 1.0))):
        h = 1e-5 * np.abs(x)
        step = [np.asarray(term.law(q + k * h * shift[0], v + k * h * shift[1], *p)) for k in (-2, -1, 1, 2)]
        difference = (step[0] - 8 * step[1] + 8 * step[2] - step[3]) / (12 * h)
        np.testing.assert_allclose(slope, difference, rtol=1e-8, atol=1e-9 * force / np.abs(x).max())


@every
def test_stiffness_is_the_slope_at_rest(term: Term) -> None:
    p = ordinary(term)
    if term.stiffness is None:
        assert term.name == "spring" or abs(float(np.asarray(term.slope(0.0, 0.0, *p)[0]))) == 0.0
    else:
        assert float(term.stiffness(*p)) == pytest.approx(float(np.asarray(term.slope(0.0, 0.0, *p)[0])))


@every
def test_force_does_not_depend_on_the_units_of_length_and_mass(term: Term) -> None:
    """In mm, t, s a newton is still t mm/s², so metres become 1000 in every unit of a parameter, and the force stays."""
    p = ordinary(term)
    q, v = _points(term)
    factor = []
    for param in term.params:
        below = param.unit.replace("N^(1-nu)", "N").split("/")[1:]
        above = param.unit.split("/")[0]
        power = sum(-float(x.partition("^")[2] or 1) for part in below for x in part.split() if x.partition("^")[0] == "m")
        power += sum(float(x.partition("^")[2] or 1) for x in above.split() if x.partition("^")[0] == "m")
        factor.append(1000.0**power)
    if term.memory == "bouc_wen":  # its law alone is the elastic part; test the loop as well
        si = force_along(term, motion(q, v, 1.0), p)
        np.testing.assert_allclose(force_along(term, motion(1e3 * q, 1e3 * v, 1.0), p * factor), si, rtol=1e-9)
    np.testing.assert_allclose(term.law(1e3 * q, 1e3 * v, *(p * factor)), term.law(q, v, *p), rtol=1e-12)


@pytest.mark.parametrize("term", [t for t in LIBRARY.values() if t.linear], ids=lambda t: t.name)
def test_unit_of_a_coefficient_is_newton_over_what_it_multiplies(term: Term) -> None:
    """Stretch length and time apart: only coefficients with the right powers of m and s leave the force alone."""
    length, time = 7.0, 3.0
    unit = term.params[0].unit
    factor = 1.0
    for part, sign in ((unit.split("/")[0], 1.0), ("/".join(unit.split("/")[1:]), -1.0)):
        for symbol in part.split():
            name, _, power = symbol.partition("^")
            factor *= {"m": length, "s": time, "N": 1.0}[name] ** (sign * float(power or 1))
    assert float(term.law(0.3 * length, 0.2 * length / time, factor)) == pytest.approx(float(term.law(0.3, 0.2, 1.0)))


@every
def test_broadcasts_over_any_batch_and_changes_nothing(term: Term) -> None:
    q, v = _points(term)
    p = ordinary(term) * (1 + 0.1 * np.random.default_rng(3).random((2, 3, len(term.params))))
    before = q.copy(), v.copy(), p.copy()
    batch = term.static_force(q, v, p)
    assert batch.shape == (2, 3, len(q))
    for i, j in np.ndindex(2, 3):
        np.testing.assert_array_equal(batch[i, j], term.static_force(q, v, p[i, j]))
    path = motion(q, v, 0.01)
    along = force_along(term, path, p)
    np.testing.assert_allclose(along[1, 2], force_along(term, path, p[1, 2]), rtol=1e-12, atol=1e-12)
    trial(term, start_state(term, p[0]), q[:3], v[:3], 0.01, p[0])
    for now, then in zip((q, v, p), before, strict=True):
        np.testing.assert_array_equal(now, then)


@every
def test_dissipation_over_a_symmetric_cycle_is_what_the_term_claims(term: Term) -> None:
    phase = 2 * np.pi * np.arange(4001) / 1000
    q, v = 4e-5 * np.sin(phase), 0.02 * np.cos(phase)
    f = force_along(term, motion(q, v, phase[1] * 4e-5 / 0.02), ordinary(term))
    last = slice(3000, 4001)
    energy, scale = np.trapezoid(f[last] * v[last], phase[last]), np.trapezoid(np.abs(f[last] * v[last]), phase[last])
    assert (energy > 1e-3 * scale) if term.dissipative else (abs(energy) < 1e-9 * scale)


@every
def test_excess_takes_out_the_spring_at_rest(term: Term) -> None:
    p = ordinary(term)
    q, v = _points(term)
    path = motion(q, v, 0.01)
    spring = 0.0 if term.stiffness is None else float(term.stiffness(*p))
    np.testing.assert_allclose(force_along(term, path, p, excess=True), force_along(term, path, p) - spring * q, rtol=1e-12)
    state = start_state(term, p[None])
    full, part = (trial(term, state, q[:1], v[:1], 0.01, p[None], excess=e) for e in (False, True))
    assert part[0][0] == pytest.approx(full[0][0] - spring * q[0], rel=1e-9)
    assert part[1][0] == pytest.approx(full[1][0] - spring, rel=1e-9)


@every
def test_survives_pickling(term: Term) -> None:
    q, v = _points(term)
    other = pickle.loads(pickle.dumps(term))
    np.testing.assert_array_equal(other.static_force(q, v, ordinary(term)), term.static_force(q, v, ordinary(term)))


EXTREMES = [(2000.0, 1e8, -1.0, 0.0), (2000.0, 1e8, -1 + 1e-15, 1e-300), (1e-300, 1e12, -0.5, 0.1), (0.0, 1e8, 0.3, 0.0),
            (1e12, 1e-12, 0.9, 10.0), (1e-12, 1e300, -0.9999, 0.0), (2000.0, 0.0, -0.5, 0.1)]


@pytest.mark.parametrize("p", EXTREMES)
@pytest.mark.parametrize("name", ["iwan4", "iwan5", "iwan4_memory", "iwan5_memory"])
def test_iwan_laws_stay_finite_at_the_edges_of_their_parameters(name: str, p: tuple[float, ...]) -> None:
    term = LIBRARY[name]
    values = np.array([*p, 0.5][:len(term.params)])
    q = np.concatenate([[0.0], np.logspace(-300, 0, 61), -np.logspace(-300, 0, 61)])
    with np.errstate(all="raise", under="ignore"):
        f, slope = term.law(q, 0 * q, *values), term.slope(q, 0 * q, *values)[0]
    assert np.isfinite(f).all() and np.isfinite(slope).all()
    assert (np.abs(f) <= p[0] * (1 + 1e-12)).all()
    assert np.isfinite(force_along(term, motion(q, 0 * q, 1.0), values)).all()


@pytest.mark.parametrize("theta", [1.0, 0.6])
@pytest.mark.parametrize(("chi", "beta"), [(-0.5, 0.1), (0.4, 0.0), (-0.9, 2.0)])
def test_iwan_backbone_is_the_integral_over_its_sliders(chi: float, beta: float, theta: float) -> None:
    f_s, k_t = IWAN["f_s"], IWAN["k_t"]
    reach = phi_max(f_s, k_t, chi, beta)
    density, last = k_t * (chi + 1) / ((1 + beta) * reach ** (chi + 1)), k_t * beta / (1 + beta)
    for share in (0.05, 0.5, 0.99):
        q = share * reach
        # Sliders below q have broken and carry theta phi; those above are stretched by q.
        broken = quad(lambda phi: phi, 0, q, weight="alg", wvar=(chi, 0), epsabs=0)[0]
        stuck = (reach ** (chi + 1) - q ** (chi + 1)) / (chi + 1)
        expected = density * (theta * broken + q * stuck) + last * q
        assert float(LIBRARY["iwan5"].law(q, 0.0, f_s, k_t, chi, beta, theta)) == pytest.approx(expected, rel=1e-9)
        if theta == 1.0:
            assert float(LIBRARY["iwan4"].law(-q, 0.0, f_s, k_t, chi, beta)) == pytest.approx(-expected, rel=1e-9)


def test_iwan_is_continuous_at_macroslip_unless_friction_drops() -> None:
    reach = phi_max(**IWAN)
    four = LIBRARY["iwan4"].law(reach * np.array([1 - 1e-9, 1 + 1e-9]), 0.0, *list(IWAN.values())[:4])
    np.testing.assert_allclose(four, 2000.0, rtol=1e-8)
    five = LIBRARY["iwan5"].law(reach * np.array([1 - 1e-9, 1 + 1e-9]), 0.0, *IWAN.values())
    drop = (1 - IWAN["theta"]) * IWAN["k_t"] * IWAN["beta"] / (1 + IWAN["beta"]) * reach
    assert five[0] - five[1] == pytest.approx(drop, rel=1e-6)


def test_silverbox_can_be_built() -> None:
    q = np.linspace(-1, 1, 11)
    f = LIBRARY["square"].static_force(q, q, [0.3]) + LIBRARY["cubic"].static_force(q, q, [2.0])
    np.testing.assert_allclose(f, 0.3 * q**2 + 2.0 * q**3, rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("key", [45, "45", "iwan4"])
def test_terms_are_found_by_number_and_name(key: str | int) -> None:
    assert find_term(key) is LIBRARY["iwan4"]


@pytest.mark.parametrize("key", [0, 47, "iwan", "", -1])
def test_unknown_terms_are_refused_in_one_sentence(key: str | int) -> None:
    with pytest.raises(InputError, match="study.toml: .*no force law.*nlsid terms"):
        find_term(key, "study.toml: [candidates]")


def test_rows_describe_every_term() -> None:
    rows = library_rows()
    assert [row["name"] for row in rows] == list(LIBRARY)
    assert all(row[key] for row in rows for key in ("formula", "parameters", "bounds", "memory", "parity", "dissipates", "meaning"))
    by_name = {row["name"]: row for row in rows}
    assert by_name["cubic"]["parameters"] == "c [N/m^3]"
    assert by_name["v|v|"]["parameters"] == "c [N s^2/m^2]"
    assert by_name["sgn(q)|q|^0.5v"]["parameters"] == "c [N s/m^1.5]"
    assert by_name["iwan4"]["index"] == "45" and by_name["iwan4_memory"]["memory"] == "masing"


def test_a_term_by_hand_takes_ten_lines() -> None:
    term = Term("stribeck", "f_c*tanh(v/v_s)*(1 + 0.3*exp(-(v/v_s)**2))",
                params=(Param("f_c", "N", "force"), Param("v_s", "m/s", "velocity")),
                law=lambda q, v, f_c, v_s: f_c * np.tanh(v / v_s) * (1 + 0.3 * np.exp(-((v / v_s) ** 2))),
                slope=lambda q, v, f_c, v_s: (0.0, f_c / v_s * (np.exp(-((v / v_s) ** 2)) * (
                    0.3 / np.cosh(v / v_s) ** 2 - 0.6 * v / v_s * np.tanh(v / v_s)) + 1 / np.cosh(v / v_s) ** 2)),
                dissipative=True)
    v = np.linspace(-0.2, 0.2, 7)
    text = Formula(term.formula, ("f_c", "v_s"))
    np.testing.assert_allclose(term.static_force(v, v, [3.0, 0.1]), text(v, v, 3.0, 0.1), rtol=1e-13)
    np.testing.assert_allclose(term.slope(v, v, 3.0, 0.1)[1], text.slope(v, v, 3.0, 0.1)[1], rtol=1e-12)
