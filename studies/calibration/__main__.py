"""``python -m studies.calibration``: one degree of freedom in all scenarios (five joints where named), results stored beside this file."""

from __future__ import annotations

import argparse
import sys

from studies.calibration import truth
from studies.calibration.cases import CASES, QUICK
from studies.calibration.run import keep, line, run


def main() -> int:
    """Run what is asked for and print one row for each."""
    parser = argparse.ArgumentParser(prog="python -m studies.calibration", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="virtual tests for each case and scenario")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", choices=tuple(CASES), action="append")
    parser.add_argument("--scenario", choices=tuple(truth.SCENARIOS), action="append")
    parser.add_argument("--no-store", action="store_true", help="print only")
    options = parser.parse_args()
    for case in options.case or QUICK:
        for scenario in options.scenario or list(truth.SCENARIOS):
            result = run(case, scenario, options.count, options.seed,
                         lambda text: print(text, file=sys.stderr, end="\r") if sys.stderr.isatty() else None)
            if not options.no_store:
                keep(result)
            print(line(result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
