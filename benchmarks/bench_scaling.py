"""How cost grows: with modes, joints, samples and workers; what giving work away costs. The numbers of docs/scale.md.

    python benchmarks/bench_scaling.py [growth] [giving] [dask]

CPU time, best of some rounds, in one process; for work given away, the CPU time of the process that gives it and the time it waits.
``dask`` needs the package distributed and starts a cluster of three workers on this machine.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the benchmarks of this folder, in workers too
os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)

from bayes_nlsid.executors import Crew, packed, run_tasks  # noqa: E402
from bayes_nlsid.forces.library import LIBRARY  # noqa: E402
from bayes_nlsid.inference.posterior import write_npz  # noqa: E402
from bayes_nlsid.model import Element, Model  # noqa: E402
from bayes_nlsid.prediction.continuation import response_curves  # noqa: E402
from bayes_nlsid.prediction.fast import fast_bands  # noqa: E402
from bayes_nlsid.simulation.integration import simulate  # noqa: E402
from bayes_nlsid.structure.modal import ModalModel  # noqa: E402

IWAN = np.array([2000.0, 1e8, -0.5, 0.1])
BASE = (10, 5)


def beam(modes: int, joints: int, term: str = "iwan4") -> Model:
    """Frequencies as those of a beam in bending; joint motion grows with frequency."""
    rng = np.random.default_rng(1)
    frequency = 78.56 * (1 + 0.35 * np.arange(modes)) ** 2
    shapes = 1.5e-3 * rng.standard_normal((joints, modes)) * np.sqrt(frequency / frequency[0])
    shapes[:, 0] = 1e-2 / np.sqrt(joints) * rng.uniform(0.5, 1.2, joints)
    tip = 0.1 * rng.standard_normal((1, modes))
    tip[0, 0] = 0.86
    names = tuple(f"J{i + 1}" for i in range(joints))
    linear = ModalModel(2 * np.pi * frequency, np.full(modes, 1e-3), (*names, "tip"), np.concatenate([shapes, tip]), ("tip",), ("tip",),
                        names)
    return Model(linear, (Element(LIBRARY[term], names),))


def draws(count: int, joints: int) -> np.ndarray:
    return np.tile(IWAN, joints) * (1 + 0.05 * np.random.default_rng(2).standard_normal((count, 4 * joints)))


def best(run: Any, rounds: int = 3) -> float:
    run()
    times = []
    for _ in range(rounds):
        began = time.process_time()
        run()
        times.append(time.process_time() - began)
    return min(times)


def averaged(modes: int, joints: int, samples: int, term: str = "iwan4") -> float:
    """CPU seconds for one backbone by averaging."""
    model, theta = beam(modes, joints, term), draws(samples, joints)
    return best(lambda: fast_bands(theta, model, at="tip", start_amplitude=1e-3)) / samples


def stepped(modes: int, joints: int, samples: int, term: str = "iwan4") -> float:
    """CPU seconds for one step of one sample, HHT at 8192 Hz."""
    model, theta = beam(modes, joints, term), draws(samples, joints)
    u0 = np.zeros(modes)
    u0[0] = 2e-3
    count, options = 2048, {"fs": 8192.0, "u0": u0, "keep": ("tip",), "store": ("displacement",), "compiled": True}
    return best(lambda: simulate(model, theta, samples=count, **options), 2) / samples / count  # type: ignore[arg-type]


def followed(modes: int, joints: int, samples: int, term: str = "iwan4") -> float:
    """CPU seconds for one response curve with its stability."""
    model, theta = beam(modes, joints, term), draws(samples, joints)
    began = time.process_time()
    found = response_curves(model, theta, drive="tip", at="tip", levels=[0.2], band=(74.0, 82.0), harmonics=3)
    assert all(curve.status == "ok" for (curve,) in found)
    return (time.process_time() - began) / samples


def growth() -> None:
    """Cost of one sample against modes, joints, and samples computed together."""
    print("| modes | joints | together | backbone by averaging (ms) | with memory (ms) | HHT step (ns) | with memory (ns) "
          "| response curve (ms) |")
    print("|---:|---:|---:|---:|---:|---:|---:|---:|")
    cases = [(5, 5, 250), (10, 5, 250), (20, 5, 250), (40, 5, 250), (10, 1, 250), (10, 10, 250), (10, 20, 250), (10, 5, 10)]
    for modes, joints, samples in cases:
        few = min(samples, 4)
        row = [1e3 * averaged(modes, joints, samples), 1e3 * averaged(modes, joints, samples, "iwan4_memory"),
               1e9 * stepped(modes, joints, min(samples, 64)), 1e9 * stepped(modes, joints, min(samples, 64), "iwan4_memory"),
               1e3 * followed(modes, joints, few)]
        print(f"| {modes} | {joints} | {samples} | " + " | ".join(f"{v:.3g}" for v in row) + " |", flush=True)


def idle(shared: Any, task: np.ndarray) -> dict[str, np.ndarray]:
    """What a chunk of 250 backbones sends back, without the work."""
    return {"frequency": np.zeros((250, 60)), "damping": np.zeros((250, 60)), "status": np.full(250, "ok"), "way": np.full(250, "fast")}


def busy(shared: tuple[Model, dict[str, Any]], theta: np.ndarray) -> np.ndarray:
    model, options = shared
    return fast_bands(theta, model, **options).frequency


def given(executor: Any, workers: int, name: str) -> None:
    """Start-up, and what a task costs."""
    model = beam(*BASE)
    shared = (model, {"at": "tip", "start_amplitude": 1e-3})
    tasks = [draws(250, BASE[1])] * 200
    wall = time.perf_counter()
    with Crew(shared, executor=executor, workers=workers) as crew:
        list(crew.run(idle, tasks[:workers]))
        start = time.perf_counter() - wall
        wall, began = time.perf_counter(), time.process_time()
        count = sum(1 for _ in crew.run(idle, tasks))
        spent, waited = time.process_time() - began, time.perf_counter() - wall
        wall, began = time.perf_counter(), time.process_time()
        list(crew.run(busy, tasks[:40]))
        load, worked = time.process_time() - began, time.perf_counter() - wall
    print(f"| {name} | {start:.2f} | {1e3 * spent / count:.2f} | {1e3 * waited / count:.2f} | {worked:.2f} | {load:.2f} |", flush=True)


HEAD = ("| executor | until the first answers (s) | CPU of the giver per task (ms) | wall per task (ms) | wall for 10,000 backbones (s) "
        "| CPU of the giver meanwhile (s) |\n|---|---:|---:|---:|---:|---:|")


def giving() -> None:
    """Local processes, and what travels."""
    model = beam(*BASE)
    one = idle(None, np.zeros(0))
    with tempfile.TemporaryDirectory() as folder:
        write = best(lambda: write_npz(Path(folder) / "chunk.npz", **one), 20)
    print(f"sent once: {len(packed((model, {}))) / 1e3:.0f} kB; per task: {len(packed(draws(250, BASE[1]))) / 1e3:.0f} kB out, "
          f"{len(packed(one)) / 1e3:.0f} kB back; written to disk in {1e3 * write:.1f} ms\n")
    print(HEAD)
    for workers in (1, 2):
        given("local", workers, f"{workers} local")


def dask() -> None:
    """The same on a cluster of three local workers."""
    import distributed

    print(HEAD)
    with distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        given(str(cluster.scheduler_address).replace("tcp", "dask"), 3, "3 of Dask")
        began, count = time.process_time(), 1000
        done = sum(1 for _ in run_tasks(idle, None, [np.zeros(1)] * count, executor=str(cluster.scheduler_address).replace("tcp", "dask")))
        print(f"\n{done} tasks at once: {1e3 * (time.process_time() - began) / count:.2f} ms CPU of the giver each (scheduler included)")


if __name__ == "__main__":
    for part in sys.argv[1:] or ("growth", "giving", "dask"):
        {"growth": growth, "giving": giving, "dask": dask}[part]()
        print()
