"""Every mistake in a study file gets one sentence with file, table, key and mend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.template import TEXT

# what the user wrote instead of what is right, and parts of the sentence they must get
CASES = {
    "misspelt key": ("mass = 1.0 ", "mas = 1.0 ", ["[structure] mas", "did you mean 'mass'"]),
    "misspelt table": ("[prediction]", "[predictions]", ["predictions", "did you mean 'prediction'"]),
    "unknown kind": ('kind = "oscillator"\nmass', 'kind = "oscilator"\nmass', ["[structure] kind", "did you mean 'oscillator'"]),
    "text for a number": ("mass = 1.0 ", 'mass = "heavy" ', ["[structure] mass", "does not begin with a number"]),
    "wrong dimension": ('frequency = "20 Hz"', 'frequency = "20 mm"', ["[structure] frequency", "'mm' is not a unit of frequency",
                                                                       "Hz, kHz"]),
    "text without unit": ('frequency = "20 Hz"', 'frequency = "20"', ["[structure] frequency", "'20' is a text without a unit",
                                                                      "write 20 without quotes", "Hz, kHz"]),
    "unit of a plain number": ("starts = 20", 'starts = 20\nwidening = "2 m"', ["[identification] widening", "'m' is not understood here"]),
    "negative mass": ("mass = 1.0 ", "mass = -1.0 ", ["[structure] mass", "not positive"]),
    "both stiffness and frequency": ("mass = 1.0 ", "stiffness = 3.0\nmass = 1.0 ", ["[structure] stiffness", "give one of them"]),
    "no title": ('title = "My first study: an oscillator with a hardening spring"', "", ["title: is missing"]),
    "seed is text": ("seed = 1", 'seed = "one"', ["seed", "not a whole number"]),
    "missing file": ("recording.npz", "recordings.npz", ["[[recordings]] 1 file", "there is no file"]),
    "no rate": ('rate = "fs" ', "", ["[[recordings]] 1 rate: is missing", "time ="]),
    "rate and time": ('rate = "fs" ', 'rate = "fs"\ntime = "t" ', ["[[recordings]] 1 time", "beside rate"]),
    "unknown role": ('role = "train" ', 'role = "training" ', ["role", "'training' is not possible", "did you mean 'train'"]),
    "window backwards": ("window = [0.0, 8.0]", "window = [8.0, 0.0]", ["window", "from a lower to a higher"]),
    "window of one": ("window = [0.0, 8.0]", "window = [8.0]", ["window", "is not a pair"]),
    "unknown unit": ('unit = "m/s^2"', 'unit = "furlong"', ["[[recordings.channels]] 1 unit", "not a unit that is known for acceleration"]),
    "unit of another quantity": ('unit = "m/s^2"', 'unit = "mm"', ["unit", "measures displacement", "acceleration"]),
    "volts without sensitivity": ('unit = "m/s^2"', 'unit = "V"', ["unit", "voltage", "per_volt"]),
    "unknown quantity": ('quantity = "acceleration" ', 'quantity = "jerk" ', ["quantity", "'jerk' is not possible"]),
    "unknown location": ('unit = "N"\nlocation = "x"', 'unit = "N"\nlocation = "tip"', ["[[recordings.channels]] 2 location", "'tip'",
                                                                                        "known are x"]),
    "polarity of zero": ('unit = "N"\n', 'unit = "N"\npolarity = 0\n', ["polarity", "is 0"]),
    "recording twice": ('name = "later part"', 'name = "multisine"', ["[[recordings]] 2 name", "used twice"]),
    "like nothing above": ('like = "multisine"', 'like = "multisin"', ["like", "did you mean 'multisine'"]),
    "no training record": ('role = "train" ', 'role = "noise" ', ["[[recordings]]", 'role = "train"']),
    "unknown term": ('"cubic", ', '"kubic", ', ["[identification] candidates", "'kubic' is not a term", "did you mean 'cubic'"]),
    "number outside Table 1": ('"cubic", ', "47, ", ["candidates", "47 is not a number of Table 1", "1 to 46"]),
    "unknown scenario": ('scenario = "S2"', 'scenario = "S4"', ["scenario", "'S4' is not possible"]),
    "main not among modes": ("main = 1", "main = 2", ["main", "not among modes"]),
    "free mode not among modes": ("free_modes = [1]", "free_modes = [2]", ["free_modes", "not among modes"]),
    "modes from zero": ("modes = [1] ", "modes = [0] ", ["modes", "from 1 up"]),
    "joint unknown": ('joints = ["x"]', 'joints = ["J1"]', ["joints", "'J1' is not a location"]),
    "band backwards": ('band = ["5 Hz", "80 Hz"]', 'band = ["80 Hz", "5 Hz"]', ["band", "lower to a higher"]),
    "no starts": ("starts = 20", "starts = 0", ["starts", "out of range"]),
    "one ensemble": ("ensembles = 4", "ensembles = 1", ["[posterior] ensembles", "out of range"]),
    "amplitude in hertz": ('amplitude = "2 mm"', 'amplitude = "2 Hz"', ["[prediction] amplitude", "Hz"]),
    "held out unknown": ('heldout = ["later part"]', 'heldout = ["last part"]', ["heldout", "no recording 'last part'", "'later part'"]),
    "held out but fitted": ('heldout = ["later part"]', 'heldout = ["multisine"]', ["heldout", "'multisine' has role = 'train'", "fitted"]),
    "held out twice": ('heldout = ["later part"]', 'heldout = ["later part", "later part"]', ["[prediction] heldout", "names repeat"]),
    "held out in part fitted": ("window = [8.0, 12.0]", "window = [7.0, 12.0]",
                                ["[[recordings]] 2 window", "'later part' is kept for judging, but 7 to 8 s of it is fitted in"]),
    "held out of a whole file": ("window = [0.0, 8.0]", "", ["[[recordings]] 2 window", "8 to 12 s of it is fitted"]),
    "band without the mode": ('band = ["5 Hz", "80 Hz"]', 'band = ["50 Hz", "80 Hz"]',
                              ["[identification] band", "leaves out mode 1 at 20 Hz"]),
    "amplitude below zero": ('amplitude = "2 mm"', 'amplitude = "2 mm"\namplitudes = [0.001, -0.5]',
                             ["[prediction] amplitudes", "ascending"]),
    "amplitude out of reach": ('amplitude = "2 mm"', 'amplitude = "2 mm"\namplitudes = ["1 mm", "3 mm"]',
                               ["[prediction] amplitudes", "0.003 m lies above amplitude = 0.002 m"]),
    "held out of a quiet record": ('heldout = ["later part"]', 'heldout = ["quiet"]', ["heldout", "'quiet'", "excitation off"]),
    "backbone of a quiet record": ('heldout = ["later part"]', 'measured = "quiet"', ["measured", "'quiet'", "name a free decay"]),
    "mode of the backbone": ("mode = 1\n", "mode = 3\n", ["[prediction] mode", "mode 3 does not exist, the model has 1"]),
    "low-level mode": ("[identification]", '[linear]\nrecording = "multisine"\nmodes = [4]\n[identification]',
                       ["[linear] modes", "mode 4 does not exist"]),
    "too many damping ratios": ("[identification]", "[linear]\ndamping = [0.1, 0.2]\n[identification]", ["damping", "2 ratios", "1 mode"]),
    "update of an oscillator": ("[identification]", '[linear]\nrecording = "multisine"\nupdate = ["E"]\n[identification]',
                                ["[linear] update", "no parts to update"]),
    "odd walkers": ("ensembles = 4", "ensembles = 4\nwalkers = 9", ["walkers", "9 is not an even number"]),
    "prior of nothing": ("[prediction]", '[[posterior.priors]]\nparameter = "cubic[*].k"\nkind = "normal"\nmean = 1\nsd = 1\n[prediction]',
                         ["[[posterior.priors]] 1 parameter", "'cubic[*].k' is none", "did you mean 'cubic[*].c'"]),
    "group of nothing": ("[prediction]", '[[posterior.groups]]\nparameters = ["cubic[*].k"]\n[prediction]',
                         ["[[posterior.groups]] 1 parameters", "'cubic[*].k' is none", "did you mean 'cubic[*].c'"]),
    "group without members": ("[prediction]", "[[posterior.groups]]\nparameters = []\n[prediction]", ["parameters", "is empty"]),
    "two groups of one": ("[prediction]", '[[posterior.groups]]\nparameters = ["cubic[*].c"]\n[[posterior.groups]]\n'
                                          'parameters = ["cubic[x].c"]\n[prediction]', ["[[posterior.groups]] 2", "in group 1 already"]),
    "group without scatter": ("[prediction]", '[[posterior.groups]]\nparameters = ["cubic[*].c"]\nscatter = 0\n[prediction]',
                              ["[[posterior.groups]] 1 scatter", "0"]),
    "file with a null": ('file = "recording.npz"', 'file = "record\\u0000ing.npz"', ["file", "null character"]),
    "no structure": ("[structure] ", "[structures] ", ["[structure]", "is missing"]),
    "not TOML": ("seed = 1", "seed = = 1", ["is not valid TOML", "line 5"]),
    "own term unusable": ("[posterior]", '[[terms]]\nname = "mine"\nformula = "c*import"\nparams = { c = ["N", "coefficient"] '
                                         '}\n[posterior]',
                          ["[[terms]] 1", "formula"]),
    "own term of a taken name": ("[posterior]", '[[terms]]\nname = "cubic"\nformula = "c*q"\nparams = { c = ["N/m", "coefficient"] '
                                                '}\n[posterior]',
                                 ["[[terms]] 1 name", "already a term"]),
    "own unit with a prefix": ("[posterior]", '[[terms]]\nname = "m"\nformula = "c*q"\nparams = { c = ["N/mm", "coefficient"] }\n'
                               "[posterior]", ["[[terms]] 1 term 'm', parameter 'c'", "'mm', which is no SI unit", "N/m^3"]),
    "own unit against its rule": ("[posterior]", '[[terms]]\nname = "m"\nformula = "c*q"\nparams = { c = ["N", "stiffness"] }\n'
                                  "[posterior]", ["parameter 'c'", "'N' does not go with the rule 'stiffness'", "write N/m"]),
    "own parameter misread": ("[posterior]", '[[terms]]\nname = "m"\nformula = "c*q"\nparams = { c = "N/m" }\n[posterior]',
                              ["params", "c"]),
}


def write(folder: Path, text: str) -> Path:
    np.savez(folder / "recording.npz", acceleration=np.zeros(8), force=np.zeros(8), quiet=np.zeros(8), fs=100.0)
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_copy_does_not_judge_what_its_original_was_fitted_to(tmp_path: Path) -> None:
    text = TEXT.replace("window = [8.0, 12.0]", "window = [7.0, 12.0]")
    first, name, second = text.partition('name = "later part"')
    assert name
    path = write(tmp_path, first + name + '\nfile = "copy.npz"' + second)
    (tmp_path / "copy.npz").write_bytes((tmp_path / "recording.npz").read_bytes())
    with pytest.raises(InputError, match="'later part' is kept for judging, but 7 to 8 s of it is fitted in 'multisine'"):
        read_study(path)
    with (tmp_path / "copy.npz").open("ab") as file:
        file.write(b"another")
    read_study(path)


def test_the_template_itself_is_good(tmp_path: Path) -> None:
    study = read_study(write(tmp_path, TEXT))
    assert study.stages == ("read", "linear", "identify", "posterior", "predict", "report")
    assert study.locations == ("x",)


@pytest.mark.parametrize("name", list(CASES))
def test_one_sentence(name: str, tmp_path: Path) -> None:
    right, wrong, expected = CASES[name]
    assert TEXT.count(right) >= 1, f"{right!r} no longer stands in the template"
    with pytest.raises(InputError) as caught:
        read_study(write(tmp_path, TEXT.replace(right, wrong, 1)))
    sentence = str(caught.value)
    assert sentence.startswith("study.toml") or sentence.startswith(str(tmp_path)), sentence
    assert "\n" not in sentence and sentence.endswith("."), sentence
    for part in expected:
        assert part in sentence, sentence


def test_enough_of_them() -> None:
    assert len(list(CASES)) >= 40


@pytest.mark.parametrize(("content", "expected"), [(None, "there is no such file"), (b"\xff\xfe\x00", "is not UTF-8")])
def test_unreadable_file(content: bytes | None, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=expected):
        read_study(path)


def test_a_stage_needs_the_one_before_it(tmp_path: Path) -> None:
    text = TEXT[:TEXT.index("[identification]")] + TEXT[TEXT.index("[posterior]"):]
    with pytest.raises(InputError, match=r"\[posterior\]: needs a table \[identification\], which is missing"):
        read_study(write(tmp_path, text))


def test_a_folder_is_not_a_study(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"):
        read_study(tmp_path)


BEAM = """
title = "beam"
[structure]
kind = "beam"
length = "720 mm"
width = "25.4 mm"
height = "12.7 mm"
E = "200 GPa"
rho = 7800
lap = ["300 mm", "420 mm"]
stations = ["330 mm", "360 mm", "390 mm"]
tangential = ["100 MN/m", 1e8, 1e8]
bolts = [{ at = "360 mm", mass = "31 g" }]
[structure.sensors]
tip = "5 mm"
[[recordings]]
file = "recording.npz"
rate = "1 kHz"
[[recordings.channels]]
array = "acceleration"
quantity = "acceleration"
unit = "g"
location = "tip"
"""


def test_units_become_si(tmp_path: Path) -> None:
    study = read_study(write(tmp_path, BEAM))
    values = study.structure.parameters
    assert values["length"] == pytest.approx(0.72) and values["E"] == pytest.approx(2e11)
    assert values["tangential"] == pytest.approx((1e8, 1e8, 1e8)) and values["bolts"][0] == pytest.approx((0.36, 0.031))
    assert study.recordings[0].rate == 1000.0
    assert {"tip", "J1_slip", "J3_open"} <= set(study.locations)


@pytest.mark.parametrize(("right", "wrong", "expected"), [
    ('lap = ["300 mm", "420 mm"]', 'lap = ["300 mm"]', "[structure] lap: 1 values are given"),
    ('length = "720 mm"', "", "[structure] length: is missing"),
    ('tip = "5 mm"', 'tip = "5 m"', "positions must lie between"),
    ('at = "360 mm"', 'place = "360 mm"', "[[structure.bolts]] 1 place"),
    ('E = "200 GPa"', 'E = "200 kN"', "[structure] E: unit 'kN' is not a unit of pressure"),
    ("[[recordings]]", '[reduction]\nmethod = "iirs"\nmasters = ["joints", "tap"]\n[[recordings]]',
     "[reduction] masters: 'tap' is neither a group nor a location; did you mean 'tip'"),
    ("[[recordings]]", '[reduction]\nmodes = 3\n[linear]\nrecording = "recording"\nmodes = [1, 4]\n[[recordings]]',
     "[linear] modes: mode 4 does not exist, the model has 3; raise modes in [reduction]"),
    ("[[recordings]]", '[linear]\nrecording = "recording"\nupdate = ["J4_slip"]\n[[recordings]]',
     "[linear] update: 'J4_slip' is not a part of the structure; did you mean 'J"),
    ("[[recordings]]", '[linear]\nrecording = "recording"\n[linear.update]\na = ["J1_slip"]\nb = ["J1_slip"]\n[[recordings]]',
     "[linear] update: 'J1_slip' stands in two groups"),
    ('length = "720 mm"', 'length = "720 mm"\nelement_size = "1 um"', "[structure]: lapped beam: elements of 1e-06 m are 7.2e+05 along it"),
    ("[[recordings]]", '[reduction]\ndamping = "120 %"\n[[recordings]]', "[reduction] damping: 1.2 is not below critical damping"),
    ("[[recordings]]", '[linear]\nrecording = "recording"\n[linear.update]\na = []\n[[recordings]]',
     "[linear] update: group 'a' names no parts"),
    ('"330 mm", "360 mm", "390 mm"', '"130 mm", "360 mm", "390 mm"', "must lie within the lap"),
])
def test_bad_beams(right: str, wrong: str, expected: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_study(write(tmp_path, BEAM.replace(right, wrong)))
    assert expected in str(caught.value)


def test_moving_the_file_changes_nothing_but_paths(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    first.mkdir(), second.mkdir()
    a, b = read_study(write(first, TEXT)), read_study(write(second, TEXT))
    assert a.inputs == b.inputs
