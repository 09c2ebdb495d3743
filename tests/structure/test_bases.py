"""Bases: what must be exact in each, and what each loses at the joints."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.structure.bases import attachment_modes, craig_bampton, serep
from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.modal_model import joint_flexibility_ratio, modal_model
from bayes_nlsid.structure.reduction import dynamic_flexibility, guyan, iirs, without_rigid_body
from bayes_nlsid.structure.structure import Structure, mac, modes

POINTS = tuple((f"P{i}", x) for i, x in enumerate(np.linspace(0, 0.72, 9)))


@pytest.fixture(scope="module")
def beam() -> Structure:
    return lapped_beam(LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7800, lap=(0.3, 0.42), stations=(0.33, 0.36, 0.39), tangential=1e8,
                                  normal=1e9, patch=0.02, element_size=0.015, points=POINTS))


@pytest.fixture(scope="module")
def masters(beam: Structure) -> np.ndarray:
    axial = np.zeros(beam.size)
    axial[beam.dofs.index("L1.u")] = 1.0
    return np.vstack([beam.rows([*(name for name, _ in POINTS), *beam.joints]), axial])


def test_serep_is_exact_for_its_modes_and_as_stiff_at_the_joints_as_they_are(beam: Structure, masters: np.ndarray) -> None:
    reduced = serep(beam, masters, 8, compare=8)
    exact, found = modes(beam, 8), reduced.modes(8)
    assert np.allclose(found.omega, exact.omega, rtol=1e-8) and found.rigid.shape[1] == 3
    assert np.allclose(np.diag(mac(exact.shapes, found.shapes, beam.M)), 1, atol=1e-9)
    # The coordinates are the masters' motion for whatever the modes can do.
    basis = np.hstack([exact.rigid, exact.shapes])
    assert np.allclose(reduced.T @ (masters @ basis), basis, atol=1e-8 * np.abs(basis).max())
    kept = joint_flexibility_ratio(beam, modal_model(beam, 8))
    assert np.allclose(1 - reduced.history[-1].joint_loss, kept, atol=1e-6) and kept.max() < 0.9


def test_craig_bampton_is_exact_in_statics_and_converges_with_its_modes(beam: Structure, masters: np.ndarray) -> None:
    bare = craig_bampton(beam, masters, 0)
    assert np.allclose(bare.T, guyan(beam, masters).T)
    worst = [craig_bampton(beam, masters, count).history[-1].worst for count in (0, 4, 12)]
    assert worst[0] > worst[1] > worst[2] and worst[2] < 0.015
    reduced = craig_bampton(beam, masters, 8)
    assert np.abs(reduced.history[-1].joint_loss).max() < 1e-6
    assert np.abs(masters @ reduced.T[:, len(masters):]).max() < 1e-9 * np.abs(reduced.T[:, len(masters):]).max()
    assert reduced.masters[-1] == "fixed8" and any("static flexibility of the joints lost" in note for note in reduced.notes)


def test_attachment_modes_carry_the_joint_and_leave_the_modes_alone(beam: Structure) -> None:
    plain, rich = attachment_modes(beam, 6, at=()), attachment_modes(beam, 6)
    assert plain.history[-1].joint_loss.min() > 0.1 and np.abs(rich.history[-1].joint_loss).max() < 1e-6
    assert np.allclose(rich.M, np.eye(rich.size), atol=1e-9)
    assert np.allclose(rich.modes(6).omega, modes(beam, 6).omega, rtol=1e-9)
    assert rich.masters[:4] == ("rigid1", "rigid2", "rigid3", "mode1") and rich.masters[-1] == f"static[{beam.joints[-1]}]"


def test_attachment_modes_follow_the_joints_dynamics_below_the_modes(beam: Structure) -> None:
    rows = beam.rows(beam.joints)
    exact = dynamic_flexibility(beam, rows, 20.0)
    rich = attachment_modes(beam, 6)
    b = rich.rows(beam.joints)
    own = b @ np.linalg.solve(rich.K - (2 * np.pi * 20.0) ** 2 * rich.M, b.T)
    assert np.abs(own - exact).max() < 1e-6 * np.abs(exact).max()


def test_rigid_motion_can_be_left_out(beam: Structure) -> None:
    free, held = attachment_modes(beam, 5), attachment_modes(beam, 5, rigid=False)
    assert held.rigid == 0 and held.size == free.size - 3
    assert np.allclose(held.modes(5).omega, without_rigid_body(free).modes(5).omega, rtol=1e-9)


def test_iterations_report_what_the_joint_loses(beam: Structure, masters: np.ndarray) -> None:
    history = iirs(beam, masters, iterations=3, tolerance=1e-12).history
    lost = np.array([step.joint_loss for step in history])
    assert np.abs(lost[0]).max() < 1e-6 and lost[1:].max() > 1e-3


def test_what_cannot_be_done_is_said(beam: Structure, masters: np.ndarray) -> None:
    with pytest.raises(ValueError, match="cannot follow 20 modes, 3 of them rigid"):
        serep(beam, masters, 17)
    with pytest.raises(ValueError, match="do not see"):
        serep(beam, masters[:-1], 4)                # nothing sees axial motion
    with pytest.raises(ValueError, match="rigid-body"):
        craig_bampton(beam, masters[:-1], 2)
    with pytest.raises(ValueError, match="already held"):
        attachment_modes(beam, 4, at=[beam.joints[0]] * 2)
