"""Figures of the effect that was found: a force law along its motion, a force without a law, a drift, a fault of the measuring chain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.axes import scaled, unit_sign
from bayes_nlsid.study.figures import BLUE, GREEN, GREY, ORANGE, RED, SKY, canvas

Array = NDArray[np.float64]
DOTS = 3000          # points of a cloud
CYCLES = 3           # of the motion that are drawn as a line
EDGE = 0.9995        # share of the points that must be in sight
BINS = 25


def force_law(law: Mapping[str, Any], onset: float = 0.0) -> Figure:
    """The force of a law against displacement and velocity at its place, with what the records still ask for beside it.

    Parameters
    ----------
    law : dict
        ``displacement``, ``velocity``, ``force`` (k n,), ``left`` (n,), ``class``, ``place``, ``unit`` (m or rad), ``phase``; for a law
        without memory ``grid``, ``curve``, ``low``, ``high`` (g,): the law over its own coordinate with a 90 % band.
    onset : float
        Displacement from which the law departs from a linear one; 0 if it has none.
    """
    turning = str(law["unit"]) == "rad"
    d, v, g, left = (np.asarray(law[k], dtype=float) for k in ("displacement", "velocity", "force", "left"))
    finer = max(1, len(g) // len(left))
    dots = slice(None, None, finer * max(1, len(left) // DOTS))
    few = left[::max(1, len(left) // DOTS)][:len(g[dots])]
    asked = g[::finer][:len(left)] + left[:len(g[::finer])]
    ff, uf = scaled(np.quantile(np.abs(asked), EDGE), "N m" if turning else "N")
    loop = loudest(d, v, CYCLES)
    figure, grid = canvas(2, 2, height=5.4, height_ratios=(1.6, 1), sharey="row")
    handles: dict[str, Any] = {}
    own = 1 if str(law["phase"]) == "velocity" else 0
    for column, (motion, unit, word) in enumerate(((d, "rad" if turning else "m", "rotation" if turning else "displacement"),
                                                   (v, "rad/s" if turning else "m/s", "velocity"))):
        fm, um = scaled(np.quantile(np.abs(motion), EDGE), unit)
        top, bottom = grid[0][column], grid[1][column]
        handles["law + what is left"] = top.plot(fm * motion[dots], ff * (g[dots] + few), ".", color="#9fb3c4",
                                                                  markersize=1.6, rasterized=True)[0]
        if column == own and "curve" in law:
            x = fm * np.asarray(law["grid"], dtype=float)
            handles["90 % band of the law"] = top.fill_between(x, ff * np.asarray(law["low"]), ff * np.asarray(law["high"]), color=RED,
                                                              alpha=0.25, linewidth=0)
            handles["law"] = top.plot(x, ff * np.asarray(law["curve"]), color=RED, linewidth=1.8)[0]
        elif "curve" in law:
            handles["law at every sample"] = top.plot(fm * motion[dots], ff * g[dots], ".", color=BLUE, markersize=1.6, rasterized=True)[0]
        else:
            handles["law, loudest cycles"] = top.plot(fm * motion[loop], ff * g[loop], color=BLUE, linewidth=1.1)[0]
        if column == 0 and onset > 0:
            for side in (-1, 1):
                handles["onset"] = top.axvline(side * fm * onset, color=GREEN, linewidth=1.0, linestyle=":")
        bottom.plot(fm * motion[dots], ff * few, ".", color="#9fb3c4", markersize=1.6, rasterized=True)
        bottom.set(xlabel=f"{word} at {law['place']} ({um})")
        edge = 0.04 * fm * float(np.ptp(motion))
        for axes in (top, bottom):
            axes.set_xlim(fm * float(motion.min()) - edge, fm * float(motion.max()) + edge)
    reach = 1.1 * ff * max(float(np.quantile(np.abs(asked), EDGE)), float(np.abs(g).max()))
    grid[0][0].set(ylabel=f"{'moment' if turning else 'force'} ({uf})", ylim=(-reach, reach))
    grid[1][0].set(ylabel=f"what is left ({uf})", ylim=(-reach * 0.625, reach * 0.625))
    size, rest = float(np.std(g)), float(np.std(left))
    grid[0][0].set_title(f"{str(law['class']).replace('_', ' ')} at {law['place']}")
    grid[1][0].set_title(f"left: {_rms(ff * rest, uf)} rms, law {_rms(ff * size, uf)} rms", fontsize=8.5)
    figure.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=len(handles), markerscale=4,
                  columnspacing=1.2)
    return figure


def _rms(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}" if value < 99.5 else f"{value:.0f} {unit}"


def loudest(d: Array, v: Array, cycles: int) -> slice:
    """The stretch of so many cycles about the largest displacement."""
    ups = np.flatnonzero((v[:-1] <= 0) & (v[1:] > 0))   # troughs
    at = int(np.argmax(np.abs(d)))
    if len(ups) <= cycles:
        return slice(0, len(d))
    k = int(np.clip(np.searchsorted(ups, at) - (cycles + 1) // 2, 0, len(ups) - cycles - 1))
    return slice(int(ups[k]), int(ups[k + cycles]) + 1)


def latent_forces(latents: Sequence[Mapping[str, object]]) -> Figure:
    """The force that would explain the mismatch at the likeliest places, recovered without a law, against motion there.

    Parameters
    ----------
    latents : sequence of dict
        ``place``, ``force`` (n,) N, ``displacement`` (n,) m, ``velocity`` (n,) m/s.
    """
    columns = max(1, len(latents))
    figure, grid = canvas(2, columns, height=5.0)
    handles: list[Any] = []
    for j, latent in enumerate(latents):
        turning = "rot" in str(latent["place"]).lower()
        force = np.asarray(latent["force"], dtype=float)
        ff, uf = scaled(np.quantile(np.abs(force), EDGE), "N m" if turning else "N")
        for row, (key, unit) in enumerate((("displacement", "rad" if turning else "m"), ("velocity", "rad/s" if turning else "m/s"))):
            motion = np.asarray(latent[key], dtype=float)
            fm, um = scaled(np.quantile(np.abs(motion), EDGE), unit)
            axes = grid[row][j]
            dots = axes.plot(fm * motion, ff * force, ".", color="#9fb3c4", markersize=1.4, rasterized=True)[0]
            x, low, middle, high = binned(motion, force)
            band = axes.fill_between(fm * x, ff * low, ff * high, color=SKY, alpha=0.35, linewidth=0)
            line = axes.plot(fm * x, ff * middle, color=BLUE, linewidth=1.8)[0]
            handles = [dots, line, band]
            axes.set(xlabel=f"{'rotation' if turning and row == 0 else key} ({um})", ylabel=f"{'moment' if turning else 'force'} ({uf})")
            if row == 0:
                axes.set_title(str(latent["place"]))
    figure.legend(handles, ["every sample", "median of bins", "middle 50 % of each bin"], loc="outside upper center", ncols=3,
                  markerscale=4)
    return figure


def binned(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Middle of bins along x that hold enough samples, with the quartiles of y in each."""
    low, high = (float(np.quantile(x, q)) for q in (0.002, 0.998))
    edges = np.linspace(low, high, BINS + 1)
    which = np.digitize(x, edges) - 1
    out = [(0.5 * (edges[k] + edges[k + 1]), *np.quantile(y[which == k], [0.25, 0.5, 0.75])) for k in range(BINS)
           if (which == k).sum() >= 5]
    a = np.array(out).reshape(-1, 4)
    return a[:, 0], a[:, 1], a[:, 2], a[:, 3]


