"""Studies drafted from files: complete where the files say enough, and where not, every gap is named at once."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid import cli
from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.chains import spring_mass_chain
from bayes_nlsid.study.drafting import draft_study
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.template import example_recording

T = np.arange(2000) / 500
RING = np.exp(-0.5 * T) * np.cos(2 * np.pi * 20 * T)


def table(path: Path, head: str, *columns: np.ndarray) -> Path:
    path.write_text(head + "\n" + "\n".join(",".join(f"{v:.7g}" for v in row) for row in zip(*columns, strict=True)) + "\n")
    return path


def nominal(folder: Path) -> Path:
    chain = spring_mass_chain([1.0, 1.0], [1e4, 1e4])
    np.savez(folder / "nominal.npz", M=chain.M, K=chain.K, sensor_select=np.eye(2), shaker_vector=np.eye(2)[1],
             location_names=np.array(["J1_slip"]), location_vectors=np.array([[-1.0, 1.0]]))
    return folder / "nominal.npz"


def test_a_table_with_units_gives_a_study_that_is_ready(tmp_path: Path) -> None:
    file = table(tmp_path / "decay.csv", "time [s],acc [g]", T, RING)
    study = read_study(draft_study(tmp_path / "new", [file]))
    assert study.structure.parameters["frequency"] == pytest.approx(20, rel=0.02)
    first, second = study.recordings
    assert (first.role, second.role, first.time) == ("train", "holdout", "time") and first.window == (0.0, 2.8)
    assert study.prediction is not None
    assert study.prediction.amplitude == pytest.approx(3 * np.std(RING) * 9.81 / (40 * np.pi) ** 2, rel=0.1)
    text = (tmp_path / "new" / "study.toml").read_text()
    assert '# unit = "g", as written in the file' in text and text.count("guess") >= 8


def test_times_that_were_rounded_give_the_rate_all_the_same(tmp_path: Path) -> None:
    from bayes_nlsid.recordings.readers import read_file
    from bayes_nlsid.study.survey import survey_recording

    t = np.arange(2000) / 1024
    file = table(tmp_path / "decay.csv", "time [s],acc [g]", np.round(t, 6), np.sin(70 * t))
    assert survey_recording(file, read_file(file)).rate == pytest.approx(1024, rel=1e-6)


def test_a_model_and_two_recordings(tmp_path: Path) -> None:
    files = [nominal(tmp_path)]
    for i, name in enumerate(("run1", "run2", "noise")):
        files.append(table(tmp_path / f"{name}.csv", "t [ms],force [N],a1 [m/s^2],a2 [m/s^2]", 1e3 * T, RING, RING + i, 2 * RING))
    study = read_study(draft_study(tmp_path / "new", files))
    assert [r.role for r in study.recordings] == ["train", "holdout", "noise"]
    assert [c.location for c in study.recordings[0].channels] == ["SHAKER", "S1", "S2"]
    assert study.identification is not None and study.identification.joints == ("J1_slip",)
    assert study.prediction is not None and study.prediction.at == "S2" and study.prediction.heldout == ("run2",)


def test_gaps_are_all_named_and_filling_them_makes_it_good(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "recording.npz", **example_recording())
    assert cli.main(["new", str(tmp_path / "new"), "--from", str(tmp_path / "recording.npz")]) == 0
    study = tmp_path / "new" / "study.toml"
    capsys.readouterr()
    assert cli.main(["check", str(study)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "entries are still to be filled in" in said
    for part in ("[structure] mass (modal mass at the sensor, kg)", "[recordings 1.channels 1] unit (unit of acceleration", "[prediction]"):
        assert part in said, said
    text = study.read_text()
    blocks = {"mass": "1.0", "amplitude": '"2 mm"', "quantity": '"acceleration"'}
    for key, value in blocks.items():
        text = re.sub(rf'^{key} = "FILL IN[^"]*"', f"{key} = {value}", text, flags=re.MULTILINE)
    for array, unit in (("acceleration", "m/s^2"), ("force", "N"), ("quiet", "m/s^2")):
        text = re.sub(rf'^unit = "FILL IN: unit of {array} [^"]*"', f'unit = "{unit}"', text, flags=re.MULTILINE)
    study.write_text(text)
    assert cli.main(["check", str(study)]) == 0, capsys.readouterr().err


def test_matrices_of_a_program_ask_for_their_units(tmp_path: Path) -> None:
    (tmp_path / "job_MASS1.mtx").write_text("1,1, 1,1, 1e-3\n2,1, 2,1, 1e-3\n")
    (tmp_path / "job_STIF1.mtx").write_text("1,1, 1,1, 20.\n2,1, 1,1, -10.\n2,1, 2,1, 20.\n")
    (tmp_path / "where.csv").write_text("name,dof,coefficient,role\ntip,2.1,1,sensors\nJ,1.1,1,joints\n")
    (tmp_path / "modes.csv").write_text("frequency [Hz],damping [%],tip\n16,0.2,1\n")
    file = table(tmp_path / "decay.csv", "time [s],tip [g]", T, RING)
    names = ("job_STIF1.mtx", "where.csv", "modes.csv", "job_MASS1.mtx")
    study = draft_study(tmp_path / "new", [*(tmp_path / n for n in names), file])
    with pytest.raises(InputError, match=r"2 entries are .*\[structure\] length_unit \(.*\); \[structure\] force_unit"):
        read_study(study)
    study.write_text(study.read_text().replace("FILL IN: unit of length of the model, m or mm", "mm")
                     .replace("FILL IN: unit of force of the model, N or kN", "N"))
    read = read_study(study)
    assert read.linear.file is not None and read.locations == ("tip", "J")


@pytest.mark.parametrize(("names", "words"), [
    (["none.csv"], "there is no such file"), (["nominal.npz"], "holds no recording"), (["a.wav"], "are not read"),
    (["nominal.npz", "nominal.npz", "decay.csv"], "both look like the mass"), (["k.mtx", "decay.csv"], "comes without a mass matrix"),
    (["short.csv"], "no array of 16 samples"), (["decay.csv", "copy.csv"], "copy.csv: holds the same as decay.csv"),
    (["decay.csv", "folder"], "is a folder"),
])
def test_files_that_make_no_study(tmp_path: Path, names: list[str], words: str) -> None:
    nominal(tmp_path)
    table(tmp_path / "decay.csv", "time [s],acc [g]", T, RING)
    table(tmp_path / "short.csv", "time [s],acc [g]", T[:5], RING[:5])
    (tmp_path / "k.mtx").write_text("1,1, 1,1, 20.\n")
    (tmp_path / "a.wav").write_bytes(b"RIFF")
    (tmp_path / "copy.csv").write_bytes((tmp_path / "decay.csv").read_bytes())
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=words):
        draft_study(tmp_path / "new", [tmp_path / n for n in names])
    assert not (tmp_path / "new").exists()


def test_one_mode_takes_the_strongest_sensor(tmp_path: Path) -> None:
    file = table(tmp_path / "decay.csv", "time [s],a1 [g],a2 [g]", T, RING, 2 * RING)
    path = draft_study(tmp_path / "new", [file])
    assert [c.array for c in read_study(path).recordings[0].channels] == ["a2"]
    assert "the strongest; left out: a1" in path.read_text()


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    file = table(tmp_path / "decay.csv", "time [s],acc [g]", T, RING)
    (tmp_path / "study.toml").write_text("mine")
    with pytest.raises(InputError, match="is already there"):
        draft_study(tmp_path, [file])
    assert (tmp_path / "study.toml").read_text() == "mine"
