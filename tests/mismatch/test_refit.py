"""The linear model fitted with free participations, and the corrections of the channels that any simulation allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.signal import StateSpace, lsim

from bayes_nlsid.mismatch.campaign import Campaign, Trial
from bayes_nlsid.mismatch.case import CLASSES
from bayes_nlsid.mismatch.recorded import start_of
from bayes_nlsid.mismatch.refit import refitted
from bayes_nlsid.mismatch.seen import charge, corrected, unseen
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
M, K = np.diag([1.0, 1.5]), np.array([[9000.0, -4000.0], [-4000.0, 7000.0]])
ZETA = np.array([0.006, 0.02])


def modes() -> tuple[Array, Array]:
    w2, shapes = eigh(K, M)
    return np.sqrt(w2), shapes


def recorded(decay: bool) -> Recording:
    """Displacements of two masses by the matrix exponential of the true system."""
    omega, shapes = modes()
    C = M @ shapes @ np.diag(2 * ZETA * omega) @ shapes.T @ M
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    system = StateSpace(A, np.concatenate([np.zeros(2), np.linalg.solve(M, [1.0, 0.0])])[:, None], np.eye(2, 4), np.zeros((2, 1)))
    t = np.arange(2400) / 200.0
    rng = np.random.default_rng(5)
    force = np.zeros(len(t)) if decay else np.convolve(rng.standard_normal(len(t)), np.hanning(9), "same")
    _, y, _ = lsim(system, force, t, X0=[0.0, 0.0, 1.0, -0.4] if decay else [0.0] * 4)
    channels = (Channel("a", "a", "displacement", "m"), Channel("b", "b", "displacement", "m"))
    inputs = () if decay else (Channel("force", "a", "force", "N"),)
    return Recording("run", 1 / 200.0, y, channels, force[:, None][:, :len(inputs)], inputs)


def campaign(record: Recording, off: float) -> Campaign:
    omega, shapes = modes()
    model = ModalModel(off * omega, 2 * ZETA, ("a", "b"), shapes, ("a", "b"), ("a",), ("a",))
    trial = Trial(record, "fit", 1e-6 * record.response.std(axis=0), "known", 1.0)
    return Campaign("two masses", model, model, (trial,), ("a",), CLASSES, top=60.0)


def test_frequencies_and_damping_are_found_from_some_per_cent_away() -> None:
    for decay in (True, False):
        one = campaign(recorded(decay), 1.04)
        found = refitted(one, start_of(one))
        assert np.allclose(found.modal.omega, modes()[0], rtol=1e-3)
        assert np.allclose(found.modal.zeta, ZETA, rtol=0.08)   # drawn a little towards the double that was stated


def test_a_rigid_body_is_left_alone() -> None:
    record = recorded(False)
    rigid = ModalModel(np.array([1e-4]), np.array([0.0]), ("a", "b"), np.ones((2, 1)), ("a", "b"), ("a",), ("a",))
    one = replace(campaign(record, 1.0), nominal=rigid, start=rigid)
    start = start_of(one)
    assert refitted(one, start) is start


def test_errors_of_mode_shapes_are_recovered_and_cost_what_they_are_worth() -> None:
    rng = np.random.default_rng(2)
    omega, shapes = modes()
    model = ModalModel(omega, ZETA, ("a", "b"), shapes, ("a", "b"), ("a",), ("a",))
    record = recorded(False)
    motion = rng.standard_normal((record.n, 1, 2))
    wrong = 0.03 * np.array([[1.0, -1.0], [0.5, 1.0]])
    seen = replace(unseen(model, [record]), shapes=wrong, direct=np.array([[0.2], [0.0]]), constant=np.array([0.1, 0.0]))
    told = replace(record, response=seen.wave(model, record, motion))
    again = corrected(model, [told], [np.ones_like(told.response)], [motion])
    assert np.allclose(again.shapes, wrong, atol=1e-4) and np.allclose(again.direct, seen.direct, atol=1e-4)
    assert np.allclose(again.constant, seen.constant, atol=1e-4)
    assert np.allclose(charge(model, unseen(model, [record])), 0.0) and (charge(model, again) ** 2).sum() > 0
