"""Every figure of the study; the only place here that draws."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from studies.virtual_beam.beam import SLIP, TABLE_2, Array, Solid

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
