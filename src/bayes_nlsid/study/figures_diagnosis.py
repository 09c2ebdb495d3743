"""Figures of a diagnosis: what is probably missing, where, at which amplitude, frequency and time, and what it improves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_nlsid.mismatch.words import whole_percent
from bayes_nlsid.study.axes import prefixed, unit_sign
from bayes_nlsid.study.figures import BLUE, GREEN, GREY, ORANGE, RED, SKY, WIDTH, canvas, fitted
from bayes_nlsid.study.sketch import Sketch

Array = NDArray[np.float64]
SHOWN = 10
FEWEST = 3     # that are shown however unlikely
FINER = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def hypotheses(names: Sequence[str], probability: Array) -> Figure:
    """Probability of every explanation, likeliest first."""
    order = np.argsort(-probability, kind="stable")[:SHOWN]
    order = order[:max(FEWEST, int((probability[order] > 0.005).sum()))]
    figure, grid = canvas(1, 1, height=0.8 + 0.27 * max(len(order), 3))
    axes = grid[0][0]
    at = np.arange(len(order))
    axes.barh(at, 100 * probability[order], color=[GREY if names[i] == "none" else BLUE for i in order], height=0.6)
    for row, i in enumerate(order):
        axes.text(100 * probability[i] + 1, row, whole_percent(float(probability[i])), va="center", fontsize=8)
    axes.set(yticks=at, yticklabels=[words_of(names[i]) for i in order], ylim=(len(order) - 0.4, -0.6), xlim=(0, 108),
             xlabel="probability (%)")
    axes.grid(False, axis="y")
    rest = float(probability.sum() - probability[order].sum())
    if rest > 0.005:
        axes.set_title(f"the {len(order)} likeliest; all others together {whole_percent(rest)}")
    return figure


def words_of(name: str) -> str:
    """``class@place + class@place`` as it is read."""
    parts = []
    for part in name.split(" + "):
        cls, _, place = part.partition("@")
        said = {"none": "nothing missing", "other": "outside the catalogue"}.get(cls, cls.replace("_", " "))
        parts.append(said + (f" at {place}" if place not in ("", "-") else ""))
    return " + ".join(parts)


def where(found: Sequence[tuple[str, float]], alike: Sequence[str], places: Sequence[str], shares: Array, sketch: Sketch | None,
          by: str = "any force, no law assumed,") -> Figure:
    """Where the mismatch sits: on a sketch of the structure if there is one, as probabilities, and as what a force there would explain.

    Parameters
    ----------
    found : (place, probability), likeliest first.
    alike : places that these data cannot tell from the first.
    places, shares : what share of the mismatch a force would explain at each place; ``by`` what kind of force.
    """
    order = np.argsort(-shares, kind="stable")[:SHOWN]
    rows = max(min(len(found), SHOWN), len(order), 2)
    height = 0.9 + 0.25 * rows
    figure, grid = canvas(2 if sketch else 1, 2 if len(order) else 1, height=height + (2.1 if sketch else 0),
                          **({"height_ratios": (2.0, height)} if sketch else {}))
    if sketch is not None:
        top = grid[0][0].get_gridspec()
        for axes in grid[0]:
            axes.remove()
        _on_structure(figure.add_subplot(top[0, :]), sketch, dict(found))
    left = grid[-1][0]
    chosen = list(found)[:SHOWN]
    at = np.arange(len(chosen))
    same = {found[0][0], *alike} if alike and found else set()
    left.barh(at, [100 * p for _, p in chosen], color=[RED if n in same or i == 0 else SKY for i, (n, _) in enumerate(chosen)], height=0.6)
    for row, (_, p) in enumerate(chosen):
        left.text(100 * p + 2, row, whole_percent(p), va="center", fontsize=8)
    left.set(yticks=at, yticklabels=[n for n, _ in chosen], ylim=(rows - 0.4, -0.6), xlim=(0, 122),
             xticks=(0, 25, 50, 75, 100), xlabel="probability that something is missing there (%)")
    left.set_title("cannot be told apart: " + ", ".join([found[0][0], *alike]) if same else "place of what is missing", fontsize=8.5)
    left.grid(False, axis="y")
    if not len(order):
        return figure
    right, at = grid[-1][1], np.arange(len(order))
    right.barh(at, 100 * np.minimum(shares[order], 1.0), color=GREY, height=0.6)
    right.set(yticks=at, yticklabels=[places[i] for i in order], ylim=(rows - 0.4, -0.6), xlim=(0, 105),
              xlabel="of what is not linear, explained (%)")
    right.set_title(f"by {by} at that place", fontsize=8.5)
    right.grid(False, axis="y")
    return figure


def _on_structure(axes: Axes, sketch: Sketch, found: Mapping[str, float]) -> None:
    """Beams with their height drawn larger; a disc at each place, its area the probability."""
    tall = max(b[4] for b in sketch.beams)
    for name, left, right, bottom, top in sketch.beams:
        axes.fill_between([left, right], [bottom / tall] * 2, [top / tall] * 2, color="#dfe5ea" if name == "A" else "#cfd8e0",
                          linewidth=0.8, edgecolor=GREY)
    bolts = sorted({x for n, (x, _) in sketch.points.items() if n.startswith("J") and n[1:2].isdigit()})
    for i, x in enumerate(bolts):
        axes.plot([x, x], [0.0, 1.0], color=GREY, linewidth=0.9, linestyle=":")
        axes.text(x, -0.08, f"J{i + 1}", ha="center", va="top", fontsize=7.5, color=GREY)
    for n, (x, y) in sketch.points.items():
        if n[:1] == "S" and n[1:].isdigit():
            axes.plot(x, y / tall + 0.06, marker="v", color=GREY, markersize=4)
            axes.text(x, y / tall + 0.13, n, ha="center", va="bottom", fontsize=6.5, color=GREY)
    if "SHAKER" in sketch.points:
        x, y = sketch.points["SHAKER"]
        axes.annotate("shaker", (x, y / tall), (x, y / tall - 0.45), ha="center", va="top", fontsize=7.5, color=GREY,
                      arrowprops={"arrowstyle": "->", "color": GREY})
    axes.plot([0, 0], [-0.25, 0.8], color="black", linewidth=2.5)
    placed: dict[tuple[float, float], list[str]] = {}
    for n, p in found.items():
        if n in sketch.points and p > 0.02:
            placed.setdefault(sketch.points[n], []).append(n)
    for (x, y), names in placed.items():
        p = sum(found[n] for n in names)
        axes.scatter([x], [y / tall], s=40 + 260 * p, color=RED, alpha=0.25 + 0.6 * min(p, 1.0), zorder=5, linewidth=0)
    # words above, side by side, with a thread to each place
    ordered = sorted(placed.items())
    span = sketch.length
    last = -np.inf
    for (x, y), names in ordered:
        words = "\n".join(f"{n}  {whole_percent(found[n])}" for n in sorted(names, key=lambda n: -found[n]))
        at = max(x, last + 0.14 * span)
        last = at
        axes.annotate(words, (x, y / tall), (at, 1.55), ha="center", va="bottom", fontsize=8, color=RED,
                      arrowprops={"arrowstyle": "-", "color": RED, "linewidth": 0.7})
    outside = [f"{n}  {whole_percent(p)}" for n, p in found.items() if n not in sketch.points and p > 0.02]
    axes.set(xlim=(-0.04 * span, 1.08 * span), ylim=(-0.75, 2.25), yticks=[],
             xlabel="position along the structure (m); height not to scale")
    if outside:
        axes.set_title("not a point of the structure: " + ", ".join(outside), fontsize=8.5)
    axes.grid(False)
    axes.spines["left"].set_visible(False)


def distortion(numbers: Mapping[str, Any]) -> Figure:
    """What one linear system cannot explain, by line of the spectrum and by record, before and after the effect that was found.

    Parameters
    ----------
    numbers : dict
        ``frequency``, ``line_number``, ``line_excited``, ``response_by_line``, ``residual_by_line``, ``noise_by_line`` (L,), m/s²;
        ``record_names``, ``levels``, ``starts``, ``record_before`` (R,); ``left_by_line``, ``record_after`` if something was found.
    """
    after = "left_by_line" in numbers
    figure, grid = canvas(3 if after else 2, 1, height=7.2 if after else 5.0)
    limits = [np.inf, 0.0]
    both = (("residual_by_line", "response that no linear system explains"), ("left_by_line", "what the leading explanation leaves of it"))
    for row, (key, words) in enumerate(both[:2 if after else 1]):
        axes = grid[row][0]
        for v in (_lines(axes, numbers, np.asarray(numbers[key])), np.asarray(numbers["response_by_line"])):
            good = v[v > 0]
            if good.size:
                limits = [min(limits[0], float(np.quantile(good, 0.002))), max(limits[1], float(good.max()))]
        axes.set_ylabel("rms of a line (m/s²)")
        axes.set_title(words)
    for row in range(2 if after else 1):
        grid[row][0].set(ylim=(limits[0] / 2, 2 * limits[1]), xlim=(0, 1.02 * float(np.max(numbers["frequency"]))))
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=5, markerscale=3, handletextpad=0.2)
    grid[1 if after else 0][0].set_xlabel("frequency (Hz)")
    _by_record(grid[-1][0], numbers)
    return figure


def _lines(axes: Axes, numbers: Mapping[str, Any], residual: Array) -> Array:
    """Response, what is left on lines with and without force, and noise; returns what is left."""
    f, line, excited = (np.asarray(numbers[k]) for k in ("frequency", "line_number", "line_excited"))
    axes.semilogy(f[excited], np.asarray(numbers["response_by_line"])[excited], ".", color="#b8c0c8", markersize=1.8, label="response")
    kinds = [(excited, BLUE, "lines with force")]
    if (~excited).any():
        kinds += [(~excited & (line % 2 == 1), ORANGE, "odd lines without"), (~excited & (line % 2 == 0), GREEN, "even lines without")]
    for mask, color, words in kinds:
        if mask.any():
            axes.semilogy(f[mask], np.maximum(residual[mask], 1e-300), ".", color=color, markersize=1.8, label=words)
    axes.semilogy(f, np.maximum(np.asarray(numbers["noise_by_line"]), 1e-300), color="black", linewidth=0.9, linestyle="--", label="noise")
    return residual


def _by_record(axes: Axes, numbers: Mapping[str, Any]) -> None:
    """Misfit of each record over noise, in the order of the test day."""
    starts, levels = np.asarray(numbers["starts"], dtype=float), np.asarray(numbers["levels"], dtype=float)
    order = np.argsort(starts, kind="stable")
    at = np.arange(len(order))
    for key, shift, color, marker, words in (("record_before", -0.08, RED, "o", "one linear system"),
                                             ("record_after", 0.08, BLUE, "s", "with the leading explanation")):
        if key in numbers:
            axes.semilogy(at + shift, np.maximum(np.asarray(numbers[key], dtype=float)[order], 1e-3), marker, color=color, markersize=5,
                          label=words)
    axes.axhline(1.0, color="black", linewidth=0.9, linestyle="--", label="noise")
    low, high = axes.get_ylim()
    axes.set(xticks=at, xlim=(-0.6, len(order) - 0.4), ylim=(min(low, 0.3), max(high, 10.0)), ylabel="squared misfit\nover noise",
             xticklabels=[f"{numbers['record_names'][i]}\nlevel {levels[i]:.3g}, {starts[i]:.4g} s" for i in order])
    axes.tick_params(axis="x", labelsize=7)
    axes.set_title("by record")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)


def transfer_functions(numbers: Mapping[str, Any], channels: Sequence[str] = ()) -> Figure:
    """Measured and modelled transfer function of the channel that what was found changes most, and the errors against the noise.

    Parameters
    ----------
    numbers : dict
        ``frf_frequency`` (e,) Hz; ``frf_measured``, ``frf_linear``, if there are ``frf_nominal``, ``frf_extended`` (e, s) complex and
        ``frf_error`` (e, s), m/s² per N.
    channels : sequence of str (s,)
    """
    f, measured = np.asarray(numbers["frf_frequency"], dtype=float), np.asarray(numbers["frf_measured"])
    error = np.asarray(numbers["frf_error"]) if "frf_error" in numbers else np.zeros(measured.shape)
    models = [(np.asarray(numbers[k]), color, style, words) for k, color, style, words in (
        ("frf_nominal", GREY, ":", "model as delivered"), ("frf_linear", ORANGE, "--", "linear model, re-tuned"),
        ("frf_extended", BLUE, "-", "with what was found")) if k in numbers]
    c = _changed(measured, error, numbers)
    figure, grid = canvas(3, 1, height=6.0, sharex=True, height_ratios=(1.3, 0.9, 1.1))
    top, middle, bottom = (grid[i][0] for i in range(3))
    top.semilogy(f, np.abs(measured[:, c]), ".", color="black", markersize=2.5, label="measured")
    middle.plot(f, np.degrees(np.angle(measured[:, c])), ".", color="black", markersize=2.5)
    for model, color, style, words in models:
        top.semilogy(f, np.abs(model[:, c]), color=color, linestyle=style, linewidth=1.0, label=words)
        middle.plot(f, np.degrees(np.angle(model[:, c])), color=color, linestyle="none", marker=".", markersize=1.2)
        bottom.semilogy(f, np.maximum(np.abs(measured[:, c] - model[:, c]), 1e-300), color=color, linestyle=style, linewidth=0.9)
    bottom.semilogy(f, np.maximum(error[:, c], 1e-300), color=GREEN, linewidth=1.1, linestyle="-.", label="error of the measurement, 1 sd")
    name = channels[c] if len(channels) > c else f"channel {c + 1}"
    top.set_ylabel("(m/s²)/N")
    top.set_title(f"{name} per force", pad=18)
    top.legend(loc="lower left", bbox_to_anchor=(0.0, 0.98), ncols=4, borderaxespad=0.1)
    middle.set(ylabel="phase (°)", yticks=(-180, -90, 0, 90, 180), ylim=(-190, 190))
    size = np.abs(measured[:, c])
    bottom.set(xlabel="frequency (Hz)", ylabel="|measured − model|\n((m/s²)/N)",
               ylim=(max(np.quantile(error[:, c], 0.02), 1e-5 * size.max()) / 4, 2 * size.max()))
    bottom.legend(loc="upper right")
    return figure


def _changed(measured: Any, error: Array, numbers: Mapping[str, Any]) -> int:
    """The channel whose transfer function gains most by what was found; the strongest if nothing does."""
    if "frf_extended" in numbers:
        safe = np.maximum(error, 1e-6 * np.abs(measured).max())
        before, after = (np.abs((measured - np.asarray(numbers[k])) / safe) ** 2 for k in ("frf_linear", "frf_extended"))
        gain = (before - after).sum(axis=0)
        if gain.max() > 0:
            return int(np.argmax(gain))
    return int(np.argmax(np.abs(measured).max(axis=0)))


def _telling(waves: Mapping[str, Array]) -> int:
    """The channel that what was found changes most; the loudest where nothing changes."""
    if "updated" in waves and "extended" in waves:
        change = (waves["extended"] - waves["updated"]).std(axis=0)
        if change.max() > 0:
            return int(np.argmax(change))
    return int(np.argmax(waves["measured"].std(axis=0)))


def before_after(time: Array, waves: Mapping[str, Array], facts: str, channels: Sequence[str] = (), units: Sequence[str] = (),
                 half: Array | None = None) -> Figure:
    """A record not used: measured, the errors of the model as delivered, re-tuned and extended, and a close look at the loudest cycles.

    Parameters
    ----------
    time : ndarray (n,) s
    waves : dict
        ``measured``, ``nominal``, ``updated``, ``extended``, each (n, s).
    facts : str
        One line of numbers.
    channels, units : sequence of str (s,)
        Names, and m/s², m/s or m; numbered accelerations if not given.
    half : ndarray (n, s), optional
        Half the width of the 90 % predictive band of the extended model.
    """
    c = _telling(waves)
    name_of = channels[c] if len(channels) > c else f"sensor {c + 1}"
    names = [("nominal", "error of the model as delivered", GREY), ("updated", "error of the linear model, re-tuned", ORANGE),
             ("extended", "error with what was found", BLUE)]
    shown = [entry for entry in names if entry[0] in waves]
    figure, grid = canvas(2 + len(shown), 1, height=3.2 + 1.05 * (1 + len(shown)), height_ratios=(1, *[1] * len(shown), 1.9))
    measured = waves["measured"][:, c]
    factor, unit = prefixed(measured, units[c] if len(units) > c else "m/s^2")
    size = factor * float(np.abs(measured).max()) * 1.05
    grid[0][0].plot(time, factor * measured, color="black", linewidth=0.6)
    grid[0][0].set_ylabel(f"({unit})", fontsize=8)
    grid[0][0].set_title("measured", fontsize=8.5, pad=2)
    for row, (name, _, color) in enumerate(shown, start=1):
        axes = grid[row][0]
        axes.plot(time, factor * (measured - waves[name][:, c]), color=color, linewidth=0.6)
        if name == shown[-1][0] and half is not None:
            axes.fill_between(time, -factor * half[:, c], factor * half[:, c], color=SKY, alpha=0.35, linewidth=0, label="90 % band")
            for side in (-1, 1):
                axes.plot(time, side * factor * half[:, c], color="black", linewidth=0.7)
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.95), borderaxespad=0.1)
        axes.set_ylabel(f"({unit})", fontsize=8)
    for row, axes in enumerate(grid[:-1, 0]):
        limit = size
        if row:
            name, words, _ = shown[row - 1]
            worst = 1.05 * factor * float(np.abs(measured - waves[name][:, c]).max())
            # a small error on the scale of the recording would be a line: it gets a round number of times its scale
            zoom = FINER[int(np.searchsorted(FINER, size / max(worst, 1e-300), side="right")) - 1] if 0 < worst < size else 1
            limit = max(size / zoom, worst)
            axes.set_title(words + (f" (scale {zoom} times finer)" if zoom > 1 else ""), fontsize=8.5, pad=2)
        axes.set(ylim=(-limit, limit), xlim=(time[0], time[-1]))
        if row < len(shown):
            axes.tick_params(labelbottom=False)
    _close_look(grid[-1][0], time, {k: factor * w[:, c] for k, w in waves.items()}, None if half is None else factor * half[:, c], unit)
    figure.suptitle(fitted(f"channel {name_of} {facts}", WIDTH - 0.2, 8.5), x=0.01, ha="left", fontsize=8.5)
    return figure


def _smooth(time: Array, wave: Array, piece: slice) -> tuple[Array, Array]:
    """A stretch of a band-limited signal eight times finer, so that cycles of a few samples look like cycles."""
    margin = 64
    first, last = max(piece.start - margin, 0), min(piece.stop + margin, len(wave))
    part = wave[first:last]
    ramp = np.linspace(part[0], part[-1], len(part))   # without a jump at the ends
    lines = np.fft.rfft(part - ramp)
    fine = np.fft.irfft(lines, 8 * len(part)) * 8
    t = time[first] + (time[1] - time[0]) * np.arange(len(fine)) / 8
    fine = fine + np.interp(t, time[first:last], ramp)
    keep = (t >= time[piece][0]) & (t <= time[piece][-1])
    return t[keep], fine[keep]


def _close_look(axes: Axes, time: Array, waves: Mapping[str, Array], half: Array | None, unit: str) -> None:
    """The ten cycles or so where the re-tuned model errs most: measured, re-tuned and extended with its band."""
    y = waves["measured"]
    crossings = max(int((np.diff(np.sign(y - y.mean())) != 0).sum()), 1)
    width = int(np.clip(20 * len(y) / crossings, 30, len(y)))
    error = np.abs(y - waves["updated"]) if "updated" in waves else np.abs(y)
    first = int(np.clip(int(np.argmax(error)) - width // 2, 0, max(len(y) - width, 0)))
    piece = slice(first, first + width)
    best = "extended" if "extended" in waves else "updated"
    if half is not None and best in waves:
        t, middle = _smooth(time, waves[best], piece)
        wide = np.interp(t, time, half)
        axes.fill_between(t, middle - wide, middle + wide, color=SKY, alpha=0.45, linewidth=0, label="90 % band")
    for name, color, style, words in (("updated", ORANGE, "--", "linear model, re-tuned"), ("extended", BLUE, "-", "with what was found")):
        if name in waves:
            axes.plot(*_smooth(time, waves[name], piece), color=color, linestyle=style, linewidth=1.1, label=words)
    axes.plot(time[piece], y[piece], ".", color="black", markersize=3.5, label="measured")
    axes.set(xlim=(time[piece][0], time[piece][-1]), xlabel="time (s)", ylabel=f"({unit_sign(unit)})")
    axes.set_title("a close look", fontsize=8.5, pad=2)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, borderaxespad=0.1)
