"""Good files of every kind that is read, and ways to damage them."""

from __future__ import annotations

import gc
import io
import re
import tempfile
import warnings
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pyuff
from scipy.io import hb_write, savemat
from scipy.sparse import csc_array

from bayes_nlsid.study.template import TEXT

RNG = np.random.default_rng(0)
T = np.arange(40) / 500
LONG = np.random.default_rng(1).normal(size=160)
ACC, FORCE = RNG.normal(size=(40, 2)), RNG.normal(size=40)
M, K = np.eye(3), np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2.0]])

MARKET = "%%MatrixMarket matrix coordinate real symmetric\n% a comment\n3 3 5\n1 1 2.0\n2 1 -1.0\n2 2 2.0\n3 2 -1.0\n3 3 2.0\n"
DENSE = "%%MatrixMarket matrix array real general\n2 2\n2.0\n-1.0\n-1.0\n2.0\n"
ABAQUS = "** made\n1,1, 1,1, 2.0\n2,1, 1,1, -1.0\n2,1, 2,1, 2.0\n2,6, 2,6, 1e36\n"
DMIG = "DMIG    KAAX           0       6       2       0\n" + "\n".join(
    f"DMIG*   KAAX    {j + 1:>24}{1:>16}\n*       {j + 1:>16}{1:>16}{2.0:>16.9E}" for j in range(3)) + "\n"
LOCATIONS = "name,dof,coefficient,role\nJ1,1,-1,joints\nJ1,2,1,joints\nacc,q3,1.0,sensors\n"
LOCATIONS_TOML = '[[location]]\nname = "J1"\ndofs = [1, 2]\ncoefficients = [-1, 1]\nrole = "joints"\n'
MODES = "frequency [Hz],damping [%],acc,J1\n16.0,0.2,1.0,0.5\n27.5,0.3,-0.5,1.0\n"
BEAM = '''title = "beam"
[structure]
kind = "beam"
length = "720 mm"
width = "25.4 mm"
height = "12.7 mm"
E = "200 GPa"
rho = 7800
lap = ["300 mm", "420 mm"]
stations = ["330 mm", "390 mm"]
tangential = "100 MN/m"
[structure.sensors]
tip = "5 mm"
[reduction]
method = "iirs"
masters = ["sensors", "joints"]
modes = 4
[[recordings]]
name = "decay"
file = "recording.npz"
rate = "fs"
role = "train"
[[recordings.channels]]
array = "acceleration"
quantity = "acceleration"
unit = "g"
location = "tip"
[linear]
recording = "decay"
modes = [1, 2]
update = ["E"]
[identification]
joints = ["J1_slip", "J2_slip"]
candidates = ["cubic", 45, "mine"]
[[terms]]
name = "mine"
formula = "c*q**3 + abs(v)*q"
params = { c = ["N/m^3", "coefficient"] }
'''


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def text(separator: str, decimal: str) -> bytes:
    rows = [separator.join(["time [s]", "force [N]", "a1 [g]", "a2 [m/s^2]"])]
    rows += [separator.join(f"{v:.5f}".replace(".", decimal) for v in row) for row in np.column_stack([T, FORCE, ACC])]
    return "\n".join(rows).encode()


def universal(kind: int, binary: int = 0) -> bytes:
    """Datasets 58 or 55 as pyuff writes them."""
    common = {f"id{i}": "NONE" for i in range(1, 6)}
    if kind == 58:
        sets = [{"type": 58, "binary": binary, "func_type": 1, "rsp_node": i, "rsp_dir": 3, "ref_node": 0, "ref_dir": 0, "data": FORCE,
                 "x": T, "abscissa_spacing": 1, "abscissa_spec_data_type": 17, "ordinate_spec_data_type": 12,
                 "orddenom_spec_data_type": 0, **common} for i in (1, 2)]
    else:
        sets = [{"type": 55, "model_type": 1, "analysis_type": 2, "data_ch": 2, "spec_data_type": 8, "data_type": 2, "n_data_per_node": 3,
                 "r1": np.zeros(2), "r2": np.zeros(2), "r3": np.array([1.0, 0.5]), "node_nums": np.array([1, 2]), "load_case": 1,
                 "mode_n": 1, "modal_m": 0.0, "freq": 16.0, "modal_damp_vis": 0.002, "modal_damp_his": 0.0, **common}]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        path = Path(folder) / "a.uff"
        for one in sets:
            pyuff.UFF(str(path)).write_sets([one], mode="add")
        gc.collect()
        return path.read_bytes()


