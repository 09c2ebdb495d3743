"""Stage ``posterior``: likelihood, priors and sampling; checkpoints survive a kill."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.adequacy import adequacy
from bayes_nlsid.inference.ensemble import MOST_STEPS, sample
from bayes_nlsid.inference.forward import ForwardLikelihood, forward_likelihood
from bayes_nlsid.inference.likelihood import Likelihood, PlainLikelihood, WhittleLikelihood
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.inference.prior import Prior, sample_priors
from bayes_nlsid.inference.reweighting import forward_posterior
from bayes_nlsid.study.context import Context, Result
from bayes_nlsid.study.priors import chosen_priors, common_values, described
from bayes_nlsid.study.schema import PosteriorEntry
from bayes_nlsid.study.stage_identify import stored_fit

PRIOR_DRAWS = 4000
MOST_WORK = 1e5         # samples times modes of all recordings up to which the second stage is made unasked
MEMORY = 10             # how much dearer a step with memory is


def posterior(context: Context) -> Result:
    """Sample the posterior of the selected model.

    Returns
    -------
    arrays, data
        ``theta`` (M, n, W, P), ``log_prob`` (M, n, W), ``quantiles`` (3, P), ``regression_quantiles`` (3, P) where a second stage came
        after the regression, ``prior_draws`` (E, P), ``narrowing`` (P,) as posterior over prior width in search coordinates, ``ess``,
        ``tau`` (P,); ``data["convergence"]`` as in the results file, ``data["second_stage"]`` its tests and disagreement.
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
    priors = chosen_priors(context, start)
    if entry.walkers is not None and entry.walkers < 2 * len(priors):
        raise InputError(f"{context.study.file.name}: [posterior] walkers", f"{entry.walkers} are too few for {len(priors)} parameters",
                         f"write {4 * len(priors)} or more, or leave it out")
    stage, why = chosen_stage(context, entry, start)
    found: Posterior | None = None
    arrays: dict[str, Any] = {}
    data: dict[str, Any] = {}
    if stage != "forward":
        found, likelihood = _regression(context, entry, start, priors, 0.0, 1.0 if stage == "regression" else 0.5)
        arrays, data = _results(found, likelihood)
    if stage != "regression":
        second, simulated, data["second_stage"] = _forward(context, entry, start, priors, found)
        if second is not None and simulated is not None and len(second.flat) and (second.convergence.converged or entry.stage is not None):
            earlier = {} if found is None else {"regression_quantiles": arrays["quantiles"]}
            arrays, rest = _results(second, simulated)
            arrays, data = arrays | earlier, rest | {"second_stage": data["second_stage"]}
            found, likelihood = second, simulated
        elif found is None:
            raise InputError(f"{context.study.file.name}: [posterior] stage", "; ".join(data["second_stage"]["reasons"]),
                             'write stage = "regression"')
    assert found is not None
    if not len(found.flat):
        raise InputError(f"{context.study.file.name}: [posterior] most", f"the sampler left no draws ({'; '.join(found.reasons)})",
                         "raise most, or leave it out")
    rng = np.random.default_rng(context.random("prior"))
    arrays["prior_draws"] = sample_priors(priors, PRIOR_DRAWS, rng)
    _keep_whole(context, found, likelihood, arrays)
    data |= {"stage": stage, "stage_why": why,
             "priors": described(priors), "groups": common_values(priors, found.flat, rng)}
    return arrays, data


def chosen_stage(context: Context, entry: PosteriorEntry, start: Fit) -> tuple[str, str]:
    """``regression``, ``forward`` or ``both``, and why: what the study says, else by what simulating its recordings would cost."""
    if entry.stage is not None:
        return entry.stage, "as the study says"
    if entry.likelihood != "whittle":
        return "regression", "the plain likelihood is that of the regression alone"
    dear = any(e.term.memory != "none" for e in start.problem.model.elements)
    work = sum(r.n for r in context.role("train")) * start.problem.model.linear.modes * (MEMORY if dear else 1)
    if work > MOST_WORK:
        return "regression", (f"simulating the recordings some thousand times takes long ({work:.2g} steps of one mode each time, "
                              f'limit {MOST_WORK:.0g}); write stage = "both" to have it done')
    return "both", "the recordings are short enough to be simulated some thousand times"


def _regression(context: Context, entry: PosteriorEntry, start: Fit, priors: tuple[Prior, ...], begin: float, end: float
                ) -> tuple[Posterior, Likelihood]:
    """Chains on the residual of Eq. 13."""
    context.progress(begin, "likelihood")
    likelihood = _likelihood(entry, start)
    found = sample(start, likelihood=likelihood, priors=priors, ensembles=entry.ensembles, steps=entry.steps, walkers=entry.walkers,
                   most=entry.most or MOST_STEPS, seed=context.number("posterior"), store=context.checkpoints("posterior"),
                   progress=lambda share, sentence: context.progress(begin + (end - begin) * share, sentence),
                   executor=context.executor, workers=context.workers)
    if any("stopped from the keyboard" in reason for reason in found.reasons):
        raise KeyboardInterrupt  # half a posterior is not a result; its checkpoints stay for the next run
    return found, likelihood


