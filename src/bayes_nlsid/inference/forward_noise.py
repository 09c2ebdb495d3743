"""Noise of simulated recordings as it becomes known: white at first, then spectra and unmeasured force from the error that is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.output_error import OutputError
from bayes_nlsid.inference.covariance import Layout, Levels, Noise
from bayes_nlsid.inference.unmeasured import forced_modes, residual_terms, unmeasured_force
from bayes_nlsid.recordings.noise import NoiseFloor

Array = NDArray[np.float64]
KNOTS = 4               # of the spectrum of sensor noise over the band
OUTLIER = 14.0          # power over spectrum beyond which a line is left out as a resonance or hum that the model does not know


@final
@dataclass(frozen=True, eq=False)
class Expansion:
    """Quadratic expansion of the log posterior around an optimum, initial states marginalised.

    Parameters
    ----------
    s : ndarray (P,)
        Sampling coordinates of the optimum.
    states : ndarray (U,)
        Initial states there.
    error : ndarray (N,)
        E there.
    slope : ndarray (N, P + U)
        dE/d(s, states).
    follow : ndarray (U, P)
        How the best initial state moves with s.
    information : ndarray (P, P)
        Of the recordings alone, in s.
    gradient : ndarray (P,)
        Of minus the log-likelihood, in s.
    """

    s: Array
    states: Array = field(repr=False)
    error: Array = field(repr=False)
    slope: Array = field(repr=False)
    follow: Array = field(repr=False)
    information: Array = field(repr=False)
    gradient: Array = field(repr=False)


def plain_noise(error: OutputError, floors: Sequence[NoiseFloor | None]) -> Noise:
    """White noise of one level per channel, or the measured one; residual terms as nuisance."""
    labels = list(dict.fromkeys((c.name, c.location, c.quantity) for run in error.runs for c in run.recording.channels))
    layouts = []
    for i, run in enumerate(error.runs):
        floor = floors[i] if i < len(floors) else None
        channel = np.array([labels.index((c.name, c.location, c.quantity)) for c in run.recording.channels], dtype=np.intp)
        f, s = run.spectrum.frequency, len(channel)
        measured = np.full((len(f), s), np.nan)
        if floor is not None and floor.sure == "measured":
            measured = _smooth(floor, f) * 0.5 * run.recording.fs / run.scale**2
        layouts.append(Layout(f, channel, _hats(f), measured, (), np.zeros((0, len(f), s)), _orthonormal(residual_terms(run)),
                              np.ones(2 * len(f) * s, dtype=bool)))
    return Noise(tuple(layouts), Levels(np.zeros((len(labels), max(x.hats.shape[1] for x in layouts))), np.zeros(0)),
                 tuple(run.spectrum.information for run in error.runs))


def _smooth(floor: NoiseFloor, frequency: Array) -> Array:
    """Measured density (bins, s), averaged over neighbours: a density from few segments is not to be divided by as it stands."""
    inside = (floor.frequency >= 0.7 * frequency[0]) & (floor.frequency <= 1.4 * frequency[-1])
    f, psd = floor.frequency[inside], floor.psd[inside]
    if len(f) < 8:
        return np.maximum(floor.at(frequency), 1e-300)
    width = max(1, len(f) // 12)
    kernel = np.hanning(2 * width + 3)[1:-1]
    padded = np.pad(psd, ((width, width), (0, 0)), mode="reflect" if len(f) > width else "edge")
    smooth = np.stack([np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T], axis=1)
    return np.maximum(np.stack([np.interp(frequency, f, column) for column in smooth.T], axis=1), 1e-300)


def _hats(frequency: Array) -> Array:
    """Hat functions (bins, J) of evenly spaced knots; fewer where there are few frequencies."""
    count = KNOTS if len(frequency) >= 48 else 2 if len(frequency) >= 12 else 1
    if count == 1:
        return np.ones((len(frequency), 1))
    at = np.linspace(frequency[0], frequency[-1], count)
    return np.stack([np.interp(frequency, at, row) for row in np.eye(count)], axis=1)


def _orthonormal(columns: Array) -> Array:
    if not columns.size:
        return columns
    left, values, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return np.asarray(left[:, values > 1e-6 * values[0]])


def rescaled(noise: Noise, error: Array) -> Noise:
    """The same with every channel's level as found in the error: robust, so that a resonance not yet fitted does not set it."""
    knots = np.full(noise.levels.knots.shape, -np.inf)
    for layout, part in zip(noise.layouts, noise.split(error), strict=True):
        power = part.reshape(2, len(layout.frequency), len(layout.channel))
        level = np.log(np.maximum(np.mean(power**2, axis=(0, 1)), 1e-24))
        np.maximum.at(knots, layout.channel, level[:, None])
    layouts = tuple(replace(x, floor=np.full(x.floor.shape, np.nan)) for x in noise.layouts)
    return Noise(layouts, Levels(knots, noise.levels.sources), noise.information)


