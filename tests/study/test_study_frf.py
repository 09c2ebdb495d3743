"""``nlsid frf``: from the stored run to files, figure and report; resumed, and refused in one sentence where it cannot work."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.cli import main
from bayes_nlsid.errors import InputError
from bayes_nlsid.study import pictures
from bayes_nlsid.study.reading import read_study

FRF = '[frf]\ninput = "x"\noutput = "x"\nlevels = ["0.6 N", "0.05 N"]\nband = ["17 Hz", "27 Hz"]\nsamples = 8\n'


@pytest.fixture(scope="module")
def study(small: Path) -> Path:
    path = small.parent / "frf.toml"
    path.write_text(small.read_text(encoding="utf-8") + FRF, encoding="utf-8")
    return path


def test_from_a_run_to_the_report(study: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                  monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished / "stages", out / "stages")
    assert main(["frf", str(study), "--out", str(out)]) == 0
    assert "peak (Hz)" in capsys.readouterr().out
    with np.load(out / "frf.npz") as file:
        arrays = dict(file)
    assert arrays["level"].tolist() == [0.05, 0.6]
    assert {"up_q05", "up_q50", "up_q95", "down_q50", "samples_up", "curve1_phase"} <= arrays.keys()
    result = json.loads((out / "result.json").read_text())
    peaks = result["frf"]["peaks"]
    # truth: 20.3 Hz, 1.2 %, 4e8 N/m3; small level: F/(2 zeta w^2)
    assert result["frf"]["status"] == "ok" and peaks[0]["frequency_q50"] == pytest.approx(20.3, rel=3e-3)
    assert peaks[0]["amplitude_q50"] == pytest.approx(0.05 / (2 * 0.012 * (2 * np.pi * 20.3) ** 2), rel=0.05)
    assert peaks[1]["frequency_q50"] > peaks[0]["frequency_q50"] + 0.2
    assert (out / "figures" / "response_curves.png").stat().st_size > 5000
    assert "Response to stepped sines" in (out / "report.html").read_text(encoding="utf-8")
    log = out / "run.log"
    log.unlink()
    monkeypatch.setattr(pictures, "draw_all", lambda *_: [])
    # again, on two processes: nothing is computed; then a plain run keeps the section
    assert main(["frf", str(study), "--out", str(out), "--workers", "2", "--quiet"]) == 0
    assert log.read_text().count("taken from an earlier run") == 4
    assert main(["run", str(study), "--out", str(out), "--quiet"]) == 0
    assert "Response to stepped sines" in (out / "report.html").read_text(encoding="utf-8")
    # a change in the run makes the curves those of another model
    text = study.read_text(encoding="utf-8").replace("starts = 20", "starts = 5")
    changed = study.parent / "changed.toml"
    changed.write_text(text, encoding="utf-8")
    assert main(["run", str(changed), "--out", str(out), "--quiet"]) == 0
    assert "Response to stepped sines" not in (out / "report.html").read_text(encoding="utf-8")


def test_a_study_without_the_table_is_refused(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["frf", str(small), "--out", str(tmp_path / "out")]) == 2
    assert "[frf]: is missing" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(("right", "wrong", "words"), [
    ('input = "x"', 'input = "y"', ["[frf] input", "'y' is not a location"]),
    ('output = "x"\n', "", ["[frf] output", "is missing"]),
    ('["0.6 N", "0.05 N"]', '["0.6 N", "0.6 N"]', ["levels", "different"]),
    ('["0.6 N", "0.05 N"]', '["0.6 mm"]', ["levels", "mm"]),
    ('["0.6 N", "0.05 N"]', "[-1.0]", ["levels", "above zero"]),
    ('["17 Hz", "27 Hz"]', '["27 Hz", "17 Hz"]', ["band", "lower to a higher"]),
    ('["17 Hz", "27 Hz"]', '["0 Hz", "17 Hz"]', ["band", "begins at zero"]),
    ("samples = 8", "samples = 1", ["samples", "out of range"]),
    ("samples = 8", "harmonics = 0", ["harmonics", "out of range"]),
    ("samples = 8", "sample = 8", ["sample", "did you mean 'samples'"]),
])
def test_mistakes_in_the_table(right: str, wrong: str, words: list[str], study: Path) -> None:
    path = study.parent / "wrong.toml"
    path.write_text(study.read_text(encoding="utf-8").replace(right, wrong), encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_study(path)
    assert all(word in str(error.value) for word in words), error.value
