"""A run skips what is unchanged, survives a kill anywhere, and says the same every time."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.progress import Reporter, duration
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.run import rebuild_report, run_study
from bayes_nlsid.study.template import TEXT

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src")}


def timeless(out: Path) -> dict[str, Any]:
    """What must be the same however often a run was interrupted."""
    result = json.loads((out / "result.json").read_text())
    for stage in result["stages"].values():
        stage.pop("seconds")
    return result


def log_of(out: Path) -> str:
    return (out / "run.log").read_text(encoding="utf-8")


def test_finds_what_made_the_recording(finished: Path) -> None:
    """Truth: 20.3 Hz, 1.2 % and 4e8 N/m³ (see the template); noise 0.2 %."""
    result = timeless(finished)
    values = {p["name"]: p["fit"] for p in result["parameters"]}
    assert result["status"] == "ok" and result["selection"]["terms"] == [{"index": 2, "name": "cubic", "locations": ["x"]}]
    assert values["f[1]"] == pytest.approx(20.3, rel=5e-3)
    assert values["cubic[x].c"] == pytest.approx(4e8, rel=0.1)


def test_every_mean_square_is_of_one_kind(finished: Path) -> None:
    """What is called left and removed compares like with like: the score is the end of the path that begins at the linear model."""
    (record,) = json.loads((finished / "stages" / "identify" / "data.json").read_text())["variants"]
    score = timeless(finished)["selection"]["score"]
    last = [step["mse"] for step in record["path"] if step["accepted"]][-1]
    assert score["mse"] == pytest.approx(record["mse_of_fit"], rel=1e-3) and score["mse"] <= last * (1 + 1e-6)
    assert score["floor"] < score["mse"] < 0.05 * score["mse_linear"]


def test_the_integration_states_its_band_and_error(finished: Path) -> None:
    """Noise of 0.2 % outside the band is what the example has; a periodic window has no edges."""
    (row,) = json.loads((finished / "stages" / "identify" / "data.json").read_text())["motion"]
    assert row["record"] == "multisine" and row["band_hz"] == [5.0, 80.0] and row["channels"] == ["x"]
    assert 0 <= row["span_s"][0] < row["span_s"][1] <= 4.0 and 1e-5 < row["error"][0] < 0.02


def test_contract_files(finished: Path) -> None:
    assert {"result.json", "report.html", "run.log", "figures", "stages"} <= {p.name for p in finished.iterdir()}
    result = timeless(finished)
    assert result["format"] == 1 and set(result["versions"]) >= {"bayes_nlsid", "numpy"}
    assert set(result["inputs"]) == {"small.toml", "recording.npz"} and all(len(h) == 64 for h in result["inputs"].values())
    assert result["selection"]["forward"] == [2] and {"mse", "mse_linear"} <= result["selection"]["score"].keys()
    assert len(list((finished / "figures").glob("*.png"))) >= 2


def test_second_run_computes_nothing(small: Path, finished: Path, quick: None, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (out / "run.log").unlink()
    run_study(read_study(small), out)
    assert log_of(out).count("taken from an earlier run") == 3
    assert timeless(out) == timeless(finished)


def test_a_prediction_without_posterior(small: Path, finished: Path, quick: None, tmp_path: Path) -> None:
    """A fit alone has a backbone (no band), joint loops that close, and records it is judged on."""
    out, path = tmp_path / "out", small.with_name("predicted.toml")
    shutil.copytree(finished, out)
    path.write_text(small.read_text(encoding="utf-8") + PREDICTED, encoding="utf-8")
    result = run_study(read_study(path), out)
    with np.load(out / "backbone.npz") as found, np.load(out / "stages" / "predict" / "arrays.npz") as arrays:
        assert np.nanmax(np.abs(found["numerical_error_frequency"])) == pytest.approx(result["backbone"]["numerical_error_hz"])
        assert np.array_equal(found["frequency_q05"], found["frequency_q95"], equal_nan=True)
        assert (np.diff(found["frequency_q50"]) > 0).mean() > 0.9, "the spring hardens"
        q, force = arrays["loop0.q"], arrays["loop0.force"]
        assert q[0] == pytest.approx(q[-1], abs=1e-9 * np.ptp(q)) and force[0, 0] == pytest.approx(force[0, -1], abs=1e-9 * np.ptp(force))
        np.testing.assert_allclose(force[0], next(p["fit"] for p in result["parameters"] if p["name"] == "cubic[x].c") * q**3, rtol=1e-9,
                                   atol=1e-12)
    assert result["heldout"]["nrmse"] < 0.02 and result["heldout"]["coverage90"] is None


def test_an_integrator_too_coarse_for_its_band_is_told() -> None:
    from types import SimpleNamespace

    from bayes_nlsid.study.stage_predict import _coarse

    def bands(error: float, width: float, samples: int = 200) -> Any:
        return SimpleNamespace(frequency=80.0 + np.array([[0.0], [0.5], [1.0]]) * np.full(5, width),
                               numerical_error_frequency=np.array([np.nan, 0.0, error, 0.0, 0.0]), samples_frequency=np.zeros((samples, 5)))

    (said,) = _coarse(bands(-0.03, 0.01), "hht")
    assert "up to 0.03 Hz" in said and "0.01 Hz wide" in said and 'scheme = "exponential"' in said
    assert not _coarse(bands(-1e-4, 0.01), "hht") and not _coarse(bands(-0.03, 0.01, 1), "hht")
    assert "exponential" not in _coarse(bands(-0.03, 0.01), "exponential")[0]


@pytest.mark.parametrize(("right", "wrong", "reused"), [
    ('title = "My first', 'title = "My second', 3),            # words change the report only
    ("starts = 20", "starts = 3", 2),
    ("zeta = 0.011", "zeta = 0.012", 1),
    ("window = [0.0, 4.0]", "window = [0.0, 3.0]", 0),
])
def test_only_what_depends_on_a_change_is_redone(right: str, wrong: str, reused: int, small: Path, finished: Path, quick: None,
                                                   tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (out / "run.log").unlink()
    text = small.read_text(encoding="utf-8")
    assert right in text
    changed = small.with_name(f"changed-{tmp_path.name}.toml")
    changed.write_text(text.replace(right, wrong, 1), encoding="utf-8")
    run_study(read_study(changed), out)
    assert log_of(out).count("taken from an earlier run") == reused, log_of(out)


def test_another_seed_redoes_what_draws(small: Path, finished: Path, quick: None, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (out / "run.log").unlink()
    assert run_study(read_study(small), out, seed=7)["seed"] == 7
    assert log_of(out).count("taken from an earlier run") == 2


KILLER = """
import os, sys
from pathlib import Path
from bayes_nlsid.study import pictures, run
from bayes_nlsid.study.reading import read_study
stage = sys.argv[3]
pictures.draw_all = lambda *_: []
real = run._stage
def fatal(name):
    def stage_function(context):
        found = real(name)(context)
        if name == stage:
            os.kill(os.getpid(), 9)
        return found
    return stage_function
