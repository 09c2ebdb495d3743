"""The second stage of the posterior from a study: what it changes, that it tells a wrong model, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bayes_nlsid.cli import main
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.story import story

CONVERGED = '\n[posterior]\nensembles = 2\nsteps = 400\nwalkers = 16\n'
BRIEF = '\n[posterior]\nensembles = 2\nsteps = 50\nwalkers = 16\nmost = 400\n'


def run(small: Path, out: Path, posterior: str, **changes: str) -> tuple[int, dict]:
    text = small.read_text(encoding="utf-8")
    for old, new in changes.items():
        before = next(line for line in text.splitlines() if line.startswith(f"{old} = "))
        text = text.replace(before, f"{old} = {new}")
    path = small.parent / f"{out.name}.toml"
    path.write_text(text + posterior, encoding="utf-8")
    code = main(["run", str(path), "--out", str(out), "--quiet"])
    return code, json.loads((out / "result.json").read_text()) if (out / "result.json").exists() else {}


def test_both_stages_by_default_and_the_truth_in_the_second(small: Path, quick: None, tmp_path: Path) -> None:
    """Truth of the example: 20.3 Hz, 1.2 %, 4e8 N/m³, made by Runge–Kutta."""
    code, result = run(small, tmp_path / "both", CONVERGED, candidates='["cubic"]')
    assert code == 0 and result["status"] == "ok", result["reasons"]
    second = result["posterior"]["second_stage"]
    assert result["posterior"]["stage"] == "both" and second["k_hat"] < 0.7 and not second["misfit"]["found"]
    cubic = next(p for p in result["parameters"] if p["name"] == "cubic[x].c")
    width = cubic["q95"] - cubic["q05"]
    prior = cubic["prior"]
    assert prior["kind"] == "normal" and prior["a"] == 0 and prior["lower"] < -prior["b"] < prior["b"] < prior["upper"]
    assert "physical parameter" in result["posterior"]["prior_space"]
    assert abs(cubic["q50"] - 4e8) < 1.5 * width and width < 0.01 * 4e8
    assert cubic["regression"]["q05"] < cubic["regression"]["q95"]
    assert {row["name"] for row in second["against_regression"]} == {p["name"] for p in result["parameters"]}
    page = (tmp_path / "both" / "report.html").read_text(encoding="utf-8")
    assert "simulation, 5–95 %" in page and "does the model explain the recordings?" in page
    assert any("imulating the recordings" in s for s in story(read_study(small), result))


def test_a_model_that_lacks_the_force_is_refused(small: Path, quick: None, tmp_path: Path) -> None:
    code, result = run(small, tmp_path / "misfit", BRIEF + 'stage = "forward"\n', candidates='["v|v|"]')
    assert code == 1 and result["status"] in ("model_misfit", "not_converged", "not_identifiable")
    assert result["posterior"]["second_stage"]["misfit"]["found"] and "regression" not in result["parameters"][0]
    assert any("sensor noise" in reason or "points along" in reason for reason in result["reasons"])


def test_regression_alone_where_asked_and_words_that_are_none(small: Path, quick: None, tmp_path: Path,
                                                                  capsys: pytest.CaptureFixture[str]) -> None:
    code, result = run(small, tmp_path / "alone", BRIEF + 'stage = "regression"\n', candidates='["cubic"]')
    assert code in (0, 1) and result["posterior"]["second_stage"] is None
    assert run(small, tmp_path / "few", BRIEF.replace("400", "200") + 'stage = "regression"\n', candidates='["cubic"]')[0] == 2
    assert "most" in capsys.readouterr().err
    assert run(small, tmp_path / "wrong", BRIEF + 'stage = "forwards"\n')[0] == 2
    assert "forward" in capsys.readouterr().err
