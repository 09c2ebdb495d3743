"""Figures of the selection, the posterior and the convergence of the sampler."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from bayes_nlsid.study.axes import brief_names, scaled
from bayes_nlsid.study.figures import BLUE, CYCLE, GREEN, GREY, RED, WIDTH, canvas, fitted

Array = NDArray[np.float64]
DECADE = 10.0  # ratio of the 95 % to the 5 % quantile from which an axis is logarithmic


def selection_path(steps: Sequence[Mapping[str, object]], tried: Sequence[Mapping[str, object]], *, floor: float | None,
                   linear: float) -> Figure:
    """The score after each step, and every candidate that was tried for it.

    Parameters
    ----------
    steps : sequence of dict
        ``phase`` ("forward" or "backward"), ``name`` of the term added or removed, ``mse`` after it.
    tried : sequence of dict
        ``step`` (0-based index into ``steps``), ``name``, ``mse``.
    floor : float or None
        Mean square that sensor noise alone would leave.
    linear : float
        Mean square of the linear model.
    """
    figure, grid = canvas(1, 2, height=3.3, width_ratios=(1, 1.15))
    left, right = grid[0]
    scores = [linear, *(float(str(s["mse"])) for s in steps)]
    labels = ["linear", *(("+ " if s["phase"] == "forward" else "− ") + str(s["name"]) for s in steps)]
    at = np.arange(len(scores))
    rng = np.random.default_rng(0)  # spreads overlapping dots sideways; the picture is the same every time
    points = [(int(str(t["step"])) + 1, float(str(t["mse"]))) for t in tried]
    if points:
        x, y = np.array(points, dtype=float).T
        ok = np.isfinite(y) & (y > 0)
        left.plot(x[ok] + rng.uniform(-0.16, 0.16, ok.sum()), y[ok], ".", color=GREY, alpha=0.55, markersize=4,
                  label="every candidate tried")
    for phase, marker, color in (("forward", "o", BLUE), ("backward", "s", RED)):
        chosen = [i + 1 for i, s in enumerate(steps) if s["phase"] == phase]
        if chosen:
            left.plot(chosen, [scores[i] for i in chosen], marker, color=color, label=f"kept, {phase}", markersize=6)
    left.plot(at, scores, "-", color=BLUE, linewidth=1.0)
    left.plot(0, linear, "D", color="black", markersize=5)
    if floor is not None and floor > 0:
        left.axhline(floor, color=GREEN, linestyle="--", linewidth=1.2, label="noise floor")
    left.set_yscale("log")
    left.set(xticks=at, xlabel="step", ylabel="mean square residual (N²/kg)")
    left.set_xticklabels(labels, rotation=30 if len(labels) > 3 else 0, ha="right" if len(labels) > 3 else "center")
    if left.get_legend_handles_labels()[0]:
        left.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, handletextpad=0.3, columnspacing=0.8)
    _first_ranking(right, tried, floor, linear)
    return figure


def _first_ranking(axes: Axes, tried: Sequence[Mapping[str, object]], floor: float | None, linear: float) -> None:
    """The best dozen candidates of the first step."""
    first = sorted((float(str(t["mse"])), str(t["name"])) for t in tried if int(str(t["step"])) == 0
                   and np.isfinite(float(str(t["mse"]))))[:12]
    if not first:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "the form was given,\nnothing to choose from", ha="center", va="center", color=GREY, transform=axes.transAxes)
        return
    at = np.arange(len(first))
    axes.hlines(at, [m for m, _ in first], linear, color="#c9d8e6", linewidth=4)
    axes.plot([m for m, _ in first], at, "o", color=BLUE)
    axes.axvline(linear, color="black", linewidth=0.9)
    axes.annotate("linear model", (linear, 1.0), xycoords=("data", "axes fraction"), ha="right", va="bottom", fontsize=7.5)
    if floor is not None and floor > 0:
        axes.axvline(floor, color=GREEN, linestyle="--", linewidth=1.2)
    axes.set_xscale("log")
    axes.set(yticks=at, yticklabels=[name for _, name in first], ylim=(len(first) - 0.5, -0.7),
             xlabel="mean square residual, first step (N²/kg)")


def posterior_marginals(draws: Array, names: Sequence[str], units: Sequence[str], *, prior: Array | None = None, fit: Array | None = None,
                        identifiable: Sequence[bool] = ()) -> Figure:
    """Histogram of every parameter with its prior, the fit, and the 90 % interval.

    Parameters
    ----------
    draws : ndarray (D, P)
        Physical units.
    names, units : sequence of str, length P
    prior : ndarray (E, P), optional
        Draws from the prior.
    fit : ndarray (P,), optional
    identifiable : sequence of bool, optional
    """
    count = len(names)
    columns = min(4, count)
    rows = -(-count // columns)
    known = [not len(identifiable) or bool(identifiable[i]) for i in range(count)]
    titles = [fitted(name if sure else f"{name}\nnot identifiable", WIDTH / columns - 0.32, 8)
              for name, sure in zip(brief_names(names), known, strict=True)]
    figure, grid = canvas(rows, columns, height=0.6 + (1.6 + 0.13 * max(title.count("\n") for title in titles)) * rows)
    for i, axes in enumerate(grid.ravel()):
        if i >= count:
            axes.set_axis_off()
            continue
        factor, unit = scaled(np.quantile(np.abs(draws[:, i]), [0.5]), units[i])
        values = factor * draws[:, i]
        low, high = np.quantile(values, [0.05, 0.95])
        bins = _bins(values)
        if wide(values):
            axes.set_xscale("log")
        axes.hist(values, bins=bins, weights=np.full(len(values), 1 / len(values)), color=BLUE, alpha=0.75, label="posterior")
        if prior is not None:
            axes.hist(factor * prior[:, i], bins=bins, weights=np.full(len(prior), 1 / len(prior)), histtype="step", color=GREY,
                      linestyle="--", linewidth=1.1, label="prior")
        axes.axvspan(low, high, color=BLUE, alpha=0.10, linewidth=0, label="90 % interval")
        if fit is not None:
            axes.axvline(factor * fit[i], color=RED, linewidth=1.2, label="least squares")
        axes.set_title(titles[i], fontsize=8, color="black" if known[i] else RED)
        axes.set(yticks=[], xlim=(bins[0], bins[-1]), xlabel=unit or "no unit")
        _few_ticks(axes.xaxis, wide(values), 3)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def wide(values: Array) -> bool:
    """Whether draws (D,) spread over a decade of one sign, so that a logarithmic axis shows them better."""
    low, high = np.quantile(values, [0.05, 0.95])
    return bool(values.min() > 0 and high > DECADE * low)


def _bins(values: Array, count: int = 45) -> Array:
    """Edges of a histogram of draws (D,): all but the outermost of them and a margin, equal on the axis that `wide` asks for."""
    edges = np.quantile(np.log(values) if wide(values) else values, [0.001, 0.999])
    margin = 0.05 * max(float(np.ptp(edges)), 1e-12 * float(np.abs(edges).max()) + 1e-300)
    even = np.linspace(edges[0] - margin, edges[1] + margin, count)
    return np.asarray(np.exp(even) if wide(values) else even)


def _few_ticks(axis: Axis, logarithmic: bool, most: int, prune: Literal["both"] | None = None) -> None:
    """At most a few labels on a small axis."""
    if logarithmic:
        axis.set_major_locator(LogLocator(numticks=most + 1))
        axis.set_minor_formatter(NullFormatter())
    else:
        axis.set_major_locator(MaxNLocator(most, prune=prune))


def posterior_pairs(draws: Array, names: Sequence[str], units: Sequence[str], *, worst: Sequence[int], fit: Array | None = None) -> Figure:
    """Pairwise views of the parameters that are known least well.

    Parameters
    ----------
    draws : ndarray (D, P)
    worst : sequence of int
        Which parameters to show, at most five.
    """
    chosen = list(worst)[:5]
    k = len(chosen)
    short = brief_names(names)
    figure, grid = canvas(k, k, height=1.0 + 1.3 * k, sharex="col")
    some = draws[np.linspace(0, len(draws) - 1, min(len(draws), 1500)).astype(int)]
    for i, row in enumerate(chosen):
        for j, column in enumerate(chosen):
            axes = grid[i][j]
            if j > i:
                axes.set_axis_off()
                continue
            fx, ux = scaled(np.quantile(np.abs(draws[:, column]), [0.5]), units[column])
            fy, uy = scaled(np.quantile(np.abs(draws[:, row]), [0.5]), units[row])
            by_log = wide(draws[:, column]), wide(draws[:, row])
            if by_log[0]:
                axes.set_xscale("log")
            if i == j:
                axes.hist(fx * draws[:, row], bins=_bins(fx * draws[:, row]), color=BLUE, alpha=0.75)
                axes.set_yticks([])
            else:
                axes.plot(fx * some[:, column], fy * some[:, row], ".", color=BLUE, markersize=1.6, alpha=0.35, rasterized=True)
                if by_log[1]:
                    axes.set_yscale("log")
                shown = np.stack([np.log(x) if log else x for x, log in zip((draws[:, column], draws[:, row]), by_log, strict=True)])
                correlation = np.corrcoef(shown)[0, 1]
                axes.text(0.96, 0.95, f"ρ = {correlation:+.2f}", transform=axes.transAxes, ha="right", va="top", fontsize=7,
                          bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0})
                if fit is not None:
                    axes.plot(fx * fit[column], fy * fit[row], "+", color=RED, markersize=9, markeredgewidth=1.6)
            _few_ticks(axes.xaxis, by_log[0], 2, prune="both")
            if i != j:
                _few_ticks(axes.yaxis, by_log[1], 3)
            if i == k - 1:
                axes.set_xlabel(fitted(short[column] + (f" ({ux})" if ux else ""), WIDTH / k - 0.45, 7), fontsize=7)
            else:
                axes.tick_params(labelbottom=False)
            if j == 0 and i > 0:
                axes.set_ylabel(fitted(short[row] + (f" ({uy})" if uy else ""), 1.1, 7), fontsize=7)
            elif i != j:
                axes.tick_params(labelleft=False)
    return figure


def convergence(log_probability: Array, chains: Array, names: Sequence[str], units: Sequence[str], *, kept_from: int = 0,
                worst: Sequence[int] = ()) -> Figure:
    """Traces of independent ensembles: log-probability and the slowest parameters.

    Parameters
    ----------
    log_probability : ndarray (M, n, W)
        Ensembles, steps, walkers.
    chains : ndarray (M, n, W, P)
        Physical units.
    kept_from : int
        First step that counts; before it is burn-in.
    worst : sequence of int
        Parameters to show, at most three.
    """
    chosen, short = list(worst)[:3], brief_names(names)
    figure, grid = canvas(1 + len(chosen), 1, height=1.2 + 1.15 * (1 + len(chosen)), sharex=True)
    steps = np.arange(log_probability.shape[1])
    low = np.quantile(log_probability[:, log_probability.shape[1] // 3:], 0.002)
    for m in range(log_probability.shape[0]):
        color, label = CYCLE[m % len(CYCLE)], f"ensemble {m + 1}"
        grid[0][0].plot(steps, np.median(log_probability[m], axis=1), color=color, label=label, linewidth=0.9)
        for row, i in enumerate(chosen):
            factor, unit = scaled(np.quantile(np.abs(chains[..., i]), [0.5]), units[i])
            quantiles = factor * np.quantile(chains[m, :, :, i], [0.05, 0.5, 0.95], axis=1)
            axes = grid[row + 1][0]
            axes.fill_between(steps, quantiles[0], quantiles[2], color=color, alpha=0.15, linewidth=0)
            axes.plot(steps, quantiles[1], color=color, linewidth=0.9)
            axes.set_ylabel(fitted(short[i] + (f" ({unit})" if unit else ""), 1.05, 7.5), fontsize=7.5)
    top = float(log_probability.max())
    grid[0][0].set_ylim(low - 0.1 * (top - low) - 1e-9, top + 0.1 * (top - low) + 1e-9)
    grid[0][0].set_ylabel("log-probability\n(median walker)", fontsize=7.5)
    for axes in grid[:, 0]:
        axes.set_xlim(0, steps[-1])
        if kept_from > 0:
            axes.axvspan(0, kept_from, color="#dddddd", alpha=0.6, linewidth=0)
    if kept_from > 0:
        grid[0][0].annotate("burn-in", (0.5 * kept_from, 0.06), xycoords=("data", "axes fraction"), ha="center", fontsize=7.5)
    grid[0][0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4)
    grid[-1][0].set_xlabel("step (bands: 5–95 % of the walkers)")
    return figure
