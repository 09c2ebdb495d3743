"""The files, figures and page of a diagnosis."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.diagnosis import Diagnosis, Named
from bayes_nlsid.study import diagnosing
from bayes_nlsid.study import figures as shared
from bayes_nlsid.study import figures_diagnosis as draw
from bayes_nlsid.study import figures_effects as effects
from bayes_nlsid.study.diagnosis_pictures import SECTIONS, pictures
from bayes_nlsid.study.sketch import sketch_of


def law(rng: np.random.Generator, memory: bool, n: int = 400) -> dict[str, Any]:
    """A cubic spring with noise (or a loop) along two superposed sines."""
    t = np.arange(2 * n) / 500
    d = 2e-5 * np.sin(40 * t) + 1e-5 * np.sin(97 * t)
    grid = np.linspace(d.min(), d.max(), 31)
    curve = {} if memory else {f"law_0_{k}": c * grid ** 3 for k, c in (("curve", 1e15), ("low", 9e14), ("high", 1.1e15))}
    curve |= {} if memory else {"law_0_grid": grid}
    return {"law_record": np.array("high_1"), "law_0_displacement": d, "law_0_velocity": np.gradient(d, 1 / 500),
            "law_0_force": 1e15 * d ** 3, "law_0_left": 0.1 * rng.standard_normal(n),
            "law_0_class": np.array("hysteresis" if memory else "hardening"),
            "law_0_place": np.array("J2_slip"), "law_0_unit": np.array("m"),
            "law_0_phase": np.array("memory" if memory else "displacement"),
            **curve}


def numbers(rng: np.random.Generator, effect: str) -> dict[str, Any]:
    """What an engine stores for the figures."""
    n, lines, sensors = 600, 80, 3
    line = np.arange(lines) + 1
    out: dict[str, Any] = {
        "frequency": line / 2, "line_number": line, "line_excited": line % 4 == 1,
        "response_by_line": rng.uniform(1, 9, lines), "residual_by_line": rng.uniform(0.1, 1, lines),
        "left_by_line": rng.uniform(0.05, 0.1, lines),
        "noise_by_line": np.full(lines, 0.05),
        "record_names": np.array(["low_1", "high_1"]), "levels": np.array([0.1, 1.0]), "starts": np.array([10.0, 25.0]),
        "record_before": np.array([1.2, 30.0]), "record_after": np.array([1.0, 1.1]),
        "frf_frequency": line / 2, **{f"frf_{k}": rng.standard_normal((lines, sensors)) + 1j for k in ("measured", "linear", "nominal",
                                                                                                     "extended")},
        "frf_error": np.full((lines, sensors), 0.1), "hypothesis_names": np.array(["hysteresis@J2_slip", "other@-", "none"]),
        "hypothesis_probability": np.array([0.9, 0.07, 0.03]), "place_names": np.array(["J2_slip", "J1_slip"]),
        "place_share": np.array([0.9, 0.6]), "heldout_time": np.arange(n) / 1000, "heldout_half": np.full((n, sensors), 0.3),
        "heldout_channels": np.array(["S1", "S2", "S3"]), "heldout_name": np.array("burst_1"),
        **{f"heldout_{k}": rng.standard_normal((n, sensors)) for k in ("measured", "nominal", "updated", "extended")}}
    f = np.linspace(20, 800, 60)
    if effect == "law" or effect == "loop":
        out |= law(rng, effect == "loop")
    elif effect == "chain":
        out |= {"chain_0_frequency": f, "chain_0_ratio": np.exp(-2e-4j * f) * (1 + 0.01 * rng.standard_normal(60)),
                "chain_0_effect": np.exp(-2e-4j * f), "chain_0_sd": np.full(60, 0.01), "chain_0_class": np.array("sensor_delay"),
                "chain_0_place": np.array("S2")}
    elif effect == "others":
        out |= {"attached_frequency": f, "attached_stiffness": -f ** 2 * (1 + 0.1j), "attached_sd": np.full(60, 9e3),
                "attached_law": -f ** 2 + 0j,
                "attached_class": np.array("added_mass"), "attached_place": np.array("P3"), "attached_unit": np.array("N/m"),
                "drift_place": np.array("J1_slip"), "drift_value": np.array([-2e4, 2e4]), "drift_error": np.array([3e3, 3e3]),
                "drift_start": np.array([10.0, 25.0]), "drift_unit": np.array("N/m"), "clip_time": f / 1e4,
                "clip_measured": np.clip(f, 0, 500),
                "clip_model": f, "clip_level": np.array(500.0), "clip_channel": np.array("S3"), "clip_record": np.array("high_1"),
                "quiet_frequency": f, "quiet_own": 1 / f, "quiet_others": 1 / f ** 2, "quiet_place": np.array("S1"),
                "quiet_mains": np.array(50.0), "quiet_record": np.array("noise"), "quiet_class": np.array("mains_hum"),
                **{f"latent_0_{k}": rng.standard_normal(n) for k in ("force", "displacement", "velocity")}}
    elif effect == "errors":
        out |= {"error_frequency": f, "error_measured_spectrum": 1 / f, "error_time": np.arange(5.0), "error_level": np.arange(1, 6) / 7,
                "error_noise": np.array(0.01), "error_unit": np.array("m"), "error_channel": np.array("y"),
                "error_record": np.array("arrow"),
                **{f"error_{k}_spectrum": 0.1 / f for k in ("nominal", "updated", "extended")},
                **{f"error_{k}_block": np.arange(1, 6) / 70 for k in ("nominal", "updated", "extended")}}
    return out


def answer(verdict: str = "mismatch", effect: str = "law") -> Diagnosis:
    rng = np.random.default_rng(2)
    parameter = {"name": "f_s", "unit": "N", "q05": 9.1, "q50": 10.0, "q95": 11.2, "meaning": "force at which it slips"}
    held = {"records": ["high_2"], "nrmse_nominal": 0.5, "nrmse_updated_linear": 0.2, "nrmse_extended": 0.02, "noise_floor": 0.01,
            "elpd_difference": -300.0, "elpd_se": 200.0, "coverage90": 0.7}
    where = {"locations": [{"name": "J2_slip", "probability": 0.9, "indistinguishable_from": ["J1_slip"]},
                           {"name": "J1_slip", "probability": 0.1, "indistinguishable_from": ["J2_slip"]}],
             "amplitude": {"onset": 4.2e-6, "unit": "m"}, "band_hz": [31.0, 45.5], "phase": "memory", "time": "throughout"}
    return Diagnosis("case <1>", 4, 3.0, verdict, 0.97, where, (
        Named((("hysteresis", "J2_slip"),), 0.9, (parameter,), "Friction with memory at J2.", "a test at ten times the level"),
        Named((("other", "-"),), 0.07), Named((), 0.03)), held, "Something is missing at J2.",
        {"odd_lines": 31.5, "even_lines": float("nan")}, ("one note",), {}, {} if effect == "nothing" else numbers(rng, effect))


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing is what is tested, not the number of dots."""
    monkeypatch.setattr(shared, "DPI", 40)


