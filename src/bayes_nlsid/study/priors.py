"""Priors of a study: the defaults, what it states in their place, and which joints it calls nominally equal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.prior import Prior, default_priors, groups, pool
from bayes_nlsid.study.consistency import same_parameter
from bayes_nlsid.study.context import Context
from bayes_nlsid.study.schema import GroupEntry

SCATTER = 0.3     # of the logarithm or logit; of other parameters: times the standard deviation of the prior of the common value
Array = NDArray[np.float64]


def chosen_priors(context: Context, start: Fit) -> tuple[Prior, ...]:
    """The default priors with those of the study in their place; one for a term that was not chosen waits for another day.

    Raises
    ------
    InputError
        If a prior does not fit its bounds, or those of one group differ.
    """
    out = list(default_priors(start.problem))
    entry = context.study.posterior
    for i, stated in enumerate(entry.priors if entry is not None else ()):
        where = f"{context.study.file.name}: [[posterior.priors]] {i + 1}"
        matched = [k for k, p in enumerate(out) if same_parameter(stated.parameter, p.name)]
        if not matched:
            context.note(f"the prior of {stated.parameter} is not used: the terms that were chosen have no such parameter")
        for k in matched:
            lower = out[k].lower if stated.lower is None else max(stated.lower, out[k].lower)
            upper = out[k].upper if stated.upper is None else min(stated.upper, out[k].upper)
            try:
                out[k] = replace(out[k], kind=stated.kind, a=stated.a, b=stated.b, lower=lower, upper=upper)
            except ValueError as error:
                raise InputError(where, str(error), "change it, or widen the bounds of the identification") from None
    for i, group in enumerate(entry.groups if entry is not None else ()):
        matched = [k for k, p in enumerate(out) if any(same_parameter(name, p.name) for name in group.parameters)]
        if len(matched) < 2:
            context.note(f"[[posterior.groups]] {i + 1} is not used: the terms that were chosen have {len(matched)} such parameters")
            continue
        for k, prior in zip(matched, _grouped(group, [out[k] for k in matched], f"{context.study.file.name}: [[posterior.groups]] {i + 1}"),
                            strict=True):
            out[k] = prior
    return tuple(out)


def _grouped(group: GroupEntry, members: list[Prior], where: str) -> list[Prior]:
    """Members with one prior of their common value: the widest of their own, where bounds made them differ."""
    name = ", ".join(group.parameters)
    if len({p.unit for p in members}) > 1:
        raise InputError(f"{where} parameters", f"{members[0].name} and {next(p.name for p in members if p.unit != members[0].unit)} have "
                         "different units", "name the same parameter of several joints")
    if len({(p.kind, p.a) for p in members}) > 1:
        raise InputError(f"{where} parameters", f"the priors of {name} differ in kind or middle",
                         "state one prior for all of them in [[posterior.priors]]")
    first, wide = members[0], max(p.b for p in members)
    low, high = min(p.lower for p in members), max(p.upper for p in members)
    if first.kind == "logitnormal" and {(p.lower, p.upper) for p in members} != {(low, high)}:
        raise InputError(f"{where} parameters", f"the bounds of {name} differ, and with them the meaning of its logit",
                         "state lower and upper in [[posterior.priors]], or another kind")
    scatter = group.scatter
    if scatter is None:
        whole = replace(first, lower=low, upper=high, b=wide)
        free = first.kind in ("lognormal", "loguniform", "logitnormal")
        scatter = SCATTER if free else SCATTER * float(whole.quantile((np.arange(256) + 0.5) / 256).std())
    return [replace(p, b=wide, group=name, scatter=scatter) for p in members]


def described(priors: tuple[Prior, ...]) -> list[dict[str, Any]]:
    """For ``result.json`` and the report."""
    return [{"parameter": p.name, "text": p.sentence.removeprefix(f"{p.name}: "), "kind": p.kind, "a": p.a, "b": p.b, "lower": p.lower,
             "upper": p.upper} | ({"group": p.group, "scatter": p.scatter} if p.group else {}) for p in priors]


def common_values(priors: tuple[Prior, ...], theta: Array, rng: np.random.Generator) -> list[dict[str, Any]]:
    """What draws (S, P) say of the common value and the scatter of every group; for ``result.json``."""
    out = []
    for name, places in groups(priors).items():
        members = tuple(priors[i] for i in places)
        z = np.stack([p.variable(theta[:, i]) for i, p in zip(places, members, strict=True)], axis=1)
        mu, tau = pool(members).common(z, rng)
        middle = members[0] if members[0].kind == "logitnormal" else replace(
            members[0], lower=min(p.lower for p in members), upper=max(p.upper for p in members))
        relative = {"lognormal": "natural logarithm", "loguniform": "natural logarithm", "logitnormal": "logit"}
        out.append({"group": name, "parameters": [p.name for p in members], "unit": members[0].unit,
                    "scatter_of": relative.get(members[0].kind, "parameter"), "scatter_prior": members[0].scatter,
                    "common": _quantiles(middle.value(mu)), "scatter": _quantiles(tau)})
    return out


def _quantiles(values: Array) -> dict[str, float]:
    return {key: float(q) for key, q in zip(("q05", "q50", "q95"), np.quantile(values, [0.05, 0.5, 0.95]), strict=True)}
