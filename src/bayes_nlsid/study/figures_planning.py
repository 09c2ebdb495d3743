"""Figures of a test plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.figures import BLUE, CYCLE, GREY, canvas, legend_below

MOST = 6  # parameters in one panel


def learning(levels: NDArray[np.float64], sd: NDArray[np.float64], names: Sequence[str], limits: tuple[float, float, float]) -> Figure:
    """Standard deviation of ln p of every parameter against the level, at the best place for the shaker.

    Parameters
    ----------
    levels : ndarray (L,) N rms
    sd : ndarray (L, J)
    names : sequence of str, length J
    limits : tuple of float
        Learned up to here, roughly learned up to here, the prior.
    """
    figure, grid = canvas(1, 1, height=3.4)
    axes = grid[0][0]
    worst = np.argsort(-sd[-1], kind="stable")[:MOST]
    for n, j in enumerate(worst):
        axes.loglog(levels, sd[:, j], "o-", color=CYCLE[n % len(CYCLE)], label=names[j])
    for limit, text in zip(limits, ("learned", "roughly", "prior"), strict=True):
        axes.axhline(limit, color=GREY, linewidth=0.8, linestyle="--")
        axes.text(levels[-1], limit, f"{text} ", ha="right", va="bottom", fontsize=7.5, color=GREY)
    axes.set(xlabel="rms force (N)", ylabel="standard deviation of ln p")
    legend_below(figure, *axes.get_legend_handles_labels())
    return figure


def sensors(names: Sequence[str], gains: Sequence[float]) -> Figure:
    """Information reached when sensors are added in the best order."""
    figure, grid = canvas(1, 1, height=0.9 + 0.26 * max(len(names), 4))
    axes = grid[0][0]
    at = np.arange(len(names))
    axes.barh(at, gains, color=BLUE, height=0.6)
    axes.set(yticks=at, yticklabels=[f"+ {n}" if i else n for i, n in enumerate(names)], ylim=(len(names) - 0.4, -0.6),
             xlabel="information about the joints (nats, cumulative)")
    return figure
