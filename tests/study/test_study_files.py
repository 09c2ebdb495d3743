"""Studies that take their model and their modes from files of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.run import run_study

STUDY = '''
title = "two masses"
[structure]
kind = "matrices"
mass = "m.mtx"
stiffness = "k.mtx"
locations = "l.csv"
length_unit = "mm"
force_unit = "N"
[reduction]
modes = 2
[[recordings]]
file = "run.csv"
time = "time"
[[recordings.channels]]
array = "tip"
quantity = "acceleration"
location = "tip"
[linear]
file = "modes.csv"
update = []
'''


def write(folder: Path, text: str = STUDY) -> Path:
    (folder / "m.mtx").write_text("1,1, 1,1, 1e-3\n2,1, 2,1, 1e-3\n")  # t: 1 kg each
    (folder / "k.mtx").write_text("1,1, 1,1, 20.\n2,1, 1,1, -10.\n2,1, 2,1, 20.\n")  # N/mm
    (folder / "l.csv").write_text("name,dof,coefficient,role\nroot,1.1,1,other\ntip,2.1,1,sensors\n")
    (folder / "modes.csv").write_text("frequency [Hz],damping [%],root,tip\n16,0.2,1,1\n27.5,0.3,1,-1\n")
    t = np.arange(400) / 500
    rows = [f"{a:.4f},{b:.6f}" for a, b in zip(t, np.sin(90 * t) * np.exp(-t), strict=True)]
    (folder / "run.csv").write_text("time [s],tip [g]\n" + "\n".join(rows) + "\n")
    path = folder / "study.toml"
    path.write_text(text)
    return path


def test_matrices_in_mm_and_modes_from_a_table(tmp_path: Path) -> None:
    study = read_study(write(tmp_path))
    assert {name for name, _ in study.inputs} == {"study.toml", "m.mtx", "k.mtx", "l.csv", "modes.csv", "run.csv"}
    result = run_study(study, tmp_path / "out")
    rows = result["linear"]["modes"]
    assert [r["measured_hz"] for r in rows] == [16.0, 27.5] and rows[0]["model_hz"] == pytest.approx(np.sqrt(1e4) / (2 * np.pi))
    assert rows[1]["zeta"] == pytest.approx(0.003) and rows[1]["mac"] == pytest.approx(1.0)
    assert any("mm, N and s, converted to SI" in n for n in result["linear"]["notes"])
    report = (tmp_path / "out" / "report.html").read_text()
    assert "converted to SI" in report and "g → m/s²" in report


def test_inputs_are_named_as_seen_from_the_study(tmp_path: Path) -> None:
    """The same study says the same wherever it lies, also with its recordings in a folder beside it."""
    found = []
    for place in ("here", "there"):
        folder = tmp_path / place / "studies" / "one"
        (tmp_path / place / "data").mkdir(parents=True)
        folder.mkdir(parents=True)
        path = write(folder, STUDY.replace("run.csv", "../../data/run.csv"))
        (folder / "run.csv").rename(tmp_path / place / "data" / "run.csv")
        found.append(read_study(path).inputs)
    assert found[0] == found[1] and "../../data/run.csv" in dict(found[0])


@pytest.mark.parametrize(("old", "new", "words"), [
    ('file = "modes.csv"', 'file = "none.csv"', r"\[linear\] file: there is no file"),
    ('file = "modes.csv"', 'file = "modes.csv"\nrecording = "run"', "is given beside recording"),
    ('update = []', '[linear.sensors]\nnowhere = "tip"', "'nowhere' is not a location"),
    ('update = []', '[linear.sensors]\ntip = "top"', "holds no shape 'top'"),
    ('length_unit = "mm"', 'length_unit = "N"', r"\[structure\] length_unit"),
    ('length_unit = "mm"', "", "does not say its units"),
])
def test_mistakes(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_study(write(tmp_path, STUDY.replace(old, new)))
