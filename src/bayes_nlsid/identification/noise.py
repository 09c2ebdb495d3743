"""Variance of the residual read off the residual itself: a smoothed spectrum per equation and recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.problem import Problem

WIDTH = 12  # bins on each side of the Hann smoother: about 34 degrees of freedom


def smoothed_variance(problem: Problem, residual: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.float64]:
    """Variance (N,) of every entry, from the power of one residual smoothed over neighbouring frequencies.

    Real and imaginary part of a frequency share their power; a Hann window over ``2 width + 1`` frequencies, reflected at the edges of
    the band, smooths it. Equations and recordings are kept apart.

    Raises
    ------
    ValueError
        If ``width`` is negative or the residual has the wrong shape.
    """
    if width < 0 or residual.shape != (problem.size,):
        raise ValueError(f"width {width} must not be negative and residual {residual.shape} must be ({problem.size},)")
    out = np.empty(problem.size)
    for cell in problem.cells:
        half = min(width, cell.bins - 1)
        window = np.hanning(2 * half + 3)[1:-1]
        parts = residual[cell.entries].reshape(2, cell.bins)
        power = np.pad(0.5 * np.sum(parts**2, axis=0), half, mode="reflect") if half else 0.5 * np.sum(parts**2, axis=0)
        out[cell.entries] = np.tile(np.convolve(power, window / window.sum(), "valid"), 2)
    return out


def freedom(width: int = WIDTH) -> float:
    """Degrees of freedom of one smoothed variance, 2 (Σw)²/Σw²."""
    window = np.hanning(2 * width + 3)[1:-1]
    return float(2 * window.sum() ** 2 / np.sum(window**2))
