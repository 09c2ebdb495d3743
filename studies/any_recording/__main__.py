"""``python -m studies.any_recording generate | run | score | refit``."""

from __future__ import annotations

import argparse
from pathlib import Path


def main() -> None:
    """Commands of the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.any_recording")
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("generate")
    make.add_argument("--cases", type=int, default=60)
    make.add_argument("--seed", type=int, required=True)
    make.add_argument("--out", type=Path, required=True)
    make.add_argument("--answers", type=Path, required=True)
    run = commands.add_parser("run")
    run.add_argument("--cases", type=Path, required=True)
    run.add_argument("--out", type=Path, required=True)
    for name in ("score", "refit"):
        one = commands.add_parser(name)
        one.add_argument("--results", type=Path, required=True)
        one.add_argument("--answers", type=Path, required=True)
    given = parser.parse_args()
    if given.command == "generate":
        from studies.any_recording.generate import generate

        generate(given.cases, given.seed, given.out, given.answers)
    elif given.command == "run":
        from studies.concealed.run import run as run_all

        run_all(given.cases, given.out, workers=1)
    elif given.command == "score":
        from studies.any_recording.score import gather, table

        print(table(gather(given.results, given.answers)))
    else:
        from studies.refit_odds import refit

        refit(given.results, given.answers)


if __name__ == "__main__":
    main()
