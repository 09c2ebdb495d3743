"""What one table of a study says, held against the others, before anything is computed."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from math import inf
from pathlib import Path
from typing import Any

from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.structure import Structure
from bayes_nlsid.study.building import library
from bayes_nlsid.study.reading_structure import GROUPS
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.store import file_digest
from bayes_nlsid.study.table import nearest


def check_consistency(study: Study, built: Structure | ModalModel) -> None:
    """Modes, parts, masters, records and parameters that are named must exist and serve the purpose they are named for.

    Parameters
    ----------
    study : Study
    built : Structure or ModalModel
        The structure that the study describes.

    Raises
    ------
    InputError
        On the first contradiction.
    """
    where = study.file.name
    _check_modes(study, built, where)
    _check_parts(study, built, where)
    _check_roles(study, where)
    _check_windows(study, where)
    _check_priors(study, where)


def _check_modes(study: Study, built: Structure | ModalModel, where: str) -> None:
    count = built.modes if isinstance(built, ModalModel) else min(study.reduction.modes or 10, len(built.dofs))
    asked: list[tuple[str, Sequence[int]]] = [("linear", study.linear.modes)]
    if study.identification is not None:
        asked.insert(0, ("identification", study.identification.modes))
    asked += [(name, (entry.mode,)) for name, entry in (("prediction", study.prediction), ("montecarlo", study.montecarlo))
              if entry is not None]
    for table, modes in asked:
        key = "modes" if table in ("identification", "linear") else "mode"
        beyond = [k for k in modes if k > count]
        if beyond:
            mend = "name lower ones" if isinstance(built, ModalModel) else "raise modes in [reduction], or name lower ones"
            raise InputError(f"{where}: [{table}] {key}", f"mode {beyond[0]} does not exist, the model has {count}", mend)
    if study.identification is not None and isinstance(built, ModalModel):
        refuse_band(study, float(built.frequency[study.identification.main - 1]))
    if len(study.linear.damping) > count:
        raise InputError(f"{where}: [linear] damping", f"{len(study.linear.damping)} ratios are given for {count} mode{'s'[:count > 1]}",
                         "give fewer")


def refuse_band(study: Study, frequency: float) -> None:
    """The residual is that of the main mode's equation, so its band must hold the main mode.

    Parameters
    ----------
    study : Study
    frequency : float
        Of the main mode, Hz.

    Raises
    ------
    InputError
        If a stated band leaves it out.
    """
    entry = study.identification
    if entry is not None and entry.band is not None and not entry.band[0] < frequency < entry.band[1]:
        raise InputError(f"{study.file.name}: [identification] band",
                         f"{entry.band[0]:g} to {entry.band[1]:g} Hz leaves out mode {entry.main} at {frequency:.4g} Hz, the main one",
                         "widen the band, or name another main mode")


def _check_parts(study: Study, built: Structure | ModalModel, where: str) -> None:
    if isinstance(built, ModalModel):
        if study.linear.update:
            raise InputError(f"{where}: [linear] update", "an oscillator has no parts to update",
                             "remove update; its frequency and damping are measured directly")
        return
    known = list(dict.fromkeys((*built.K_parts, *built.M_parts)))
    named = [part for _, parts in study.linear.update for part in parts]
    for part in named:
        if part not in known:
            raise InputError(f"{where}: [linear] update", f"{part!r} is not a part of the structure", nearest(part, known))
        if named.count(part) > 1:
            raise InputError(f"{where}: [linear] update", f"{part!r} stands in two groups", "name each part once")
    if study.reduction.method != "none":
        places = (*GROUPS, *built.locations)
        for name in study.reduction.masters:
            if name not in places:
                raise InputError(f"{where}: [reduction] masters", f"{name!r} is neither a group nor a location", nearest(name, places))


def _check_roles(study: Study, where: str) -> None:
    """Records that judge a prediction must not have been fitted; a backbone needs a sensor where it is drawn."""
    prediction = study.prediction
    if prediction is None:
        return
    recordings = {r.name: r for r in study.recordings}
    for name in prediction.heldout:
        role = recordings[name].role
        if role in ("train", "noise"):
            why = "is fitted, so it cannot judge the fit" if role == "train" else "was taken with the excitation off"
            raise InputError(f"{where}: [prediction] heldout", f"recording {name!r} has role = {role!r}: it {why}",
                             'name one of role = "holdout"')
    if prediction.measured is not None:
        found = recordings[prediction.measured]
        if found.role == "noise":
            raise InputError(f"{where}: [prediction] measured", f"recording {found.name!r} was taken with the excitation off",
                             "name a free decay")
        sensors = [c.location for c in found.channels if c.quantity != "force"]
        if prediction.at not in sensors:
            raise InputError(f"{where}: [prediction] measured", f"recording {found.name!r} has no channel at {prediction.at!r}",
                             f"choose at among {', '.join(sensors)}")


def _check_windows(study: Study, where: str) -> None:
    """What judges must not hold samples that are fitted: windows of the same signals of one file, or of its copy, must not overlap."""
    judges = study.prediction.heldout if study.prediction is not None else ()
    for number, kept in enumerate(study.recordings, start=1):
        if kept.role != "holdout" and kept.name not in judges:
            continue
        signals = {(c.array, c.column) for c in kept.channels if c.quantity != "force"}
        for fitted in study.recordings:
            shared = signals & {(c.array, c.column) for c in fitted.channels if c.quantity != "force"}
            if fitted.role != "train" or fitted is kept or not shared or not _same_file(fitted.file, kept.file):
                continue
            low, high = (edge(a, b) for edge, a, b in zip((max, min), kept.window or (0.0, inf), fitted.window or (0.0, inf), strict=True))
            if low < high:
                part = f"{low:g} to {high:g} s" if high < inf else f"all that follows {low:g} s"
                raise InputError(f"{where}: [[recordings]] {number} window",
                                 f"{kept.name!r} is kept for judging, but {part} of it is fitted in {fitted.name!r}",
                                 "move one of the windows, so that nothing judges what it was fitted to")


def _same_file(one: str, other: str) -> bool:
    """Whether two paths lead to the same bytes."""
    a, b = Path(one), Path(other)
    return a == b or (a.stat().st_size == b.stat().st_size and file_digest(a) == file_digest(b))


def _check_priors(study: Study, where: str) -> None:
    if study.posterior is None or study.identification is None:
        return
    walkers = study.posterior.walkers
    if walkers is not None and (walkers < 8 or walkers % 2):
        raise InputError(f"{where}: [posterior] walkers", f"{walkers} is not an even number from 8 up", "leave it out, or write 32 or more")
    possible = list(dict.fromkeys(_parameters(study)))
    for i, prior in enumerate(study.posterior.priors, start=1):
        if not any(same_parameter(prior.parameter, name) for name in possible):
            anywhere = list(dict.fromkeys(re.sub(r"\[.*[^0-9].*\]", "[*]", name) for name in possible))
            raise InputError(f"{where}: [[posterior.priors]] {i} parameter",
                             f"{prior.parameter!r} is none of the parameters that this study can have", nearest(prior.parameter, anywhere))


    taken: dict[str, int] = {}
    for i, group in enumerate(study.posterior.groups, start=1):
        for pattern in group.parameters:
            matched = [name for name in possible if same_parameter(pattern, name)]
            if not matched:
                anywhere = list(dict.fromkeys(re.sub(r"\[.*[^0-9].*\]", "[*]", name) for name in possible))
                raise InputError(f"{where}: [[posterior.groups]] {i} parameters",
                                 f"{pattern!r} is none of the parameters that this study can have", nearest(pattern, anywhere))
            for name in matched:
                if taken.setdefault(name, i) != i:
                    raise InputError(f"{where}: [[posterior.groups]] {i} parameters", f"{name} is in group {taken[name]} already",
                                     "name each parameter in one group")


def same_parameter(pattern: str, name: str) -> bool:
    """Whether a name of a study, in which ``*`` stands for any part, means a parameter."""
    return name == pattern or fnmatchcase(name, pattern.replace("[", "[[]"))


def _parameters(study: Study) -> Iterator[str]:
    """Every name that a parameter can have, whichever terms are chosen: ``f[1]``, ``cubic[J1].c``, tied places joined by ``+``."""
    entry: Any = study.identification
    yield from (f"{kind}[{k}]" for kind in ("f", "zeta") for k in entry.free_modes)
    if entry.free_gain:
        yield "gain"
    terms = library(study.terms)
    places = ["+".join(entry.joints)] if entry.tied else list(entry.joints)
    for name in entry.candidates:
        yield from (f"{name}[{place}].{p.name}" for place in places for p in terms[name].params)
    for element in entry.elements:
        at = ["+".join(element.locations)] if element.tied else list(element.locations)
        fixed = {key for key, _ in element.fixed}
        yield from (f"{element.term}[{place}].{p.name}" for place in at for p in terms[element.term].params if p.name not in fixed)
