"""What a run tells while it works: a line that renews itself on a terminal, and a log file always."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO, final

from bayes_nlsid.errors import InputError

Progress = Callable[[float, str], None]


def duration(seconds: float) -> str:
    """``75`` → ``1 min 15 s``."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


@final
class Reporter:
    """Progress of a run.

    Parameters
    ----------
    logs : tuple of Path
        Files that every finished step is appended to.
    terminal : TextIO or None
        Where the renewing line goes; None for silence (not a terminal, or ``--quiet``).
    """

    def __init__(self, logs: tuple[Path, ...] = (), terminal: TextIO | None = None) -> None:
        self._logs, self._terminal = logs, terminal
        self._label, self._began, self._shown = "", time.monotonic(), 0.0
        self._width = 0
        self._passed: list[tuple[float, float]] = []  # (when, share) of the current stage

    def begin(self, number: int, count: int, stage: str, why: str) -> None:
        """A stage starts; ``why`` says what makes it necessary."""
        self._label, self._began = f"[{number}/{count}] {stage}", time.monotonic()
        self._passed = [(self._began, 0.0)]
        self._record(f"{self._label}: begun ({why})")
        self._line(f"{self._label} ...")

    def update(self, share: float, sentence: str) -> None:
        """Part of the current stage is done (0 to 1)."""
        now = time.monotonic()
        if now - self._shown < 0.1 and share < 1:
            return
        self._shown = now
        left = self._left(now, share)
        rest = "" if left is None else f", about {duration(left)} left"
        self._line(f"{self._label} {100 * min(max(share, 0.0), 1.0):3.0f} %{rest}  {sentence}")

    def _left(self, now: float, share: float) -> float | None:
        """Seconds left at the pace of the later half of the stage so far; None where that says nothing.

        What an earlier run had finished passes at once, so the pace since the beginning would promise too much.
        """
        self._passed.append((now, share))
        since = now - max(5.0, 0.5 * (now - self._began))
        while len(self._passed) > 2 and self._passed[1][0] <= since:
            self._passed.pop(0)
        then, before = self._passed[0]
        if now - self._began < 2 or not before + 0.01 < share < 1:
            return None
        return (now - then) * (1 - share) / (share - before)

    def end(self, seconds: float, reused: bool) -> None:
        """The current stage is finished."""
        text = f"{self._label}: " + ("taken from an earlier run" if reused else f"done in {duration(seconds)}")
        self._record(text)
        self._line(text)
        if self._terminal is not None:
            self._terminal.write("\n")
            self._terminal.flush()
        self._width = 0

    def note(self, sentence: str) -> None:
        """A sentence worth keeping."""
        self._record(sentence)
        if self._terminal is not None:
            self._line("")
            self._terminal.write(f"\r  {sentence}\n")
            self._terminal.flush()
            self._width = 0

    def log(self, sentence: str) -> None:
        """A sentence for the log alone."""
        self._record(sentence)

    def _line(self, text: str) -> None:
        if self._terminal is None:
            return
        shown = text[:118]
        self._terminal.write("\r" + shown + " " * max(0, self._width - len(shown)))
        self._terminal.flush()
        self._width = len(shown)

    def _record(self, text: str) -> None:
        for path in self._logs:
            with path.open("a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")


def opening(told: Reporter, sentence: str, versions: Mapping[str, str], inputs: Sequence[tuple[str, str]]) -> None:
    """The first lines of a log: with what, on what, and how; ``inputs`` are files with their SHA-256."""
    told.log(f"{sentence}; " + ", ".join(f"{name} {value}" for name, value in versions.items()))
    for name, digest in inputs:
        told.log(f"input {name}: SHA-256 {digest}")


@contextmanager
def ending(told: Reporter, again: str) -> Iterator[None]:
    """What does not come to its end says why in its log; ``again``: what the same command does after it was stopped."""
    try:
        yield
    except BaseException as error:
        why = f"stopped; the same command {again}" if isinstance(error, KeyboardInterrupt) else (
            f"refused: {error}" if isinstance(error, InputError) else f"failed: {type(error).__name__}: {error}")
        with suppress(OSError):  # the log may lie on the disk that is full
            told.log(why)
        raise
