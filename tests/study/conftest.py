"""A small study that runs in a second or two."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.simulation import integration
from bayes_nlsid.study import pictures
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.run import run_study
from bayes_nlsid.study.template import TEXT, example_recording


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "recording.npz"
    np.savez(path, **example_recording())
    return path


@pytest.fixture(scope="session")
def small(recording: Path) -> Path:
    """The template without posterior and prediction, with a shorter window."""
    text = TEXT[:TEXT.index("[posterior]")].replace("window = [0.0, 8.0]", "window = [0.0, 4.0]")
    path = recording.parent / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def finished(small: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run of the small study leaves; to be copied, never written into."""
    out = tmp_path_factory.mktemp("finished") / "out"
    run_study(read_study(small), out)
    return out


@pytest.fixture(autouse=True)
def _compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs shorter than those of studies go by the compiled loop too; tests of simulation show that it gives the same numbers."""
    monkeypatch.setattr(integration, "LONG_RUN", 500)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures, where only stages and numbers are looked at."""
    monkeypatch.setattr(pictures, "draw_all", lambda *_: [])
