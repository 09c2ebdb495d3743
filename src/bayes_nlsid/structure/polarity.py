"""Channels whose sign, or whose place, disagrees with the model over the modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.structure.identified import IdentifiedModes, pair
from bayes_nlsid.structure.modal import ModalModel

SHAPE_ERROR = 0.15
"""Standard deviation of a model shape, relative to its largest entry: joints and sensor positions are never quite right."""
INVERTED_PRIOR, SWAPPED_PRIOR = 0.02, 0.005
"""Prior probability that one channel is inverted, that one pair of cables is swapped."""
DEGREES = 4.0
"""Degrees of freedom of the heavy-tailed misfit, so that one bad entry cannot decide alone."""
CERTAIN = 0.9
"""Posterior probability from which a finding is reported."""
MOST_CHANNELS = 10
"""Up to so many channels every pattern of signs is tried; above, up to three inverted ones."""


@final
@dataclass(frozen=True)
class PolarityFinding:
    """A channel that disagrees with the model.

    Parameters
    ----------
    channel : str
    kind : {"inverted", "swapped", "scaled"}
    confidence : float
        Posterior probability among the alternatives tried; with a measured force, correlation with the computed response.
    sentence : str
        What a person would say.
    other : str
        The channel it is swapped with, else empty.
    """

    channel: str
    kind: Literal["inverted", "swapped", "scaled"]
    confidence: float
    sentence: str
    other: str = ""


@final
@dataclass(frozen=True)
class _Pattern:
    signs: tuple[int, ...]
    order: tuple[int, ...]
    prior: float  # log


def polarity(modes: IdentifiedModes, model: ModalModel) -> tuple[PolarityFinding, ...]:
    """Which channels seem inverted or swapped.

    For every pattern of signs, and every swap of two channels, each measured shape is fitted by the model's with a free factor; the
    misfits, in units of the shape's uncertainty and `SHAPE_ERROR` of its largest entry, give the posterior of the patterns. A channel near
    a node hardly moves the misfit and so carries little weight. Without a measured force only relative signs exist: a set of channels and
    its complement are the same finding, and the smaller is named.

    Parameters
    ----------
    modes : IdentifiedModes
    model : ModalModel
        Nominal; shapes need to be right in sign only.

    Returns
    -------
    tuple of PolarityFinding
        Empty when nothing stands out with probability `CERTAIN`.
    """
    pairs = pair_by_frequency(modes, model)
    count = len(modes.channels)
    if count < 2 or not pairs:
        return ()
    measured = [(modes.shapes[:, i], modes.shapes_sd[:, i], model.rows(modes.locations)[:, k],
                 _force_sign(modes, model, k)) for i, k in pairs]
    patterns = _patterns(count, modes.signed)
    score = np.array([p.prior + sum(_fit(p, *mode) for mode in measured) for p in patterns])
    probability = np.exp(score - score.max())
    probability /= probability.sum()
    best = patterns[int(np.argmax(probability))]
    findings = list(_swapped(modes, best, patterns, probability))
    for c in range(count):
        chance = float(sum(q for p, q in zip(patterns, probability, strict=True) if p.signs[c] < 0))
        if best.signs[c] < 0 and chance >= CERTAIN:
            findings.append(_inverted(modes, c, best, chance, len(pairs)))
    return tuple(findings)


def pair_by_frequency(modes: IdentifiedModes, model: ModalModel) -> tuple[tuple[int, int], ...]:
    """Pairs (measured, model) that do not lean on signs, which are in question: the modes that were looked for, else the nearest."""
    return tuple(enumerate(modes.nominal)) if max(modes.nominal, default=-1) < model.modes and modes.nominal else pair(modes, model)


def _force_sign(modes: IdentifiedModes, model: ModalModel, k: int) -> float:
    """Sign of the model shape at the force, 0 where it is not known or too near a node to count."""
    if not modes.signed or len(model.inputs) != 1:
        return 0.0
    at, largest = float(model.rows(model.inputs)[0, k]), float(np.abs(model.shapes[:, k]).max())
    return float(np.sign(at)) if abs(at) > SHAPE_ERROR * largest else 0.0


def _patterns(count: int, signed: bool) -> list[_Pattern]:
    """Every combination tried, with its log prior; of a set of signs and its complement only the smaller, unless a force fixes signs."""
    most = count if signed else count // 2
    most = most if count <= MOST_CHANNELS else min(most, 3)
    straight = tuple(range(count))
    flip, keep = np.log(INVERTED_PRIOR), np.log1p(-INVERTED_PRIOR)
    out = []
    for size in range(most + 1):
        for chosen in combinations(range(count), size):
            signs = tuple(-1 if c in chosen else 1 for c in range(count))
            out.append(_Pattern(signs, straight, size * flip + (count - size) * keep))
    for a, b in combinations(range(count), 2):
        order = tuple(b if c == a else a if c == b else c for c in range(count))
        out.append(_Pattern((1,) * count, order, np.log(SWAPPED_PRIOR) + count * keep))
    return out


def _fit(pattern: _Pattern, shape: NDArray[np.float64], sd: NDArray[np.float64], model: NDArray[np.float64], force: float) -> float:
    """Log-likelihood of a measured shape under a pattern, factor free (its sign too, unless a force fixes it), heavy-tailed."""
    if not np.abs(model).max() > 0:
        return 0.0
    reference = (np.array(pattern.signs) * model)[list(pattern.order)]
    reference = reference / np.abs(reference).max()
    # The model's error scales with the factor; with the largest measured entry 1 the factor is near 1.
    spread = np.hypot(sd, SHAPE_ERROR * np.abs(shape).max())
    factor = float(np.sum(shape * reference / spread**2) / np.sum(reference**2 / spread**2))
    if force:
        factor = force * abs(factor)
    miss = (shape - factor * reference) / spread
    return float(-0.5 * (DEGREES + 1) * np.sum(np.log1p(miss**2 / DEGREES)))


def _inverted(modes: IdentifiedModes, c: int, best: _Pattern, chance: float, count: int) -> PolarityFinding:
    name = modes.channels[c]
    others = [n for n, s in zip(modes.channels, best.signs, strict=True) if s > 0]
    if modes.signed:
        text = f"{name} moves against the model over {count} modes, with the measured force as reference: it is mounted the other way round"
    else:
        text = (f"{name} moves against the model relative to {', '.join(others)} over {count} modes: either it is mounted the other way "
                f"round or {'all of them are' if len(others) > 1 else 'the other is'}; no measured force tells which")
    return PolarityFinding(name, "inverted", chance, text)


def _swapped(modes: IdentifiedModes, best: _Pattern, patterns: Sequence[_Pattern],
             probability: NDArray[np.float64]) -> tuple[PolarityFinding, ...]:
    straight = tuple(range(len(best.order)))
    if best.order == straight:
        return ()
    chance = float(sum(q for p, q in zip(patterns, probability, strict=True) if p.order == best.order))
    a, b = (modes.channels[c] for c in straight if best.order[c] != c)
    if chance < CERTAIN:
        return ()
    return (PolarityFinding(a, "swapped", chance, f"{a} and {b} look swapped: with their places exchanged the modes fit the model", b),)
