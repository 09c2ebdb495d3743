"""The scorer on invented results whose figures are known beforehand, and the runner with a stand-in tool."""

import json
import sys

import numpy as np
import pytest
from studies.concealed import score
from studies.concealed.run import run
from studies.concealed.tables import markdown


def put(root, name, effects, said, p, confidence=1.0, error=0.5, verdict="mismatch", places=None, inside=False):
    """One answer and one diagnosis; ``error``: rms error of the prediction over that of the linear fit's excess."""
    answers, results = root / "answers", root / "results" / name
    answers.mkdir(exist_ok=True)
    results.mkdir(parents=True)
    answer = {
        "case": name,
        "effects": [{"cls": c, "loc": "J1_slip", "strength": s, "group": g} for c, s, g in effects],
        "inside_tolerances": inside,
        "conceal": None,
        "tier": "normal",
        "burst_only": False,
        "few_sensors": False,
        "equivalent_locations": {"J1_slip": {"same_by_noise": ["J1_slip", "J2_slip"]}},
    }
    (answers / f"{name}.json").write_text(json.dumps(answer))
    rng = np.random.default_rng(len(name))
    clean, noise = rng.standard_normal((4000, 2)), 0.01 * rng.standard_normal((4000, 2))
    excess = 0.3 * rng.standard_normal((4000, 2))
    np.savez(answers / f"{name}_sealed.npz", x_accel=clean + noise, x_clean=clean, x_linear=clean + excess)
    guess = clean + error * excess
    np.savez(results / "predictions.npz", x_accel_q50=guess, x_accel_q05=guess - 1.645 * 0.01, x_accel_q95=guess + 1.645 * 0.01)
    rest = [] if confidence == 1.0 else [{"effects": [{"class": "other", "location": "-"}], "probability": 1 - confidence}]
    (results / "diagnosis.json").write_text(
        json.dumps(
            {
                "p_mismatch": p,
                "verdict": verdict,
                "seconds": 2.0,
                "heldout": {},
                "where": {"locations": [{"name": n, "probability": 0.5, "indistinguishable_from": []} for n in places or ["J1_slip"]]},
                "hypotheses": [{"effects": [{"class": c, "location": "J1_slip"} for c in said], "probability": confidence}, *rest],
            }
        )
    )


@pytest.fixture()
def batch(tmp_path):
    for i in range(20):
        put(tmp_path, f"case_null{i}", [], [], i / 100, error=0.0)
    put(tmp_path, "case_hit_a", [("hysteresis", 0.1, "nonlinear")], ["hysteresis"], 0.99, 0.8, error=0.5)
    put(tmp_path, "case_hit_bb", [("clearance", 0.01, "nonlinear")], ["hardening"], 0.9, 0.95, error=1.1, places=["J2_slip", "J1_slip"])
    put(tmp_path, "case_quiet", [("added_mass", 0.01, "linear")], [], 0.05, 0.6, verdict="cannot_tell", inside=True)
    put(tmp_path, "case_two", [("coulomb", 0.03, "nonlinear"), ("clipping", 0.1, "sensor")], ["coulomb"], 0.99)
    files = sorted((tmp_path / "answers").glob("*.json"))
    return [score.read_case(f, tmp_path / "results") for f in files]


def test_wilson_interval_against_a_published_value():
    low, high = score.wilson(81, 263)  # Newcombe 1998, Table I, method 3
    assert (low, high) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert score.wilson(0, 20)[1] == pytest.approx(0.1611, abs=1e-4)  # same table
    assert score.wilson(0, 0) == (0.0, 1.0)


def test_threshold_lets_five_percent_of_nulls_pass(batch):
    at = score.threshold(batch)
    assert sum(c.p > at for c in batch if c.null) == 1
    d = score.detection(batch)
    assert d["power"]["hits"] == 4 and d["excused"] == 1
    assert d["false_alarms_p50"]["hits"] == 0 and d["nonlinear_1"]["n"] == 1


def test_naming_counts_only_exact_sets(batch):
    n = score.naming(batch)
    assert n["singles_3"]["hits"] == 1 and n["singles_3"]["n"] == 1
    assert n["singles_all"]["n"] == 3 and n["double_named"]["hits"] == 1 and n["double_named"]["n"] == 2
    assert n["confident_and_wrong"]["hits"] == 2 and n["confident_miss"]["hits"] == 0
    assert n["confusion"]["clearance"] == {"hardening": 1}


def test_places_are_exact_alike_or_among_three(batch):
    w = score.placing(batch)["all"]
    assert w["exact"]["hits"] == 1 and w["true_set"]["hits"] == 2 and w["top3"]["hits"] == 2 and w["exact"]["n"] == 2


def test_removed_energy_and_harm(batch):
    p = score.proof(batch)
    assert p["nonlinear"]["0.1"]["median"] == pytest.approx(0.75, abs=0.01)
    assert p["nonlinear"]["0.01"]["median"] == pytest.approx(1 - 1.21, abs=0.01)
    assert p["worse"]["hits"] == 1 and p["worse_null"]["hits"] == 0
    null = next(c for c in batch if c.null)
    assert null.sealed[0]["coverage"] == pytest.approx(0.9, abs=0.02)


def test_calibration_of_honest_and_of_boastful_answers(batch):
    c = score.calibration(batch)
    assert c["ece"] == pytest.approx((0.2 + 0.95 + 0.6 + 1.0) / 24, abs=1e-9)
    assert c["log_loss"] == pytest.approx((-np.log(0.8) - 3 * np.log(score.FLOOR)) / 24)


def test_case_without_answer_counts_as_nothing_found(batch, tmp_path):
    lost = score.read_case(tmp_path / "answers" / "case_hit_a.json", tmp_path / "nowhere")
    assert lost.missing and not lost.right and lost.p == 0.0
    assert "| hysteresis | none 1 |" in markdown(score.figures([lost, *batch[1:]])) or lost.truth == ("hysteresis",)
    assert "20 with nothing missing" in markdown(score.figures(batch))


def test_runner_runs_each_case_once_with_one_thread(tmp_path):
    for name in ("case_a", "case_b"):
        (tmp_path / "cases" / name).mkdir(parents=True)
        (tmp_path / "cases" / name / "case.json").write_text("{}")
    tool = tmp_path / "tool.py"
    tool.write_text(
        "import os, pathlib, sys\nassert os.environ['OMP_NUM_THREADS'] == '1' and sys.argv[1] == 'diagnose'\n"
        "out = pathlib.Path(sys.argv[4])\nf = out / 'diagnosis.json'\nf.write_text((f.read_text() if f.exists() else '') + 'x')\n"
    )
    out, command = tmp_path / "results", f"{sys.executable} -S {tool}"
    assert run(tmp_path / "cases", out, 2, 0, 60.0, command) == 0
    assert run(tmp_path / "cases", out, 2, 0, 60.0, command) == 0
    assert (out / "case_a" / "diagnosis.json").read_text() == "x"
    assert json.loads((out / "case_b" / "status.json").read_text())["exit"] == 0
    assert run(tmp_path / "nothing", out) == 2
