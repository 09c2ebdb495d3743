"""A real bolted beam, end to end: published modes, one inverted channel, and joint stiffness as the only thing fitted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.identify import identify_modes
from bayes_nlsid.structure.modal_model import modal_model
from bayes_nlsid.structure.polarity import polarity
from bayes_nlsid.structure.sensing import modal_data
from bayes_nlsid.structure.updating import update

DATA = Path(__file__).resolve().parents[2] / "data" / "brb"
# Stated: length, section, lap, sensor positions, mass. Steel: E = 200 GPa, nu = 0.29; density from the mass. Five patches of the interface
# are joined, three at the bolts and one at either end of the lap, by tangential and normal springs.
BEAM = LappedBeam(0.72, 0.0254, 0.0127, 2e11, 1.796 / (0.72 * 0.0254 * 0.0127), nu=0.29, lap=(0.3, 0.42),
                  stations=(0.3075, 0.33, 0.36, 0.39, 0.4125), patch=0.015, tangential=1e8, normal=1e7,
                  sensors=(("acc1", 0.0254), ("acc2", 0.72 - 0.1651), ("acc3", 0.72 - 0.0762)))
PARTS = {name: tuple(f"J{j}_{name}" for j in range(1, 6)) for name in ("slip", "open")}


@pytest.fixture(scope="module")
def recording() -> Recording:
    meta = json.loads((DATA / "meta.json").read_text())
    with np.load(DATA / "hammer.npz") as file:
        acc = np.asarray(file["acc"], dtype=float)
    channels = tuple(Channel(f"acc{i}", f"acc{i}", "acceleration", "m/s^2") for i in (1, 2, 3))
    return Recording("hammer", 1 / meta["fs_hz"], acc, channels, np.zeros((len(acc), 0)))


@pytest.fixture(scope="module")
def identified(recording: Recording) -> IdentifiedModes:
    return identify_modes(recording, modal_model(lapped_beam(BEAM), 5, zeta=0.002))


def test_published_modes_are_found_at_low_amplitude(identified: IdentifiedModes) -> None:
    assert identified.nominal == (0, 1, 2, 3, 4) and set(identified.status) == {"ok"}
    np.testing.assert_allclose(identified.frequency, [80.3, 298, 583, 846, 1527], rtol=0.005)
    assert 0.001 < identified.zeta[0] < 0.003
    assert identified.amplitude[0] < 1e-4


def test_the_first_channel_has_the_opposite_sign(recording: Recording, identified: IdentifiedModes) -> None:
    model = modal_model(lapped_beam(BEAM), 5)
    assert [(f.channel, f.kind) for f in polarity(identified, model)] == [("acc1", "inverted")]
    mended = replace(identified, shapes=identified.shapes * np.array([[-1.0], [1.0], [1.0]]))
    assert polarity(mended, model) == ()


def test_joint_stiffness_alone_brings_five_modes_within_two_and_a_half_per_cent(identified: IdentifiedModes) -> None:
    mended = replace(identified, shapes=identified.shapes * np.array([[-1.0], [1.0], [1.0]]))
    result = update(lapped_beam(BEAM), PARTS, mended, prior_sd=3.0)
    assert np.abs(result.after / result.frequency - 1).max() < 0.025
    assert abs(result.after[0] / result.frequency[0] - 1) < 0.005
    assert result.unidentifiable == ()
    assert result.mac_after.min() > 0.95


def test_modes_in_bands_of_their_own_from_three_sensors(recording: Recording, identified: IdentifiedModes) -> None:
    model = modal_model(lapped_beam(BEAM), 5, zeta=identified, measured_frequencies=True)
    turned = replace(recording, response=recording.response * np.array([-1.0, 1.0, 1.0]))
    bands = [(40.0, 160.0), (200.0, 400.0), (500.0, 680.0), (750.0, 950.0), (1350.0, 1700.0)]
    data = modal_data(turned, model, range(5), model.joints, (40.0, 1700.0), bands=bands)
    assert data.u.shape[1] == 5 and 1 < data.condition < 20
    inside = slice(data.valid.start, data.valid.start + 12800)
    for k in range(5):
        spectrum = np.abs(np.fft.rfft(data.a[inside, k]))
        assert abs(spectrum.argmax() - identified.frequency[k]) < 0.01 * identified.frequency[k] + 1
    with pytest.raises(ValueError, match="3 sensors cannot tell 5 modes apart"):
        modal_data(turned, model, range(5), (), (40.0, 1700.0))
