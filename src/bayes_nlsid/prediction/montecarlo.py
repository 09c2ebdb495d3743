"""Backbones of very many parameter samples, in chunks that are kept on disk: a run that is killed goes on where it stopped.

Where averaging holds (``prediction/fast.py``) a backbone costs a tenth of a millisecond; where it refuses (modes interact, forces with
memory of another kind than Masing's) the decay is integrated in time. Nothing but the curves is kept.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.executors import run_tasks
from bayes_nlsid.inference.posterior import write_npz
from bayes_nlsid.model import Model
from bayes_nlsid.prediction.bands import REFERENCE_FACTOR, Run, median_sample, release_of
from bayes_nlsid.prediction.fast import fast_bands
from bayes_nlsid.simulation.schemes import SchemeName, spectrum, steps

Array = NDArray[np.float64]
PathName = Literal["auto", "fast", "time"]
FAST_CHUNK, TIME_CHUNK = 250, 50
MOST_BYTES = 2**33
"""Of all curves together, which stand in memory at the end."""


@final
@dataclass(frozen=True)
class Decay:
    """Which backbone is wanted, and how; see ``backbone_bands`` for the meaning of each."""

    at: str
    start_amplitude: float
    mode: int = 0
    amplitudes: tuple[float, ...] = ()
    fs: float | None = None
    scheme: SchemeName = "hht"
    duration: float | None = None
    band: tuple[float, float] | None = None


@final
@dataclass(frozen=True)
class Backbones:
    """Backbones of many samples.

    Parameters
    ----------
    amplitude : ndarray (K,)
        m.
    frequency, damping : ndarray (N, K)
        Hz and ratio; NaN where a sample failed or did not pass.
    status : ndarray of str (N,)
    path : ndarray of str (N,)
        ``"fast"`` or ``"time"``: how each was computed.
    """

    amplitude: Array
    frequency: Array
    damping: Array
    status: NDArray[np.str_]
    path: NDArray[np.str_]


@final
@dataclass(frozen=True)
class NumericalError:
    """What computing adds to a backbone, found on one sample against the exponential step at four times the rate.

    Parameters
    ----------
    frequency, damping : ndarray (K,)
        Hz and ratio.
    period_error, false_damping : float
        Of the time step in the linear mode released, relative and ratio; what samples on the time path suffer.
    fs : float
        Hz, of the time path.
    """

    frequency: Array
    damping: Array
    period_error: float
    false_damping: float
    fs: float


def backbones(model: Model, theta: Array, decay: Decay, *, path: PathName = "auto", folder: Path | None = None,
              executor: str | Executor = "local", workers: int = 1, progress: Callable[[float, str], None] | None = None) -> Backbones:
    """Backbones of every row of theta.

    Parameters
    ----------
    model : Model
    theta : ndarray (N, P)
    decay : Decay
    path : {"auto", "fast", "time"}
        ``fast``: averaging, with a status where it refuses; ``time``: integration; ``auto``: averaging, integration where that refuses.
    folder : Path or None
        Where finished chunks are kept; those already there are not computed again. The caller sees to it that a folder belongs to one set
        of arguments.
    executor, workers
        As in ``executors.run_tasks``; results do not depend on them.
    progress : callable or None

    Returns
    -------
    Backbones

    Raises
    ------
    ValueError
        As ``backbone_bands``, and with ``path="fast"`` as ``fast_bands``.
    """
    if path not in ("auto", "fast", "time"):
        raise ValueError(f"path must be auto, fast or time, got {path!r}")
    release = release_of(theta, model, decay.at, decay.start_amplitude, decay.mode, decay.amplitudes or None, None, decay.fs,
                         _duration(model, theta, decay))
    size = 16 * len(theta) * len(release.grid)
    if size > MOST_BYTES:
        raise ValueError(f"{len(theta)} backbones at {len(release.grid)} amplitudes are {1e-9 * size:.3g} GB; ask for fewer samples or "
                         "amplitudes, or for no indices")
    quick = path == "fast" or (path == "auto" and _averages(model, theta, decay, release.grid))
    step = FAST_CHUNK if quick else TIME_CHUNK
    starts = list(range(0, len(theta), step))
    kept = {i: found for i in range(len(starts)) if (found := _read(folder, i, min(step, len(theta) - starts[i]))) is not None}
    todo = [i for i in range(len(starts)) if i not in kept]
    shared = (model, decay, release, quick, path)
    for number, answer in run_tasks(_chunk, shared, [theta[starts[i]:starts[i] + step] for i in todo], executor=executor, workers=workers):
        kept[todo[number]] = answer
        if folder is not None:
            write_npz(_name(folder, todo[number]), **answer)
        if progress is not None:
            progress(len(kept) / len(starts), f"backbones of {min(step * len(kept), len(theta))} of {len(theta)} samples")
    whole = {name: np.concatenate([kept[i][name] for i in range(len(starts))]) for name in ("frequency", "damping", "status", "way")}
    return Backbones(release.grid, whole["frequency"], whole["damping"], whole["status"], whole["way"])


def numerical_error(model: Model, theta: Array, found: Backbones, decay: Decay) -> NumericalError:
    """The error of the path taken, on the usable sample nearest to the median.

    Parameters
    ----------
    model, theta, found, decay
        As given to and returned by `backbones`.
    """
    ok = found.status == "ok"
    nothing = np.full(len(found.amplitude), np.nan)
    if not ok.any():
        return NumericalError(nothing, nothing.copy(), float("nan"), float("nan"), 0.0)
    i = median_sample(found.frequency, found.damping, ok)
    one = theta[i:i + 1]
    duration = _duration(model, one, decay)
    release = release_of(one, model, decay.at, decay.start_amplitude, decay.mode, tuple(found.amplitude), None, decay.fs, duration)
    run = Run(model, release, "exponential", 0.0, decay.band, None)
    f, z, *_ = run.curves(one, REFERENCE_FACTOR * release.fs)
    omega, zeta = (v[0] for v in model.linear_values(one))
    period, false = spectrum(steps(omega, zeta, 1 / release.fs, decay.scheme), omega, zeta)
    return NumericalError(found.frequency[i] - f[0], found.damping[i] - z[0], float(period[decay.mode]), float(false[decay.mode]),
                          release.fs)


def _duration(model: Model, theta: Array, decay: Decay) -> float | None:
    """The duration given; a placeholder where it is not needed because there is no linear damping to tell it (averaging)."""
    if decay.duration is not None:
        return decay.duration
    if not 0 <= decay.mode < model.linear.modes:
        return None  # which is refused where the release is made
    omega, zeta = model.linear_values(theta)
    return 400 / float(model.linear.frequency[decay.mode]) if (omega * zeta)[:, decay.mode].min() <= 0 else None


def _averages(model: Model, theta: Array, decay: Decay, grid: Array) -> bool:
    """Whether averaging takes this model at all."""
    try:
        fast_bands(theta[:1], model, at=decay.at, start_amplitude=decay.start_amplitude, mode=decay.mode, amplitudes=grid)
    except ValueError:
        return False
    return True


def _chunk(shared: tuple[Model, Decay, Any, bool, PathName], theta: Array) -> dict[str, NDArray[Any]]:
    """Backbones of some samples."""
    model, decay, release, quick, path = shared
    shape = (len(theta), len(release.grid))
    frequency, damping = np.full(shape, np.nan), np.full(shape, np.nan)
    status, way = np.full(len(theta), "", dtype="<U24"), np.full(len(theta), "time", dtype="<U4")
    rest = np.arange(len(theta))
    if quick:
        options = {"at": decay.at, "start_amplitude": decay.start_amplitude, "mode": decay.mode, "amplitudes": release.grid}
        found = fast_bands(theta, model, **options)
        frequency[:], damping[:] = found.samples_frequency, found.samples_damping
        refused = np.isnan(frequency).all(axis=1)
        status[~refused], way[~refused], rest = "ok", "fast", np.flatnonzero(refused)
        if path == "fast":
            for i in rest:
                status[i], way[i] = next(iter(fast_bands(theta[i:i + 1], model, **options).status)), "fast"
            rest = rest[:0]
    for first in range(0, len(rest), min(release.chunk, TIME_CHUNK)):
        part = rest[first:first + min(release.chunk, TIME_CHUNK)]
        curves = Run(model, release, decay.scheme, -0.05, decay.band, None).curves(theta[part], release.fs)
        frequency[part], damping[part], status[part] = curves[:3]
    return {"frequency": frequency, "damping": damping, "status": status, "way": way}


def _name(folder: Path, number: int) -> Path:
    return folder / f"chunk_{number:06d}.npz"


def _read(folder: Path | None, number: int, count: int) -> dict[str, NDArray[Any]] | None:
    """A chunk that an earlier run has left whole; None if there is none."""
    if folder is None:
        return None
    try:
        with np.load(_name(folder, number), allow_pickle=False) as file:
            found = {name: file[name] for name in ("frequency", "damping", "status", "way")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return found if all(len(array) == count for array in found.values()) else None
