"""Hysteresis along a recorded motion: loops, memory, and their closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp

from bayes_nlsid.forces import memory
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import force_along, motion, reversal_parents
from tests.forces.cases import IWAN, ordinary, phi_max, ringing

IWAN4 = np.array(list(IWAN.values())[:4])
REACH = phi_max(*IWAN4)
paths = arrays(float, st.integers(2, 40), elements=st.integers(-12, 12).map(lambda k: k * 3e-6))


def along(name: str, path: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Force at the corners of a path without turning points between them."""
    return force_along(LIBRARY[name], motion(path, np.zeros_like(path), 1.0), p)


def sweep(*corners: float, points: int = 2000) -> np.ndarray:
    """A path through the given corners, starting at the first."""
    pieces = [np.linspace(a, b, points + 1)[1:] for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return np.concatenate([[corners[0]], *pieces])


def energy(name: str, p: np.ndarray, *corners: float, cycle: int) -> float:
    """Energy dissipated on the last ``cycle`` corners of the path, J."""
    path = sweep(*corners)
    f = along(name, path, p)
    last = slice(len(path) - cycle * 2000 - 1, None)
    return float(np.trapezoid(f[last], path[last]))


# --- Masing -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9, 1.0, 1.7])
@pytest.mark.parametrize(("chi", "beta"), [(-0.5, 0.1), (0.3, 1.5), (-0.9, 0.0)])
def test_iwan4_energy_per_cycle_is_the_closed_form(chi: float, beta: float, share: float) -> None:
    f_s, k_t = IWAN["f_s"], IWAN["k_t"]
    reach = phi_max(f_s, k_t, chi, beta)
    q, density, last = share * reach, k_t * (chi + 1) / ((1 + beta) * reach ** (chi + 1)), k_t * beta / (1 + beta)
    expected = (4 * density * q ** (chi + 3) / ((chi + 2) * (chi + 3)) if share <= 1
                else 4 * q * f_s - 4 * (density * reach ** (chi + 3) / (chi + 3) + last * reach**2))
    found = energy("iwan4_memory", np.array([f_s, k_t, chi, beta]), 0.0, q, -q, q, cycle=2)
    assert found == pytest.approx(expected, rel=2e-4)


def elastoplastic(path: np.ndarray, f_s: float, k_t: float) -> np.ndarray:
    """Exact update of an elastic, perfectly plastic spring."""
    f, before, out = 0.0, 0.0, []
    for q in path:
        f, before = min(max(f + k_t * (q - before), -f_s), f_s), q
        out.append(f)
    return np.array(out)


@settings(max_examples=200, deadline=None)
@given(paths)
def test_jenkins_memory_is_the_elastoplastic_update(path: np.ndarray) -> None:
    np.testing.assert_allclose(along("jenkins_memory", path, IWAN4[:2]), elastoplastic(path, *IWAN4[:2]), atol=1e-8)


@settings(max_examples=60, deadline=None)
@given(paths)
def test_iwan4_memory_is_a_fine_sum_of_sliders(path: np.ndarray) -> None:
    f_s, k_t, chi, beta = IWAN4
    edges = np.linspace(0, REACH, 401)
    scale = k_t / (1 + beta) / REACH ** (chi + 1)
    k = np.append(scale * np.diff(edges ** (chi + 1)), k_t * beta / (1 + beta))
    slip_force = np.append(scale * (chi + 1) / (chi + 2) * np.diff(edges ** (chi + 2)), k[-1] * REACH)
    total = sum(elastoplastic(path, s, x) for s, x in zip(slip_force, k, strict=True))
    np.testing.assert_allclose(along("iwan4_memory", path, IWAN4), total, atol=2e-4 * f_s)


def brute_parents(path: np.ndarray) -> list[int]:
    """Preisach's staircase: the open reversals of a history are its dominant extrema, found anew for every prefix."""
    parents = []
    for i in range(len(path)):
        x = np.concatenate([[0.0], path[:i + 1]])
        keep = [k for k in range(len(x)) if k == 0 or x[k] != x[k - 1]]
        corner = [k for j, k in enumerate(keep) if j in (0, len(keep) - 1) or (x[keep[j + 1]] - x[k]) * (x[k] - x[keep[j - 1]]) < 0]
        open_end, position = -1, 0
        largest = max(abs(x[k]) for k in corner)
        # The largest excursion lies on the first loading curve (either sign: the curve is symmetric); then alternate extrema.
        position = max(j for j, k in enumerate(corner) if abs(x[k]) == largest)
        while position < len(corner) - 1:
            open_end = corner[position]
            rest = corner[position + 1:]
            down = x[rest[0]] < x[open_end]
            best = min(x[k] for k in rest) if down else max(x[k] for k in rest)
            position += 1 + max(j for j, k in enumerate(rest) if x[k] == best)
        parents.append(open_end - 1)
    return parents


@settings(max_examples=300, deadline=None)
@given(arrays(float, st.integers(1, 25), elements=st.integers(-9, 9).map(float)))
def test_wiping_out_leaves_the_dominant_extrema(path: np.ndarray) -> None:
    found = reversal_parents(path)
    for mine, reference in zip(found, brute_parents(path), strict=True):
        # Where a loop is closed exactly, several samples stand for the same reversal: compare values.
        assert (mine < 0) == (reference < 0)
        assert mine < 0 or path[mine] == path[reference]


def test_return_point_memory() -> None:
    outer = sweep(0, 0.8 * REACH, -0.8 * REACH, 0.8 * REACH, points=400)
    inner = sweep(0, 0.8 * REACH, -0.8 * REACH, 0.1 * REACH, -0.3 * REACH, -0.1 * REACH, -0.2 * REACH, 0.1 * REACH, 0.8 * REACH, points=400)
    f_outer, f_inner = along("iwan4_memory", outer, IWAN4), along("iwan4_memory", inner, IWAN4)
    # After the inner loops have closed at 0.1 reach, the rest of the branch is as if they had never been.
    late = inner[-400:]
    q, f = outer[-400:], f_outer[-400:]
    np.testing.assert_allclose(f_inner[-400:], np.interp(late, q, f), atol=2e-4 * IWAN4[0])
    assert reversal_parents(inner)[-2] == 800  # the reversal at −0.8 reach; the branch ends when +0.8 reach is met again
    assert reversal_parents(inner)[-1] == -1


def test_first_loading_is_the_backbone_and_excursions_beyond_return_to_it() -> None:
    path = np.array([0.2, 0.5, -0.4, 0.3, 0.9, -0.95]) * REACH
    f = along("iwan4_memory", path, IWAN4)
    law = LIBRARY["iwan4"].law(path, 0.0, *IWAN4)
    np.testing.assert_allclose(f[[0, 1, 4, 5]], law[[0, 1, 4, 5]], rtol=1e-13)
    # from 0.5 down by 0.9: 2 f(0.45)
    assert f[2] == pytest.approx(law[1] - 2 * LIBRARY["iwan4"].law(0.45 * REACH, 0.0, *IWAN4), rel=1e-13)


def test_decay_of_five_thousand_half_cycles() -> None:
    """Every half-cycle nests inside the last: the chain is 5,000 deep, and its sum telescopes for a linear spring."""
    peaks = 0.9 * REACH * 0.999 ** np.arange(5000) * (-1.0) ** np.arange(5000)
    path = motion(peaks, np.zeros(5000), 1.0)
    assert len(path.path.reversals) == 4999 and len(path.path.passes) <= 14
    f = force_along(LIBRARY["iwan4_memory"], path, IWAN4)
    expected = [LIBRARY["iwan4"].law(peaks[0], 0.0, *IWAN4)]
    for step in np.diff(peaks):
        expected.append(expected[-1] + 2 * LIBRARY["iwan4"].law(step / 2, 0.0, *IWAN4))
    np.testing.assert_allclose(f, expected, atol=1e-9 * IWAN4[0])
    stuck = force_along(LIBRARY["jenkins_memory"], path, [1e9, 1e8])
    np.testing.assert_allclose(stuck, 1e8 * peaks, atol=1e-8)


def test_force_is_rate_independent() -> None:
    q, v = ringing(400, 1 / 4000)
    slow = force_along(LIBRARY["iwan4_memory"], motion(q, v / 50, 50 / 4000), IWAN4)
    np.testing.assert_array_equal(slow, force_along(LIBRARY["iwan4_memory"], motion(q, v, 1 / 4000), IWAN4))


# --- turning points between samples -------------------------------------------------------------------------------------------


def test_turning_point_is_that_of_the_cubic() -> None:
    rng = np.random.default_rng(2)
    q0, v0, q1, v1 = rng.normal(size=(4, 500))
    turned, extremum = memory.turning_point(q0, v0, q1, v1, 0.7)
    np.testing.assert_array_equal(turned, v0 * v1 < 0)
    np.testing.assert_array_equal(extremum[~turned], q1[~turned])
    s = np.linspace(0, 1, 4001)[:, None]
    cubic = q0 + s * 0.7 * v0 + s**2 * (3 * (q1 - q0) - 0.7 * (2 * v0 + v1)) + s**3 * (0.7 * (v0 + v1) - 2 * (q1 - q0))
    best = np.where(v0 > 0, cubic.max(axis=0), cubic.min(axis=0))
    np.testing.assert_allclose(extremum[turned], best[turned], atol=1e-6)


@pytest.mark.parametrize(("name", "p"), [("jenkins_memory", IWAN4[:2]), ("iwan4_memory", IWAN4),
                                         ("bouc_wen", np.array([1e8, 5e4, 0.8, -0.3, 1.0]))])
def test_force_converges_with_the_fourth_power_of_the_time_step(name: str, p: np.ndarray) -> None:
    """Turning points from the velocity: halving dt divides the error by 16; peaks of the samples alone would give 4."""
    if name == "jenkins_memory":
        p = np.array([800.0, 1e8])
    error = []
    for points in (16, 32, 64):
        dt = 1 / points
        t = dt * np.arange(2 * points) + 0.3 * dt
        def tone(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return 2e-5 * np.sin(2 * np.pi * t), 2e-5 * 2 * np.pi * np.cos(2 * np.pi * t)
        fine = np.unique(np.concatenate([np.arange(0.25, 2.0, 0.5), t]))
        exact = force_along(LIBRARY[name], motion(tone(fine)[0], 0 * fine, 1.0), p)[np.searchsorted(fine, t)]
        error.append(np.abs(force_along(LIBRARY[name], motion(*tone(t), dt), p) - exact).max())
    order = np.log2(error[:-1] / np.asarray(error[1:]))
    assert (order > 3.3).all(), (error, order)
    assert error[-1] < 1e-5 * IWAN4[0]


# --- five-parameter Iwan: sliders that drop when they break --------------------------------------------------------------------


@pytest.mark.parametrize(("chi", "beta"), [(-0.5, 0.1), (0.3, 1.5), (-0.9, 0.0)])
@pytest.mark.parametrize("theta", [1.0, 0.7, 0.3])
def test_iwan5_first_loading_is_its_backbone(chi: float, beta: float, theta: float) -> None:
    p = np.array([2000.0, 1e8, chi, beta, theta])
    reach = phi_max(*p[:4])
    path = np.linspace(0, 1.5 * reach, 600)
    path = path[np.abs(path / reach - 1) > 1e-3]  # the force falls off a step at phi_max
    force = along("iwan5_memory", path, p)
    stiffness, slip, _ = memory.iwan_sliders(p)
    one_breaks = (1 - theta) * (stiffness * slip)[:-1].max()
    assert one_breaks <= 0.03 * (1 - theta) * 2000
    assert np.abs(force - LIBRARY["iwan5"].law(path, 0.0, *p)).max() < 0.7 * one_breaks + 2e-4 * 2000


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.6, 0.9])
def test_iwan5_with_theta_one_is_iwan4(share: float) -> None:
    q = share * REACH
    five = energy("iwan5_memory", np.append(IWAN4, 1.0), 0.0, q, -q, q, cycle=2)
    assert five == pytest.approx(energy("iwan4_memory", IWAN4, 0.0, q, -q, q, cycle=2), rel=5e-3)


