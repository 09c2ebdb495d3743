"""Forward simulation against analytic solutions, conservation laws and an independent integrator."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.stepping import commit, start_state, trial
from bayes_nlsid.model import Element, Model
from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.structure.modal import ModalModel
from tests.simulation.problems import IWAN, beam, oscillator, scattered

W = 2 * np.pi * 10.0


def reference(model: Model, theta: NDArray[np.float64], u0: NDArray[np.float64], stop: float,
              force: Callable[[float], float] | None = None) -> NDArray[np.float64]:
    """Modal displacement (m,) at ``stop`` by DOP853 on the full equations; memoryless terms only."""
    lin = model.linear
    m = lin.modes

    def side(t: float, y: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = y[:m], y[m:]
        a = -2 * lin.zeta * lin.omega * v - lin.omega**2 * u
        for i, element in enumerate(model.elements):
            for name in element.locations:
                b, p = lin.rows((name,))[0], model.element_values(theta, i, name)
                f = element.term.law(b @ u, b @ v, *p)
                if element.excess and element.term.stiffness is not None:
                    f = f - element.term.stiffness(*p) * (b @ u)
                a = a - b * f
        if force is not None:
            a = a + lin.rows(lin.inputs)[0] * force(t)
        return np.concatenate([v, a])

    found = solve_ivp(side, (0, stop), np.concatenate([u0, np.zeros(m)]), method="DOP853", rtol=1e-11, atol=1e-14)
    return np.asarray(found.y[:m, -1])


def order(errors: list[float]) -> float:
    """Observed order from errors at successively halved steps."""
    return float(np.log2(errors[0] / errors[-1]) / (len(errors) - 1))


@pytest.mark.parametrize(("scheme", "least"), [("hht", 1.9), ("exponential", 1.9)])
@pytest.mark.parametrize(("term", "p"), [("cubic", [3e5]), ("iwan4", [200.0, 3000.0, -0.5, 0.1]), ("v|v|", [0.8])])
def test_second_order_against_an_independent_integrator(scheme: str, least: float, term: str, p: list[float]) -> None:
    model = oscillator(term)
    exact = reference(model, np.array(p), np.array([0.1]), 0.53)[0]
    errors = [abs(simulate(model, [p], fs=fs, samples=53 * fs // 100 + 1, u0=[0.1], scheme=scheme).displacement[0, -1, 0] - exact)  # type: ignore[arg-type]
              for fs in (1000, 2000, 4000)]
    assert order(errors) > least
    assert errors[-1] < 2e-4


def test_several_modes_and_joints_against_an_independent_integrator() -> None:
    model = beam("iwan4", "v|v|")
    theta = np.concatenate([IWAN, [2e3, 1e3]])
    u0 = np.array([4e-3, 0.0, 0.0])
    exact = reference(model, theta, u0, 0.125, lambda t: 30.0 * np.sin(40 * np.pi * t))
    for scheme in ("hht", "exponential"):
        errors = []
        for fs in (4000, 8000):
            n = fs // 8 + 1
            force = 30.0 * np.sin(40 * np.pi * np.arange(n) / fs)[:, None]
            response = simulate(model, [theta], fs=fs, samples=n, u0=u0, force=force, scheme=scheme, keep=("tip",))  # type: ignore[arg-type]
            errors.append(np.abs(response.final_displacement[0] - exact).max())
        assert errors[1] < errors[0] / 3.5
        assert errors[1] < 8e-3 * np.abs(exact).max()


@pytest.mark.parametrize("scheme", ["hht", "exponential"])
def test_dry_friction_stops_where_the_piecewise_solution_stops(scheme: str) -> None:
    model = oscillator("coulomb", zeta=0.0)
    force = 20.0
    shift = force / W**2
    # every half cycle is a cosine about ±shift, so the amplitude drops by 2 shift until it is below shift
    turning = [0.1]
    while abs(turning[-1]) > shift:
        turning.append(-np.sign(turning[-1]) * (abs(turning[-1]) - 2 * shift))
    fs = 4000
    response = simulate(model, [[force]], fs=fs, samples=fs + 1, u0=[0.1], scheme=scheme)  # type: ignore[arg-type]
    halves = response.displacement[0, ::fs // 20, 0]
    assert halves[:len(turning)] == pytest.approx(turning, abs=3e-4)
    assert np.abs(response.velocity[0, -fs // 10:, 0]).max() < 1e-8
    assert response.displacement[0, -1, 0] == pytest.approx(turning[-1], abs=2e-4)
    assert response.status[0] == "ok"


def test_dry_friction_is_second_order_between_reversals() -> None:
    model = oscillator("coulomb", zeta=0.0)
    shift = 20.0 / W**2
    errors = []
    for fs in (500, 1000, 2000):
        response = simulate(model, [[20.0]], fs=fs, samples=fs // 25 + 1, u0=[0.1])
        errors.append(abs(response.displacement[0, -1, 0] - (shift + (0.1 - shift) * np.cos(W * (fs // 25) / fs))))
    assert order(errors) > 1.9


def test_linear_motion_is_exact_with_the_exponential_step() -> None:
    model = beam()
    u0, v0 = np.array([1e-3, -2e-4, 5e-4]), np.array([0.01, 0.2, -0.1])
    response = simulate(model, np.zeros((1, 0)), fs=100.0, samples=201, u0=u0, v0=v0, scheme="exponential", keep=("tip",))
    w, z = model.linear.omega, model.linear.zeta
    wd, t = w * np.sqrt(1 - z**2), response.time[:, None]
    u = np.exp(-z * w * t) * (u0 * np.cos(wd * t) + (v0 + z * w * u0) / wd * np.sin(wd * t))
    exact = u @ model.linear.rows(("tip",))[0]
    assert np.abs(response.displacement[0, :, 0] - exact).max() < 1e-12 * np.abs(exact).max()


def test_undamped_duffing_follows_the_elliptic_function_and_keeps_its_energy() -> None:
    model, c, a = oscillator("cubic", zeta=0.0), 4e5, 0.1
    w2 = W**2 + c * a**2
    m = c * a**2 / (2 * w2)
    fs = 20000
    response = simulate(model, [[c]], fs=fs, samples=fs // 4 + 1, u0=[a], scheme="exponential")
    exact = a * ellipj(np.sqrt(w2) * response.time, m)[1]
    assert np.abs(response.displacement[0, :, 0] - exact).max() < 2e-4 * a
    u, v = response.displacement[0, :, 0], response.velocity[0, :, 0]
    energy = v**2 / 2 + W**2 * u**2 / 2 + c * u**4 / 4
    assert np.ptp(energy) < 1e-4 * energy[0]
    up = np.flatnonzero((u[:-1] < 0) & (u[1:] >= 0))
    crossing = (up - u[up] / (u[up + 1] - u[up])) / fs
    assert np.diff(crossing) == pytest.approx(4 * ellipk(m) / np.sqrt(w2), rel=1e-5)


@pytest.mark.parametrize("term", ["iwan4_memory", "bouc_wen", "v|v|"])
def test_dissipative_terms_never_raise_the_energy(term: str) -> None:
    p = {"iwan4_memory": [60.0, 3000.0, -0.5, 0.1], "bouc_wen": [3000.0, 40.0, 0.6, 0.4, 1.0], "v|v|": [2.0]}[term]
    model = oscillator(term, zeta=0.0, excess=False)
    response = simulate(model, [p], fs=1000, samples=1001, u0=[0.05], scheme="exponential")
    peaks = np.abs(response.displacement[0, :, 0]).reshape(-1)[:1000].reshape(20, 50).max(axis=1)
    assert (np.diff(peaks) < 1e-9).all() and peaks[-1] < 0.9 * peaks[0]


@pytest.mark.parametrize("terms", [("iwan4",), ("iwan4_memory",), ("clearance", "cubic"), ("coulomb",)])
@pytest.mark.parametrize("free", [(), (0, 2)])
def test_a_batch_is_its_samples_one_by_one(terms: tuple[str, ...], free: tuple[int, ...]) -> None:
    model = beam(*terms, free=free)
    values = {"iwan4": IWAN, "iwan4_memory": IWAN, "clearance": np.tile([2e6, 4e-5], 2), "cubic": np.array([1e13, 2e13]),
              "coulomb": np.array([10.0, 5.0])}
    theta = scattered(model.start(np.concatenate([values[t] for t in terms])), 3)
    kwargs = {"fs": 4096.0, "samples": 80, "u0": np.array([5e-3, 0.0, 0.0]), "keep": ("tip", "J1")}
    batch = simulate(model, theta, **kwargs)  # type: ignore[arg-type]
    for i in range(3):
        one = simulate(model, theta[i], **kwargs)  # type: ignore[arg-type]
        assert np.abs(one.displacement[0] - batch.displacement[i]).max() < 1e-9 * np.abs(batch.displacement[i]).max()
        assert one.status[0] == batch.status[i]


@pytest.mark.parametrize("scheme", ["hht", "exponential"])
def test_accelerations_satisfy_the_equation_of_motion(scheme: str) -> None:
    model = beam("iwan4_memory", "v|v|")
    theta = np.concatenate([IWAN, [2e3, 1e3]])
    n, fs = 200, 4096.0
    force = 20 * np.random.default_rng(1).standard_normal((n, 1))
    lin = model.linear
    # keep as many locations as modes, so that modal motion can be taken back out of the response
    response = simulate(model, [theta], fs=fs, samples=n, u0=np.array([2e-3, 0, 0]), force=force, scheme=scheme,  # type: ignore[arg-type]
                        keep=("J1", "tip", "shaker"))
    back = np.linalg.inv(lin.rows(response.locations))
    u, v, a = (x[0] @ back.T for x in (response.displacement, response.velocity, response.acceleration))
    b = lin.rows(("J1", "J2"))
    joint = np.zeros((n, 2))
    for j in range(2):
        p, term = theta[None, 4 * j:4 * j + 4], LIBRARY["iwan4_memory"]
        state = start_state(term, p)
        for i in range(n):
            q, w = (u[i] @ b[j])[None], (v[i] @ b[j])[None]
            joint[i, j] = trial(term, state, q, w, 1 / fs, p, True)[0][0]
            state = commit(term, state, q, w, 1 / fs, p)
            joint[i, j] += theta[8 + j] * w[0] * abs(w[0])
    exact = force @ lin.rows(("shaker",)) - 2 * lin.zeta * lin.omega * v - lin.omega**2 * u - joint @ b
    assert np.abs(a - exact).max() < 1e-6 * np.abs(a).max()


def test_divergence_is_a_status_and_leaves_the_others_alone() -> None:
    model = oscillator("cubic")
    response = simulate(model, [[-1e9], [1e3]], fs=1000, samples=600, u0=[0.1])
    assert list(response.status) == ["diverged", "ok"]
    alone = simulate(model, [[1e3]], fs=1000, samples=600, u0=[0.1])
    assert response.displacement[1] == pytest.approx(alone.displacement[0], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("stiffness", [1e5, 1e7, 1e9])
def test_stiff_contact_converges_and_keeps_its_energy(stiffness: float) -> None:
    model = oscillator("clearance", zeta=0.0)
    fs = 50000
    response = simulate(model, [[stiffness, 0.1]], fs=fs, samples=fs // 8, u0=[0.049], v0=[2.0], scheme="exponential")
    assert response.status[0] == "ok"
    u, v = response.displacement[0, :, 0], response.velocity[0, :, 0]
    inside = np.abs(u) < 0.05
    energy = (v**2 + W**2 * u**2)[inside] / 2
    # the bounce takes few steps at 1e9 N/m, so its energy is only as good as the force linear over a step
    assert np.ptp(energy) < {1e5: 0.01, 1e7: 0.02, 1e9: 0.5}[stiffness] * energy[0]


def test_a_growing_history_costs_no_accuracy() -> None:
    # every half cycle of a decay nests inside the last: the stack of reversals grows by one each time
    model = oscillator("iwan4_memory", zeta=0.002)
    p = [40.0, 2000.0, -0.4, 0.2]
    fs = 500
    response = simulate(model, [p], fs=fs, samples=4 * fs + 1, u0=[0.02], scheme="exponential")
    u, v = response.displacement[0, :, 0], response.velocity[0, :, 0]
    assert np.count_nonzero(np.diff(np.sign(v)) != 0) > 60
    # at the end motion is so small that the joint is stuck: linear frequency again
    late = u[-500:]
    up = np.flatnonzero((late[:-1] < 0) & (late[1:] >= 0))
    crossing = (up - late[up] / (late[up + 1] - late[up])) / fs
    assert 1 / np.diff(crossing).mean() == pytest.approx(10.0, rel=2e-2)
    assert response.status[0] == "ok"


def test_steady_forced_motion_is_the_frequency_response() -> None:
    model = beam(free=(0,))
    theta = model.start() * np.array([[1.0, 5.0], [1.02, 7.5]])   # damped enough to be steady after five seconds
    fs, f = 4096.0, 19.0
    n = int(fs * 6)
    force = np.cos(2 * np.pi * f * np.arange(n) / fs)[:, None]
    response = simulate(model, theta, fs=fs, samples=n, force=force, scheme="exponential", keep=("tip",), store=("displacement",))
    tail = response.displacement[:, -4096:, 0]
    measured = 2 / 4096 * tail @ np.exp(-2j * np.pi * f * np.arange(n - 4096, n) / fs)
    w = 2 * np.pi * f
    for i in range(2):
        omega, zeta = model.linear_values(theta[i])
        exact = np.sum(model.linear.rows(("tip",))[0] * model.linear.rows(("shaker",))[0] / (omega**2 - w**2 + 2j * zeta * omega * w))
        assert abs(measured[i] - exact) < 2e-4 * abs(exact)  # first-order hold: (w h)²/12


def test_each_sample_may_have_its_own_force() -> None:
    model = beam("iwan4")
    theta = scattered(IWAN, 2)
    force = np.random.default_rng(2).standard_normal((2, 300, 1))
    both = simulate(model, theta, fs=2000.0, samples=300, force=force, keep=("tip",))
    for i in range(2):
        one = simulate(model, theta[i], fs=2000.0, samples=300, force=force[i], keep=("tip",))
        assert both.acceleration[i] == pytest.approx(one.acceleration[0], rel=1e-8, abs=1e-10)


def test_storage_can_be_thinned_and_stopped() -> None:
    model = oscillator("cubic", zeta=0.05)
    full = simulate(model, [[1e4]], fs=1000, samples=4001, u0=[0.1])
    thin = simulate(model, [[1e4]], fs=1000, samples=4001, u0=[0.1], every=8, store=("velocity",))
    assert np.array_equal(thin.velocity[0, :, 0], full.velocity[0, ::8, 0])
    assert thin.displacement.shape == (1, 0, 1)
    short = simulate(model, [[1e4]], fs=1000, samples=400001, u0=[0.1], stop_amplitude=1e-4, compiled=False)
    last = np.abs(short.displacement[0, -100:, 0]).max()
    assert short.n < 6000 and last < 1e-4
    assert np.array_equal(short.displacement[0, :2000], full.displacement[0, :2000])


def test_a_location_without_motion_is_harmless() -> None:
    linear = ModalModel(np.array([W, 3 * W]), np.array([0.01, 0.01]), ("a", "b"), np.array([[1.0, 0.5], [0.0, 0.0]]), ("a",), (), ("a",
                                                                                                                                   "b"))
    model = Model(linear, (Element(LIBRARY["iwan4"], ("a", "b")),))
    response = simulate(model, [[30.0, 1e3, -0.5, 0.1] * 2], fs=2000, samples=500, u0=[0.05, 0.0])
    assert response.status[0] == "ok" and np.isfinite(response.displacement).all()


@pytest.mark.parametrize(("change", "word"), [
    ({"theta": np.zeros((1, 3))}, "theta"), ({"theta": np.full((1, 1), np.nan)}, "theta"), ({"fs": -1.0}, "fs"), ({"samples": 1},
                                                                                                                  "samples"),
    ({"force": np.zeros((9, 1))}, "force"), ({"u0": np.zeros(2)}, "u0"), ({"keep": ("y",)}, "unknown locations"), ({"store": ("jerk",)},
                                                                                                                   "store")])
def test_wrong_arguments_are_named(change: dict[str, object], word: str) -> None:
    arguments = {"theta": np.zeros((1, 1)), "fs": 100.0, "samples": 10} | change
    with pytest.raises(ValueError, match=word):
        simulate(oscillator("cubic"), **arguments)  # type: ignore[arg-type]
