"""Priors of a study: what it states in place of the defaults, joints that it calls nominally equal, and what is said of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.prior import check_priors, groups
from bayes_nlsid.model import Element, Model
from bayes_nlsid.study.priors import chosen_priors, common_values, described
from bayes_nlsid.study.report import _common_values
from bayes_nlsid.study.schema import GroupEntry, PosteriorEntry, PriorEntry
from tests.identification.truth import beam
from tests.inference.targets import run


@pytest.fixture(scope="module")
def start():
    elements = (Element(LIBRARY["q|q|"], ("J1", "J2")), Element(LIBRARY["iwan4_memory"], ("J1", "J2")))
    return fit(Problem(Model(beam(), elements), (run(),), scenario("S2", 3, 0)), starts=1)


def context(entry: PosteriorEntry) -> Any:
    said: list[str] = []
    return SimpleNamespace(study=SimpleNamespace(posterior=entry, file=Path("study.toml")), note=said.append, said=said)


def test_a_group_takes_the_widest_prior_of_its_members_and_stays_within_their_bounds(start) -> None:
    entry = PosteriorEntry(groups=(GroupEntry(("q|q|[*].c",)), GroupEntry(("iwan4_memory[J1].k_t", "iwan4_memory[J2].k_t"), 0.2)))
    plain = {p.name: p for p in chosen_priors(context(PosteriorEntry()), start)}
    priors = chosen_priors(context(entry), start)
    check_priors(start.problem, priors)
    named = {p.name: p for p in priors}
    wide = max(plain[f"q|q|[{j}].c"].b for j in ("J1", "J2"))
    assert {p.b for p in priors if p.group == "q|q|[*].c"} == {wide}
    assert named["q|q|[J1].c"].scatter == pytest.approx(0.3 * wide, rel=0.02)      # the bounds cut the normal distribution a little
    assert named["iwan4_memory[J2].k_t"].scatter == 0.2 and named["iwan4_memory[J2].f_s"].group == ""
    assert all(named[n].lower == plain[n].lower and named[n].upper == plain[n].upper for n in named)
    assert [d.get("group") for d in described(priors)].count("q|q|[*].c") == 2


def test_what_cannot_be_a_group_is_told(start) -> None:
    alone = context(PosteriorEntry(groups=(GroupEntry(("q|q|[J1].c",)),)))
    assert not groups(chosen_priors(alone, start)) and "is not used" in alone.said[0]
    with pytest.raises(InputError, match="different units"):
        chosen_priors(context(PosteriorEntry(groups=(GroupEntry(("q|q|[J1].c", "iwan4_memory[J1].k_t")),))), start)
    own = (PriorEntry("q|q|[J1].c", "normal", 5.0, 1e4),)
    with pytest.raises(InputError, match="differ in kind or middle"):
        chosen_priors(context(PosteriorEntry(priors=own, groups=(GroupEntry(("q|q|[*].c",)),))), start)


def test_the_common_value_is_reported(start) -> None:
    entry = PosteriorEntry(groups=(GroupEntry(("iwan4_memory[*].k_t",), 0.2),))
    priors = chosen_priors(context(entry), start)
    places = groups(priors)["iwan4_memory[*].k_t"]
    low = max(priors[i].lower for i in places)
    theta = np.tile([0.5 * (p.lower + p.upper) for p in priors], (3000, 1))
    theta[:, places] = 10 * low * np.exp(0.01 * np.random.default_rng(0).normal(size=(3000, 2)))
    said = common_values(priors, theta, np.random.default_rng(1))
    assert len(said) == 1 and said[0]["scatter_of"] == "natural logarithm" and said[0]["unit"] == "N/m"
    assert said[0]["common"]["q50"] == pytest.approx(10 * low, rel=0.02)
    assert said[0]["scatter"]["q05"] < said[0]["scatter"]["q50"] < 0.1        # two joints alike to 1 %: less scatter than was expected
    page = _common_values(said)
    assert "nominally equal" in page and "k_t" in page
    assert "the value" in _common_values([replace_scale(said[0])]) and _common_values([]) == ""


def replace_scale(group: dict[str, Any]) -> dict[str, Any]:
    return group | {"scatter_of": "parameter"}


def test_a_stated_prior_of_all_members_is_that_of_the_common_value(start) -> None:
    entry = PosteriorEntry(priors=(PriorEntry("iwan4_memory[*].k_t", "lognormal", 3e3, 0.4),),
                           groups=(GroupEntry(("iwan4_memory[*].k_t",)),))
    priors = [p for p in chosen_priors(context(entry), start) if p.group]
    assert {(p.kind, p.a, p.b, p.scatter) for p in priors} == {("lognormal", 3e3, 0.4, 0.3)}
    assert replace(priors[0], group="", scatter=0.0).quantile([0.95])[0] < priors[0].quantile([0.95])[0]
