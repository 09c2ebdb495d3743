"""Fit the odds of diagnoses of recordings of any kind on simulated cases; the numbers go into ``mismatch/odds.py``.

The logarithm of every number moves with a prior of its own about the value set by hand, so that few cases move it little.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from studies.any_recording.score import NO_PHYSICS

from bayes_nlsid.mismatch.odds import LAYER, Findings, OddsLayer, findings_from, odds_of

MOVED = ("least", "part", "surety", "seen", "blind", "shown", "scale", "share", "power", "useless", "floor", "along", "second", "beside",
         "proof", "unexplained", "withdrawn")
PRIOR_SD = 0.5
LEAST = 0.01   # a probability below it counts as this


def gather(results: Path, answers: Path) -> list[tuple[Findings, str]]:
    """Findings and true class of all cases that have both."""
    out = []
    for file in sorted(results.glob("*/scores.json")):
        sheet, stored = answers / f"{file.parent.name}.json", json.loads(file.read_text())
        if sheet.exists() and "singles" in stored:
            out.append((findings_from(stored), str(json.loads(sheet.read_text())["class"])))
    return out


def chance(findings: Findings, truth: str, layer: OddsLayer) -> float:
    """Probability given to the true class at any place; of nothing, where no law is missing."""
    odds = odds_of(findings, layer)
    if truth in NO_PHYSICS:
        return odds[()] + sum(p for key, p in odds.items() if truth != "none" and len(key) == 1 and key[0][0] == truth)
    return sum(p for key, p in odds.items() if len(key) == 1 and key[0][0] == truth)


def log_loss(cases: list[tuple[Findings, str]], layer: OddsLayer) -> float:
    """Mean of −log of the probability of the truth."""
    return float(np.mean([-np.log(max(chance(f, truth, layer), LEAST)) for f, truth in cases]))


def moved(x: NDArray[np.float64]) -> OddsLayer:
    """The layer with its numbers multiplied by exp(x)."""
    values = {name: getattr(LAYER, name) * float(np.exp(v)) for name, v in zip(MOVED, x, strict=True)}
    return replace(LAYER, **{**values, "blind": min(values["blind"], 1.0)})


def fit(cases: list[tuple[Findings, str]]) -> OddsLayer:
    """Largest posterior of the numbers."""
    def cost(x: NDArray[np.float64]) -> float:
        return log_loss(cases, moved(x)) * len(cases) + 0.5 * float(np.sum((x / PRIOR_SD) ** 2))

    found = minimize(cost, np.zeros(len(MOVED)), method="Powell", options={"maxfev": 3000, "xtol": 0.02, "ftol": 1e-4})
    return moved(found.x)


def refit(results: Path, answers: Path, folds: int = 5) -> OddsLayer:
    """Fit on all cases and print the numbers, with the log loss before, after, and on cases left out."""
    cases = gather(results, answers)
    left = []
    for k in range(folds):
        layer = fit([c for i, c in enumerate(cases) if i % folds != k])
        left.append(log_loss([c for i, c in enumerate(cases) if i % folds == k], layer))
    layer = fit(cases)
    print(f"{len(cases)} cases: log loss {log_loss(cases, LAYER):.3f} before, {log_loss(cases, layer):.3f} fitted, "
          f"{np.mean(left):.3f} on cases left out")
    for name in MOVED:
        print(f"    {name}: float = {getattr(layer, name):.3g}")
    return layer
