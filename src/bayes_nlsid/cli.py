"""The command ``nlsid``: a study from the command line. Nothing heavy is imported before it is needed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, final

from bayes_nlsid import __version__
from bayes_nlsid.errors import InputError

DONE, REFUSED, BAD_INPUT, STOPPED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns
    -------
    int
        0 done; 1 done, but the answer is a refusal; 2 bad input; 130 stopped.
    """
    try:
        options = _parser().parse_args(arguments)
        status: int = options.action(options)
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f"nlsid: {error}", file=sys.stderr)
        return BAD_INPUT
    except MemoryError as error:
        print(f"nlsid: the memory of this machine is not enough ({str(error) or 'no more is said'}); ask for fewer degrees of freedom, "
              "modes or samples.", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("\nnlsid: stopped; run the same command again to go on from here.", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:  # the reader of our output (head, less) has gone
        sys.stderr.close()
        return DONE


@final
class _Parser(argparse.ArgumentParser):
    """Wrong usage is bad input like any other: one sentence, not the whole usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help.\n")


def _parser() -> argparse.ArgumentParser:
    top = _Parser(prog="nlsid", description="Nonlinear models of jointed structures from recordings, with their "
                                                            "uncertainty.",
                                  epilog="Exit status: 0 done, 1 done but the answer is a refusal (the reason is printed and stored), "
                                         "2 bad input, 130 stopped.")
    top.add_argument("--version", action="version", version=f"bayes_nlsid {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    common = _common()

    def add(name: str, summary: str, action: Any, out: bool = False) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".", parents=[common])
        parser.set_defaults(action=action, command=name)
        if out:
            parser.add_argument("--out", required=True, type=_named, metavar="DIR", help="results folder")
        return parser

    run = add("run", "all stages of a study, resuming where an earlier run stopped", _run, out=True)
    run.add_argument("study", metavar="STUDY.toml")
    run.add_argument("--fresh", action="store_true", help="compute every stage again")
    check = add("check", "read everything, say what would be done and what is missing; compute nothing", _check)
    check.add_argument("study", metavar="STUDY.toml")
    diagnose = add("diagnose", "where model and recordings differ, and what was probably left out", _diagnose, out=True)
    diagnose.add_argument("study", metavar="PATH", help="study file, or case folder")
    diagnose.add_argument("--hypotheses", metavar="FILE.toml", help="hypotheses of your own, weighed beside those of the catalogue")
    for name, what in (("compare", "scenarios S1–S3 and alternatives scored on records that none of them was fitted to"),
                       ("montecarlo", "parameter distributions to backbone bands and Sobol indices"),
                       ("frf", "stepped-sine response curves with posterior bands")):
        extra = add(name, f"{what}; the run comes first where it is missing", _extra, out=True)
        extra.add_argument("study", metavar="STUDY.toml")
        extra.add_argument("--fresh", action="store_true", help="compute this again; the run itself is kept")
    add("plan", "before a test: which sensors, place and level of excitation let the joints be learned, and what cannot be", _plan,
        out=True).add_argument("study", metavar="STUDY.toml")
    report = add("report", "write report.html again from stored results", _report)
    report.add_argument("out", type=_named, metavar="DIR")
    report.add_argument("--format", choices=("html", "markdown"), default="html", help="markdown also writes report.md")
    add("terms", "the library of force laws as a table", _terms)
    add("hypotheses", "the catalogue of what may be missing from a model, as a table", _hypotheses).add_argument(
        "own", metavar="FILE.toml", nargs="?", help="with hypotheses of your own, checked as nlsid diagnose --hypotheses reads them")
    new = add("new", "write a commented study to start from", _new)
    new.add_argument("out", type=_named, metavar="DIR")
    new.add_argument("--from", dest="files", nargs="+", metavar="FILE", default=[],
                     help="recordings, matrices, locations and modal results to write the study from; guesses are commented")
    return top


def _common() -> _Parser:
    common = _Parser(add_help=False)
    group = common.add_argument_group("common options")
    group.add_argument("--seed", type=_whole, metavar="N", help="in place of the seed of the study")
    group.add_argument("--workers", type=_positive, default=1, metavar="N", help="threads or processes; results do not depend on it")
    group.add_argument("--executor", type=_executor, default="local", metavar="local|dask://HOST:PORT", help="where the work is done")
    group.add_argument("--quiet", action="store_true", help="no progress, no summary")
    group.add_argument("--log", metavar="FILE", help="also write the log here")
    return common


def _named(text: str) -> str:
    """An empty name, as an unset variable of a shell leaves it, would mean the present folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name of the folder is empty")
    return text


def _whole(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 up")
    return int(text)


def _executor(text: str) -> str:
    if text == "local":
        return text
    if text.startswith("dask://"):
        host, colon, port = text.removeprefix("dask://").rpartition(":")
        if host and colon and port.isdigit():
            return text
        raise argparse.ArgumentTypeError(f"{text!r} names no scheduler; write dask://HOST:PORT")
    raise argparse.ArgumentTypeError(f"{text!r} is neither local nor dask://HOST:PORT")


def _reporter(options: argparse.Namespace, out: Path | None) -> Any:
    from bayes_nlsid.study.progress import Reporter

    terminal = sys.stderr if sys.stderr.isatty() and not options.quiet else None
    logs = [] if out is None else [out / "run.log"]
    if options.log:
        extra = Path(options.log)
        try:
            extra.open("a", encoding="utf-8").close()
        except OSError as error:
            raise InputError(f"--log {options.log}", f"cannot be written to ({error.strerror})",
                             "create its folder or choose another file") from None
        logs.append(extra)
    return Reporter(tuple(logs), terminal)


def _run(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.reading import read_study
    from bayes_nlsid.study.run import run_study

    study, out = read_study(options.study), Path(options.out)
    result = run_study(study, out, seed=options.seed, workers=options.workers, executor=options.executor, fresh=options.fresh,
                       reporter=_reporter(options, out))
    if not options.quiet:
        from bayes_nlsid.study.screen import summary

        print(summary(result, out))
    elif result["status"] != "ok":
        print(f"nlsid: {result['status']}: {'; '.join(result['reasons'])}", file=sys.stderr)
    return DONE if result["status"] == "ok" else REFUSED


def _extra(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.reading import read_study
    from bayes_nlsid.study.run import run_study

    study, out = read_study(options.study), Path(options.out)
    result = run_study(study, out, seed=options.seed, workers=options.workers, executor=options.executor, fresh=options.fresh,
                       extra=options.command, reporter=_reporter(options, out))
    found = result[options.command]
    if not options.quiet:
        from bayes_nlsid.study.screen import extra_summary

        print(extra_summary(options.command, result, out))
    elif found["status"] != "ok":
        print(f"nlsid: {found['status']}: {'; '.join(found['reasons'])}", file=sys.stderr)
    return DONE if found["status"] == "ok" else REFUSED


def _check(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.checking import examine
    from bayes_nlsid.study.reading import read_study
    from bayes_nlsid.study.screen import plan

    study = read_study(options.study)
    print(plan(study, examine(study)))
    return DONE


def _plan(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.planning import run_plan, sentences
    from bayes_nlsid.study.reading import read_study

    out = Path(options.out)
    reporter = _reporter(options, None)
    reporter.begin(1, 1, "plan", options.study)
    said = run_plan(read_study(options.study), out, seed=options.seed, progress=reporter.update)
    reporter.end(0.0, reused=False)
    if not options.quiet:
        print("\n".join([*sentences(said), f"\nin {out}: plan.html, plan.json, figures/"]))
    return DONE if any(e["status"] == "ok" for e in said["excitations"]) else REFUSED


def _report(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.run import rebuild_report, write_markdown

    out = Path(options.out)
    wrote = write_markdown(out) if options.format == "markdown" else None
    if wrote is None:
        rebuild_report(out)
    if not options.quiet:
        print(f"wrote {wrote or out / 'report.html'}")
    return DONE


def _terms(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.screen import terms_table

    print(terms_table())
    return DONE


def _new(options: argparse.Namespace) -> int:
    if options.files:
        from bayes_nlsid.study.drafting import draft_study

        path, wrote = draft_study(Path(options.out), [Path(f) for f in options.files]), ""
    else:
        from bayes_nlsid.study.template import write_template

        path, wrote = write_template(Path(options.out)), " and an example recording beside it"
    if not options.quiet:
        print(f"wrote {path}{wrote}\nnext: nlsid check {path}")
    return DONE


def _diagnose(options: argparse.Namespace) -> int:
    from bayes_nlsid.study.diagnosing import lines, run_diagnosis

    out = Path(options.out)
    found = run_diagnosis(options.study, out, seed=options.seed, hypotheses=options.hypotheses, reporter=_reporter(options, out))
    if not options.quiet:
        print(lines(found) + f"\n\nin {out}: report.html, diagnosis.json, predictions.npz, figures/")
    return REFUSED if found.verdict == "cannot_tell" else DONE


def _hypotheses(options: argparse.Namespace) -> int:
    from bayes_nlsid.mismatch.catalogue import with_rows
    from bayes_nlsid.study.hypotheses import read_hypotheses
    from bayes_nlsid.study.screen import hypotheses_table

    with with_rows(read_hypotheses(options.own) if options.own else ()):
        print(hypotheses_table())
    return DONE


