"""Runs that are killed or meet a full disk at random moments: what is left is whole, and the same command goes on to the same numbers."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid import cli
from bayes_nlsid.errors import InputError
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.run import run_study
from bayes_nlsid.study.store import Store
from bayes_nlsid.study.template import TEXT, example_recording

SAMPLED = "\n[posterior]\nensembles = 2\nsteps = 100\n"
FINISHED = {"result.json", "report.html", "run.log", "figures", "stages"}
RUNS = 25  # of each kind


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    np.savez(folder / "recording.npz", **example_recording())
    text = TEXT[:TEXT.index("[posterior]")].replace("window = [0.0, 8.0]", "window = [0.0, 4.0]")
    text = text.replace('"cubic", "q|q|", "v|v|"', '"cubic"')
    (folder / "study.toml").write_text(text.replace("starts = 20", "starts = 4") + SAMPLED, encoding="utf-8")
    return folder / "study.toml"


def numbers(out: Path) -> dict[str, Any]:
    """What must not depend on interruptions."""
    result: dict[str, Any] = json.loads((out / "result.json").read_text(encoding="utf-8"))
    for stage in result["stages"].values():
        stage.pop("seconds")
    return result


def forked(action: Callable[[], None]) -> int:
    """Process number of a child that does something and ends with 0, or 2 after one sentence, or 1 after anything else."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
        child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        action()
        status = 0
    except InputError:
        status = 2
    finally:
        os._exit(status)


def status_of(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def whole_or_absent(out: Path) -> None:
    """Every stage is whole or not there; every file of the results is whole or not there."""
    if not (out / "stages" / "store.json").exists():
        return
    store = Store(out)
    for stage in ("read", "linear", "identify", "posterior"):
        if (out / "stages" / stage).exists():
            assert store.load(stage) is not None, stage
    if (out / "result.json").exists():
        json.loads((out / "result.json").read_text(encoding="utf-8"))
    if (out / "report.html").exists():
        assert (out / "report.html").read_text(encoding="utf-8").rstrip().endswith("</html>")


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Callable[[int], None]]:
    """A file system of ``size`` bytes at ``folder``, and the way to make it larger."""
    folder.mkdir(exist_ok=True)
    if os.name != "posix" or shutil.which("mount") is None or os.geteuid() != 0:
        pytest.skip("needs a superuser to mount a small file system")
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True, check=False).returncode:
        pytest.skip("this system does not allow mounting")
    try:
        yield lambda more: subprocess.run(["mount", "-o", f"remount,size={more}", str(folder)], check=True, capture_output=True) and None
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True, capture_output=True)


@pytest.mark.slow
def test_kills_at_random_moments(study: Path, tmp_path: Path) -> None:
    begun = time.monotonic()
    run_study(read_study(study), tmp_path / "whole")
    seconds, expected = time.monotonic() - begun, numbers(tmp_path / "whole")
    rng, killed = np.random.default_rng(1), 0
    for i in range(RUNS):
        out = tmp_path / f"out{i}"
        child = forked(lambda out=out: run_study(read_study(study), out))  # type: ignore[misc]
        time.sleep(seconds * rng.uniform(0.0, 1.0))
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        killed += status_of(child) == -signal.SIGKILL
        whole_or_absent(out)
        assert status_of(forked(lambda out=out: run_study(read_study(study), out))) == 0  # type: ignore[misc]
        assert numbers(out) == expected and {p.name for p in out.iterdir()} >= FINISHED
        assert not list((out / "stages").glob(".*"))
        shutil.rmtree(out)
    assert killed >= RUNS // 2, "the moments were too late"


@pytest.mark.slow
def test_disks_that_fill_at_random_moments(study: Path, tmp_path: Path) -> None:
    run_study(read_study(study), tmp_path / "whole")
    expected = numbers(tmp_path / "whole")
    needed = sum(p.stat().st_size for p in (tmp_path / "whole").rglob("*") if p.is_file())
    rng, filled = np.random.default_rng(2), 0
    for _ in range(RUNS):
        with small_disk(tmp_path / "disk", int(needed * rng.uniform(0.0, 1.1)) + 4096) as enlarge:
            out = tmp_path / "disk" / "out"
            status = status_of(forked(lambda out=out: run_study(read_study(study), out)))  # type: ignore[misc]
            assert status in (0, 2), "a full disk must be one sentence"
            filled += status == 2
            if out.exists():
                whole_or_absent(out)
            enlarge(4 * needed + 2**20)
            assert status_of(forked(lambda out=out: run_study(read_study(study), out))) == 0  # type: ignore[misc]
            assert numbers(out) == expected
    assert filled >= RUNS // 2, "the disks were too large"


def test_a_full_disk_is_one_sentence_on_the_command_line(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with small_disk(tmp_path / "disk", 16 * 1024):
        assert cli.main(["run", str(study), "--out", str(tmp_path / "disk" / "out"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "the disk is full; free some space and run again" in said and said.count("\n") == 1


def test_a_second_run_into_the_same_folder_is_refused(study: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Store(out).lock():
        done = subprocess.run([sys.executable, "-m", "bayes_nlsid", "run", str(study), "--out", str(out)], capture_output=True, text=True,
                              check=False, env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2] / "src")})
    assert done.returncode == 2 and "another run (process" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.parametrize(("file", "change", "words"), [
    ("store.json", lambda text: text.replace('"format": 1', '"format": 2'), "store format 2 is not 1, the one this version reads"),
    ("study.json", lambda text: text.replace('"title"', '"heading"'), "cannot be read by this version"),
    ("study.json", lambda text: text.replace('"seed": 1', '"seed": null'), "cannot be read by this version"),
    ("study.json", lambda text: "[]", "cannot be read by this version"),
])
def test_folders_of_other_versions_are_refused_in_one_sentence(study: Path, tmp_path: Path, file: str, change: Callable[[str], str],
                                                               words: str, capsys: pytest.CaptureFixture[str]) -> None:
    from bayes_nlsid.study.archive import keep_study

    store = Store(tmp_path / "out")
    keep_study(store.stages, read_study(study), 1)
    path = store.stages / file
    changed = change(path.read_text(encoding="utf-8"))
    assert changed != path.read_text(encoding="utf-8")
    path.write_text(changed, encoding="utf-8")
    assert cli.main(["report", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
