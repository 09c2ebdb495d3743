"""Hypotheses of the user's own, from a file: read, refused in words, weighed by both engines, gone again afterwards."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid import cli
from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch import recorded_answer
from bayes_nlsid.mismatch.campaign import Campaign
from bayes_nlsid.mismatch.catalogue import CATALOGUE, ROWS, with_rows
from bayes_nlsid.mismatch.diagnosis import Diagnosis
from bayes_nlsid.mismatch.laws import Size
from bayes_nlsid.study.diagnosing import run_diagnosis
from bayes_nlsid.study.hypotheses import read_hypotheses
from tests.mismatch.test_recorded import STIFFNESS, write_single
from tests.mismatch.truth import write_case
from tests.robustness.corpus import CASE_FILES, good
from tests.study.test_study_diagnosing import answer

COGGING = """[[hypotheses]]
name = "cogging"
claim = "a force at {place} comes and goes with position"
law = "f*sin(q/d)"
params = { f = ["N", "coefficient"], d = ["m", "displacement"] }
start = { d = [0.1, 0.2, 0.4, 0.8] }
confused = ["softening"]
test = "a slow move over the whole travel"
"""


@pytest.fixture(autouse=True)
def catalogue_stays() -> Iterator[None]:
    yield
    assert list(ROWS) == [row.name for row in CATALOGUE]


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_becomes_rows_with_shapes_in_units_of_the_motion(tmp_path: Path) -> None:
    more = COGGING + """[[hypotheses]]
