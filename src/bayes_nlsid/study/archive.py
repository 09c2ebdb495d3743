"""The study as it was run, kept beside its results, so that a report can be rebuilt when the study file has moved or changed."""

from __future__ import annotations

import json
import types
import typing
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.store import write_atomic

NAME = "study.json"


def keep_study(folder: Path, study: Study, seed: int) -> None:
    """Write the study into a ``stages`` folder."""
    text = study.file.read_text(encoding="utf-8") if study.file.is_file() else ""
    record = {"study": asdict(study), "seed": seed, "text": text}
    write_atomic(folder / NAME, json.dumps(record, default=str, indent=1).encode())


def stored_study(out: Path) -> tuple[Study, int]:
    """The study and the seed of the last run into a folder.

    Raises
    ------
    InputError
        If the folder holds none, or one that this version cannot read.
    """
    path = out / "stages" / NAME
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return _build(Study, record["study"]), int(record["seed"])
    except FileNotFoundError:
        raise InputError(str(out), "holds no results of a run", "give the --out of an earlier nlsid run") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(str(path), f"cannot be read by this version ({type(error).__name__})", "run the study again") from None


def study_text(out: Path) -> str:
    """The study file as it stood at the last run; empty if unknown."""
    try:
        return str(json.loads((out / "stages" / NAME).read_text(encoding="utf-8"))["text"])
    except (OSError, ValueError, KeyError):
        return ""


def _build(kind: Any, value: Any) -> Any:
    """A value of a type as written in an annotation, from its JSON form."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        options = [k for k in inner if k is not type(None)]
        return _build(options[0], value) if len(options) == 1 else value
    if origin is tuple:
        kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else inner
        return tuple(_build(k, v) for k, v in zip(kinds, value, strict=True))
    if is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        return kind(**{f.name: _build(hints[f.name], value[f.name]) for f in fields(kind) if f.init})
    if kind is Path:
        return Path(value)
    return _tuples(value) if kind is Any else value


def _tuples(value: Any) -> Any:
    """Lists of JSON as the tuples they were."""
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
