"""``python -m studies.concealed generate | run | score``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """Command line of the study; returns an exit status."""
    parser = argparse.ArgumentParser(prog="python -m studies.concealed", description=__doc__)
    todo = parser.add_subparsers(dest="command", required=True)
    g = todo.add_parser("generate", help="random cases and, elsewhere, their answers")
    g.add_argument("--cases", type=int, required=True)
    g.add_argument("--seed", type=int, required=True)
    g.add_argument("--out", type=Path, required=True)
    g.add_argument("--answers", type=Path, required=True)
    g.add_argument("--workers", type=int, default=1)
    g.add_argument("--hard", type=float, default=0.15, help="share of cases with bursts only or four sensors")
    r = todo.add_parser("run", help="`nlsid diagnose` on every case; resumes")
    r.add_argument("--cases", type=Path, required=True)
    r.add_argument("--out", type=Path, required=True)
    r.add_argument("--workers", type=int, default=2)
    r.add_argument("--seed", type=int, default=0)
    r.add_argument("--timeout", type=float, default=900.0, help="seconds per case")
    r.add_argument("--command", dest="tool", default="", help="the tool's command (default: this Python with -m bayes_nlsid)")
    s = todo.add_parser("score", help="tables from results and answers")
    s.add_argument("--results", type=Path, required=True)
    s.add_argument("--answers", type=Path, required=True)
    s.add_argument("--out", type=Path, required=True, help="a .md file; a .json of the same name is written beside it")
    options = parser.parse_args(arguments)
    if options.command == "generate":
        from .generate import generate

        return generate(options.cases, options.seed, options.out, options.answers, options.workers, options.hard)
    if options.command == "run":
        from .run import run

        return run(options.cases, options.out, options.workers, options.seed, options.timeout, options.tool)
    from .score import score_files

    return score_files(options.results, options.answers, options.out)


if __name__ == "__main__":
    sys.exit(main())
