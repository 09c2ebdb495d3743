"""Local laws marched on modes: exactness of a step, order of convergence, and agreement with a general integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("numba")

from bayes_nlsid.forces.compiled import law_code  # noqa: E402
from bayes_nlsid.forces.library import LIBRARY  # noqa: E402
from bayes_nlsid.simulation.modal_march import march_modes, propagators  # noqa: E402

OMEGA, ZETA = np.array([2 * np.pi * 20.0, 2 * np.pi * 55.0, 2 * np.pi * 900.0]), np.array([0.01, 0.02, 0.005])
SHAKER = np.array([0.8, -0.5, 0.3])
ROWS = np.array([[1.0, 0.7, -0.6], [0.4, -0.9, 0.8]])


def linear_motion(t, amplitude=30.0, frequency=22.0):
    """Of both places under a sine force from rest: by the closed form of each mode."""
    w = 2 * np.pi * frequency
    H = amplitude * SHAKER / (OMEGA**2 - w**2 + 2j * ZETA * OMEGA * w)
    damped = OMEGA * np.sqrt(1 - ZETA**2)
    x0, v0 = -(H * np.exp(0j)).imag, -(1j * w * H).imag    # the free part cancels the forced one at the start
    lam = -ZETA * OMEGA + 1j * damped
    c = x0 - 1j * (v0 + ZETA * OMEGA * x0) / damped
    x = (H * np.exp(1j * w * t[:, None])).imag + (c * np.exp(lam * t[:, None])).real
    v = (1j * w * H * np.exp(1j * w * t[:, None])).imag + (c * lam * np.exp(lam * t[:, None])).real
    return x @ ROWS.T, v @ ROWS.T


def marched(names, values, dt, seconds=0.4, still=((0.0, 0.0), (0.0, 0.0)), modes=slice(None)):
    t = dt * np.arange(1, round(seconds / dt) + 1)
    q0, v0 = (np.ascontiguousarray(x[:, :len(names)]) for x in linear_motion(t))
    codes = [law_code(LIBRARY[n]) for n in names]
    own, forced = propagators(OMEGA[modes], ZETA[modes], dt)
    g, b = np.zeros((len(t), len(names))), np.ascontiguousarray(ROWS[:len(names), modes])
    static = np.ascontiguousarray(np.array(still)[:len(names), :len(names)])
    lost = march_modes(q0, v0, own, forced, b, static, dt, np.array([c[0] for c in codes]),
                       np.array([c[1] for c in codes]), np.array(values, dtype=float), g, np.zeros((2, b.shape[1])), np.zeros(len(names)))
    assert lost == 0
    return t, g


def integrated(names, values, seconds=0.4):
    """The same by an explicit integrator of high order on modal equations."""
    laws = [LIBRARY[n].law for n in names]

    def rate(t, y):
        x, w = y[:3], y[3:]
        g = sum(ROWS[j] * law(ROWS[j] @ x, ROWS[j] @ w, *values[j][:len(LIBRARY[names[j]].params)]) for j, law in enumerate(laws))
        return np.concatenate([w, -2 * ZETA * OMEGA * w - OMEGA**2 * x + SHAKER * 30.0 * np.sin(2 * np.pi * 22.0 * t) - g])

    found = solve_ivp(rate, (0, seconds), np.zeros(6), method="DOP853", rtol=1e-10, atol=1e-14, dense_output=True)

    def forces(t):
        y = found.sol(t)
        return np.stack([law(ROWS[j] @ y[:3], ROWS[j] @ y[3:], *values[j][:len(LIBRARY[names[j]].params)])
                         for j, law in enumerate(laws)], axis=1)

    return forces


def test_a_step_is_exact_for_a_ramp():
    """A force that grows evenly: closed form at any length of step, also for many radians per step."""
    for dt in (1e-4, 1e-2):
        own, forced = propagators(OMEGA, ZETA, dt)
        for m, (w, z) in enumerate(zip(OMEGA, ZETA, strict=True)):
            t, lam = dt, -z * w + 1j * w * np.sqrt(1 - z**2)
            # x'' + 2 z w x' + w² x = t from rest: (t − 2 z/w)/w² plus a free part
            c = 2 * z / w**3 - 1j * (-1 / w**2 + z * w * 2 * z / w**3) / lam.imag
            x, v = (t - 2 * z / w) / w**2 + (c * np.exp(lam * t)).real, 1 / w**2 + (c * lam * np.exp(lam * t)).real
            assert forced[1, m] * dt == pytest.approx(x, rel=1e-8, abs=1e-20) and forced[3, m] * dt == pytest.approx(v, rel=1e-8, abs=1e-16)
            free = np.exp(lam * t) * (1 - 1j * (z * w) / lam.imag)
            assert own[0, m] == pytest.approx(free.real, abs=1e-10)


@pytest.mark.parametrize(("names", "values"), [
    (("cubic",), [[4e10]]), (("spring",), [[6e3]]), (("v|v|",), [[400.0]]), (("clearance",), [[2e4, 1e-3]]),
    (("cubic", "v|v|"), [[4e10, 0.0], [400.0, 0.0]])], ids=lambda x: "+".join(x) if isinstance(x[0], str) else "")
def test_it_converges_with_second_order_to_what_an_integrator_finds(names, values):
    truth = integrated(names, values, seconds=0.25)
    errors = []
    for dt in (2e-4, 1e-4, 5e-5):
        t, g = marched(names, values, dt, seconds=0.25)
        wanted = truth(t)
        errors.append(np.abs(g - wanted).max() / np.abs(wanted).max())
    smooth = names != ("clearance",)
    assert errors[2] < (2e-3 if smooth else 2e-2)
    assert errors[2] < errors[0] / (10 if smooth else 4)


@pytest.mark.parametrize(("names", "values"), [(("cubic",), [[4e10]]), (("v|v|",), [[4e5]]),
                                               (("cubic", "v|v|"), [[4e10, 0.0], [4e5, 0.0]])],
                         ids=lambda x: "+".join(x) if isinstance(x[0], str) else "")
def test_a_mode_far_above_acts_as_a_spring(names, values):
    """Also before a damper, which then acts on the speed at which the spring yields."""
    high = ROWS[:, 2:] / OMEGA[2]
    t, whole = marched(names, values, 5e-5)
    _, short = marched(names, values, 5e-5, still=high @ high.T, modes=slice(0, 2))
    assert np.abs(whole - short).max() < 0.05 * np.abs(whole).max()


def test_the_speed_of_a_spring_is_of_second_order():
    """A damper behind nothing but a spring that moves as it is told: a first-order equation for the force."""
    flexibility, strength = 1e-4, 300.0

    def marched_alone(dt):
        t = dt * np.arange(1, round(0.2 / dt) + 1)
        q0, v0 = 1e-3 * (1 - np.cos(200 * t))[:, None], 0.2 * np.sin(200 * t)[:, None]
        g = np.zeros((len(t), 1))
        code = law_code(LIBRARY["v|v|"])
        march_modes(q0, v0, np.zeros((4, 0)), np.zeros((4, 0)), np.zeros((1, 0)), np.array([[flexibility]]), dt, np.array([code[0]]),
                    np.array([code[1]]), np.array([[strength]]), g, np.zeros((2, 0)), np.zeros(1))
        return t, g[:, 0]

    found = solve_ivp(lambda t, g: (0.2 * np.sin(200 * t) - np.sign(g) * np.sqrt(np.abs(g) / strength)) / flexibility, (0, 0.2), [0.0],
                      method="LSODA", rtol=1e-10, atol=1e-12, dense_output=True)
    errors = []
    for dt in (4e-4, 2e-4, 1e-4):
        t, g = marched_alone(dt)
        errors.append(np.abs(g - found.sol(t)[0]).max() / np.abs(g).max())
    assert errors[2] < 5e-3 and errors[2] < errors[0] / 6