@pytest.mark.parametrize("theta", [0.9, 0.7, 0.4])
@pytest.mark.parametrize("history", ["first loading", "ringing down"])
def test_iwan5_energy_depends_on_history_as_in_closed_form(theta: float, history: str) -> None:
    chi, beta, k_t = IWAN["chi"], IWAN["beta"], IWAN["k_t"]
    q = 0.3 * REACH
    before = [0.0] if history == "first loading" else [0.0, *(0.99 * REACH * (-0.97) ** k for k in range(1, 39))]
    if history == "ringing down":
        q = abs(before[-1])
        before[-1:] = []
    side = 1.0 if len(before) == 1 or before[-1] < 0 else -1.0
    found = energy("iwan5_memory", np.array([*IWAN4, theta]), *before, side * q, -side * q, side * q, cycle=2)
    density = k_t * (chi + 1) / ((1 + beta) * REACH ** (chi + 1))
    upper = q if history == "first loading" else min(2 * q / (1 + theta), REACH)
    expected = density * (4 * theta * q * upper ** (chi + 2) / (chi + 2)
                          + (1 + theta) * (1 - 3 * theta) * upper ** (chi + 3) / (chi + 3))
    assert found == pytest.approx(expected, rel=0.015)


def test_finite_sliders_carry_the_whole_stiffness_and_strength() -> None:
    p = np.array([[2000.0, 1e8, -0.5, 0.1, 0.7], [10.0, 3e6, 0.6, 0.0, 1.0], [5.0, 1e5, -0.9999, 3.0, 0.2]])
    stiffness, slip, theta = memory.iwan_sliders(p)
    np.testing.assert_allclose(stiffness.sum(-1), p[:, 1], rtol=1e-12)
    np.testing.assert_allclose((stiffness * slip).sum(-1), p[:, 0], rtol=1e-9)
    assert (np.diff(slip, axis=-1) >= 0).all()


