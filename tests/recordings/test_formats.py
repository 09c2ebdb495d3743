"""Universal files, HDF5 and TDMS: what exporters write, whole and damaged, gives the samples or one sentence."""

from __future__ import annotations

import gc
import io
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import pyuff

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.readers import Contents, read_file
from bayes_nlsid.recordings.reading import ChannelSpec, RecordingSpec, read_recording

N, STEP = 50, 9.765625e-05  # 10240 Hz, which six printed digits do not hold
RNG = np.random.default_rng(3)
ACC, FORCE = RNG.normal(size=N), RNG.normal(size=N)
WRITTEN: dict[int, bytes] = {}


def dataset58(path: Path, binary: int = 0, **changes: Any) -> bytes:
    """What pyuff writes for an acceleration at 12+Z and a force at 3-X; written there too."""
    if changes or binary not in WRITTEN:
        data = _dataset58(path.with_suffix(".made"), binary, **changes)
        if changes:
            path.write_bytes(data)
            return data
        WRITTEN[binary] = data
    path.write_bytes(WRITTEN[binary])
    return WRITTEN[binary]


def _dataset58(path: Path, binary: int, **changes: Any) -> bytes:
    if path.exists():
        path.unlink()
    for node, direction, kind, label, data in ((12, 3, 12, "m/s^2", ACC), (3, -1, 13, "N", FORCE)):
        entry: dict[str, Any] = {
            "type": 58, "binary": binary, "func_type": 1, "rsp_node": node, "rsp_dir": direction, "ref_node": 0, "ref_dir": 0, "data": data,
            "x": STEP * np.arange(N), "abscissa_spacing": 1, "abscissa_spec_data_type": 17, "ordinate_spec_data_type": kind,
            "ordinate_axis_units_lab": label, "orddenom_spec_data_type": 0, **changes}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves files open when it writes binary
            pyuff.UFF(str(path)).write_sets([entry], mode="add")
            gc.collect()
    return path.read_bytes()


def read(path: Path, data: bytes) -> Contents:
    path.write_bytes(data)
    return read_file(path)


def expect(contents: Contents, rtol: float = 1e-11) -> None:
    np.testing.assert_allclose(contents.arrays["12+Z"], ACC, rtol=rtol, atol=1e-11)
    np.testing.assert_allclose(contents.arrays["3-X"], FORCE, rtol=rtol, atol=1e-11)
    assert float(contents.arrays["rate"]) == 10240.0
    assert contents.quantities == {"12+Z": "acceleration", "3-X": "force"}


@pytest.mark.parametrize("binary", [0, 1])
def test_universal_files_as_pyuff_writes_them(tmp_path: Path, binary: int) -> None:
    file = tmp_path / "run.uff"
    dataset58(file, binary)
    expect(read_file(file), 0 if binary else 1e-11)
    channels = (ChannelSpec("12+Z", "acceleration", "", "tip"), ChannelSpec("3-X", "force", "", "shaker"))
    run = read_recording(RecordingSpec(str(file), "run", channels, rate="rate"))
    assert run.fs == 10240 and run.channels[0].unit == "m/s^2"


def test_binary_samples_that_look_like_an_end_mark(tmp_path: Path) -> None:
    """Where pyuff alone cuts the dataset: 16 bytes of samples that read ``\\n    -1\\n``."""
    data = bytearray(dataset58(tmp_path / "a.uff", 1))
    start = bytes(data).find(ACC.tobytes()[:16])
    data[start:start + 16] = b"\n    -1\n" * 2
    found = read(tmp_path / "b.uff", bytes(data))
    assert found.arrays["12+Z"].size == N
    np.testing.assert_array_equal(found.arrays["12+Z"][2:], ACC[2:])
    np.testing.assert_array_equal(found.arrays["3-X"], FORCE)


@pytest.mark.parametrize("ending", [b"\n    -1\n", b"\r\n    -1\r\n", b"    -1" + b" " * 74 + b"\n", b"\n\n    -1\n"])
def test_binary_end_marks_of_several_exporters(tmp_path: Path, ending: bytes) -> None:
    data = dataset58(tmp_path / "a.uff", 1)
    changed = data.replace(ACC.tobytes() + b"    -1\n", ACC.tobytes() + ending)
    assert changed != data
    expect(read(tmp_path / "b.uff", changed), 0)


def test_text_variants(tmp_path: Path) -> None:
    """Windows line ends, D exponents, values between single blanks, blank header fields, a header in latin-1."""
    data = dataset58(tmp_path / "a.uff")
    expect(read(tmp_path / "b.uff", data.replace(b"\n", b"\r\n")))
    expect(read(tmp_path / "b.uff", data.replace(b"e+0", b"D+0").replace(b"e-0", b"D-0")))
    lines = data.splitlines()
    loose = [b" ".join(line.split()) if line.count(b"e") == 4 else line for line in lines]
    expect(read(tmp_path / "b.uff", b"\n".join(loose) + b"\n"))
    blank = [line.replace(b"    0    0    0", b"               ") if b"NONE" in line and len(line) == 67 else line for line in lines]
    assert blank != lines
    expect(read(tmp_path / "b.uff", b"\n".join(blank) + b"\n"))
    expect(read(tmp_path / "b.uff", data.replace(b"NONE" + b" " * 76, b"Schwingungspr\xfcfung" + b" " * 60, 1)))


