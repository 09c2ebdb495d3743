"""One run at a time in one folder: a lock file that a dead process cannot keep."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bayes_nlsid.errors import InputError


def _born(pid: int) -> str:
    """When a process began, in the system's own words (Linux), so that a re-used number is not mistaken for the old process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def _alive(pid: int) -> bool:
    """Whether a process of this machine exists."""
    if os.name == "nt":  # there os.kill(pid, 0) would end the process, so ask the file system of handles instead
        import ctypes

        kernel = ctypes.windll.kernel32  # type: ignore[attr-defined, unused-ignore]
        handle = kernel.OpenProcess(0x1000, False, pid)
        if handle:
            kernel.CloseHandle(handle)
        return bool(handle)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _read(path: Path) -> dict[str, Any] | None:
    """What the lock says; an empty or broken lock (its writer died half-way) counts as stale once it is a few seconds old."""
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
        return said if isinstance(said, dict) else {}
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}


def _stale(path: Path, said: dict[str, Any]) -> bool:
    """Whether the lock's owner is certainly gone."""
    if not {"pid", "host", "born"} <= said.keys():
        try:
            return time.time() - path.stat().st_mtime > 5.0
        except FileNotFoundError:
            return True
    if said["host"] != socket.gethostname():
        return False
    return not _alive(int(said["pid"])) or _born(int(said["pid"])) != said["born"]


def _take(path: Path) -> None:
    """Create the lock, or refuse with the owner's number.

    A stale lock is first renamed under this process's own name: of two processes that find it stale only one rename succeeds.
    """
    mine = json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "born": _born(os.getpid()), "since": time.time()})
    for _ in range(5):
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            said = _read(path)
            if said is None:
                continue
            if not _stale(path, said):
                owner = f"process {said.get('pid', '?')} on {said.get('host', '?')}"
                raise InputError(str(path.parent.parent), f"another run ({owner}) is writing into this folder",
                                 f"wait for it, choose another --out, or remove {path} if that process is gone") from None
            aside = path.with_name(f"{path.name}.stale.{os.getpid()}")
            try:
                os.replace(path, aside)
            except FileNotFoundError:
                continue
            if _read(aside) != said:  # somebody else's fresh lock was caught: give it back
                os.replace(aside, path)
            else:
                aside.unlink(missing_ok=True)
            continue
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(mine)
        except OSError:  # a full disk: an empty lock would keep the next run out
            path.unlink(missing_ok=True)
            raise
        return
    raise InputError(str(path.parent.parent), "the lock of this folder keeps changing hands", "start one run at a time")


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold the lock file ``path`` while the block runs.

    Raises
    ------
    InputError
        If a living process holds it.
    """
    _take(path)
    try:
        yield
    finally:
        said = _read(path)
        if said and said.get("pid") == os.getpid():
            path.unlink(missing_ok=True)
