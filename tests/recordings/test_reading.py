"""Files to recordings: every supported form gives the same samples, and whatever is wrong is said in one sentence."""

import hashlib
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings import readers
from bayes_nlsid.recordings.readers import read_file
from bayes_nlsid.recordings.reading import ChannelSpec, RecordingSpec, read_recording

N, RATE = 64, 500.0
TIME = np.arange(N) / RATE
ACC = np.round(np.random.default_rng(0).normal(size=(N, 3)), 6)
FORCE = np.round(np.random.default_rng(1).normal(size=N), 6)
CHANNELS = (ChannelSpec("force", "force", "N", "P3", name="F"), ChannelSpec("acc", "acceleration", "g", "tip", column=2, polarity=-1))


def npz_bytes(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def mat_bytes(compressed: bool = True) -> bytes:
    stream = io.BytesIO()
    run = {"acc": ACC, "meta": {"force": FORCE[None], "who": "someone"}}
    savemat(stream, {"run": run, "fs": RATE, "file": TIME}, do_compression=compressed)
    return stream.getvalue()


def hdf5_bytes() -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=512) as file:
        file["run/acc"] = ACC.T  # as MATLAB stores it
        file["run/force"] = FORCE[None]
        file["fs"] = [[RATE]]
        name = file.create_dataset("run/who", data=np.array([65, 66], dtype=np.uint16))
        name.attrs["MATLAB_class"] = np.bytes_("char")
    return stream.getvalue()


def csv_bytes(separator: str = ",", decimal: str = ".", extra: str = "", encoding: str = "utf-8") -> bytes:
    rows = [extra + separator.join(["time [s]", "force [N]", "a1 [g]", "a2 (m/s²)", "a3 [g]"])]
    for t, f, a in zip(TIME, FORCE, ACC, strict=True):
        rows.append(separator.join(repr(float(v)).replace(".", decimal) for v in (t, f, *a)))
    return "\n".join(rows).encode(encoding)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, bytes], str]:
    def writer(name: str, data: bytes) -> str:
        path = tmp_path / name
        path.write_bytes(data)
        return str(path)
    return writer


Write = Callable[[str, bytes], str]


def test_npz_to_si(write: Write) -> None:
    data = npz_bytes(acc=ACC.astype("f4"), force=FORCE[:, None], time=TIME + 20, words=np.array(["a"]))
    run = read_recording(RecordingSpec(write("a.npz", data), "run", CHANNELS, role="holdout", time="time", period=16))
    assert run.dt == pytest.approx(1 / RATE, rel=1e-12) and run.start == 20 and run.period == 16 and run.role == "holdout"
    assert np.allclose(run.response[:, 0], -9.80665 * ACC[:, 2].astype("f4").astype(float), rtol=1e-12)
    assert np.array_equal(run.force[:, 0], FORCE)
    assert [c.name for c in run.channels] == ["tip"] and run.channels[0].unit == "g" and run.inputs[0].location == "P3"
    assert run.sha256 == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize(("separator", "decimal", "extra", "encoding"), [
    (",", ".", "", "utf-8"), (";", ".", "# made by x\n\n", "utf-8-sig"), (";", ",", "% comment\nsep=;\n", "latin-1"),
    ("\t", ",", "", "utf-16"), ("  ", ".", "// c\n", "utf-8"),
])
def test_text_in_every_dialect(write: Write, separator: str, decimal: str, extra: str, encoding: str) -> None:
    file = write("a.csv", csv_bytes(separator, decimal, extra, encoding))
    channels = (ChannelSpec("force", "force", "", "P3"), *(ChannelSpec(f"a{i}", "acceleration", "", f"S{i}") for i in (1, 2)))
    run = read_recording(RecordingSpec(file, "run", channels, time="time"))
    assert np.allclose(run.response, ACC[:, :2] * [9.80665, 1.0], rtol=1e-12) and np.array_equal(run.force[:, 0], FORCE)
    assert run.channels[1].unit == "m/s²" and run.fs == pytest.approx(RATE)


@pytest.mark.parametrize("data", [mat_bytes(), mat_bytes(False)])
def test_matlab_structs(write: Write, data: bytes) -> None:
    channels = (ChannelSpec("run.meta.force", "force", "N", "P3"), ChannelSpec("run.acc", "acceleration", "m/s^2", "S", column=1))
    run = read_recording(RecordingSpec(write("a.mat", data), "run", channels, rate="fs"))
    assert np.array_equal(run.response[:, 0], ACC[:, 1]) and np.array_equal(run.force[:, 0], FORCE) and run.fs == RATE


