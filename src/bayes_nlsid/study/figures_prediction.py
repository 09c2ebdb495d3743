"""Figures of what the identified model predicts: joint loops, backbones, records kept for judging."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.axes import engineering, prefixed, unit_sign
from bayes_nlsid.study.figures import BLUE, CYCLE, GREEN, GREY, ORANGE, RED, WIDTH, canvas, draw_signal, envelope, fitted, legend_below

Array = NDArray[np.float64]
BAND = "5–95 %"


def joint_loops(loops: Sequence[Mapping[str, object]]) -> Figure:
    """Joint force against relative motion, with the spread of the posterior.

    Parameters
    ----------
    loops : sequence of dict
        ``location``, ``term``, ``q`` (n,) m, ``force`` (S, n) N, ``unit`` of q.
    """
    columns = min(3, max(1, len(loops)))
    rows = max(1, -(-len(loops) // columns))
    figure, grid = canvas(rows, columns, height=0.5 + 2.65 * rows)
    spent = [_energy(loop) for loop in loops]
    common = prefixed([values[1] for values in spent], "J")
    for i, axes in enumerate(grid.ravel()):
        if i >= len(loops):
            axes.set_axis_off()
            continue
        q, force = np.asarray(loops[i]["q"], dtype=float), np.asarray(loops[i]["force"], dtype=float)
        fq, uq = prefixed(q, str(loops[i].get("unit", "m")))
        ff, uf = prefixed(np.quantile(np.abs(force), 0.99), "N")
        for k in range(min(len(force), 40)):
            axes.plot(fq * q, ff * force[k], color=BLUE, alpha=0.10, linewidth=0.8)
        axes.plot(fq * q, ff * np.median(force, axis=0), color=BLUE, linewidth=1.4, label="median")
        axes.plot([], [], color=BLUE, alpha=0.3, label="single posterior draws")
        lost = "no energy lost"
        if spent[i][2] >= 1e-6 * float(np.abs(force).max() * np.abs(q).max()) > 0.0:
            lost = _spent(spent[i], *common)
        title = fitted(f"{loops[i]['location']}, {loops[i].get('term', '')}\n{lost}".replace(", \n", "\n"), WIDTH / columns - 0.75, 8)
        axes.set_title(title, fontsize=8)
        axes.set(xlabel=f"relative displacement ({uq})", ylabel=f"force beyond the linear model ({uf})" if i % columns == 0 else f"({uf})")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2)
    return figure


def _energy(loop: Mapping[str, object]) -> Array:
    """Energy lost over the cycle, J: its 5, 50 and 95 % quantiles over the draws (trapezoidal rule round the closed loop)."""
    q, force = np.asarray(loop["q"], dtype=float), np.asarray(loop["force"], dtype=float)
    energy = np.abs(np.sum(0.5 * (force + np.roll(force, -1, axis=1)) * (np.roll(q, -1) - q), axis=1))
    return np.asarray(np.quantile(energy, [0.05, 0.5, 0.95]))


def _spent(energy: Array, factor: float, unit: str) -> str:
    """Energy in words, in the unit of the joint that loses most, so that joints compare; in its own unit if that is far too large."""
    if factor * energy[0] < 0.01:
        factor, unit = prefixed(energy[1], "J")
    low, middle, high = (engineering(factor * value) for value in energy)
    return f"energy per cycle {middle} {unit}\n(90 %: {low}–{high} {unit})"


def backbone_bands(bands: Mapping[str, Array], measured: Mapping[str, Array] | None = None, *, location: str = "",
                   alternatives: Sequence[Mapping[str, object]] = (), published: Sequence[Mapping[str, object]] = (),
                   numerical: Array | None = None) -> Figure:
    """Frequency and damping against amplitude: posterior bands over the backbone measured directly.

    Parameters
    ----------
    bands : dict
        ``amplitude`` (K,) m, ``frequency_q05/q50/q95`` (K,) Hz, ``damping_q05/q50/q95`` (K,) ratio.
    measured : dict, optional
        ``amplitude``, ``frequency``, ``damping`` (K2,).
    alternatives : sequence of dict
        ``name``, ``amplitude``, ``frequency``, ``damping`` of rival models (point estimates).
    published : sequence of dict
        ``label`` and spans ``frequency`` (Hz), ``damping`` (ratio), either may be None.
    numerical : ndarray (K,), optional
        The integrator's own error of frequency, Hz.
    """
    figure, grid = canvas(1, 2, height=3.3)
    left, right = grid[0]
    everything = [bands["amplitude"], *([measured["amplitude"]] if measured else [])]
    fa, ua = prefixed(np.nanmax(np.concatenate(everything)), "m")
    for axes, key, factor in ((left, "frequency", 1.0), (right, "damping", 100.0)):
        low, high = factor * bands[f"{key}_q05"], factor * bands[f"{key}_q95"]
        spread = not np.array_equal(low, high, equal_nan=True)
        if spread:
            axes.fill_between(fa * bands["amplitude"], low, high, color=BLUE, alpha=0.28, linewidth=0, label=f"model, {BAND}")
        axes.plot(fa * bands["amplitude"], factor * bands[f"{key}_q50"], color=BLUE, label="model, median" if spread else "model, best fit")
        for k, rival in enumerate(alternatives):
            axes.plot(fa * np.asarray(rival["amplitude"]), factor * np.asarray(rival[key]), linestyle=("--", ":", "-.")[k % 3],
                      color=(GREEN, ORANGE, GREY)[k % 3], label=f"{rival['name']} (fit)")
        if measured is not None:
            axes.plot(fa * measured["amplitude"], factor * measured[key], "o", color=RED, markersize=3.4, mfc="white",
                      label="measured directly")
        for k, span in enumerate(published):
            limits = span.get(key)
            if limits is not None:
                low, high = np.asarray(limits, dtype=float)
                axes.axhspan(factor * low, factor * high, color=CYCLE[(k + 2) % len(CYCLE)], alpha=0.10, linewidth=0,
                             label=str(span["label"]))
        axes.set_xscale("log")
        axes.set_xlabel(f"amplitude at {location} ({ua})" if location else f"amplitude ({ua})")
    start, stop = compared(bands, measured)
    shown = bands["amplitude"] >= start
    for axes, key, factor in ((left, "frequency", 1.0), (right, "damping", 100.0)):
        model = [factor * bands[f"{key}_{level}"][shown] for level in ("q05", "q50", "q95")]
        _limit(axes, [*model, *([factor * measured[key]] if measured else [])], zero=axes is right)
        if stop > start > 0.0:
            axes.set_xlim(fa * start / 1.12, fa * stop * 1.12)
    left.set_ylabel("frequency (Hz)")
    right.set_ylabel("damping (% of critical)")
    if numerical is not None and np.isfinite(numerical).any():
        left.set_title(f"integrator's own error ≤ {engineering(float(np.nanmax(np.abs(numerical))), 'Hz', 2)}", fontsize=8, color=GREY)
    handles, labels = left.get_legend_handles_labels()
    extra = [(h, n) for h, n in zip(*right.get_legend_handles_labels(), strict=True) if n not in labels]
    legend_below(figure, handles + [h for h, _ in extra], labels + [n for _, n in extra])
    return figure


def compared(bands: Mapping[str, Array], measured: Mapping[str, Array] | None = None) -> tuple[float, float]:
    """Amplitudes (m) from the smallest worth showing to the largest: from the measured points where there are any, else the model's."""
    model = bands["amplitude"][np.isfinite(bands["frequency_q50"]) | np.isfinite(bands["damping_q50"])]
    seen = np.zeros(0) if measured is None else measured["amplitude"][np.isfinite(measured["amplitude"])]
    pooled = np.concatenate([model, seen])
    if not pooled.size:
        return 0.0, 0.0
    return float(seen.min() if seen.size else model.min()), float(pooled.max())


