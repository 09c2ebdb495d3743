"""The benchmark studies, whole: errors on the official tests against the limits and against what was measured before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.run import run_study

STUDIES = Path(__file__).resolve().parents[2] / "studies"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["silverbox", "bouc_wen"])
def test_official_tests_are_simulated_within_the_limits(name: str, tmp_path: Path) -> None:
    expected = json.loads((STUDIES / name / "expected.json").read_text(encoding="utf-8"))
    found = run_study(read_study(STUDIES / name / "study.toml"), tmp_path / "out")
    assert found["status"] == "ok", found["reasons"]
    errors = {entry["record"]: entry["rmse"] for entry in found["heldout"]["each"]}
    assert set(errors) == set(expected["rmse"])
    for record, limit in expected["limit"].items():
        assert errors[record] <= limit, (record, errors[record])
        assert errors[record] == pytest.approx(expected["rmse"][record], rel=0.1)
    fitted = {entry["name"]: entry["fit"] for entry in found["parameters"]}
    for parameter, value in expected["parameters"].items():
        assert fitted[parameter] == pytest.approx(value, rel=0.02), parameter


def test_windows_of_the_silverbox_are_whole_steady_periods() -> None:
    """Read from the data alone: what follows the period is its beginning again, and even lines are silent."""
    study = read_study(STUDIES / "silverbox" / "study.toml")
    with np.load(STUDIES.parent / "data" / "silverbox" / "snls80mv.npz") as data:
        u, rate = np.asarray(data["u_V"], dtype=float), float(data["fs"])
    for spec in study.recordings:
        if spec.role != "train" or spec.window is None or spec.period is None:
            continue
        first, last = (round(t * rate) for t in spec.window)
        assert last - first == spec.period == 8192
        # the samples that led up to the window are those at its end: it starts in a steady state
        before = u[first - 300:first] - u[last - 300:last]
        assert np.sqrt(np.mean(before**2)) < 0.02 * u[first:last].std()
        lines = np.abs(np.fft.rfft(u[first:last])) ** 2
        assert lines[2::2].sum() < 1e-3 * lines[1::2].sum()
