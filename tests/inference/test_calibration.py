"""The calibration study in small: its sums on made-up answers, its smoke run, and twenty virtual tests for each scenario (slow)."""

from __future__ import annotations

import numpy as np
import pytest
from studies.calibration import assembly, hard, misfit, scenarios, truth
from studies.calibration.cases import CASES, QUICK
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


def test_misfit_counts_what_is_silently_wrong() -> None:
    fine = {"flagged": False, "innovation": False, "refused": False, "worst": 2.0, "worst_allowing": 0.5, "worst_backbone": 2.0,
            "inside90": 0.9, "widening": [2.0, 3.0]}
    tests = [fine, fine | {"flagged": True, "worst": 40.0, "worst_allowing": 9.0}, fine | {"worst": 20.0}, fine | {"worst_allowing": 4.0}]
    found = misfit.summarise(tests)
    assert (found["flagged"], found["silently_wrong"], found["silently_wrong_given_form"]) == (1, 1, 1)
    assert found["flagged_or_covered"] == 0.75 and found["flagged_or_covered_90"][0] < 0.75 < found["flagged_or_covered_90"][1]


def test_hidden_friction_is_flagged_and_its_backbone_is_that_of_the_loss() -> None:
    found = misfit.run(misfit.TRIALS["coulomb"], 1, 2)
    assert found["flagged"] == 1 and found["silently_wrong"] == 0 and "coulomb" in misfit.line(found)
    a, square = np.array([1e-3]), np.array([[4e5]])
    dry = misfit.Hidden.lost(np.array([[0, 0, 0.0, 0.0, 0.05, 0.0]]), a, square)
    assert dry[0, 0] == pytest.approx(4 * 0.05 * 1e-3, rel=0.01)      # fast: dry friction loses four times force times amplitude


def test_five_joints_conserve_energy_and_hold_their_modes() -> None:
    """Without damping and joints a mode released from rest keeps its frequency; the backbone at small amplitude is the linear mode."""
    case = CASES["five S3"]
    theta = case.draw(3, np.random.default_rng(0))
    frequency, damping = case.backbone(theta)
    assert frequency.shape == (3, 5) and np.all(np.diff(frequency) < 0) and np.all(np.diff(damping) > 0)
    assert frequency[:, 0] == pytest.approx(theta[:, 0], rel=0.01) and len(case.names) == theta.shape[1] == 12
    assert assembly.slips(3).shape == (5, 3) and len(CASES["five S2 memory"].names) == 12


def test_scenarios_count_with_exact_intervals() -> None:
    assert scenarios.interval(40, 40)[1] == 1.0 and scenarios.interval(40, 40)[0] == pytest.approx(0.05 ** (1 / 40))
    assert scenarios.interval(0, 40)[0] == 0.0


def test_exact_draws_have_the_density_that_the_sampler_sees() -> None:
    """For each family of hard posteriors: the mean of a ratio of densities over exact draws is one."""
    for i, family in enumerate(hard.FAMILIES):
        for seed in range(4):
            one = family(np.random.default_rng([i, seed]))
            x = one.draw(4000, np.random.default_rng(1))
            # nudging draws along by a tenth of their own spread: E[p(x + h)/p(x)] = 1 for a density without bounds
            h = 0.02 * np.quantile(np.abs(x - np.median(x, axis=0)), 0.2, axis=0)
            ratio = np.exp(np.clip(one.log(x + h) - one.log(x), -30, 30))
            assert np.median(ratio) == pytest.approx(1.0, abs=0.5), one.words


def test_a_false_converged_is_counted() -> None:
    """The same density with draws from another: what the run says is held against the exact draws."""
    one = hard.Posterior("one", "a normal distribution", lambda x: -0.5 * np.sum((x / 0.1) ** 2, axis=1),
                         lambda n, rng: 0.1 * rng.normal(size=(n, 1)), np.zeros((1, 1)), (0.1,))
    start = hard.lent(1)
    right = hard.one_test(one, start, 0)
    other = hard.Posterior("one", "", one.log, lambda n, rng: 0.05 + 0.1 * rng.normal(size=(n, 1)), one.optima, one.widths)
    wrong = hard.one_test(other, start, 0)
    assert right["converged"] and not right["false"] and right["distance"] < 0.06
    assert wrong["converged"] and wrong["false"]


@pytest.mark.slow
@pytest.mark.parametrize("scenario", truth.SCENARIOS)
@pytest.mark.parametrize("case", QUICK)
def test_twenty_virtual_tests(case: str, scenario: str) -> None:
    """Twenty tests only see gross faults: an honest 90 % covers at least 75 % of 80 correlated values, and ranks are not piled up."""
    result = run(case, scenario, 20, 3)
    assert 0.75 <= result["coverage"]["90"] <= 1.0 and min(result["rank_p"]) > 1e-4
