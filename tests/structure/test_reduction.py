"""Reduction: identities that hold exactly, convergence, the rank guard, and what a basis loses at the joints."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.chains import spring_mass_chain
from bayes_nlsid.structure.modal_model import joint_flexibility_ratio, modal_model
from bayes_nlsid.structure.reduction import dynamic_flexibility, guyan, iirs, static_flexibility, without_rigid_body
from bayes_nlsid.structure.structure import Structure, modes

POINTS = tuple((f"P{i}", x) for i, x in enumerate(np.linspace(0, 0.72, 9)))


@pytest.fixture(scope="module")
def beam() -> Structure:
    return lapped_beam(LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7800, lap=(0.3, 0.42), stations=(0.33, 0.36, 0.39), tangential=1e8,
                                  normal=1e9, patch=0.02, element_size=0.015, points=POINTS, sensors=(("S1", 0.0254), ("S2", 0.6))))


@pytest.fixture(scope="module")
def masters(beam: Structure) -> tuple[str, ...]:
    """Transverse points, relative joint motions that are averages over patches, and one axial motion to see that rigid mode."""
    return (*(name for name, _ in POINTS), *beam.joints)


def with_axial(structure: Structure, names: tuple[str, ...]) -> np.ndarray:
    axial = np.zeros(structure.size)
    axial[structure.dofs.index("L1.u")] = 1.0
    return np.vstack([structure.rows(names), axial])


def test_reduction_to_all_degrees_of_freedom_changes_nothing() -> None:
    chain = spring_mass_chain([1.0, 2.0, 3.0, 1.0], [10.0, 20.0, 30.0], ends="free-free")
    full = guyan(chain, chain.sensors)
    np.testing.assert_allclose(full.T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(full.K, chain.K, atol=1e-10)
    assert full.history[-1].worst < 1e-10


def test_masters_that_are_averages_keep_their_meaning_at_every_iteration(beam: Structure, masters: tuple[str, ...]) -> None:
    A = with_axial(beam, masters)
    for iterations in (0, 1, 4):
        reduced = iirs(beam, A, iterations=iterations, tolerance=1e-12)
        np.testing.assert_allclose(A @ reduced.T, np.eye(len(A)), atol=1e-9)


def test_guyan_equals_the_textbook_partition(beam: Structure) -> None:
    keep = np.array([beam.dofs.index(name) for name in ("L1.u", "L1.w", "L20.w", "R10.w", "R20.w")])
    rest = np.setdiff1d(np.arange(beam.size), keep)
    T = guyan(beam, np.eye(beam.size)[keep]).T
    np.testing.assert_allclose(T[rest], -np.linalg.solve(beam.K[np.ix_(rest, rest)], beam.K[np.ix_(rest, keep)]), atol=1e-6)


def test_frequency_errors_fall_with_each_iteration_and_stay_upper_bounds(beam: Structure, masters: tuple[str, ...]) -> None:
    reduced = iirs(beam, with_axial(beam, masters), iterations=6, tolerance=1e-12, compare=5)
    worst = [step.worst for step in reduced.history]
    assert len(worst) == 7 and worst[0] > 0.005
    assert all(later <= earlier * 1.0001 for earlier, later in zip(worst[:-1], worst[1:], strict=True))
    assert worst[-1] < 0.05 * worst[0]
    assert all((step.frequency_error > -1e-7).all() for step in reduced.history)


def test_stops_as_soon_as_the_modes_are_met(beam: Structure, masters: tuple[str, ...]) -> None:
    reduced = iirs(beam, with_axial(beam, masters), iterations=20, tolerance=0.01, compare=5)
    assert reduced.status == "ok" and len(reduced.history) < 6
    assert reduced.history[-1].worst <= 0.01 and reduced.history[-1].mac.min() >= 0.95
    missed = guyan(beam, with_axial(beam, ("P0", "P3", "P5", "P8")), compare=2)
    assert missed.status.startswith("modes not met") and "Hz" in missed.status


def test_guyan_keeps_the_joints_flexibility_and_iterations_lose_it(beam: Structure, masters: tuple[str, ...]) -> None:
    A, joints = with_axial(beam, masters), beam.joints
    exact = np.diag(static_flexibility(beam, beam.rows(joints)))

    def share(iterations: int) -> np.ndarray:
        reduced = iirs(beam, A, iterations=iterations, tolerance=1e-12)
        free = Structure(reduced.M, reduced.K, reduced.masters, {n: r for n, r in zip(joints, reduced.rows(joints), strict=True)})
        return np.diag(static_flexibility(free, free.rows(joints))) / exact

    np.testing.assert_allclose(share(0), 1.0, rtol=1e-3)
    assert (share(5) < share(0) + 1e-3).all() and share(5).min() < 0.995


def test_masters_blind_to_a_rigid_motion_are_refused_and_the_guard_holds_it(beam: Structure, masters: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="2 of 3 rigid-body modes"):
        iirs(beam, masters)
    held = iirs(beam, masters, guard="constrain", compare=4)
    assert held.modes(4).rigid.shape[1] == 2
    axial = np.array([name.endswith(".u") for name in beam.dofs], dtype=float)
    assert np.abs(axial @ (beam.M @ held.T)).max() < 1e-9
    np.testing.assert_allclose(held.modes(3).omega, modes(beam, 3).omega, rtol=0.01)


def test_dependent_or_unknown_masters_are_refused(beam: Structure) -> None:
    with pytest.raises(ValueError, match="dependent"):
        guyan(beam, np.vstack([np.eye(beam.size)[:2], np.eye(beam.size)[:1]]))
    with pytest.raises(ValueError, match="unknown locations"):
        guyan(beam, ("nowhere",))


def test_rigid_body_removal_leaves_elastic_frequencies(beam: Structure, masters: tuple[str, ...]) -> None:
    reduced = iirs(beam, with_axial(beam, masters), iterations=2)
    elastic = without_rigid_body(reduced)
    assert elastic.size == reduced.size - 3
    count = reduced.size - 3
    np.testing.assert_allclose(elastic.modes(count).omega, reduced.modes(count).omega, rtol=1e-7)
    assert elastic.modes(1).rigid.shape[1] == 0


def test_sparse_matrices_give_the_same_reduction(beam: Structure, masters: tuple[str, ...]) -> None:
    from scipy.sparse import csr_array

    sparse = Structure(csr_array(beam.M), csr_array(beam.K), beam.dofs, beam.locations)
    A = with_axial(beam, masters)
    np.testing.assert_allclose(iirs(sparse, A, iterations=2).T, iirs(beam, A, iterations=2).T, atol=1e-6)


def test_static_flexibility_is_the_sum_over_all_elastic_modes() -> None:
    chain = spring_mass_chain([1.0, 2.0, 3.0, 1.0], [10.0, 20.0, 30.0], ends="free-free")
    every = modes(chain, 10)
    rows = chain.rows(("S1", "S3", "J2"))
    shapes = rows @ every.shapes
    np.testing.assert_allclose(static_flexibility(chain, rows), (shapes / every.omega**2) @ shapes.T, atol=1e-12)
    fixed = spring_mass_chain([1.0, 1.0], [4.0, 2.0])
    assert static_flexibility(fixed, fixed.rows(["S2"]))[0, 0] == pytest.approx(1 / 4 + 1 / 2)


def test_modal_model_and_residual_reproduce_the_full_flexibility(beam: Structure) -> None:
    model = modal_model(beam, 6, zeta=0.002)
    names = ("S1", "J1_slip", "J2_slip")
    shapes = model.rows(names)
    frequency = 0.05 * model.frequency[0]
    omega2 = (2 * np.pi * frequency) ** 2
    rigid = beam.rows(names) @ modes(beam, 1).rigid
    assert model.residual is not None
    place = [model.locations.index(n) for n in names]
    parts = (shapes / (model.omega**2 - omega2)) @ shapes.T - rigid @ rigid.T / omega2 + model.residual[np.ix_(place, place)]
    np.testing.assert_allclose(parts, dynamic_flexibility(beam, beam.rows(names), frequency), rtol=1e-4)
    assert any("rigid-body modes removed" in note for note in model.notes)


def test_few_modes_carry_little_of_the_joints_flexibility_and_say_so(beam: Structure) -> None:
    few, many = modal_model(beam, 4), modal_model(beam, 40)
    low, high = joint_flexibility_ratio(beam, few), joint_flexibility_ratio(beam, many)
    assert (low <= high + 1e-9).all() and (high <= 1 + 1e-6).all() and low.min() < 0.6
    assert any("static flexibility carried by the 4 modes" in note for note in few.notes)


def test_modal_model_of_a_reduced_structure(beam: Structure, masters: tuple[str, ...]) -> None:
    reduced = iirs(beam, with_axial(beam, masters), iterations=3, tolerance=1e-9)
    small, full = modal_model(reduced, 4), modal_model(beam, 4)
    np.testing.assert_allclose(small.omega, full.omega, rtol=1e-3)
    np.testing.assert_allclose(np.abs(small.rows(("S1", "J1_slip"))), np.abs(full.rows(("S1", "J1_slip"))), rtol=0.05, atol=1e-4)
    assert any("iirs, 3 iterations" in note for note in small.notes)
    with pytest.raises(ValueError, match="zeta"):
        modal_model(beam, 3, zeta=[0.1, 0.2])
    np.testing.assert_allclose(modal_model(beam, [0, 2]).omega, full.omega[[0, 2]], rtol=1e-9)
