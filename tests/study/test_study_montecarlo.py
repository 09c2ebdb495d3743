"""``nlsid montecarlo``: files, ranking, resumption after a kill, and one sentence for each mistake."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.cli import main
from bayes_nlsid.errors import InputError
from bayes_nlsid.study.reading import read_study

ROOT = Path(__file__).resolve().parents[2]
TABLE = """
[montecarlo]
at = "x"
amplitude = "2 mm"
amplitudes = ["0.5 mm", "1 mm", "1.8 mm"]
source = "fit"
scatter = "1 %"
samples = 100

[[montecarlo.parameters]]
parameter = "f[[]1]"
kind = "uniform"
lower = 20.0
upper = 20.02

[[montecarlo.parameters]]
parameter = "*.c"
scatter = "10 %"
"""


@pytest.fixture(scope="module")
def study(small: Path) -> Path:
    path = small.parent / "montecarlo.toml"
    path.write_text(small.read_text(encoding="utf-8") + TABLE.replace('"f[[]1]"', '"f[1]"'), encoding="utf-8")
    return path


def test_from_a_run_to_the_report(study: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished / "stages", out / "stages")
    assert main(["montecarlo", str(study), "--out", str(out)]) == 0
    assert "first order" in capsys.readouterr().out
    said = json.loads((out / "montecarlo.json").read_text())
    assert said["format"] == 1 and said["status"] == "ok" and said["samples"] == 128 and said["paths"] == {"fast": 128}
    # damping comes from zeta; the frequency at 1.8 mm from the hardening spring, whose share of it is 3 % times 10 %
    assert said["sensitivity"]["damping"][0]["name"] == "zeta[1]" and said["sensitivity"]["frequency"][0]["name"] == "cubic[x].c"
    assert said["sensitivity"]["frequency"][0]["total"] > 0.8
    assert said["numerical"]["frequency_hz"] < 0.01 and said["convergence"]["counts"][-1] == 128
    with np.load(out / "montecarlo.npz") as file:
        arrays = dict(file)
    names = {p["name"]: j for j, p in enumerate(said["parameters"])}
    f = arrays["samples_theta"][:, names["f[1]"]]
    c = arrays["samples_theta"][:, names["cubic[x].c"]]
    assert f.min() >= 20.0 and f.max() <= 20.02 and c.std() / c.mean() == pytest.approx(0.1, abs=0.01)
    assert arrays["samples_frequency"].shape == (128, 3) and arrays["total_frequency"].shape == (3, 3)
    assert arrays["frequency_q95"] == pytest.approx(np.quantile(arrays["samples_frequency"], 0.95, axis=0))
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Scatter and what it comes from" in page
    assert {"scatter_band.png", "scatter_parameters.png", "sensitivity.png", "tornado.png", "scatter_convergence.png"} <= {
        p.name for p in (out / "figures").iterdir()}


def test_samples_of_a_posterior(small: Path, quick: None, tmp_path: Path) -> None:
    text = small.read_text(encoding="utf-8") + '[posterior]\nstage = "regression"\nensembles = 2\nsteps = 60\nmost = 400\n'
    path = tmp_path / "posterior.toml"
    text = text.replace("recording.npz", str(small.parent / "recording.npz")) + TABLE[:TABLE.index("source")]
    path.write_text(text + "samples = 300\n", encoding="utf-8")
    main(["montecarlo", str(path), "--out", str(tmp_path / "out"), "--quiet"])
    said = json.loads((tmp_path / "out" / "montecarlo.json").read_text())
    assert said["source"] == "posterior" and not said["independent"] and said["samples"] == 300
    shares = {r["name"]: r["first"] for r in said["sensitivity"]["damping"]}
    assert shares["zeta[1]"] > 0.8


@pytest.mark.parametrize(("right", "wrong", "words"), [
    ('source = "fit"', 'source = "posterior"', ["[montecarlo] source", "there is no [posterior]"]),
    ('source = "fit"', 'source = "prior"', ["source", "'prior' is not possible"]),
    ('scatter = "1 %"', 'scatter = "-1 %"', ["scatter", "not positive"]),
    ('scatter = "1 %"\n', 'scatters = "1 %"\n', ["scatters", "did you mean 'scatter'"]),
    ("samples = 100", "samples = 3", ["samples", "out of range"]),
    ("samples = 100", "samples = 100000000", ["samples", "out of range"]),
    ("samples = 100", 'path = "quick"', ["path", "'quick' is not possible"]),
    ('at = "x"\namp', 'at = "y"\namp', ["[montecarlo] at", "'y' is not a location"]),
    ("upper = 20.02", "", ["[[montecarlo.parameters]] 1 upper", "is missing"]),
    ("upper = 20.02", "upper = 19.0", ["upper", "not above lower"]),
    ('kind = "uniform"', 'kind = "gamma"', ["kind", "'gamma' is not possible"]),
])
def test_mistakes_in_the_table(right: str, wrong: str, words: list[str], study: Path) -> None:
    path = study.parent / "wrong_montecarlo.toml"
    path.write_text(study.read_text(encoding="utf-8").replace(right, wrong), encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_study(path)
    assert all(word in str(error.value) for word in words), error.value


def test_a_parameter_that_does_not_exist_is_said(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = study.parent / "unknown_montecarlo.toml"
    path.write_text(study.read_text(encoding="utf-8").replace('parameter = "*.c"', 'parameter = "*.k"'), encoding="utf-8")
    assert main(["montecarlo", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "[[montecarlo.parameters]] 2" in said and "'*.k' is none of the parameters f[1]" in said


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_ten_thousand_samples_survive_kill_9(study: Path, tmp_path: Path) -> None:
    """Killed again and again; what is left at the end is what an undisturbed run leaves."""
    path = study.parent / "many.toml"
    path.write_text(study.read_text(encoding="utf-8").replace("samples = 100", "samples = 10000"), encoding="utf-8")
    calm, hunted = tmp_path / "calm", tmp_path / "hunted"
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-m", "bayes_nlsid", "montecarlo", str(path), "--quiet", "--out"]
    subprocess.run([*command, str(calm)], check=True, env=environment)
    kills, seen = 0, 0
    while kills < 3:
        run = subprocess.Popen([*command, str(hunted)], env=environment)
        while run.poll() is None:
            chunks = len(list(hunted.glob("stages/.montecarlo.*.work/chunk_*.npz")))
            if chunks >= seen + 20:
                run.send_signal(signal.SIGKILL)
                run.wait()
                kills, seen = kills + 1, chunks
                break
            time.sleep(0.01)
        else:
            break
    assert kills >= 1
    subprocess.run([*command, str(hunted)], check=True, env=environment)
    with np.load(calm / "montecarlo.npz") as one, np.load(hunted / "montecarlo.npz") as other:
        assert sorted(one.files) == sorted(other.files)
        assert all(np.array_equal(one[k], other[k], equal_nan=one[k].dtype.kind == "f") for k in one.files)
        assert len(one["samples_frequency"]) == 16384


def test_an_interval_that_holds_zero_is_explained() -> None:
    from bayes_nlsid.study.report_extras import chance_words

    assert chance_words([{"name": "f", "total_low": 0.4}, {"name": "c", "total_low": None}]) == ""
    said = chance_words([{"name": "f", "total_low": 0.4}, {"name": "zeta", "total_low": -0.02}])
    assert "zeta hold zero" in said and "f" not in said.split("intervals of ")[1].split(" hold")[0]
