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
    """The samples where two continuations agree: to `EDGE_TOLERANCE` of the motion near that end, or a third of its noise.

    The motion is that of the strongest channel: one near a node of the only mode in the band has nothing to be relative to.
    """
    n, edges = len(ones[0]), []
    for part in (slice(0, most), slice(n - 1, n - 1 - most, -1)):
        last = 0
        for one, other, noise in zip(ones, others, floor, strict=True):
            allowed = np.maximum(EDGE_TOLERANCE * np.max(rms(one[part]), initial=0.0), noise / 3)
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


def predicted(x: NDArray[np.float64], before: int, after: int, order: int) -> NDArray[np.float64]:
    """Continued on both sides by linear prediction from the samples near each end (Burg 1975), fading out smoothly.

    A sum of lightly damped oscillations is continued almost exactly, which mirror images cannot do; the poles lie inside the unit
    circle, so a continuation never grows.

    Parameters
    ----------
    x : ndarray (n, s)
    before, after : int
        Samples to add.
    order : int
        Of the prediction, below n / 2; four times as many samples serve to estimate it.

    Returns
    -------
    ndarray (before + n + after, s)
    """
    parts = []
    for values, count in ((x[::-1], before), (x, after)):
        fade = 1 - smooth_step(np.arange(1, count + 1, dtype=float), 0.0, count + 1.0)
        tail = values[-4 * order:]
        parts.append(np.column_stack([_prediction(column, count, order) for column in tail.T]) * fade[:, None]
                     if x.shape[1] else np.zeros((count, 0)))
    return np.concatenate([parts[0][::-1], x, parts[1]])


def _prediction(x: NDArray[np.float64], count: int, order: int) -> NDArray[np.float64]:
    """The next ``count`` samples (count,) of one signal by Burg's method."""
    forward, backward, weights = x[1:].copy(), x[:-1].copy(), np.ones(1)
    for _ in range(order):
        energy = forward @ forward + backward @ backward
        if energy <= 1e-28 * (x @ x) or len(forward) < 2:  # perfectly predictable already, or silent
            break
        k = -2 * (forward @ backward) / energy
        weights = np.append(weights, 0.0) + k * np.append(weights, 0.0)[::-1]
        forward, backward = forward[1:] + k * backward[1:], backward[:-1] + k * forward[:-1]
    past = len(weights) - 1
    out = np.concatenate([x[len(x) - past:], np.zeros(count)])
    steps = -weights[:0:-1]
    for i in range(count):
        out[past + i] = steps @ out[i:past + i]
    return out[past:]


def prediction_orders(band: tuple[float, float], dt: float, n: int) -> tuple[int, int] | None:
    """Two orders whose predictions must agree to be believed, long enough for the lower band edge; None if n samples are too few."""
    order = min(round(2 / (band[0] * dt)) if band[0] > 0 else 0, n // 8, 600)
    return (order, round(0.6 * order)) if order >= 8 else None


def continuations(x: NDArray[np.float64], before: int, after: int, band: tuple[float, float], dt: float,
                  ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two independent guesses (before + n + after, s) of what lies beyond the ends; where they differ nothing is known.

    Predictions of two orders where there are samples enough, else the even and the odd mirror image.
    """
    orders = prediction_orders(band, dt, len(x))
    if orders is None:
        return extended(x, before, after, False), extended(x, before, after, True)
    return predicted(x, before, after, orders[0]), predicted(x, before, after, orders[1])


def rms(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square over time."""
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)), dtype=float)
