"""Figures of a diagnosis: what is probably missing, where, what its force looks like, and what it improves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.axes import prefixed
from bayes_nlsid.study.figures import BLUE, GREEN, GREY, ORANGE, RED, canvas

Array = NDArray[np.float64]


def hypotheses(names: Sequence[str], probability: Array, places: Sequence[str], shares: Array) -> Figure:
    """Probability of every explanation, and how much of the mismatch a free force at each place would explain."""
    order = np.argsort(-probability)[:10]
    where = np.argsort(-shares)[:10]
    figure, grid = canvas(1, 2, height=0.9 + 0.26 * max(len(order), len(where), 4), width_ratios=(1.2, 1))
    left, right = grid[0]
    at = np.arange(len(order))
    left.barh(at, 100 * probability[order], color=BLUE, height=0.6)
    for row, i in enumerate(order):
        words = f"{100 * probability[i]:.0f} %" if probability[i] >= 0.005 else "< 1 %"
        left.text(100 * probability[i] + 1, row, words, va="center", fontsize=7.5)
    left.set(yticks=at, yticklabels=[_words(names[i]) for i in order], ylim=(len(order) - 0.4, -0.6), xlim=(0, 112),
             xlabel="probability (%)")
    at = np.arange(len(where))
    right.barh(at, 100 * shares[where], color=ORANGE, height=0.6)
    right.set(yticks=at, yticklabels=[places[i] for i in where], ylim=(max(len(where), 4) - 0.4, -0.6), xlim=(0, 105),
              xlabel="explained by a force there (%)")
    return figure


def _words(name: str) -> str:
    """``class@place + class@place`` as it is read."""
    parts = []
    for part in name.split(" + "):
        cls, _, place = part.partition("@")
        parts.append(cls.replace("_", " ") + (f" at {place}" if place not in ("", "-") else ""))
    return " + ".join(parts)


def transfer_functions(frequency: Array, measured: Array, linear: Array, lines: Array, residual: Array, noise: Array) -> Figure:
    """Measured against modelled transfer function of the strongest sensor, and what is left against the noise.

    Parameters
    ----------
    frequency : ndarray (e,) Hz
    measured, linear : ndarray (e, s)
        Complex, m/s² per N.
    lines : ndarray (f,) Hz
    residual, noise : ndarray (f,)
        Root mean square over sensors and records.
    """
    c = int(np.argmax(np.abs(measured).max(axis=0)))
    figure, grid = canvas(2, 1, height=4.2, sharex=True)
    top, bottom = grid[0][0], grid[1][0]
    top.semilogy(frequency, np.abs(measured[:, c]), ".", color=RED, markersize=3, label="measured")
    top.semilogy(frequency, np.abs(linear[:, c]), color=BLUE, label="linear model, re-tuned")
    top.set_ylabel(f"sensor {c + 1} per force\n((m/s²)/N)")
    top.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    bottom.semilogy(lines, np.maximum(residual, 1e-300), color=RED, linewidth=0.8, label="what the linear model leaves")
    bottom.semilogy(lines, np.maximum(noise, 1e-300), color=GREEN, linewidth=0.9, linestyle="--", label="noise")
    bottom.set(xlabel="frequency (Hz)", ylabel="rms over sensors (m/s²)")
    positive = np.concatenate([residual[residual > 0], noise[noise > 0]])
    if positive.size:
        bottom.set_ylim(np.quantile(positive, 0.001) / 2, 2 * positive.max())
    bottom.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return figure


def latent_forces(latents: Sequence[Mapping[str, object]]) -> Figure:
    """The force that would explain the mismatch at the likeliest places, against motion there.

    Parameters
    ----------
    latents : sequence of dict
        ``place``, ``force`` (n,) N, ``displacement`` (n,) m, ``velocity`` (n,) m/s.
    """
    columns = max(1, len(latents))
    figure, grid = canvas(2, columns, height=4.6)
    for j, latent in enumerate(latents):
        force = np.asarray(latent["force"], dtype=float)
        ff, uf = prefixed(np.quantile(np.abs(force), 0.999), "N")
        for row, (key, unit, word) in enumerate((("displacement", "m", "displacement"), ("velocity", "m/s", "velocity"))):
            motion = np.asarray(latent[key], dtype=float)
            fm, um = prefixed(np.quantile(np.abs(motion), 0.999), unit)
            axes = grid[row][j]
            axes.plot(fm * motion, ff * force, ".", color=BLUE, markersize=1.2, alpha=0.5, rasterized=True)
            axes.set(xlabel=f"{word} ({um})", ylabel=f"force ({uf})" if j == 0 else f"({uf})")
            if row == 0:
                axes.set_title(str(latent["place"]))
    return figure


def _telling(waves: Mapping[str, Array]) -> int:
    """The channel that what was found changes most; the loudest where nothing changes."""
    if "updated" in waves and "extended" in waves:
        change = (waves["extended"] - waves["updated"]).std(axis=0)
        if change.max() > 0:
            return int(np.argmax(change))
    return int(np.argmax(waves["measured"].std(axis=0)))


def before_after(time: Array, waves: Mapping[str, Array], facts: str, channels: Sequence[str] = (), units: Sequence[str] = ()) -> Figure:
    """A record not used: measured, and the errors of the model as delivered, re-tuned, and extended.

    Parameters
    ----------
    time : ndarray (n,) s
    waves : dict
        ``measured``, ``nominal``, ``updated``, ``extended``, each (n, s).
    facts : str
        One line of numbers.
    channels, units : sequence of str (s,)
        Names, and m/s², m/s or m; numbered accelerations if not given.
    """
    c = _telling(waves)
    name_of = channels[c] if len(channels) > c else f"sensor {c + 1}"
    names = [("nominal", "model as delivered", GREY), ("updated", "linear model, re-tuned", ORANGE),
             ("extended", "with what was found", BLUE)]
    shown = [entry for entry in names if entry[0] in waves]
    figure, grid = canvas(1 + len(shown), 1, height=1.0 + 1.05 * (1 + len(shown)), sharex=True)
    measured = waves["measured"][:, c]
    factor, unit = prefixed(measured, units[c] if len(units) > c else "m/s^2")
    size = factor * float(np.abs(measured).max()) * 1.05
    grid[0][0].plot(time, factor * measured, color="black", linewidth=0.6)
    grid[0][0].set_ylabel(f"measured\n({unit})", fontsize=8)
    for row, (name, words, color) in enumerate(shown, start=1):
        grid[row][0].plot(time, factor * (measured - waves[name][:, c]), color=color, linewidth=0.6)
        grid[row][0].set_ylabel(f"error ({unit})", fontsize=8)
        grid[row][0].set_title(words, fontsize=8.5, pad=2)
    left = [factor * float(np.abs(measured - waves[n][:, c]).max()) for n, _, _ in shown if n != "nominal"]
    fine = 1.05 * max(left, default=size) or size
    for row, axes in enumerate(grid[:, 0]):
        # the two best share a finer scale
        limit = size if row == 0 else fine
        if row and shown[row - 1][0] == "nominal":
            limit = max(size, 1.05 * factor * float(np.abs(measured - waves["nominal"][:, c]).max()))
        axes.set(ylim=(-limit, limit), xlim=(time[0], time[-1]))
    grid[-1][0].set_xlabel("time (s)")
    figure.suptitle(f"{name_of}   {facts}", x=0.01, ha="left", fontsize=8.5)
    return figure