def drift(start: Array, value: Array, error: Array, place: str, unit: str) -> Figure:
    """A stiffness that changes over the test day: deviation from its mean, record by record, with 90 % intervals.

    Parameters
    ----------
    start : (R,) s. value, error : (R,) ``unit``; one standard deviation.
    """
    figure, grid = canvas(1, 1, height=2.9)
    axes = grid[0][0]
    factor, sign = scaled(value, unit)
    axes.errorbar(start, factor * value, yerr=1.645 * factor * error, fmt="o-", color=BLUE, capsize=3, linewidth=1.0)
    axes.axhline(0.0, color=GREY, linewidth=0.9, linestyle="--")
    axes.set(xlabel="begin of the record on the test day (s)", ylabel=f"stiffness at {place}\nminus its mean ({sign})")
    axes.set_title("drift, record by record (bars: 90 %)")
    return figure


def measuring_chain(frequency: Array, ratio: Array, effect: Array, sd: Array, cls: str, place: str) -> Figure:
    """Measured over modelled transfer function of a faulty channel, the fault left out of the model, then put into it: size and phase.

    Parameters
    ----------
    frequency : (e,) Hz. ratio, effect : (e,) complex, of the measurement and of the fault.
    sd : (e,) of the ratio's real and imaginary part.
    """
    figure, grid = canvas(2, 2, height=4.6, sharex=True, sharey="row")
    told = sd < max(float(np.abs(effect - 1).max()), 0.01)   # elsewhere noise is larger than the fault
    frequency, ratio, effect, sd = (x[told] for x in (frequency, ratio, effect, sd))
    both = ((ratio, ORANGE, "fault left out of the model"), (ratio / effect, BLUE, "fault in the model"))
    for column, (z, color, words) in enumerate(both):
        top, bottom = grid[0][column], grid[1][column]
        top.errorbar(frequency, np.abs(z), yerr=1.645 * sd, fmt=".", color=color, markersize=2.5, elinewidth=0.3,
                     label="measured over model")
        bottom.errorbar(frequency, np.degrees(np.angle(z)), yerr=np.degrees(1.645 * sd), fmt=".", color=color, markersize=2.5,
                        elinewidth=0.3)
        if column == 0:
            top.plot(frequency, np.abs(effect), color=RED, linewidth=1.6, zorder=5, label="the fault as estimated")
            bottom.plot(frequency, np.degrees(np.angle(effect)), color=RED, linewidth=1.6, zorder=5)
        for axes, level in ((top, 1.0), (bottom, 0.0)):
            axes.axhline(level, color="black", linewidth=0.9, linestyle="--")
        top.set_title(words)
        bottom.set_xlabel("frequency (Hz)")
    named = place if place not in ("", "-", "FORCE") else "all channels"
    reach = max(float(np.quantile(np.abs(np.abs(ratio) - 1), 0.95)), float(np.abs(np.abs(effect) - 1).max()), 0.01)
    turn = max(float(np.quantile(np.abs(np.degrees(np.angle(ratio))), 0.95)), float(np.abs(np.degrees(np.angle(effect))).max()), 0.5)
    grid[0][0].set(ylabel=f"size, {named}", ylim=(max(1 - 2 * reach, 0), 1 + 2 * reach))
    grid[1][0].set(ylabel="phase (°)", ylim=(-1.6 * turn, 1.6 * turn))
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=2, markerscale=3)
    figure.suptitle(f"{cls.replace('_', ' ')} at {place}", x=0.01, ha="left", fontsize=9.5)
    return figure


