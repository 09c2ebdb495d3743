"""Figures of the recording and of the linear model, and the style all figures share.

Only this module and its siblings ``figures_*.py`` import matplotlib; figures are built as objects without pyplot, so nothing
global changes.
Colours are those of Okabe and Ito, which people with any colour vision can tell apart; line style or marker repeats what colour says.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.study.axes import axis_label, prefixed

BLUE, ORANGE, GREEN, RED, PURPLE, SKY, YELLOW, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#F0E442", "#6b6b6b"
CYCLE = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 9, "axes.titlesize": 9.5, "axes.labelsize": 9, "legend.fontsize": 8,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "#e3e3e3", "grid.linewidth": 0.6, "axes.axisbelow": True, "lines.linewidth": 1.3, "legend.frameon": False,
    "figure.facecolor": "white", "axes.titlelocation": "left",
    "axes.formatter.limits": (-4, 5), "axes.formatter.use_mathtext": True, "axes.formatter.useoffset": False,
}
WIDTH = 7.2
DPI = 170
Array = NDArray[np.float64]


def canvas(rows: int = 1, columns: int = 1, height: float = 3.0, **grid: Any) -> tuple[Figure, Any]:
    """A figure of the common width with a grid of axes (always a 2-D array of them)."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **grid)


def png(draw: Any, *arguments: Any, **options: Any) -> bytes:
    """Draw in the common style and return the PNG.

    Parameters
    ----------
    draw : callable
        One of the figure functions; returns a Figure.
    """
    with rc_context(STYLE):
        figure = draw(*arguments, **options)
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
        return buffer.getvalue()


def text_width(text: str, size: float) -> float:
    """Width in inches of the widest line of a text at a font size in points, in the font of the common style."""
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font = get_font(findfont(FontProperties(family=STYLE["font.family"])))
    font.set_size(size, 720)  # tenths of a point, so that hinting does not round the width
    widths = [0]
    for line in text.split("\n"):
        font.set_text(line, 0.0)
        widths.append(font.get_width_height()[0])
    return max(widths) / 64 / 720


def fitted(text: str, width: float, size: float) -> str:
    """A text broken into lines no wider than ``width`` inches: before a bracket if that is enough, then at spaces, then anywhere.

    Parameters
    ----------
    text : str
        Its own line breaks stay.
    width : float
        Inches.
    size : float
        Font size, points.
    """
    return "\n".join("\n".join(_broken(line, width, size, 0)) for line in text.split("\n"))


_BREAKS = (r"(?=\[)|(?<=\]\.)", r"(?<= )", r"(?<=[+._\]/-])", r"(?<=.)(?=.)")


def _broken(line: str, width: float, size: float, level: int) -> list[str]:
    """Lines of one line, broken at the coarsest level of `_BREAKS` that fits."""
    if level == len(_BREAKS) or text_width(line, size) <= width:
        return [re.sub(r"\]\.$", "]", line.strip())]  # the dot before a parameter on its own line says nothing
    lines: list[str] = []
    for piece in re.split(_BREAKS[level], line):
        if lines and text_width((lines[-1] + piece).rstrip(), size) <= width:
            lines[-1] += piece
        else:
            lines.append(piece)
    return [part for found in lines for part in _broken(found, width, size, level + 1)]


def legend_below(figure: Figure, handles: Sequence[Any], labels: Sequence[str]) -> None:
    """A legend under the panels in as many columns as fit the figure, labels wrapped; the figure grows by the legend's height."""
    if not handles:
        return
    size, room = float(STYLE["legend.fontsize"]), WIDTH - 0.2
    for columns in (3, 2, 1):
        share = room / columns - 0.6  # handle, gaps between columns
        wrapped = [fitted(label, share, size) for label in labels]
        if columns == 1 or all("\n" not in text for text in wrapped) or (columns == 2 and max(t.count("\n") for t in wrapped) < 2):
            break
    legend = figure.legend(handles, wrapped, loc="outside lower center", ncols=columns, columnspacing=1.2, fontsize=size)
    extent = legend.get_window_extent()
    figure.set_figheight(figure.get_figheight() + float(extent.height) / figure.dpi)