def test_matlab_7_3(write: Write) -> None:
    channels = (ChannelSpec("run.force", "force", "N", "P3"), ChannelSpec("run.acc", "acceleration", "m/s^2", "S", column=1))
    run = read_recording(RecordingSpec(write("a.mat", hdf5_bytes()), "run", channels, rate="fs"))
    assert np.array_equal(run.response[:, 0], ACC[:, 1]) and np.array_equal(run.force[:, 0], FORCE)
    assert "run.who" not in read_file(write("b.mat", hdf5_bytes())).arrays


def test_window_and_start(write: Write) -> None:
    spec = RecordingSpec(write("a.npz", npz_bytes(acc=ACC, force=FORCE, time=TIME + 20)), "run", CHANNELS, time="time", window=(0.02, 0.06))
    run = read_recording(spec)
    assert run.n == 20 and run.start == pytest.approx(20.02) and np.array_equal(run.force[:, 0], FORCE[10:30])
    assert np.array_equal(read_recording(replace(spec, time=None, rate=RATE)).force, run.force)


def test_one_channel_a_row(write: Write) -> None:
    run = read_recording(RecordingSpec(write("a.npz", npz_bytes(acc=ACC.T, force=FORCE[None])), "run", CHANNELS, rate=RATE))
    assert np.array_equal(run.response[:, 0], -9.80665 * ACC[:, 2])


def test_volts_only_as_declared(write: Write) -> None:
    file = write("a.npz", npz_bytes(u=FORCE, y=ACC[:, 0]))
    drive, output = ChannelSpec("u", "force", "mV", "D", name="u", per_volt=35.0), ChannelSpec("y", "displacement", "V", "D", per_volt=1.0)
    run = read_recording(RecordingSpec(file, "run", (drive, output), rate=1))
    assert np.allclose(run.force[:, 0], 0.035 * FORCE) and np.array_equal(run.response[:, 0], ACC[:, 0])
    assert run.notes == ("channel 'D': volts stand in for m",)
    with pytest.raises(InputError, match="give per_volt"):
        read_recording(RecordingSpec(file, "run", (drive, replace(output, per_volt=None)), rate=1))
    with pytest.raises(InputError, match="drop per_volt"):
        read_recording(RecordingSpec(file, "run", (drive, replace(output, unit="mm")), rate=1))


@pytest.mark.parametrize(("change", "words"), [
    (lambda t: t + 0.002 * (np.arange(N) >= 30), "1 samples are missing after sample 29"),
    (lambda t: np.where(np.arange(N) == 30, t[29], t), "time repeats after sample 29"),
    (lambda t: t[::-1], "runs backward after sample 0"),
    (lambda t: t**1.5, "not constant"),
    (lambda t: np.where(np.arange(N) == 7, np.nan, t), "missing at sample 7"),
    (lambda t: t * 1.01, "contradicts the time array"),
])
def test_time_is_checked(write: Write, change: Callable[[np.ndarray], np.ndarray], words: str) -> None:
    file = write("a.npz", npz_bytes(acc=ACC, force=FORCE, time=change(TIME.copy())))
    with pytest.raises(InputError, match=words):
        read_recording(RecordingSpec(file, "run", CHANNELS, time="time", rate=RATE if "contradicts" in words else None))


def test_rounded_times_are_no_gap(write: Write) -> None:
    t = np.arange(N) / 2048
    file = write("a.npz", npz_bytes(acc=ACC, force=FORCE, time=np.round(t, 4)))
    assert read_recording(RecordingSpec(file, "run", CHANNELS, time="time")).fs == pytest.approx(2048, rel=2e-3)


