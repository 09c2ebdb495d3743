"""The command line: exit statuses, one sentence for each mistake, quick help."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bayes_nlsid.cli import main

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("run", "check", "diagnose", "compare", "montecarlo", "frf", "report", "terms", "hypotheses", "new")


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert all(f"\n    {name}" in text for name in COMMANDS), text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_the_common_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([name, "--help"])
    text = capsys.readouterr().out
    assert all(option in text for option in ("--seed", "--workers", "--executor", "--quiet", "--log"))


@pytest.mark.skipif(sys.platform == "win32", reason="tells no CPU time of children")
def test_help_is_quick() -> None:
    """CPU time, best of two, so that a busy machine does not decide."""
    spent = []
    for _ in range(2):
        began = sum(os.times()[2:4])
        subprocess.run([sys.executable, "-m", "bayes_nlsid", "--help"], env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
                       capture_output=True, check=True)
        spent.append(sum(os.times()[2:4]) - began)
    assert 0.0 < min(spent) < 0.5, spent


@pytest.mark.parametrize(("arguments", "status", "words"), [
    (["run", "nowhere.toml", "--out", "x"], 2, "there is no such file"),
    (["check", "nowhere.toml"], 2, "there is no such file"),
    (["report", "nowhere"], 2, "there is no such folder"),
    (["compare", "s.toml", "--out", "x"], 2, "s.toml"),
    (["montecarlo", "s.toml", "--out", "x"], 2, "there is no such file"),
    (["frf", "s.toml", "--out", "x"], 2, "there is no such file"),
])
def test_refusals(arguments: list[str], status: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                  capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == status
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and words in said.err and said.err.startswith("nlsid")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["run"], ["run", "s.toml"], ["flurb"], ["terms", "--seed", "-1"], ["terms", "--workers", "0"],
                                       ["terms", "--executor", "cloud"], ["terms", "--executor", "dask://a"], ["--nonsense"],
                                       ["run", "s.toml", "--out", ""], ["report", ""], ["new", ""]])
def test_wrong_usage_is_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    said = capsys.readouterr()
    assert ended.value.code == 2 and said.out == "" and said.err.count("\n") == 1, said
    assert said.err.startswith("nlsid") and said.err.rstrip().endswith("--help."), said


def test_new_then_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "mine"
    assert main(["new", str(folder)]) == 0
    assert main(["check", str(folder / "study.toml")]) == 0
    text = capsys.readouterr().out
    assert "stages: read -> linear -> identify -> posterior -> predict -> report" in text
    assert main(["new", str(folder)]) == 2, "an existing study is never overwritten"
    assert "already there" in capsys.readouterr().err


def test_terms_show_table_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["terms"]) == 0
    first = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.split()]
    assert [int(word) for word in first if word.isdigit()] == list(range(1, 47))


def test_ctrl_c_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import bayes_nlsid.study.screen as screen

    def pressed() -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(screen, "terms_table", pressed)
    assert main(["terms"]) == 130
    assert "run the same command again" in capsys.readouterr().err


def test_too_little_memory_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import bayes_nlsid.study.screen as screen

    def greedy() -> str:
        raise MemoryError("Unable to allocate 46 TiB")

    monkeypatch.setattr(screen, "terms_table", greedy)
    assert main(["terms"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and "46 TiB" in said.err and "fewer degrees of freedom" in said.err


def test_nothing_but_the_summary_without_a_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    from bayes_nlsid.study import pictures
    from bayes_nlsid.study.template import TEXT, write_template

    monkeypatch.setattr(pictures, "draw_all", lambda *_: [])
    study = write_template(tmp_path / "s")
    study.write_text(TEXT[:TEXT.index("[identification]")], encoding="utf-8")
    assert main(["run", str(study), "--out", str(tmp_path / "out"), "--log", str(tmp_path / "more.log")]) == 0
    said = capsys.readouterr()
    assert said.err == "" and "report.html" in said.out
    assert "[1/3] read" in (tmp_path / "more.log").read_text()
    assert main(["run", str(study), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("arguments", "words"), [
    (["run", "STUDY", "--out", "file/x"], "file/x: cannot be made"), (["run", "STUDY", "--out", "file"], "the output folder is a file"),
    (["diagnose", "STUDY", "--out", "file/x"], "file/x: cannot be made"), (["report", "file/x"], "there is no such folder"),
    (["run", "STUDY", "--out", "x", "--log", "no/x.log"], "--log no/x.log: cannot be written to"),
    (["run", "STUDY", "--out", "x", "--log", "."], "--log .: cannot be written to"),
])
def test_folders_that_cannot_be_written(arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                        capsys: pytest.CaptureFixture[str]) -> None:
    from bayes_nlsid.study.template import write_template

    monkeypatch.chdir(tmp_path)
    study = write_template(tmp_path / "s")
    (tmp_path / "file").write_text("in the way")
    assert main([str(study) if a == "STUDY" else a for a in arguments]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and words in said.err and said.err.startswith("nlsid"), said.err
    assert (tmp_path / "file").read_text() == "in the way" and not (tmp_path / "x").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX pipes")
def test_closed_pipe_is_quiet() -> None:
    done = subprocess.run([f"{sys.executable} -m bayes_nlsid terms | head -1"], shell=True, capture_output=True, text=True, check=False,
                          env={**os.environ, "PYTHONPATH": str(ROOT / "src")})
    assert done.stderr == "" and done.stdout.startswith("number")
