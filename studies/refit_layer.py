"""Fit the layer from scores to probabilities on simulated cases with known answers; the weights go into ``mismatch/probability.py``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from bayes_nlsid.mismatch.probability import FEATURES, SHIPPED, Key, Layer, Scores, classes_of, fit_layer, probabilities, scores_from

FLOOR = 1e-4  # a probability below this counts as this


def gather(results: Path, answers: Path) -> tuple[list[Scores], list[Key]]:
    """Scores and true keys of all cases that have both; what is outside the catalogue is of class ``other``."""
    scores, truths = [], []
    for file in sorted(results.glob("*/scores.json")):
        sheet = answers / f"{file.parent.name}.json"
        if sheet.exists():
            effects = json.loads(sheet.read_text())["effects"]
            scores.append(scores_from(json.loads(file.read_text())))
            truths.append(tuple(sorted((e["cls"], e["loc"]) for e in effects)))
    return scores, truths


def log_loss(layer: Layer, scores: list[Scores], truths: list[Key]) -> float:
    """Mean of −log p of the true classes, at whatever place."""
    total = 0.0
    for one, truth in zip(scores, truths, strict=True):
        p = sum(x for key, x in probabilities(one, layer).items() if classes_of(key) == classes_of(truth))
        total -= float(np.log(max(p, FLOOR)))
    return total / max(len(scores), 1)


def refit(results: list[Path], answers: list[Path], spread: float = 1.0, folds: int = 5) -> Layer:
    """Fit on all cases and print the weights, with the log loss on cases left out."""
    scores: list[Scores] = []
    truths: list[Key] = []
    for result, answer in zip(results, answers, strict=True):
        more = gather(result, answer)
        scores, truths = scores + more[0], truths + more[1]
    left_out = []
    for k in range(folds):
        keep = [i for i in range(len(scores)) if i % folds != k]
        test = [i for i in range(len(scores)) if i % folds == k]
        layer = fit_layer([scores[i] for i in keep], [truths[i] for i in keep], SHIPPED, "", spread)
        left_out += [log_loss(layer, [scores[i]], [truths[i]]) for i in test]
    final = fit_layer(scores, truths, SHIPPED, f"fitted on {len(truths)} simulated cases", spread)
    print(f"{len(truths)} cases; log loss as shipped {log_loss(SHIPPED, scores, truths):.3f}, on cases left out {np.mean(left_out):.3f}, "
          f"on all {log_loss(final, scores, truths):.3f}")
    print(", ".join(f"{name.replace(' ', '_')}={weight:.3f}" for name, weight in zip(FEATURES, final.weights, strict=True)))
    return final


def main() -> None:
    """``python -m studies.refit_layer --results DIR… --answers DIR…``."""
    parser = argparse.ArgumentParser(prog="python -m studies.refit_layer", description=__doc__)
    parser.add_argument("--results", type=Path, required=True, nargs="+")
    parser.add_argument("--answers", type=Path, required=True, nargs="+")
    parser.add_argument("--spread", type=float, default=1.0, help="standard deviation of the weights around those shipped")
    options = parser.parse_args()
    refit(options.results, options.answers, options.spread)


if __name__ == "__main__":
    main()
