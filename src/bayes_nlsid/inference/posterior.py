"""The result of sampling: draws, what they may be trusted for, and where they came from."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.inference.convergence import Convergence
from bayes_nlsid.inference.prior import Prior

FORMAT = 1


@final
@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws of theta after burn-in.

    Parameters
    ----------
    names, units : tuple of str, length P
    theta : ndarray (M, draws, walkers, P)
        Physical parameters, SI, of M independent ensembles.
    log_prob : ndarray (M, draws, walkers)
        Log posterior density in search coordinates, up to a constant.
    convergence : Convergence
    priors : tuple of Prior
    seed : int
    likelihood : str
        In words.
    burn : int
        Steps discarded.
    failures : int
        Evaluations at which the likelihood was not finite inside the bounds.
    failed_at : ndarray (F, P)
        The first few of them, theta.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    theta: NDArray[np.float64] = field(repr=False)
    log_prob: NDArray[np.float64] = field(repr=False)
    convergence: Convergence
    priors: tuple[Prior, ...] = field(repr=False)
    seed: int
    likelihood: str
    burn: int
    failures: int = 0
    failed_at: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)), repr=False)

    def __post_init__(self) -> None:
        if self.theta.ndim != 4 or self.theta.shape[-1] != len(self.names) or len(self.units) != len(self.names):
            raise ValueError(f"theta has shape {self.theta.shape}, expected (M, draws, walkers, {len(self.names)})")
        if self.log_prob.shape != self.theta.shape[:3]:
            raise ValueError(f"log_prob has shape {self.log_prob.shape}, expected {self.theta.shape[:3]}")

    @property
    def status(self) -> str:
        """"ok", "not_converged" or "not_identifiable"."""
        return self.convergence.status

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why, in words; also what is worth knowing of an ok run."""
        return self.convergence.reasons

    @property
    def flat(self) -> NDArray[np.float64]:
        """(all draws, P)."""
        return self.theta.reshape(-1, len(self.names))

    def draws(self, count: int, seed: int) -> NDArray[np.float64]:
        """``count`` draws (count, P), without repetition while there are enough.

        Raises
        ------
        ValueError
            If ``count`` is not positive or there are no draws at all.
        """
        flat = self.flat
        if count < 1 or len(flat) == 0:
            raise ValueError(f"cannot take {count} draws from a posterior of {len(flat)}")
        return flat[np.random.default_rng(seed).choice(len(flat), count, replace=count > len(flat))]

    def quantiles(self, probabilities: ArrayLike = (0.05, 0.5, 0.95)) -> NDArray[np.float64]:
        """(len(probabilities), P); NaN without draws."""
        shares = np.atleast_1d(np.asarray(probabilities, dtype=float))
        return np.quantile(self.flat, shares, axis=0) if len(self.flat) else np.full((len(shares), len(self.names)), np.nan)

    @property
    def best(self) -> NDArray[np.float64]:
        """The draw (P,) of highest log_prob."""
        return self.flat[int(np.argmax(self.log_prob))]

    def summary(self) -> list[dict[str, Any]]:
        """One row for each parameter: name, unit, q05, q50, q95, identifiable, ess, tau, rhat, contraction, prior."""
        q, c = self.quantiles(), self.convergence
        return [{"name": name, "unit": unit, "q05": float(q[0, i]), "q50": float(q[1, i]), "q95": float(q[2, i]),
                 "identifiable": bool(c.identifiable[i]), "ess": float(c.ess[i]), "tau": float(c.tau[i]), "rhat": float(c.rhat[i]),
                 "contraction": float(c.contraction[i]), "prior": self.priors[i].sentence}
                for i, (name, unit) in enumerate(zip(self.names, self.units, strict=True))]

    def save(self, path: Path | str) -> None:
        """Write everything to one .npz, at once or not at all."""
        c = self.convergence
        arrays = {f.name: getattr(c, f.name) for f in fields(c) if isinstance(getattr(c, f.name), np.ndarray)}
        plain = {f.name: getattr(c, f.name) for f in fields(c) if not isinstance(getattr(c, f.name), np.ndarray)}
        meta = {"format": FORMAT, "names": self.names, "units": self.units, "seed": self.seed, "likelihood": self.likelihood,
                "burn": self.burn,
                "failures": self.failures, "priors": [asdict(p) for p in self.priors], "convergence": plain}
        write_npz(Path(path), theta=self.theta, log_prob=self.log_prob, failed_at=self.failed_at, meta=np.array(json.dumps(meta)),
                  **{f"convergence_{k}": v for k, v in arrays.items()})


def load(path: Path | str) -> Posterior:
    """Read what ``Posterior.save`` wrote.

    Raises
    ------
    InputError
        If the file is missing, damaged or not a posterior.
    """
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {k: file[k] for k in file.files}
        meta = json.loads(str(arrays.pop("meta")))
        if meta["format"] != FORMAT:
            raise KeyError(f"format {meta['format']}")
        diagnostics = {k.removeprefix("convergence_"): v for k, v in arrays.items() if k.startswith("convergence_")}
        plain = meta["convergence"] | {"reasons": tuple(meta["convergence"]["reasons"])}
        return Posterior(tuple(meta["names"]), tuple(meta["units"]), arrays["theta"], arrays["log_prob"],
                         Convergence(**plain, **diagnostics),
                         tuple(Prior(**p) for p in meta["priors"]), meta["seed"], meta["likelihood"], meta["burn"], meta["failures"],
                         arrays["failed_at"])
    except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(path), f"cannot be read as a posterior ({error})",
                         "sample again, or name a file written by Posterior.save") from error


def write_npz(path: Path, **arrays: ArrayLike) -> None:
    """Write an .npz beside its place and move it there, so that a kill leaves the old file or the new one, never half of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **{k: np.asarray(v) for k, v in arrays.items()})  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def columns(posterior: Posterior, names: Sequence[str]) -> NDArray[np.float64]:
    """Draws (count, len(names)) of the named parameters.

    Raises
    ------
    ValueError
        If a name is unknown.
    """
    unknown = [n for n in names if n not in posterior.names]
    if unknown:
        raise ValueError(f"unknown parameters {unknown}; known are {list(posterior.names)}")
    return posterior.flat[:, [posterior.names.index(n) for n in names]]
