"""Long runs by the compiled loop: tests of simulation have compiled it already, and show that it gives the numbers of the numpy loop."""

from __future__ import annotations

import pytest

from bayes_nlsid.simulation import integration


@pytest.fixture(autouse=True)
def _compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(integration, "LONG_RUN", 500)
