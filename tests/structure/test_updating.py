"""Updating recovers what was changed, says what it cannot know, and its deviations cover."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.structure import Structure, modes
from bayes_nlsid.structure.updating import update

GROUPS = {"E": ("E",), "slip": ("J1_slip", "J2_slip", "J3_slip"), "rho": ("rho",)}


@pytest.fixture(scope="module")
def beam() -> Structure:
    return lapped_beam(LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7800, lap=(0.3, 0.42), stations=(0.33, 0.36, 0.39), tangential=1e8,
                                  normal=5e7, patch=0.02, element_size=0.02, sensors=tuple((f"S{i}", 0.1 * i) for i in range(8))))


def measured(structure: Structure, count: int, frequency_sd: float, rng: np.random.Generator) -> IdentifiedModes:
    found = modes(structure, count)
    frequency = found.frequency * (1 + frequency_sd * rng.standard_normal(count))
    shapes = structure.rows(structure.sensors) @ found.shapes
    shapes = shapes / np.abs(shapes).max(axis=0)
    small = np.full(count, 1e-3)
    return IdentifiedModes(frequency, small, shapes, structure.sensors, structure.sensors, tuple(range(count)), frequency_sd * frequency,
                           small, np.full(shapes.shape, 0.01), small, small, ((0.0, 1.0),) * count, ("ok",) * count)


def test_exact_frequencies_give_back_what_was_changed(beam: Structure) -> None:
    true = {"E": 0.95, **dict.fromkeys(GROUPS["slip"], 0.4)}
    data = measured(beam.scaled(true), 5, 1e-6, np.random.default_rng(1))
    result = update(beam, {k: GROUPS[k] for k in ("E", "slip")}, data, frequency_error=1e-6, prior_sd=3.0)
    np.testing.assert_allclose(result.values, [0.95, 0.4], rtol=1e-3)
    np.testing.assert_allclose(result.after, data.frequency, rtol=1e-5)
    assert np.abs(result.before / data.frequency - 1).max() > 0.01 and result.status == "ok"
    np.testing.assert_allclose(modes(result.structure, 5).frequency, result.after, rtol=1e-9)
    assert (result.mac_after > 0.999).all() and result.unidentifiable == ()


def test_stiffness_and_density_together_are_called_undetermined(beam: Structure) -> None:
    data = measured(beam, 5, 1e-4, np.random.default_rng(2))
    result = update(beam, {"stiffness": tuple(beam.K_parts), "density": ("rho",)}, data, frequency_error=1e-4)
    assert "combinations" in result.status and "density" in result.status and "stiffness" in result.status
    assert result.sd.min() > 0.3


def test_a_part_the_modes_do_not_see_is_named(beam: Structure) -> None:
    data = measured(beam, 2, 1e-3, np.random.default_rng(3))
    result = update(beam, ("E", "J2_slip"), data)
    assert result.unidentifiable == ("J2_slip",) and "J2_slip" in result.status
    assert result.sd[0] < 0.05


def test_deviations_cover(beam: Structure) -> None:
    misses = []
    true = np.array([0.97, 0.6])
    changed = beam.scaled({"E": true[0], **dict.fromkeys(GROUPS["slip"], true[1])})
    rng = np.random.default_rng(4)
    for _ in range(15):
        result = update(beam, {k: GROUPS[k] for k in ("E", "slip")}, measured(changed, 5, 3e-3, rng), frequency_error=0.0, prior_sd=2.0)
        misses.append((np.log(result.values) - np.log(true)) / result.sd)
    assert 0.5 < np.sqrt(np.mean(np.square(misses))) < 1.5


def test_a_wrong_model_says_so(beam: Structure) -> None:
    data = measured(beam, 5, 1e-5, np.random.default_rng(5))
    bent = IdentifiedModes(data.frequency * np.array([1.0, 1.05, 0.95, 1.05, 1.0]), data.zeta, data.shapes, data.channels, data.locations,
                           data.nominal, data.frequency_sd, data.zeta_sd, data.shapes_sd, data.phase_scatter, data.amplitude, data.window,
                           data.status)
    assert "something else is wrong" in update(beam, ("E",), bent).status


def test_unknown_or_doubled_parts_are_refused(beam: Structure) -> None:
    data = measured(beam, 3, 1e-3, np.random.default_rng(6))
    with pytest.raises(ValueError, match="unknown parts"):
        update(beam, ("glue",), data)
    with pytest.raises(ValueError, match="two groups"):
        update(beam, {"a": ("E",), "b": ("E",)}, data)
