"""Diagnoses against answers: false alarms, power, classes, places, calibration of the probabilities, errors before and after."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

NO_PHYSICS = ("none", "force_delay", "sensor_gain")
"""Nothing nonlinear is missing: a linear model, or a gain or delay, may explain all."""


@dataclass(frozen=True)
class Row:
    """One case: its answer and what the tool said."""

    answer: dict[str, Any]
    said: dict[str, Any]

    @property
    def p(self) -> float:
        return float(self.said["p_mismatch"])

    @property
    def truth(self) -> str:
        return str(self.answer["class"])

    @property
    def top(self) -> tuple[tuple[str, ...], str]:
        """Classes and first place of the likeliest explanation that is one."""
        effects = next(h["effects"] for h in self.said["hypotheses"] if h["effects"][0]["class"] != "none")
        return tuple(e["class"] for e in effects), str(effects[0]["location"])

    def of_classes(self) -> dict[tuple[str, ...], float]:
        """Probability by classes, places added up."""
        out: dict[tuple[str, ...], float] = {}
        for h in self.said["hypotheses"]:
            key = tuple(sorted(e["class"] for e in h["effects"]))
            out[key] = out.get(key, 0.0) + float(h["probability"])
        return out


def gather(results: Path, answers: Path) -> list[Row]:
    """All cases that have an answer and a diagnosis."""
    rows = []
    for file in sorted(results.glob("*/diagnosis.json")):
        sheet, said = answers / f"{file.parent.name}.json", json.loads(file.read_text())
        if sheet.exists() and "hypotheses" in said:
            rows.append(Row(json.loads(sheet.read_text()), said))
    return rows


def share(values: list[bool]) -> str:
    """Count and percentage."""
    return f"{sum(values)} of {len(values)}" + (f" ({100 * np.mean(values):.0f} %)" if values else "")


def median(values: list[float]) -> str:
    return f"{100 * float(np.median(values)):.3g} %" if values else "–"


def table(rows: list[Row]) -> str:
    """Markdown."""
    null = [r for r in rows if r.truth in NO_PHYSICS]
    real = [r for r in rows if r.truth not in NO_PHYSICS]
    found = [r for r in real if r.p > 0.5]
    lines = ["| what | measured |", "|---|---|",
             f"| false alarms at p > 0.5 (nothing missing, or a gain or delay) | {share([r.p > 0.5 for r in null])} |",
             f"| a force law named there with more than 50 % | {share([_law(r) for r in null])} |"]
    for low, high, words in ((0.0, 0.05, "3 %"), (0.05, 0.2, "10 %"), (0.2, 9.0, "30 %")):
        some = [r for r in real if low <= float(r.answer["strength"]) < high]
        lines.append(f"| found at p > 0.5, effects of about {words} | {share([r.p > 0.5 for r in some])} |")
        lines.append(f"| class right among those found, about {words} | {share([r.top[0] == (r.truth,) for r in some if r.p > 0.5])} |")
    right = [r for r in found if r.top[0] == (r.truth,)]
    many = [r for r in right if int(r.answer["masses"]) > 1]
    lines.append(f"| place right among those, more than one place | {share([r.top[1] == r.answer['location'] for r in many])} |")
    confidence = [max(r.of_classes().items(), key=lambda kv: kv[1]) for r in rows]
    hits = [key == (r.truth,) or (key == ("none",) and r.truth in NO_PHYSICS) for (key, _), r in zip(confidence, rows, strict=True)]
    p = np.array([value for _, value in confidence])
    for low, high in ((0.0, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        inside = (p >= low) & (p < high)
        if inside.any():
            lines.append(f"| stated {100 * low:.0f}–{min(100.0, 100 * high):.0f} %, mean {100 * p[inside].mean():.0f} %: right | "
                         f"{share([h for h, i in zip(hits, inside, strict=True) if i])} |")
    held = [r.said["heldout"] for r in right]
    for key, words in (("nrmse_updated_linear", "re-tuned"), ("nrmse_extended", "with what was found"), ("noise_floor", "noise")):
        known = [h[key] for h in held if h[key] is not None]
        lines.append(f"| error on records not fitted, class right, median: {words} | {median(known)} |")
    worse = [h["nrmse_extended"] > 1.02 * h["nrmse_updated_linear"] for h in (r.said["heldout"] for r in rows)
             if h["nrmse_extended"] is not None and h["nrmse_updated_linear"] is not None]
    lines.append(f"| made worse by more than 2 % | {share(worse)} |")
    lines.append(f"| seconds per case, median | {np.median([float(r.said['seconds']) for r in rows]):.1f} |")
    return "\n".join(lines) + "\n"


def _law(r: Row) -> bool:
    classes, _ = r.top
    laws = ("hardening", "softening", "clearance", "asymmetric", "coulomb", "quad_damping", "hysteresis")
    return any(c in laws for c in classes) and r.of_classes().get(tuple(sorted(classes)), 0.0) > 0.5
