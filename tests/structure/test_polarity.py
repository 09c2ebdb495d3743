"""Sign and swap findings: found when there, silent on noisy but right data, never claimed where only the relative sign is known."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.modal_model import modal_model
from bayes_nlsid.structure.polarity import polarity

NAMES = ("S1", "S2", "S3", "S4", "S5")
PLACES = (0.02, 0.2, 0.31, 0.55, 0.64)


@pytest.fixture(scope="module")
def model() -> ModalModel:
    beam = LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7800, sensors=tuple(zip(NAMES, PLACES, strict=True)), inputs=(("F", 0.64),))
    return modal_model(lapped_beam(beam), 4)


def measured(model: ModalModel, names: tuple[str, ...], rng: np.random.Generator, *, error: float = 0.1, inverted: tuple[int, ...] = (),
             swapped: tuple[int, int] | None = None, signed: bool = False) -> IdentifiedModes:
    """Shapes with model error, in each mode scaled and signed as identification would."""
    m, s = model.modes, len(names)
    shapes = model.rows(names)
    shapes = shapes + error * np.abs(shapes).max(axis=0) * rng.standard_normal(shapes.shape)
    if swapped:
        shapes[list(swapped)] = shapes[list(swapped[::-1])]
    shapes[list(inverted)] *= -1
    if signed:
        shapes = shapes * np.sign(model.rows(["F"]))
    else:
        shapes = shapes * rng.choice([-1, 1], m)
    shapes /= np.abs(shapes).max(axis=0)
    small = np.full(m, 1e-3)
    return IdentifiedModes(model.frequency, small, shapes, names, names, tuple(range(m)), small, small, np.full((s, m), 0.02), small, small,
                           ((0.0, 1.0),) * m, ("ok",) * m, signed)


def test_noisy_but_right_data_raise_no_alarm(model: ModalModel) -> None:
    rng = np.random.default_rng(1)
    for names in (NAMES, NAMES[:3], (NAMES[0], NAMES[3], NAMES[4])):
        alarms = sum(bool(polarity(measured(model, names, rng), model)) for _ in range(60))
        assert alarms <= 1


@pytest.mark.parametrize("inverted", [(0,), (3,), (1, 4)])
def test_inverted_channels_are_named(model: ModalModel, inverted: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        found = polarity(measured(model, NAMES, rng, inverted=inverted), model)
        assert tuple(f.channel for f in found) == tuple(NAMES[c] for c in inverted)
        assert all(f.kind == "inverted" and f.confidence > 0.9 and "no measured force" in f.sentence for f in found)


def test_the_smaller_set_is_named_when_only_relative_signs_exist(model: ModalModel) -> None:
    found = polarity(measured(model, NAMES, np.random.default_rng(3), inverted=(1, 2, 3, 4)), model)
    assert [f.channel for f in found] == ["S1"]


def test_a_measured_force_tells_the_larger_set_from_the_smaller(model: ModalModel) -> None:
    found = polarity(measured(model, NAMES, np.random.default_rng(4), inverted=(1, 2, 3, 4), signed=True), model)
    assert [f.channel for f in found] == ["S2", "S3", "S4", "S5"] and "force as reference" in found[0].sentence


def test_swapped_cables_are_named(model: ModalModel) -> None:
    found = polarity(measured(model, NAMES, np.random.default_rng(5), swapped=(1, 4), error=0.05), model)
    assert [(f.channel, f.other, f.kind) for f in found] == [("S2", "S5", "swapped")]


def test_a_free_beam_with_published_shapes_of_three_sensors() -> None:
    """Measured shapes of a Brake-Reuss beam at 25.4, 554.9 and 643.8 mm, whose first channel has the opposite sign of the others."""
    places = (("acc1", 0.0254), ("acc2", 0.5549), ("acc3", 0.6438))
    model = modal_model(lapped_beam(LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7732, sensors=places)), 3)
    shapes = np.array([[1.0, 1.0, 1.0], [-0.044, -0.74, 0.90], [-0.636, 0.306, 0.055]])
    names, small = tuple(n for n, _ in places), np.full(3, 1e-3)
    modes = IdentifiedModes(np.array([80.3, 298.0, 583.0]), small, shapes, names, names, (0, 1, 2), small, small, np.full((3, 3), 0.01),
                            small, small, ((0.0, 1.0),) * 3, ("ok",) * 3)
    found = polarity(modes, model)
    assert [f.channel for f in found] == ["acc1"] and found[0].confidence > 0.99
    mended = IdentifiedModes(modes.frequency, small, shapes * np.array([[-1.0], [1.0], [1.0]]), names, names, (0, 1, 2), small, small,
                             modes.shapes_sd, small, small, modes.window, modes.status)
    assert polarity(mended, model) == ()


def test_a_channel_at_a_node_is_not_accused(model: ModalModel) -> None:
    beam = LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7800, sensors=(("S1", 0.02), ("N", 0.72 * 0.2242), ("S5", 0.64)))
    one = modal_model(lapped_beam(beam), 1)
    rng = np.random.default_rng(6)
    assert not any(polarity(measured(one, ("S1", "N", "S5"), rng, inverted=(1,)), one) for _ in range(20))
