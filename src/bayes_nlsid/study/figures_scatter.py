"""Figures of Monte Carlo runs: band, histograms, shares of the variance, tornado, convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.axes import axis_label, brief_names, engineering, prefixed, scaled
from bayes_nlsid.study.figures import BLUE, CYCLE, GREEN, GREY, ORANGE, WIDTH, canvas, fitted, legend_below

Array = NDArray[np.float64]
MOST_LINES = 60
MOST_PARAMETERS = 12
LABELS = {"frequency": ("frequency (Hz)", 1.0), "damping": ("damping (% of critical)", 100.0)}


def band(arrays: Mapping[str, Array], summary: Mapping[str, Any]) -> Figure:
    """Frequency and damping of the samples against amplitude."""
    figure, grid = canvas(1, 2, height=3.2)
    factor, unit = prefixed(arrays["amplitude"], "m")
    for axes, (name, (label, scale)) in zip(grid[0], LABELS.items(), strict=True):
        x = factor * arrays["amplitude"]
        # points of a Sobol sequence have patterns, so that every k-th would be a biased choice
        chosen = np.random.default_rng(0).permutation(len(arrays[f"samples_{name}"]))[:MOST_LINES]
        lines = arrays[f"samples_{name}"][chosen]
        axes.plot(x, scale * lines.T, color=GREY, alpha=0.25, linewidth=0.5)
        axes.fill_between(x, scale * arrays[f"{name}_q05"], scale * arrays[f"{name}_q95"], color=BLUE, alpha=0.3, linewidth=0,
                          label="5–95 %")
        axes.plot(x, scale * arrays[f"{name}_q50"], color=BLUE, label="median")
        axes.set(xscale="log", xlabel=f"amplitude at {summary['at']} ({unit})", ylabel=label)
    error = summary["numerical"]["frequency_hz"]
    if error is not None:
        grid[0][0].set_title(f"error of the computation ≤ {error:.1g} Hz", fontsize=8, color=GREY)
    legend_below(figure, *grid[0][0].get_legend_handles_labels())
    return figure


def parameters(theta: Array, names: Sequence[str], units: Sequence[str]) -> Figure:
    """Histograms of what was sampled (paper's Fig. 8a)."""
    shown = min(len(names), MOST_PARAMETERS)
    columns = min(3, shown)
    rows = -(-shown // columns)
    figure, grid = canvas(rows, columns, height=0.4 + 1.75 * rows)
    short = brief_names(list(names))
    for i, axes in enumerate(grid.ravel()):
        if i >= shown:
            axes.set_axis_off()
            continue
        factor, unit = scaled(theta[:, i], units[i])
        axes.hist(factor * theta[:, i], bins=min(40, max(8, len(theta) // 20)), color=BLUE, alpha=0.6)
        for value in factor * np.quantile(theta[:, i], (0.05, 0.5, 0.95)):
            axes.axvline(value, color=ORANGE, linewidth=1.0)
        axes.set_title(fitted(short[i], WIDTH / columns - 0.4, 8), fontsize=8)
        axes.set(xlabel=axis_label("", unit).strip() if unit else "", yticks=[])
        axes.locator_params(axis="x", nbins=4)
    return figure


def shares(arrays: Mapping[str, Array], names: Sequence[str]) -> Figure:
    """First-order and total share of the variance along the amplitude, for frequency and damping."""
    figure, grid = canvas(2, 2, height=4.8, sharex=True, sharey=True)
    factor, unit = prefixed(arrays["index_amplitude"], "m")
    x, short = factor * arrays["index_amplitude"], brief_names(list(names))
    weight = np.nansum([np.nan_to_num(arrays[f"total_{name}"]).sum(axis=1) for name in LABELS], axis=0)
    order = np.argsort(-weight, kind="stable")[:len(CYCLE)]
    for row, kind in enumerate(("first", "total")):
        for column, name in enumerate(LABELS):
            axes = grid[row][column]
            for n, j in enumerate(order):
                low, high = arrays[f"{kind}_low_{name}"][j], arrays[f"{kind}_high_{name}"][j]
                axes.fill_between(x, 100 * low, 100 * high, color=CYCLE[n], alpha=0.2, linewidth=0)
                axes.plot(x, 100 * arrays[f"{kind}_{name}"][j], marker="os^Dvx"[n], markersize=3, color=CYCLE[n], label=short[j])
            axes.set(xscale="log", ylim=(-5, 118))
            if row == 0:
                axes.set_title(f"scatter of {name}", fontsize=9)
            else:
                axes.set_xlabel(f"amplitude ({unit})")
        grid[row][0].set_ylabel(f"{'first-order' if row == 0 else 'total'} share (%)")
    legend_below(figure, *grid[0][0].get_legend_handles_labels())
    return figure


def tornado(arrays: Mapping[str, Array], names: Sequence[str]) -> Figure:
    """Swing of every parameter from its 5 % to its 95 % point, the largest on top."""
    short = brief_names(list(names))
    count = min(len(names), MOST_PARAMETERS)
    figure, grid = canvas(1, 2, height=1.2 + 0.27 * count)
    for axes, (name, (label, scale)) in zip(grid[0], LABELS.items(), strict=True):
        middle, ends = scale * arrays[f"middle_{name}"], scale * arrays[f"tornado_{name}"]
        seen = np.flatnonzero(np.isfinite(middle) & np.isfinite(ends).all(axis=(0, 1)))
        if not seen.size:
            axes.set_axis_off()
            continue
        k = int(seen[-1])
        order = np.argsort(-np.abs(ends[:, 1, k] - ends[:, 0, k]), kind="stable")[:count]
        for place, j in enumerate(order):
            for end, color, word in ((0, GREEN, "at its 5 % point"), (1, ORANGE, "at its 95 % point")):
                axes.barh(-place, ends[j, end, k] - middle[k], left=middle[k], color=color, height=0.7, label=word if place == 0 else None)
        axes.axvline(middle[k], color=GREY, linewidth=0.8)
        axes.set_yticks(-np.arange(len(order)), [fitted(short[j], WIDTH / 2 - 2.0, 7.5) for j in order], fontsize=7.5)
        axes.set(xlabel=label)
        axes.locator_params(axis="x", nbins=4)
        axes.set_title(f"at {engineering(float(arrays['amplitude'][k]), 'm')}", fontsize=8, color=GREY)
        axes.grid(visible=False, axis="y")
    legend_below(figure, *grid[0][0].get_legend_handles_labels())
    return figure


def settling(arrays: Mapping[str, Array]) -> Figure:
    """Quantiles at the largest amplitude against the number of samples."""
    figure, grid = canvas(1, 2, height=2.7)
    for axes, (name, (label, scale)) in zip(grid[0], LABELS.items(), strict=True):
        _settle(axes, arrays["convergence_count"], scale * arrays[f"convergence_{name}"])
        axes.set(xlabel="samples", ylabel=label)
    legend_below(figure, *grid[0][0].get_legend_handles_labels())
    return figure


def _settle(axes: Axes, counts: Array, bands: Array) -> None:
    seen = np.flatnonzero(np.isfinite(bands[-1]).all(axis=0))
    if not seen.size:
        return
    at = bands[:, :, int(seen[-1])]
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(n) for n in counts], rotation=45)
    axes.set_xticks([], minor=True)
    axes.fill_between(counts, at[:, 0], at[:, 2], color=BLUE, alpha=0.2, linewidth=0)
    for row, word, style in ((0, "5 %", "--"), (1, "median", "-"), (2, "95 %", "--")):
        axes.plot(counts, at[:, row], color=BLUE, linestyle=style, marker="o", markersize=3, label=word)