def full_noise(error: OutputError, at: Expansion, theta: Array, plain: Noise) -> Noise:
    """Sensor noise started from the quiet lines of the error, and unmeasured force on every mode in the band."""
    modes = forced_modes(error)
    found = unmeasured_force(error, theta, at.states, modes)
    layouts = tuple(replace(layout, columns=u.columns, spill=u.spill) for layout, u in zip(plain.layouts, found, strict=True))
    knots = np.full(plain.levels.knots.shape, -np.inf)
    for layout, part in zip(layouts, plain.split(at.error), strict=True):
        power = np.mean(part.reshape(2, len(layout.frequency), len(layout.channel)) ** 2, axis=0)
        for j, hat in enumerate(layout.hats.T):
            some = power[hat >= 0.5 * hat.max()]
            level = np.log(np.maximum(np.median(some, axis=0) / 0.69, 1e-24))
            np.maximum.at(knots[:, j], layout.channel, level)
        knots[:, layout.hats.shape[1]:] = np.where(np.isfinite(knots[:, layout.hats.shape[1]:]), knots[:, layout.hats.shape[1]:], 0.0)
    sources = []
    for k in range(len(modes)):
        ratio = [1e-300]
        for layout, part in zip(layouts, plain.split(at.error), strict=True):
            if layout.columns[k].size:
                ratio.append(float(np.sum((layout.columns[k].T @ part) ** 2)
                                   / max(np.sum((layout.columns[k].T @ layout.columns[k]) ** 2), 1e-300)))
        sources.append(np.log(0.3 * max(ratio)) if max(ratio) > 1e-300 else -20.0)
    return Noise(layouts, Levels(knots, np.array(sources)), plain.information)


def with_states(noise: Noise, error: OutputError, at: Expansion) -> Noise:
    """Residual terms and initial states as nuisance directions."""
    count = len(at.s)
    layouts = []
    for layout, run, columns in zip(noise.layouts, error.runs, noise.split(at.slope[:, count:].T), strict=True):
        used = columns[np.linalg.norm(columns, axis=1) > 0].T
        layouts.append(replace(layout, nuisance=_orthonormal(np.concatenate([residual_terms(run), used], axis=1))))
    return replace(noise, layouts=tuple(layouts))


def without_states(noise: Noise, error: OutputError) -> Noise:
    """Residual terms alone as nuisance, for a search in which initial states are unknowns of their own."""
    return replace(noise, layouts=tuple(replace(layout, nuisance=_orthonormal(residual_terms(run)))
                                        for layout, run in zip(noise.layouts, error.runs, strict=True)))


def without_outliers(error: OutputError, noise: Noise, at: Expansion) -> tuple[Noise, tuple[str, ...]]:
    """Leave out lines far above the spectrum away from the resonances of the model, three to each side, and say which."""
    layouts, words = [], []
    for run, layout, part in zip(error.runs, noise.layouts, noise.split(at.error), strict=True):
        bins, s = len(layout.frequency), len(layout.channel)
        power = np.mean(part.reshape(2, bins, s) ** 2, axis=0)
        near = np.zeros(bins, dtype=bool)
        for u in layout.spill:
            near |= u.sum(axis=1) == 0
        out = (power > OUTLIER * layout.diagonal(noise.levels).reshape(2, bins, s)[0]) & ~near[:, None]
        for i, channel in enumerate(run.recording.channels):
            if out[:, i].any():
                lines = layout.frequency[out[:, i]]
                words.append(f"{run.recording.name}, {channel.name}: {len(lines)} lines between {lines[0]:.4g} and {lines[-1]:.4g} Hz "
                             "stand far above the noise and away from the modes of the model; they were left out")
                out[:, i] = np.convolve(out[:, i], np.ones(7), "same") > 0
        out &= ~near[:, None]
        keep = layout.keep & ~np.concatenate([out, out]).ravel()
        layouts.append(replace(layout, keep=keep) if keep.mean() > 0.5 else layout)
    changed = replace(noise, layouts=tuple(layouts))
    return (changed.estimated(at.error), tuple(words)) if words else (noise, ())