def test_unit_system_where_no_label_stands(tmp_path: Path) -> None:
    data = dataset58(tmp_path / "a.uff", ordinate_axis_units_lab="NONE")
    units = b"    -1\n   164\n         5mm (milli-newton)             2\n  1.0E+03  1.0E+03  1.0E+00\n  0.0\n    -1\n"
    found = read(tmp_path / "b.uff", units + data)
    assert found.units == {"12+Z": "mm/s^2", "3-X": "mN"}
    assert read(tmp_path / "c.uff", data).units == {}


def test_repeated_channels_and_scalars_get_names(tmp_path: Path) -> None:
    data = dataset58(tmp_path / "a.uff")
    assert {"12+Z", "12+Z #2"} <= read(tmp_path / "b.uff", data + data).arrays.keys()
    scalar = dataset58(tmp_path / "a.uff", rsp_node=0, rsp_dir=0, id1="laser")
    assert {"laser", "laser #2"} <= read(tmp_path / "b.uff", scalar).arrays.keys()


@pytest.mark.parametrize("binary", [0, 1])
def test_cut_universal_files_are_refused_in_words(tmp_path: Path, binary: int) -> None:
    data = dataset58(tmp_path / "a.uff", binary)
    for cut in (20, 400, 1200, len(data) - 20):
        with pytest.raises(InputError, match="cut short|is broken|is not a universal file|no time record"):
            read(tmp_path / "b.uff", data[:cut])
    wrong = data.replace(f"{N:10d}".encode(), f"{N + 1000:10d}".encode())
    with pytest.raises(InputError, match="its header says|cut short"):
        read(tmp_path / "b.uff", wrong)
    with pytest.raises(InputError, match="2 frequency response functions and no time record"):
        read(tmp_path / "b.uff", dataset58(tmp_path / "a.uff", binary, func_type=4, abscissa_spec_data_type=18, data=ACC + 1j * FORCE))


def hdf5(**root: Any) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file.attrs.update(root)
        file["run/acc"] = np.stack([ACC, FORCE], axis=1)
        file["run/acc"].attrs.update({"units": "g", "fs": 512.0})
        table = np.zeros(N, dtype=[("t", "f8"), ("force", "f4"), ("text", "S3")])
        table["force"] = FORCE
        file["table"] = table
        file["table"].attrs["unit"] = "counts"
        file["elsewhere"] = h5py.ExternalLink("/etc/hostname", "/a")
    return stream.getvalue()


def test_hdf5_groups_tables_attributes_and_units(tmp_path: Path) -> None:
    found = read(tmp_path / "a.h5", hdf5(rate=512.0))
    assert set(found.arrays) == {"run.acc", "run.acc.fs", "table.t", "table.force", "rate"} and found.units == {"run.acc": "g"}
    channels = (ChannelSpec("run.acc", "acceleration", "", "tip", column=0),)
    run = read_recording(RecordingSpec(str(tmp_path / "a.h5"), "run", channels, rate="run.acc.fs"))
    np.testing.assert_allclose(run.response[:, 0], ACC * 9.80665)
    with pytest.raises(InputError, match="cannot be read as .hdf5"):
        read(tmp_path / "b.h5", hdf5()[:900])


def test_hdf5_that_names_data_in_other_files_reads_only_its_own(tmp_path: Path) -> None:
    (tmp_path / "raw").write_bytes(ACC.tobytes())
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file.create_dataset("secret", shape=(N,), dtype="f8", external=[(str(tmp_path / "raw"), 0, 8 * N)])
        file["own"] = FORCE
    assert set(read(tmp_path / "a.h5", stream.getvalue()).arrays) == {"own"}


def test_tdms_channels_and_increment(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment([nptdms.ChannelObject("run", "tip", ACC, {"unit_string": "g", "wf_increment": 1 / 512}),
                              nptdms.ChannelObject("run", "load", FORCE, {"unit_string": "N", "wf_increment": 1 / 512})])
    found = read_file(tmp_path / "a.tdms")
    assert float(found.arrays["rate"]) == 512 and found.units == {"run.tip": "g", "run.load": "N"}
    np.testing.assert_array_equal(found.arrays["run.load"], FORCE)
    for data, words in ((b"TDSm" + b"\xff" * 200, "holds no numeric array"), (b"\xff" * 200, "cannot be read as .tdms")):
        with pytest.raises(InputError, match=words):
            read(tmp_path / "b.tdms", data)


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bayes_nlsid.recordings import isolation

    monkeypatch.setattr(isolation, "_BOOT", isolation._BOOT.replace("import runpy, sys", "import runpy, sys\nsys.modules['nptdms'] = None"))
    with pytest.raises(InputError, match=r"needs the package nptdms, which is not installed; pip install 'bayes-nlsid\[tdms\]'"):
        read(tmp_path / "a.tdms", b"TDSm")


def test_memory_of_a_parser_is_bounded(tmp_path: Path) -> None:
    from bayes_nlsid.recordings.isolation import Unreadable, parse_apart

    greedy = tmp_path / "greedy.py"
    greedy.write_text("import sys\ntry:\n    b = bytearray(20 * 2**30)\nexcept MemoryError:\n    print('asks for too much'); sys.exit(3)\n")
    with pytest.raises(Unreadable, match="asks for too much"):
        parse_apart(greedy, ("test",), b"", 2**20)
