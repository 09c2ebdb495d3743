"""Figures of stepped-sine responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.axes import engineering, prefixed, unit_sign
from bayes_nlsid.study.figures import CYCLE, GREY, canvas, legend_below

Array = NDArray[np.float64]
MOST_LEVELS = 6
TAIL = 0.06  # of the largest response: beyond that the band is not worth showing


def response_curves(arrays: Mapping[str, Array], summary: Mapping[str, Any]) -> Figure:
    """Response per force against frequency for every level, and the peak against the level.

    Parameters
    ----------
    arrays : dict
        Those of ``frf.npz``.
    summary : dict
        ``peaks`` and ``output`` of the stage.
    """
    figure, grid = canvas(1, 2, height=3.5, width_ratios=(1.75, 1))
    left, right = grid[0]
    level = arrays["level"]
    shown = np.unique(np.linspace(0, len(level) - 1, min(len(level), MOST_LEVELS)).round().astype(int))
    seen = np.concatenate([arrays[f"{way}_q50"][shown] / level[shown, None] for way in ("up", "down")])
    factor, unit = prefixed(np.nanmax(seen), "m") if np.isfinite(seen).any() else (1.0, "m")
    for n, i in enumerate(shown):
        color = CYCLE[n % len(CYCLE)]
        for way in ("up", "down"):
            low, high = (factor * arrays[f"{way}_{q}"][i] / level[i] for q in ("q05", "q95"))
            if not np.array_equal(low, high, equal_nan=True):
                left.fill_between(arrays["frequency"], low, high, color=color, alpha=0.22, linewidth=0)
        frequency, curve = arrays[f"curve{i}_frequency"], factor * arrays[f"curve{i}_amplitude"] / level[i]
        left.plot(frequency, curve, color=color, linewidth=0.8, linestyle=(0, (1, 1.6)))
        left.plot(frequency, np.where(arrays[f"curve{i}_stable"], curve, np.nan), color=color, linewidth=1.1,
                  label=engineering(float(level[i]), "N"))
    left.set(xlabel="frequency (Hz)", ylabel=f"displacement at {summary['output']} per force ({unit}/N)", ylim=(0, None))
    _zoom(left, arrays, shown)
    for n, i in enumerate(shown):
        peak = summary["peaks"][i]
        if not np.isfinite(peak["frequency_q50"]):
            continue
        x, y = peak["frequency_q50"], factor * peak["amplitude_q50"] / level[i]
        width = [[x - peak["frequency_q05"]], [peak["frequency_q95"] - x]]
        height = [[y - factor * peak["amplitude_q05"] / level[i]], [factor * peak["amplitude_q95"] / level[i] - y]]
        right.errorbar(x, y, xerr=np.maximum(width, 0), yerr=np.maximum(height, 0), fmt="o", color=CYCLE[n % len(CYCLE)], markersize=4,
                       linewidth=1.2, capsize=2)
    path = [(p["frequency_q50"], factor * p["amplitude_q50"] / p["level"]) for p in summary["peaks"] if np.isfinite(p["frequency_q50"])]
    if path:
        right.plot(*np.array(path).T, color=GREY, linewidth=0.8, zorder=0)
    right.set(xlabel="frequency of the peak (Hz)", ylabel=f"peak per force ({unit_sign(unit)}/N)")
    right.locator_params(axis="x", nbins=4)
    right.set_title("peaks, 5–95 %", fontsize=8, color=GREY)
    legend_below(figure, *left.get_legend_handles_labels())
    return figure


def _zoom(axes: Axes, arrays: Mapping[str, Array], shown: NDArray[np.intp]) -> None:
    """Only the frequencies at which some level responds noticeably."""
    worth = np.zeros(len(arrays["frequency"]), dtype=bool)
    for way in ("up", "down"):
        values = np.nan_to_num(arrays[f"{way}_q95"][shown])
        worth |= (values > TAIL * values.max(axis=1, keepdims=True)).any(axis=0)
    f = arrays["frequency"][worth]
    if f.size > 1:
        margin = 0.05 * (f[-1] - f[0])
        axes.set_xlim(max(arrays["frequency"][0], f[0] - margin), min(arrays["frequency"][-1], f[-1] + margin))
