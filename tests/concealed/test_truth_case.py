"""Generated cases: format, no answers inside, same bytes from the same seed, strengths and quotas as ordered."""

import ast
import hashlib
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import studies.concealed
from studies.concealed.generate import generate
from studies.concealed.truth import catalogue
from studies.concealed.truth.campaign import FS, PERIODS
from studies.concealed.truth.case import Order, make, plan
from studies.concealed.truth.effects import _tap, draw_effect, truth_of
from studies.concealed.truth.folder import write
from studies.concealed.truth.sheet import answer


@pytest.fixture(scope="module")
def made():
    return make(Order(3, (("sensor_gain", 0.1),), None, False, False), 5)


@pytest.fixture(scope="module")
def folders(made, tmp_path_factory):
    root = tmp_path_factory.mktemp("concealed")
    write(made, root / "cases", root / "answers")
    return root / "cases" / made.name, root / "answers"


def test_folder_holds_what_the_format_says(folders):
    case, _ = folders
    info = json.loads((case / "case.json").read_text())
    with np.load(case / "nominal.npz") as n:
        N, s = n["M"].shape[0], n["sensor_select"].shape[0]
        assert n["K_parts"].sum(axis=0) == pytest.approx(n["K"]) and n["K_parts"].shape == (n["K_part_names"].size, N, N)
        assert n["location_vectors"].shape == (n["location_names"].size, N) and list(n["location_names"]) == info["locations"]["joints"]
        assert np.linalg.eigvalsh(n["M"]).min() > 0 and np.linalg.eigvalsh(n["K"]).min() > 0
    for record in info["records"]:
        name = f"{record['name']}_force.npz" if record["sealed"] else f"{record['name']}.npz"
        with np.load(case / name) as r:
            assert set(r.files) == ({"time", "force"} if record["sealed"] else {"time", "force", "accel"})
            assert r["force"].dtype == np.float32 and r["time"][0] == record["start_s"]
            if not record["sealed"]:
                assert r["accel"].shape == (r["time"].size, s) and r["accel"].dtype == np.float32
    with np.load(case / "low_1.npz") as a, np.load(case / "low_2.npz") as b:
        assert np.corrcoef(a["force"], b["force"])[0, 1] > 0.999


def test_no_answer_lies_inside_the_case_folder(folders):
    case, answers = folders
    info = json.loads((case / "case.json").read_text())
    assert not {"effects", "seed", "conceal", "tier", "true_factors", "strength"} & set(info)
    assert len([p for p in case.iterdir()]) == len(info["records"]) + 2
    sealed = [r["name"] for r in info["records"] if r["sealed"]]
    assert sealed and not any((case / f"{n}.npz").exists() for n in sealed)
    with np.load(answers / f"{case.name}_sealed.npz") as z:
        assert {f"{n}_{k}" for n in sealed for k in ("accel", "clean", "linear")} == set(z.files)


def test_generate_refuses_answers_inside_the_cases(tmp_path, capsys):
    assert generate(1, 1, tmp_path / "a", tmp_path / "a" / "answers") == 2
    assert "elsewhere" in capsys.readouterr().err


def test_same_seed_same_bytes(folders, tmp_path):
    case, _ = folders
    again = make(Order(3, (("sensor_gain", 0.1),), None, False, False), 5)
    write(again, tmp_path / "cases", tmp_path / "answers")
    first = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in case.iterdir()}
    second = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in (tmp_path / "cases" / case.name).iterdir()}
    assert first == second


def test_sensor_gain_shows_in_that_channel_and_nowhere_else(made):
    effect = made.effects[0]
    index = int(effect.loc[1:]) - 1
    change = [
        np.std(made.clean["high_1"][1][:, i] - made.baseline["high_1"][1][:, i]) / np.std(made.baseline["high_1"][1][:, i])
        for i in range(made.bench.sensors)
    ]
    assert change[index] == pytest.approx(0.1, rel=0.05)
    assert max(c for i, c in enumerate(change) if i != index) < 1e-12


def test_tuned_local_effect_reaches_its_target_in_the_recorded_response():
    made = make(Order(8, (("hardening", 0.1),), None, False, False), 5)
    a, b = made.clean["high_1"][1], made.baseline["high_1"][1]
    assert np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)) == pytest.approx(made.effects[0].achieved, rel=0.25)
    assert made.effects[0].achieved == pytest.approx(0.1, rel=0.05)
    sheet = answer(made, {})
    assert not sheet["inside_tolerances"] and sheet["chi2_not_lti"] > 100
    name = made.effects[0].loc
    assert sheet["equivalent_locations"][name]["similarity"][name] == pytest.approx(1.0)


@pytest.mark.parametrize("cls", [c for c in catalogue.INPUT + catalogue.SENSOR + catalogue.AMBIENT])
@pytest.mark.parametrize("target", [0.3, 0.01])
def test_channel_effects_reach_their_targets(made, cls, target):
    effect = draw_effect(cls, target, made.bench, np.random.default_rng(1), None, (), ())
    assert effect.achieved == pytest.approx(target, rel=0.05)
    force, accel = (a[made.bench.force.size :] for a in truth_of(made.bench, (effect,)).clean(made.campaign, high(made)))
    force0, accel0 = (a[made.bench.force.size :] for a in made.baseline["high_1"])
    if effect.loc == "FORCE":
        assert np.array_equal(accel, accel0) and np.std(force - force0) > 0.3 * target * np.std(force0)
    else:
        channel = slice(None) if effect.taps[0].channel < 0 else slice(effect.taps[0].channel, effect.taps[0].channel + 1)
        size = np.sqrt(np.mean((accel - accel0)[:, channel] ** 2) / np.mean(accel0[:, channel] ** 2))
        # Another multisine realisation and another draw of the slow signals: the same size, not the same figure.
        assert 0.4 * target < size < 2.5 * target


@pytest.mark.parametrize("target", [0.3, 0.03, 0.01])
def test_dropouts_and_crosstalk_reach_their_targets(made, target):
    for seed in range(6):
        for kind in ("dropouts", "crosstalk", "cell_curvature"):
            assert _tap("other", kind, target, made.bench, np.random.default_rng(seed), ()).achieved == pytest.approx(target, rel=0.1)


def high(made):
    return next(e for e in made.campaign.entries if e.name == "high_1")


def test_noise_is_what_the_answer_says_and_periods_differ_by_it_only(made):
    with_noise, clean = made.noisy["high_1"][1], made.clean["high_1"][1]
    assert np.std(with_noise - clean, axis=0) == pytest.approx(made.noise.sigma, rel=0.05)
    assert made.noisy["high_1"][0].size == PERIODS * 2 * FS


def test_plan_keeps_its_quotas():
    orders = plan(120, 4)
    assert [o.index for o in orders] == list(range(120))
    assert Counter(len(o.effects) for o in orders) == {0: 24, 1: 82, 2: 14}
    assert sum(o.conceal is not None for o in orders) == round(0.4 * 24) + round(0.4 * 96)
    assert sum(o.tier == "hard" for o in orders) == round(0.15 * 24) + round(0.15 * 96)
    count = Counter(c for o in orders for c, _ in o.effects)
    assert len(count) == 20 and min(count.values()) >= 3
    targets = Counter(t for o in orders for _, t in o.effects)
    assert max(targets.values()) - min(targets.values()) <= 8
    assert plan(120, 4) == orders != plan(120, 5)


def test_the_study_shares_no_code_with_the_package():
    root = Path(studies.concealed.__file__).parent
    for file in root.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            assert not any(n.split(".")[0] == "bayes_nlsid" for n in names), file
