"""Parsers of foreign files in a process of their own: a crash, a hang or a greedy allocation there is only an unreadable file here."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import final

PATIENCE = 600.0  # s that a file may take
SPARE = 3 * 2**30  # bytes of address space beside copies of the file: interpreter, numpy, the parser
_BOOT = """
import runpy, sys
try:
    import resource
    most = int(sys.argv[1])
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
except (ImportError, ValueError, OSError):
    pass  # a system without such limits
sys.argv = sys.argv[2:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@final
class Unreadable(Exception):
    """Problem and mend, from a reader that does not know the name of its file."""

    def __init__(self, problem: str, mend: str = "it is damaged, cut short or of another kind: export it again") -> None:
        super().__init__(problem, mend)
        self.problem, self.mend = problem, mend


def parse_apart(program: Path, arguments: Sequence[str], data: bytes, most: int) -> bytes:
    """Standard output of a parser program that was given the bytes of a file.

    Parameters
    ----------
    program : Path
        A file with a ``main`` guard. It ends with 0 (done), 3 (standard output says why not) or 4 (standard output names a package that
        is not installed, and the extra that brings it, as JSON).
    arguments : sequence of str
        The first is the kind of file, as messages call it.
    data : bytes
    most : int
        Bytes that the result may have; the address space of the process is bounded by four copies of this and of the file.

    Raises
    ------
    Unreadable
        In words, whatever happened.
    """
    bound = SPARE + 4 * (len(data) + most)
    command = [sys.executable, "-P", "-c", _BOOT, str(bound), str(program), *arguments]
    try:
        done = subprocess.run(command, input=data, capture_output=True, check=False, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        raise Unreadable(f"was not read within {PATIENCE:.0f} s", "cut it into shorter recordings") from None
    if done.returncode == 0:
        return done.stdout
    said = " ".join(done.stdout.decode(errors="replace").split())
    if done.returncode == 3 and said:
        raise Unreadable(f"cannot be read as .{arguments[0]} ({said[:160]})")
    if done.returncode == 4 and said:
        package, extra = json.loads(said)
        raise Unreadable(f"needs the package {package}, which is not installed", f"pip install 'bayes-nlsid[{extra}]'")
    raise Unreadable(f"cannot be read as .{arguments[0]} (its structure is broken)")
