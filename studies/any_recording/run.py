"""Run ``nlsid diagnose`` on every case; resumes where it stopped."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def run(cases: Path, out: Path) -> None:
    """One case after the other, one thread each."""
    quiet = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for case in sorted(p for p in cases.iterdir() if (p / "case.json").is_file()):
        target = out / case.name
        if not (target / "diagnosis.json").is_file():
            found = subprocess.run([sys.executable, "-m", "bayes_nlsid", "diagnose", str(case), "--out", str(target), "--quiet"], env=quiet,
                                   capture_output=True, text=True, check=False)
            print(case.name, "exit", found.returncode, found.stderr.strip()[:200], flush=True)