@pytest.mark.parametrize(("changes", "words"), [
    ({"channels": (ChannelSpec("acc", "acceleration", "g", "S"),)}, "3 columns; give column = 0 to 2"),
    ({"channels": (ChannelSpec("acc", "acceleration", "g", "S", column=3),)}, "no column 3; count from 0, the last is 2"),
    ({"channels": (ChannelSpec("accel", "acceleration", "g", "S"),)}, r"'accel' is not in the file; it holds acc \(64, 3\), force"),
    ({"channels": (ChannelSpec("acc", "acceleration", "N", "S", column=0),)}, "measures force"),
    ({"channels": (ChannelSpec("acc", "acceleration", "", "S", column=0),)}, "no unit is given"),
    ({"channels": (ChannelSpec("short", "acceleration", "g", "S"), CHANNELS[1])}, "lengths differ: S 9, tip 64"),
    ({"channels": (ChannelSpec("holes", "acceleration", "g", "S"),)},
     r"channel 'S': 2 samples .* sample 5 \(t = 0.01 s\); give window = \[0.022, 0.128\], or drop"),
    ({"window": (0.1, 5.0)}, "does not lie within the 0.128 s"),
    ({"window": (0.2, 0.21)}, "does not lie within"),
    ({"period": 10}, "not a whole number of periods of 10"),
    ({"rate": "acc"}, "no sampling rate"),
    ({"rate": None, "time": "acc"}, "must be one column"),
])
def test_misuse_is_one_sentence(write: Write, changes: dict[str, Any], words: str) -> None:
    holes = ACC[:, 0].copy()
    holes[[5, 10]] = np.nan
    file = write("a.npz", npz_bytes(acc=ACC, force=FORCE, short=FORCE[:9], holes=holes))
    spec = replace(RecordingSpec(file, "run", CHANNELS, rate=RATE), **changes)
    with pytest.raises(InputError, match=words) as caught:
        read_recording(spec)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


@pytest.mark.parametrize(("changes", "words"), [
    ({"role": "test"}, "role 'test'"), ({"rate": None}, "neither a rate nor a time"), ({"rate": -1.0}, "positive number"),
    ({"rate": True}, "positive number"), ({"channels": ()}, "no response"), ({"channels": (CHANNELS[1], CHANNELS[1])}, "stands twice"),
    ({"window": (2.0, 1.0)}, "start below stop"), ({"window": ("a", "b")}, "start below stop"), ({"period": 1}, "at least 2"),
])
def test_specification_is_checked(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(RecordingSpec("a.npz", "run", CHANNELS, rate=RATE), **changes)


@pytest.mark.parametrize(("changes", "words"), [
    ({"quantity": "voltage"}, "quantity 'voltage'"), ({"polarity": 0}, "give 1 or -1"), ({"column": -1}, "count columns from 0"),
    ({"column": 1.0}, "count columns from 0"), ({"per_volt": 0.0}, "finite sensitivity"), ({"per_volt": "x"}, "finite sensitivity"),
])
def test_channel_specification_is_checked(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(CHANNELS[0], **changes)


@pytest.mark.parametrize(("name", "data", "words"), [
    ("a.npz", b"", "is empty"), ("a.npz", npz_bytes(acc=ACC)[:200], "not an npz archive"), ("a.npz", b"hello", "not an npz archive"),
    ("a.npz", npz_bytes(o=np.array([{}], dtype=object)), "pickled"), ("a.npz", npz_bytes(s=np.array(["x"])), "no numeric array"),
    ("a.mat", b"hello" * 100, "cannot be read as .mat"), ("a.mat", mat_bytes()[:300], "cannot be read as .mat|no numeric"),
    ("a.mat", hdf5_bytes()[:1500], "cannot be read as .mat"),
    ("a.csv", b"1,2\n3,4", "no header row"), ("a.csv", b"a,b", "no header row followed"),
    ("a.csv", b"a,b\n1,2\n1,2,3\n", "line 3 has 3 cells"),
    ("a.csv", b"# c\na,b\n1,2\n1,x\n", "line 4, column 2 is no number: 'x'"), ("a.csv", b"a,a\n1,2\n", "repeats the column name 'a'"),
    ("a.csv", b"a\0b\n1", "is not text"), ("a.wav", b"RIFF", "not read; give one of .csv"), ("noext", b"x", "without a suffix"),
])
def test_foreign_files(write: Write, name: str, data: bytes, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_file(write(name, data))
    assert "\n" not in str(caught.value) and "Traceback" not in str(caught.value)


def test_missing_and_huge_files(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (tmp_path / "none.npz", "a\0b.npz", tmp_path.with_suffix(".npz")):
        with pytest.raises(InputError, match="cannot be opened"):
            read_file(path)
    big, small = write("big.npz", npz_bytes(a=np.zeros(9000))), write("small.npz", b"")
    stream = io.BytesIO()
    np.savez_compressed(stream, a=np.zeros(9000))
    Path(small).write_bytes(stream.getvalue())
    packed = write("a.mat", mat_bytes())
    monkeypatch.setattr(readers, "MAX_BYTES", 2000)
    with pytest.raises(InputError, match="read at once"):
        read_file(big)
    with pytest.raises(InputError, match="unpacks to"):
        read_file(small)
    monkeypatch.setattr(readers, "MAX_BYTES", len(mat_bytes()) + 1)
    with pytest.raises(InputError, match="unpacks to"):
        read_file(packed)


def test_empty_cells_are_missing_samples(write: Write) -> None:
    file = write("a.csv", b"t,a\n0,1\n1,\n2,3\n3,4\n")
    with pytest.raises(InputError, match="1 samples are missing .* sample 1"):
        read_recording(RecordingSpec(file, "run", (ChannelSpec("a", "acceleration", "g", "S"),), time="t"))


def test_unit_in_the_file_is_binding(write: Write) -> None:
    file = write("a.csv", b"t [ms],a [g]\n0,1\n1,2\n2,3\n")
    spec = RecordingSpec(file, "run", (ChannelSpec("a", "acceleration", "g", "S"),), time="t")
    assert read_recording(spec).dt == pytest.approx(1e-3)
    with pytest.raises(InputError, match="'m/s\\^2' contradicts 'g'"):
        read_recording(replace(spec, channels=(ChannelSpec("a", "acceleration", "m/s^2", "S"),)))
    with pytest.raises(InputError, match="time_unit 's' contradicts 'ms'"):
        read_recording(replace(spec, time_unit="s"))


GOOD = {"a.npz": npz_bytes(acc=ACC[:8], force=FORCE[:8]), "a.csv": csv_bytes()[:600], "b.csv": csv_bytes(";", ",")[:600], 
        "a.mat": mat_bytes(), "b.mat": mat_bytes(False), "c.mat": hdf5_bytes()}


def damage(tmp_path: Path, name: str, data: st.DataObject) -> None:
    damaged = bytearray(GOOD[name])
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(damaged) - 1), st.integers(0, 255)), max_size=4)):
        damaged[at] = value
    cut = data.draw(st.integers(0, len(damaged)))
    path = tmp_path / name
    path.write_bytes(bytes(damaged[:cut] if data.draw(st.booleans()) else damaged))
    channels = (ChannelSpec("acc", "acceleration", "g", "S", column=0),)
    try:
        run = read_recording(RecordingSpec(str(path), "run", channels, rate=RATE))
    except InputError:
        return
    assert np.isfinite(run.response).all()