def test_a_broken_slider_slides_until_the_velocity_reverses() -> None:
    force, way, out = 0.0, 0.0, []
    for move in (0.9, 0.2, 0.01, 0.01, -0.1, -1.3, -0.2):
        force, way = memory.slider_step(move, force, way, 1.0, 0.5)
        out.append((round(float(force), 12), float(way)))
    assert out == [(0.9, 0), (0.5, 1), (0.5, 1), (0.5, 1), (0.4, 0), (-0.9, 0), (-0.5, -1)]


# --- Bouc–Wen -----------------------------------------------------------------------------------------------------------------


def bouc_wen_reference(p: np.ndarray, size: float, half_cycles: int, per_half: int) -> tuple[np.ndarray, np.ndarray]:
    """Path and force of z' = alpha v − beta (gamma |v||z|^(nu−1) z + delta v |z|^nu) under q = size sin t, by DOP853."""
    alpha, beta, gamma, delta, nu = p

    def rate(t: float, z: np.ndarray) -> np.ndarray:
        v, a = size * np.cos(t), np.abs(z)
        return alpha * v - beta * (gamma * abs(v) * a ** (nu - 1) * z + delta * v * a**nu)

    edges = np.concatenate([[0.0], np.pi * (np.arange(half_cycles) + 0.5)])
    q, z, now = [0.0], [0.0], [0.0]
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        t = np.linspace(a, b, per_half + 1)
        solved = solve_ivp(rate, (a, b), now, method="DOP853", rtol=1e-11, atol=1e-11 * alpha * size, t_eval=t, max_step=0.02)
        q, z, now = [*q, *size * np.sin(t[1:])], [*z, *solved.y[0][1:]], [solved.y[0][-1]]
    return np.array(q), np.array(z)