def boeing() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        hb_write(Path(folder) / "a.rua", csc_array(K))
        return (Path(folder) / "a.rua").read_bytes()


def matlab(compressed: bool) -> bytes:
    stream = io.BytesIO()
    savemat(stream, {"run": {"acc": ACC, "meta": {"force": FORCE}}, "fs": 500.0}, do_compression=compressed)
    return stream.getvalue()


def hdf5(userblock: int) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=userblock) as file:
        file["run/acc"] = ACC.T
        file["run/acc"].attrs["units"] = "g"
        file.create_dataset("run/force", data=FORCE, compression="gzip")
        file["fs"] = [[500.0]]
    return stream.getvalue()


def tdms() -> bytes:
    import nptdms

    stream = io.BytesIO()
    with nptdms.TdmsWriter(stream) as writer:
        writer.write_segment([nptdms.ChannelObject("run", "acc", FORCE, {"unit_string": "g", "wf_increment": 0.002})])
    return stream.getvalue()


def output4(binary: bool) -> bytes:
    from pyyeti.nastran import op4

    with tempfile.TemporaryDirectory() as folder:
        op4.write(f"{folder}/a.op4", {"MAA": M, "KAA": K}, binary=binary)
        return Path(f"{folder}/a.op4").read_bytes()


RECORDING = npz(acceleration=FORCE, force=FORCE, quiet=0.1 * FORCE, fs=np.array(500.0))


@cache
def good(name: str) -> bytes:
    """The bytes of a good file."""
    made = {
        "a.npz": lambda: npz(acc=ACC, force=FORCE, fs=np.array(500.0)), "a.csv": lambda: text(",", "."), "b.csv": lambda: text(";", ","),
        "a.tsv": lambda: text("\t", "."), "a.uff": lambda: universal(58), "b.uff": lambda: universal(58, 1), "m.uff": lambda: universal(55),
        "m.csv": MODES.encode, "a.mtx": MARKET.encode, "d.mtx": DENSE.encode, "b.mtx": ABAQUS.encode, "a.rua": boeing,
        "l.csv": LOCATIONS.encode, "l.toml": LOCATIONS_TOML.encode,
        "nominal.npz": lambda: npz(M=M, K=K, sensor_select=np.eye(3)[:1], shaker_vector=np.eye(3)[0]),
        "case.json": CASE.encode, "mine.toml": HYPOTHESES.encode,
        "run.npz": lambda: npz(time=np.arange(len(LONG)) / 500.0, accel=LONG[:, None], force=LONG),
        "study.toml": TEXT.encode, "beam.toml": BEAM.encode,
        "a.mat": lambda: matlab(True), "b.mat": lambda: matlab(False), "c.mat": lambda: hdf5(512), "a.h5": lambda: hdf5(0), "a.tdms": tdms,
        "a.op4": lambda: output4(False), "b.op4": lambda: output4(True), "a.pch": DMIG.encode}
    return bytes(made[name]())


CASE = """{"case": "small", "fs_hz": 500.0, "period_s": 0.0, "mains_hz": 50, "nominal_damping_ratio": 0.01, "band_hz": [5, 100],
 "excited_lines": [10, 11], "classes": ["none", "hardening"], "tolerances": {"E_rel_sd": 0.03},
 "locations": {"sensors": ["S1"], "joints": ["J1"], "mass_points": ["P1", "SHAKER"]},
 "geometry": {"sensors": [{"name": "S1", "mass_point": "P1"}]},
 "records": [{"name": "run", "level": 1.0, "kind": "random", "start_s": 0.0, "sealed": false}]}
"""
HYPOTHESES = """[[hypotheses]]
name = "stribeck"
claim = "friction at {place} falls once it slides"
law = "f*tanh(v/w)*(1 + a*exp(-(v/w)**2))"
params = { f = ["N", "force"], w = ["m/s", "velocity"], a = ["", "range", 0.0, 2.0] }
start = { w = [0.1, 1.0], a = [0.5] }
fixed = ["w"]
follows = "velocity"
prior = 0.5
confused = ["coulomb"]
test = "a slow ramp"
"""

