"""A small study that runs in a second or two."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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
