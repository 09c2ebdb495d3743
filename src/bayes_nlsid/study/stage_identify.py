"""Stage ``identify``: which force laws, and their least-squares parameters, for the main form and for every alternative."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.identification.fit import Fit, Start, fit
from bayes_nlsid.identification.harmonics import lost_motion
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import Scenario, scenario
from bayes_nlsid.identification.select import Selection, select
from bayes_nlsid.model import Element, Model
from bayes_nlsid.recordings.kinematics import kinematics
from bayes_nlsid.structure.modal import ModalData, ModalModel
from bayes_nlsid.structure.sensing import modal_data
from bayes_nlsid.study.building import build_element, element_from, element_record
from bayes_nlsid.study.consistency import refuse_band
from bayes_nlsid.study.context import Arrays, Context, Result
from bayes_nlsid.study.schema import AlternativeEntry, IdentificationEntry


def entry_of(context: Context) -> IdentificationEntry:
    """The study's table; only called when there is one."""
    entry = context.study.identification
    assert entry is not None
    return entry


def chosen_scenario(context: Context) -> Scenario:
    """The study's scenario in 0-based modes."""
    entry = entry_of(context)
    return scenario(entry.scenario, [k - 1 for k in entry.modes], entry.main - 1)


def band_of(context: Context, model: ModalModel) -> tuple[float, float]:
    """The stated band, or from half the lowest to one and a half times the highest mode."""
    entry = entry_of(context)
    if entry.band is not None:
        return entry.band
    modes = model.frequency[[k - 1 for k in entry.modes]]
    nyquist = min(r.fs for r in context.role("train")) / 2
    return 0.5 * float(modes.min()), min(1.5 * float(modes.max()), 0.8 * nyquist)


def observed(context: Context, role: str = "train") -> tuple[ModalData, ...]:
    """Every recording of a role in modal coordinates.

    Raises
    ------
    InputError
        If the sensors cannot tell the modes apart, or the band does not fit the recording.
    """
    entry, model = entry_of(context), context.model
    unknown = [k for k in entry.modes if k > model.modes]
    if unknown:
        raise InputError(f"{context.study.file.name}: [identification] modes",
                         f"mode {unknown[0]} does not exist, the model has {model.modes}",
                         "raise modes in [reduction], or name lower ones")
    refuse_band(context.study, float(model.frequency[entry.main - 1]))
    chosen = chosen_scenario(context)
    places = tuple(dict.fromkeys([*entry.joints, *(place for e in _all_elements(entry) for place in e.locations)]))
    try:
        return tuple(_settled(modal_data(r, model, chosen.coupled, places, band_of(context, model), noise=context.noise(r), fs=entry.rate,
                                bands=[entry.mode_bands[entry.modes.index(k + 1)] for k in chosen.coupled] if entry.mode_bands else None,
                                static_correction=entry.static_correction), entry.settle) for r in context.role(role))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{context.study.file.name}: [identification]", str(error), "change modes, band, rate or the recordings") from None


def _settled(data: ModalData, seconds: float) -> ModalData:
    """The same data, whose first seconds serve the memory of the joints only.

    Raises
    ------
    ValueError
        If nothing is left to fit.
    """
    first = max(data.valid.start or 0, round(seconds / data.dt))
    last = data.n if data.valid.stop is None else data.valid.stop
    if first >= last - 1:
        raise ValueError(f"settle {seconds:g} s leaves nothing of recording {data.name!r} to fit")
    return replace(data, valid=slice(first, last))


def _all_elements(entry: IdentificationEntry) -> list[Any]:
    return [*entry.elements, *(e for a in entry.alternatives for e in a.elements)]


def base_problem(context: Context, elements: Sequence[Element] = (), data: tuple[ModalData, ...] | None = None) -> Problem:
    """The regression problem of the study with the given elements."""
    entry = entry_of(context)
    model = Model(context.model, tuple(elements), tuple(k - 1 for k in entry.free_modes), entry.free_gain)
    return Problem(model, data if data is not None else observed(context), chosen_scenario(context), entry.band, entry.widening,
                   (entry.frequency_widening, entry.damping_widening), places=entry.places)


def identify(context: Context) -> Result:
    """Select or fit the main form, then every alternative, on the same recordings.

    Returns
    -------
    arrays, data
        ``<v>.theta``, ``<v>.s`` (P,), ``<v>.covariance`` (P, P) for variant v (0 is the main one); ``data["variants"]`` describes them.
    """
    entry = entry_of(context)
    data = observed(context)
    variants = [AlternativeEntry("main", entry.candidates, entry.elements), *entry.alternatives]
    arrays: Arrays = {}
    records = []
    for v, variant in enumerate(variants):
        def progress(share: float, sentence: str, v: int = v, name: str = variant.name) -> None:
            context.progress((v + share) / len(variants), f"{name}: {sentence}")

        record, extra = _variant(context, variant, data, progress)
        records.append(record)
        arrays |= {f"{v}.{name}": value for name, value in extra.items()}
    return arrays, {"variants": records, "band_hz": list(band_of(context, context.model)), "scenario": entry.scenario,
                    "records": [d.name for d in data], "condition": max(d.condition for d in data),
                    "motion": _integrated(context)}