CASE_FILES = ("nominal.npz", "case.json", "run.npz")
READ_HERE = ("a.npz", "a.csv", "b.csv", "a.tsv", "a.uff", "b.uff", "m.uff", "m.csv", "a.mtx", "d.mtx", "b.mtx", "a.rua", "l.csv", "l.toml",
             "nominal.npz", "case.json", "run.npz", "mine.toml")
READ_APART = ("a.mat", "b.mat", "c.mat", "a.h5", "a.tdms", "a.op4", "b.op4", "a.pch")
STUDIES = ("study.toml", "beam.toml")

NUMBERS = (b"0", b"-1", b"1e308", b"1e-308", b"nan", b"inf", b"99999999999999999999", b"2147483648", b"4294967295", b"1e9", b"", b"x")
WORDS = ("0", "-1", "1e308", "1e-300", "nan", "inf", "-inf", "999999999", '"x"', '""', "true", "[]", "{}", "[[1]]",
         '"1e400 mm"', '"\\u0000"',
         '"../../../../etc/passwd"', "1979-05-27", '"é\\u202e"', '["a", 1]')


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """A file after one to four accidents: bytes changed, cut, doubled, moved; numbers in it replaced by extreme ones."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        kind, n = int(rng.integers(0, 7)), len(out)
        if n == 0:
            break
        i, j = sorted(int(k) for k in rng.integers(0, n + 1, 2))
        if kind == 0:
            out[min(i, n - 1)] = int(rng.integers(0, 256))
        elif kind == 1:
            out[min(i, n - 1)] ^= 1 << int(rng.integers(0, 8))
        elif kind == 2:
            del out[i:min(j, i + 64)]
        elif kind == 3:
            out[i:i] = out[i:min(j, i + 64)]
        elif kind == 4:
            out[i:i] = bytes(rng.integers(0, 256, int(rng.integers(1, 9)), dtype=np.uint8))
        elif kind == 5:
            del out[i:]
        else:
            found = list(re.finditer(rb"[-+]?\d+(\.\d*)?([eEdD][-+]?\d+)?", bytes(out[:20000])))
            if found:
                match = found[int(rng.integers(0, len(found)))]
                out[match.start():match.end()] = NUMBERS[int(rng.integers(0, len(NUMBERS)))]
    return bytes(out)


def damaged_study(data: bytes, rng: np.random.Generator) -> bytes:
    """A study after accidents of an editor: values replaced, lines lost, doubled, exchanged; or of a disk."""
    if rng.random() < 0.2:
        return damaged(data, rng)
    lines = data.decode().splitlines()
    for _ in range(int(rng.integers(1, 4))):
        kind, i = int(rng.integers(0, 8)), int(rng.integers(0, len(lines)))
        if kind < 4:
            valued = [k for k, line in enumerate(lines) if "=" in line and not line.startswith("#")]
            k = valued[int(rng.integers(0, len(valued)))]
            lines[k] = lines[k].split("=")[0] + "= " + WORDS[int(rng.integers(0, len(WORDS)))]
        elif kind == 4 and len(lines) > 3:
            del lines[i]
        elif kind == 5:
            lines.insert(i, lines[int(rng.integers(0, len(lines)))])
        elif kind == 6:
            j = int(rng.integers(0, len(lines)))
            lines[i], lines[j] = lines[j], lines[i]
        else:
            match = re.search(r"\d+(\.\d+)?", lines[i])
            if match:
                lines[i] = lines[i][:match.start()] + NUMBERS[int(rng.integers(0, len(NUMBERS)))].decode() + lines[i][match.end():]
    return "\n".join(lines).encode()