ALWAYS = {"where", "distortion", "hypotheses", "transfer_function", "before_after"}


@pytest.mark.parametrize(("effect", "more"), [
    ("law", {"latent_force"}), ("loop", {"latent_force"}), ("chain", {"measuring_chain"}),
    ("others", {"attached", "drift", "clipping", "quiet", "free_force"}), ("errors", {"errors"})])
def test_every_effect_has_its_figures(effect: str, more: set[str]) -> None:
    drawn = pictures(answer(effect=effect))
    assert set(drawn) == ALWAYS | more
    assert set(drawn) <= {name for names in SECTIONS.values() for name in names}   # each stands in a section of the page
    assert all(image.startswith(b"\x89PNG") and len(caption) > 30 for image, caption in drawn.values())


def test_nothing_found_draws_no_place_and_no_extension() -> None:
    found = answer("none", "nothing")
    rng = np.random.default_rng(1)
    quiet = replace(found, figures={k: v for k, v in numbers(rng, "law").items() if not k.startswith("law")})
    assert set(pictures(quiet)) == ALWAYS - {"where"}


def test_the_close_look_and_the_scales_of_errors() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(800) / 1000
    measured = np.sin(90 * time)[:, None]
    waves = {"measured": measured, "nominal": 0 * measured, "updated": 0.9 * measured,
             "extended": measured + 1e-3 * rng.standard_normal((800, 1))}
    figure = draw.before_after(time, waves, "facts", ["S1"], ["m"], np.full((800, 1), 1e-3))
    titles = [axes.get_title() + axes.get_title(loc="left") for axes in figure.axes]
    assert "(scale 10 times finer)" in titles[2] and "times finer" not in titles[1]
    band = [float(p.get_offsets().size) for axes in figure.axes[3:] for p in axes.collections]
    assert len(band) == 2   # the error panel of the extended model and the close look have a band
    fine = next(line for line in figure.axes[-1].lines if line.get_label() == "with what was found")
    x, y = np.asarray(fine.get_xdata(), dtype=float), np.asarray(fine.get_ydata(), dtype=float)
    assert len(x) > 4 * len(figure.axes[-1].lines[-1].get_xdata()) and np.abs(y - np.sin(90 * x) * (1e3 if y.max() > 10 else 1)).max() < 20


