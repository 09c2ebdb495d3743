"""Recordings and matrices that cannot be used: `nlsid check` reads them all and answers in one sentence, as `nlsid run` does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.cli import main
from bayes_nlsid.study.template import TEXT

N, FS = 4096, 1024.0
QUIET = 'role = "noise"\n'
CSV = '''title = "table"
[structure]
kind = "oscillator"
frequency = 20
zeta = 0.01
[[recordings]]
file = "table.csv"
time = "t"
[[recordings.channels]]
array = "a"
quantity = "acceleration"
unit = "g"
location = "x"
'''
MATRICES = CSV.replace('kind = "oscillator"\nfrequency = 20\nzeta = 0.01', 'kind = "matrices"\nmass = "m.npz"\nsensors = ["x"]')
ROWS = "\n".join(f"{i / 100:.2f},{np.sin(0.7 * i):.6f}" for i in range(300))
EYE = {"M": np.eye(2), "K": np.diag([4e3, 9e3]), "location_names": np.array(["x"]), "location_vectors": np.array([[1.0, 0.0]])}


def arrays() -> dict[str, Any]:
    rng = np.random.default_rng(1)
    return {"acceleration": rng.standard_normal(N), "force": rng.standard_normal(N), "quiet": 1e-3 * rng.standard_normal(N), "fs": FS}


def swap(**new: Any) -> dict[str, Any]:
    return {**arrays(), **new}


def holed() -> np.ndarray:
    x = arrays()["acceleration"]
    x[700] = np.nan
    return x


# what stands in the study file instead, what the archive holds, and parts of the sentence
ARCHIVES: dict[str, tuple[tuple[str, str], dict[str, Any], list[str]]] = {
    "NaN in a column": (("", ""), swap(acceleration=holed()), ["channel 'x'", "1 samples are missing", "sample 700", "give window ="]),
    "array not there": (('array = "force"', 'array = "forces"'), arrays(), ["array 'forces' is not in the file", "acceleration (4096,)"]),
    "no such column": (('array = "force"', 'array = "force"\ncolumn = 3'), arrays(), ["has no column 3"]),
    "several columns": (("", ""), swap(acceleration=np.ones((N, 3))), ["has 3 columns", "give column = 0 to 2"]),
    "window beyond the end": (("window = [2.0, 4.0]", "window = [2.0, 60.0]"), arrays(), ["window 2 to 60 s", "move the window"]),
    "quiet record of another rate": (('rate = "fs"\nrole = "noise"', 'rate = 500\nrole = "noise"'), arrays(), ["500 Hz", "1024 Hz"]),
    "quiet record too short": ((QUIET, QUIET + "window = [0.0, 0.01]\n"), arrays(), ["10 samples are too few"]),
    "lengths differ": (("", ""), swap(force=np.ones(N - 96)), ["lengths differ: x 4096, force at x 4000"]),
    "dead sensor": (("", ""), swap(acceleration=np.full(N, 3.0)), ["channel 'x'", "is constant at 3", "drop the channel"]),
    "rate is no number": (("", ""), swap(fs=np.array([FS, FS])), ["array 'fs'", "no sampling rate"]),
    "period does not fit": (('role = "train" ', 'role = "train"\nperiod = 1000 '), arrays(), ["not a whole number of periods of 1000"]),
    "band beyond the rate": (('["5 Hz", "80 Hz"]', '["5 Hz", "900 Hz"]'), arrays(), ["[identification] band", "900 Hz", "1024 Hz"]),
    "rate that does not divide": (("starts = 20", "starts = 20\nrate = 30"), arrays(), ["[identification] rate", "a whole number"]),
    "settling longer than the record": (("starts = 20", "starts = 20\nsettle = 9"), arrays(), ["settle", "leave nothing"]),
    "negative settling": (("starts = 20", "starts = 20\nsettle = -1"), arrays(), ["settle", "negative"]),
    "second mode of an oscillator": (("modes = [1] ", "modes = [1, 2] "), arrays(), ["mode 2 does not exist, the model has 1"]),
    "undamped beyond critical": (("zeta = 0.011", "zeta = 1.2"), arrays(), ["below critical"]),
    "name with brackets": (("[posterior]", '[[terms]]\nname = "my [term]"\nformula = "c*q"\nparams = { c = ["N/m", "coefficient"] }\n'
                            "[posterior]"), arrays(), ["cannot be a name of a term"]),
    "negative noise": (('unit = "N"\n', 'unit = "N"\nnoise = -1.0\n'), arrays(), ["noise", "is negative"]),
    "backbone of a driven motion": (('heldout = ["later part"]', 'measured = "later part"'), arrays(), ["is driven to its end"]),
    "complex numbers": (("", ""), swap(acceleration=arrays()["acceleration"] + 1j), ["'acceleration' holds complex numbers"]),
    "text for numbers": (("", ""), swap(acceleration=np.array(["a"] * N)), ["'acceleration' holds text", "plain numbers"]),
    "pickled archive": (("", ""), swap(acceleration=np.array([{}] * 3, dtype=object)), ["pickled Python objects"]),
}
FILES: dict[str, tuple[str, dict[str, Any], list[str]]] = {
    "text in a cell": (CSV, {"table.csv": "t,a\n" + ROWS.replace("0.50,", "0.50,broken", 1)}, ["line 52, column 2 is no number"]),
    "cell missing": (CSV, {"table.csv": "t,a\n" + ROWS.replace("\n0.50,", "\n0.50", 1)}, ["line 52 has 1 cells, the header 2"]),
    "time runs backward": (CSV, {"table.csv": "t,a\n" + ROWS + "\n0.10,1.0"}, ["time runs backward", "sort the samples"]),
    "time with a gap": (CSV, {"table.csv": "t,a\n" + ROWS + "\n9.00,1.0"}, ["samples are missing after sample 299"]),
    "no header": (CSV, {"table.csv": ROWS}, ["has no header row"]),
    "empty file": (CSV, {"table.csv": ""}, ["is empty"]),
    "header only": (CSV, {"table.csv": "t,a\n"}, ["no header row followed by numbers"]),
    "binary as csv": (CSV, {"table.csv": b"\x00\x01\x02" * 50}, ["is not text"]),
    "unit against the header": (CSV, {"table.csv": "t,a [mm]\n" + ROWS}, ["mm"]),
    "unknown suffix": (CSV.replace("table.csv", "table.xlsx"), {"table.xlsx": b"PK"}, ["'.xlsx' are not read"]),
    "broken mat": (CSV.replace("table.csv", "table.mat"), {"table.mat": b"MATLAB 5.0 MAT-file" + b"\0" * 300}, ["cannot be read as .mat"]),
    "matrix not square": (MATRICES, {"m.npz": {**EYE, "K": np.ones((2, 3))}}, ["K", "square matrix"]),
    "matrices of two sizes": (MATRICES, {"m.npz": {**EYE, "M": np.eye(3)}}, ["m.npz"]),
    "matrix not symmetric": (MATRICES, {"m.npz": {**EYE, "K": np.array([[4e3, 1.0], [0.0, 9e3]])}}, ["symmetric"]),
    "mass not positive": (MATRICES, {"m.npz": {**EYE, "M": np.diag([1.0, -1.0])}}, ["m.npz", "positive"]),
    "NaN in a matrix": (MATRICES, {"m.npz": {**EYE, "K": np.diag([np.nan, 9e3])}}, ["finite"]),
    "stiffness not saved": (MATRICES, {"m.npz": {k: v for k, v in EYE.items() if k != "K"}}, ["K missing"]),
    "sensor not among locations": (MATRICES.replace('["x"]', '["tip"]'), {"m.npz": EYE}, ["unknown locations ['tip']"]),
    "complex matrix": (MATRICES, {"m.npz": {**EYE, "K": EYE["K"] * (1 + 0.01j)}}, ["K", "real numbers"]),
    "rows for other matrices": (MATRICES, {"m.npz": {**EYE, "location_vectors": np.ones((1, 3))}}, ["has (3,) entries"]),
}


def put(path: Path, content: Any) -> None:
    if isinstance(content, dict):
        np.savez(path, **content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content, encoding="utf-8")


def expect(folder: Path, parts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(folder / "study.toml")]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and said.err.startswith("nlsid: ") and said.err.endswith(".\n"), said.err
    for part in parts:
        assert part in said.err, said.err


@pytest.mark.parametrize("name", list(ARCHIVES))
def test_archives_and_tables_that_do_not_go_together(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (right, wrong), content, parts = ARCHIVES[name]
    text = TEXT.replace("window = [8.0, 12.0]", "window = [2.0, 4.0]")
    assert right in text
    text = text.replace(right, wrong, 1) if right else text
    put(tmp_path / "study.toml", text.replace("window = [0.0, 8.0]", "window = [0.0, 2.0]"))
    put(tmp_path / "recording.npz", content)
    expect(tmp_path, parts, capsys)


@pytest.mark.parametrize("name", list(FILES))
def test_files_that_cannot_be_used(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, files, parts = FILES[name]
    put(tmp_path / "study.toml", text)
    put(tmp_path / "table.csv", "t,a\n" + ROWS)
    for file, content in files.items():
        put(tmp_path / file, content)
    expect(tmp_path, parts, capsys)


def test_every_mistake_is_another_one() -> None:
    """The lists here and in `test_study_bad_input` count what they claim: no case stands twice."""
    from tests.study.test_study_bad_input import CASES

    pairs = [(right, wrong) for right, wrong, _ in CASES.values()]
    assert len(set(pairs)) == len(pairs) >= 40
    whole = [(pair, tuple((k, np.asarray(v).dtype.str, np.asarray(v).shape) for k, v in content.items()), parts[-1])
             for pair, content, parts in ARCHIVES.values()]
    assert len(set(whole)) == len(whole)
    assert len({str(f) for f in FILES.values()}) == len(FILES)
    assert len(ARCHIVES) + len(FILES) >= 38


def test_a_run_refuses_like_the_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    put(tmp_path / "study.toml", CSV)
    put(tmp_path / "table.csv", "t,a\n" + ROWS.replace("0.50,", "0.50,broken", 1))
    assert main(["run", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "line 52, column 2 is no number" in capsys.readouterr().err


@pytest.mark.parametrize(("make", "words"), [
    (lambda x: np.clip(x, -0.8, 0.8), "is clipped"),
    (lambda x: np.concatenate([x[:500], np.zeros(40), x[540:]]), "drops to zero"),
])
def test_what_is_doubtful_is_told_before_and_after(make: Callable[[np.ndarray], np.ndarray], words: str, tmp_path: Path,
                                                   capsys: pytest.CaptureFixture[str]) -> None:
    table = np.column_stack([np.arange(1200) / 400, make(np.sin(2 * np.pi * 7 * np.arange(1200) / 400))])
    put(tmp_path / "study.toml", CSV)
    put(tmp_path / "table.csv", "t,a\n" + "\n".join(f"{a:.4f},{b:.6f}" for a, b in table))
    assert main(["check", str(tmp_path / "study.toml")]) == 0
    plan = " ".join(capsys.readouterr().out.split())
    assert words in plan and "no force is recorded, and yet the motion does not decay" in plan


def test_an_inverted_force_and_a_wrong_unit_are_told_by_the_run(quick: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No low-level recording is named, one sensor, one force: the sign and the size of the answer still have to be those of the model."""
    from bayes_nlsid.study.template import example_recording

    text, good = TEXT[:TEXT.index("[identification]")], example_recording()
    for name, change, words in (("right", {}, None), ("turned", {"force": -good["force"]}, "force at x is inverted, or this channel is"),
                                ("in g", {"acceleration": good["acceleration"] / 9.80665}, "g for m/s²")):
        folder = tmp_path / name
        folder.mkdir()
        put(folder / "recording.npz", {**good, **change})
        put(folder / "study.toml", text)
        assert main(["run", str(folder / "study.toml"), "--out", str(folder / "out")]) == 0
        said = " ".join(capsys.readouterr().out.split())
        page = (folder / "out" / "report.html").read_text(encoding="utf-8")
        assert ("beware" in said) == ("Polarity" in page) == (words is not None), said
        assert words is None or (words in said and words in page and words in (folder / "out" / "run.log").read_text(encoding="utf-8"))
