"""Damping and measured frequencies in the modal model, and the pairing behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.structure.chains import spring_mass_chain
from bayes_nlsid.structure.identified import IdentifiedModes, pair
from bayes_nlsid.structure.modal_model import modal_model, with_damping
from bayes_nlsid.structure.structure import mac, modes

CHAIN = spring_mass_chain([1.0, 1.0, 1.0, 2.0], [1e5, 2e5, 1e5, 3e5])


def measured(indices: list[int], factor: float = 1.02) -> IdentifiedModes:
    found = modes(CHAIN, 4)
    m = len(indices)
    shapes = CHAIN.rows(CHAIN.sensors) @ found.shapes[:, indices]
    shapes = shapes / np.abs(shapes).max(axis=0)
    zeta = 0.01 * (1 + np.arange(m))
    return IdentifiedModes(factor * found.frequency[indices], zeta, shapes, CHAIN.sensors, CHAIN.sensors, tuple(indices), np.full(m, 0.1),
                           0.1 * zeta, np.full(shapes.shape, 0.01), np.zeros(m), np.ones(m), ((0.0, 1.0),) * m, ("ok",) * m)


def test_measured_damping_goes_to_the_modes_it_belongs_to() -> None:
    plain = modal_model(CHAIN, 4)
    model = modal_model(CHAIN, 4, zeta=measured([0, 2]))
    np.testing.assert_allclose(model.zeta, [0.01, 1e-3, 0.02, 1e-3])
    np.testing.assert_allclose(model.zeta_sd, [0.1, 1, 0.1, 1])  # the others are assumed
    np.testing.assert_allclose(model.omega, plain.omega)
    moved = modal_model(CHAIN, 4, zeta=measured([0, 2]), measured_frequencies=True)
    np.testing.assert_allclose(moved.omega / plain.omega, [1.02, 1, 1.02, 1])
    assert moved.omega_sd[0] == pytest.approx(0.1 / moved.frequency[0]) and any("modes 1, 3 have measured" in n for n in moved.notes)


def test_pairing_uses_shape_where_frequency_misleads() -> None:
    model = modal_model(CHAIN, 4)
    data = measured([1, 2], factor=0.95)
    assert pair(data, model) == ((0, 1), (1, 2))
    assert pair(measured([0], factor=2.0), modal_model(CHAIN, [0])) == ()


def test_measured_frequencies_must_keep_the_order() -> None:
    close = replace(modal_model(CHAIN, 4), omega=modal_model(CHAIN, 4).omega[0] * np.array([1.0, 1.05, 3.0, 4.0]))
    with pytest.raises(ValueError, match="order of the modes"):
        with_damping(close, measured([0], factor=1.07), measured_frequencies=True)
    with pytest.raises(ValueError, match="identified modes"):
        modal_model(CHAIN, 4, zeta=0.01, measured_frequencies=True)


def test_damping_matrix_gives_modal_ratios() -> None:
    damped = replace(CHAIN, C=2.0 * CHAIN.M + 1e-5 * CHAIN.K)
    model = modal_model(damped, 4)
    np.testing.assert_allclose(model.zeta, 1.0 / model.omega + 0.5e-5 * model.omega, rtol=1e-9)


def test_identified_modes_check_their_shapes() -> None:
    with pytest.raises(ValueError, match="zeta_sd"):
        replace(measured([0, 1]), zeta_sd=np.zeros(3))


def test_mac_is_one_for_scaled_and_zero_for_orthogonal_shapes() -> None:
    found = modes(CHAIN, 4)
    np.testing.assert_allclose(mac(found.shapes, -3 * found.shapes, CHAIN.M), np.eye(4), atol=1e-12)
    assert mac(np.zeros((2, 1)), np.ones((2, 1)))[0, 0] == 0
    with pytest.raises(ValueError, match="same s"):
        mac(np.ones((2, 1)), np.ones((3, 1)))
