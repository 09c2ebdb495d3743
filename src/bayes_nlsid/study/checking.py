"""``nlsid check``: every recording read and examined, so that a run does not stop half-way over what could be known before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.context import Context
from bayes_nlsid.study.schema import IdentificationEntry, Study
from bayes_nlsid.study.stage_read import describe, refuse_dead, refuse_driven


def examine(study: Study) -> list[dict[str, Any]]:
    """What the recordings of a study hold; see `stage_read.describe`.

    Raises
    ------
    InputError
        If one of them cannot be used as the study says, or cannot carry the band of the identification.
    """
    context = Context(study, study.seed)
    found = []
    for recording in context.recordings.values():
        found.append(describe(recording, context.noise(recording)))
        refuse_dead(context, recording, found[-1]["findings"])
    if study.prediction is not None and study.prediction.measured is not None:
        refuse_driven(context, context.recordings[study.prediction.measured])
    if study.identification is not None:
        for record in found:
            if record["role"] == "train":
                _check_rate(study, study.identification, record)
    return found


def _check_rate(study: Study, entry: IdentificationEntry, record: Mapping[str, Any]) -> None:
    """Rate, band and settling time of the identification against one recording."""
    recorded, name, where = float(record["rate"]), record["name"], f"{study.file.name}: [identification]"
    rate = float(entry.rate or recorded)
    whole = max(1, round(recorded / rate))
    if abs(recorded / rate - whole) > 1e-6:
        raise InputError(f"{where} rate", f"{rate:g} Hz is not the {recorded:g} Hz of recording {name!r} divided by a whole number",
                         f"write for instance {recorded / whole:g}")
    if entry.band is not None and entry.band[1] >= rate / 2:
        raise InputError(f"{where} band", f"{entry.band[1]:g} Hz is not below half the rate of recording {name!r}, {rate:g} Hz",
                         "lower the band or raise the rate")
    if entry.settle >= record["seconds"]:
        raise InputError(f"{where} settle", f"{entry.settle:g} s leave nothing of recording {name!r}", "shorten it")
