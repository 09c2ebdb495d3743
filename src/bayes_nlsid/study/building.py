"""Records of a study file to the objects of the other rooms, and those objects to arrays and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.term import Term
from bayes_nlsid.model import Element
from bayes_nlsid.structure.modal import ASSUMED, ModalModel
from bayes_nlsid.structure.modal_model import UNKNOWN_DAMPING
from bayes_nlsid.structure.structure import Structure
from bayes_nlsid.study.schema import ElementEntry, ReductionEntry, StructureEntry, UserTermEntry


def build_structure(entry: StructureEntry) -> Structure | ModalModel:
    """The structure a study names: matrices with locations, or directly a modal model for an oscillator.

    Raises
    ------
    ValueError
        If the builder refuses the values (its message says which).
    """
    values = entry.parameters
    if entry.kind == "beam":
        from bayes_nlsid.structure.beam import LappedBeam, lapped_beam

        springs = {k: None for k in ("tangential", "normal", "rotation") if values.get(k) is False}
        return lapped_beam(LappedBeam(**{**values, **springs}))
    if entry.kind == "oscillator":
        from bayes_nlsid.structure.chains import oscillator

        found = oscillator(**values)
        return found if "zeta" in values or "damping" in values else _guessed(found, UNKNOWN_DAMPING)
    from bayes_nlsid.structure.matrices import read_matrices

    files: dict[str, Any] = dict(entry.files)
    return read_matrices(**files, **values)


def reduce_structure(structure: Structure | ModalModel, entry: ReductionEntry, file: Path) -> ModalModel:
    """The modal model that identification works with, reduced as the study in ``file`` says.

    Raises
    ------
    InputError
        If masters are unknown or cannot carry the structure.
    """
    if isinstance(structure, ModalModel):
        return structure
    from bayes_nlsid.structure.modal_model import modal_model
    from bayes_nlsid.structure.reduction import guyan, iirs

    modes = entry.modes or 10
    if entry.method == "none":
        return _guessed(modal_model(structure, modes), entry.damping)
    groups = {"sensors": structure.sensors, "inputs": structure.inputs, "joints": structure.joints}
    masters = tuple(dict.fromkeys(name for word in entry.masters for name in groups.get(word, (word,))))
    try:
        reduced = (guyan(structure, masters, guard="constrain") if entry.method == "guyan"
                   else iirs(structure, masters, iterations=entry.iterations, guard="constrain"))
        return _guessed(modal_model(reduced, modes), entry.damping)
    except ValueError as error:
        raise InputError(f"{file.name}: [reduction] masters", str(error), "name more masters, or fewer modes") from None


def _guessed(model: ModalModel, damping: float | None) -> ModalModel:
    """The model with one damping ratio for all modes, marked as assumed; as it is where none is given."""
    if damping is None:
        return model
    return replace(model, zeta=np.full(model.modes, damping), zeta_sd=np.full(model.modes, ASSUMED))


def user_terms(entries: Sequence[UserTermEntry]) -> dict[str, Term]:
    """Terms from checked expressions.

    Raises
    ------
    InputError
        If an expression is not admissible.
    """
    if not entries:
        return {}
    from bayes_nlsid.forces.expression import user_term

    return {entry.name: user_term(entry.name, entry.formula, dict(entry.params), entry.memory, meaning=entry.meaning) for entry in entries}


def library(entries: Sequence[UserTermEntry]) -> Mapping[str, Term]:
    """The library with the user's own terms."""
    return {**LIBRARY, **user_terms(entries)}


def build_element(entry: ElementEntry, terms: Mapping[str, Term]) -> Element:
    """An element of the model."""
    return Element(terms[entry.term], entry.locations, entry.tied, entry.excess, entry.fixed)


def element_record(element: Element) -> dict[str, Any]:
    """An element as JSON; the inverse is `element_from`."""
    return {"term": element.term.name, "index": element.term.index, "locations": list(element.locations), "tied": element.tied,
            "excess": element.excess, "fixed": [list(f) for f in element.fixed]}


def element_from(record: Mapping[str, Any], terms: Mapping[str, Term]) -> Element:
    """An element from `element_record`."""
    return Element(terms[record["term"]], tuple(record["locations"]), record["tied"], record["excess"],
                   tuple((str(n), float(v)) for n, v in record["fixed"]))


_MODEL_ARRAYS = ("omega", "zeta", "shapes", "omega_sd", "zeta_sd")
_MODEL_NAMES = ("locations", "sensors", "inputs", "joints", "notes")


def model_record(model: ModalModel) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A modal model as arrays and JSON; the inverse is `model_from`."""
    arrays = {f"model.{name}": getattr(model, name) for name in _MODEL_ARRAYS}
    if model.residual is not None:
        arrays["model.residual"] = model.residual
    return arrays, {name: list(getattr(model, name)) for name in _MODEL_NAMES}


def model_from(arrays: Mapping[str, NDArray[Any]], names: Mapping[str, Any]) -> ModalModel:
    """A modal model from `model_record`."""
    values: dict[str, Any] = {name: np.asarray(arrays[f"model.{name}"], dtype=float) for name in _MODEL_ARRAYS}
    values |= {name: tuple(names[name]) for name in _MODEL_NAMES}
    return ModalModel(**values, residual=arrays.get("model.residual"))
