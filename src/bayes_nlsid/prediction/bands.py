"""Backbone bands: frequency and damping against amplitude, for many samples of the parameters, with the integrator's own error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, final, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.model import Model
from bayes_nlsid.recordings.decay import measured_backbone
from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.simulation.schemes import SchemeName

Array = NDArray[np.float64]
LEVELS = (0.05, 0.5, 0.95)
GRID = 40
STEPS_PER_CYCLE = 100
STORED_PER_CYCLE = 40
REFERENCE_FACTOR = 4
CHUNK_BYTES = 2**28
SLOWEST = 10.0
"""Samples whose linear part decays more slowly than the median by this factor are not waited for: low amplitudes stay without a value."""
ENOUGH = 0.9
"""Share of the usable samples that must pass an amplitude for quantiles to be given there."""


@runtime_checkable
class Drawable(Protocol):
    """A posterior, as far as this page needs one."""

    def draws(self, count: int, seed: int) -> Array:
        """(count, P) samples of theta."""
        ...


@final
@dataclass(frozen=True)
class Bands:
    """Quantiles of the backbone over samples of the parameters.

    Parameters
    ----------
    amplitude : ndarray (K,)
        m at ``location``, ascending.
    frequency, damping : ndarray (3, K)
        Hz and ratio at the levels 0.05, 0.5, 0.95; NaN where fewer than 90 % of the usable samples pass.
    samples_frequency, samples_damping : ndarray (S, K)
        NaN where a sample did not pass.
    numerical_error_frequency, numerical_error_damping : ndarray (K,)
        What the integrator adds: the same (median) sample minus a reference by the exponential step at four times the rate, Hz and ratio.
    location : str
    mode : int
        0-based index of the mode released.
    status : dict of str to int
        How many samples ended how; only ``"ok"`` enter the quantiles.
    scheme, fs : str, float
        How it was integrated; Hz. ``"averaging"`` and 0 for the fast path.
    period_error, false_damping : ndarray (m,)
        Of the step, per linear mode.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    amplitude: Array
    frequency: Array
    damping: Array
    samples_frequency: Array
    samples_damping: Array
    numerical_error_frequency: Array
    numerical_error_damping: Array
    location: str
    mode: int
    status: dict[str, int]
    scheme: str
    fs: float
    period_error: Array
    false_damping: Array

    def __post_init__(self) -> None:
        k = len(self.amplitude)
        for name, shape in (("frequency", (3, k)), ("damping", (3, k)), ("numerical_error_frequency", (k,)),
                            ("numerical_error_damping", (k,)), ("samples_damping", self.samples_frequency.shape)):
            if getattr(self, name).shape != shape:
                raise ValueError(f"bands: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if self.samples_frequency.shape[1:] != (k,):
            raise ValueError(f"bands: samples_frequency has shape {self.samples_frequency.shape}, expected (S, {k})")

    def save(self, path: str | Path) -> Path:
        """Write ``backbone.npz``; returns the file written."""
        target = Path(path)
        arrays: dict[str, Any] = {"amplitude": self.amplitude}
        for name, values in (("frequency", self.frequency), ("damping", self.damping)):
            arrays |= {f"{name}_q{round(100 * level):02d}": row for level, row in zip(LEVELS, values, strict=True)}
        for name in ("samples_frequency", "samples_damping", "numerical_error_frequency", "numerical_error_damping", "location", "mode",
                     "scheme", "fs", "period_error", "false_damping"):
            arrays[name] = np.asarray(getattr(self, name))
        arrays["status_name"] = np.array(list(self.status), dtype=str)
        arrays["status_count"] = np.array(list(self.status.values()), dtype=int)
        with target.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
        return target

    @classmethod
    def load(cls, path: str | Path) -> Bands:
        """Read what ``save`` wrote."""
        with np.load(Path(path), allow_pickle=False) as data:
            frequency, damping = (np.stack([data[f"{name}_q{round(100 * level):02d}"] for level in LEVELS]) for name in ("frequency",
                                                                                                                         "damping"))
            return cls(data["amplitude"], frequency, damping, data["samples_frequency"], data["samples_damping"],
                       data["numerical_error_frequency"], data["numerical_error_damping"], str(data["location"]), int(data["mode"]),
                       dict(zip(data["status_name"].tolist(), data["status_count"].tolist(), strict=True)), str(data["scheme"]),
                       float(data["fs"]), data["period_error"], data["false_damping"])


def backbone_bands(draws: ArrayLike | Drawable, model: Model, *, at: str, start_amplitude: float, mode: int = 0,
                   amplitudes: ArrayLike | None = None, stop_amplitude: float | None = None, fs: float | None = None,
                   scheme: SchemeName = "hht", alpha: float = -0.05, samples: int = 200, seed: int = 0, duration: float | None = None,
                   band: tuple[float, float] | None = None, progress: Callable[[str], None] | None = None) -> Bands:
    """Release every sample from one mode shape, let it ring down, and read frequency and damping off the zero crossings.

    Parameters
    ----------
    draws : array_like (S, P) or object with ``draws(count, seed)``
        Samples of theta, or a posterior to draw ``samples`` of them from.
    model : Model
    at : str
        Location whose amplitude is meant.
    start_amplitude : float
        m at ``at``, where the decay begins.
    mode : int
        0-based.
    amplitudes : array_like (K,) or None
        m, ascending; by default 40 from ``stop_amplitude`` to just below the start.
    stop_amplitude : float or None
        m; by default half the smallest of ``amplitudes``, or 1/400 of the start.
    fs : float or None
        Hz; by default the power of two next above 100 steps per cycle of the mode.
    scheme, alpha
        As in ``simulate``.
    samples, seed : int
        Used with a posterior only.
    duration : float or None
        s at most; by default what linear damping alone needs to reach ``stop_amplitude``.
    band : tuple of float or None
        Hz; band-pass before the zero crossings, if other modes disturb them.
    progress : callable or None

    Returns
    -------
    Bands

    Raises
    ------
    ValueError
        If the location does not move in this mode, amplitudes are not positive, or the duration cannot be told.
    """
    theta = np.atleast_2d(draws.draws(samples, seed) if isinstance(draws, Drawable) else np.asarray(draws, dtype=float))
    release = release_of(theta, model, at, start_amplitude, mode, amplitudes, stop_amplitude, fs, duration)
    run = Run(model, release, scheme, alpha, band, progress)
    parts = [run.curves(theta[i:i + release.chunk], release.fs) for i in range(0, len(theta), release.chunk)]
    frequency, damping = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
    status = np.concatenate([p[2] for p in parts])
    ok = status == "ok"
    counts = {str(name): int((status == name).sum()) for name in np.unique(status)}
    error_f, error_d = np.full(len(release.grid), np.nan), np.full(len(release.grid), np.nan)
    if ok.any():
        middle = median_sample(frequency, damping, ok)
        reference = Run(model, release, "exponential", alpha, band, progress).curves(theta[middle:middle + 1],
                                                                                      REFERENCE_FACTOR * release.fs)
        error_f, error_d = frequency[middle] - reference[0][0], damping[middle] - reference[1][0]
    period_error, false_damping = parts[0][3], parts[0][4]
    return Bands(release.grid, quantiles(frequency, ok), quantiles(damping, ok), frequency, damping, error_f, error_d, at, mode, counts,
                 scheme, release.fs, period_error, false_damping)


def quantiles(curves: Array, ok: NDArray[np.bool_]) -> Array:
    """(3, K) at the levels 0.05, 0.5, 0.95 of the usable rows of (S, K); NaN where fewer than 90 % of them have a value."""
    usable = curves[ok]
    out = np.full((len(LEVELS), curves.shape[1]), np.nan)
    if len(usable):
        enough = np.isfinite(usable).mean(axis=0) >= ENOUGH
        out[:, enough] = np.nanquantile(usable[:, enough], LEVELS, axis=0)
    return out


def amplitude_grid(amplitudes: ArrayLike | None, start: float, stop: float) -> Array:
    """The amplitudes asked for, or 40 between the floor and the start, spaced logarithmically; m.

    Raises
    ------
    ValueError
        If they are not positive and ascending.
    """
    grid = np.geomspace(1.1 * stop, 0.97 * start, GRID) if amplitudes is None else np.asarray(amplitudes, dtype=float)
    if grid.ndim != 1 or grid.size == 0 or not (np.isfinite(grid).all() and (grid > 0).all() and (np.diff(grid) > 0).all()):
        raise ValueError(f"amplitudes of shape {grid.shape} must be one-dimensional, positive and ascending")
    return grid


@final
@dataclass(frozen=True)
class Release:
    """A decay to be integrated: where and from what motion, at which amplitudes (m) it is read, down to which, how fast and how long."""

    at: str
    start: Array
    grid: Array
    stop: float
    fs: float
    duration: float
    every: int
    chunk: int


def release_of(theta: Array, model: Model, at: str, amplitude: float, mode: int, amplitudes: ArrayLike | None, stop: float | None,
             fs: float | None, duration: float | None) -> Release:
    """Checked and completed arguments of `backbone_bands`.

    Raises
    ------
    ValueError
        As there.
    """
    if not 0 <= mode < model.linear.modes:
        raise ValueError(f"mode {mode} does not exist; the model has modes 0 to {model.linear.modes - 1}")
    if not (np.isfinite(amplitude) and amplitude > 0):
        raise ValueError(f"start_amplitude must be a positive number of metres, got {amplitude}")
    shape = float(model.linear.rows((at,))[0, mode])
    if shape == 0:
        raise ValueError(f"location {at!r} does not move in mode {mode}; name another")
    lowest = None if amplitudes is None else float(np.min(np.asarray(amplitudes, dtype=float)))
    floor = stop if stop is not None else (0.5 * lowest if lowest is not None and lowest > 0 else amplitude / 400)
    if not 0 < floor < amplitude:
        raise ValueError(f"stop_amplitude {floor} m must lie between 0 and start_amplitude {amplitude} m")
    omega, zeta = model.linear_values(theta)
    frequency = float(np.median(omega[:, mode])) / (2 * np.pi)
    rate = fs if fs is not None else 2.0 ** np.ceil(np.log2(STEPS_PER_CYCLE * frequency))
    if duration is None:
        rates = omega[:, mode] * zeta[:, mode]
        slowest = max(float(rates.min()), float(np.median(rates)) / SLOWEST)
        if rates.min() <= 0:
            raise ValueError("mode without linear damping: say how long to integrate (duration, s)")
        duration = 1.05 * float(np.log(amplitude / floor)) / slowest + 20 / frequency
    every = max(1, int(rate // max(STORED_PER_CYCLE * frequency, 2.2 * float(model.linear.frequency.max()))))
    chunk = max(1, int(CHUNK_BYTES // (16 * rate / every * duration)))
    start = np.zeros(model.linear.modes)
    start[mode] = amplitude / shape
    return Release(at, start, amplitude_grid(amplitudes, amplitude, floor), floor, float(rate), duration, every, chunk)


@final
@dataclass(frozen=True)
class Run:
    """One way of integrating the release."""

    model: Model
    release: Release
    scheme: SchemeName
    alpha: float
    band: tuple[float, float] | None
    progress: Callable[[str], None] | None

    def curves(self, theta: Array, fs: float) -> tuple[Array, Array, NDArray[np.str_], Array, Array]:
        """Frequency, damping (s, K), status (s,), and what the step does to the linear modes."""
        release = self.release
        every = max(1, int(round(release.every * fs / release.fs)))
        response = simulate(self.model, theta, fs=fs, samples=int(np.ceil(release.duration * fs)) + 1, u0=release.start, scheme=self.scheme,
                            alpha=self.alpha, keep=(release.at,), every=every, store=("displacement",), stop_amplitude=release.stop,
                            progress=self.progress)
        decay = response.at(release.at)
        status = np.array(response.status, dtype="<U24")
        shape = (len(theta), len(release.grid))
        frequency, damping = np.full(shape, np.nan), np.full(shape, np.nan)
        for i in np.flatnonzero(np.isfinite(decay).all(axis=1)):
            curve = measured_backbone(response.time, decay[i], self.band, release.grid, release.at)
            frequency[i], damping[i] = curve.frequency, curve.damping
            if status[i] == "ok" and not np.isfinite(frequency[i]).any():
                status[i] = curve.status if curve.status != "ok" else "amplitudes not passed"
        return frequency, damping, status, response.period_error, response.false_damping


def median_sample(frequency: Array, damping: Array, ok: NDArray[np.bool_]) -> int:
    """Index of the usable sample nearest to the median of both curves."""
    distance = np.zeros(len(ok))
    for curves in (frequency, damping):
        seen = np.isfinite(curves[ok]).all(axis=0)
        if not seen.any():
            continue
        middle, spread = np.median(curves[ok][:, seen], axis=0), np.std(curves[ok][:, seen], axis=0)
        distance += np.mean(np.abs(curves[:, seen] - middle) / np.maximum(spread, 1e-12 * np.abs(middle) + 1e-300), axis=1)
    return int(np.argmin(np.where(ok, np.nan_to_num(distance, nan=np.inf), np.inf)))
