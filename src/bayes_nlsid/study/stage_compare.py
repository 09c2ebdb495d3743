"""Stage ``compare``: scenarios and alternatives scored on the records that none of them was fitted to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.inference.arviz_export import comparison_bytes
from bayes_nlsid.inference.ensemble import sample
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.inference.reweighting import WORST_SHAPE, around_fit
from bayes_nlsid.model import Element, Model
from bayes_nlsid.prediction.comparison import Alternative, Comparison
from bayes_nlsid.prediction.comparison import compare as score
from bayes_nlsid.study.building import element_from
from bayes_nlsid.study.context import Arrays, Context, Result
from bayes_nlsid.study.priors import chosen_priors
from bayes_nlsid.study.schema import CompareEntry
from bayes_nlsid.study.stage_identify import band_of, base_problem, entry_of, stored_model

MOST_STEPS = 3000


def compare(context: Context) -> Result:
    """Fit and sample every alternative, then score all of them on the same blocks.

    Returns
    -------
    arrays, data
        ``by_block`` (K, B), ``log_density<k>`` (S, B), ``netcdf<k>``; ``data["summary"]`` what ``result.json`` says.
    """
    entry = context.study.compare
    assert entry is not None
    records = context.role("holdout")
    where = f"{context.study.file.name}: [compare]"
    if not records:
        raise InputError(where, "there is no recording that was not fitted", 'give one the role "holdout"')
    others = list(_alternatives(context, entry))
    try:
        found = score(others, [(r, context.noise(r)) for r in context.role("train")], [(r, context.noise(r)) for r in records],
                      band=band_of(context, context.model), seed=context.number("compare"),
                      progress=lambda share, sentence: context.progress(0.5 + 0.5 * share, sentence))
    except ValueError as error:
        raise InputError(where, str(error), "lengthen the window, or change the band") from None
    arrays: Arrays = {"by_block": found.by_block}
    for k, one in enumerate(others):
        arrays[f"log_density{k}"] = found.log_density[k]
        names = tuple(p.name for p in one.model.parameters)
        whole = comparison_bytes(names, one.theta, found.log_density[k], found.blocks, one.name)
        arrays[f"netcdf{k}"] = np.frombuffer(whole, dtype=np.uint8)
    return arrays, {"summary": _summary(found, others, [r.name for r in records])}


def _summary(found: Comparison, others: list[Alternative], records: list[str]) -> dict[str, Any]:
    reasons = [f"{o.name}: {o.note}" for o in others if o.note]
    reasons += [f"{name}: could not be simulated on the held-out records" for name, value in zip(found.names, found.elpd, strict=True)
                if not np.isfinite(value)]
    usable = bool(np.isfinite(found.elpd).any())
    return {"status": "ok" if usable else "failed", "reasons": reasons, "records": records, "blocks": list(found.blocks),
            "sentence": found.sentence, "order": list(found.names), "alternatives": found.rows()}


def _alternatives(context: Context, entry: CompareEntry) -> Iterator[Alternative]:
    """The main form under each scenario, the study's alternatives, the linear model, and the second stage where there is one."""
    stored = context.done["identify"].data["variants"]
    own = entry_of(context)
    several = len(own.modes) > 1
    names = [s for s in entry.scenarios if several or s == own.scenario]
    plans = [(s if several else "main", s, 0) for s in names]
    plans += [(v["name"], own.scenario, i) for i, v in enumerate(stored) if i > 0]
    plans.append(("linear", own.scenario, -1))
    for i, (name, scenario, variant) in enumerate(plans):
        context.progress(0.5 * i / len(plans), f"posterior of {name}")
        elements = () if variant < 0 else tuple(element_from(e, context.terms) for e in stored[variant]["elements"])
        if variant >= 0 and not elements:
            continue
        yield _drawn(context, entry, name, scenario, elements, None if variant < 0 else stored_model(context, variant)[1])
    second = (context.done["posterior"].data.get("second_stage") or {}) if "posterior" in context.done else {}
    if second.get("status") == "ok":
        theta = np.asarray(context.done["posterior"].arrays["theta"], dtype=float)
        flat = theta.reshape(-1, theta.shape[-1])
        rng = np.random.default_rng(context.random("compare simulation"))
        yield Alternative("simulation", stored_model(context)[0], flat[rng.choice(len(flat), min(entry.samples, len(flat)), replace=False)],
                          second.get("k_hat"))


def _drawn(context: Context, entry: CompareEntry, name: str, scenario: str, elements: tuple[Element, ...], warm: Any) -> Alternative:
    """Draws of the regression's posterior: weighted draws around its optimum, or walkers where the weights are not to be trusted."""
    own = entry_of(context)
    asked = replace(context, study=replace(context.study, identification=replace(own, scenario=scenario)))
    problem = base_problem(asked, elements)
    seed = context.number(f"compare {name}")
    found: Fit = fit(problem, starts=own.starts, seed=seed, warm=warm)
    if not np.isfinite(found.theta).all():
        raise InputError(f"{context.study.file.name}: [compare]", f"the fit of {name} failed ({'; '.join(found.reasons)})",
                         "leave it out of scenarios")
    model: Model = problem.model
    if not problem.names:
        return Alternative(name, model, np.zeros((1, 0)))
    priors = chosen_priors(asked, found)
    likelihood = WhittleLikelihood(found)
    weighted = around_fit(likelihood, priors, draws=1000, seed=seed)
    if weighted.shape <= WORST_SHAPE:
        return Alternative(name, model, weighted.resampled(entry.samples, np.random.default_rng(seed)), weighted.shape)
    chain = sample(found, likelihood=likelihood, priors=priors, most=MOST_STEPS, seed=seed, workers=context.workers,
                   executor=context.executor)
    if any("stopped from the keyboard" in reason for reason in chain.reasons):
        raise KeyboardInterrupt
    note = "" if chain.convergence.converged else "its walkers had not converged"
    if not len(chain.flat):
        return Alternative(name, model, found.theta[None], weighted.shape, "its walkers left no draws; the fit stands for them")
    return Alternative(name, model, chain.draws(min(entry.samples, len(chain.flat)), seed), None, note)
