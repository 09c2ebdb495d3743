"""The calibration study in small: its sums on made-up answers, its smoke run, and twenty virtual tests for each scenario (slow)."""

from __future__ import annotations

import numpy as np
import pytest
from studies.calibration import truth
from studies.calibration.cases import CASES
from studies.calibration.run import keep, line, rank_p, run, summarise


def made_up(count: int, shrink: float) -> list[dict]:
    """Tests whose posteriors are normal around an estimate with error one, their widths wrong by a factor."""
    rng = np.random.default_rng(0)
    out = []
    for _ in range(count):
        theta = rng.normal(size=2)
        draws = theta + rng.normal(size=2) + shrink * rng.normal(size=(999, 2))
        out.append({"truth": theta, "rank": (draws[:99] < theta).sum(axis=0),
                    "quantiles": np.quantile(draws, [0.025, 0.05, 0.25, 0.75, 0.95, 0.975], axis=0), "sd": draws.std(axis=0),
                    "known": np.ones(2), "frequency_inside": np.ones(5, bool), "damping_inside": np.zeros(5, bool),
                    "regression": {"z": rng.normal(size=2), "sd": np.ones(2)}, "shape": 0.1, "chained": False, "seconds": 0.1})
    return out


def test_sums_tell_honest_from_narrow() -> None:
    honest, narrow = (summarise(("a", "b"), made_up(400, shrink)) for shrink in (1.0, 0.4))
    assert honest["coverage"]["90"] == pytest.approx(0.90, abs=0.04) and min(honest["rank_p"]) > 1e-3
    assert honest["regression_coverage"]["95"] == pytest.approx(0.95, abs=0.04)
    assert narrow["coverage"]["90"] < 0.6 and max(narrow["rank_p"]) < 1e-6
    assert rank_p(np.arange(1000) % 100) == pytest.approx(1.0)


def test_truth_conserves_energy_and_meets_its_backbone() -> None:
    """Runge–Kutta without loss keeps its energy; the free vibration has the frequency that harmonics foretell."""
    case = CASES["static"]
    theta = np.array([[truth.F0, truth.ZETA, -2.4e6, 4.0]])
    frequency, damping = case.backbone(theta)
    assert frequency.shape == damping.shape == (1, 5)
    assert np.all(np.diff(frequency[0]) < 0) and np.all(np.diff(damping[0]) > 0)
    sliders = truth.Sliders(np.array([[truth.F0, truth.ZETA, 13.0, -0.5]]))
    # pushed far beyond the last yield the bank holds its slip force, less the spring that belongs to the linear part
    u = np.array([1.0])
    assert sliders.force(u, u)[0] + sliders.stiffness.sum() == pytest.approx(13.0, rel=1e-6)


def test_smoke(tmp_path) -> None:
    result = run("static", "white", 1, 1)
    assert keep(result, tmp_path).exists() and "cover" in line(result)
    assert result["seed"] == 1 and "numpy" in result["versions"] and result["refused"] == 0
    assert max(result["length_over_known"]) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("scenario", truth.SCENARIOS)
@pytest.mark.parametrize("case", CASES)
def test_twenty_virtual_tests(case: str, scenario: str) -> None:
    """Twenty tests only see gross faults: an honest 90 % covers at least 75 % of 80 correlated values, and ranks are not piled up."""
    result = run(case, scenario, 20, 3)
    assert 0.75 <= result["coverage"]["90"] <= 1.0 and min(result["rank_p"]) > 1e-4
