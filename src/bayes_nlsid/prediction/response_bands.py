"""Bands of stepped-sine response curves over samples of the parameters, and whether enough harmonics carry them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.executors import run_tasks
from bayes_nlsid.model import Model
from bayes_nlsid.prediction.bands import LEVELS, Drawable, quantiles
from bayes_nlsid.prediction.continuation import response_curves
from bayes_nlsid.prediction.response_curve import Curve
from bayes_nlsid.prediction.stability import has_multipliers

Array = NDArray[np.float64]
HARMONICS = 7
MOST_HARMONICS = 31
AGREEMENT = 2e-3
"""Relative change of the peak by more harmonics that is small enough."""
CHUNK = 25
EVEN_POINTS = 240
MOST_GRID = 1200


@final
@dataclass(frozen=True)
class ResponseBands:
    """Quantiles of stepped-sine responses over samples of the parameters.

    Parameters
    ----------
    level : ndarray (F,)
        Amplitudes of the force, N.
    frequency : ndarray (K,)
        Hz, ascending; denser where the curves are steep.
    up, down : ndarray (3, F, K)
        Fundamental amplitude of displacement, m, at the levels 0.05, 0.5, 0.95, met by a slow sweep upwards and downwards; NaN where
        fewer than 90 % of the usable samples have a value, as where their steady motion is not stable.
    samples_up, samples_down : ndarray (S, F, K)
    peak_frequency, peak_amplitude : ndarray (S, F)
        Hz and m at the largest response in the band; NaN where a curve failed.
    curves : tuple (F) of Curve
        Whole curves, unstable parts included, of one sample: the draw nearest to the median of the peaks.
    status : dict of str to int
        How many of the S × F curves ended how; only ``"ok"`` enter the quantiles.
    lost : dict of str to int
        On how many of them the motion loses its stability elsewhere than at a turning point, and how.
    judged_by : {"multipliers", "turning points"}
        How stability was found; with memory only turning points are known.
    harmonics : int
    harmonic_error : ndarray (F,)
        Relative change of the median's peak (amplitude or frequency, whichever is larger) when about twice as many harmonics carry it.
    drive, location : str

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    level: Array
    frequency: Array
    up: Array
    down: Array
    samples_up: Array
    samples_down: Array
    peak_frequency: Array
    peak_amplitude: Array
    curves: tuple[Curve, ...]
    status: dict[str, int]
    lost: dict[str, int]
    judged_by: str
    harmonics: int
    harmonic_error: Array
    drive: str
    location: str

    def __post_init__(self) -> None:
        f, k = len(self.level), len(self.frequency)
        for name, shape in (("up", (3, f, k)), ("down", (3, f, k)), ("samples_down", self.samples_up.shape), ("harmonic_error", (f,)),
                            ("peak_amplitude", self.peak_frequency.shape)):
            if getattr(self, name).shape != shape:
                raise ValueError(f"response bands: {name} has shape {getattr(self, name).shape}, expected {shape}")

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What ``frf.npz`` holds."""
        out: dict[str, NDArray[Any]] = {"level": self.level, "frequency": self.frequency, "harmonic_error": self.harmonic_error}
        for name in ("up", "down"):
            out |= {f"{name}_q{round(100 * level):02d}": row for level, row in zip(LEVELS, getattr(self, name), strict=True)}
        for name in ("samples_up", "samples_down", "peak_frequency", "peak_amplitude"):
            out[name] = getattr(self, name)
        for i, curve in enumerate(self.curves):
            motion = curve.harmonic(self.location)
            out |= {f"curve{i}_frequency": curve.frequency, f"curve{i}_amplitude": np.abs(motion), f"curve{i}_phase": np.angle(motion),
                    f"curve{i}_largest": curve.largest(self.location), f"curve{i}_stable": curve.stable}
            if curve.multiplier is not None:
                out[f"curve{i}_multiplier"] = curve.multiplier
        return out


def response_bands(draws: ArrayLike | Drawable, model: Model, *, drive: str, at: str, levels: ArrayLike, band: tuple[float, float],
                   samples: int = 100, seed: int = 0, harmonics: int | None = None, executor: str | Executor = "local", workers: int = 1,
                   progress: Callable[[float, str], None] | None = None) -> ResponseBands:
    """Stepped-sine response curves of every sample at every level, as bands.

    Parameters
    ----------
    draws : array_like (S, P) or object with ``draws(count, seed)``
        Samples of theta, or a posterior to draw ``samples`` of them from.
    model : Model
    drive, at : str
        Locations of the force and of the response.
    levels : array_like (F,)
        N.
    band : (low, high)
        Hz.
    samples, seed : int
        Used with a posterior only.
    harmonics : int or None
        The highest; None: from 7 upwards until more of them do not move the peaks by 0.2 %.
    executor, workers
        As in ``executors.run_tasks``; results do not depend on them.
    progress : callable or None

    Returns
    -------
    ResponseBands

    Raises
    ------
    ValueError
        As ``response_curves``.
    """
    theta = np.atleast_2d(draws.draws(samples, seed) if isinstance(draws, Drawable) else np.asarray(draws, dtype=float))
    level = np.atleast_1d(np.asarray(levels, dtype=float))
    told = progress if progress is not None else _silent
    told(0.0, "number of harmonics")
    common: dict[str, Any] = {"drive": drive, "at": at, "levels": level, "band": band}
    highest, error, middle = _enough_harmonics(model, np.median(theta, axis=0), harmonics, common)
    grid = _grid(middle, band)
    parts = [theta[i:i + CHUNK] for i in range(0, len(theta), CHUNK)]
    shared = (model, {**common, "harmonics": highest}, grid)
    found: dict[int, Any] = {}
    for number, answer in run_tasks(_chunk, shared, parts, executor=executor, workers=workers):
        found[number] = answer
        told(0.1 + 0.85 * len(found) / len(parts), f"response curves of {min(CHUNK * len(found), len(theta))} of {len(theta)} samples")
    up, down, peak, ended, lost = (np.concatenate([found[i][k] for i in range(len(parts))]) for k in range(5))
    ok = ended == "ok"
    up, down, peak = (np.where(ok[..., None], values, np.nan) for values in (up, down, peak))
    bands = [np.stack([quantiles(values[:, i], ok[:, i]) for i in range(len(level))], axis=1) for values in (up, down)]
    nearest = _middle(peak, ok)
    shown = response_curves(model, theta[nearest], **common, harmonics=highest)[0]
    judged_by = "multipliers" if has_multipliers(model) else "turning points"
    return ResponseBands(level, grid, bands[0], bands[1], up, down, peak[..., 0], peak[..., 1], tuple(shown), _counts(ended),
                         _counts(lost[lost != ""]), judged_by, highest, error, drive, at)


def _silent(share: float, sentence: str) -> None:
    """No progress."""


def _counts(names: NDArray[np.str_]) -> dict[str, int]:
    return {str(name): int((names == name).sum()) for name in np.unique(names)}


def _chunk(shared: tuple[Model, dict[str, Any], Array], theta: Array) -> tuple[NDArray[Any], ...]:
    """Swept responses (s, F, K) up and down, peaks (s, F, 2), endings and losses of stability (s, F) of some samples."""
    model, options, grid = shared
    every = response_curves(model, theta, **options)
    at, shape = options["at"], (len(theta), len(options["levels"]))
    up, down, peak = np.full((*shape, len(grid)), np.nan), np.full((*shape, len(grid)), np.nan), np.full((*shape, 2), np.nan)
    ended = np.array([[_kind(curve.status) for curve in curves] for curves in every], dtype="<U96").reshape(shape)
    lost = np.array([[curve.lost if curve.status == "ok" else "" for curve in curves] for curves in every], dtype="<U32").reshape(shape)
    for s, curves in enumerate(every):
        for f, curve in enumerate(curves):
            if curve.status == "ok":
                up[s, f], down[s, f] = curve.swept(at, grid), curve.swept(at, grid, down=True)
                peak[s, f] = curve.peak(at)
                if not curve.peak_stands(at):
                    ended[s, f] = f"the motion at the peak is not stable: {curve.lost or 'it lies beyond a turning point'}"
    return up, down, peak, ended, lost


def _kind(status: str) -> str:
    """An ending without its frequency, so that endings can be counted."""
    return status.rpartition(" at ")[0] if status.endswith(" Hz") else status


def _enough_harmonics(model: Model, theta: Array, given: int | None, common: dict[str, Any]) -> tuple[int, Array, list[Curve]]:
    """The number of harmonics, what more of them would change (F,), and the curves of theta (P,) with the most."""
    def curves(highest: int) -> list[Curve]:
        return response_curves(model, theta, **common, harmonics=highest, stability=False)[0]

    highest = given if given is not None else HARMONICS
    few = curves(highest)
    while True:
        many = curves(2 * highest + 1)
        error = np.array([_moved(a, b, common["at"]) for a, b in zip(few, many, strict=True)])
        if given is not None or not (error > AGREEMENT).any() or 2 * highest + 1 > MOST_HARMONICS:
            return highest, error, many
        highest, few = 2 * highest + 1, many


def _moved(one: Curve, other: Curve, at: str) -> float:
    """Relative difference of two peaks; NaN where a curve failed."""
    if one.status != "ok" or other.status != "ok":
        return float("nan")
    a, b = np.array(one.peak(at)), np.array(other.peak(at))
    return float(np.abs(a / b - 1).max())


def _grid(curves: list[Curve], band: tuple[float, float]) -> Array:
    """Frequencies (K,) spread evenly and, in addition, as dense as the points of the curves."""
    points = np.concatenate([np.linspace(*band, EVEN_POINTS), *(c.frequency for c in curves)])
    inside = np.unique(points[(points >= band[0]) & (points <= band[1])])
    apart = np.concatenate([[True], np.diff(inside) > 1e-9 * band[1]])
    grid = inside[apart]
    return grid[np.unique(np.linspace(0, len(grid) - 1, min(len(grid), MOST_GRID)).astype(int))]


def _middle(peak: Array, ok: NDArray[np.bool_]) -> int:
    """Sample whose peaks (S, F, 2) lie nearest to the median."""
    usable = np.where(ok[..., None], peak, np.nan).reshape(len(peak), -1)
    seen = np.isfinite(usable).any(axis=0)
    if not seen.any():
        return 0
    values = usable[:, seen]
    spread = np.nanstd(values, axis=0) + 1e-12 * np.nanmax(np.abs(values), axis=0) + 1e-300
    distance = np.abs(values - np.nanmedian(values, axis=0)) / spread
    whole = np.isfinite(values).all(axis=1)
    return int(np.argmin(np.where(whole, np.nan_to_num(distance, nan=np.inf).mean(axis=1), np.inf)))
