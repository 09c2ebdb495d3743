"""Every figure of the study; the only place here that draws."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from studies.virtual_beam.beam import K_T, SLIP, TABLE_2, Array, Solid

from bayes_nlsid.structure.reduction import Reduced
from bayes_nlsid.structure.updating import Updated

COLOURS = {"truth": "black", "S1": "#c44e52", "S2": "#4c72b0", "S3": "#55a868"}


def _plots(*shape: int, size: tuple[float, float]) -> tuple[Any, Any]:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(*shape, figsize=size, layout="constrained", squeeze=False)


def _save(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def shapes(path: Path, solid: Solid) -> None:
    """Fig. 4: the ten modes of Table 2 along the middle of the upper face."""
    figure, axes = _plots(5, 2, size=(9, 9))
    points = [f"P{i}" for i in range(1, 13)]
    x = np.asarray(solid.beam.positions)
    rows = solid.structure.rows(points)
    for i, (axis, mode) in enumerate(zip(axes.ravel(), solid.listed, strict=True)):
        shape = rows @ solid.found.shapes[:, mode]
        shape = shape / np.abs(shape).max() * np.sign(shape[np.abs(shape).argmax()])
        axis.plot(1e3 * x, shape, "o-", ms=3, color="#4c72b0")
        axis.axvspan(480, 600, color="0.9")
        axis.axhline(0, color="0.6", lw=0.6)
        axis.set_title(f"{i + 1}: {solid.table[i]:.1f} Hz, paper {TABLE_2[i]:.1f} Hz", fontsize=9)
        axis.set_ylim(-1.15, 1.15)
    for axis in axes[-1]:
        axis.set_xlabel("distance from the left end, mm")
    figure.suptitle("Bending modes at the twelve measured points (lap shaded)", fontsize=11)
    _save(figure, path)


def iterations(path: Path, rom1: Reduced, rom2: Reduced, others: Mapping[str, Reduced]) -> None:
    """Errors of IIRS by iteration, and what every basis loses at the joints."""
    figure, axes = _plots(1, 2, size=(10, 3.8))
    left, right = axes[0]
    for reduced, label in ((rom1, "32 masters (ROM1)"), (rom2, "12 masters (ROM2)")):
        left.semilogy([100 * s.worst for s in reduced.history], "o-", ms=3, label=label)
    left.axhline(1, color="0.6", ls="--", lw=0.8)
    left.set(xlabel="IIRS iteration", ylabel="worst frequency error of ten modes, %")
    left.legend(fontsize=8)
    joints = list(rom1.structure.joints)
    at = [joints.index(n) for n in SLIP[:3]]
    bars = {f"IIRS, iteration {k}": rom1.history[k] for k in (0, 1, len(rom1.history) - 1)} | {r.method: r.history[-1]
                                                                                              for r in others.values()}
    for offset, (place, name) in enumerate(zip(at, ("outer", "inner", "middle"), strict=True)):
        right.barh(np.arange(len(bars)) + 0.25 * (1 - offset), [100 * s.joint_loss[place] for s in bars.values()], 0.24, label=name)
    right.set_yticks(range(len(bars)), list(bars), fontsize=7)
    right.invert_yaxis()
    right.set(xlabel="static flexibility of the joint lost, %")
    right.legend(fontsize=8)
    _save(figure, path)


def updated(path: Path, result: Updated, truth: Array) -> None:
    """Table 5: multipliers with 90 % intervals."""
    figure, axes = _plots(1, 1, size=(7, 3.2))
    axis = axes[0, 0]
    place = np.arange(len(result.names))
    factor = np.exp(1.645 * result.sd)
    axis.errorbar(result.values, place, xerr=[result.values * (1 - 1 / factor), result.values * (factor - 1)], fmt="o", capsize=3,
                  color="#4c72b0", label="updated, 90 %")
    axis.plot(truth, place, "kx", ms=8, label="truth")
    axis.axvline(1, color="0.6", lw=0.8, ls="--")
    axis.set_xscale("log")
    axis.set_yticks(place, list(result.names))
    axis.invert_yaxis()
    axis.set(xlabel="multiplier of the start value")
    axis.legend(fontsize=8)
    _save(figure, path)


def backbones(path: Path, found: Mapping[str, Mapping[str, Any]], checks: Mapping[str, Any]) -> None:
    """Fig. 5: frequency and damping against amplitude, static and memory law."""
    figure, axes = _plots(2, 2, size=(10, 6.6))
    for row, (kind, curves) in zip(axes, found.items(), strict=True):
        for k, (name, bands) in enumerate(curves.items()):
            style = {"lw": 1.6, "ls": ("-", "--", ":", "-.", "-")[k], "label": name}
            row[0].semilogx(1e3 * bands.amplitude, bands.frequency[1], **style)
            row[1].semilogx(1e3 * bands.amplitude, 100 * bands.damping[1], **style)
        check = checks[kind]
        row[0].semilogx(1e3 * check.amplitude, check.frequency, "k.", ms=4, label="plant, integrated")
        row[1].semilogx(1e3 * check.amplitude, 100 * check.damping, "k.", ms=4)
        row[0].set_ylabel(f"{kind} Iwan: frequency, Hz")
        row[1].set_ylabel("damping ratio, %")
    axes[0, 1].set_ylim(0, 0.1)
    axes[1, 1].set_ylim(0, 1.6)
    axes[0, 0].legend(fontsize=7)
    for axis in axes[1]:
        axis.set_xlabel("amplitude of the tip, mm")
    _save(figure, path)


def tests(path: Path, tests_: Any, windows: Mapping[str, tuple[float, float]]) -> None:
    """Fig. 6a: tip displacement of the three tests with the training windows."""
    figure, axes = _plots(3, 1, size=(10, 6.2))
    time = np.arange(len(tests_.tip)) / tests_.rate
    for i, (axis, name) in enumerate(zip(axes[:, 0], ("training", "validation, mode 1", "validation, mode 2"), strict=True)):
        axis.plot(time, 1e3 * tests_.tip[:, i], lw=0.4, color="#4c72b0")
        axis.set_ylabel("tip, mm")
        axis.set_title(f"{name}: {np.abs(tests_.force[:, i]).max():.0f} N", fontsize=9)
        axis.axvline(tests_.seconds, color="0.5", lw=0.8, ls="--")
        axis.set_xlim(0, time[-1])
    for name, (start, stop) in windows.items():
        axes[0, 0].axvspan(start, stop, color="#dd8452", alpha=0.25)
        axes[0, 0].text(start, axes[0, 0].get_ylim()[0] * 0.95, f" {name}", fontsize=8, va="bottom")
    axes[-1, 0].set_xlabel("time, s")
    _save(figure, path)


def sensing(path: Path, tests_: Any, routes: Mapping[str, Any], dt: float, window: tuple[float, float]) -> None:
    """Fig. 6b: force and displacement of an outer and an inner joint, true and reconstructed."""
    figure, axes = _plots(1, 2, size=(10, 4))
    part = slice(round((window[1] - 0.06) / dt), round(window[1] / dt))
    for axis, joint, name in zip(axes[0], (0, 1), ("outer joint 1", "inner joint 2"), strict=True):
        true = tests_.q[part, 0, joint]
        force = 1e-3 * (tests_.g[part, 0, joint] + K_T * true)
        for route, data in routes.items():
            axis.plot(1e6 * data.q[part, joint], force, ".-", ms=2, lw=0.8, label=route)
        axis.plot(1e6 * true, force, "k.", ms=3, label="truth")
        axis.set(xlabel="relative displacement as sensed, µm", ylabel="force at that time, kN", title=name)
    axes[0, 0].legend(fontsize=7)
    _save(figure, path)


def posterior(path: Path, posteriors: Mapping[str, Any]) -> None:
    """Table 4: 90 % intervals of every parameter and joint."""
    figure, axes = _plots(1, 3, size=(11, 3.8))
    for k, (axis, name, truth) in enumerate(zip(axes[0], ("f_s, N", "χ", "β"), (2000.0, -0.5, 0.1), strict=True)):
        for i, (scenario, draws) in enumerate(posteriors.items()):
            low, mid, high = draws.quantiles((0.05, 0.5, 0.95))
            place = np.arange(len(SLIP)) + 0.2 * (i - 1)
            pick = slice(2 + k, None, 3)
            axis.errorbar(mid[pick], place, xerr=[mid[pick] - low[pick], high[pick] - mid[pick]], fmt="o", ms=3, capsize=2,
                          color=COLOURS[scenario], label=scenario)
        axis.axvline(truth, color="black", lw=0.8)
        axis.set_yticks(range(len(SLIP)), [f"joint {j + 1}" for j in range(len(SLIP))])
        axis.invert_yaxis()
        axis.set_xlabel(name)
    axes[0, 0].set_xscale("log")
    axes[0, 2].set_xscale("symlog", linthresh=0.01)
    axes[0, 1].legend(fontsize=8)
    figure.suptitle("90 % intervals; black: truth", fontsize=10)
    _save(figure, path)


def maps(path: Path, tests_: Any, window: slice, found: Mapping[str, tuple[Array, Array]], force: Array) -> None:
    """Fig. 7: nonlinear force of mode 1 against its displacement."""
    figure, axes = _plots(1, 3, size=(11, 3.8))
    for axis, (name, (u, bands)) in zip(axes[0], found.items(), strict=True):
        order = np.argsort(u)
        axis.plot(1e3 * u, force, "k.", ms=1.5, label="truth")
        axis.fill_between(1e3 * u[order], bands[0][order], bands[2][order], color=COLOURS[name], alpha=0.4, lw=0)
        axis.plot(1e3 * u, bands[1], ".", ms=1, color=COLOURS[name], label=f"{name}, 90 %")
        axis.set(xlabel="modal displacement, 10⁻³ kg½ m", title=name)
        axis.legend(fontsize=8, markerscale=4)
    axes[0, 0].set_ylabel("nonlinear modal force, N kg⁻½")
    _save(figure, path)


def band(path: Path, grey: Any, truth: Any, bands: Mapping[str, Any]) -> None:
    """Fig. 8: frequency and damping against amplitude."""
    figure, axes = _plots(1, 2, size=(10.5, 4.2))
    x = 1e3 * grey.amplitude
    for axis, what, scale in ((axes[0, 0], "frequency", 1.0), (axes[0, 1], "damping", 100.0)):
        low, _, high = scale * getattr(grey, what)
        axis.fill_between(x, low, high, color="0.8", label="100 samples, 5 % scatter (90 %)")
        axis.semilogx(x, scale * getattr(truth, what)[1], "k-", lw=1.2, label="truth")
        for name, b in bands.items():
            low, mid, high = scale * getattr(b, what)
            axis.fill_between(x, low, high, color=COLOURS[name], alpha=0.4, lw=0)
            axis.semilogx(x, mid, "--", lw=1.2, color=COLOURS[name], label=f"{name}, posterior")
        axis.set(xlabel="amplitude of the tip, mm")
    axes[0, 0].set_ylabel("frequency, Hz")
    axes[0, 1].set_ylabel("damping ratio, %")
    axes[0, 1].set_ylim(0.045, 0.056)
    axes[0, 0].legend(fontsize=8)
    _save(figure, path)


def selection(path: Path, chosen: Any, number: Mapping[str, int]) -> None:
    """Fig. 9: mean square that each law alone leaves, and the path."""
    figure, axes = _plots(1, 2, size=(11, 3.8))
    left, right = axes[0]
    first = [t for t in chosen.tried if t.round == chosen.tried[0].round and t.action == "add" and np.isfinite(t.mse)]
    left.bar([number[t.element.partition("[")[0]] for t in first], [t.mse for t in first], color="#4c72b0")
    left.set_yscale("log")
    left.axhline(chosen.mse_linear, color="0.5", ls="--", lw=0.8)
    left.set(xlabel="law of Table 1", ylabel="weighted mean square", title="first forward round (dashed: linear model)")
    steps = [("linear", chosen.mse_linear), *((f"{p.action} {p.element.partition('[')[0]}{'' if p.accepted else ' (refused)'}", p.mse)
                                               for p in chosen.path)]
    right.semilogy(range(len(steps)), [v for _, v in steps], "o-", color="#c44e52")
    right.set_xticks(range(len(steps)), [n for n, _ in steps], rotation=20, fontsize=8)
    right.set_title("path")
    _save(figure, path)


def validation(path: Path, shown: Mapping[tuple[str, str], Any]) -> None:
    """Fig. 10: acceleration of the tip near the largest response, measured and 90 % bands."""
    records = list(dict.fromkeys(record for record, _ in shown))
    scenarios = list(dict.fromkeys(name for _, name in shown))
    figure, axes = _plots(len(records), len(scenarios), size=(12, 5.6))
    for row, record in zip(axes, records, strict=True):
        for axis, name in zip(row, scenarios, strict=True):
            judged = shown[record, name]
            tip = judged.measured[:, -1]
            start = max(0, int(np.abs(tip).argmax()) - 100)
            part = slice(start, start + 200)
            axis.fill_between(judged.time[part], judged.q05[part, -1], judged.q95[part, -1], color=COLOURS[name], alpha=0.5, lw=0)
            axis.plot(judged.time[part], judged.q50[part, -1], color=COLOURS[name], lw=1, label=name)
            axis.plot(judged.time[part], tip[part], "k.", ms=2, label="measured")
            axis.set_title(f"{record}: {name}, error {100 * judged.nrmse:.1f} %, coverage {100 * judged.coverage90:.0f} %", fontsize=8)
            axis.tick_params(labelsize=7)
        row[0].set_ylabel("tip, m/s²")
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    axes[0, 0].legend(fontsize=7)
    _save(figure, path)


def responses(path: Path, found: Mapping[int, Any]) -> None:
    """Fig. 16 in kind: response curves of the truth over draws of the posterior."""
    figure, axes = _plots(1, 2, size=(11, 4.4))
    for axis, (mode, (truth, sampled)) in zip(axes[0], found.items(), strict=True):
        for curves in sampled:
            for curve in curves:
                axis.semilogy(curve.frequency, 1e3 * curve.largest("P12"), color=COLOURS["S3"], lw=0.5, alpha=0.6)
        for curve in truth:
            axis.semilogy(curve.frequency, 1e3 * curve.largest("P12"), "k-", lw=0.9)
            f, a = curve.peak("P12")
            axis.annotate(f"{curve.level:g} N", (f, 1e3 * a), fontsize=7, ha="right")
        axis.set(xlabel="frequency, Hz", ylabel="tip, mm", title=f"mode {mode}: truth (black), draws of S3 (green)")
    _save(figure, path)