run._stage = fatal
if stage == "report":
    run.render = lambda report: os.kill(os.getpid(), 9)
run.run_study(read_study(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.mark.parametrize("stage", [pytest.param("read", marks=pytest.mark.slow), "linear", pytest.param("identify", marks=pytest.mark.slow),
                                   "report"])
def test_kill_and_resume_gives_the_same_numbers(stage: str, small: Path, finished: Path, quick: None, tmp_path: Path) -> None:
    out = tmp_path / "out"
    killed = subprocess.run([sys.executable, "-c", KILLER, str(small), str(out), stage], env=ENVIRONMENT, check=False)
    assert killed.returncode == -9
    run_study(read_study(small), out)
    assert timeless(out) == timeless(finished)
    assert not list((out / "stages").glob(".*"))
    for name in ("read", "linear", "identify"):
        with np.load(out / "stages" / name / "arrays.npz") as a, np.load(finished / "stages" / name / "arrays.npz") as b:
            assert set(a.files) == set(b.files)
            for key in a.files:
                np.testing.assert_array_equal(a[key], b[key])


def test_interrupt_keeps_finished_stages(small: Path, quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bayes_nlsid.study import run

    real = run._stage

    def stopped(name: str) -> Any:
        def press(context: Any) -> Any:
            raise KeyboardInterrupt
        return press if name == "identify" else real(name)

    monkeypatch.setattr(run, "_stage", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_study(read_study(small), tmp_path / "out")
    assert not (tmp_path / "out" / "stages" / "lock").exists()
    monkeypatch.undo()
    run_study(read_study(small), tmp_path / "out")
    assert log_of(tmp_path / "out").count("taken from an earlier run") == 2


def test_report_is_rebuilt_without_the_study_file(small: Path, finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    page = (out / "report.html").read_bytes()
    (out / "report.html").unlink()
    rebuild_report(out)
    assert (out / "report.html").read_bytes() == page


def test_report_of_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no results"):
        rebuild_report(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        rebuild_report(tmp_path / "nowhere")


def test_report_page_stands_alone(finished: Path) -> None:
    from html.parser import HTMLParser

    page = (finished / "report.html").read_text(encoding="utf-8")
    opened: list[str] = []

    class Walker(HTMLParser):
        def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
            values = dict(attributes)
            for name in ("src", "href"):
                assert (values.get(name) or "#").startswith(("#", "data:")), values
            assert tag not in ("script", "link", "iframe")
            if tag not in ("meta", "img", "br"):
                opened.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert opened.pop() == tag

    Walker().feed(page.replace("<!doctype html>", ""))
    assert not opened
    for words in ("cubic at x was chosen", "prefers-color-scheme: dark", "@media print", "SHA-256", "stages/identify", "Next:",
                  "width=device-width", "band and error of the integration"):
        assert words in page, words


def test_report_escapes_what_users_write(small: Path, quick: None, tmp_path: Path) -> None:
    text = small.read_text(encoding="utf-8").replace('title = "My first study', 'title = "<script>alert(1)</script> A & B')
    changed = small.with_name("escaped.toml")
    changed.write_text(text[:text.index("[identification]")], encoding="utf-8")
    run_study(read_study(changed), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>" not in page and "&lt;script&gt;alert(1)&lt;/script&gt; A &amp; B" in page


def test_progress_line_and_log(tmp_path: Path) -> None:
    from io import StringIO

    terminal = StringIO()
    told = Reporter((tmp_path / "a.log", tmp_path / "b.log"), terminal)
    told.begin(1, 2, "read", "not computed yet")
    told.update(1.0, "hammer")
    told.end(75.0, reused=False)
    assert "[1/2] read 100 %" in terminal.getvalue() and "done in 1 min 15 s" in terminal.getvalue()
    assert (tmp_path / "a.log").read_text() == (tmp_path / "b.log").read_text() and "not computed yet" in (tmp_path / "a.log").read_text()


def test_time_left_is_that_of_the_present_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of an earlier run pass at once; then one per cent takes ten seconds. Where nothing moves, nothing is promised."""
    from io import StringIO

    now = [100.0]
    monkeypatch.setattr("bayes_nlsid.study.progress.time.monotonic", lambda: now[0])
    terminal = StringIO()
    told = Reporter((), terminal)
    told.begin(1, 1, "posterior", "x")
    for share in (0.1, 0.3, 0.6):
        now[0] += 0.2
        told.update(share, "")
    for step in range(20):
        now[0] += 10.0
        told.update(0.6 + 0.01 * (step + 1), "")
    assert "80 %, about 3 min 20 s left" in terminal.getvalue().replace("  ", " ")  # 20 more of 10 s each
    told.begin(1, 1, "posterior", "x")
    for _ in range(20):
        now[0] += 10.0
        told.update(0.5, "")
    assert "left" not in terminal.getvalue().rpartition("...")[2].rpartition("\r")[2]


def test_the_log_tells_a_colleague_what_was_done(finished: Path, small: Path, tmp_path: Path) -> None:
    text = log_of(finished)
    first, last = text.splitlines()[0], text.splitlines()[-1]
    assert "small.toml, seed 1, 1 worker, local" in first and "numpy" in first and "input recording.npz: SHA-256" in text
    assert "was chosen from the library" in text and "Next:" in last
    bad = small.with_name("log_bad.toml")
    bad.write_text(small.read_text(encoding="utf-8").replace('"acceleration"', '"absent"', 1), encoding="utf-8")
    with pytest.raises(InputError):
        run_study(read_study(bad), tmp_path)
    assert "refused: " in log_of(tmp_path).splitlines()[-1] and "absent" in log_of(tmp_path)


@pytest.mark.parametrize(("seconds", "text"), [(0.04, "0.0 s"), (12.4, "12 s"), (75, "1 min 15 s"), (7200, "2 h 0 min")])
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


PREDICTED = """
[prediction]
at = "x"
amplitude = "1 mm"
heldout = ["later part"]
"""

SAMPLED = """
[posterior]
ensembles = 2
steps = 200
[prediction]
at = "x"
amplitude = "1 mm"
samples = 4
draws = 10
heldout = ["later part"]
"""

WITHIN = """
import os, sys
from pathlib import Path
from bayes_nlsid.study import context, run
from bayes_nlsid.study.reading import read_study
calls = 0
def killing(self, share, sentence):
    global calls
    calls += sentence.startswith(sys.argv[3])
    if calls == int(sys.argv[4]):
        os.kill(os.getpid(), 9)
run.Reporter.update = killing
run.run_study(read_study(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.fixture(scope="module")
def sampled(small: Path) -> Path:
    path = small.with_name("sampled.toml")
    path.write_text(small.read_text(encoding="utf-8") + SAMPLED, encoding="utf-8")
    return path


@pytest.mark.slow
def test_kill_inside_the_sampler_and_the_prediction(sampled: Path, tmp_path: Path) -> None:
    """Killed after a block of the sampler, then in the middle of the prediction: the same numbers as without interruption, and with two
    workers as with one."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run_study(read_study(sampled), whole)
    for word, count in (("burn-in", 1), ("sampling", 1), ("predicting", 1)):
        done = subprocess.run([sys.executable, "-c", WITHIN, str(sampled), str(broken), word, str(count)], env=ENVIRONMENT, check=False)
        assert done.returncode == -9, (word, done.returncode)
    run_study(read_study(sampled), broken, workers=2)
    assert timeless(broken) == timeless(whole)
    for stage in ("posterior", "predict"):
        with np.load(broken / "stages" / stage / "arrays.npz") as a, np.load(whole / "stages" / stage / "arrays.npz") as b:
            for key in set(a.files) - {"netcdf"}:
                np.testing.assert_array_equal(a[key], b[key], err_msg=f"{stage} {key}")
    assert {"posterior.nc", "backbone.npz"} <= {p.name for p in whole.iterdir()}
    assert not list((broken / "stages").glob(".*"))


@pytest.mark.slow
def test_the_exported_posterior_is_the_one_that_was_sampled(sampled: Path, tmp_path: Path) -> None:
    import arviz

    run_study(read_study(sampled), tmp_path)
    data = arviz.from_netcdf(str(tmp_path / "posterior.nc"))
    assert {"posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data"} <= set(data.groups())
    rows = {p["name"]: p for p in json.loads((tmp_path / "result.json").read_text())["parameters"]}
    middle = float(np.median(data.posterior["f[1]"].values))
    assert middle == pytest.approx(rows["f[1]"]["q50"], rel=1e-12)


def test_the_noise_of_a_sensor_comes_from_the_best_evidence(recording: Path, tmp_path: Path) -> None:
    """A noise record serves whatever its channels are called; without one, what scatters between periods elsewhere does."""
    from bayes_nlsid.study.context import Context

    text = recording.parent.joinpath("best.toml")
    base = TEXT[:TEXT.index("[identification]")]
    text.write_text(base.replace('array = "quiet"\n', 'array = "quiet"\nname = "the same sensor"\n'), encoding="utf-8")
    context = Context(read_study(text), 1)
    assert "from the recording 'quiet'" in context.noise(context.recordings["multisine"]).how
    periodic = base[:base.index("[[recordings]]\nname = \"quiet\"")].replace("window = [0.0, 8.0] ", "period = 1024\nwindow = [0.0, 8.0] ")
    text.write_text(periodic, encoding="utf-8")
    context = Context(read_study(text), 1)
    assert "as in the recording 'multisine', from the differences between 8" in context.noise(context.recordings["later part"]).how
    text.write_text(base.replace('unit = "m/s^2"\nlocation', 'unit = "m/s^2"\nnoise = "2 mm/s^2"\nlocation', 1), encoding="utf-8")
    context = Context(read_study(text), 1)
    assert context.noise(context.recordings["multisine"]).rms() == pytest.approx([2e-3])


def test_a_frequency_at_its_bound_is_a_refusal(small: Path, quick: None, tmp_path: Path) -> None:
    far = small.with_name("far.toml")
    far.write_text(small.read_text(encoding="utf-8").replace('frequency = "20 Hz"', 'frequency = "35 Hz"'), encoding="utf-8")
    result = run_study(read_study(far), tmp_path / "out")
    assert result["status"] == "not_identifiable" and any("f[1] ended at a bound" in reason for reason in result["reasons"])


def test_the_band_of_a_backbone_keeps_other_modes_out() -> None:
    from types import SimpleNamespace

    from bayes_nlsid.structure.modal import ModalModel
    from bayes_nlsid.study.schema import PredictionEntry
    from bayes_nlsid.study.stage_predict import _mode_band

    model = ModalModel(2 * np.pi * np.array([9.0, 16.0, 400.0]), np.full(3, 0.01), ("tip",), np.ones((1, 3)))
    context: Any = SimpleNamespace(model=model)
    bands = [_mode_band(context, PredictionEntry("tip", 1e-3, mode)) for mode in (1, 2, 3)]
    assert bands == [pytest.approx((4.5, 12.0)), pytest.approx((12.0, 25.6)), pytest.approx((200.0, 640.0))]
    assert _mode_band(context, PredictionEntry("tip", 1e-3, band=(1.0, 2.0))) == (1.0, 2.0)
