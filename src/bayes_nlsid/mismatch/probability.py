"""From scores to probabilities: a small layer whose numbers are fitted on simulated cases.

Differences of −2 log likelihood between hypotheses run to thousands because what is left over is model error, not noise; taken at face
value they would always name one class with certainty. The layer therefore lets odds fall with a power of the difference measured
against the leftover, and lets the odds of anything at all rise with the logarithm of the gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.catalogue import ROWS

Array = NDArray[np.float64]
Key = tuple[tuple[str, str], ...]


@final
@dataclass(frozen=True)
class Layer:
    """The numbers of the layer, all positive but ``slope_other``.

    Parameters
    ----------
    threshold, steepness : float
        Gain at which something is as likely as nothing, and how fast the odds rise with its logarithm (coherent effects).
    scale, share, power : float
        Odds against a rival: (1 + difference / (scale + share * best gain)) ** −power.
    threshold_second, steepness_second : float
        The same as the first two for a second effect on top of a first.
    other_at, other_width : float
        Share of the distortion above noise left unexplained at which ``other`` is as likely as the best law, and how sharply.
    provenance : str
    """

    threshold: float = 45.0
    steepness: float = 3.0
    scale: float = 12.0
    share: float = 0.01
    power: float = 1.5
    threshold_second: float = 150.0
    steepness_second: float = 2.0
    other_at: float = 0.45
    other_width: float = 0.08
    provenance: str = "set by hand before any fit"

    def numbers(self) -> Array:
        """The fitted numbers as a vector."""
        return np.array(astuple(self)[:-1], dtype=float)


@final
@dataclass(frozen=True)
class Score:
    """What the layer needs to know of one hypothesis.

    Parameters
    ----------
    key : tuple of (class, place)
        Sorted; empty for ``none``.
    gain : float
        Decrease of −2 log likelihood against ``none``, charges for parameters included.
    alone : float
        For a pair, the gain of the better of its members alone; else 0.
    strength : float
        What its smallest effect changes, relative to the response; NaN if unknown.
    visible : float
        What it changes that nothing simpler does, relative to the response.
    rest : float
        Leftover −2 log likelihood beyond its expectation.
    held : float
        Logarithm of the squared error on records that were not fitted over that of noise; NaN if not run.
    """

    key: Key
    gain: float
    alone: float = 0.0
    strength: float = float("nan")
    visible: float = float("nan")
    rest: float = 0.0
    held: float = float("nan")


@final
@dataclass(frozen=True)
class Scores:
    """All hypotheses of a case.

    ``unexplained``: share of the distortion above noise that the best hypothesis leaves (0 if there is none).
    ``dispersion``: leftover chi² per degree of freedom of the best hypothesis; ``linear``: the same of its transfer function alone;
    ``held``: of the calibrated linear model on records not fitted, as ``Score.held``.
    """

    items: tuple[Score, ...]
    unexplained: float = 0.0
    dispersion: float = 1.0
    linear: float = 1.0
    held: float = float("nan")


SHIPPED = Layer()


def sigmoid(x: float) -> float:
    """1/(1 + exp(−x)), safe for any x."""
    return float(1 / (1 + np.exp(-np.clip(x, -700, 700))))


def probabilities(scores: Scores, layer: Layer = SHIPPED) -> dict[Key, float]:
    """Probability of every hypothesis, of ``none`` (the empty key) and of ``other`` (key (("other", "-"),) unless scored itself).

    They sum to one.
    """
    items = [i for i in scores.items if i.key]
    out: dict[Key, float] = {(): 1.0}
    if not items:
        return out
    best = max(i.gain for i in items)
    dispersion = max(scores.dispersion, 1.0)
    something = _rises(best / dispersion ** 0.5, layer.threshold, layer.steepness)
    scale = layer.scale * dispersion + layer.share * max(best, 0.0)
    weights: dict[Key, float] = {}
    double = _double(items, dispersion, layer)
    for many in (False, True):
        group = [i for i in items if (len(i.key) > 1) == many]
        if not group:
            continue
        top = max(i.gain for i in group)
        raw: dict[Key, float] = {}
        for item in group:
            prior = float(np.prod([ROWS[cls].prior if cls in ROWS else 1.0 for cls, _ in item.key]))
            raw[item.key] = max(raw.get(item.key, 0.0), prior * (1 + (top - item.gain) / scale) ** -layer.power)
        share = double if many else 1 - double
        for key, value in raw.items():
            weights[key] = share * value / sum(raw.values())
    strange: Key = (("other", "-"),)
    odds = sigmoid((scores.unexplained - layer.other_at) / layer.other_width)
    weights[strange] = weights.get(strange, 0.0) + max(max(weights.values()) * odds / max(1 - odds, 1e-3), 1e-4 * max(weights.values()))
    total = sum(weights.values())
    out[()] = 1 - something
    for key, weight in weights.items():
        out[key] = something * weight / total
    norm = sum(out.values())
    return {key: value / norm for key, value in sorted(out.items(), key=lambda kv: -kv[1])}


def _double(items: list[Score], dispersion: float, layer: Layer) -> float:
    """Probability that two effects act rather than one: from what the best pair gains over the better of its members alone."""
    pairs = [i for i in items if len(i.key) > 1]
    if not pairs:
        return 0.0
    if all(len(i.key) > 1 for i in items):
        return 1.0
    best = max(pairs, key=lambda i: i.gain)
    return _rises((best.gain - best.alone) / dispersion, layer.threshold_second, layer.steepness_second)


def _rises(gain: float, threshold: float, steepness: float) -> float:
    return sigmoid(steepness * np.log(max(gain, 1e-3) / threshold))


def fit_layer(scores: Sequence[Scores], truths: Sequence[Key], start: Layer = SHIPPED, provenance: str = "") -> Layer:
    """Numbers that make the log loss over cases smallest (with a weak pull towards ``start``).

    Parameters
    ----------
    truths : the true key of each case, empty for none; a truth that was not scored counts as ``other``.
    """
    from scipy.optimize import minimize

    origin = np.log(start.numbers())

    def loss(x: Array) -> float:
        layer = Layer(*np.exp(np.clip(x, -12, 12)).tolist())
        total = 0.0
        for one, truth in zip(scores, truths, strict=True):
            found = probabilities(one, layer)
            key = tuple(sorted(truth))
            p = found.get(key, found.get((("other", "-"),), 0.0) * 0.5)
            total -= np.log(max(p, 1e-6))
        return total + 0.05 * float(((x - origin) ** 2).sum())

    best = minimize(loss, origin, method="Nelder-Mead", options={"maxiter": 1500, "xatol": 0.02, "fatol": 0.02})
    return replace(Layer(*np.exp(best.x).tolist()), provenance=provenance or f"fitted on {len(truths)} simulated cases")
