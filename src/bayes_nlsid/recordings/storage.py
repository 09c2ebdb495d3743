"""Recordings in the store of a study: npz without pickle, the same bytes for the same recording."""

from __future__ import annotations

import hashlib
import io
import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.readers import read_file
from bayes_nlsid.recordings.recording import Channel, Recording

FORMAT = 1
_LABELS = ("name", "dt", "role", "period", "start", "source", "sha256", "notes")


def recording_bytes(recording: Recording) -> bytes:
    """The npz archive of a recording; equal recordings give equal bytes."""
    meta = {"format": FORMAT, **{k: getattr(recording, k) for k in _LABELS}, "channels": [asdict(c) for c in recording.channels],
            "inputs": [asdict(c) for c in recording.inputs]}
    text = json.dumps(meta, sort_keys=True, ensure_ascii=False).encode()
    stream = io.BytesIO()
    np.savez(stream, response=np.ascontiguousarray(recording.response), force=np.ascontiguousarray(recording.force),
             meta=np.frombuffer(text, dtype=np.uint8))
    return stream.getvalue()


def save_recording(recording: Recording, path: str | Path) -> str:
    """Write a recording in one step, so that no half file is ever seen.

    Returns
    -------
    str
        sha256 of the bytes written.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    file, data = Path(path), recording_bytes(recording)
    if file.suffix != ".npz":
        raise InputError(str(file), "a stored recording is an npz file", "give a name that ends in .npz")
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        os.replace(part, file)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InputError(str(file), f"cannot be written ({error.strerror})", "check the folder") from error
    return hashlib.sha256(data).hexdigest()


def load_recording(path: str | Path) -> Recording:
    """Read a recording written by `save_recording`.

    Raises
    ------
    InputError
        If the file cannot be read or was not written by it.
    """
    arrays = read_file(path).arrays
    try:
        meta = json.loads(arrays["meta"].tobytes().decode())
        if meta["format"] != FORMAT:
            raise ValueError(f"format {meta['format']!r}")
        channels, inputs = (tuple(Channel(**c) for c in meta[key]) for key in ("channels", "inputs"))
        labels = {k: meta[k] for k in _LABELS} | {"notes": tuple(meta["notes"])}
        return Recording(response=np.array(arrays["response"], dtype=float), force=np.array(arrays["force"], dtype=float),
                         channels=channels, inputs=inputs, **labels)
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise InputError(str(path), f"is not a stored recording ({' '.join(str(error).split())[:120]})", "run the stage again") from error
