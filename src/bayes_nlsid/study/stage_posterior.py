"""Stage ``posterior``: likelihood, priors and sampling; checkpoints survive a kill."""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.ensemble import MOST_STEPS, sample
from bayes_nlsid.inference.likelihood import Likelihood, PlainLikelihood, WhittleLikelihood
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.inference.prior import Prior, default_priors
from bayes_nlsid.study.context import Context, Result
from bayes_nlsid.study.schema import PosteriorEntry
from bayes_nlsid.study.stage_identify import stored_fit

PRIOR_DRAWS = 4000


def posterior(context: Context) -> Result:
    """Sample the posterior of the selected model.

    Returns
    -------
    arrays, data
        ``theta`` (M, n, W, P), ``log_prob`` (M, n, W), ``quantiles`` (3, P), ``prior_draws`` (E, P), ``narrowing`` (P,) as posterior over
        prior width in search coordinates, ``ess``, ``tau`` (P,); ``data["convergence"]`` as in the results file.
    """
    entry = context.study.posterior
    assert entry is not None
    start = stored_fit(context)
    if start.status == "failed":
        raise InputError(f"{context.study.file.name}: [posterior]", f"the fit failed ({'; '.join(start.reasons)})",
                         "correct the identification first")
    if not start.problem.size or not start.problem.names:
        return {"theta": np.zeros((1, 0, 1, 0)), "log_prob": np.zeros((1, 0, 1)), "quantiles": np.zeros((3, 0)), "narrowing": np.zeros(0),
                "ess": np.zeros(0), "tau": np.zeros(0)}, _empty()
    context.progress(0.0, "likelihood")
    likelihood = _likelihood(entry, start)
    priors = _priors(context, entry, start)
    checkpoints = context.checkpoints("posterior")
    found = sample(start, likelihood=likelihood, priors=priors, ensembles=entry.ensembles, steps=entry.steps, walkers=entry.walkers,
                   most=entry.most or MOST_STEPS, seed=context.number("posterior"), store=checkpoints, progress=context.progress,
                   executor=context.executor, workers=context.workers)
    if any("stopped from the keyboard" in reason for reason in found.reasons):
        raise KeyboardInterrupt  # half a posterior is not a result; its checkpoints stay for the next run
    rng = np.random.default_rng(context.random("prior"))
    c = found.convergence
    arrays = {"theta": found.theta, "log_prob": found.log_prob, "quantiles": found.quantiles(), "narrowing": 1 - np.asarray(c.contraction),
              "ess": np.asarray(c.ess), "tau": np.asarray(c.tau),
              "prior_draws": np.stack([p.sample(PRIOR_DRAWS, rng) for p in priors], axis=1)}
    _keep_whole(context, found, likelihood, arrays)
    data: dict[str, Any] = {
        "names": list(found.names), "units": list(found.units), "identifiable": [bool(x) for x in c.identifiable], "status": found.status,
        "reasons": list(found.reasons), "burn_in": 0, "burned": found.burn, "likelihood": likelihood.describe(), "failures": found.failures,
        "priors": [{"parameter": p.name, "text": p.sentence.removeprefix(f"{p.name}: ")} for p in priors],
        "convergence": {"ensembles": c.ensembles, "steps": c.steps, "walkers": c.walkers, "converged": bool(c.converged),
                        "rhat_max": float(c.rhat_max), "ess_min": float(c.ess_min), "stuck_walkers": int(c.stuck_walkers)}}
    return arrays, data


def _empty() -> dict[str, Any]:
    """A linear model without free parameters has nothing to sample."""
    return {"names": [], "units": [], "identifiable": [], "status": "ok", "reasons": ["the chosen model has no free parameters"],
            "burn_in": 0,
            "priors": [], "likelihood": "", "convergence": {"ensembles": 0, "steps": 0, "walkers": 0, "converged": True, "rhat_max": None,
                                                            "ess_min": None, "stuck_walkers": 0}}


def _likelihood(entry: PosteriorEntry, start: Fit) -> Likelihood:
    return WhittleLikelihood(start) if entry.likelihood == "whittle" else PlainLikelihood(start)


def _priors(context: Context, entry: PosteriorEntry, start: Fit) -> tuple[Prior, ...]:
    """The default priors with those of the study in their place.

    Raises
    ------
    InputError
        If a pattern names no parameter, or a prior does not fit its bounds.
    """
    out = list(default_priors(start.problem))
    for i, stated in enumerate(entry.priors):
        where = f"{context.study.file.name}: [[posterior.priors]] {i + 1}"
        matched = [k for k, p in enumerate(out) if p.name == stated.parameter or fnmatchcase(p.name, stated.parameter.replace("[", "[[]"))]
        if not matched:
            raise InputError(where, f"{stated.parameter!r} is none of the parameters {', '.join(p.name for p in out[:8])}",
                             "correct the name")
        for k in matched:
            lower = out[k].lower if stated.lower is None else max(stated.lower, out[k].lower)
            upper = out[k].upper if stated.upper is None else min(stated.upper, out[k].upper)
            try:
                out[k] = replace(out[k], kind=stated.kind, a=stated.a, b=stated.b, lower=lower, upper=upper)
            except ValueError as error:
                raise InputError(where, str(error), "change it, or widen the bounds of the identification") from None
    return tuple(out)


def _keep_whole(context: Context, found: Posterior, likelihood: Likelihood, arrays: dict[str, Any]) -> None:
    """The exported data set, as bytes beside the arrays, so that ``posterior.nc`` can be written again without computing."""
    from bayes_nlsid.inference.arviz_export import to_inference_data, write_netcdf

    folder = context.checkpoints("posterior")
    target = (folder if folder is not None else Path(".")) / "posterior.nc"
    write_netcdf(to_inference_data(found, likelihood), target)
    arrays["netcdf"] = np.frombuffer(target.read_bytes(), dtype=np.uint8)
    target.unlink()
