"""Finite elements and complex modes of the truth generator against analytic beams and direct solutions."""

import numpy as np
import pytest
import scipy.linalg as la
from studies.concealed.truth.beams import Beam, Joint, Layout, Mesh, Point, assemble, element
from studies.concealed.truth.draw import draw_scenery
from studies.concealed.truth.effects import Mod, modified
from studies.concealed.truth.modes import plant

E, RHO, WIDTH, HEIGHT, LENGTH = 70e9, 2700.0, 0.04, 0.008, 0.5


def one_beam(mesh, root_fix=1e12, root_rot=1e9, tip_w=0.0, height=HEIGHT):
    beam = Beam("A", 0.0, LENGTH, ((0.0, height),), E, RHO)
    layout = Layout((beam,), WIDTH, (), root_fix, root_rot, tip_w, 0.0, (Point(0, LENGTH),), Point(0, 0.2), 0.0)
    return assemble(layout, mesh)


def two_beams(mesh=None):
    a = Beam("A", 0.0, 0.4, ((0.0, 0.008),), E, RHO)
    b = Beam("B", 0.25, 0.4, ((0.25, 0.007),), E, RHO)
    joints = (Joint(0.28, 0, 4e6, 6e6, 30.0), Joint(0.36, 0, 3e6, 5e6, 50.0))
    layout = Layout((a, b), WIDTH, joints, 1e9, 2e4, 5e4, 0.1, (Point(0, 0.1), Point(1, 0.5), Point(1, 0.6)), Point(0, 0.2), 0.003)
    return assemble(layout, mesh or Mesh(0.02, "timoshenko", "consistent"))


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_clamped_free_beam_has_the_analytic_frequencies(mass):
    model = one_beam(Mesh(0.01, "euler", mass))
    w = np.sqrt(la.eigh(model.K, model.M, eigvals_only=True)[:4])
    inertia, area = WIDTH * HEIGHT**3 / 12, WIDTH * HEIGHT
    exact = np.array([1.8751041, 4.6940911, 7.8547574, 10.9955407]) ** 2 * np.sqrt(E * inertia / (RHO * area)) / LENGTH**2
    # Rotary inertia and lumping lower the fourth frequency by up to 0.3 %.
    assert w == pytest.approx(exact, rel=4e-3)
    assert w[0] == pytest.approx(exact[0], rel=3e-4)


def test_timoshenko_tip_deflection_is_bending_plus_shear():
    height = 0.08  # stubby, so that shear matters
    model = one_beam(Mesh(0.1, "timoshenko", "consistent"), root_fix=1e15, root_rot=1e13, height=height)
    tip = la.solve(model.K, model.vectors["TIP_w"], assume_a="sym") @ model.vectors["TIP_w"]
    inertia, area, G = WIDTH * height**3 / 12, WIDTH * height, E / 2.6
    assert tip == pytest.approx(LENGTH**3 / (3 * E * inertia) + LENGTH / (5 / 6 * G * area), rel=1e-6)


def test_timoshenko_frequencies_fall_below_euler_as_theory_says():
    height = 0.05
    w = [
        np.sqrt(la.eigh(m.K, m.M, eigvals_only=True)[1])
        for m in (one_beam(Mesh(0.01, t, "consistent"), 1e14, 1e12, height=height) for t in ("euler", "timoshenko"))
    ]
    # First order in (k r)^2 for the second clamped-free mode, local wave number from the Euler beam.
    k2 = (4.694 / LENGTH) ** 2 * height**2 / 12
    assert 0.5 * k2 * 2.6 / (5 / 6) < 1 - w[1] / w[0] < 2.5 * k2 * 2.6 / (5 / 6)


@pytest.mark.parametrize("theory", ["euler", "timoshenko"])
@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_element_moves_rigidly_without_force_and_has_its_mass(theory, mass):
    L = 0.03
    k, m = element(L, E, RHO, WIDTH, HEIGHT, Mesh(L, theory, mass))
    across, along, turn = np.array([0, 1, 0, 0, 1, 0.0]), np.array([1, 0, 0, 1, 0, 0.0]), np.array([0, 0, 1, 0, L, 1.0])
    assert np.abs(k @ np.array([across, along, turn]).T).max() < 1e-9 * np.abs(k).max()
    total = RHO * WIDTH * HEIGHT * L
    assert across @ m @ across == pytest.approx(total)
    assert along @ m @ along == pytest.approx(total)
    if mass == "consistent":
        assert turn @ m @ turn == pytest.approx(total * L**2 / 3 + RHO * WIDTH * HEIGHT**3 / 12 * L)


