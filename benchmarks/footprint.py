"""Rows 8 and 9: start-up and memory, each in a process of its own; and what this machine can do at most."""

from __future__ import annotations

import resource
import subprocess
import sys

import numpy as np

from benchmarks.case import Row, quick, seconds

IMPORT, HELP, MEMORY = 0.5, 0.5, 2048.0   # s, s, MiB
# The peak that getrusage tells begins with that of the process that started this one; Linux keeps the process's own.
BAND = """
from benchmarks.case import *
from bayes_nlsid.prediction.{module} import {name}
theta, model, grid = scattered(1000), beam(LIBRARY["iwan4_memory"]), np.geomspace(4e-4, 3.5e-3, 12)
print(seconds(lambda: {name}(theta, model, at="tip", start_amplitude=START, amplitudes=grid{more})))
print(next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) / 1024)
"""


def _child(*arguments: str) -> tuple[float, str]:
    """CPU time of another process, s, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def rows() -> list[Row]:
    """Lines for rows 8 and 9."""
    bare = min(_child("-c", "pass")[0] for _ in range(3))
    imported = min(_child("-c", "import bayes_nlsid")[0] for _ in range(3))
    helped = min(_child("-m", "bayes_nlsid", "--help")[0] for _ in range(3))
    out = [Row("8", "import bayes_nlsid, the interpreter's own start included", f"{IMPORT} s", f"{quick(imported)} CPU (interpreter "
               f"{quick(bare)})", imported <= IMPORT),
           Row("8", "nlsid --help", f"{HELP} s", f"{quick(helped)} CPU", helped <= HELP)]
    for module, name, more, what in (("fast", "fast_bands", "", "averaging"), ("bands", "backbone_bands", ", fs=8192.0", "HHT at 8192 Hz")):
        time, peak = (float(x) for x in _child("-c", BAND.format(module=module, name=name, more=more))[1].split())
        out.append(Row("9", f"peak memory of a band of 1,000 samples with memory by {what} ({quick(time)})", "2 GiB", f"{peak:.0f} MiB",
                       peak <= MEMORY))
    return out


def peak() -> tuple[float, float]:
    """Floating point operations and bytes per second of one core, from a matrix product and a sum of long vectors."""
    a = np.random.default_rng(0).standard_normal((1000, 1000))
    out = np.empty_like(a)
    flops = 2 * 1000.0**3 / seconds(lambda: np.matmul(a, a, out=out), 8)
    x, y, z = (np.ones(8_000_000) for _ in range(3))
    return flops, 3 * 8 * len(x) / seconds(lambda: np.add(x, y, out=z), 8)
