"""The script of docs/in_python.md, as it stands there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.study.template import example_recording

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "in_python.md").read_text(encoding="utf-8")
SCRIPT = TEXT.split("```python\n")[1].split("```")[0]


def test_it_names_only_what_is_public() -> None:
    import re

    import bayes_nlsid

    names = set(re.findall(r"\bnl\.(\w+)", SCRIPT))
    assert len(names) >= 14 and all(hasattr(bayes_nlsid, name) for name in names)


@pytest.mark.slow
def test_it_finds_what_made_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Truth: 20.3 Hz, 1.2 %, 4e8 N/m³; noise 0.2 %."""
    monkeypatch.chdir(tmp_path)
    np.savez("recording.npz", **example_recording())  # type: ignore[arg-type]
    found: dict[str, Any] = {}
    exec(compile(SCRIPT, "in_python.md", "exec"), found)
    assert [e.term.name for e in found["chosen"].backward] == ["cubic"] and found["posterior"].status == "ok"
    low, middle, high = found["posterior"].quantiles()
    names = found["posterior"].names
    assert middle[names.index("f[1]")] == pytest.approx(20.3, rel=1e-3)
    assert middle[names.index("cubic[x].c")] == pytest.approx(4e8, rel=0.02) and (low < high).all()
    assert found["judged"].nrmse < 2 * found["judged"].noise_floor and 0.8 < found["judged"].coverage90 < 1.0
    assert "ok" in capsys.readouterr().out
