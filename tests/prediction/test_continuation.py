"""Response curves against closed forms, against long time integration of this package, and against an integrator that shares no code."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from bayes_nlsid.model import Model
from bayes_nlsid.prediction.continuation import Curve, response_curves
from bayes_nlsid.prediction.harmonics import Basis, SteadyForces, orders_for
from bayes_nlsid.simulation.integration import simulate
from tests.simulation.problems import IWAN, beam, oscillator, scattered

W0 = 2 * np.pi * 10
Array = NDArray[np.float64]


def test_without_elements_it_is_the_linear_frequency_response() -> None:
    curve = response_curves(oscillator(), np.zeros(0), drive="x", at="x", levels=[3.0], band=(4, 30))[0][0]
    w = 2 * np.pi * curve.frequency
    exact = 3.0 / (W0**2 - w**2 + 2j * 0.01 * W0 * w)
    assert curve.status == "ok" and curve.frequency[0] == pytest.approx(4) and curve.frequency[-1] >= 30
    assert curve.harmonic("x") == pytest.approx(exact, rel=1e-9)
    assert curve.largest("x") == pytest.approx(np.abs(exact), rel=1e-4)
    peak = curve.peak("x")
    assert peak[0] == pytest.approx(10 * np.sqrt(1 - 2 * 0.01**2), rel=1e-5)
    assert peak[1] == pytest.approx(3.0 / (2 * 0.01 * np.sqrt(1 - 0.01**2) * W0**2), rel=1e-4)


def test_duffing_peak_lies_on_the_backbone_of_the_elliptic_integral() -> None:
    """At phase resonance the damping balances the force and the motion is that of the undamped oscillator."""
    c, zeta = 2e5, 0.002
    curves = response_curves(oscillator("cubic", zeta=zeta), [c], drive="x", at="x", levels=[0.05, 0.5, 2.0, 6.0], band=(8, 40))[0]
    for curve in curves:
        largest = curve.largest("x")
        i = int(np.argmax(largest))
        a = largest[i]
        w2 = W0**2 + c * a**2
        assert curve.status == "ok"
        assert curve.frequency[i] == pytest.approx(np.sqrt(w2) / (4 * ellipk(c * a**2 / (2 * w2))), rel=5e-4)
    assert curves[-1].frequency[np.argmax(curves[-1].largest("x"))] > 16  # far bent


def test_turning_points_are_passed_and_sweeps_jump_there() -> None:
    curve = response_curves(oscillator("cubic", zeta=0.01), [2e5], drive="x", at="x", levels=[5.0], band=(8, 20))[0][0]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(curve.frequency))) != 0)
    assert len(turns) == 2 and curve.status == "ok"
    upper, lower = curve.frequency[turns[0] + 1], curve.frequency[turns[1] + 1]
    assert upper > lower
    grid = np.linspace(8.5, 19.5, 400)
    up, down = curve.swept("x", grid), curve.swept("x", grid, down=True)
    between = (grid > lower) & (grid < upper)
    assert np.isfinite(up).all() and np.isfinite(down).all()
    assert up[~between] == pytest.approx(down[~between]) and (up[between] > 1.5 * down[between]).all() and between.sum() > 5


def test_a_softening_curve_folds_the_other_way() -> None:
    curve = response_curves(oscillator("cubic", zeta=0.01), [-4e4], drive="x", at="x", levels=[8.0], band=(7, 13))[0][0]
    grid = np.linspace(7.5, 12.5, 300)
    up, down = curve.swept("x", grid), curve.swept("x", grid, down=True)
    assert curve.status == "ok" and (down >= up * (1 - 1e-9)).all() and (down > 1.5 * up).any()


@pytest.mark.parametrize(("term", "p"), [("cubic", [2e5]), ("q|q|", [4e3]), ("v|v|", [0.4]), ("clearance", [3e3, 0.02]),
                                         ("iwan4", [8.0, 2e3, -0.4, 0.2]), ("jenkins_memory", [8.0, 2e3]),
                                         ("iwan4_memory", [8.0, 2e3, -0.4, 0.2]), ("iwan5_memory", [8.0, 2e3, -0.4, 0.2, 1.0]),
                                         ("bouc_wen", [2e3, 30.0, 0.8, -0.3, 1.0])])
def test_tangents_are_the_derivatives_of_the_forces(term: str, p: list[float]) -> None:
    model = oscillator(term)
    basis = Basis(orders_for(model, 5), 256)
    forces = SteadyForces(model, np.array([p]), basis)
    rng = np.random.default_rng(3)
    x = 0.01 * rng.standard_normal((1, 1, basis.size)) / (1 + basis.each) ** 2
    w, which = np.array([60.0]), np.zeros(1, dtype=int)
    f, by_x, by_w = forces.evaluate(x, w, which)
    size = np.abs(by_x).max()
    for c in range(basis.size):
        step = np.zeros_like(x)
        step[..., c] = 2e-9
        wanted = (forces.evaluate(x + step, w, which)[0] - forces.evaluate(x - step, w, which)[0]) / 4e-9
        # sliders break loose one by one, so their quotient is rough
        assert by_x[..., c] == pytest.approx(wanted, abs=(0.03 if term == "iwan5_memory" else 2e-4) * size)
    wanted = (forces.evaluate(x, w + 1e-5, which)[0] - forces.evaluate(x, w - 1e-5, which)[0]) / 2e-5
    assert by_w == pytest.approx(wanted, abs=1e-6 * max(np.abs(f).max(), 1e-12))


def test_every_force_follows_a_loop_that_closes_with_its_energy() -> None:
    """Work per cycle of a Jenkins slider: 4 f_s (a − f_s/k_t)."""
    model = oscillator("jenkins_memory", excess=False)
    basis = Basis((1, 3), 512)
    x = np.zeros((1, 1, basis.size))
    x[..., 0] = 0.01
    force = SteadyForces(model, np.array([[8.0, 2e3]]), basis).evaluate(x, np.ones(1), np.zeros(1, dtype=int))[0]
    work = -np.pi * 0.01 * force[0, 0, 1]  # of q = a cos θ against b sin θ
    assert work == pytest.approx(4 * 8.0 * (0.01 - 8.0 / 2e3), rel=1e-3)


def settled(model: Model, theta: Array, curves: list[Curve], points: list[int], drive: str, at: str, cycles: int) -> Array:
    """Fundamental amplitude after a long time, all points of a batch at once, started from the balanced motion."""
    curve = curves[0]
    frequency = curve.frequency[points]
    fs = 256 * frequency.max()
    n = int(cycles / frequency.min() * fs)
    t = np.arange(n) / fs
    force = np.zeros((len(points), n, len(model.linear.inputs)))
    force[..., model.linear.inputs.index(drive)] = curve.level * np.cos(2 * np.pi * frequency[:, None] * t)
    x0, v0 = (start_of(model, theta, curve, points, drive, k) for k in (0, 1))
    found = simulate(model, np.tile(theta, (len(points), 1)), fs=fs, samples=n, force=force, u0=x0, v0=v0, keep=(at,),
                     scheme="exponential", store=("displacement",))
    out = []
    for i, f in enumerate(frequency):
        last = t >= t[-1] - 10 / f
        wave = np.exp(2j * np.pi * f * t[last])
        table = np.concatenate([(wave[:, None] ** np.arange(1, 8)).real, (wave[:, None] ** np.arange(1, 8)).imag,
                                np.ones((last.sum(), 1))], axis=1)
        c = np.linalg.lstsq(table, found.at(at)[i, last], rcond=None)[0]
        out.append(np.hypot(c[0], c[7]))
    return np.array(out)


def start_of(model: Model, theta: Array, curve: Curve, points: list[int], drive: str, order: int) -> Array:
    """Modal displacement or velocity at θ = 0 from the balance of every mode, (len(points), m)."""
    w = 2 * np.pi * curve.frequency[points]
    forces = SteadyForces(model, theta[None], curve.basis)
    r = len(forces.locations)
    f = curve.basis.complex(forces.evaluate(curve.coefficients[points][:, :r], w, np.zeros(len(points), dtype=int))[0])
    omega, zeta = (a[0] for a in model.linear_values(theta[None]))
    h = np.array(curve.basis.orders) * w[:, None]
    push = -np.einsum("rm,brh->bhm", model.linear.rows(forces.locations), f)
    push[:, curve.basis.orders.index(1)] += curve.level * model.linear.rows((drive,))[0]
    u = push / (omega**2 - h[..., None]**2 + 2j * zeta * omega * h[..., None])
    return np.asarray(((1j * h[..., None]) ** order * u).real.sum(axis=1))


@pytest.mark.parametrize(("term", "cycles"), [("iwan4", 60), ("iwan4_memory", 60), ("cubic", 60)])
def test_ten_points_against_long_time_integration(term: str, cycles: int) -> None:
    model = beam(term)
    theta = IWAN if "iwan" in term else np.array([3e9, 3e9])
    curves = response_curves(model, theta, drive="shaker", at="tip", levels=[4.0], band=(17, 23), harmonics=9)[0]
    size = np.abs(curves[0].harmonic("tip"))
    order = np.argsort(-size)
    # ten points that a sweep upwards meets, the peak among them
    stable = [i for i in range(len(size)) if curves[0].frequency[i] >= curves[0].frequency[:i + 1].max()]
    best = [int(i) for i in order if i in stable][0]
    points = sorted({best, *(stable[k] for k in np.linspace(0, len(stable) - 1, 9).astype(int))})[:10]
    found = settled(model, theta, curves, points, "shaker", "tip", cycles)
    assert len(points) >= 9 and curves[0].status == "ok"
    assert found == pytest.approx(size[points], rel=4e-3)


@pytest.mark.parametrize("where", [0.3, 0.9])
def test_duffing_against_an_independent_integrator(where: float) -> None:
    zeta, c = 0.02, 2e5
    curve = response_curves(oscillator("cubic", zeta=zeta), [c], drive="x", at="x", levels=[8.0], band=(7, 20), harmonics=11)[0][0]
    z = curve.harmonic("x")
    i = int(np.searchsorted(np.maximum.accumulate(np.abs(z)), where * np.abs(z).max()))
    w = 2 * np.pi * curve.frequency[i]
    x0, v0 = curve.basis.at(np.zeros(1))[0] @ curve.coefficients[i, 0], w * (curve.basis.slope[0] @ curve.coefficients[i, 0])
    turns = 60
    t = np.linspace((turns - 1) * 2 * np.pi / w, turns * 2 * np.pi / w, 513)[:-1]
    done = solve_ivp(lambda s, y: [y[1], 8.0 * np.cos(w * s) - 2 * zeta * W0 * y[1] - W0**2 * y[0] - c * y[0] ** 3], (0, t[-1]), [x0, v0],
                     method="DOP853", rtol=1e-10, atol=1e-12, t_eval=t)
    assert 2 * np.abs(np.mean(done.y[0] * np.exp(-1j * w * t))) == pytest.approx(abs(z[i]), rel=1e-5)


def test_bouc_wen_against_its_differential_equation() -> None:
    a, b, gamma, delta, zeta = 2e3, 30.0, 0.8, -0.3, 0.01
    curve = response_curves(oscillator("bouc_wen", zeta=zeta, excess=False), [a, b, gamma, delta, 1.0], drive="x", at="x", levels=[12.0],
                            band=(7, 16), harmonics=9)[0][0]
    z1 = curve.harmonic("x")
    i = int(np.argmax(np.abs(z1)))
    w = 2 * np.pi * curve.frequency[i]

    def slope(s: float, y: Array) -> list[float]:
        x, v, z = y
        return [v, 12.0 * np.cos(w * s) - 2 * zeta * W0 * v - W0**2 * x - z, a * v - b * (gamma * abs(v) * z + delta * v * abs(z))]

    t = np.linspace(60 * 2 * np.pi / w, 61 * 2 * np.pi / w, 513)[:-1]
    done = solve_ivp(slope, (0, t[-1]), [0.0, 0.0, 0.0], rtol=1e-8, atol=1e-10, t_eval=t, max_step=0.02 / 10)
    assert curve.status == "ok"
    assert 2 * np.abs(np.mean(done.y[0] * np.exp(-1j * w * t))) == pytest.approx(abs(z1[i]), rel=3e-3)


def test_a_batch_gives_what_each_sample_gives_alone() -> None:
    theta = scattered(IWAN, 2)
    options = {"drive": "shaker", "at": "tip", "levels": [1.0, 8.0], "band": (18.0, 22.0)}
    together = response_curves(beam("iwan4_memory"), theta, **options)  # type: ignore[arg-type]
    for i in range(2):
        alone = response_curves(beam("iwan4_memory"), theta[i], **options)[0]  # type: ignore[arg-type]
        for one, other in zip(together[i], alone, strict=True):
            assert len(one.frequency) == len(other.frequency)
            assert one.peak("tip") == pytest.approx(other.peak("tip"), rel=1e-8)


def test_dry_friction_sticks_and_slides() -> None:
    """Den Hartog: above 4/π of the friction the fundamental force of Coulomb friction is 4 f/π whatever the amplitude."""
    friction, zeta = 0.2, 0.02
    curve = response_curves(oscillator("coulomb", zeta=zeta), [friction], drive="x", at="x", levels=[2.0], band=(5, 15))[0][0]
    assert curve.status == "ok"
    assert curve.peak("x")[1] == pytest.approx((2.0 - 4 * friction / np.pi) / (2 * zeta * W0**2), rel=5e-3)


def test_failure_is_a_status_and_what_was_found_stays() -> None:
    curve = response_curves(oscillator("cubic", zeta=0.001), [2e5], drive="x", at="x", levels=[50.0], band=(8, 200), most_points=30)[0][0]
    assert curve.status == "the band was not crossed in 30 points" and len(curve.frequency) == 30
    wild = response_curves(oscillator("cubic"), [[np.nan], [1.0]], drive="x", at="x", levels=[50.0], band=(8, 12))
    assert wild[0][0].status.startswith("no steady response") and len(wild[0][0].frequency) == 0 and wild[1][0].status == "ok"


@pytest.mark.parametrize(("change", "word"), [({"band": (0.0, 3.0)}, "band"), ({"levels": [0.0]}, "levels"), ({"drive": "y"}, "y"),
                                              ({"harmonics": 0}, "harmonics"), ({"at": "still"}, "still")])
def test_wrong_arguments_are_named(change: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        response_curves(oscillator(), np.zeros(0), **({"drive": "x", "at": "x", "levels": [1.0], "band": (5, 15)} | change))  # type: ignore[arg-type]
