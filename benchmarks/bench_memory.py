"""Largest resident memory of one process for bands of 1,000 samples: histories must not be stored (less than 2 GiB).

    python benchmarks/bench_memory.py

Ten modes, five joints (the stand-in of ``case.py``). Every row is a process of its own, and what it needs is what the operating
system counted for it at the end, the interpreter and all libraries included.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

LIMIT = 2 * 2**30
SAMPLES, FLOOR, START = 1000, 1e-5, 4e-3


def _draws(count: int, width: int) -> np.ndarray:
    from benchmarks.case import JOINT

    centre = np.tile(np.append(JOINT, [1.0])[:width], 5)
    return centre * (1 + 0.05 * np.random.default_rng(2).standard_normal((count, 5 * width)))


def nothing() -> None:
    """The libraries alone."""
    import bayes_nlsid.prediction.bands  # noqa: F401


def averaging(term: str) -> None:
    """Backbone band by averaging."""
    from bayes_nlsid.forces.library import LIBRARY
    from bayes_nlsid.prediction.fast import fast_bands
    from benchmarks.case import beam

    found = fast_bands(_draws(SAMPLES, 4), beam(LIBRARY[term]), at="tip", start_amplitude=START, stop_amplitude=FLOOR)
    assert found.status == {"ok": SAMPLES}, found.status


def integrated(term: str, width: int = 4) -> None:
    """Backbone band by time integration of every sample, HHT at 8192 Hz, from 4 mm down to 10 µm."""
    from bayes_nlsid.forces.library import LIBRARY
    from bayes_nlsid.prediction.bands import backbone_bands
    from benchmarks.case import FS, beam

    found = backbone_bands(_draws(SAMPLES, width), beam(LIBRARY[term]), at="tip", start_amplitude=START, stop_amplitude=FLOOR, fs=FS)
    assert found.status == {"ok": SAMPLES}, found.status


def swept(term: str) -> None:
    """Response curves at one level."""
    from dataclasses import replace

    from bayes_nlsid.forces.library import LIBRARY
    from bayes_nlsid.prediction.response_bands import response_bands
    from benchmarks.case import beam

    model = beam(LIBRARY[term])
    model = replace(model, linear=replace(model.linear, inputs=("tip",)))
    found = response_bands(_draws(SAMPLES, 4), model, drive="tip", at="tip", levels=[1.0], band=(74.0, 82.0), harmonics=3)
    assert found.status == {"ok": SAMPLES}, found.status


def scattered() -> None:
    """Monte Carlo of twenty parameters: 1,024 samples for the band, 11,264 more for the indices."""
    from bayes_nlsid.forces.library import LIBRARY
    from bayes_nlsid.inference.prior import Prior
    from bayes_nlsid.prediction.montecarlo import Decay, backbones
    from bayes_nlsid.prediction.sampling_plan import scattered_plan
    from bayes_nlsid.prediction.sensitivity import sobol
    from benchmarks.case import JOINT, beam

    model, centre = beam(LIBRARY["iwan4"]), np.tile(JOINT, 5)
    spreads = [(i, Prior(name, parameter.unit, "normal", float(min(0.6 * c, 1.4 * c)), float(max(0.6 * c, 1.4 * c)), float(c),
                         float(0.05 * abs(c))))
               for i, (name, parameter, c) in enumerate(zip(model.names, model.parameters, centre, strict=True))]
    plan = scattered_plan(centre, spreads, 1024, 1)
    found = backbones(model, plan.theta, Decay("tip", START))
    _, a, b, mixed, _, _ = plan.split(found.frequency[:, ::5])
    assert set(found.status) == {"ok"} and np.isfinite(sobol(a, b, mixed, 1).total).all()


ROWS: dict[str, tuple[str, Callable[[], None]]] = {
    "imports": ("the libraries alone", nothing),
    "averaging": ("band by averaging, static Iwan", lambda: averaging("iwan4")),
    "averaging-memory": ("band by averaging, Iwan with memory", lambda: averaging("iwan4_memory")),
    "integration": ("band by time integration, static Iwan", lambda: integrated("iwan4")),
    "integration-memory": ("band by time integration, Iwan with memory", lambda: integrated("iwan4_memory")),
    "sliders": ("band by time integration, 50 sliders in each joint", lambda: integrated("iwan5_memory", 5)),
    "sweep": ("response curves, static Iwan", lambda: swept("iwan4")),
    "montecarlo": ("Monte Carlo with indices of 20 parameters, 12,300 backbones", scattered),
}


def measure(name: str) -> tuple[int, float]:
    """Bytes and CPU seconds that one row took."""
    code = (f"import resource, sys; sys.path.insert(0, {str(Path(__file__).resolve().parents[1])!r}); from benchmarks import bench_memory; "
            f"bench_memory.ROWS[{name!r}][1](); r = resource.getrusage(resource.RUSAGE_SELF); "
            "print(r.ru_maxrss * (1 if sys.platform == 'darwin' else 1024), r.ru_utime + r.ru_stime)")
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    size, seconds = done.stdout.split()[-2:]
    return int(size), float(seconds)


def main() -> int:
    """Print the table; 1 if the limit is broken."""
    worst = 0
    print(f"| {SAMPLES} samples, 10 modes, 5 joints | largest memory (MiB) | CPU (s) |\n|---|---:|---:|")
    for name in sys.argv[1:] or ROWS:
        size, seconds = measure(name)
        worst = max(worst, size)
        print(f"| {ROWS[name][0]} | {size / 2**20:.0f} | {seconds:.1f} |", flush=True)
    print(f"\nlimit {LIMIT / 2**20:.0f} MiB: {'held' if worst < LIMIT else 'BROKEN'}")
    return int(worst >= LIMIT)


if __name__ == "__main__":
    sys.exit(main())
