"""``nlsid new``: a commented study with a small recording of its own, ready for ``nlsid check`` and ``nlsid run``."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.store import write_atomic

TEXT = '''# A study: what was recorded, what the structure is, what to find out. Every number is in SI unless it carries
# its unit as a text, for instance "25.4 mm". Paths are relative to this file. Check it with: nlsid check study.toml

title = "My first study: an oscillator with a hardening spring"
seed = 1

[structure]                       # kind = "oscillator", "beam" (lapped Timoshenko beam) or "matrices" (npz or MatrixMarket)
kind = "oscillator"
mass = 1.0                        # kg
frequency = "20 Hz"               # nominal; refined by the identification because mode 1 is free below
zeta = 0.011                       # damping ratio
location = "x"                    # name of its one motion

# A bolted beam would read:
# kind = "beam"
# length = "720 mm"
# width = "25.4 mm"
# height = "12.7 mm"              # in the direction of bending
# E = "200 GPa"
# rho = 7800                      # kg/m^3
# lap = ["300 mm", "420 mm"]
# stations = ["330 mm", "360 mm", "390 mm"]   # joints J1, J2, J3 with locations J1_slip, J1_open, ...
# tangential = "100 MN/m"
# [structure.sensors]
# tip = "5 mm"
# [reduction]
# method = "iirs"                 # "none", "guyan" or "iirs"
# masters = ["sensors", "joints"]
# modes = 6

[[recordings]]
name = "multisine"
file = "recording.npz"            # npz, csv, txt, tsv, mat, h5, hdf5, uff, unv or tdms
rate = "fs"                       # Hz, or the name of the array that holds it; or time = "name of the time array"
role = "train"                    # "train", "holdout" (for judging only), "linear" (low level, for modes), "noise" (excitation off)
window = [0.0, 8.0]               # s from the first sample

[[recordings.channels]]
array = "acceleration"            # name in the file; add column = 0 for arrays with several
quantity = "acceleration"         # "acceleration", "velocity", "displacement" or "force"
unit = "m/s^2"
location = "x"

[[recordings.channels]]
array = "force"
quantity = "force"
unit = "N"
location = "x"

[[recordings]]
like = "multisine"                # everything not given here as in the recording above
name = "later part"
role = "holdout"
window = [8.0, 12.0]

[[recordings]]
name = "quiet"                    # the same sensor with the excitation off: the best evidence of its noise
file = "recording.npz"
rate = "fs"
role = "noise"
[[recordings.channels]]
array = "quiet"
quantity = "acceleration"
unit = "m/s^2"
location = "x"

[identification]
scenario = "S2"                   # S1: one equation, one mode; S2: one equation, all modes; S3: all equations, all modes
modes = [1]                       # modes seen by the nonlinear part
main = 1
free_modes = [1]                  # frequency and damping of these are estimated too
band = ["5 Hz", "80 Hz"]          # where motion and residual are seen; three times the mode, for the harmonics of its laws
joints = ["x"]                    # where force laws may act
candidates = ["cubic", "q|q|", "v|v|"]   # names (see: nlsid terms), numbers of Table 1, or "table1", "memory", "user", "all"
starts = 20

# A force law of your own, from a checked expression in q (m), v (m/s) and its parameters; then name it among the candidates.
# [[terms]]
# name = "my_cubic"
# formula = "c*q**3"
# params = { c = ["N/m^3", "coefficient"] }

[posterior]
# stage = "both"                  # "regression" (Eq. 13), "forward" (recordings simulated), or both; by default both where that is quick
ensembles = 4                     # independent ensembles of walkers; they go on until converged (or steps = ..., most = ...)
# [[posterior.priors]]            # instead of the default: normal (mean, sd), lognormal (median, log_sd), uniform, loguniform, ...
# parameter = "cubic[*].c"        # in its own unit, * stands for any part
# kind = "normal"
# mean = 0.0
# sd = 1e8
# [[posterior.groups]]            # joints that are nominally equal: values scatter around a common one, both unknown
# parameters = ["iwan4_memory[*].k_t"]
# scatter = 0.3                   # between the joints: of the natural logarithm, or in the unit of a signed coefficient

[prediction]
at = "x"                          # whose amplitude the backbone is drawn against
amplitude = "2 mm"                # where the released decay starts
mode = 1
samples = 50
heldout = ["later part"]

[frf]                             # for nlsid frf: response to a slowly stepped sine, for draws of the posterior
input = "x"                       # where the force acts
output = "x"                      # whose displacement is wanted
levels = ["0.05 N", "0.2 N", "0.6 N"]
band = ["17 Hz", "27 Hz"]
samples = 50
# harmonics = 7                   # the highest; by default as many as are needed

[montecarlo]                      # for nlsid montecarlo: backbones of many samples, and which parameter their scatter comes from
source = "fit"                    # independent distributions around the fit; or "posterior": its draws
scatter = "5 %"                   # every parameter normal with this standard deviation
samples = 256                     # for the band; indices take half as many again for each parameter

[[montecarlo.parameters]]         # in place of the scatter above, for parameters whose name matches
parameter = "zeta[1]"
kind = "lognormal"                # "normal" (mean, sd or scatter), "lognormal" (median, log_sd), "uniform", "loguniform" (lower, upper)
log_sd = 0.2
'''


def write_template(folder: Path) -> Path:
    """Write ``study.toml`` and ``recording.npz``; nothing that exists is touched.

    Raises
    ------
    InputError
        If the folder already holds one of them, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(str(folder), "is a file", "give a folder")
    study, recording = folder / "study.toml", folder / "recording.npz"
    for path in (study, recording):
        if path.exists():
            raise InputError(str(path), "is already there", "give another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(folder), f"cannot be made ({error.strerror})", "give another folder") from None
    buffer = BytesIO()
    np.savez(buffer, **example_recording())  # type: ignore[arg-type]
    write_atomic(recording, buffer.getvalue())
    write_atomic(study, TEXT.encode())
    return study


def example_recording() -> dict[str, np.ndarray]:
    """Twelve seconds of ẍ + 2ζω ẋ + ω² x + k₃ x³ = F under a random multisine, by Runge–Kutta steps, with sensor noise.

    Truth: 20.3 Hz, 1.2 %, k₃ = 4e8 N/m³, so that nominal values are a little off and the spring hardens by a few per cent.
    """
    fs, count, inner = 1024.0, 12 * 1024, 4
    rng = np.random.default_rng(20)
    lines = np.arange(8.0, 40.0, 0.25)
    phase = rng.uniform(0, 2 * np.pi, lines.size)
    half = np.arange(2 * inner * count + 1) / (2 * inner * fs)
    force = 0.25 * sum(np.cos(2 * np.pi * f * half + p) for f, p in zip(lines, phase, strict=True))
    omega, zeta, cubic = 2 * np.pi * 20.3, 0.012, 4e8

    def slope(x: float, v: float, f: float) -> float:
        return f - 2 * zeta * omega * v - omega**2 * x - cubic * x * x * x

    h, x, v, states, applied = 1 / (inner * fs), 0.0, 0.0, [], force.tolist()  # plain numbers: five times quicker than small arrays
    for i in range(inner * count):
        a = slope(x, v, applied[2 * i])
        if i % inner == 0:
            states.append(a)
        v1 = v + 0.5 * h * a
        b = slope(x + 0.5 * h * v, v1, applied[2 * i + 1])
        v2 = v + 0.5 * h * b
        c = slope(x + 0.5 * h * v1, v2, applied[2 * i + 1])
        v3 = v + h * c
        d = slope(x + h * v2, v3, applied[2 * i + 2])
        x, v = x + h / 6 * (v + 2 * v1 + 2 * v2 + v3), v + h / 6 * (a + 2 * b + 2 * c + d)
    acceleration = np.array(states)
    noise = 2e-3 * acceleration.std() * rng.standard_normal((2, count))
    return {"acceleration": acceleration + noise[0], "force": force[:2 * inner * count:2 * inner], "quiet": noise[1], "fs": np.array(fs)}