def few(count: int) -> settings:
    return settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.mark.parametrize("name", [n for n in GOOD if not n.endswith(".mat")])
@few(80)
@given(data=st.data())
def test_damaged_bytes_raise_input_errors_only(tmp_path: Path, name: str, data: st.DataObject) -> None:
    damage(tmp_path, name, data)


@pytest.mark.parametrize("name", [n for n in GOOD if n.endswith(".mat")])
@few(4)  # each starts a process
@given(data=st.data())
def test_damaged_matlab_files_raise_input_errors_only(tmp_path: Path, name: str, data: st.DataObject) -> None:
    damage(tmp_path, name, data)


def test_a_parser_that_crashes_is_an_unreadable_file(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    crash = tmp_path / "crash.py"
    crash.write_text("import os\nos.abort()\n")
    monkeypatch.setattr(readers, "PARSER", crash)
    with pytest.raises(InputError, match="its structure is broken"):
        read_file(write("a.mat", mat_bytes()))


@few(80)
@given(data=st.binary(max_size=300), suffix=st.sampled_from([".npz", ".csv", ".txt"]))
def test_arbitrary_bytes_raise_input_errors_only(tmp_path: Path, data: bytes, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    try:
        arrays = read_file(path).arrays
    except InputError:
        return
    assert arrays


def test_an_offset_is_taken_from_the_samples_before_anything_else(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    path.write_bytes(npz_bytes(acc=ACC, force=FORCE))
    plain = read_recording(RecordingSpec(str(path), "run", CHANNELS, rate=RATE))
    shifted = read_recording(RecordingSpec(str(path), "run", (replace(CHANNELS[0], offset=0.5), replace(CHANNELS[1], offset=-0.25)),
                                           rate=RATE))
    np.testing.assert_allclose(shifted.force, plain.force - 0.5, atol=1e-12)
    np.testing.assert_allclose(shifted.response, plain.response - 0.25 * 9.80665, atol=1e-12)     # polarity -1, unit g
    with pytest.raises(InputError, match="offset"):
        replace(CHANNELS[0], offset=float("nan"))
