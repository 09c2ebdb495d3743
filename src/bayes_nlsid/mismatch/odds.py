"""Probabilities of hypotheses from held-out differences between blocks of time.

What a wrong model leaves over is model error, not noise, so likelihood ratios are no probabilities (they run to thousands of nats). A
hypothesis is held against its best rival by the difference of their block scores measured in its own standard error over blocks, and
the odds fall with a power of that ratio, not exponentially: a difference that every block shares counts, one that rests on few blocks
does not. The numbers of the layer were set by hand and four of them (least, surety, along, unexplained) moved part of the way to where 50
simulated recordings with known answers put them (``studies/any_recording``): all the way, cases left out gain nothing. Everything that they
are applied to is in `Findings`, which is stored beside every answer so that they can be fitted anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, final

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
    surety : float
        Gain over its standard error at which it is as likely as not.
    seen, blind : float
        Lead of the best simulated rival over the linear model, in its error, at which the bench is believed; share of belief without.
    shown : float
        The same lead at which simulation alone makes it as likely as not that something is missing.
    scale, share, power : float
        Odds against a rival: (1 + difference / (scale + standard error + share · best gain)) ** −power.
    useless : float
        Factor on what gains nothing on the bench.
    floor, along : float
        Odds against a simulated rival: (1 + mean difference of logarithms / (floor + standard error)) ** −along.
    second, beside : float
        Share of the gain of one effect that a second must add to be as likely as not; and its lead in simulation.
    proof : float
        Ratio of errors on records not fitted from which something is missing whatever the bench says.
    unexplained, width : float
        Share of the error on held-out records left unexplained at which ``other`` is as likely as the best law, and how sharply.
    withdrawn : float
        Factor on the odds of what made records that were not used worse.
    """

    least: float = 10.0
    part: float = 0.001
    surety: float = 1.7
    seen: float = 0.5
    blind: float = 0.5
    shown: float = 4.0
    scale: float = 3.0
    share: float = 0.02
    power: float = 2.5
    useless: float = 0.2
    floor: float = 0.1
    along: float = 3.0
    second: float = 0.04
    beside: float = 1.5
    proof: float = 1.4
    unexplained: float = 0.9
    width: float = 0.08
    withdrawn: float = 0.1


LAYER = OddsLayer()


@final
@dataclass(frozen=True)
class Candidate:
    """One hypothesis as the odds see it: gain on the bench, and standard error of its difference to the best of its kind (nats)."""

    key: Key
    gain: float
    behind: float


