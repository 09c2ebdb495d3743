"""What the documents say is so: commands exist, links lead somewhere, and the examples of tutorial and how-to pages run as they stand."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from bayes_nlsid import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "studies").rglob("*.md"))]
EXAMPLES = [ROOT / "docs" / "tutorial.md", *sorted((ROOT / "docs" / "howto").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[list[str]]:
    """The ``nlsid`` lines of a block, without their comments."""
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    return [shlex.split(line)[1:] for line in lines if line.startswith("nlsid ")]


def carry_out(page: Path) -> None:
    """Every block of a page in turn, in the present folder; ``toml`` blocks are files, ``sh`` blocks commands."""
    names: dict[str, Any] = {"__name__": "example"}
    for language, remark, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        first = text.splitlines()[0]
        if "slow" in remark:
            continue
        if language == "python":
            exec(compile(text, str(page), "exec"), names)  # noqa: S102 - our own page
        elif language == "toml":
            file, mode = (first.removeprefix("# file: "), "w") if first.startswith("# file: ") else (first.removeprefix("# add to: "), "a")
            assert file != first, f"{page.name}: a toml block begins with its file: {first}"
            Path(file).parent.mkdir(parents=True, exist_ok=True)
            with open(file, mode, encoding="utf-8") as target:
                target.write(text)
        elif language == "sh":
            assert commands(text), text
            for command in commands(text):
                assert cli.main(command) == 0, (page.name, command)


def workplace(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("data", "studies"):
        (folder / name).symlink_to(ROOT / name)
    monkeypatch.chdir(folder)


# the tutorial's own blocks take half a minute, so they run beside the fast lane (.ci/run); its block marked slow is `start.py run`
@pytest.mark.parametrize("page", [pytest.param(page, id=page.stem, marks=[pytest.mark.slow] if page.stem == "tutorial" else [])
                                  for page in EXAMPLES])
def test_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    workplace(tmp_path, monkeypatch)
    carry_out(page)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere_and_commands_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not target.startswith(("http", "#")):
            assert (page.parent / target.partition("#")[0]).exists(), target
    for language, _, block in BLOCK.findall(text):
        if language in ("sh", "text"):
            for command in commands(block):
                cli._parser().parse_args(command)


def test_every_ask_is_answered_and_the_tests_it_names_exist() -> None:
    text = (ROOT / "docs" / "asks.md").read_text(encoding="utf-8")
    counts = [len(re.findall(r"^\| \d+ ", part, re.MULTILINE)) for part in text.split("\n## ")[1:]]
    assert counts == [12, 9, 9, 8, 3]
    written = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", text):
        assert f"def {name}(" in written, name
