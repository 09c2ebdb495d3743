"""The files, figures and page of a diagnosis."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.study import diagnosing


def answer(verdict: str = "mismatch", figures: bool = True) -> Diagnosis:
    rng = np.random.default_rng(2)
    n, lines, sensors = 600, 80, 3
    parameter = {"name": "f_s", "unit": "N", "q05": 9.1, "q50": 10.0, "q95": 11.2}
    numbers: dict[str, Any] = {} if not figures else {
        "frequency": np.arange(lines) + 1.0, "frf_frequency": np.arange(lines) + 1.0,
        "frf_measured": rng.standard_normal((lines, sensors)) + 0j,
        "frf_linear": rng.standard_normal((lines, sensors)) + 0j, "residual_by_line": rng.uniform(0.1, 1, lines),
        "noise_by_line": np.zeros(lines), "hypothesis_names": np.array(["hysteresis@J2_slip", "other@-", "none"]),
        "hypothesis_probability": np.array([0.9, 0.07, 0.03]),
        "place_names": np.array(["J2_slip", "J1_slip"]), "place_share": np.array([0.9, 0.6]),
        "heldout_time": np.arange(n) / 1000, **{f"latent_0_{k}": rng.standard_normal(n) for k in ("force", "displacement", "velocity")},
        **{f"heldout_{k}": rng.standard_normal((n, sensors)) for k in ("measured", "nominal", "updated", "extended")}}
    held = {"records": ["high_2"], "nrmse_nominal": 0.5, "nrmse_updated_linear": 0.2, "nrmse_extended": 0.02, "noise_floor": 0.01}
    return Diagnosis("case <1>", 4, 3.0, verdict, 0.97, {}, (
        Named((("hysteresis", "J2_slip"),), 0.9, (parameter,), "Friction with memory at J2.", "a test at ten times the level"),
        Named((("other", "-"),), 0.07), Named((), 0.03)), held, "Something is missing at J2.", {}, ("one note",), {}, numbers)


@pytest.mark.parametrize("figures", [True, False])
def test_everything_is_left(figures: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosing, "diagnose", lambda path, seed, progress: answer(figures=figures))
    diagnosing.run_diagnosis(tmp_path, tmp_path / "out")
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert found["format"] == 1 and found["hypotheses"][0]["effects"] == [{"class": "hysteresis", "location": "J2_slip"}]
    assert {p.stem for p in (tmp_path / "out" / "figures").glob("*.png")} == (
        {"hypotheses", "latent_force", "transfer_function", "before_after"} if figures else set())
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for words in ("case &lt;1&gt;", "hysteresis at J2_slip", "90.0 %", "9.10 N / 10.0 N / 11.2 N",
                  "a test at ten times the level", "2 %", "one note"):
        assert words in page, words
    assert "http" not in page.replace("http-equiv", "")


def test_answer_on_one_screen() -> None:
    text = diagnosing.lines(answer())
    assert " 90.0 %  hysteresis at J2_slip" in text and "50 % as delivered, 20 % re-tuned, 2 % extended" in text


def test_cannot_tell_is_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from bayes_nlsid.cli import main

    monkeypatch.setattr(diagnosing, "diagnose", lambda path, seed, progress: answer("cannot_tell", figures=False))
    assert main(["diagnose", str(tmp_path), "--out", str(tmp_path / "out"), "--seed", "4"]) == 1
    assert "cannot_tell" in capsys.readouterr().out


def test_a_study_that_says_nothing_is_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text("")
    with pytest.raises(InputError, match="study.toml"):
        diagnosing.run_diagnosis(tmp_path / "study.toml", tmp_path / "out")
    assert not (tmp_path / "out" / "diagnosis.json").exists()