def test_a_law_is_drawn_over_its_own_coordinate_with_its_band() -> None:
    numbers_of = {k.removeprefix("law_0_"): v for k, v in law(np.random.default_rng(1), False).items() if k.startswith("law_0")}
    figure = effects.force_law(numbers_of, onset=1e-5)
    left, right = figure.axes[:2]
    assert len(left.collections) == 1 and not right.collections and "displacement at J2_slip (µm)" in figure.axes[2].get_xlabel()
    drawn = next(line for line in left.lines if line.get_linewidth() > 1.5)
    assert np.asarray(drawn.get_ydata()).max() == pytest.approx(1e15 * numbers_of["grid"].max() ** 3, rel=1e-6)
    loop = {k.removeprefix("law_0_"): v for k, v in law(np.random.default_rng(1), True).items() if k.startswith("law_0")}
    assert not effects.force_law(loop).axes[0].collections


def test_the_loudest_stretch_holds_the_largest_displacement() -> None:
    t = np.arange(4000) / 1000
    d = np.exp(-((t - 2.3) ** 2)) * np.sin(60 * t)
    piece = effects.loudest(d, np.gradient(d, t), 3)
    assert piece.start <= int(np.argmax(np.abs(d))) < piece.stop and 200 < piece.stop - piece.start < 450


def test_medians_of_bins_follow_a_curve_in_noise() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal(20000)
    at, low, middle, high = effects.binned(x, x ** 3 + rng.standard_normal(20000))
    inner = np.abs(at) < 2
    assert np.abs(middle - at ** 3)[inner].max() < 0.5 and (low < high).all()


def test_a_sketch_knows_where_places_are(tmp_path: Path) -> None:
    geometry = {"L_A": 0.5, "L_B": 0.4, "overlap": 0.1, "h_A": 0.008, "h_B": 0.006, "joints": [0.42, 0.48],
                "sensors": [{"name": "S1", "beam": "B", "x": 0.7, "mass_point": "P1"}], "shaker": {"beam": "A", "x": 0.2}}
    (tmp_path / "case.json").write_text(json.dumps({"geometry": geometry, "locations": {"joints": ["J2_slip", "TIP_w"]}}))
    sketch = sketch_of(tmp_path)
    assert sketch is not None and sketch.length == pytest.approx(0.8)
    assert sketch.points["J2_slip"] == (0.48, 0.008) and sketch.points["P1"] == pytest.approx((0.7, 0.014))
    assert sketch.points["TIP_w"][0] == pytest.approx(0.8) and sketch.points["FORCE"] == (0.2, 0.0)
    plain, drawn = (draw.where([("J2_slip", 0.9), ("FORCE", 0.1)], [], [], np.zeros(0), s) for s in (None, sketch))
    assert len(plain.axes) == 1 and len(drawn.axes) == 2 and "J2_slip  90 %" in [t.get_text() for t in drawn.axes[-1].texts]
    (tmp_path / "case.json").write_text(json.dumps({"geometry": {"joints": []}}))
    assert sketch_of(tmp_path) is None and sketch_of(tmp_path / "nowhere") is None


@pytest.mark.parametrize("figures", [True, False])
def test_everything_is_left(figures: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosing, "diagnose", lambda path, seed, progress: answer(effect="law" if figures else "nothing"))
    (tmp_path / "out" / "figures").mkdir(parents=True)
    (tmp_path / "out" / "figures" / "of_an_earlier_answer.png").write_bytes(b"")
    diagnosing.run_diagnosis(tmp_path, tmp_path / "out")
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert found["format"] == 1 and found["hypotheses"][0]["effects"] == [{"class": "hysteresis", "location": "J2_slip"}]
    assert {p.stem for p in (tmp_path / "out" / "figures").glob("*.png")} == (
        ALWAYS | {"latent_force"} if figures else {"where"})
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for words in ("case &lt;1&gt;: something is missing", "hysteresis at J2_slip", "90.0 %", "force at which it slips",
                  "9.10 N", "11.2 N",
                  "What would confirm it: a test at ten times the level", "2 %", "one note",
                  "cannot tell it from J1_slip", "above about 4.2 µm", "31 to 45.5 Hz", "with the history of displacement",
                  "outside the catalogue",
                  "-300 ± 200 nats", "that cannot be told from no change", "70 % of the samples: too narrow", "31.5",
                  "Not testable with these recordings: power on even lines"):
        assert words in page, words
    assert "http" not in page.replace("http-equiv", "")


def test_answer_on_one_screen() -> None:
    text = diagnosing.lines(answer())
    assert " 90.0 %  hysteresis at J2_slip" in text and "50 % as delivered, 20 % re-tuned, 2 % extended" in text


def test_cannot_tell_is_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from bayes_nlsid.cli import main

    monkeypatch.setattr(diagnosing, "diagnose", lambda path, seed, progress: answer("cannot_tell", "nothing"))
    assert main(["diagnose", str(tmp_path), "--out", str(tmp_path / "out"), "--seed", "4"]) == 1
    assert "cannot_tell" in capsys.readouterr().out


def test_a_study_that_says_nothing_is_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text("")
    with pytest.raises(InputError, match="study.toml"):
        diagnosing.run_diagnosis(tmp_path / "study.toml", tmp_path / "out")
    assert not (tmp_path / "out" / "diagnosis.json").exists()