def _forward(context: Context, entry: PosteriorEntry, start: Fit, priors: tuple[Prior, ...], first: Posterior | None
             ) -> tuple[Posterior | None, ForwardLikelihood | None, dict[str, Any]]:
    """Second stage: the measured channels themselves, started from the regression and the middle of its posterior."""
    recordings = context.role("train")
    floors = [context.noise(r) for r in recordings]
    folder = context.checkpoints("posterior")
    try:
        likelihood = forward_likelihood(start, recordings, priors, floors=floors, starts=() if first is None else (first.quantiles()[1],),
                                        progress=lambda share, sentence: context.progress(0.5 + 0.15 * share, sentence))
    except ValueError as error:
        return None, None, {"status": "failed", "reasons": [str(error)], "misfit": None}
    tested = adequacy(likelihood, floors, priors=priors)
    found, weighted = forward_posterior(start, likelihood, priors, ensembles=entry.ensembles, steps=entry.steps, walkers=entry.walkers,
                                        most=entry.most or MOST_STEPS, seed=context.number("posterior forward"), workers=context.workers,
                                        store=None if folder is None else folder / "forward",
                                        progress=lambda share, sentence: context.progress(0.65 + 0.35 * share, sentence))
    said = {"status": found.status, "reasons": list(found.reasons), "misfit": tested.record(), "k_hat": weighted.shape,
            "effective": weighted.effective, "simulated": len(weighted.theta)}
    if first is not None and len(found.flat) and len(first.flat):
        said["against_regression"] = _disagreement(first, found)
    return found, likelihood, said


def _disagreement(first: Posterior, second: Posterior) -> list[dict[str, Any]]:
    """Per parameter: distance of the medians in standard deviations of the regression, and how much narrower the second stage is."""
    middle, width = (second.quantiles()[1] - first.quantiles()[1], first.flat.std(axis=0))
    return [{"name": name, "shift_sd": float(m / max(w, 1e-300)), "width_ratio": float(s / max(w, 1e-300))}
            for name, m, w, s in zip(first.names, middle, width, second.flat.std(axis=0), strict=True)]


def _results(found: Posterior, likelihood: Likelihood) -> Result:
    c = found.convergence
    arrays = {"theta": found.theta, "log_prob": found.log_prob, "quantiles": found.quantiles(), "narrowing": 1 - np.asarray(c.contraction),
              "ess": np.asarray(c.ess), "tau": np.asarray(c.tau)}
    data: dict[str, Any] = {
        "names": list(found.names), "units": list(found.units), "identifiable": [bool(x) for x in c.identifiable], "status": found.status,
        "reasons": list(found.reasons), "burn_in": 0, "burned": found.burn, "likelihood": likelihood.describe(), "failures": found.failures,
        "convergence": {"ensembles": c.ensembles, "steps": c.steps, "walkers": c.walkers, "converged": bool(c.converged),
                        "rhat_max": float(c.rhat_max), "ess_min": float(c.ess_min), "stuck_walkers": int(c.stuck_walkers)}}
    return arrays, data


def _empty() -> dict[str, Any]:
    """A linear model without free parameters has nothing to sample."""
    return {"names": [], "units": [], "identifiable": [], "status": "ok", "reasons": ["the chosen model has no free parameters"],
            "burn_in": 0, "priors": [], "likelihood": "", "stage": "regression", "stage_why": "nothing to sample",
            "convergence": {"ensembles": 0, "steps": 0, "walkers": 0, "converged": True, "rhat_max": None, "ess_min": None,
                            "stuck_walkers": 0}}


def _likelihood(entry: PosteriorEntry, start: Fit) -> Likelihood:
    return WhittleLikelihood(start) if entry.likelihood == "whittle" else PlainLikelihood(start)


def _keep_whole(context: Context, found: Posterior, likelihood: Likelihood, arrays: dict[str, Any]) -> None:
    """The exported data set, as bytes beside the arrays, so that ``posterior.nc`` can be written again without computing."""
    from bayes_nlsid.inference.arviz_export import to_inference_data, write_netcdf

    folder = context.checkpoints("posterior")
    target = (folder if folder is not None else Path(".")) / "posterior.nc"
    write_netcdf(to_inference_data(found, likelihood), target)
    arrays["netcdf"] = np.frombuffer(target.read_bytes(), dtype=np.uint8)
    target.unlink()
