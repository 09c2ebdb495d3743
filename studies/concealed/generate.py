"""Write a batch of cases, and a manifest of hashes that is printed before anything is diagnosed."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import sys
import time
from functools import partial
from pathlib import Path

from .truth.case import Order, make, plan
from .truth.folder import write


def _one(order: Order, seed: int, out: Path, answers: Path) -> tuple[str, float]:
    begin = time.perf_counter()
    made = make(order, seed)
    write(made, out, answers)
    return made.name, time.perf_counter() - begin


def generate(cases: int, seed: int, out: Path, answers: Path, workers: int = 1, hard: float = 0.15) -> int:
    """Generate ``cases`` cases into ``out`` and their answers into ``answers``, which must lie outside ``out``."""
    out, answers = out.resolve(), answers.resolve()
    if answers == out or out in answers.parents or answers in out.parents:
        print(f"answers: {answers} and the cases {out} must not lie in one another; name a folder elsewhere", file=sys.stderr)
        return 2
    out.mkdir(parents=True, exist_ok=True)
    orders = plan(cases, seed, hard)
    job = partial(_one, seed=seed, out=out, answers=answers)
    if workers > 1:
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            done = pool.map(job, orders, chunksize=1)
    else:
        done = [job(o) for o in orders]
    manifest = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(answers.glob("case_*"))}
    inputs = {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(out.glob("case_*/*"))}
    text = json.dumps({"seed": seed, "cases": cases, "answers": manifest, "files": inputs}, indent=1, sort_keys=True)
    (answers / "manifest.json").write_text(text)
    seconds = [s for _, s in done]
    print(f"{cases} cases, seed {seed}: {sum(seconds) / cases:.1f} s each (longest {max(seconds):.1f} s)")
    print(f"sha256 of the manifest of answers and cases: {hashlib.sha256(text.encode()).hexdigest()}")
    return 0
