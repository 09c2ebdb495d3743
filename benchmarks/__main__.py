"""Measure everything and write RESULTS.md.

    python -m benchmarks [rows ...]

With names of parts (loops, backbone, selection, posterior, footprint) only those are measured and printed, and nothing is written.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"    # before numpy is imported: times are those of one core

import platform  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from importlib.metadata import version  # noqa: E402
from pathlib import Path  # noqa: E402

from benchmarks import backbone, chain, footprint, loops  # noqa: E402
from benchmarks.case import Row, quick  # noqa: E402

RESULTS = Path(__file__).with_name("RESULTS.md")
NOTES = Path(__file__).with_name("NOTES.md")
PARTS = ("loops", "backbone", "selection", "posterior", "footprint")
STEP_PRODUCTS = 2 * (3 * 20 + 2 * 5 * 10 + 2 * 2 * 25 + 5 * 10 + 2 * 10)   # flops of the matrix products of a condensed step
LIKELIHOOD = 2 * 5 * 128 * 651                                            # of a condensed log-likelihood of five joints


def machine() -> list[str]:
    """What the figures were measured on."""
    model = next((line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")), platform.processor())
    load = "  ".join(f"{x:.1f}" for x in os.getloadavg()) if hasattr(os, "getloadavg") else "unknown"
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "emcee"))
    return [f"- {model}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}",
            f"- Python {platform.python_version()}, {packages}",
            f"- {time.strftime('%Y-%m-%d')}; load average at the start (1, 5, 15 min): {load}"]


def _lines(path: str) -> list[str]:
    return Path(path).read_text(encoding="utf-8").splitlines() if Path(path).exists() else []


def table(rows: list[Row]) -> str:
    """Rows as Markdown."""
    mark = {True: "yes", False: "**no**", None: ""}
    lines = ["| row | what | aim | measured | met |", "| --- | --- | --- | --- | --- |"]
    return "\n".join(lines + [f"| {r.number} | {r.what} | {r.aim} | {r.measured} | {mark[r.met]} |" for r in rows])


def roofline(step: float) -> str:
    """How far the two hottest kernels are from what one core can do."""
    flops, transfer = footprint.peak()
    bound = STEP_PRODUCTS / flops
    return "\n".join([
        f"Measured on one core: {flops / 1e9:.0f} GFLOP/s (product of two 1000 x 1000 matrices), {transfer / 1e9:.0f} GB/s (sum of two "
        "long vectors).", "",
        "| kernel | operations | bytes | bound | measured | |", "| --- | ---: | ---: | ---: | ---: | ---: |",
        f"| condensed HHT step, one sample, without the joint laws | {STEP_PRODUCTS} flops | 8 stored, if asked for | {quick(bound)} "
        f"| {quick(step)} with the laws | {step / bound:.1f}x |",
        f"| condensed log-likelihood, five joints, 128 places | {LIKELIHOOD} flops at most | 3.3 MB of matrices, read once for all walkers "
        f"| {quick(LIKELIHOOD / flops)} | row 6 | |"])


def main(wanted: list[str]) -> int:
    """Measure, print, and write the file if everything was measured."""
    unknown = [w for w in wanted if w not in PARTS]
    if unknown:
        print(f"{unknown[0]!r} is none of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    head, rows, before, batch = machine(), [], 0.0, 0.0
    for part in PARTS:
        if wanted and part not in wanted:
            continue
        print(f"{time.strftime('%H:%M:%S')} {part} ...", file=sys.stderr, flush=True)
        new: list[Row] = []
        if part == "loops":
            new, batch = loops.rows()
        elif part == "selection":
            new, before = chain.selection()
        elif part == "posterior":
            new = chain.posterior(before)
        else:
            new = backbone.rows() if part == "backbone" else footprint.rows()
        print(table(new), flush=True)
        rows += new
    if not wanted:
        text = ["# How fast it is", "", "Written by `make bench`. Times are CPU time of one thread on one core (BLAS on one thread), "
                "ratios are measured side by side in one process.", "", *head, "", table(rows), "",
                "## Distance to the limit of the machine", "", roofline(batch), "", NOTES.read_text(encoding="utf-8").strip(), ""]
        RESULTS.write_text("\n".join(text), encoding="utf-8")
        print(f"written: {RESULTS}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
