"""Results of stages on disk: atomic, checked on reading, and skipped when their inputs have not changed."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import shutil
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.lock import held

FORMAT = 1
Arrays = dict[str, NDArray[Any]]


@final
@dataclass(frozen=True)
class Saved:
    """What one stage left.

    Parameters
    ----------
    stage : str
    key : str
        Hash of everything it was computed from.
    arrays : dict of ndarray
    data : dict
        JSON values.
    seconds : float
        Time it took.
    versions : dict of str
    reused : bool
        Whether it was found on disk instead of computed now.
    """

    stage: str
    key: str
    arrays: Arrays
    data: dict[str, Any]
    seconds: float
    versions: dict[str, str] = field(default_factory=dict)
    reused: bool = False


def versions() -> dict[str, str]:
    """Versions that decide a result, for the record and for the hash of a stage's inputs."""
    out = {"python": platform.python_version()}
    for name in ("bayes_nlsid", "numpy", "scipy", "emcee", "arviz", "numba"):
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            from bayes_nlsid import __version__

            out[name] = __version__ if name == "bayes_nlsid" else "absent"
    return out


def digest(value: Any) -> str:
    """SHA-256 of a JSON value, with keys in order."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _plain(value: Any) -> Any:
    """JSON form of numpy numbers and arrays, paths and tuples."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{type(value).__name__} has no place in a stage's data; store it as an array or as plain values")


