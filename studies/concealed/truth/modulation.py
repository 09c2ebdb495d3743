"""Time courses of drifting and modulated springs, as functions of the time of day (s)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def draw_modulation(name: str, rng: np.random.Generator, day: float, band: tuple[float, float]) -> Callable[[np.ndarray], np.ndarray]:
    """Dimensionless course ``m(t)`` of order one for a formula name; ``day`` (s) is the length of the campaign.

    The drifts start at zero, so that the first record sees the nominal joint.
    """
    if name == "relaxing":
        tau = day * rng.uniform(0.2, 0.5)
        return lambda t: 1.0 - np.exp(-np.maximum(t, 0.0) / tau)
    if name == "linear_loss":
        return lambda t: np.maximum(t, 0.0) / day
    if name == "step":
        at = day * rng.uniform(0.3, 0.65)
        return lambda t: 0.5 + 0.5 * np.tanh((t - at) / 1.5)
    if name == "warming":
        return lambda t: np.sin(0.5 * np.pi * np.clip(t / day, 0.0, 1.0)) ** 2
    if name == "parametric":
        f1, f2, p1, p2 = rng.uniform(3, 40), rng.uniform(40, 150), *rng.uniform(0, 2 * np.pi, 2)
        return lambda t: np.cos(2 * np.pi * f1 * t + p1) + 0.5 * np.cos(2 * np.pi * f2 * t + p2)
    # telegraph: the contact comes and goes at random times
    count = int(400 + day * 8)
    times = np.cumsum(rng.exponential(0.25, count)) - 20.0
    return lambda t: np.where(np.searchsorted(times, t) % 2 == 0, 1.0, 0.0)