def _integrated(context: Context) -> list[dict[str, Any]]:
    """What became of the channels on the way to displacement and velocity: band, stretch without edge effects, estimated error."""
    entry = entry_of(context)
    rows = []
    for recording in context.role("train"):
        for band in dict.fromkeys(entry.mode_bands or (band_of(context, context.model),)):
            found = kinematics(recording, band, entry.rate)
            span = [found.valid.start * found.dt, found.valid.stop * found.dt]
            rows.append({"record": recording.name, "band_hz": list(band), "span_s": span,
                         "channels": [c.name for c in found.channels], "error": found.error.tolist()})
    return rows


def _variant(context: Context, variant: AlternativeEntry, data: tuple[ModalData, ...], progress: Any) -> tuple[dict[str, Any], Arrays]:
    entry = entry_of(context)
    known = [build_element(e, context.terms) for e in variant.elements]
    seed = context.number(f"identify {variant.name}")
    try:
        bare = base_problem(context, (), data)
        problem = bare.with_elements(tuple(known)) if known else bare
        if variant.candidates:
            candidates = _candidates(context, variant, bare, entry)
            selection = select(problem, candidates, eps1=entry.eps1, eps2=entry.eps2, starts=entry.starts, seed=seed,
                               most=entry.most, workers=context.workers, progress=progress)
            found, linear = selection.fit, selection.mse_linear
        else:
            progress(0.1, "fitting")
            selection, found = None, fit(problem, starts=entry.starts, seed=seed)
            linear = fit(bare, starts=1, seed=seed).mse
        if entry.output_error:
            found = _refined(context, found, progress)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{context.study.file.name}: [identification]", str(error), "change the candidates, joints or modes") from None
    lost = 0.0 if entry.output_error else lost_motion(found.problem, found.theta)
    return _record(variant.name, found, linear, selection) | {"lost_motion": lost}, {
        "theta": found.theta, "s": found.s, "covariance": found.covariance, "bounds": found.problem.bounds,
        "starts": np.array([x.theta for x in found.starts])}


def _candidates(context: Context, variant: AlternativeEntry, bare: Problem, entry: IdentificationEntry) -> list[Element]:
    """Every candidate at all joints; those that the linear part or the bounds rule out are named in the log."""
    out = []
    for name in variant.candidates:
        element = Element(context.terms[name], entry.joints, entry.tied, entry.excess)
        try:
            bare.with_elements((element,))
        except ValueError as error:
            context.note(f"{name} is left out: {error}")
            continue
        out.append(element)
    return out


def _refined(context: Context, found: Fit, progress: Any) -> Fit:
    """Least squares on the simulated response, started from the regression."""
    from bayes_nlsid.identification.output_error import output_error

    return output_error(found, context.role("train"), progress=lambda share, sentence: progress(0.8 + 0.2 * share, sentence))


def _record(name: str, found: Fit, linear: float, selection: Selection | None) -> dict[str, Any]:
    problem = found.problem
    # under the weights of the search, so that it compares with the linear model, the path and the floor; the fit may have had others
    regression = float(problem.mse(found.theta, problem.default_weight)) if np.isfinite(found.theta).all() else found.mse
    record: dict[str, Any] = {
        "name": name, "elements": [element_record(e) for e in problem.model.elements], "names": list(problem.names),
        "units": [p.unit for p in problem.model.parameters], "mse": regression, "mse_of_fit": found.mse, "mse_linear": linear,
        "floor": float(problem.floor), "rank": found.rank,
        "status": found.status, "reasons": list(found.reasons), "samples": problem.samples,
        "starts": [{"mse": s.mse, "status": s.status, "evaluations": s.evaluations, "seconds": s.seconds} for s in found.starts]}
    if selection is not None:
        record |= {
            "forward": [element_record(e) for e in selection.forward], "backward": [element_record(e) for e in selection.backward],
            "path": [{"round": s.round, "action": s.action, "element": s.element, "mse": s.mse, "accepted": s.accepted, "reason": s.reason,
                      "aliases": list(s.aliases)} for s in selection.path],
            "tried": [{"round": t.round, "action": t.action, "element": t.element, "mse": t.mse, "statistic": t.statistic,
                       "threshold": t.threshold, "status": t.status, "seconds": t.seconds} for t in selection.tried],
            "aliases": list(selection.aliases)}
    return record


def stored_fit(context: Context, variant: int = 0) -> Fit:
    """The fit of a variant, rebuilt from what the stage stored."""
    saved = context.done["identify"]
    record = saved.data["variants"][variant]
    elements = tuple(element_from(e, context.terms) for e in record["elements"])
    problem = base_problem(context, elements)
    pick = {name: np.asarray(saved.arrays[f"{variant}.{name}"], dtype=float) for name in ("theta", "s", "covariance")}
    starts = tuple(Start(np.asarray(at, dtype=float), entry["mse"], entry["status"], entry["evaluations"], entry["seconds"])
                   for at, entry in zip(saved.arrays[f"{variant}.starts"], record["starts"], strict=True))
    return Fit(pick["theta"], pick["s"], record["mse_of_fit"], pick["covariance"], record["rank"], starts, record["status"],
               tuple(record["reasons"]), problem, problem.weight, context.number(f"identify {record['name']}"))


def stored_model(context: Context, variant: int = 0) -> tuple[Model, np.ndarray]:
    """Model and theta of a variant, without the recordings."""
    saved = context.done["identify"]
    record = saved.data["variants"][variant]
    model = Model(context.model, tuple(element_from(e, context.terms) for e in record["elements"]),
                  tuple(k - 1 for k in entry_of(context).free_modes), entry_of(context).free_gain)
    return replace(model), np.asarray(saved.arrays[f"{variant}.theta"], dtype=float)
