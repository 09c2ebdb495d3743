"""The plant of the virtual beam against exact solutions, and against the package's force laws, which it does not use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from studies.virtual_beam import truth

import bayes_nlsid as nl
from bayes_nlsid.forces.motion import force_along, motion

VALUES = np.array([[2000.0, 1e8, -0.5, 0.1], [1500.0, 8e7, -0.3, 0.4]])


def plant(residual: float = 0.0) -> truth.Plant:
    """Two modes, two joints, two sensors."""
    omega, zeta = 2 * np.pi * np.array([78.0, 290.0]), np.array([5e-4, 1e-3])
    joints = np.array([[0.012, 0.008], [0.006, -0.01]])
    return truth.Plant(omega, zeta, joints, np.array([[-0.8, 0.5], [0.4, 0.3]]), np.array([-0.2, 0.4]), residual * np.eye(2),
                       0.1 * residual * np.ones((2, 2)), residual * np.ones(2) * 0.1, residual * np.ones(2))


def test_linear_decay_is_exact() -> None:
    own = plant()
    still = truth.Static(truth.Joint.of(VALUES * [1e14, 1, 1, 1]), 1)     # never slips: no excess force to speak of
    u0 = np.array([[1e-3, 2e-4]])
    got = truth.integrate(own, still, np.zeros((2000, 1)), 1 / 2048, u0=u0)
    w, z = own.omega, own.zeta
    damped = w * np.sqrt(1 - z**2)
    t = got.time[:, None]
    exact = u0 * np.exp(-z * w * t) * (np.cos(damped * t) + z * w / damped * np.sin(damped * t))
    assert np.abs(got.u[:, 0] - exact).max() < 1e-6 * np.abs(u0).max()


@pytest.mark.parametrize("residual", [0.0, 2e-9])
def test_second_order_in_the_step(residual: float) -> None:
    force = [truth.sweep(76.0, 79.0, 0.2, 0.25, 200.0, rate)[:, None] for rate in (4096, 8192, 16384, 32768)]
    runs = [truth.integrate(plant(residual), truth.Static(truth.Joint.of(VALUES), 1), F, 1 / rate, keep=rate // 4096).x
            for F, rate in zip(force, (4096, 8192, 16384, 32768), strict=True)]
    errors = [np.abs(x - runs[-1]).max() for x in runs[:-1]]
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3 and errors[2] < 1e-3 * np.abs(runs[-1]).max()


def test_laws_are_those_of_the_papers_table_and_of_masing() -> None:
    """The plant's own formulas and sliders meet the closed forms and the memory of the package."""
    q = 3e-5 * np.sin(np.linspace(0, 7, 400)) * np.linspace(0.2, 1.4, 400)
    joint = truth.Joint.of(VALUES[:1])
    static, memory = truth.Static(joint, 1), truth.Memory(joint, 1, sliders=120)
    p = VALUES[0]
    closed = nl.LIBRARY["iwan4"].static_force(q, 0 * q, p) - p[1] * q
    own = np.array([static.force(np.array([[x]]))[0][0, 0] for x in q])
    assert np.abs(own - closed).max() < 1e-9 * np.abs(closed).max()
    loop = force_along(nl.LIBRARY["iwan4_memory"], motion(q, np.gradient(q), 1.0), p) - p[1] * q
    slid = []
    for x in q:
        slid.append(memory.force(np.array([[x]]))[0][0, 0])
        memory.commit(np.array([[x]]))
    assert np.abs(np.array(slid) - loop).max() < 2e-3 * np.abs(loop).max()


def test_static_law_conserves_energy_and_memory_dissipates() -> None:
    own = plant()
    silent = replace(own, zeta=0 * own.zeta)
    u0 = np.array([[3e-3, 0.0]])
    peaks = []
    for law in (truth.Static, truth.Memory):
        got = truth.integrate(silent, law(truth.Joint.of(VALUES), 1), np.zeros((4096, 1)), 1 / 8192, u0=u0)
        peaks.append(np.abs(got.u[-400:, 0, 0]).max() / np.abs(got.u[:400, 0, 0]).max())
    assert abs(peaks[0] - 1) < 2e-3 and peaks[1] < 0.97


def test_truncation_keeps_modes_and_drops_the_rest() -> None:
    cut = plant(1e-9).truncated(1)
    assert cut.omega.shape == (1,) and cut.joints.shape == (2, 1) and not cut.G_jj.any() and not cut.G_sf.any()