@contextmanager
def writing(where: Path) -> Iterator[None]:
    """Turn a full disk or a forbidden folder into one sentence.

    Raises
    ------
    InputError
        In place of the `OSError` of the block, if it is one of these.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise InputError(str(where), "the disk is full", "free some space and run again: finished stages are kept") from None
        if isinstance(error, PermissionError) or error.errno == errno.EROFS:
            raise InputError(str(where), "the folder cannot be written to", "choose another --out or change its permissions") from None
        raise


def make_folder(out: Path, inner: str) -> Path:
    """The folder ``inner`` of a results folder, both made where they are missing.

    Raises
    ------
    InputError
        If a file stands in the way, or the folder cannot be made or written to.
    """
    with writing(out):
        try:
            if out.exists() and not out.is_dir():
                raise InputError(str(out), "the output folder is a file", "choose another --out")
            (out / inner).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            if isinstance(error, PermissionError) or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
                raise
            raise InputError(str(out), f"cannot be made ({error.strerror})", "choose another --out") from None
    return out / inner


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old one or the new one, never half of it.

    Raises
    ------
    InputError
        If the disk is full or the folder is read-only.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with writing(path.parent):
        try:
            with partial.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


@final
class Store:
    """The results folder of one study.

    ``stages/<name>/`` holds ``data.json``, ``arrays.npz`` and ``stage.json`` (hash of the inputs, versions, seconds, hashes of
    the two other files). A stage appears by one rename, so a killed run leaves either the whole stage or none. The store removes
    only what carries its own mark.

    Parameters
    ----------
    out : Path
        The folder; created if missing.

    Raises
    ------
    InputError
        If ``out`` is a file, cannot be written, or holds results that another program made.
    """

    def __init__(self, out: Path | str) -> None:
        self.out = Path(out)
        self.stages = self.out / "stages"
        self._mark = self.stages / "store.json"
        if self.out.is_dir() and not self._mark.exists():
            foreign = [name for name in ("result.json", "stages", "report.html", "posterior.nc") if (self.out / name).exists()]
            if foreign and not self._ours_half_made():
                raise InputError(str(self.out), f"holds {', '.join(foreign)} that this program did not make",
                                 "choose another --out, or move them away")
        make_folder(self.out, "stages")
        if not self._mark.exists():
            write_atomic(self._mark, json.dumps({"made_by": "bayes_nlsid", "format": FORMAT}).encode())
        self._check_format()

    def _ours_half_made(self) -> bool:
        """A first run killed before its mark was written leaves an empty ``stages`` folder and nothing else."""
        others = [p for p in self.out.iterdir() if p.name != "stages"]
        return not others and self.stages.is_dir() and all(p.name.endswith(".partial") for p in self.stages.iterdir())

    def _check_format(self) -> None:
        try:
            found = json.loads(self._mark.read_text(encoding="utf-8"))
            number = found["format"] if found["made_by"] == "bayes_nlsid" else None
        except (OSError, ValueError, KeyError, TypeError):
            number = None
        if number != FORMAT:
            raise InputError(str(self._mark), f"store format {number!r} is not {FORMAT}, the one this version reads",
                             "choose another --out, or use the version that made it")

    def lock(self) -> AbstractContextManager[None]:
        """Hold the folder for one run; a second run is refused, the lock of a dead process is taken over."""
        return held(self.stages / "lock")

    def load(self, stage: str) -> Saved | None:
        """What a stage left, or None if it is missing or damaged (its files do not match their hashes)."""
        folder = self.stages / stage
        try:
            meta = json.loads((folder / "stage.json").read_text(encoding="utf-8"))
            if meta["format"] != FORMAT or any(file_digest(folder / name) != sha for name, sha in meta["files"].items()):
                return None
            data = json.loads((folder / "data.json").read_text(encoding="utf-8"))
            with np.load(folder / "arrays.npz", allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            return Saved(stage, meta["key"], arrays, data, float(meta["seconds"]), dict(meta["versions"]), reused=True)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return None

    def why_redo(self, stage: str, key: str) -> str:
        """In one sentence why a stage cannot be taken from disk; empty if it can."""
        folder = self.stages / stage
        if not (folder / "stage.json").exists():
            return "not computed yet"
        saved = self.load(stage)
        if saved is None:
            return "the stored files are damaged"
        if saved.key == key:
            return ""
        old, new = saved.versions, versions()
        changed = [f"{name} {old.get(name, 'absent')} → {new[name]}" for name in new if old.get(name) != new[name]]
        return f"made by other versions ({', '.join(changed)})" if changed else "its inputs have changed"

    def save(self, stage: str, key: str, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any], seconds: float,
             inputs: Mapping[str, Any] | None = None) -> Saved:
        """Store a stage, whole or not at all.

        Raises
        ------
        InputError
            If the disk is full.
        ValueError
            If an array has dtype object, which could not be read back safely.
        """
        wrong = [name for name, array in arrays.items() if np.asarray(array).dtype == object]
        if wrong:
            raise ValueError(f"stage {stage!r}: arrays {wrong} have dtype object; store plain numbers")
        target, partial = self.stages / stage, self.stages / f".{stage}.{os.getpid()}.partial"
        with writing(self.out):
            shutil.rmtree(partial, ignore_errors=True)
            try:
                partial.mkdir()
                text = json.dumps(dict(data), default=_plain, allow_nan=True, indent=1)
                (partial / "data.json").write_text(text, encoding="utf-8")
                with (partial / "arrays.npz").open("wb") as file:
                    np.savez(file, **{name: np.asarray(array) for name, array in arrays.items()})  # type: ignore[arg-type]
                    file.flush()
                    os.fsync(file.fileno())
                meta = {"format": FORMAT, "stage": stage, "key": key, "inputs": dict(inputs or {}), "versions": versions(),
                        "seconds": seconds, "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
                        "files": {name: file_digest(partial / name) for name in ("data.json", "arrays.npz")}}
                (partial / "stage.json").write_text(json.dumps(meta, default=_plain, indent=1), encoding="utf-8")
                self._swap(partial, target)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
        saved = self.load(stage)
        if saved is None:
            raise InputError(str(target), "what was written could not be read back", "check the disk and run again")
        return Saved(stage, key, saved.arrays, saved.data, seconds, saved.versions)

    def _swap(self, new: Path, target: Path) -> None:
        """Put a finished folder in place of the old one; a folder that holds anything but a stage's own files is never replaced."""
        if target.exists():
            if {path.name for path in target.iterdir()} - {"stage.json", "data.json", "arrays.npz"}:
                raise InputError(str(target), "holds files that this program did not make", "move them away and run again")
            old = new.with_name(f"{new.name}.old")
            os.replace(target, old)
            os.replace(new, target)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(new, target)

    def scratch(self, stage: str, key: str) -> Path:
        """A folder for checkpoints of a stage that is under way; those of other inputs are removed.

        Its name carries the hash of the inputs, so that a checkpoint is never continued with other inputs.
        """
        with writing(self.out):
            for folder in self.stages.glob(f".{stage}.*.work"):
                if folder.name != f".{stage}.{key[:16]}.work":
                    shutil.rmtree(folder, ignore_errors=True)
            path = self.stages / f".{stage}.{key[:16]}.work"
            path.mkdir(exist_ok=True)
        return path

    def clear_scratch(self, stage: str) -> None:
        """Remove the checkpoints of a finished stage."""
        for folder in self.stages.glob(f".{stage}.*.work"):
            shutil.rmtree(folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove what killed runs left half-written (call with the lock held)."""
        for path in (*self.stages.glob(".*.partial"), *self.stages.glob(".*.partial.old")):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
