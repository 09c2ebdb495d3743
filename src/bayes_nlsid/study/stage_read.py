"""Stage ``read``: recordings into SI, checked, with their noise floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.checks import check
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.reading import RecordingSpec, read_recording
from bayes_nlsid.recordings.recording import SI_UNIT, Recording
from bayes_nlsid.study.axes import thinned
from bayes_nlsid.study.context import Arrays, Context, Result, same_sensors

DRIVEN = 0.1
"""Largest force in the second half of a free decay over that in the first, where a hammer may have struck."""
MOST = 400_000
"""Samples of a recording that are kept for its picture."""


def read(context: Context) -> Result:
    """Read every recording.

    Returns
    -------
    arrays, data
        ``<i>.noise_frequency`` (f,), ``<i>.noise_psd`` (f, s) for recording i; ``view<k>.signals`` (n, c) and ``view<k>.step`` for
        every distinct set of signals, as pictures show them. ``data["recordings"]`` describes each recording.
    """
    arrays: Arrays = {}
    records = []
    for i, recording in enumerate(context.recordings.values()):
        context.progress(i / len(context.recordings), recording.name)
        floor = context.noise(recording)
        arrays[f"{i}.noise_frequency"], arrays[f"{i}.noise_psd"] = floor.frequency, floor.psd
        records.append(describe(recording, floor))
        refuse_dead(context, recording, records[-1]["findings"])
        for finding in records[-1]["findings"]:
            if finding["severity"] != "note":
                context.note(told(recording.name, finding))
    for quiet in context.role("noise"):
        if all(same_sensors(quiet, r) is None for r in context.recordings.values() if r.role != "noise"):
            context.note(f"noise recording {quiet.name} serves no other recording: it lacks one of their sensors")
    views = _views(context, arrays)
    return arrays, {"recordings": records, "views": views}


def told(recording: str, finding: Mapping[str, Any]) -> str:
    """A finding in one sentence that names recording and channel."""
    channel = f", channel {finding['channel']}" if finding["channel"] else ""
    return f"{recording}{channel}: {finding['sentence']}; {finding['mend']}"


def refuse_dead(context: Context, recording: Recording, findings: Sequence[Mapping[str, Any]]) -> None:
    """A response that never moves holds nothing to identify from.

    Raises
    ------
    InputError
        If a response channel of a recording that is fitted is dead.
    """
    if recording.role not in ("train", "linear"):
        return
    responses = {c.name for c in recording.channels}
    for finding in findings:
        if finding["kind"] == "dead" and finding["channel"] in responses:
            where = f"{context.study.file.name}: recording {recording.name!r}, channel {finding['channel']!r}"
            raise InputError(where, finding["sentence"], "correct the array or column, or drop the channel")


def refuse_driven(context: Context, recording: Recording) -> None:
    """A backbone is read from a motion that decays freely.

    Raises
    ------
    InputError
        If the recorded force is still at work in the second half of the record.
    """
    early, late = (float(np.abs(part).max()) if part.size else 0.0 for part in np.array_split(recording.force, 2))
    if late > DRIVEN * early:
        raise InputError(f"{context.study.file.name}: [prediction] measured",
                         f"recording {recording.name!r} is driven to its end", "name a free decay, or a window of one")


def describe(recording: Recording, floor: NoiseFloor) -> dict[str, Any]:
    """What tables and the plan of a study say of one recording."""
    noise = floor.rms()
    peaks = np.abs(recording.response).max(axis=0)
    channels = [{"name": c.name, "location": c.location, "quantity": c.quantity, "unit": SI_UNIT[c.quantity], "file_unit": c.unit,
                 "polarity": c.polarity, "rms": float(np.std(recording.response[:, k])), "peak": float(peaks[k]),
                 "noise_rms": float(noise[k])} for k, c in enumerate(recording.channels)]
    inputs = [{"name": c.name, "location": c.location, "unit": "N", "file_unit": c.unit, "rms": float(np.std(recording.force[:, k])),
               "peak": float(np.abs(recording.force[:, k]).max())} for k, c in enumerate(recording.inputs)]
    findings = [{"severity": f.severity, "channel": f.channel, "sentence": f.sentence, "mend": f.mend, "kind": f.kind}
                for f in check(recording)]
    return {"name": recording.name, "role": recording.role, "rate": recording.fs, "seconds": recording.n * recording.dt,
            "start": recording.start, "period": recording.period, "sha256": recording.sha256, "channels": channels, "inputs": inputs,
            "noise": floor.how, "noise_sure": floor.sure, "findings": findings, "notes": list(recording.notes)}


def _views(context: Context, arrays: Arrays) -> list[dict[str, Any]]:
    """One picture for every distinct set of signals: recordings that are windows of the same file share it."""
    groups: dict[tuple[Any, ...], list[RecordingSpec]] = {}
    for spec in context.study.recordings:
        groups.setdefault((spec.file, spec.channels), []).append(spec)
    names = list(context.recordings)
    views = []
    for k, specs in enumerate(groups.values()):
        whole = _whole(specs[0], context)
        step = thinned(whole.n, MOST)
        signals = np.concatenate([whole.response, whole.force], axis=1)[step]
        arrays[f"view{k}.signals"] = signals.astype(np.float32)
        windows = [{"name": s.name, "role": s.role, "span": list(s.window or (0.0, whole.n * whole.dt))} for s in specs]
        views.append({"title": ", ".join(s.name for s in specs), "step": whole.dt * (step.step or 1), "noise": names.index(specs[0].name),
                      "labels": [c.name for c in (*whole.channels, *whole.inputs)],
                      "units": [SI_UNIT[c.quantity] for c in whole.channels] + ["N"] * len(whole.inputs), "windows": windows,
                      "responses": len(whole.channels)})
    return views


def _whole(spec: RecordingSpec, context: Context) -> Recording:
    """The file without its window, if it can be read so (outside the window samples may be missing)."""
    if spec.window is None:
        return context.recordings[spec.name]
    try:
        return read_recording(replace(spec, window=None, period=None))
    except InputError:
        return context.recordings[spec.name]