def attached(frequency: Array, stiffness: Array, sd: Array, law: Array, cls: str, place: str, unit: str) -> Figure:
    """Dynamic stiffness that the recordings ask for at a place, line by line, beside that of the effect as estimated.

    Parameters
    ----------
    frequency : (e,) Hz. stiffness, law : (e,) complex, ``unit``. sd : (e,) of real and imaginary part.
    """
    figure, grid = canvas(1, 2, height=3.3, sharex=True)
    reach = float(np.abs(law).max())
    told = sd < 0.3 * reach   # elsewhere the motion there is too small to tell
    factor, sign = scaled(np.abs(law), unit)
    parts = ((grid[0][0], np.real, "in phase with displacement"), (grid[0][1], np.imag, "a quarter ahead of it (loss)"))
    for axes, part, words in parts:
        axes.errorbar(frequency[told], factor * part(stiffness[told]), yerr=1.645 * factor * sd[told], fmt=".", color="#7d93a6",
                      markersize=2.5, elinewidth=0.3, label="recordings, line by line (90 %)")
        axes.plot(frequency, factor * part(law), color=RED, linewidth=1.7, zorder=5, label="as estimated")
        axes.axhline(0.0, color="black", linewidth=0.9, linestyle="--")
        axes.set(xlabel="frequency (Hz)", ylim=(-1.5 * factor * reach, 1.5 * factor * reach))
        axes.set_title(words)
    grid[0][0].set_ylabel(f"force over displacement\nat {place} ({sign})")
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside upper right", ncols=2, markerscale=3)
    figure.suptitle(f"{'outside the catalogue' if cls == 'other' else cls.replace('_', ' ')} at {place}", x=0.01, ha="left", fontsize=9.5)
    return figure


