"""Stage ``linear``: the structure as stated, the modes as measured at low level, and the model updated to them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.structure import Structure, mac
from bayes_nlsid.study.building import build_structure, model_record, reduce_structure
from bayes_nlsid.study.context import Arrays, Context, Result


def linear(context: Context) -> Result:
    """Build, measure, update, reduce.

    Returns
    -------
    arrays, data
        ``model.*`` is the modal model for identification; ``data["modes"]`` compares measured and modelled modes, ``data["polarity"]``
        names channels whose sign disagrees, ``data["updated"]`` lists the parts that were scaled.
    """
    study = context.study
    context.progress(0.0, "building the structure")
    structure = build_structure(study.structure)
    nominal = reduce_structure(structure, study.reduction, study.file)
    if study.linear.recording is None and study.linear.file is None:
        model = _with_stated_damping(context, nominal)
        arrays, names = model_record(model)
        notes = [*model.notes, "no low-level recording was named"]
        signs = _signs(context, nominal, None)
        return arrays, {"model": names, "modes": [], "polarity": signs, "updated": [], "notes": notes}
    wanted = tuple(k - 1 for k in study.linear.modes) or tuple(range(nominal.modes))
    measured, source = _measured(context, nominal, wanted)
    signs = _signs(context, nominal, measured)
    missing = [f"mode {k + 1}, {nominal.frequency[k]:.4g} Hz in the model, was not found in {source}: it was not "
               "excited, or the model is more than 10 % off" for k in wanted if k not in measured.nominal]
    for sentence in missing:
        context.note(sentence)
    final, updated, notes = _updated(context, structure, measured)
    context.progress(0.8, "reducing")
    computed = reduce_structure(final, study.reduction, study.file)
    model = _with_stated_damping(context, _measured_into(computed, measured, study.linear.use_measured))
    arrays, names = model_record(model)
    table, extra = _compare(measured, nominal, computed)
    arrays |= extra
    if study.structure.kind == "beam" and table:
        arrays |= _shape_lines(context, updated, [row["number"] - 1 for row in table])
    return arrays, {"model": names, "modes": table, "polarity": signs, "updated": updated, "shape_locations": list(measured.locations),
                    "notes": [*model.notes, *measured.notes, *missing, *notes], "recording": study.linear.recording or ""}


def _measured(context: Context, nominal: ModalModel, wanted: tuple[int, ...]) -> tuple[IdentifiedModes, str]:
    """Modes from the low-level recording or from the file of a modal test, and what to call that source."""
    entry = context.study.linear
    if entry.file is not None:
        from bayes_nlsid.structure.modal_results import matched_to, read_modal_results

        found = matched_to(read_modal_results(entry.file, nominal.locations, dict(entry.sensors)), nominal, wanted)
        if not found.modes:
            raise InputError(f"{context.study.file.name}: [linear] file", f"no mode of {entry.file.name} is near one of the model",
                             "check the frequencies of the model, or leave the file out")
        return found, f"file {entry.file.name!r}"
    from bayes_nlsid.structure.identify import identify_modes

    context.progress(0.2, "identifying modes from low-level data")
    recording = _low_level(context)
    return identify_modes(recording, nominal, modes=wanted), f"recording {recording.name!r}"


def _signs(context: Context, nominal: ModalModel, measured: IdentifiedModes | None) -> list[dict[str, Any]]:
    """Channels that disagree with the model: among themselves over the measured modes, and in their answer to a measured force.

    Where no modes were measured, those of the first recording to be fitted serve, if it is a free decay.
    """
    from bayes_nlsid.structure.agreement import response_findings
    from bayes_nlsid.structure.identify import identify_modes
    from bayes_nlsid.structure.polarity import polarity

    context.progress(0.5, "comparing signs with the model")
    entry, trained = context.study.identification, context.role("train")
    wanted = [k - 1 for k in entry.modes] if entry is not None else list(range(nominal.modes))
    if measured is None and trained and trained[0].free and len(trained[0].channels) > 1:
        low = [k for k in wanted if nominal.frequency[k] < 0.4 * trained[0].fs]
        measured = identify_modes(trained[0], nominal, modes=low) if low else None
    found = [] if measured is None else list(polarity(measured, nominal))
    forced = [r for r in (*([_low_level(context)] if context.study.linear.recording is not None else []), *trained) if not r.free]
    if forced:
        known = {f.channel for f in found}
        again = response_findings(forced[0], nominal, wanted, scale=entry is None or not entry.free_gain)
        found += [f for f in again if f.kind == "scaled" or f.channel not in known]
    for finding in found:
        context.note(finding.sentence)
    return [{"channel": f.channel, "sentence": f.sentence} for f in found]


def _updated(context: Context, structure: Structure | ModalModel, measured: Any) -> tuple[Any, list[dict[str, Any]], list[str]]:
    """The structure with its named parts scaled to the measured modes, a row for each part, and what to beware of."""
    groups = dict(context.study.linear.update)
    if not groups:
        return structure, [], []
    where = f"{context.study.file.name}: [linear] update"
    if not isinstance(structure, Structure):
        raise InputError(where, "an oscillator has no parts to update", "remove update; its frequency and damping are measured directly")
    from bayes_nlsid.structure.updating import update

    context.progress(0.6, "updating " + ", ".join(groups))
    try:
        found = update(structure, groups, measured)
    except ValueError as error:
        raise InputError(where, str(error), "name parts of the structure") from None
    rows = [{"part": name, "parts": list(groups[name]), "factor": float(value), "log_sd": float(sd),
             "identifiable": name not in found.unidentifiable}
            for name, value, sd in zip(found.names, found.values, found.sd, strict=True)]
    return found.structure, rows, [] if found.status == "ok" else [f"updating: {found.status}"]


def _shape_lines(context: Context, updated: list[dict[str, Any]], modes: list[int]) -> Arrays:
    """Mode shapes along the beam for the picture: the same beam with 41 more points, scaled like the model."""
    entry = context.study.structure
    values = entry.parameters
    x = np.linspace(0.0, values["length"], 41)
    points = (*values.get("points", ()), *((f"shape {i}", float(p)) for i, p in enumerate(x)))
    structure = build_structure(replace(entry, values=tuple({**values, "points": points}.items())))
    assert isinstance(structure, Structure)
    if updated:
        structure = structure.scaled({part: row["factor"] for row in updated for part in row["parts"]})
    whole = replace(context.study.reduction, method="none", masters=(), modes=max(modes) + 1)
    fine = reduce_structure(structure, whole, context.study.file)
    return {"line_position": x, "line": fine.rows([f"shape {i}" for i in range(len(x))])[:, modes]}


def _low_level(context: Context) -> Recording:
    entry = context.study.linear
    assert entry.recording is not None
    recording = context.recordings[entry.recording]
    return recording if entry.window is None else recording.window(*entry.window)


def _with_stated_damping(context: Context, model: ModalModel) -> ModalModel:
    """The model with the damping ratios that the study states; the first ones, mode by mode."""
    stated = context.study.linear.damping
    if not stated:
        return model
    if len(stated) > model.modes:
        raise InputError(f"{context.study.file.name}: [linear] damping", f"{len(stated)} ratios are given for {model.modes} modes",
                         "give fewer")
    zeta = model.zeta.copy()
    zeta[:len(stated)] = stated
    spread = model.zeta_sd.copy()
    spread[:len(stated)] = 0.0
    return replace(model, zeta=zeta, zeta_sd=spread)


def _measured_into(model: ModalModel, measured: Any, frequencies: bool) -> ModalModel:
    """Measured damping, and frequencies if asked for, in place of the computed ones."""
    from bayes_nlsid.structure.modal_model import with_damping

    return with_damping(model, measured, measured_frequencies=frequencies)


def _compare(measured: Any, nominal: ModalModel, computed: ModalModel) -> tuple[list[dict[str, Any]], Arrays]:
    """Table and arrays of measured modes against the model before and after updating."""
    from bayes_nlsid.structure.identified import pair

    pairs = dict(pair(measured, computed))
    before = dict(pair(measured, nominal))
    kept = [i for i in range(measured.modes) if i in pairs]
    rows = []
    for i in kept:
        k = pairs[i]
        start = float(nominal.frequency[before[i]]) if i in before else None
        rows.append({"number": k + 1, "measured_hz": float(measured.frequency[i]), "measured_sd": float(measured.frequency_sd[i]),
                     "zeta": float(measured.zeta[i]), "zeta_sd": float(measured.zeta_sd[i]), "stated_hz": start,
                     "model_hz": float(computed.frequency[k]), "amplitude_m": float(measured.amplitude[i]), "status": measured.status[i]})
    at: NDArray[np.float64] = computed.rows(measured.locations)[:, [pairs[i] for i in kept]]
    shapes = measured.shapes[:, kept]
    likeness = mac(shapes, at)
    for row, value in zip(rows, np.diag(likeness), strict=True):
        row["mac"] = float(value)
    return rows, {"mac": likeness, "measured_shapes": shapes, "model_at_sensors": at}