def envelope(time: Array, signal: Array, columns: int = 1500) -> tuple[Array, Array, Array]:
    """Smallest and largest sample in each of ``columns`` stretches: what a long signal looks like at the width of a page."""
    n = len(signal)
    if n <= 2 * columns:
        return time, signal, signal
    size = -(-n // columns)
    starts = np.arange(0, n, size)
    return time[starts], np.minimum.reduceat(signal, starts), np.maximum.reduceat(signal, starts)


def draw_signal(axes: Axes, time: Array, signal: Array, **style: Any) -> None:
    """A signal as a line, or as the filled band between its extremes when it has too many samples for lines."""
    t, low, high = envelope(time, signal)
    if low is high:
        axes.plot(t, signal, **{"linewidth": 0.8, **style})
    else:
        axes.fill_between(t, low, high, linewidth=0.4, edgecolor=style.get("color"), **style)


def spectrum(signal: Array, dt: float) -> tuple[Array, Array]:
    """One-sided amplitude density (unit/√Hz) by averaged Hann windows of an eighth of the record."""
    from scipy.signal import welch

    length = max(16, min(len(signal), 2 ** int(np.log2(max(16, len(signal) // 8)))))
    frequency, density = welch(signal - signal.mean(), 1 / dt, nperseg=length)
    return frequency, np.sqrt(density)


def recording_overview(time: Array, signals: Array, labels: Sequence[str], units: Sequence[str], *,
                       windows: Sequence[tuple[str, float, float]] = (), noise: tuple[Array, Array] | None = None,
                       band: tuple[float, float] | None = None, modes: Sequence[float] = (), title: str = "") -> Figure:
    """Each channel against time with its windows, and its spectrum with noise floor and modes.

    Parameters
    ----------
    time : ndarray (n,) s
    signals : ndarray (n, c)
        In the SI ``units`` of each channel.
    windows : sequence of (name, start, stop) in s
    noise : (frequency (f,), density (f, c)), optional
        One-sided power spectral density of the noise.
    band : (low, high) Hz, optional
        Where the identification works.
    modes : sequence of float
        Natural frequencies, Hz.
    """
    count = signals.shape[1]
    figure, grid = canvas(count, 2, height=0.7 + 1.65 * count, sharex="col", width_ratios=(1.35, 1))
    dt = float(time[1] - time[0])
    top = float(max((band or (0, 0))[1] * 1.6, 2.0 * max(modes, default=0.0))) or 0.5 / dt
    for c in range(count):
        left, right = grid[c]
        factor, unit = prefixed(signals[:, c], units[c])
        draw_signal(left, time, factor * signals[:, c], color=BLUE)
        _draw_windows(left, windows, float(time[-1]), labelled=c == 0)
        left.set_ylabel(f"{labels[c]} ({unit})")
        frequency, density = spectrum(signals[:, c], dt)
        if (density[1:] > 0).any():  # a silent channel has nothing that a logarithm can show
            right.semilogy(frequency[1:], density[1:], color=BLUE, linewidth=0.9, label="recording")
        if noise is not None and (noise[1][1:, c] > 0).any():
            right.semilogy(noise[0][1:], np.sqrt(noise[1][1:, c]), color=RED, linewidth=1.1, linestyle="--", label="noise floor")
        if band is not None:
            right.axvspan(*band, color=GREEN, alpha=0.12, linewidth=0, label="band used")
        for k, f in enumerate(modes):
            right.axvline(f, color=GREY, linewidth=0.8, linestyle=":", label="modes" if k == 0 else None)
        right.set_xlim(0, min(top, 0.5 / dt))
        right.set_ylabel(f"{units[c].replace('^2', '²')}/√Hz")
    grid[0][1].legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=2, columnspacing=1.0, handlelength=1.4)
    grid[-1][0].set_xlabel("time (s)")
    grid[-1][1].set_xlabel("frequency (Hz)")
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure


def _draw_windows(axes: Axes, windows: Sequence[tuple[str, float, float]], end: float, labelled: bool) -> None:
    """Windows as shading and, above the first panel, as named bars one above the other, so that overlaps stay readable."""
    for k, (name, start, stop) in enumerate(windows):
        color = CYCLE[(k + 1) % len(CYCLE)]
        if stop - start < 0.8 * end:
            axes.axvspan(start, stop, color=color, alpha=0.14, linewidth=0)
        if labelled:
            level = 1.05 + 0.13 * k
            axes.plot([start, min(stop, end)], [level, level], transform=axes.get_xaxis_transform(), color=color, linewidth=3,
                      clip_on=False)
            axes.text(start, level + 0.015, name, transform=axes.get_xaxis_transform(), color=color, fontsize=7.5, va="bottom", ha="left")


def linear_model(measured: Mapping[str, Array], model: Mapping[str, Array], mac: Array, *, shapes: Mapping[str, Array] | None = None,
                 before: Array | None = None) -> Figure:
    """Measured against modelled frequencies, the modal assurance criterion, and mode shapes at the sensors.

    Parameters
    ----------
    measured : dict
        ``frequency`` (k,) Hz, ``zeta`` (k,), ``frequency_sd`` (k,) Hz, ``number`` (k,) 1-based numbers of the modes; ``zeta_sd`` (k,) draws
        bars of 90 % on the damping.
    model : dict
        ``frequency`` (k,) Hz of the same modes after updating.
    mac : ndarray (k, k)
        Measured modes by rows.
    shapes : dict, optional
        ``position`` (s,), ``measured`` (s, k), and ``line_position`` (p,), ``line`` (p, k) of the model.
    before : ndarray (k,), optional
        Frequencies of the model before updating.
    """
    k = len(measured["frequency"])
    numbers = [f"{int(n)}" for n in measured["number"]]
    rows = 2 if shapes is not None else 1
    figure = Figure(figsize=(WIDTH, 2.9 + (1.5 if shapes is not None else 0.0)), layout="constrained")
    FigureCanvasAgg(figure)
    upper = figure.add_gridspec(rows, 1, height_ratios=(1.5, 1)[:rows])
    top = upper[0].subgridspec(1, 3, width_ratios=(1.25, 1, 1))
    left, middle, right = (figure.add_subplot(top[i]) for i in range(3))
    place = np.arange(k)
    if before is not None:
        left.plot(100 * (before / measured["frequency"] - 1), place, "o", color=GREY, mfc="white", label="model as stated")
    left.errorbar(100 * (model["frequency"] / measured["frequency"] - 1), place,
                  xerr=165 * measured["frequency_sd"] / measured["frequency"],
                  fmt="s", color=BLUE, capsize=2.5, label="model updated (bars: 90 % of the measurement)")
    left.axvline(0, color="black", linewidth=0.8)
    left.set(yticks=place, yticklabels=[f"mode {n}\n{f:.4g} Hz" for n, f in zip(numbers, measured["frequency"], strict=True)],
             xlabel="model − measured (%)", ylim=(k - 0.5, -0.5))
    spread = np.nan_to_num(np.asarray(measured.get("zeta_sd", np.zeros(k)), dtype=float))
    middle.barh(place, 100 * measured["zeta"], color=SKY, height=0.55, xerr=165 * spread if spread.any() else None, capsize=2.5,
                error_kw={"elinewidth": 1.0})
    middle.set(yticks=place, yticklabels=numbers, xlabel="damping measured (% of critical)", ylim=(k - 0.5, -0.5), ylabel="mode")
    middle.set_xlim(left=0.0)
    image = right.imshow(mac, vmin=0, vmax=1, cmap="cividis")
    right.grid(False)
    right.set(xticks=place, yticks=place, xticklabels=numbers, yticklabels=numbers, xlabel="model mode", ylabel="measured mode",
              title="MAC")
    for i in range(k):
        for j in range(k):
            right.text(j, i, f"{mac[i, j]:.2f}", ha="center", va="center", fontsize=7, color="white" if mac[i, j] < 0.55 else "black")
    figure.colorbar(image, ax=right, shrink=0.75)
    if shapes is not None:
        _draw_shapes(figure, upper[1].subgridspec(1, k), shapes, numbers)
    pairs = dict(zip(*reversed(left.get_legend_handles_labels()), strict=True))
    for axes in figure.axes[4:5]:
        pairs |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(list(pairs.values()), list(pairs), loc="outside upper left", ncols=4, columnspacing=1.0)
    return figure


def _draw_shapes(figure: Figure, grid: Any, shapes: Mapping[str, Array], numbers: Sequence[str]) -> None:
    """One small panel for each mode: the model's line and the measured points, scaled to the model by least squares."""
    for j, number in enumerate(numbers):
        axes = figure.add_subplot(grid[j])
        measured = shapes["measured"][:, j]
        if "line" in shapes and shapes["line"].size:
            line, at = shapes["line"][:, j], shapes["at_sensors"][:, j]
            size = float(np.abs(line).max()) or 1.0
            gain = float(measured @ at) / (float(measured @ measured) or 1.0)
            axes.plot(shapes["line_position"], line / size, color=BLUE, label="model shape")
            axes.plot(shapes["position"], gain * measured / size, "o", color=RED, markersize=4.5, label="measured shape")
        else:
            axes.stem(shapes["position"], measured / (float(np.abs(measured).max()) or 1.0), basefmt=" ")
        axes.axhline(0, color="black", linewidth=0.6)
        axes.set(title=f"mode {number}", ylim=(-1.25, 1.25), yticks=[-1, 0, 1], xlabel=axis_label("position", "m"))
        if j:
            axes.set_yticklabels([])
        else:
            axes.set_ylabel("shape (largest = 1)")