def clipping(time: Array, measured: Array, model: Array, level: float, channel: str) -> Figure:
    """A clipped channel at its loudest, beside the model that is not clipped.

    Parameters
    ----------
    time : (n,) s. measured, model : (n,) m/s². level : m/s².
    """
    figure, grid = canvas(1, 1, height=2.9)
    axes = grid[0][0]
    axes.plot(time, model, color=BLUE, linewidth=1.2, label="model without clipping")
    axes.plot(time, measured, ".-", color="black", linewidth=0.6, markersize=3, label="measured")
    for side in (-1, 1):
        axes.axhline(side * level, color=RED, linewidth=1.0, linestyle="--", label="estimated range" if side == 1 else None)
    axes.set(xlabel="time (s)", ylabel=f"{channel} (m/s²)", xlim=(time[0], time[-1]))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def quiet(frequency: Array, own: Array, others: Array | None, place: str, mains: float) -> Figure:
    """Spectrum with the shaker off of the disturbed channels, beside the others.

    Parameters
    ----------
    frequency : (K,) Hz. own, others : (K,) (m/s²)/√Hz. mains : Hz, 0 where mains hum is not the matter.
    """
    figure, grid = canvas(1, 1, height=3.1)
    axes = grid[0][0]
    keep = frequency > 0
    _loglog(axes, frequency[keep], own[keep], RED, place.replace("_", " ").lower() if place in ("ALL_SENSORS", "BASE") else place)
    if others is not None:
        _loglog(axes, frequency[keep], others[keep], GREY, "median of the other channels")
    if mains > 0:
        for h in (1, 2, 3):
            axes.axvline(h * mains, color=GREEN, linewidth=0.9, linestyle=":", label="mains and harmonics" if h == 1 else None)
    axes.set(xlabel="frequency (Hz)", ylabel="amplitude density\n((m/s²)/√Hz)")
    seen = own[keep] if others is None else np.concatenate([own[keep], others[keep]])
    axes.set_ylim(float(np.quantile(seen, 0.02)) / 2, 2 * float(seen.max()))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def _loglog(axes: Axes, x: Array, y: Array, color: str, words: str) -> None:
    axes.loglog(x, np.maximum(y, 1e-300), color=color, linewidth=0.9, label=words)


def error_map(numbers: Mapping[str, Any]) -> Figure:
    """How the errors on a record that was not used follow frequency, time and amplitude.

    Parameters
    ----------
    numbers : dict
        ``error_frequency`` (K,) Hz, ``error_time`` (B,) s, ``error_level`` (B,), and for each model ``error_<model>_spectrum`` (K,) and
        ``error_<model>_block`` (B,); ``error_measured_spectrum`` (K,), ``error_noise`` (scalar), ``error_unit``.
    """
    figure, grid = canvas(2, 2, height=5.0)
    top = grid[0][0].get_gridspec()
    for axes in grid[0]:
        axes.remove()
    spectrum = figure.add_subplot(top[0, :])
    time, level = grid[1]
    unit = str(numbers["error_unit"])
    f = np.asarray(numbers["error_frequency"], dtype=float)
    size = np.asarray(numbers["error_measured_spectrum"], dtype=float)
    spectrum.semilogy(f, np.maximum(size, 1e-300), color="black", linewidth=0.9, label="response")
    factor, sign = scaled(numbers["error_level"], unit)
    levels = np.asarray(numbers["error_level"], dtype=float)
    for name, color, marker, words in (("nominal", GREY, "^", "as delivered"), ("updated", ORANGE, "o", "re-tuned"),
                                       ("extended", BLUE, "s", "with what was found")):
        if f"error_{name}_spectrum" not in numbers:
            continue
        spectrum.semilogy(f, np.maximum(np.asarray(numbers[f"error_{name}_spectrum"]), 1e-300), color=color, linewidth=0.9, label=words)
        block = factor * np.asarray(numbers[f"error_{name}_block"], dtype=float)
        time.semilogy(numbers["error_time"], block, marker, color=color, markersize=3.5)
        level.semilogy(factor * levels, block, marker, color=color, markersize=3.5)
    noise = float(numbers["error_noise"])
    if noise > 1e-6 * float(np.max(numbers["error_level"])):
        for axes in (time, level):
            axes.axhline(factor * noise, color=GREEN, linewidth=1.0, linestyle="--")
        spectrum.plot([], [], color=GREEN, linewidth=1.0, linestyle="--", label="sensor noise (below)")
    if levels.max() > 10 * max(float(levels.min()), 1e-300):
        level.set_xscale("log")
    spectrum.set(xlabel="frequency (Hz)", ylabel=f"amplitude density\n(({unit_sign(unit)})/√Hz)", xlim=(0, f[-1]),
                 ylim=(1e-6 * float(size.max()), 3 * float(size.max())))
    spectrum.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, columnspacing=1.2)
    time.set(xlabel="time in the record (s)", ylabel=f"rms error of a stretch ({sign})")
    level.set(xlabel=f"rms response of the stretch ({sign})", ylabel=f"rms error of a stretch ({sign})")
    return figure