def test_parts_sum_to_the_matrices():
    model = two_beams()
    assert np.sum(list(model.K_parts.values()), axis=0) == pytest.approx(model.K)
    attached = model.M - np.sum(list(model.M_parts.values()), axis=0)
    assert np.trace(attached) == pytest.approx(2 * (0.1 + 3 * 0.003))


def dynamic_stiffness(model, omega, C):
    return model.K - omega**2 * model.M + 1j * omega * C


def test_complex_modes_reproduce_the_direct_response_with_local_dashpots():
    model = two_beams()
    base = plant(model, lambda f: np.zeros_like(f) + 1e-12, cutoff=6000.0)
    C = sum(c * np.outer(model.vectors[n], model.vectors[n]) for n, c in model.dashpots.items())
    outs, ins = ["S1", "S3", "J1_slip"], ["SHAKER", "J2_open"]
    for hz in (30.0, 210.0, 760.0):
        direct = np.array(
            [[model.vectors[o] @ la.solve(dynamic_stiffness(model, 2 * np.pi * hz, C), model.vectors[i]) for i in ins] for o in outs]
        )
        got = base.receptance(outs, ins, np.array([2j * np.pi * hz]))[0]
        assert np.abs(got - direct).max() < 2e-3 * np.abs(direct).max()


def test_floor_motion_enters_as_the_relative_equation_says():
    model = two_beams()
    base = plant(model, lambda f: np.full_like(f, 1e-9), dashpots={})
    for hz in (40.0, 300.0):
        omega = 2 * np.pi * hz
        direct = la.solve(dynamic_stiffness(model, omega, np.zeros_like(model.K)), -model.M @ model.vectors["BASE"])
        got = base.receptance(["S3"], ["BASE"], np.array([1j * omega]))[0, 0, 0]
        assert abs(got - model.vectors["S3"] @ direct) < 5e-3 * abs(model.vectors["S3"] @ direct)


def test_added_mass_and_resonator_equal_their_rank_one_formula():
    model, omega, point = two_beams(), 2 * np.pi * 240.0, "P2"
    b = model.vectors[point]
    receptance = np.linalg.inv(dynamic_stiffness(model, omega, np.zeros_like(model.K)))
    mass, k = 0.02, 0.02 * (2 * np.pi * 180.0) ** 2
    built, C = modified(model, (Mod("resonator", point, mass, ((mass, 180.0, 0.01),)),))
    spring = k + 1j * omega * C[-1, -1].real
    kappa = spring - spring**2 / (spring - omega**2 * mass)
    expected = receptance @ b - receptance @ b * (kappa * (b @ receptance @ b)) / (1 + kappa * (b @ receptance @ b))
    got = la.solve(dynamic_stiffness(built, omega, C), built.vectors[point])[:-1]
    assert got == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max())
    heavy, none = modified(model, (Mod("mass", point, mass),))
    assert none is None
    assert np.trace(heavy.M - model.M) == pytest.approx(2 * mass)


def test_truth_parameters_scatter_by_the_stated_tolerances():
    z = []
    for seed in range(60):
        s = draw_scenery(np.random.default_rng(seed), 4, False, seed % 2 == 0)
        sd = {"E_": s.tolerances.E_rel_sd, "rh": s.tolerances.rho_rel_sd, "ro": s.tolerances.root_fix_log_sd}
        z += [np.log(v) / sd.get(k[:2], s.tolerances.joint_stiffness_log_sd) for k, v in s.factors.items()]
        assert s.nominal != s.truth and (s.nominal_mesh.theory != s.truth_mesh.theory)
        for i, joint in enumerate(s.nominal.joints, start=1):
            assert s.truth.joints[i - 1].k_slip == pytest.approx(joint.k_slip * s.factors[f"J{i}_slip"])
    assert np.std(z) == pytest.approx(1.0, abs=0.12) and abs(np.mean(z)) < 0.12


def test_hidden_joints_have_no_sensor_near():
    for seed in range(20):
        s = draw_scenery(np.random.default_rng(seed), 5, True, False).nominal
        laps = [(s.beams[i + 1].x0, s.beams[i].x1) for i in range(len(s.beams) - 1)]
        assert not any(a < p.x < b for p in s.sensors for a, b in laps)
