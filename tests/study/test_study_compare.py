"""``nlsid compare`` from a study: files, the sentence, and mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.cli import main


@pytest.fixture(scope="module")
def study(small: Path) -> Path:
    path = small.parent / "compare.toml"
    text = small.read_text(encoding="utf-8")
    before = next(line for line in text.splitlines() if line.startswith("candidates = "))
    path.write_text(text.replace(before, 'candidates = ["cubic"]') + "\n[compare]\nsamples = 30\n", encoding="utf-8")
    return path


def test_from_nothing_to_the_sentence(study: Path, quick: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["compare", str(study), "--out", str(out)]) == 0
    said = json.loads((out / "compare.json").read_text())
    assert said["status"] == "ok" and said["order"] == ["main", "linear"]
    best, other = said["alternatives"]
    assert best["name"] == "main" and best["elpd_difference"] == 0 and best["stacking_weight"] > 0.99 and best["k_hat"] < 0.7
    assert other["told_from_best"] and other["elpd_difference"] < -100 and other["elpd_se"] > 0
    assert said["sentence"][:40] in capsys.readouterr().out.replace("\n", " ")
    assert "Alternatives compared" in (out / "report.html").read_text(encoding="utf-8")
    import arviz  # here, where its daily notice has been given to the package
    data = arviz.from_netcdf(out / "compare_0.nc")
    assert data.log_likelihood["heldout"].shape == (1, 30, len(said["blocks"])) and "cubic[x].c" in data.posterior
    with np.load(out / "compare.npz") as file:
        density = file["log_density0"]
        assert file["by_block"].shape == (2, len(said["blocks"]))
        assert file["by_block"][0] == pytest.approx(np.log(np.mean(np.exp(density - density.max(axis=0)), axis=0)) + density.max(axis=0))


def test_mistakes_are_one_sentence(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = study.read_text(encoding="utf-8")
    for change, word in ((("samples = 30", 'scenarios = ["S4"]'), "S1, S2, S3"), (('role = "holdout"', 'role = "linear"'), "holdout"),
                         (("samples = 30", "samples = 1"), "samples")):
        path = study.parent / "wrong.toml"
        path.write_text(text.replace(*change), encoding="utf-8")
        assert main(["compare", str(path), "--out", str(tmp_path / "no"), "--quiet"]) == 2
        assert word in capsys.readouterr().err
