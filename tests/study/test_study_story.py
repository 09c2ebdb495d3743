"""What the report says in words: a run that its own test contradicts is never called just done."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.study.screen import summary
from bayes_nlsid.study.story import missed, sound, status_words, story

TIED = "cubic[J1+J2+J3].k"


def result(coverage: float, *, status: str = "ok", posterior: bool = True) -> dict[str, Any]:
    """A finished run whose band covers the given share of the record "late"."""
    held = {"record": "late", "nrmse": 0.12, "noise_floor": 0.001, "coverage90": coverage}
    row: dict[str, Any] = {"name": TIED, "unit": "N/m^3", "fit": 2.0}
    if posterior:
        row |= {"q05": 1.0, "q50": 2.0, "q95": 3.0, "identifiable": True, "narrowing": 0.1, "ess": 900.0}
    return {"title": "t", "status": status, "reasons": [f"at a bound: {TIED}"], "parameters": [row],
            "heldout": {"records": ["late"], "each": [held], **{k: held[k] for k in ("nrmse", "noise_floor", "coverage90")}}}


def told(found: dict[str, Any]) -> str:
    study: Any = SimpleNamespace(report=SimpleNamespace(notes=()))
    return " ".join(story(study, found))


def test_missed_records_are_said_with_numbers() -> None:
    found = result(0.04)
    words = told(found)
    assert "conditional on an inadequate model" in words and "covers 4 % of record “late”" in words
    assert "on “late” the model errs by 12 %, 120 times the sensor noise" in words
    assert "inadequate" in status_words(found) and "4 %" in status_words(found) and not sound(found)
    assert "inadequate" in summary(found, Path("nowhere")).splitlines()[0]


def test_doubtful_channels_stand_before_the_numbers_that_rest_on_them() -> None:
    found = result(0.9)
    assert "Beware" not in told(found) and "beware" not in summary(found, Path("nowhere"))
    clipped = {"severity": "error", "channel": "a", "sentence": "is clipped", "mend": "measure again", "kind": "clipping"}
    found |= {"recordings": [{"name": "loud", "findings": [clipped, {**clipped, "severity": "note", "sentence": "is odd"}]}],
              "linear": {"polarity": [{"channel": "b", "sentence": "b is inverted"}]}}
    words = told(found)
    assert "loud, channel a: is clipped; measure again. b is inverted." in words and "is odd" not in words
    assert words.index("Beware") < words.index("determine") and summary(found, Path("nowhere")).count("beware") == 2


def test_the_screen_names_the_laws_or_that_there_are_none() -> None:
    found = result(0.9)
    score = {"mse": 1.0, "mse_linear": 50.0, "floor": 0.5}
    found["selection"] = {"forward": [2], "terms": [{"name": "cubic", "index": 2, "locations": ["J1", "J2", "J3"]}], "score": score}
    assert "found: cubic at J1 … J3 was chosen from the library, removing 98.0 %" in summary(found, Path("nowhere"))
    found["selection"] = {"forward": [], "terms": [], "score": score}
    assert "found: No force law of the library explains more" in summary(found, Path("nowhere"))


@pytest.mark.parametrize("coverage", [0.76, 0.9, 1.0])
def test_a_band_that_holds_is_not_called_inadequate(coverage: float) -> None:
    found = result(coverage)
    assert sound(found) and status_words(found) == "done" and "inadequate" not in told(found)


def test_without_posterior_there_are_no_intervals_to_doubt() -> None:
    found = result(0.04, posterior=False)
    assert not missed(found) and "inadequate" not in told(found)
    assert "Next: add [posterior] to learn" in told(found)
    assert "Next: add [posterior] and [prediction] to learn" in told({**found, "heldout": None})


def test_refusals_keep_their_words() -> None:
    found = result(0.04, status="not_converged")
    assert status_words(found) == "refused: the sampler has not converged" and not sound(found)
    assert "conditional on an inadequate model" in told(found)


def test_tied_locations_are_short_where_people_read() -> None:
    for text in (told(result(0.9)), summary(result(0.9), Path("nowhere"))):
        assert "cubic[J1 … J3].k" in text and TIED not in text


def test_joints_without_force_are_named() -> None:
    from bayes_nlsid.study.pictures import idle

    saved: Any = SimpleNamespace(
        data={"loops": [{"term": "jenkins", "location": f"J{k}"} for k in range(3)] + [{"term": "cubic", "location": "J0"}]},
        arrays={"loop0.force": np.zeros((2, 5)), "loop1.force": np.eye(2, 5), "loop2.force": np.zeros((2, 5)),
                "loop3.force": np.zeros((2, 5))})
    assert idle(saved) == ["jenkins at J0, J2", "cubic at J0"]


def test_long_lists_of_aliases_open_on_demand() -> None:
    from bayes_nlsid.study.report import _alike

    page = _alike("main", [f"law{k}[J1+J2+J3]" for k in range(27)])
    assert page.startswith("<details><summary>main: the recordings do not tell 27 other force laws")
    assert page.count("[J1 … J3]") == 6 and "and 21 more" in page and "law6" not in page
