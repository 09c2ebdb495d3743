"""Whole cases from the test's own simulator: nothing is called nothing, one case for each major kind is found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.mismatch import diagnose
from tests.mismatch.truth import write_case

pytestmark = pytest.mark.slow


def test_nothing_missing_is_called_nothing(tmp_path: Path) -> None:
    write_case(tmp_path / "none", seed=1)
    found = diagnose(tmp_path / "none")
    assert found.verdict == "none" and found.p_mismatch < 0.5
    assert sum(h.probability for h in found.hypotheses) == pytest.approx(1.0)


@pytest.mark.parametrize(("cls", "place", "strength"), [
    ("hardening", "TIP_w", 0.1), ("clearance", "J2_open", 0.03), ("quad_damping", "J1_slip", 0.03), ("hysteresis", "J2_slip", 0.1),
    ("stiffness_drift", "TIP_w", 0.1), ("added_mass", "P3", 0.1), ("sensor_delay", "S4", 0.1), ("clipping", "S3", 0.3),
    ("mains_hum", "ALL_SENSORS", 0.1)])
def test_one_of_each_kind_is_named(tmp_path: Path, cls: str, place: str, strength: float) -> None:
    truth = write_case(tmp_path / "case", cls, place, strength, seed=11)
    found = diagnose(tmp_path / "case")
    assert found.verdict == "mismatch"
    best = next(h for h in found.hypotheses if h.effects[0][0] not in ("none",))
    assert cls in [c for c, _ in best.effects]
    sealed = found.predictions["sealed_ms_accel_q50"]
    if cls != "clipping":
        assert np.linalg.norm(sealed - truth["sealed_ms"]) < 0.1 * np.linalg.norm(truth["sealed_ms"])
    assert found.heldout["nrmse_extended"] <= 1.02 * found.heldout["nrmse_updated_linear"]


def test_bursts_only_with_four_sensors_runs(tmp_path: Path) -> None:
    write_case(tmp_path / "case", "hardening", "TIP_w", 0.1, seed=3, sensors=4, bursts_only=True)
    found = diagnose(tmp_path / "case")
    assert found.verdict in ("mismatch", "cannot_tell")
    assert any("periodic" in n for n in found.notes)
    assert any(p == "TIP_w" for h in found.hypotheses[:3] for _, p in h.effects)
