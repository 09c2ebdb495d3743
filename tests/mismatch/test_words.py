"""Words and numbers that both engines tell: sizes, probabilities, what separates two hypotheses, places that stand for one another."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.mismatch.answer import _alike
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.laws import Size, power_onset
from bayes_nlsid.mismatch.recorded_answer import onset_of
from bayes_nlsid.mismatch.suspects import Suspect
from bayes_nlsid.mismatch.words import error_percent, known, separates, size_of, sure, whole_percent

ORDERED = [((("hardening", "TIP_w"),), 0.6), ((("clearance", "TIP_w"),), 0.25), ((("added_mass", "P1"), ("hardening", "TIP_w")), 0.1),
           ((("other", "-"),), 0.04), ((), 0.01)]


@pytest.mark.parametrize(("value", "words"), [(9.2e-7, "920 nm"), (4.21e-6, "4.2 µm"), (0.0301, "30 mm"), (9.96e-4, "1 mm"), (2.0, "2 m")])
def test_sizes_have_a_prefix_and_two_digits(value: float, words: str) -> None:
    assert size_of(value, "m") == words


def test_probabilities_never_round_to_certainty() -> None:
    assert [whole_percent(p) for p in (0.0, 0.002, 0.4, 0.997)] == ["< 1 %", "< 1 %", "40 %", "> 99 %"]
    assert [sure(p) for p in (1e-6, 0.93, 0.9999)] == ["< 0.001", "= 0.93", "> 0.999"]
    assert [error_percent(e) for e in (1.16, 0.203, 0.0115)] == ["116 %", "20 %", "1.1 %"]


def test_the_test_that_separates_belongs_to_the_likeliest_other_claim() -> None:
    assert separates((("hardening", "TIP_w"),), ORDERED) == ROWS["hardening"].test + " (tells it from clearance)"
    assert separates((("clearance", "TIP_w"),), ORDERED) == ROWS["clearance"].test + " (tells it from hardening)"
    # a pair is told from its member by the test of the effect that it adds
    assert separates((("added_mass", "P1"), ("hardening", "TIP_w")), ORDERED) == ROWS["added_mass"].test + " (tells it from hardening)"
    assert separates((("none", "-"),), ORDERED) == ROWS["none"].test
    # rivals that nobody believes in are not worth a test
    sure_of_it = [((("coulomb", "J1_slip"),), 0.99), ((("force_delay", "FORCE"),), 0.002)]
    assert separates((("coulomb", "J1_slip"),), sure_of_it) == ROWS["coulomb"].test


def test_places_stand_for_one_another_only_with_one_class_and_not_together() -> None:
    odds = {(("other", "J1_slip"),): 0.45, (("other", "J2_slip"),): 0.4, (("sensor_gain", "S1"),): 0.15}
    assert _alike(odds, ["J1_slip", "J2_slip", "S1"]) == {"J1_slip": ["J2_slip"], "J2_slip": ["J1_slip"], "S1": []}
    pair = {(("hysteresis", "J1_slip"), ("hysteresis", "J3_slip")): 0.9, (("hysteresis", "J1_slip"),): 0.1}
    assert _alike(pair, ["J1_slip", "J3_slip"]) == {"J1_slip": [], "J3_slip": []}


def test_a_power_spring_sets_in_where_a_tenth_of_its_stiffness_is_there() -> None:
    peak, n = 3e-4, 5.0
    d = np.array([power_onset(np.array([1.0, 1.0, n]), peak), peak])
    stiffness = d ** (n - 1)
    assert stiffness[0] / stiffness[1] == pytest.approx(0.1)


def test_what_a_law_holds_fixed_is_told_with_it() -> None:
    law = ROWS["hardening"].laws[0]
    told = known(law, "J1_slip", [1.0, 2e-6, 3.0], "hardening")
    fixed = [q.name for q, kind in zip(law.term.params, law.free, strict=True) if kind == "fixed"]
    assert [p["name"] for p in told] == [f"hardening[J1_slip].{name}" for name in fixed]
    assert told[0]["q05"] == told[0]["q95"] == 2e-6 and told[0]["meaning"]


def test_every_spring_of_the_catalogue_has_an_onset_within_the_motion() -> None:
    size = Size(1e-5, 1e-2, 3e-5)
    for cls in ("hardening", "softening", "clearance"):
        for law in ROWS[cls].laws:
            if law.convert is None:
                suspect = Suspect(cls, "J1_slip", law, law.shapes(size)[0], size)
                assert 0 < onset_of(suspect, suspect.shape) < size.peak, law.term.name