name = "stribeck"
claim = "friction at {place} falls once it slides"
law = "f*tanh(v/w)*(1 + a*exp(-(v/w)**2))"
params = { f = ["N", "force"], w = ["m/s", "velocity"], a = ["", "range", 0.0, 2.0] }
fixed = ["w"]
confused = ["cogging", "coulomb"]
prior = 0.5
"""
    cogging, stribeck = read_hypotheses(write(tmp_path, more))
    size = Size(1e-4, 0.2, 3e-4)
    shapes = cogging.laws[0].shapes(size)
    assert np.allclose(shapes, [[1, 1e-5], [1, 2e-5], [1, 4e-5], [1, 8e-5]])
    assert cogging.laws[0].free == ("signed", "log") and cogging.laws[0].signed and cogging.phase == "displacement"
    assert stribeck.laws[0].free == ("log", "fixed", "linear") and not stribeck.laws[0].signed
    assert stribeck.phase == "velocity" and stribeck.prior == 0.5
    assert np.allclose(stribeck.laws[0].shapes(size), [[1, 0.2, 0.5], [1, 0.2, 1.5]])
    assert np.allclose(pickle.loads(pickle.dumps(cogging)).laws[0].shapes(size), shapes)
    with with_rows((cogging, stribeck)):
        assert ROWS["stribeck"] is stribeck
        with pytest.raises(ValueError, match="cogging"), with_rows((cogging,)):
            pass


WRONG = {
    "no file": (None, ["there is no such file", "[[hypotheses]]"]),
    "empty": ("", ["has 0 entries"]),
    "unknown table": ("[[hypothesis]]\n", ["hypothesis", "hypotheses"]),
    "name taken": (COGGING.replace('"cogging"', '"clearance"'), ["1 name", "in the catalogue already"]),
    "name twice": (COGGING + COGGING, ["2 name", "in the catalogue already"]),
    "name with blanks": (COGGING.replace('"cogging"', '"my law"'), ["name", "small letters"]),
    "claim without place": (COGGING.replace("{place}", "the tip"), ["claim", "{place}"]),
    "claim with other braces": (COGGING.replace("comes", "{comes}"), ["claim", "no other braces"]),
    "not the language": (COGGING.replace("sin(q/d)", "__import__('os')"), ["hypotheses", "not allowed"]),
    "unknown name in law": (COGGING.replace("q/d", "x/d"), ["'x'", "parameter"]),
    "unknown rule": (COGGING.replace('"coefficient"', '"coeficient"'), ["coefficient"]),
    "no params": (COGGING.replace('params = { f = ["N", "coefficient"], d = ["m", "displacement"] }\n', ""), ["parameter"]),
    "no factor": (COGGING.replace('f = ["N", "coefficient"]', 'f = ["", "range", 0.1, 1.0]'), ["hold 0 forces", "factor"]),
    "two factors": (COGGING.replace('d = ["m", "displacement"]', 'd = ["m", "coefficient"]'), ["hold 2 forces", "factor"]),
    "not proportional": (COGGING.replace("f*sin(q/d)", "f*f*sin(q/d)"), ["not proportional to f"]),
    "start of the factor": (COGGING.replace("start = { d =", "start = { f ="), ["no parameter that shapes"]),
    "start of nothing": (COGGING.replace("start = { d =", "start = { e ="), ["no parameter that shapes", "d"]),
    "start at zero": (COGGING.replace("[0.1, 0.2, 0.4, 0.8]", "[0.0]"), ["start", "above zero"]),
    "too many starts": (COGGING.replace("[0.1, 0.2, 0.4, 0.8]", str([0.1 + i for i in range(65)])), ["65 combinations"]),
    "fixed factor": (COGGING + 'fixed = ["f"]\n', ["fixed", "name some of d"]),
    "unknown rival": (COGGING.replace('["softening"]', '["sofening"]'), ["confused", "softening"]),
    "prior of zero": (COGGING + "prior = 0\n", ["prior", "positive"]),
    "prior too large": (COGGING + "prior = 1e9\n", ["prior", "up to 100"]),
    "unknown key": (COGGING + 'memory = "masing"\n', ["memory", "not a key"]),
    "law that is not finite": (COGGING.replace("sin(q/d)", "log(q/d)"), ["-inf", "guard"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_every_mistake_is_one_sentence(tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]) -> None:
    text, words = WRONG[case]
    path = tmp_path / "none.toml" if text is None else write(tmp_path, text)
    assert cli.main(["hypotheses", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words), said


def test_the_command_lists_them_beside_the_catalogue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["hypotheses", str(write(tmp_path, COGGING))]) == 0
    table = capsys.readouterr().out
    assert "cogging" in table and "hysteresis" in table and "at a place comes and goes" in table


def test_a_file_that_is_refused_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 0 entries"):
        run_diagnosis(tmp_path, tmp_path / "why", hypotheses=write(tmp_path, ""))
    assert not (tmp_path / "why").exists()


def test_the_log_of_a_diagnosis_tells_a_colleague_what_was_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "c").mkdir()
    for name in CASE_FILES:
        (tmp_path / "c" / name).write_bytes(good(name))
    asked: list[Campaign] = []

    def engine(campaign: Campaign, seed: int, say: Callable[[float, str], None]) -> Diagnosis:
        asked.append(campaign)
        say(0.5, "weighing forces")
        return answer(effect="nothing")

    monkeypatch.setattr(recorded_answer, "diagnose_campaign", engine)
    found = run_diagnosis(tmp_path / "c", tmp_path / "why", seed=7, hypotheses=write(tmp_path, COGGING))
    log = (tmp_path / "why" / "run.log").read_text(encoding="utf-8")
    for word in ("seed 7", "numpy", "input run.npz: SHA-256", "input mine.toml: SHA-256", "[1/2] diagnose: begun", "weighing forces",
                 found.sentence,
                 "note: Beside the catalogue, cogging of mine.toml"):
        assert word in log, word
    assert "cogging" in asked[0].classes
    assert "Beside the catalogue, cogging of mine.toml" in (tmp_path / "why" / "report.html").read_text(encoding="utf-8")
    (tmp_path / "c" / "nominal.npz").write_bytes(b"torn")
    with pytest.raises(InputError):
        run_diagnosis(tmp_path / "c", tmp_path / "why")
    assert "refused: " in (tmp_path / "why" / "run.log").read_text(encoding="utf-8").splitlines()[-1]


@pytest.mark.slow
def test_a_law_outside_the_catalogue_is_named_in_recordings_of_any_kind(tmp_path: Path) -> None:
    write_single(tmp_path / "c", lambda u, v: 0.35 * STIFFNESS * 0.006 * np.sin(u / 0.0025), seed=3, push=20.0)
    without = run_diagnosis(tmp_path / "c", tmp_path / "without")
    found = run_diagnosis(tmp_path / "c", tmp_path / "with", hypotheses=write(tmp_path, COGGING))
    assert without.hypotheses[0].effects[0][0] in ("none", "other")
    assert found.hypotheses[0].effects == (("cogging", "spring"),) and found.hypotheses[0].probability > 0.8
    assert found.heldout["nrmse_extended"] < 0.1 * found.heldout["nrmse_updated_linear"]
    d = next(p for p in found.hypotheses[0].parameters if p["name"].endswith(".d"))
    assert abs(d["q50"] / 0.0025 - 1) < 0.05


@pytest.mark.slow
def test_a_law_outside_the_catalogue_is_named_in_a_case_folder(tmp_path: Path) -> None:
    truth = write_case(tmp_path / "c", "cogging", "TIP_w", 0.1, seed=11)
    found = run_diagnosis(tmp_path / "c", tmp_path / "why", hypotheses=write(tmp_path, COGGING))
    assert found.hypotheses[0].effects == (("cogging", "TIP_w"),) and found.hypotheses[0].probability > 0.8
    assert np.linalg.norm(found.predictions["sealed_ms_accel_q50"] - truth["sealed_ms"]) < 0.05 * np.linalg.norm(truth["sealed_ms"])
