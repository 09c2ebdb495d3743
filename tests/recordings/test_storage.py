"""Stored recordings: the same back, the same bytes, and refusal of anything else."""

import hashlib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.recordings.storage import load_recording, recording_bytes, save_recording

RUN = Recording("läuft", 1 / 2048, np.random.default_rng(0).normal(size=(40, 2)), (Channel("a", "S1", "acceleration", "m/s²", -1),
                Channel("b", "S2", "velocity", "mm/s")), np.ones((40, 1)), (Channel("F", "P3", "force", "N"),), "holdout", 20, 3.25,
                "run.mat", "ab", ("a note",))


FREE = replace(RUN, force=np.zeros((40, 0)), inputs=(), period=None, response=np.asfortranarray(RUN.response))


@pytest.mark.parametrize("run", [RUN, FREE])
def test_round_trip(run: Recording, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    digest = save_recording(run, path)
    back = load_recording(path)
    for f in fields(Recording):
        one, two = getattr(run, f.name), getattr(back, f.name)
        assert np.array_equal(one, two) if isinstance(one, np.ndarray) else one == two, f.name
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest() == hashlib.sha256(recording_bytes(back)).hexdigest()
    assert list(tmp_path.iterdir()) == [path]


def test_bytes_change_with_content() -> None:
    assert len({recording_bytes(r) for r in (RUN, replace(RUN, role="train"), replace(RUN, response=RUN.response + 1e-9))}) == 3


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, response=np.zeros((3, 1)))
    with pytest.raises(InputError, match="not a stored recording"):
        load_recording(path)
    np.savez(path, response=np.zeros((3, 1)), force=np.zeros((3, 0)), meta=np.frombuffer(b'{"format": 9}', dtype=np.uint8))
    with pytest.raises(InputError, match="format 9"):
        load_recording(path)
    with pytest.raises(InputError, match="cannot be written"):
        save_recording(RUN, tmp_path / "none" / "x.npz")
    with pytest.raises(InputError, match=r"ends in \.npz"):
        save_recording(RUN, tmp_path / "x.dat")