@pytest.mark.parametrize(("gamma", "delta", "nu", "tolerance"), [(0.8, -1.1, 1.0, 1e-9), (0.6, 0.4, 2.0, 1e-5), (0.6, 0.4, 1.5, 5e-5)])
def test_bouc_wen_against_dop853(gamma: float, delta: float, nu: float, tolerance: float) -> None:
    size, alpha = 2e-3, 5e4
    p = np.array([alpha, 3.0 * (alpha * size) ** (1 - nu) / size, gamma, delta, nu])
    path, exact = bouc_wen_reference(p, size, 5, 48)
    assert np.abs(along("bouc_wen", path, p) - exact).max() < tolerance * np.abs(exact).max()


def test_bouc_wen_converges_with_the_third_power_of_the_step() -> None:
    p = np.array([1.0, 3.0, 0.6, 0.4, 2.0])
    path, exact = bouc_wen_reference(p, 1.0, 4, 192)
    error = []
    for stride in (12, 6, 3):
        error.append(np.abs(along("bouc_wen", path[::stride], p) - exact[::stride]).max())
    order = np.log2(np.asarray(error[:-1]) / error[1:])
    assert (order > 2.5).all(), (error, order)


def test_bouc_wen_settles_at_its_strength_however_stiff() -> None:
    for nu in (1.0, 1.7, 5.0):
        p = np.array([1e8, 1e9, 1.0, 0.5, nu])
        f = along("bouc_wen", np.array([0.0, 1e-6, 1e-3, 1.0]), p)
        strength = (1e8 / 1.5e9) ** (1 / nu)
        np.testing.assert_allclose(f[2:], strength, rtol=1e-9)
        assert 0 < f[1] <= strength * (1 + 1e-12)


def test_bouc_wen_that_runs_away_stays_finite_and_silent() -> None:
    f = along("bouc_wen", np.linspace(0, 100, 500), np.array([1e8, 1e8, 0.1, -2.0, 5.0]))
    assert np.isfinite(f).all()


def test_bouc_wen_starts_at_its_stiffness() -> None:
    p = ordinary(LIBRARY["bouc_wen"])
    assert along("bouc_wen", np.array([0.0, 1e-12]), p)[1] == pytest.approx(p[0] * 1e-12, rel=1e-6)


# --- arguments ----------------------------------------------------------------------------------------------------------------


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"p has shape \(3,\), its last axis must be 4"):
        along("iwan4_memory", np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="one location at a time"):
        motion(np.zeros((3, 2)), np.zeros((3, 2)), 1.0)
    with pytest.raises(ValueError, match="NaN"):
        motion([0.0, np.nan], [0.0, 0.0], 1.0)
    with pytest.raises(ValueError, match="dt must be positive"):
        motion([0.0], [0.0], 0.0)
