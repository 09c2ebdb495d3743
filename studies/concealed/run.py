"""Diagnose every case as a user would: one process per case, one BLAS thread, finished cases are not repeated."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def run_case(case: Path, out: Path, command: list[str], seed: int, timeout: float) -> dict:
    """Run the tool on one case folder; writes ``status.json`` and the tool's output to ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    environment = os.environ | dict.fromkeys(THREADS, "1")
    begin = time.perf_counter()
    try:
        done = subprocess.run(
            [*command, "diagnose", str(case), "--out", str(out), "--seed", str(seed), "--quiet"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
        code, err = done.returncode, done.stderr
    except subprocess.TimeoutExpired:
        code, err = -1, f"no answer within {timeout:.0f} s"
    status = {"case": case.name, "exit": code, "seconds": time.perf_counter() - begin, "message": err[-2000:]}
    (out / "status.json").write_text(json.dumps(status, indent=1))
    return status


def run(cases: Path, out: Path, workers: int = 2, seed: int = 0, timeout: float = 900.0, tool: str = "") -> int:
    """Run all cases under ``cases``; a case with a ``diagnosis.json`` in ``out`` is finished."""
    command = shlex.split(tool) if tool else [sys.executable, "-m", "bayes_nlsid"]
    folders = sorted(p for p in cases.resolve().glob("case_*") if (p / "case.json").exists())
    if not folders:
        print(f"{cases}: no case folders (case_*/case.json); generate some first", file=sys.stderr)
        return 2
    open_cases = [f for f in folders if not (out / f.name / "diagnosis.json").exists()]
    print(f"{len(folders)} cases, {len(open_cases)} to do", file=sys.stderr)
    failed = 0
    with ThreadPoolExecutor(workers) as pool:
        for i, status in enumerate(pool.map(lambda f: run_case(f, out / f.name, command, seed, timeout), open_cases), start=1):
            failed += status["exit"] not in (0, 1)
            print(f"[{i}/{len(open_cases)}] {status['case']}: exit {status['exit']}, {status['seconds']:.1f} s", file=sys.stderr)
    return 1 if failed else 0
