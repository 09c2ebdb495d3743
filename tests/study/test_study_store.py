"""The stage store: atomic, checked, resumable, careful with what is not its own."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.study import store as store_module
from bayes_nlsid.study.store import Store, digest

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "names": np.array(["x", "y"])}


def test_round_trip(tmp_path: Path) -> None:
    store = Store(tmp_path / "out")
    store.save("linear", "k1", ARRAYS, {"number": np.float64(2.5), "list": (1, 2)}, 0.5)
    saved = Store(tmp_path / "out").load("linear")
    assert saved is not None and saved.key == "k1" and saved.reused and saved.data == {"number": 2.5, "list": [1, 2]}
    np.testing.assert_array_equal(saved.arrays["a"], ARRAYS["a"])
    assert saved.arrays["names"].tolist() == ["x", "y"]


def test_why_redo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    assert store.why_redo("read", "k") == "not computed yet"
    store.save("read", "k", ARRAYS, {}, 0.0)
    assert store.why_redo("read", "k") == ""
    assert store.why_redo("read", "other") == "its inputs have changed"
    monkeypatch.setattr(store_module, "versions", lambda: {"numpy": "99.0"})
    assert "other versions" in store.why_redo("read", "other") and "→ 99.0" in store.why_redo("read", "other")


@pytest.mark.parametrize("name", ["data.json", "arrays.npz", "stage.json"])
@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_damage_is_noticed(name: str, damage: str, tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.save("read", "k", ARRAYS, {"text": "some words"}, 0.0)
    path = tmp_path / "stages" / "read" / name
    content = bytearray(path.read_bytes())
    if damage == "remove":
        path.unlink()
    else:
        content[len(content) // 2] ^= 0xFF
        path.write_bytes(content if damage == "flip" else content[:len(content) // 2])
    assert store.load("read") is None
    assert store.why_redo("read", "k") != ""
    store.save("read", "k", ARRAYS, {"text": "some words"}, 0.0)
    assert store.why_redo("read", "k") == ""


def test_objects_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="dtype object"):
        Store(tmp_path).save("read", "k", {"bad": np.array([{}], dtype=object)}, {}, 0.0)
    assert not (tmp_path / "stages" / "read").exists()


def test_foreign_results_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(InputError, match="this program did not make"):
        Store(tmp_path)
    assert (tmp_path / "result.json").read_text() == "{}" and not (tmp_path / "stages").exists()


def test_foreign_stage_folder_is_left_alone(tmp_path: Path) -> None:
    store = Store(tmp_path)
    mine = tmp_path / "stages" / "read"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="did not make"):
        store.save("read", "k", ARRAYS, {}, 0.0)
    assert (mine / "thesis.txt").read_text() == "years of work"


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="is a file"):
        Store(tmp_path / "out")


def test_other_format_is_refused(tmp_path: Path) -> None:
    Store(tmp_path)
    (tmp_path / "stages" / "store.json").write_text(json.dumps({"made_by": "bayes_nlsid", "format": 99}))
    with pytest.raises(InputError, match="store format 99 is not 1"):
        Store(tmp_path)


def test_full_disk_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    store.save("read", "k", ARRAYS, {}, 0.0)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(InputError, match="the disk is full; free some space and run again"):
        store.save("read", "k2", ARRAYS, {}, 0.0)
    assert store.why_redo("read", "k") == "", "the earlier result must survive"
    assert not list((tmp_path / "stages").glob(".*partial*")), "nothing half-written may stay"


def test_kill_while_saving_leaves_old_or_new(tmp_path: Path) -> None:
    """A process killed between any two steps of saving leaves a store that opens, and the stage whole or absent."""
    code = """
import os, sys
import numpy as np
from bayes_nlsid.study import store as module
from bayes_nlsid.study.store import Store
store = Store(sys.argv[1])
store.save("read", "old", {"a": np.zeros(3)}, {}, 0.0)
calls, real = 0, os.replace
def replace(*args):
    global calls
    calls += 1
    if calls == int(sys.argv[2]):
        os.kill(os.getpid(), 9)
    return real(*args)
module.os.replace = replace
store.save("read", "new", {"a": np.ones(3)}, {}, 0.0)
"""
    root = Path(__file__).resolve().parents[2]
    for step in (1, 2, 3):
        out = tmp_path / str(step)
        done = subprocess.run([sys.executable, "-c", code, str(out), str(step)], env={**os.environ, "PYTHONPATH": str(root / "src")},
                              check=False)
        store = Store(out)
        store.sweep()
        saved = store.load("read")
        if step <= 2:
            assert done.returncode == -9
            assert saved is None or saved.key in ("old", "new")
        else:
            assert done.returncode == 0 and saved is not None and saved.key == "new"
        assert not list((out / "stages").glob(".*"))


def test_two_runs_are_refused(tmp_path: Path) -> None:
    with Store(tmp_path).lock():
        with pytest.raises(InputError, match=rf"another run \(process {os.getpid()} on"):
            with Store(tmp_path).lock():
                pass
    with Store(tmp_path).lock():
        pass
    assert not list((tmp_path / "stages").glob("lock*"))


def test_lock_of_the_dead_is_taken_over(tmp_path: Path) -> None:
    store = Store(tmp_path)
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True, check=True)
    import socket

    lock = tmp_path / "stages" / "lock"
    lock.write_text(json.dumps({"pid": int(dead.stdout), "host": socket.gethostname(), "born": "1", "since": 0.0}))
    with store.lock():
        assert json.loads(lock.read_text())["pid"] == os.getpid()
    lock.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "born": "another life", "since": 0.0}))
    with store.lock():  # the number lives on, but not the process that wrote it
        pass
    lock.write_text("")  # killed before its first byte
    os.utime(lock, (0, 0))
    with store.lock():
        pass


def test_lock_of_another_machine_is_respected(tmp_path: Path) -> None:
    store = Store(tmp_path)
    (tmp_path / "stages" / "lock").write_text(json.dumps({"pid": 1, "host": "elsewhere", "born": "", "since": 0.0}))
    with pytest.raises(InputError, match="on elsewhere"):
        with store.lock():
            pass


def test_scratch_belongs_to_its_inputs(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = store.scratch("posterior", "a" * 64)
    (first / "chain.h5").write_text("half")
    assert store.scratch("posterior", "a" * 64) == first and (first / "chain.h5").exists()
    second = store.scratch("posterior", "b" * 64)
    assert second != first and not first.exists()
    store.clear_scratch("posterior")
    assert not second.exists()


def test_digest_does_not_depend_on_order() -> None:
    assert digest({"a": 1, "b": [1, 2]}) == digest({"b": (1, 2), "a": 1})
    assert digest({"a": 1}) != digest({"a": 1.5})
