"""``python -m studies.virtual_beam [--fast] --out results/virtual_beam``: the paper's virtual experiment, rebuilt."""

from __future__ import annotations

import argparse
from pathlib import Path

from studies.virtual_beam.run import run
from studies.virtual_beam.study import Settings


def main() -> int:
    """Run the study and say where its table is."""
    parser = argparse.ArgumentParser(prog="python -m studies.virtual_beam", description=__doc__)
    parser.add_argument("--fast", action="store_true", help="coarse mesh, short sweeps, few starts")
    parser.add_argument("--out", type=Path, default=Path("results/virtual_beam"))
    parser.add_argument("--seed", type=int, default=Settings.seed)
    options = parser.parse_args()
    run(Settings(options.fast, options.out, options.seed))
    print(f"table: {options.out / 'table.md'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
