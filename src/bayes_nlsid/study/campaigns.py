"""A study to a campaign: its linear model and its recordings, for the mismatch engine that takes records of any kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.campaign import (
    MOST,
    PASS,
    Campaign,
    Trial,
    Use,
    campaign_notes,
    energetic_band,
    in_band,
    lower_edge,
    make_trial,
    parted,
)
from bayes_nlsid.mismatch.case import CLASSES
from bayes_nlsid.recordings.checks import check
from bayes_nlsid.recordings.reading import RecordingSpec, read_recording
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.study.building import build_structure, model_from, reduce_structure
from bayes_nlsid.study.context import Context
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.stage_linear import linear

SPLIT = 0.7
"""Share of a record that is fitted where the study marks no record for judging."""


def campaign_of(study: Study) -> Campaign:
    """The linear part of a study and its recordings; elements and candidates that the study names are left aside.

    Raises
    ------
    InputError
        If nothing is left that can be analysed.
    """
    notes: list[str] = []
    recordings = _readable(study, notes)
    nominal = reduce_structure(build_structure(study.structure), study.reduction, study.file)
    start = _calibrated(study, nominal, recordings, notes)
    judged = [r for r in recordings if r.role == "holdout"]
    fitted = [r for r in recordings if r.role == "train"]
    if not fitted:
        raise InputError(f"{study.file.name}: [[recordings]]", 'none that can be read has role = "train"', "mark one to be fitted")
    if not judged:
        fitted, judged, quiet = _split(fitted)
        recordings += quiet
        notes.append(f"No record is marked for judging (role = \"holdout\"): the last {100 * (1 - SPLIT):.0f} % of every record (the "
                     "first, where the loudest motion comes late) was kept for that and not fitted.")
    top = _top(study, start, fitted)
    entry = study.identification
    bottom = lower_edge(start, fitted, 0.0 if entry is None or entry.band is None else entry.band[0])
    if bottom > 0:
        notes.append(f"Motion below {bottom:.3g} Hz was taken off the records.")
    noises = {r.name: r for r in recordings if r.role == "noise"}
    trials = _trials(fitted, judged, noises, (bottom, top), notes)
    nominal, start = in_band(nominal, top), in_band(start, top)
    places = _places(study, start)
    notes += campaign_notes(trials, bool(noises))
    return Campaign(study.title, nominal, start, trials, places, CLASSES, {"frequency": 0.05, "damping": 0.25, "gain": 0.05}, 50.0, top,
                    tuple(notes))


def _readable(study: Study, notes: list[str]) -> list[Recording]:
    """Every recording that can be used; what had to be left out is said."""
    out = []
    for spec in study.recordings:
        recording = _read(spec, notes)
        if recording is None:
            continue
        found = check(recording)
        for f in found:
            notes.append(f"Record {recording.name}: {f.sentence}")
        out.append(recording)
    if not out:
        raise InputError(f"{study.file.name}: [[recordings]]", "none can be used", "; ".join(notes[:2]) or "check the files")
    return out


def _read(spec: RecordingSpec, notes: list[str]) -> Recording | None:
    """The recording without the channels that cannot be read; None if no response is left."""
    left = spec
    while True:
        try:
            return read_recording(left)
        except InputError as error:
            said = f"{error.where} {error.problem}"
            broken = [c for c in left.channels if c.name and repr(c.name) in said or f"{c.array}" == error.where]
            usable = [c for c in left.channels if c not in broken and c.quantity != "force"]
            if not broken or not usable or any(c.quantity == "force" for c in broken):
                if spec.role == "train" and not broken:
                    raise
                notes.append(f"Record {spec.name} was left out: {error.problem}.")
                return None
            notes.append(f"Channel {broken[0].name} of record {spec.name} was left out: {error.problem}.")
            left = replace(left, channels=tuple(c for c in left.channels if c not in broken))


def _calibrated(study: Study, nominal: ModalModel, recordings: list[Recording], notes: list[str]) -> ModalModel:
    """The model updated to modes measured at low level, if the study asks for that and it succeeds."""
    if study.linear.recording is None or not study.linear.update and not study.linear.modes:
        return nominal
    context = Context(study, study.seed, done={})
    try:
        arrays, data = linear(context)
    except (InputError, ValueError) as error:
        notes.append(f"The linear model could not be updated to modes measured at low level ({error}); calibration starts as delivered.")
        return nominal
    return model_from(arrays, data["model"])


def _split(fitted: list[Recording]) -> tuple[list[Recording], list[Recording], list[Recording]]:
    """The first part of every record to fit, the rest to judge, quiet ends; periodic records are cut at whole periods, or kept whole."""
    first, second, quiet = [], [], []
    for r in fitted:
        whole = r.n * r.dt
        if r.period is not None:
            periods = r.n // r.period
            if len(fitted) > 1 and r is fitted[-1]:
                second.append(replace(r, role="holdout"))
                continue
            if periods == 1:
                first.append(r)
                continue
            cut = max(1, round(SPLIT * periods)) * r.period * r.dt
            cut = min(cut, (periods - 1) * r.period * r.dt)
        else:
            head, tail, rest = parted(r, SPLIT)
            first.append(head)
            second.append(replace(tail, name=f"{r.name} (rest)", role="holdout"))
            if rest is not None and rest.n >= 64:
                quiet.append(replace(rest, name=f"{r.name} (quiet end)", role="noise"))
            continue
        first.append(r.window(0.0, cut))
        second.append(replace(r.window(cut, whole), name=f"{r.name} (rest)", role="holdout"))
    return first or fitted, second, quiet


def _top(study: Study, model: ModalModel, fitted: list[Recording]) -> float:
    """Hz up to which records are analysed: what the study states for its identification, else where the energy is."""
    entry = study.identification
    clock = min(r.fs for r in fitted)
    if entry is not None and entry.band is not None:
        return float(min(1.3 * entry.band[1], PASS * clock))
    return energetic_band(model, fitted)


def _trials(fitted: list[Recording], judged: list[Recording], noises: dict[str, Recording], band: tuple[float, float], notes: list[str]
            ) -> tuple[Trial, ...]:
    from bayes_nlsid.recordings.noise import noise_psd

    out = []
    most = max(4000, MOST // (len(fitted) * max(len(r.channels) for r in fitted)))
    uses: list[tuple[Recording, Use]] = [*((r, "fit") for r in fitted), *((r, "judge") for r in judged)]
    for recording, use in uses:
        reference = next((n for n in noises.values() if n.channels == recording.channels and abs(n.dt / recording.dt - 1) < 1e-9), None)
        try:
            floor = noise_psd(recording, reference)
        except ValueError as error:
            notes.append(f"Record {recording.name} was left out: {error}.")
            continue
        trial = make_trial(recording, use, band[1], floor, most, band[0])
        if use == "fit" and trial.recording.n * trial.recording.dt < 0.99 * recording.n * recording.dt:
            notes.append(f"Of record {recording.name} the first {trial.recording.n * trial.recording.dt:.3g} s were fitted.")
        out.append(trial)
    return tuple(out)


def _places(study: Study, model: ModalModel) -> tuple[str, ...]:
    """Joints that the study suspects, else those of the structure, else every location that is no copy of another."""
    entry = study.identification
    named = tuple(entry.joints) if entry is not None and entry.joints else tuple(model.joints)
    names = named or tuple(model.locations)
    kept: list[str] = []
    for name in names:
        row = model.rows([name])[0]
        if np.abs(row).max() > 0 and not any(np.allclose(row, model.rows([k])[0], rtol=1e-9, atol=0) for k in kept):
            kept.append(name)
    return tuple(kept)
