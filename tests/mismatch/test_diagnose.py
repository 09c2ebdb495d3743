"""Whole cases from the test's own simulator: nothing is called nothing, one case for each major kind is found."""

from __future__ import annotations

from collections.abc import Mapping
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
    ("hardening", "TIP_w", 0.1), ("clearance", "TIP_w", 0.03), ("quad_damping", "J1_slip", 0.03), ("hysteresis", "J2_slip", 0.1),
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
        # a drift is carried beyond the last record that was fitted
        limit = 0.15 if cls == "stiffness_drift" else 0.1
        assert np.linalg.norm(sealed - truth["sealed_ms"]) < limit * np.linalg.norm(truth["sealed_ms"])
    assert found.heldout["nrmse_extended"] <= 1.02 * found.heldout["nrmse_updated_linear"]
    shows_its_effect(found.figures, best.effects[0][0])


def shows_its_effect(f: Mapping[str, np.ndarray], cls: str) -> None:
    """The numbers behind the figures of one class."""
    if "law_0_curve" in f and cls == f["law_0_class"]:
        own = f["law_0_velocity" if f["law_0_phase"] == "velocity" else "law_0_displacement"]
        at = np.interp(own, f["law_0_grid"], f["law_0_curve"])
        # along the motion it is the curve, but for the corners between points of the curve
        assert np.quantile(np.abs(at - f["law_0_force"]), 0.98) < 0.05 * np.abs(f["law_0_force"]).max()
    if "law_0_left" in f:
        assert f["law_0_left"].std() < 0.7 * f["law_0_force"].std()
        assert f["record_after"].max() < f["record_before"].max()
    if cls == "sensor_delay":
        left, with_it = (np.abs(np.angle(f["chain_0_ratio"] / e)) / f["chain_0_sd"] for e in (1.0, f["chain_0_effect"]))
        assert np.median(left) > 3 * np.median(with_it) and np.median(with_it) < 2
    if cls == "added_mass":
        # without the mass the model fits as well, but at the price of errors of form that no good model has
        before, after = (np.abs(f["frf_measured"] - f[k]) / f["frf_error"] for k in ("frf_linear", "frf_extended"))
        assert (after ** 2).sum() < 1.05 * (before ** 2).sum()
        # line by line, without a law, the recordings ask for a mass
        weight = np.abs(f["attached_law"]) ** 2 / f["attached_sd"] ** 2
        share = (weight * (f["attached_stiffness"] / f["attached_law"])).sum() / weight.sum()
        assert abs(share - 1) < 0.1
    if cls == "stiffness_drift":
        assert np.ptp(f["drift_value"]) > 3 * f["drift_error"].max()
    if cls == "clipping":
        assert np.abs(f["clip_model"]).max() > f["clip_level"] and np.abs(f["clip_measured"]).max() < 1.1 * f["clip_level"]
    if cls == "mains_hum":
        at = [int(np.argmin(np.abs(f["quiet_frequency"] - h * f["quiet_mains"]))) for h in (1, 2, 3)]
        assert f["quiet_own"][at].max() > 3 * np.median(f["quiet_own"])


def test_bursts_only_with_four_sensors_runs(tmp_path: Path) -> None:
    write_case(tmp_path / "case", "hardening", "TIP_w", 0.1, seed=3, sensors=4, bursts_only=True)
    found = diagnose(tmp_path / "case")
    assert found.verdict in ("mismatch", "cannot_tell")
    assert any("periodic" in n for n in found.notes)
    assert any(p == "TIP_w" for h in found.hypotheses[:3] for _, p in h.effects)
