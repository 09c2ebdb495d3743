"""The answer: where the mismatch sits, what is missing with which probability, and what it improves on records not used."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@final
@dataclass(frozen=True)
class Named:
    """One ranked hypothesis.

    Parameters
    ----------
    effects : tuple of (class, location)
        Empty for ``none``.
    probability : float
    parameters : tuple of dict
        ``name``, ``unit``, ``q05``, ``q50``, ``q95``.
    sentence, separated_by : str
    """

    effects: tuple[tuple[str, str], ...]
    probability: float
    parameters: tuple[Mapping[str, Any], ...] = ()
    sentence: str = ""
    separated_by: str = ""


@final
@dataclass(frozen=True)
class Diagnosis:
    """What ``diagnose`` returns.

    Parameters
    ----------
    case : str
    seed : int
    seconds : float
    verdict : {"none", "mismatch", "cannot_tell"}
    p_mismatch : float
    where : dict
        ``locations`` (list of name, probability, indistinguishable_from), ``amplitude``, ``band_hz``, ``time``, ``phase``.
    hypotheses : tuple of Named
        Ranked; probabilities sum to 1, ``none`` and ``other`` among them.
    heldout : dict
        Records not used, NRMSE of the nominal, re-tuned and extended model, noise floor, ELPD difference and its standard error.
    sentence : str
        The first line of the answer.
    detection : dict of str to float
        Statistics of the tests for one linear system.
    notes : tuple of str
        What was wrong with the data, what could not be tested, what was withdrawn.
    predictions : dict of str to ndarray
        ``<record>_accel_q05/_q50/_q95`` (n, s) m/s² of sealed records.
    figures : dict of str to ndarray
        Numbers behind the figures.
    scores : dict
        What the probabilities were made from, for a refit of the layer.
    """

    case: str
    seed: int
    seconds: float
    verdict: str
    p_mismatch: float
    where: Mapping[str, Any]
    hypotheses: tuple[Named, ...]
    heldout: Mapping[str, Any]
    sentence: str
    detection: Mapping[str, float]
    notes: tuple[str, ...] = ()
    predictions: Mapping[str, Array] = field(default_factory=dict)
    figures: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    scores: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.verdict not in ("none", "mismatch", "cannot_tell"):
            raise ValueError(f"verdict {self.verdict!r} must be none, mismatch or cannot_tell")
        total = sum(h.probability for h in self.hypotheses)
        if abs(total - 1) > 1e-6:
            raise ValueError(f"probabilities of the hypotheses sum to {total}, not 1")

    def as_dict(self) -> dict[str, Any]:
        """The contents of ``diagnosis.json``."""
        return {
            "format": 1, "case": self.case, "seed": self.seed, "seconds": self.seconds, "verdict": self.verdict,
            "p_mismatch": self.p_mismatch, "sentence": self.sentence, "where": dict(self.where),
            "hypotheses": [{"effects": [{"class": c, "location": p} for c, p in h.effects], "probability": h.probability,
                            "parameters": [dict(p) for p in h.parameters], "sentence": h.sentence,
                            "would_be_separated_by": h.separated_by} for h in self.hypotheses],
            "heldout": dict(self.heldout), "detection": dict(self.detection), "notes": list(self.notes)}


def write_diagnosis(diagnosis: Diagnosis, out: str | Path) -> None:
    """Write ``diagnosis.json``, ``predictions.npz``, ``figures.npz`` (numbers behind the figures) and ``scores.json`` (numbers behind the
    probabilities) into the folder ``out``."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "diagnosis.json").write_text(json.dumps(_plain(diagnosis.as_dict()), indent=1, ensure_ascii=False) + "\n")
    if diagnosis.scores:
        (folder / "scores.json").write_text(json.dumps(_plain(dict(diagnosis.scores))) + "\n")
    predictions: dict[str, Any] = {k: v.astype(np.float32) for k, v in diagnosis.predictions.items()}
    figures: dict[str, Any] = dict(diagnosis.figures)
    np.savez_compressed(folder / "predictions.npz", **predictions)
    np.savez_compressed(folder / "figures.npz", **figures)


def _plain(value: Any) -> Any:
    """Numbers, lists and dicts that JSON knows; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, np.bool_):
        return bool(value)
    return value
