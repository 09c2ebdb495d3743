"""Laws and time stepping of the truth generator against an adaptive eighth-order reference and first principles."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from studies.concealed.truth import catalogue
from studies.concealed.truth.campaign import FS, Local, Truth, draw_campaign
from studies.concealed.truth.catalogue import Place
from studies.concealed.truth.kernels import MEMORY, law
from studies.concealed.truth.modes import Plant, _poles
from studies.concealed.truth.response import Law, drive, local_forces, steady

W = 2 * np.pi * np.array([60.0, 170.0, 420.0])
OUT = np.array([1.0, -0.8, 0.5])
IN = np.array([0.7, 0.9, -0.6])
C = np.diag(2 * 0.02 * W) + 0.5 * np.outer(OUT, OUT)


def small_plant() -> Plant:
    """Three modes with non-proportional damping; place ``J`` and shaker ``SHAKER``, sensor ``S1`` on the joint."""
    poles, right, left = _poles(W**2, C)
    rows = {"J": OUT, "S1": OUT, "SHAKER": IN}
    return Plant(
        poles, {k: v @ right[:3] for k, v in rows.items()}, {k: left[:, 3:] @ v for k, v in rows.items()}, W / 2 / np.pi, np.full(3, 0.02)
    )


def tones(t):
    return sum(np.sin(2 * np.pi * f * t + p) for f, p in ((37.0, 0.3), (81.0, 1.9), (163.0, 4.0), (311.0, 2.2)))


LAWS = {
    "sinh": (1, (4e4, 2e-5)),
    "root_loss": (10, (9e4, 1e-5)),
    "rounded_stop": (20, (3e5, 1.5e-5, 0.08)),
    "rational_friction": (33, (0.4, 5e-3)),
    "late_damping": (42, (60.0, 5e-3, 0.4)),
}


@pytest.mark.parametrize("name", LAWS)
def test_local_force_follows_an_adaptive_eighth_order_reference(name):
    kind, values = LAWS[name]
    p = np.array([*values, *([0.0] * (8 - len(values)))])
    scratch = np.zeros(MEMORY), np.zeros(MEMORY)

    def rhs(t, y):
        d, v = OUT @ y[:3], OUT @ y[3:]
        f = -law(kind, p, d, v, 0.0, 1.0, *scratch)
        return np.r_[y[3:], -(W**2) * y[:3] - C @ y[3:] + OUT * f + IN * tones(t) * min(t / 0.02, 1.0)]

    rate, end = 16384.0, 0.08
    time = np.arange(int(end * rate)) / rate
    reference = solve_ivp(rhs, (0, end), np.zeros(6), "DOP853", t_eval=time, rtol=1e-8, atol=1e-12, max_step=1e-3).y
    wanted = np.array([-law(kind, p, d, v, 0.0, 1.0, *scratch) for d, v in zip(OUT @ reference[:3], OUT @ reference[3:], strict=True)])
    linear = solve_ivp(
        lambda t, y: np.r_[y[3:], -(W**2) * y[:3] - C @ y[3:] + IN * tones(t) * min(t / 0.02, 1.0)],
        (0, end),
        np.zeros(6),
        "DOP853",
        t_eval=time,
        rtol=1e-8,
        atol=1e-12,
        max_step=1e-3,
    ).y
    got = local_forces(small_plant(), (Law("J", kind, tuple(p)),), (OUT @ linear[:3])[:, None], (OUT @ linear[3:])[:, None], rate)[:, 0]
    assert np.std(wanted) > 0.02
    assert np.std(got - wanted) < 5e-3 * np.std(wanted)


def test_response_from_rest_and_steady_response_agree_after_the_transient():
    plant, period = small_plant(), 0.5
    time = np.arange(int(period * FS)) / FS
    wave = sum(np.sin(2 * np.pi * f * time + f) for f in (24.0, 82.0, 166.0))
    long = drive(plant, np.tile(wave, 12)[:, None], FS, ["S1"], ["SHAKER"], FS, 2)[:, 0]
    once = steady(plant, wave, FS, ["S1"], "SHAKER", FS, 2)[:, 0]
    last = long.reshape(12, -1)[10]
    assert np.std(last - once) < 2e-3 * np.std(once)


def test_response_from_rest_is_causal_and_does_not_wrap_around():
    force = np.zeros((int(4 * FS), 1))
    force[int(2 * FS) : int(2.5 * FS), 0] = np.hanning(int(0.5 * FS)) * np.sin(2 * np.pi * 90 * np.arange(int(0.5 * FS)) / FS)
    y = drive(small_plant(), force, FS, ["S1"], ["SHAKER"], FS, 2)[:, 0]
    assert np.abs(y[: int(1.98 * FS)]).max() < 1e-3 * np.abs(y).max()


def test_steady_records_repeat_and_tuned_strength_is_what_the_record_shows():
    plant = small_plant()
    campaign = draw_campaign(np.random.default_rng(3), False, False)
    entry = next(e for e in campaign.entries if e.name == "high_1")
    force = campaign.force(entry)
    d = np.std(steady(plant, force, FS, ["J"], "SHAKER", FS, 0))
    truth = Truth(plant, (Local(Law("J", 2, (6e4, float(d), 0, 0, 0, 0, 0, 0))),), (), 1, 0)
    _, accel = truth.clean(campaign, entry)
    _, plain = Truth(plant, (), (), 1, 0).clean(campaign, entry)
    periods = accel[:, 0].reshape(3, -1)
    assert np.std(accel - plain) > 0.02 * np.std(plain)
    assert np.std(periods[2] - periods[0]) < 1e-3 * np.std(periods[0])


def loop(kind, p, path):
    old, force = np.zeros(MEMORY), []
    for d in path:
        new = old.copy()
        force.append(law(kind, p, d, 0.0, 0.0, 1e-4, old, new))
        old = new
    return np.array(force)


@pytest.mark.parametrize("kind,shape", [(50, 0.2), (51, 1.5), (52, 1.5), (53, 0.5)])
def test_memory_laws_dissipate_and_depend_on_history(kind, shape):
    p = np.array([1e5, 1e-5, shape, 0.7, 0, 0, 0, 0.0])
    phase = np.linspace(0, 4 * np.pi, 8001)
    path = 3e-5 * np.sin(phase)
    force = loop(kind, p, path)
    second = phase >= 2 * np.pi
    assert np.trapezoid(force[second], path[second]) > 0.1 * np.ptp(force) * np.ptp(path) * 0.2
    up, down = np.argmin(np.abs(phase - 2 * np.pi)), np.argmin(np.abs(phase - 3 * np.pi))
    assert force[up] > 0.1 * force.max() and force[down] < -0.1 * force.max()
    small = 1e-8 * np.sin(phase)
    assert loop(kind, p, small) == pytest.approx(1e5 * small, rel=0.1, abs=1e-4 * 1e5 * 1e-8 * 1e2)


@pytest.mark.parametrize("cls", ["coulomb", "quad_damping"])
def test_velocity_laws_resist_motion(cls):
    for seed in range(8):
        f = catalogue.draw_formula(cls, np.random.default_rng(seed), Place("J1_slip", 1e-6, 1e-3, 1e6, 1e6), False)
        p = np.array(f.build(f.start))
        v = np.linspace(-5e-3, 5e-3, 41)
        force = np.array([law(f.kind, p, 0.0, x, 0.0, 1e-4, np.zeros(MEMORY), np.zeros(MEMORY)) for x in v])
        assert np.all(force * v >= 0) and force[-1] > 0


@pytest.mark.parametrize("cls,sign", [("hardening", 1.0), ("softening", -1.0)])
def test_elastic_laws_bend_the_way_their_class_says_and_vanish_at_small_amplitude(cls, sign):
    for seed in range(8):
        f = catalogue.draw_formula(cls, np.random.default_rng(seed), Place("J1_slip", 1e-6, 1e-3, 1e6, 1e6), False)
        p = np.array(f.build(f.start))
        d = np.array([1e-9, 1e-6, 3e-6])
        secant = np.array([law(f.kind, p, x, 0.0, 0.0, 1e-4, np.zeros(MEMORY), np.zeros(MEMORY)) for x in d]) / d
        assert sign * secant[2] > sign * secant[1] > 0 and abs(secant[0]) < 0.02 * abs(secant[2])


def test_every_class_has_several_formulas():
    names = {
        cls: {catalogue.draw_formula(cls, np.random.default_rng(s), Place("J1_slip", 1e-6, 1e-3, 1e6, 1e6), False).name for s in range(60)}
        for cls in catalogue.NONLINEAR
    }
    assert all(len(v) >= 3 for v in names.values())
