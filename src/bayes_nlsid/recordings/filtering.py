"""The one band-pass of this room, and what to do at the ends of a signal that is not periodic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

LOWER_SKIRT = 0.5   # the filter reaches zero at this fraction of the lower band edge
UPPER_SKIRT = 1.25  # and at this multiple of the upper one, or at the Nyquist frequency
KERNEL_REACH = 8.0  # over the width (Hz) of the lower skirt: seconds after which the filter has forgotten
EDGE_TOLERANCE = 1e-3  # relative error that the unknown continuation of a transient may leave in samples called valid


def skirts(band: tuple[float, float], rate: float) -> tuple[float, float]:
    """Frequencies (Hz) at which the filter for ``band`` reaches zero, for samples at ``rate`` (Hz)."""
    return LOWER_SKIRT * band[0], min(UPPER_SKIRT * band[1], rate / 2)


def reach(band: tuple[float, float], dt: float) -> int:
    """Samples after which the filter has forgotten."""
    return round(KERNEL_REACH / ((1 - LOWER_SKIRT) * band[0] * dt))


def band_pass(frequency: ArrayLike, band: tuple[float, float], stop: tuple[float, float]) -> NDArray[np.float64]:
    """Gain of a filter that is one inside ``band``, zero outside ``stop``, and infinitely smooth between.

    Parameters
    ----------
    frequency : array_like
        Hz, any shape.
    band, stop : tuple of float
        (low, high) Hz with stop[0] ≤ band[0] < band[1] ≤ stop[1].

    Returns
    -------
    ndarray
        Same shape, 0 to 1.
    """
    f = np.abs(np.asarray(frequency, dtype=float))
    lower = smooth_step(f, stop[0], band[0]) if stop[0] < band[0] else f >= band[0]
    upper = 1 - smooth_step(f, band[1], stop[1]) if band[1] < stop[1] else f <= band[1] * (1 + 1e-12)
    return np.asarray(lower * upper, dtype=float)


def smooth_step(f: NDArray[np.float64], start: float, end: float) -> NDArray[np.float64]:
    """Smooth step of all orders from 0 at ``start`` to 1 at ``end``: 1 / (1 + exp(1/x − 1/(1−x)))."""
    x = np.clip((f - start) / (end - start), 1e-9, 1 - 1e-9)
    value = 1 / (1 + np.exp(np.clip(1 / x - 1 / (1 - x), -700, 700)))
    return np.where(f <= start, 0.0, np.where(f >= end, 1.0, value))


def agreeing(ones: Sequence[NDArray[np.float64]], others: Sequence[NDArray[np.float64]], floor: Sequence[NDArray[np.float64]],
             most: int) -> slice:
    """The samples where two continuations agree: to `EDGE_TOLERANCE` of the motion near that end, or a third of its noise."""
    n, edges = len(ones[0]), []
    for part in (slice(0, most), slice(n - 1, n - 1 - most, -1)):
        last = 0
        for one, other, noise in zip(ones, others, floor, strict=True):
            allowed = np.maximum(EDGE_TOLERANCE * rms(one[part]), noise / 3)
            beyond = np.flatnonzero((np.abs(one[part] - other[part]) > allowed).any(axis=1))
            last = max(last, int(beyond[-1]) + 1 if beyond.size else 0)
        edges.append(last)
    return slice(edges[0], n - edges[1])


def without_line(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without its straight line, which lies below any band and would only be spread by the ends."""
    t = np.linspace(-1, 1, len(x))
    return np.asarray(x - x.mean(axis=0) - np.outer(t, t @ x / (t @ t)), dtype=float)


def extended(x: NDArray[np.float64], before: int, after: int, odd: bool) -> NDArray[np.float64]:
    """Continued on both sides by its mirror image, even, or odd about its end points, fading out smoothly."""
    parts = []
    for values, count in ((x, before), (x[::-1], after)):
        used = min(count, len(x) - 1)
        mirror = 2 * values[0] - values[1:used + 1] if odd else values[1:used + 1]
        part = np.zeros((count, x.shape[1]))
        part[:used] = mirror * (1 - smooth_step(np.arange(1, used + 1, dtype=float), 0.0, used + 1.0))[:, None]
        parts.append(part)
    return np.concatenate([parts[0][::-1], x, parts[1]])


def rms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square over time."""
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)), dtype=float)
