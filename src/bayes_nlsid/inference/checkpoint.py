"""Blocks of a chain on disk, one file each, whole or absent."""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.inference.block import Block, Walkers
from bayes_nlsid.inference.posterior import write_npz
from bayes_nlsid.inference.target import Target


@final
@dataclass(frozen=True)
class Checkpoints:
    """A folder with one file per ensemble and block of steps.

    A killed run leaves every finished block; the next run with the same inputs reads them and goes on as if nothing had happened, to the
    last bit. A run with other inputs is refused.

    Parameters
    ----------
    folder : Path
    identity : str
        Hash of everything that determines the chain.

    Raises
    ------
    InputError
        If the folder holds another run.
    """

    folder: Path
    identity: str

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        label = self.folder / "run.json"
        try:
            found = json.loads(label.read_text())["identity"] if label.exists() else None
        except (ValueError, KeyError, OSError):
            found = "unreadable"
        if found is None:
            temporary = label.with_suffix(".part")
            temporary.write_text(json.dumps({"identity": self.identity}))
            temporary.replace(label)
        elif found != self.identity:
            raise InputError(str(self.folder), "holds the chain of another model, data, prior, likelihood or seed",
                             "name another folder, or remove this one to sample again")

    def _path(self, ensemble: int, block: int) -> Path:
        return self.folder / f"ensemble{ensemble:02d}_block{block:05d}.npz"

    def read(self, ensemble: int, block: int) -> Block | None:
        """A finished block, or None; a damaged file counts as absent."""
        path = self._path(ensemble, block)
        if not path.exists():
            return None
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as f:
                name, position, has_gauss, gauss = json.loads(str(f["generator"]))
                end = Walkers(f["end_s"], f["end_log_prob"], (name, f["keys"], position, has_gauss, gauss))
                return Block(f["s"], f["log_prob"], f["accepted"], end, int(f["failures"]), f["failed_at"])
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
            return None

    def write(self, ensemble: int, block: int, content: Block) -> None:
        """Put a block on disk, at once."""
        name, keys, *rest = content.end.random
        write_npz(self._path(ensemble, block), s=content.s, log_prob=content.log_prob, accepted=content.accepted, end_s=content.end.s,
                  end_log_prob=content.end.log_prob, keys=keys, generator=np.array(json.dumps([name, *rest])),
                  failures=content.failures, failed_at=content.failed_at)


def identity(target: Target, starts: list[tuple[NDArray[np.float64], NDArray[np.float64]]], numbers: tuple[int, ...]) -> str:
    """Hash of the posterior density and of how it is sampled."""
    problem = target.problem
    digest = hashlib.sha256()
    words = [list(problem.names), target.likelihood.describe(), [repr(p) for p in target.priors], problem.scenario.name,
             [(e.term.name, e.term.formula, list(e.locations), e.tied, e.excess, list(e.fixed)) for e in problem.model.elements],
             list(numbers)]
    digest.update(json.dumps(words, sort_keys=True, default=str).encode())
    for array in (problem.bounds, target.coordinates.scale, problem.base, problem.columns, target.likelihood.weights,
                  *(x for pair in starts for x in pair)):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
