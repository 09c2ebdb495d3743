"""Probabilities of hypotheses from held-out differences between blocks of time.

What a wrong model leaves over is model error, not noise, so likelihood ratios are no probabilities (they run to thousands of nats). A
hypothesis is held against its best rival by the difference of their block scores measured in its own standard error over blocks, and
the odds fall with a power of that ratio, not exponentially: a difference that every block shares counts, one that rests on few blocks
does not. The numbers were set by hand; nothing has calibrated them yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.weigh import Weighed, spread

Key = tuple[tuple[str, str], ...]
OTHER: Key = (("other", "-"),)


@final
@dataclass(frozen=True)
class OddsLayer:
    """The numbers of this layer.

    Parameters
    ----------
    least : float
        Nats below which a gain is taken for chance.
    part : float
        Share of the independent values, in nats, that is taken for error of the linear model.
    scale, share, power : float
        Odds against a rival: (1 + difference / (scale + standard error + share · best gain)) ** −power.
    second : float
        Share of the gain of one effect that a second must add to be as likely as not.
    unexplained, width : float
        Share of the error on held-out records left unexplained at which ``other`` is as likely as the best law, and how sharply.
    """

    least: float = 12.0
    part: float = 0.001
    scale: float = 3.0
    share: float = 0.02
    power: float = 2.5
    second: float = 0.04
    unexplained: float = 0.65
    width: float = 0.08


LAYER = OddsLayer()


def rises(value: float, middle: float, steepness: float) -> float:
    """Logistic in the logarithm of a positive value; 1/2 at ``middle``."""
    return float(1 / (1 + np.exp(-np.clip(steepness * np.log(max(value, 1e-9) / max(middle, 1e-9)), -60, 60))))


def something(best: Weighed | None, values: float, layer: OddsLayer = LAYER) -> float:
    """Probability that anything at all is missing from the linear model.

    Parameters
    ----------
    best : Weighed or None
        The best hypothesis.
    values : float
        Independent values on the bench.
    """
    if best is None or best.gain <= 0:
        return 0.02
    size = rises(best.gain, layer.least + layer.part * values, 3.0)
    surety = rises(best.gain / (best.error + 2.0), 2.2, 4.0)
    return float(np.clip(size * surety, 0.0, 0.9995))


def two(singles: Sequence[Weighed], pairs: Sequence[Weighed], layer: OddsLayer = LAYER) -> float:
    """Probability that two effects act, given that something does."""
    if not pairs or not singles:
        return 0.0
    best, pair = singles[0], pairs[0]
    more = pair.gain - best.gain
    if more <= 0:
        return 0.0
    error = spread(pair.blocks - best.blocks)
    return rises(more, 15.0 + layer.second * best.gain, 2.5) * rises(more / (error + 2.0), 2.2, 4.0)


def odds_of(singles: Sequence[Weighed], pairs: Sequence[Weighed], values: float, unexplained: float = 0.0,
            proof: float = 0.0, tilt: Mapping[Key, float] | None = None, second: float = 1.0, layer: OddsLayer = LAYER
            ) -> dict[Key, float]:
    """Probability of every hypothesis, of none (empty key) and of something outside the catalogue; they sum to one.

    Parameters
    ----------
    singles, pairs : sequences of Weighed, best first
    values : float
        Independent values on the bench.
    unexplained : float
        Share of the error energy of the best linear model, noise apart, that the best hypothesis leaves on records not fitted.
    proof : float
        Probability that something is missing from what simulation of whole records shows.
    tilt : mapping or None
        Factors on the odds of hypotheses that were simulated.
    second : float
        Factor on the probability of two effects, from simulation.
    """
    leaders = [w for group in (pairs[:1], singles[:1]) for w in group]
    best = max(leaders, key=lambda w: w.gain) if leaders else None
    missing = 1 - (1 - something(best, values, layer)) * (1 - min(proof, 0.9995))
    double = second * two(singles, pairs, layer)
    weights: dict[Key, float] = {}
    for group, share in ((singles, 1 - double), (pairs, double)):
        raw = {key: value * (tilt or {}).get(key, 1.0) for key, value in _raw(group, layer).items()}
        total = sum(raw.values())
        for key, value in raw.items():
            weights[key] = weights.get(key, 0.0) + share * value / total
    strange = float(1 / (1 + np.exp(-(unexplained - layer.unexplained) / layer.width)))
    strange = max(strange, 0.01)
    out: dict[Key, float] = {(): 1 - missing, OTHER: missing * strange}
    for key, value in weights.items():
        out[key] = missing * (1 - strange) * value
    total = sum(out.values())
    return {key: value / total for key, value in sorted(out.items(), key=lambda kv: -kv[1])}


def _raw(group: Sequence[Weighed], layer: OddsLayer) -> dict[Key, float]:
    if not group:
        return {}
    best = group[0]
    out: dict[Key, float] = {}
    for w in group:
        prior = float(np.prod([ROWS[cls].prior for cls, _ in w.key]))
        against = max(best.gain - w.gain, 0.0) / (layer.scale + spread(best.blocks - w.blocks) + layer.share * max(best.gain, 0.0))
        out[w.key] = max(out.get(w.key, 0.0), prior * (1 + against) ** -layer.power)
    return out
