"""Beam elements against closed forms: Euler-Bernoulli roots, the Timoshenko pinned beam, exact mass, the solid limit of a lap."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.chains import oscillator, spring_mass_chain
from bayes_nlsid.structure.reduction import static_flexibility
from bayes_nlsid.structure.structure import Structure, mac, modes

STEEL = {"E": 2e11, "rho": 7800.0}
SLENDER = {"length": 1.0, "width": 0.02, "height": 0.002, **STEEL}


def euler_bernoulli(boundary: str, count: int) -> np.ndarray:
    """Roots βL of the frequency equation."""
    def equation(x: float) -> float:  # divided by cosh to stay of order one
        sign = {"free": -1.0, "clamped": -1.0, "clamped-free": 1.0}[boundary]
        return float(np.cos(x) + sign / np.cosh(x))
    start = 0 if boundary == "clamped-free" else 1
    return np.array([brentq(equation, np.pi * k + 0.0, np.pi * (k + 1)) for k in range(start, start + count)])


@pytest.mark.parametrize("boundary, rigid", [("free", 3), ("clamped-free", 0), ("clamped", 0)])
def test_slender_beam_has_euler_bernoulli_frequencies(boundary: str, rigid: int) -> None:
    found = modes(lapped_beam(LappedBeam(**SLENDER, boundary=boundary, element_size=0.02)), 4)
    bending_stiffness = 2e11 * 0.002**2 / 12 / 7800
    beta = np.sqrt(found.omega / np.sqrt(bending_stiffness))
    assert found.rigid.shape[1] == rigid
    np.testing.assert_allclose(beta, euler_bernoulli(boundary, 4), rtol=1e-4)


def timoshenko_pinned(beam: LappedBeam, mode: int) -> float:
    """Exact lower root for a simply supported Timoshenko beam, rad/s."""
    kappa = 10 * (1 + beam.nu) / (12 + 11 * beam.nu)
    G = beam.E / (2 * (1 + beam.nu))
    area, inertia, k = beam.width * beam.height, beam.width * beam.height**3 / 12, mode * np.pi / beam.length
    a = beam.rho**2 * inertia / (kappa * G)
    b = beam.rho * (area + inertia * k**2 * (1 + beam.E / (kappa * G)))
    return float(np.sqrt(2 * beam.E * inertia * k**4 / (b + np.sqrt(b**2 - 4 * a * beam.E * inertia * k**4))))


def test_thick_pinned_beam_converges_to_timoshenko_with_the_stated_error() -> None:
    errors = []
    for n in (8, 16, 32):
        beam = LappedBeam(0.5, 0.02, 0.1, **STEEL, boundary="pinned", element_size=0.5 / n)
        errors.append(modes(lapped_beam(beam), 1).omega[0] / timoshenko_pinned(beam, 1) - 1)
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 4.0, rtol=0.05)
    k, kappa, G = np.pi / 0.5, 10 * 1.3 / (12 + 3.3), 2e11 / 2.6
    predicted = 2e11 * 0.1**2 / 12 * k**2 / (kappa * G) * (k * 0.5 / 32) ** 2 / 24
    assert errors[-1] == pytest.approx(predicted, rel=0.25)


def test_slender_pinned_beam_converges_with_fourth_order() -> None:
    errors = []
    for n in (4, 8, 16):
        beam = LappedBeam(1.0, 0.02, 1e-4, **STEEL, boundary="pinned", element_size=1 / n)
        errors.append(modes(lapped_beam(beam), 2).omega[1] / timoshenko_pinned(beam, 2) - 1)
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 4.0, atol=0.1)
    assert errors[1] == pytest.approx((2 * np.pi / 8) ** 4 / 1440, rel=0.1)


def test_tip_deflection_of_a_cantilever_is_exact_with_one_element() -> None:
    beam = LappedBeam(0.3, 0.02, 0.05, **STEEL, boundary="clamped-free", element_size=1.0, points=(("TIP", 0.3),))
    structure = lapped_beam(beam)
    inertia, area = 0.02 * 0.05**3 / 12, 0.02 * 0.05
    exact = 0.3**3 / (3 * 2e11 * inertia) + 0.3 / (10 * 1.3 / 15.3 * 2e11 / 2.6 * area)
    assert static_flexibility(structure, structure.rows(["TIP"]))[0, 0] == pytest.approx(exact, rel=1e-9)


def lapped(size: float = 0.01, **changes: object) -> LappedBeam:
    given = {"length": 0.72, "width": 0.0254, "height": 0.0127, **STEEL, "element_size": size, "lap": (0.3, 0.42),
             "stations": (0.33, 0.36, 0.39), **changes}
    return LappedBeam(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize("direction", ["u", "w"])
def test_mass_is_exact(direction: str) -> None:
    beam = lapped(bolts=((0.33, 0.03), (0.36, 0.03), (0.39, 0.03)), masses=(("shaker", 0.1, 0.05),))
    assert lapped_beam(beam).mass(direction) == pytest.approx(0.72 * 0.0254 * 0.0127 * 7800 + 0.09 + 0.05, rel=1e-12)


def test_lap_with_very_stiff_springs_is_the_solid_beam() -> None:
    size = 0.005
    everywhere = tuple(0.3 + size * k for k in range(25))
    glued = modes(lapped_beam(lapped(size, stations=everywhere, tangential=1e13, normal=1e13, rotation=1e9)), 4)
    solid = modes(lapped_beam(lapped(size, lap=None, stations=())), 4)
    np.testing.assert_allclose(glued.omega, solid.omega, rtol=1e-5)
    assert glued.rigid.shape[1] == 3


def test_softer_joints_lower_every_frequency_and_three_rigid_modes_remain() -> None:
    previous = np.full(5, np.inf)
    for stiffness in (1e9, 1e8, 1e7, 1e6):
        found = modes(lapped_beam(lapped(tangential=stiffness, normal=stiffness)), 5)
        assert found.rigid.shape[1] == 3
        assert (found.omega <= previous * (1 + 1e-9)).all()
        previous = found.omega


def test_parts_add_up_and_joint_rows_are_relative() -> None:
    structure = lapped_beam(lapped(patch=0.02, rotation=1e4, bolts=((0.36, 0.03),)))
    np.testing.assert_allclose(sum(structure.K_parts.values()), structure.K, atol=1e-6 * np.abs(structure.K).max())
    np.testing.assert_allclose(sum(structure.M_parts.values()), structure.M, atol=1e-12)
    assert structure.joints == tuple(f"J{j}_{d}" for j in (1, 2, 3) for d in ("open", "rot", "slip"))
    rigid = modes(structure, 1).rigid
    motion = structure.rows(structure.joints) @ rigid
    assert np.abs(motion).max() < 1e-6 * np.abs(rigid).max()


def test_scaling_all_parts_scales_frequencies() -> None:
    structure = lapped_beam(lapped())
    stiffer = structure.scaled({name: 1.21 for name in structure.K_parts})
    np.testing.assert_allclose(modes(stiffer, 5).omega, 1.1 * modes(structure, 5).omega, rtol=1e-8)
    heavier = structure.scaled({name: 4.0 for name in structure.M_parts})
    np.testing.assert_allclose(modes(heavier, 5).omega, 0.5 * modes(structure, 5).omega, rtol=1e-8)


@pytest.mark.parametrize("changes, word", [({"length": -1.0}, "length"), ({"stations": (0.1,)}, "stations"), ({"normal": (1e8,)}, "normal"),
                                           ({"boundary": "glued"}, "boundary"), ({"sensors": (("A", 0.9),)}, "positions"),
                                           ({"sensors": (("A", 0.1), ("A", 0.2))}, "two positions")])
def test_wrong_beams_are_refused_in_words(changes: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        lapped_beam(lapped(**changes))


def test_large_and_small_solvers_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.sparse import csr_array

    structure = lapped_beam(lapped(0.003, sensors=(("S1", 0.02),)))
    sparse = Structure(csr_array(structure.M), csr_array(structure.K), structure.dofs, structure.locations)
    small = modes(structure, 6)
    monkeypatch.setattr("bayes_nlsid.structure.structure.DENSE_LIMIT", 10)
    large = modes(sparse, 6)
    np.testing.assert_allclose(large.omega, small.omega, rtol=1e-7)
    np.testing.assert_allclose(np.diag(mac(large.shapes, small.shapes)), 1.0, atol=1e-8)
    assert large.rigid.shape[1] == small.rigid.shape[1] == 3


def test_oscillator_and_chain_are_the_same_structure() -> None:
    model = oscillator(mass=2.0, stiffness=5e4, damping=10.0)
    assert model.omega[0] == pytest.approx(np.sqrt(2.5e4)) and model.zeta[0] == pytest.approx(10 / (2 * np.sqrt(2 * 5e4)))
    assert model.shapes[0, 0] == pytest.approx(2**-0.5)
    assert modes(spring_mass_chain([2.0], [5e4]), 1).omega[0] == pytest.approx(model.omega[0])
    chain = modes(spring_mass_chain([1.0] * 5, [1.0] * 6, ends="fixed-fixed"), 5)
    np.testing.assert_allclose(chain.omega, 2 * np.sin(np.arange(1, 6) * np.pi / 12), rtol=1e-10)
    free = modes(spring_mass_chain([1.0] * 5, [1.0] * 4, ends="free-free"), 5)
    assert free.rigid.shape[1] == 1
    np.testing.assert_allclose(free.omega, 2 * np.sin(np.arange(1, 5) * np.pi / 10), rtol=1e-9)


@pytest.mark.parametrize("M, K, word", [
    (np.eye(2), np.array([[1.0, 2.0], [0.0, 1.0]]), "not symmetric"), (np.diag([1.0, 0.0]), np.eye(2), "not positive definite"),
    (1e-9 * np.eye(2), 1e308 * np.eye(2), "leaves the range of numbers"),
    (np.eye(2), np.diag([1.0, -0.1]), "negative eigenvalues"), (np.eye(2), np.diag([1.0, np.nan]), "NaN"), (np.eye(3), np.eye(2), "shape")])
def test_bad_matrices_are_refused_in_words(M: np.ndarray, K: np.ndarray, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        Structure(M, K, ("a", "b"), {})
