"""Pages as a reader meets them: in a real browser at two widths where one is installed, and as Markdown."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

import pytest

from bayes_nlsid import cli
from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.diagnosis_page import page
from bayes_nlsid.study.diagnosis_pictures import pictures
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.report_markdown import markdown
from bayes_nlsid.study.run import run_study
from tests.study.test_planning import write
from tests.study.test_study_diagnosing import answer

BROWSER = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
WIDTHS = (1280, 390)  # a desk and a phone

# frames of the page at both widths; the load event waits for all of their images, so the measuring can follow it at once
OUTER = """<!doctype html><meta charset="utf-8"><body><pre id="said"></pre>FRAMES<script>
onload = () => { document.getElementById("said").textContent = JSON.stringify([...document.querySelectorAll("iframe")].map(frame => {
  const page = frame.contentDocument, width = frame.clientWidth;
  for (const part of page.querySelectorAll("details")) part.open = true;
  const wide = [...page.querySelectorAll("main *")].filter(e => !e.closest(".scroll, pre") && e.getBoundingClientRect().right > width + 1);
  return { width, scroll: page.documentElement.scrollWidth, wide: wide.map(e => e.tagName),
           images: [...page.images].map(image => image.complete && image.naturalWidth),
           asked: frame.contentWindow.performance.getEntriesByType("resource").map(e => e.name).filter(n => !n.startsWith("data:")) } })) };
</script></body>"""


def measured(page: str, folder: Path) -> list[dict[str, Any]]:
    """What the browser finds at each width."""
    frames = "".join(f'<iframe style="width:{w}px;height:900px;border:0" srcdoc="{escape(page)}"></iframe>' for w in WIDTHS)
    (folder / "outer.html").write_text(OUTER.replace("FRAMES", frames), encoding="utf-8")
    assert BROWSER is not None
    done = subprocess.run([BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}", "--dump-dom",
                           (folder / "outer.html").as_uri()], capture_output=True, text=True, timeout=120, check=False)
    found = re.search(r'<pre id="said">(.+?)</pre>', done.stdout, re.DOTALL)
    assert found is not None, done.stderr[-800:]
    said: list[dict[str, Any]] = json.loads(unescape(found.group(1)))
    return said


@pytest.fixture(scope="module")
def pages(small: Path, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    text = small.read_text(encoding="utf-8").replace('title = "My first study', 'title = "' + "Averylongwordwithoutanyplacetobreak" * 4)
    (small.with_name("long.toml")).write_text(text, encoding="utf-8")
    shutil.copytree(finished / "stages", folder / "run" / "stages")  # a title changes the report alone
    run_study(read_study(small.with_name("long.toml")), folder / "run")
    assert cli.main(["plan", str(write(folder)), "--out", str(folder / "plan"), "--quiet"]) == 0
    return {"run": folder / "run" / "report.html", "plan": folder / "plan" / "plan.html", "diagnosis": diagnosis(folder / "diagnosis")}


def diagnosis(folder: Path) -> Path:
    """The page of a diagnosis with every figure that a force law has, and a file with a name as long as they come."""
    found = answer(effect="law")
    drawn = pictures(found, None)
    (folder / "figures").mkdir(parents=True)
    for name, (image, _) in drawn.items():
        (folder / "figures" / f"{name}.png").write_bytes(image)
    (folder / "report.html").write_text(page(found, drawn, [("a" * 200 + ".npz", "0123456789abcdef" * 4)]), encoding="utf-8")
    return folder / "report.html"


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("name", ["run", "plan", "diagnosis"])
def test_nothing_overflows_is_missing_or_is_fetched(name: str, pages: dict[str, Path], tmp_path: Path) -> None:
    text = pages[name].read_text(encoding="utf-8")
    for at in measured(text, tmp_path):
        assert at["scroll"] <= at["width"] and at["wide"] == [], at
        assert len(at["images"]) == text.count("<img") > 1 and all(at["images"]), at
        assert at["asked"] == []


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_the_measuring_finds_what_is_wrong(tmp_path: Path) -> None:
    bad = html.page("bad", '<div style="width:2000px">x</div><img src="data:image/png;base64,AAAA">')
    for at in measured(bad, tmp_path):
        assert at["scroll"] > at["width"] and at["wide"] == ["DIV"] and at["images"] == [0]


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.1) of ``#rrggbb``."""
    parts = [int(colour[i:i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", [0, 1, 2])
def test_text_can_be_read_light_dark_and_on_paper(scheme: int) -> None:
    block = re.findall(r":root \{(.*?)\}", html.STYLE, re.DOTALL)[scheme]
    colours = dict(re.findall(r"--(\w+): (#\w{6})", block))
    for ink in ("ink", "soft", "accent", "good", "bad"):
        for paper in ("page", "tint"):
            high, low = sorted((luminance(colours[ink]), luminance(colours[paper])), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= 4.5, (ink, paper)


def test_a_page_forbids_its_browser_every_request(pages: dict[str, Path]) -> None:
    for path in pages.values():
        assert "Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\"" in path.read_text(
            encoding="utf-8")


@pytest.mark.parametrize("name", ["run", "plan", "diagnosis"])
def test_markdown_says_the_same(name: str, pages: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    folder = pages[name].parent
    assert cli.main(["report", str(folder), "--format", "markdown"]) == 0
    written = folder / ("plan.md" if name == "plan" else "report.md")
    assert str(written) in capsys.readouterr().out
    page, text = pages[name].read_text(encoding="utf-8"), written.read_text(encoding="utf-8")
    images = re.findall(r"!\[.*?\]\(<(.*?)>\)", text)
    assert len(images) == page.count("<img") and all((folder / image).is_file() for image in images)
    words = re.compile(r"[^\W_]+")
    body = re.sub(r"<style>.*?</style>|<title>.*?</title>|<nav>.*?</nav>|<[^>]+>", " ", page, flags=re.DOTALL)
    spoken, written_words = words.findall(unescape(body)), words.findall(re.sub(r"!\[.*?\]\(<.*?>\)", "", text))
    assert sorted(spoken) == sorted(written_words)
    assert text.count("\n| ") == 2 * page.count("<thead>") + page.count("<tr><td")  # head and rule of each table, and its rows


def test_signs_of_markdown_stay_signs() -> None:
    page = html.page("t", html.paragraph("a|b *c* `d` <e> [f](g) h_i _j_") + html.table(["x|y", "n"], [["1|2", "3"]], "here", numeric=(1,))
                     + "<pre>```\ncode</pre>")
    text = markdown(page)
    assert r"a\|b \*c\* \`d\` \<e\> \[f\](g) h_i \_j\_" in text
    assert "| x\\|y | n |\n| --- | ---: |\n| 1\\|2 | 3 |" in text and "````\n```\ncode\n````" in text
