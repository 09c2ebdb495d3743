"""Stage ``montecarlo``: backbones of many parameter samples, what their scatter comes from, and whether there are enough of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.inference.prior import Prior
from bayes_nlsid.model import Model, Parameter
from bayes_nlsid.prediction.bands import quantiles
from bayes_nlsid.prediction.montecarlo import Backbones, Decay, NumericalError, backbones, numerical_error
from bayes_nlsid.prediction.sampling_plan import Plan, posterior_plan, scattered_plan
from bayes_nlsid.prediction.sensitivity import Indices, convergence, dependent_shares, last_move, sobol
from bayes_nlsid.study.context import Arrays, Context, Result
from bayes_nlsid.study.schema import MonteCarloEntry, SpreadEntry
from bayes_nlsid.study.stage_identify import stored_model
from bayes_nlsid.study.stage_predict import posterior_draws

Array = NDArray[np.float64]
TAILS = 8.0  # standard deviations at which a distribution is cut
SHARE_NEEDED = 0.9
INDEX_POINTS = 12  # amplitudes at which indices are given
OUTPUTS = ("frequency", "damping")


def montecarlo(context: Context) -> Result:
    """Sample, simulate, and judge.

    Returns
    -------
    arrays, data
        Those of ``montecarlo.npz``; ``data["summary"]`` what ``montecarlo.json`` says.
    """
    entry = context.study.montecarlo
    assert entry is not None
    model, theta = stored_model(context)
    if entry.mode > model.linear.modes:
        raise InputError(f"{context.study.file.name}: [montecarlo] mode", f"{entry.mode} does not exist",
                         f"write one from 1 to {model.linear.modes}")
    spreads = [] if entry.source == "posterior" else distributions(context.study.file.name, model, theta, entry.spreads)
    try:
        if entry.source == "posterior":
            plan = posterior_plan(posterior_draws(context, theta, entry.samples, "montecarlo"))
        else:
            plan = scattered_plan(theta, spreads, entry.samples, context.number("montecarlo"), entry.indices)
        decay = _decay(context, entry)
        found = backbones(model, plan.theta, decay, path=entry.path, folder=context.checkpoints("montecarlo"), executor=context.executor,
                          workers=context.workers, progress=lambda share, sentence: context.progress(0.9 * share, sentence))
    except ValueError as problem:
        raise InputError(f"{context.study.file.name}: [montecarlo]", str(problem),
                         "change at, amplitudes, path, samples or the parameters") from None
    context.progress(0.92, "the error of the computation itself")
    error = numerical_error(model, plan.theta[:plan.samples], _part(found, plan.samples), decay)
    context.progress(0.95, "sensitivities")
    shares = _sensitivities(context, entry, plan, found)
    arrays = _arrays(plan, found, error, shares)
    return arrays, {"names": [model.names[i] for i in plan.varied], "units": [model.parameters[i].unit for i in plan.varied],
                    "summary": _summary(model, entry, plan, found, error, shares, arrays)}


def distributions(file: str, model: Model, theta: Array, spreads: Sequence[SpreadEntry]) -> list[tuple[int, Prior]]:
    """The distribution of every parameter that has one; a later entry takes the place of an earlier one.

    Raises
    ------
    InputError
        If an entry names no parameter, or its numbers make no distribution.
    """
    chosen: dict[int, Prior] = {}
    for number, entry in enumerate(spreads, start=0 if spreads and spreads[0].parameter == "*" and spreads[0].relative else 1):
        where = f"{file}: [[montecarlo.parameters]] {number}" if number else f"{file}: [montecarlo] scatter"
        pattern = entry.parameter.replace("[", "[[]")
        matched = [i for i, name in enumerate(model.names) if name == entry.parameter or fnmatchcase(name, pattern)]
        if not matched:
            raise InputError(where, f"{entry.parameter!r} is none of the parameters {', '.join(model.names[:8])}", "correct the name")
        for i in matched:
            try:
                chosen[i] = _distribution(model.parameters[i], float(theta[i]), entry)
            except ValueError as error:
                raise InputError(where, str(error), "change its numbers") from None
    return sorted(chosen.items())


def _distribution(parameter: Parameter, fitted: float, entry: SpreadEntry) -> Prior:
    """One distribution, cut where its parameter has no meaning."""
    centre = fitted if entry.centre is None else entry.centre
    spread = entry.spread * abs(centre) if entry.relative else entry.spread
    if entry.kind in ("normal", "lognormal") and not spread > 0:
        raise ValueError(f"{parameter.name} is {centre:g}, of which no share is a scatter; give sd = ...")
    if entry.kind == "normal":
        low, high = centre - TAILS * spread, centre + TAILS * spread
    elif entry.kind == "lognormal":
        if not centre > 0:
            raise ValueError(f"{parameter.name} is {centre:g}, which cannot be the median of a lognormal distribution")
        low, high = centre * np.exp(-TAILS * spread), centre * np.exp(TAILS * spread)
    else:
        assert entry.lower is not None and entry.upper is not None
        low, high = entry.lower, entry.upper
    param = parameter.param
    if param is not None and param.rule == "range":
        low, high = max(low, param.lower), min(high, param.upper)
    elif param is None or not param.signed:
        low = max(low, 1e-9 * abs(centre))
    low = low if entry.lower is None else max(low, entry.lower)
    high = high if entry.upper is None else min(high, entry.upper)
    return Prior(parameter.name, parameter.unit, entry.kind, float(low), float(high), centre, spread if spread > 0 else 1.0)


def _decay(context: Context, entry: MonteCarloEntry) -> Decay:
    """What ``[prediction]`` says of integration holds here too."""
    prediction = context.study.prediction
    if prediction is None:
        return Decay(entry.at, entry.amplitude, entry.mode - 1, entry.amplitudes)
    return Decay(entry.at, entry.amplitude, entry.mode - 1, entry.amplitudes, prediction.fs, prediction.scheme, prediction.seconds,
                 prediction.band)


def _part(found: Backbones, count: int) -> Backbones:
    return Backbones(found.amplitude, found.frequency[:count], found.damping[:count], found.status[:count], found.path[:count])


def _sensitivities(context: Context, entry: MonteCarloEntry, plan: Plan, found: Backbones) -> dict[str, Indices]:
    """Indices of both outputs at some of the amplitudes; none if they are not wanted."""
    if not entry.indices:
        return {}
    shown = index_points(found.amplitude)
    out = {}
    for name in OUTPUTS:
        values = np.where((found.status == "ok")[:, None], getattr(found, name), np.nan)[:, shown]
        band, a, b, mixed, _, _ = plan.split(values)
        seed = context.number(f"montecarlo {name}")
        out[name] = (sobol(a, b, mixed, seed) if plan.independent
                     else dependent_shares(plan.theta[:plan.samples][:, list(plan.varied)], band, seed))
    return out


def index_points(amplitude: Array) -> NDArray[np.intp]:
    """Which amplitudes indices are given at."""
    return np.unique(np.linspace(0, len(amplitude) - 1, min(len(amplitude), INDEX_POINTS)).round().astype(int))


def _arrays(plan: Plan, found: Backbones, error: NumericalError, shares: Mapping[str, Indices]) -> Arrays:
    ok = found.status == "ok"
    out: Arrays = {"amplitude": found.amplitude, "samples_theta": plan.theta[:plan.samples][:, list(plan.varied)],
                   "samples_status": found.status[:plan.samples], "samples_path": found.path[:plan.samples],
                   "numerical_error_frequency": error.frequency, "numerical_error_damping": error.damping}
    shown = index_points(found.amplitude)
    out["index_amplitude"] = found.amplitude[shown]
    for name in OUTPUTS:
        values = np.where(ok[:, None], getattr(found, name), np.nan)
        band, _, _, _, middle, ends = plan.split(values)
        out[f"samples_{name}"] = band
        for level, row in zip(("q05", "q50", "q95"), quantiles(band, ok[:plan.samples]), strict=True):
            out[f"{name}_{level}"] = row
        out[f"middle_{name}"], out[f"tornado_{name}"] = middle, ends
        out["convergence_count"], out[f"convergence_{name}"] = convergence(band)
        if name in shares:
            for kind in ("first", "total"):
                for part, row in zip(("", "_low", "_high"), getattr(shares[name], kind), strict=True):
                    out[f"{kind}{part}_{name}"] = row
            out[f"explained_{name}"] = shares[name].explained
    return out


def _summary(model: Model, entry: MonteCarloEntry, plan: Plan, found: Backbones, error: NumericalError, shares: Mapping[str, Indices],
             arrays: Arrays) -> dict[str, Any]:
    """What a program or a reader needs of it."""
    status, way = found.status[:plan.samples], found.path[:plan.samples]
    counts = {str(name): int((status == name).sum()) for name in np.unique(status)}
    usable = float(np.mean(status == "ok"))
    reasons = [f"{count} of {plan.samples} samples: {name}" for name, count in counts.items() if name != "ok"]
    theta = arrays["samples_theta"]
    parameters = []
    for j, i in enumerate(plan.varied):
        q = np.quantile(theta[:, j], (0.05, 0.5, 0.95))
        parameters.append({"name": model.names[i], "unit": model.parameters[i].unit, "q05": q[0], "q50": q[1], "q95": q[2]})
    return {"status": "ok" if usable >= SHARE_NEEDED else "failed", "reasons": reasons, "source": entry.source,
            "independent": plan.independent, "samples": plan.samples, "evaluations": len(plan.theta), "statuses": counts,
            "paths": {str(name): int((way == name).sum()) for name in np.unique(way)}, "at": entry.at, "mode": entry.mode,
            "parameters": parameters, "bands": _ends(arrays), "sensitivity": _ranking(model, plan, shares, arrays),
            "numerical": {"frequency_hz": _largest(error.frequency), "damping": _largest(error.damping), "fs_hz": error.fs,
                          "period_error": error.period_error, "false_damping": error.false_damping},
            "convergence": {"counts": arrays["convergence_count"].tolist(),
                            **{name: _largest(last_move(arrays[f"convergence_{name}"])) for name in OUTPUTS}}}


def _largest(values: Array) -> float | None:
    return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else None


def _ends(arrays: Arrays) -> dict[str, Any]:
    """The band at its smallest and largest amplitude."""
    seen = np.flatnonzero(np.isfinite(arrays["frequency_q50"]))
    if not seen.size:
        return {}
    ends = [int(seen[0]), int(seen[-1])]
    return {"amplitude_m": arrays["amplitude"][ends].tolist(),
            **{f"{name}_{q}": arrays[f"{name}_{q}"][ends].tolist() for name in OUTPUTS for q in ("q05", "q50", "q95")}}


def _ranking(model: Model, plan: Plan, shares: Mapping[str, Indices], arrays: Arrays) -> dict[str, list[dict[str, Any]]]:
    """Parameters of each output, the most important first: indices at the largest amplitude that has them, and the swing there."""
    out: dict[str, list[dict[str, Any]]] = {}
    for name, found in shares.items():
        seen = np.flatnonzero(np.isfinite(found.total[0]).all(axis=0))
        if not seen.size:
            continue
        k = int(seen[-1])
        amplitude = float(arrays["index_amplitude"][k])
        at = int(np.argmin(np.abs(arrays["amplitude"] - amplitude)))
        rows = []
        for j in np.argsort(-found.total[0, :, k], kind="stable"):
            row: dict[str, Any] = {"name": model.names[plan.varied[j]], "amplitude_m": amplitude}
            for kind in ("first", "total"):
                values = getattr(found, kind)[:, j, k]
                row |= {kind: float(values[0]), f"{kind}_low": float(values[1]), f"{kind}_high": float(values[2])}
            swing = arrays[f"tornado_{name}"][j, :, at]
            rows.append(row | {"at_q05": float(swing[0]), "at_q95": float(swing[1])})
        out[name] = rows
    return out
