"""``nlsid plan``: no recordings needed, a ranked answer in words, numbers and pictures, and one sentence for what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bayes_nlsid import cli

STUDY = '''
title = "two joints"
[structure]
kind = "matrices"
mass = "model.npz"
[reduction]
modes = 2
damping = 0.02
[plan]
sensors = ["S1", "S2"]
inputs = ["S1", "S2"]
band = ["2 Hz", "20 Hz"]
levels = ["0.05 N", "5 N"]
noise = "0.01 m/s^2"
seconds = "20 s"
[[plan.joints]]
term = "jenkins"
locations = ["J1"]
values = { f_s = 0.5, k_t = 400.0 }
'''


def write(folder: Path, text: str = STUDY) -> Path:
    import numpy as np

    K = np.array([[6e3, -3e3], [-3e3, 3e3]])
    np.savez(folder / "model.npz", M=np.eye(2), K=K, sensor_select=np.eye(2), location_names=np.array(["J1"]),
             location_vectors=np.array([[-1.0, 1.0]]))
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def test_a_plan_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = write(tmp_path)
    assert cli.main(["check", str(study)]) == 0
    assert cli.main(["plan", str(study), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "plan: 4 excitations, 2 sensors, 1 suspected joints" in said and "nothing to run yet" in said
    assert "with 5 N rms" in said and "0.05 N" in said and "f_s" in said
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    gains = [e["gain_nats"] for e in plan["excitations"]]
    assert gains == sorted(gains, reverse=True) and plan["excitations"][-1]["level_n"] == 0.05
    assert [p["word"] for p in plan["parameters"]] == ["learned", "learned"] and plan["cannot_be_learned"] == []
    page = (tmp_path / "out" / "plan.html").read_text()
    assert "Excitations, the best first" in page and page.count("data:image/png") == 2 and "http:" not in page and "https:" not in page
    assert {p.name for p in (tmp_path / "out" / "figures").iterdir()} == {"plan_levels.png", "plan_sensors.png"}


def test_below_slip_the_slip_force_stays_unknown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = write(tmp_path, STUDY.replace('"5 N"', '"0.1 N"'))
    assert cli.main(["plan", str(study), "--out", str(tmp_path / "out")]) == 0
    assert "cannot be learned by any of these tests" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert any("jenkins[J1].f_s" in c["combination"] for c in found["cannot_be_learned"])


@pytest.mark.parametrize(("old", "new", "words"), [
    ('sensors = ["S1", "S2"]', 'sensors = ["S9"]', "'S9' is not a location"), ('sensors = ["S1", "S2"]', "", "[plan] sensors: is missing"),
    ('"5 N"', '"5 mm"', "measures displacement"), ('noise = "0.01 m/s^2"', 'noise = "0.01 N"', "measures force"),
    ('noise = "0.01 m/s^2"', "noise = 0", "is not positive"), ('noise = "0.01 m/s^2"', 'noise = "x"', "is not a number with a unit"),
    (", k_t = 400.0", "", "lacks k_t"), ("k_t = 400.0", "k_t = -1", "is not positive"), ("k_t = 400.0", "k_t = 1, z = 2", "z"),
    ('"jenkins"', '"jenkin"', "did you mean 'jenkins'"), ('["2 Hz", "20 Hz"]', '["50 Hz", "90 Hz"]', "no mode of the model lies between"),
    ("[[plan.joints]]\n", "[[plan.joint]]\n", "joints: there is none"),
])
def test_mistakes(tmp_path: Path, old: str, new: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plan", str(write(tmp_path, STUDY.replace(old, new, 1))), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1, said


def test_a_plan_alone_cannot_be_run_and_a_run_alone_cannot_be_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", str(write(tmp_path)), "--out", str(tmp_path / "out")]) == 2
    assert "use nlsid plan" in capsys.readouterr().err
    assert cli.main(["new", str(tmp_path / "new")]) == 0
    assert cli.main(["plan", str(tmp_path / "new" / "study.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "[plan]: is missing" in capsys.readouterr().err
