"""Words that both engines use: what a hypothesis claims, what would tell it from the next one, what a parameter means."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.laws import Law

Key = tuple[tuple[str, str], ...]
WORTH_SAYING = 0.02   # probability of a rival from which it is named
PHASES = {"displacement": "it follows the displacement", "velocity": "it follows the velocity",
          "memory": "it follows the history of displacement (loops)", "acceleration": "it follows the acceleration",
          "input": "it sits in the input", "channel": "it sits in a measuring channel"}
LINEAR = {"f": "frequency of the mode", "zeta": "damping ratio of the mode", "damping": "viscous damping over mass",
          "gain": "factor on the measured force"}


def claims(effects: Key) -> str:
    """The effects in words."""
    return " and ".join(ROWS[c].claim.format(place=p).removesuffix(" at -") if c in ROWS else f"{c} at {p}" for c, p in effects)


def classes(effects: Key) -> str:
    """The classes in words."""
    return " with ".join(dict.fromkeys(c.replace("_", " ") for c, _ in effects))


def separates(effects: Key, ordered: Sequence[tuple[Key, float]]) -> str:
    """The test that tells a hypothesis from its likeliest rival that claims something else, and which rival that is.

    Parameters
    ----------
    effects : the hypothesis.
    ordered : all hypotheses with their probabilities, likeliest first.
    """
    own = {c for c, _ in effects}
    row = ROWS[effects[0][0]]
    if own <= {"none", "other"}:
        return row.test
    for key, p in ordered:
        there = {c for c, _ in key}
        if p < WORTH_SAYING or there == own or not there or there & {"other", "none"}:
            continue
        more, less = [c for c, _ in key if c not in own], [c for c, _ in effects if c not in there]
        if more and not less:
            test = ROWS[more[0]].test         # it has one effect more
        elif less and not more:
            test = ROWS[less[0]].test         # it has one effect less
        else:
            first = ROWS[less[0]]
            test = first.test if more[0] in first.confused else ROWS[more[0]].test
        return f"{test} (tells it from {classes(key)})"
    return row.test


def known(law: Law, place: str, values: Sequence[float], prefix: str) -> list[dict[str, Any]]:
    """Parameters that a law holds fixed, as they are reported: all quantiles alike."""
    return [{"name": f"{prefix}[{place}].{q.name}", "unit": q.unit, "q05": float(v), "q50": float(v), "q95": float(v), "meaning": q.meaning}
            for q, v, kind in zip(law.term.params, values, law.free, strict=True) if kind == "fixed"]


def of_linear(name: str) -> str:
    """What a linear parameter ``f[1]``, ``zeta[1]``, ``gain`` means; empty for others."""
    return LINEAR.get(name.split("[")[0], "")


def size_of(value: float, unit: str) -> str:
    """``920 nm``: two digits and a prefix."""
    prefixes = ((1e-9, "n"), (1e-6, "µ"), (1e-3, "m"), (1.0, ""))
    factor, prefix = next(((f, name) for f, name in prefixes if value < 995 * f), prefixes[-1])
    scaled = value / factor
    return f"{scaled:.2g} {prefix}{unit}" if scaled < 99.5 else f"{round(scaled, -1 if scaled < 995 else 0):.0f} {prefix}{unit}"


def whole_percent(p: float) -> str:
    """A probability as a whole percentage that never says 0 or 100 where it is not."""
    return "< 1 %" if p < 0.005 else "> 99 %" if 0.995 < p < 1 else f"{100 * p:.0f} %"


def sure(p: float) -> str:
    """``= 0.93``, or ``> 0.999``."""
    return "> 0.999" if p > 0.999 else "< 0.001" if p < 0.001 else f"= {p:.3g}"


def error_percent(share: float) -> str:
    """An error as a percentage with two digits."""
    return f"{100 * share:.0f} %" if share > 0.1 else f"{100 * share:.2g} %"