@final
@dataclass(frozen=True)
class Findings:
    """All that the odds are made from.

    Parameters
    ----------
    singles, pairs : tuple of Candidate, best first
    values : float
        Independent values on the bench.
    error : float
        Standard error of the best gain.
    more, more_error : float
        What the best pair gains beyond the best single effect, nats; 0 without pairs.
    simulated : dict of Key to (float, float)
        For hypotheses that were simulated: mean difference of logarithmic block errors to the best of them, and its standard error; inf if
        the simulation failed.
    lead : float
        Lead of the best simulated hypothesis over the linear model on the fitted records, see `contest.ahead`; nan if none was simulated.
    beside : float
        Lead of the best simulated pair over the better of its members; nan if none was.
    judged : (float, float)
        Mean decrease of logarithmic block errors on records not fitted, and its standard error; zeros if nothing is claimed.
    unexplained : float
        Share of the error energy of the best linear model, noise apart, that the claimed hypothesis leaves on records not fitted.
    left, noise : float
        Error of the model that is reported, and sensor noise, on records not fitted, over their rms.
    withdrawn : tuple of Key
        What made records that were not used worse.
    """

    singles: tuple[Candidate, ...]
    pairs: tuple[Candidate, ...]
    values: float
    error: float = 0.0
    more: float = 0.0
    more_error: float = 0.0
    simulated: tuple[tuple[Key, float, float], ...] = ()
    lead: float = float("nan")
    beside: float = float("nan")
    judged: tuple[float, float] = (0.0, 0.0)
    unexplained: float = 0.0
    left: float = float("nan")
    noise: float = float("nan")
    withdrawn: tuple[Key, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """For a file."""
        return asdict(self)


def findings_from(stored: Mapping[str, Any]) -> Findings:
    """Findings as they were stored; null stands for what is not finite."""
    def key(raw: Any) -> Key:
        return tuple((str(c), str(p)) for c, p in raw)

    def number(raw: Any, empty: float = float("nan")) -> float:
        return empty if raw is None else float(raw)

    def group(raw: Any) -> tuple[Candidate, ...]:
        return tuple(Candidate(key(c["key"]), float(c["gain"]), float(c["behind"])) for c in raw)

    simulated = tuple((key(k), number(a, np.inf), number(b, 0.0)) for k, a, b in stored["simulated"])
    judged = (number(stored["judged"][0]), number(stored["judged"][1]))
    single = ("error", "more", "more_error", "lead", "beside", "unexplained", "left", "noise")
    return Findings(group(stored["singles"]), group(stored["pairs"]), float(stored["values"]), simulated=simulated, judged=judged,
                    withdrawn=tuple(key(k) for k in stored["withdrawn"]), **{name: number(stored[name]) for name in single})


def bench_findings(singles: Sequence[Weighed], pairs: Sequence[Weighed], values: float) -> Findings:
    """What the bench alone says."""
    def group(some: Sequence[Weighed]) -> tuple[Candidate, ...]:
        return tuple(Candidate(w.key, w.gain, spread(some[0].blocks - w.blocks)) for w in some)

    more = pairs[0].gain - singles[0].gain if pairs and singles else 0.0
    return Findings(group(singles), group(pairs), values, singles[0].error if singles else 0.0, more,
                    spread(pairs[0].blocks - singles[0].blocks) if pairs and singles else 0.0)


def rises(value: float, middle: float, steepness: float) -> float:
    """Logistic in the logarithm of a positive value; 1/2 at ``middle``."""
    return float(1 / (1 + np.exp(-np.clip(steepness * np.log(max(value, 1e-9) / max(middle, 1e-9)), -60, 60))))


def something(f: Findings, layer: OddsLayer = LAYER) -> float:
    """Probability that anything at all is missing from the linear model, by the bench and by what simulation makes of its leaders."""
    if not f.singles or f.singles[0].gain <= 0:
        return 0.02
    gain = f.singles[0].gain
    size = rises(gain, layer.least + layer.part * f.values, 3.0)
    surety = rises(gain / (f.error + 2.0), layer.surety, 4.0)
    seen = 1.0 if np.isnan(f.lead) else layer.blind + (1 - layer.blind) * rises(max(f.lead, 1e-3), layer.seen, 2.0)
    return float(np.clip(size * surety * seen, 0.0, 0.9995))


def two(f: Findings, layer: OddsLayer = LAYER) -> float:
    """Probability that two effects act, given that something does."""
    if not f.pairs or f.more <= 0:
        return 0.0
    bench = rises(f.more, 15.0 + layer.second * f.singles[0].gain, 2.5) * rises(f.more / (f.more_error + 2.0), 2.2, 4.0)
    return bench if np.isnan(f.beside) else bench * max(0.02, rises(max(f.beside, 1e-3), layer.beside, 3.0))


def proved(f: Findings, layer: OddsLayer = LAYER) -> float:
    """Probability that something is missing, from records that were not fitted: near zero unless the error falls clearly and in most
    blocks."""
    mean, error = f.judged
    if not mean > 0:
        return 0.0
    return min(0.999, rises(float(np.exp(mean / 2)), layer.proof, 9.0) * rises(mean / (error + 0.05), 2.5, 4.0))


def strange_error(f: Findings) -> float:
    """Probability that something is missing that no law here explains: the model that is reported misses records by far more than noise.

    Kept below one half for errors of some per cent, which model error within a band alone can make.
    """
    if not (np.isfinite(f.left) and np.isfinite(f.noise)) or f.left <= 0:
        return 0.0
    return 0.9 * rises(f.left, 0.15, 3.0) * rises(f.left / max(f.noise, 1e-9), 10.0, 2.0)


def odds_of(f: Findings, layer: OddsLayer = LAYER) -> dict[Key, float]:
    """Probability of every hypothesis, of none (empty key) and of something outside the catalogue; they sum to one, largest first."""
    shown = 0.0 if np.isnan(f.lead) else 0.97 * rises(max(f.lead, 1e-3), layer.shown, 4.0)
    missing = 1 - (1 - something(f, layer)) * (1 - proved(f, layer)) * (1 - shown)
    double = two(f, layer)
    tilt = {key: (1 + max(mean, 0.0) / (layer.floor + error)) ** -layer.along if np.isfinite(mean) else 5.0 ** -layer.along
            for key, mean, error in f.simulated}
    # a class is simulated at its likeliest places only; what that says holds for its others
    alike: dict[frozenset[str], float] = {}
    for key, value in tilt.items():
        own = frozenset(cls for cls, _ in key)
        alike[own] = max(alike.get(own, 0.0), value)
    weights: dict[Key, float] = {}
    for group, share in ((f.singles, 1 - double), (f.pairs, double)):
        raw = _raw(group, layer)
        for key in raw:
            raw[key] *= tilt.get(key, alike.get(frozenset(cls for cls, _ in key), 1.0)) * (layer.withdrawn if key in f.withdrawn else 1.0)
        total = sum(raw.values())
        for key, value in raw.items():
            weights[key] = weights.get(key, 0.0) + share * value / total
    strange = max(float(1 / (1 + np.exp(-(f.unexplained - layer.unexplained) / layer.width))), 0.01)
    # what the claimed law leaves speaks against laws, not against drifts, delays and channels, which were not simulated
    lawful = {key: all(ROWS[cls].kind == "force" for cls, _ in key) for key in weights}
    outside = missing * strange * (sum(v for key, v in weights.items() if lawful[key]) if weights else 1.0)
    none = 1 - missing
    hidden = none * strange_error(f)
    out: dict[Key, float] = {(): none - hidden, OTHER: outside + hidden}
    for key, value in weights.items():
        out[key] = missing * (1 - strange * lawful[key]) * value
    total = sum(out.values())
    return {key: value / total for key, value in sorted(out.items(), key=lambda kv: -kv[1])}


def _raw(group: Sequence[Candidate], layer: OddsLayer) -> dict[Key, float]:
    out: dict[Key, float] = {}
    for c in group:
        best = max(group[0].gain, 0.0)
        prior = float(np.prod([ROWS[cls].prior for cls, _ in c.key])) * (layer.useless if c.gain <= 0 < best else 1.0)
        against = max(group[0].gain - c.gain, 0.0) / (layer.scale + c.behind + layer.share * best)
        out[c.key] = max(out.get(c.key, 0.0), prior * (1 + against) ** -layer.power)
    return out