def _limit(axes: Axes, values: Sequence[Array], zero: bool = False) -> None:
    """Let the model and the measurement set the range, not a rival that runs away."""
    pooled = np.concatenate([np.ravel(v) for v in values])
    pooled = pooled[np.isfinite(pooled)]
    if pooled.size:
        low, high = float(pooled.min()), float(pooled.max())
        margin = 0.25 * (high - low) or 0.01 * abs(high) or 1.0
        axes.set_ylim(max(0.0, low - margin) if zero else low - margin, high + margin)


def heldout_overlay(time: Array, measured: Array, low: Array, middle: Array, high: Array, *, unit: str, channel: str, zoom: float,
                    noise: float = 0.0, facts: str = "") -> Figure:
    """A record kept for judging: measured against predicted, whole and at three moments, with the residual.

    Parameters
    ----------
    time, measured, low, middle, high : ndarray (n,)
        ``low`` and ``high`` bound the 90 % predictive band.
    unit, channel : str
    zoom : float
        Length of each close-up, s.
    noise : float
        Standard deviation of the sensor's noise.
    facts : str
        One line of numbers for the title.
    """
    figure = _blank(4.8)
    grid = figure.add_gridspec(3, 3, height_ratios=(1, 1.25, 0.75))
    factor, sign = prefixed(measured, unit)
    sign = sign or unit_sign(unit)
    whole, error = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[2, :])
    draw_signal(whole, time, factor * measured, color=GREY, label="measured")
    stretches = int((time[-1] - time[0]) / (zoom / 4))  # each spans more than a cycle, so extremes follow the amplitude
    if stretches >= 60:
        t, bottom, top = envelope(time, factor * middle, columns=stretches)
        whole.plot(t, top, color=BLUE, linewidth=1.0, label="predicted (extremes)")
        whole.plot(t, bottom, color=BLUE, linewidth=1.0)
    else:
        whole.plot(time, factor * middle, color=BLUE, linewidth=0.8, label="predicted")
    whole.set(ylabel=sign, xlim=(time[0], time[-1]))
    figure.suptitle(f"{channel}   {facts}", x=0.01, ha="left", fontsize=8.5)
    lines, words = whole.get_legend_handles_labels()
    for k, centre in enumerate(np.array([0.03, 0.35, 0.8]) * (time[-1] - time[0]) + time[0]):
        axes = figure.add_subplot(grid[1, k])
        i, j = np.searchsorted(time, [centre, centre + zoom])
        part = slice(max(0, int(i)), max(int(j), int(i) + 2))
        axes.fill_between(time[part], factor * low[part], factor * high[part], color=BLUE, alpha=0.3, linewidth=0,
                          label=f"predicted, {BAND}")
        axes.plot(time[part], factor * middle[part], color=BLUE, linewidth=1.0, label="median")
        axes.plot(time[part], factor * measured[part], color="black", linewidth=0.9, linestyle="--", label="measured")
        axes.set(xlim=(time[part][0], time[part][-1]), ylabel=sign if k == 0 else None)
        axes.locator_params(axis="x", nbins=4)
        whole.axvspan(time[part][0], time[part][-1], color=ORANGE, alpha=0.35, linewidth=0)
        if k == 0:
            close, names = axes.get_legend_handles_labels()
            lines, words = lines + close[:1] + close[2:], words + names[:1] + [names[2] + " (close-ups)"]
    whole.legend(lines, words, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, columnspacing=1.0)
    draw_signal(error, time, factor * (measured - middle), color=RED)
    if noise > 0:
        error.axhspan(-1.65 * factor * noise, 1.65 * factor * noise, color=GREEN, alpha=0.25, linewidth=0, label="sensor noise, 90 %")
        error.legend(loc="lower right", bbox_to_anchor=(1.0, 0.96), borderaxespad=0.0)
    error.set(xlabel="time (s)", ylabel=f"measured −\npredicted ({sign})", xlim=(time[0], time[-1]))
    return figure


def _blank(height: float) -> Figure:
    """A figure without axes."""
    figure, grid = canvas(height=height)
    figure.delaxes(grid[0][0])
    return figure
