"""The one-line set-up: what it skips, what it refuses, and that its locks hold everything."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def start() -> ModuleType:
    spec = importlib.util.spec_from_file_location("start_under_test", ROOT / "start.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pinned(name: str) -> dict[str, str]:
    lines = (ROOT / "requirements" / name).read_text(encoding="utf-8").splitlines()
    wanted = [line.split(";")[0].strip() for line in lines if line.strip() and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[0-9][A-Za-z0-9.]*", line) for line in wanted), wanted
    return {re.sub(r"[-_.]+", "-", line.split("==")[0]).lower(): line.split("==")[1] for line in wanted}


def test_every_dependency_is_locked_within_its_limits() -> None:
    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    lock = pinned("lock.txt")
    everything = lock | pinned("lock-test.txt") | pinned("lock-lint.txt")
    for text in project["project"]["dependencies"]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(lock[requirement.name]), text
    for text in (*project["build-system"]["requires"], *project["project"]["optional-dependencies"]["dev"]):
        requirement = Requirement(text)
        assert requirement.specifier.contains(everything[requirement.name]), text
    extras = pinned("lock-extras.txt")
    assert not set(extras) & set(lock)
    for text in (*project["project"]["optional-dependencies"]["tdms"], *project["project"]["optional-dependencies"]["nastran"]):
        requirement = Requirement(text)
        assert requirement.specifier.contains(extras[requirement.name]), text


def test_the_checks_cover_every_python_that_is_stated() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    stated = [c.rpartition(" ")[2] for c in project["classifiers"] if re.search(r":: 3\.\d+$", c)]
    assert stated[0] == project["requires-python"].removeprefix(">=") and len(stated) > 2
    assert f"for version in {' '.join(stated)}; do" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_old_python_gets_one_sentence(start: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(start, "OLDEST", (99, 0))
    with pytest.raises(SystemExit) as ended:
        start.main(["run"])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.count("\n") == 1 and "Python 99.0 or newer is needed" in said


def test_it_parses_on_pythons_that_are_too_old(start: ModuleType) -> None:
    """The sentence above is only seen if the file itself is understood; Python 3.7 knows no walrus, no match, no ``|`` in types."""
    import ast

    ast.parse((ROOT / "start.py").read_text(encoding="utf-8"), feature_version=(3, 7))


def test_words_it_does_not_know(start: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert start.main(["flurb"]) == 2 and start.main([]) == 0
    assert "start.py run" in capsys.readouterr().out


def test_set_up_is_skipped_when_nothing_changed(start: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start, "ENVIRONMENT", tmp_path)
    monkeypatch.setattr(start, "usable", lambda: True)
    done: list[str] = []
    monkeypatch.setattr(start, "pip", lambda arguments, purpose: done.append(purpose))
    start.set_up([start.RUN_LOCK, start.TEST_LOCK])
    assert done == ["the locked dependencies", "bayes_nlsid"]
    start.set_up([start.RUN_LOCK, start.TEST_LOCK])
    start.set_up([start.RUN_LOCK])  # what the tests need includes what a run needs
    assert len(done) == 2
    changed = tmp_path / "lock.txt"
    changed.write_text("numpy==1\n")
    monkeypatch.setattr(start, "ROOT", tmp_path)
    (tmp_path / "pyproject.toml").write_text("")
    start.set_up([changed])
    assert len(done) == 4


def test_linear_algebra_gets_one_thread_unless_the_user_says_otherwise(start: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, str]] = []

    def run(command: list[str], **options: dict[str, str]) -> SimpleNamespace:
        given.append(options["env"])
        return SimpleNamespace(returncode=7)

    monkeypatch.setattr(start.subprocess, "run", run)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert start.call(["-m", "bayes_nlsid"]) == 7
    assert given[0]["OMP_NUM_THREADS"] == "3" and given[0]["OPENBLAS_NUM_THREADS"] == "1" and "PATH" in given[0]


def test_tests_run_side_by_side_unless_the_user_says_otherwise(start: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[list[str]] = []
    monkeypatch.setattr(start, "set_up", lambda locks: None)
    monkeypatch.setattr(start, "call", lambda arguments: given.append(arguments) or 0)
    assert start.main(["test", "-n", "0", "-k", "symlog"]) == 0
    options = given[0]
    assert options[:2] == ["-m", "pytest"] and options[2:4] == ["-n", "auto"] and options[-4:] == ["-n", "0", "-k", "symlog"]


def test_a_folder_that_is_no_environment_is_left_alone(start: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    monkeypatch.setattr(start, "ENVIRONMENT", tmp_path)
    with pytest.raises(SystemExit):
        start.make_environment()
    assert (tmp_path / "precious.txt").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX paths")
def test_python_without_ensurepip(start: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                  capsys: pytest.CaptureFixture[str]) -> None:
    """Where ``python -m venv`` cannot bring pip along, the pip from outside installs into the bare environment."""
    monkeypatch.setattr(start, "ENVIRONMENT", tmp_path / "env")
    real = start.subprocess.run

    def without(command: list[str], **options: object) -> object:
        if command[1:3] == ["-m", "venv"] and "--without-pip" not in command:
            return real([sys.executable, "-c", "raise SystemExit('ensurepip is not available')"], **options)
        return real(command, **options)

    monkeypatch.setattr(start.subprocess, "run", without)
    start.make_environment()
    assert "from outside" in capsys.readouterr().out
    assert start.installer()[:3] == [sys.executable, "-m", "pip"]
    start.pip(["--only-binary", ":all:", "iniconfig==" + pinned("lock-test.txt")["iniconfig"]], "iniconfig")
    assert real([str(start.environment_python()), "-c", "import iniconfig"], check=False).returncode == 0
