"""What the stages of one run share: the study, its results so far, and the objects made from them on demand."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.term import Term
from bayes_nlsid.recordings.noise import NoiseFloor, as_stated, noise_psd
from bayes_nlsid.recordings.reading import RecordingSpec, read_recording
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.study.building import library, model_from
from bayes_nlsid.study.progress import Progress
from bayes_nlsid.study.schema import EXTRAS, Study
from bayes_nlsid.study.store import Saved, digest, file_digest, versions

Arrays = dict[str, NDArray[Any]]
Result = tuple[Arrays, dict[str, Any]]
_ROOMS = {
    "read": ("errors.py", "recordings"),
    "linear": ("structure",),
    "identify": ("symlog.py", "forces", "model.py", "simulation", "identification"),
    "posterior": ("inference",),
    "predict": ("prediction",),
}
_NUMERICAL = ("bayes_nlsid", "numpy", "scipy", "emcee", "numba")


def _silent(share: float, sentence: str) -> None:
    """The default progress: nothing."""


def _quiet(sentence: str) -> None:
    """The default note: nothing."""


@final
@dataclass(frozen=True)
class Context:
    """A run under way.

    Parameters
    ----------
    study : Study
    seed : int
    workers : int
        How many processes or threads a stage may use; results do not depend on it.
    executor : str
        Where stages of many tasks have them done: ``local`` or ``dask://HOST:PORT``; results do not depend on it either.
    done : dict of str to Saved
        Stages finished so far, in order; the run adds to it.
    progress : callable
        ``progress(share, sentence)`` within the current stage.
    note : callable
        Takes a sentence worth keeping.
    scratch : callable or None
        ``scratch(stage, key)`` is a folder for checkpoints that survive a kill.
    """

    study: Study
    seed: int
    workers: int = 1
    executor: str = "local"
    done: dict[str, Saved] = field(default_factory=dict)
    progress: Progress = _silent
    note: Callable[[str], None] = _quiet
    scratch: Callable[[str, str], Path] | None = None

    @cached_property
    def terms(self) -> Mapping[str, Term]:
        """The library with the study's own terms."""
        return library(self.study.terms)

    @cached_property
    def recordings(self) -> dict[str, Recording]:
        """Every recording of the study, read from its file."""
        return {spec.name: read_recording(spec) for spec in self.study.recordings}

    def role(self, role: str) -> list[Recording]:
        """Recordings of one role."""
        return [self.recordings[spec.name] for spec in self.study.recordings if spec.role == role]

    def noise(self, recording: Recording) -> NoiseFloor:
        """Noise floor of a recording.

        Best is a record of role ``noise`` with the same sensors; where the recording alone gives no more than a bound, what
        another recording of the same sensors tells comes first. Channels whose noise the study states keep that.

        Raises
        ------
        InputError
            If a noise record cannot serve.
        """
        reference = next((found for r in self.role("noise") if r.name != recording.name
                          and (found := same_sensors(r, recording)) is not None), None)
        try:
            floor = noise_psd(recording, reference)
        except ValueError as error:
            raise InputError(f"{self.study.file.name}: [[recordings]]", str(error), "change the window or the rate, or drop it") from None
        if floor.sure == "bound":
            floor = self._borrowed(recording) or floor
        spec = next((s for s in self.study.recordings if s.name == recording.name), None)
        stated = {} if spec is None else {c.name: c.noise for c in spec.channels}
        return as_stated(floor, [stated.get(c.name) for c in recording.channels])

    def _borrowed(self, recording: Recording) -> NoiseFloor | None:
        """What the scatter between periods of another recording says of the same sensors."""
        for other in self.recordings.values():
            same = None if other.name == recording.name or other.role == "noise" else same_sensors(other, recording)
            if same is not None and same.n >= 16 and abs(same.dt / recording.dt - 1) < 1e-6:
                floor = noise_psd(same)
                if floor.sure == "measured":
                    return replace(floor, how=f"as in the recording {other.name!r}, {floor.how}", channels=recording.channels)
        return None

    @cached_property
    def model(self) -> ModalModel:
        """The linear model that the stage ``linear`` left."""
        saved = self.done["linear"]
        return model_from(saved.arrays, saved.data["model"])

    def random(self, stage: str) -> np.random.SeedSequence:
        """The seed of a stage, independent of what other stages drew."""
        return np.random.SeedSequence([self.seed, *hashlib.sha256(stage.encode()).digest()[:8]])

    def number(self, stage: str) -> int:
        """The same as one whole number."""
        return int(self.random(stage).generate_state(1)[0])

    def checkpoints(self, stage: str) -> Path | None:
        """Folder for the checkpoints of a stage with its present inputs; None if there is no store."""
        return None if self.scratch is None else self.scratch(stage, self.key(stage))

    def key(self, stage: str) -> str:
        """Hash of everything a stage is computed from: its tables, files, seed, earlier stages, code and versions."""
        return digest({**self.inputs(stage), "stage": stage})

    def inputs(self, stage: str) -> dict[str, Any]:
        """The inputs of a stage, each as a hash or a value, for ``stage.json``."""
        study = self.study
        tables: dict[str, tuple[Any, ...]] = {
            "read": (), "linear": (study.structure, study.reduction, study.linear), "identify": (study.identification, *study.terms),
            "posterior": (study.posterior,), "predict": (study.prediction,), "frf": (study.frf,),
            "montecarlo": (study.montecarlo, study.prediction), "compare": (study.compare,)}
        out: dict[str, Any] = {
            "tables": digest([None if t is None else _plain(asdict(t)) for t in tables[stage]]), "code": code_digest(stage),
            "versions": {name: value for name, value in versions().items() if name in _NUMERICAL},
            "earlier": {name: saved.key for name, saved in self.done.items() if not (stage in EXTRAS and name in ("predict", *EXTRAS))}}
        if stage == "read":
            out["recordings"] = [_recording_key(spec) for spec in study.recordings]
        if stage not in ("read", "linear"):
            out["seed"] = self.seed
        return out


def same_sensors(candidate: Recording, recording: Recording) -> Recording | None:
    """The candidate with its channels picked and named as in the recording; None if a sensor of the recording is missing in it."""
    places = [(c.location, c.quantity) for c in candidate.channels]
    picked = []
    for channel in recording.channels:
        found = [i for i, place in enumerate(places) if place == (channel.location, channel.quantity)]
        found = [i for i in found if candidate.channels[i].name == channel.name] if len(found) > 1 else found
        if not found:
            return None
        picked.append(found[0])
    return replace(candidate, response=candidate.response[:, picked], channels=recording.channels)


def _plain(value: Any) -> Any:
    """JSON form in which a file counts by its content, not by its path."""
    if isinstance(value, Path):
        return file_digest(value)
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


def _recording_key(spec: RecordingSpec) -> dict[str, Any]:
    return {**asdict(replace(spec, file="")), "file": file_digest(Path(spec.file))}


def code_digest(stage: str) -> str:
    """Hash of the source of every room a stage depends on, so that changed code is never mistaken for the old one."""
    package = Path(__file__).resolve().parents[1]
    digest_ = hashlib.sha256()
    for name, rooms in _ROOMS.items():
        for room in (*rooms, f"study/stage_{name}.py", *((f"study/stage_{stage}.py",) if stage in EXTRAS else ())):
            path = package / room
            for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
                if file.exists():
                    digest_.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
        if name == stage:
            break
    return digest_.hexdigest()
