"""Strong laws through the dynamic stiffness that they lend to their place at every level."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.mismatch.evidence import Evidence, gather
from bayes_nlsid.mismatch.explain import sizes
from bayes_nlsid.mismatch.joint import pursue, refine
from bayes_nlsid.mismatch.laws import POWER_DAMPER
from bayes_nlsid.mismatch.linear import Attachment, Family, fields, solve
from bayes_nlsid.mismatch.paths import LawAlong, bed
from bayes_nlsid.mismatch.polish import Bench
from bayes_nlsid.mismatch.quasilinear import by_level, equivalent, strong_starts
from tests.mismatch.test_mathematics import chain_family, steady

BAND = (1.0, 170.0)
STIFFNESS = {"J3_slip": 4e5, "J5_slip": 4e5}


def bench_of(fam: Family, evidence: Evidence) -> Bench:
    paths = bed(solve(fam, np.zeros(fam.size)), evidence.spectra, np.array(list(fam.places.values())), fam.shaker)
    return Bench(fam, evidence, ("a", "b", "c", "e"), 0.1, STIFFNESS, sizes(paths, list(fam.places)))


def shifted(fam: Family) -> np.ndarray:
    theta = np.zeros(fam.size)
    theta[:3] = [0.1, -0.1, 0.1]
    return theta


def test_dynamic_stiffness_of_each_level_is_recovered_with_its_place() -> None:
    fam = chain_family()
    theta, spectra = shifted(fam), steady(chain_family(), shifted(chain_family()))
    truth = np.array([[1e4, 5.0], [6e4, 40.0]])
    response = spectra.response.copy()
    for level, (k, c) in zip(np.unique(spectra.levels), truth, strict=True):
        joint = Attachment(fam.places["J3_slip"], k + c * spectra.s)
        H = fields(fam, solve(fam, theta), spectra.s, (joint,)).H
        for r in np.flatnonzero(spectra.levels == level):
            response[r] = H * spectra.force[r][:, None]
    evidence = gather(replace(spectra, response=response), BAND)
    bench, levels = bench_of(fam, evidence), by_level(evidence)
    found = {place: equivalent(bench, place, np.zeros(fam.size), levels) for place in fam.places}
    assert found["J3_slip"].cost < found["J5_slip"].cost - 10
    here = found["J3_slip"]
    # a stiffness common to both levels may as well be the linear model's; the step between them may not
    assert here.values[1, 0] - here.values[0, 0] == pytest.approx(5e4, rel=0.05)
    assert here.values[:, 1] == pytest.approx(truth[:, 1], abs=3.0)


def test_a_damper_that_all_but_locks_its_joint_is_begun_near_the_truth() -> None:
    """At the higher level the joint hardly moves: the calibrated linear model has a stiffer joint and knows no velocity there."""
    fam, theta = chain_family(), shifted(chain_family())
    probe = steady(fam, theta)
    _, v = bed(solve(fam, theta), probe, fam.places["J5_slip"][None], fam.shaker).in_time(
        bed(solve(fam, theta), probe, fam.places["J5_slip"][None], fam.shaker).linear(int(np.argmax(probe.levels))))
    w = float(np.std(v))
    strength = 400.0 * w
    law = LawAlong(lambda d, v, dt: POWER_DAMPER.static_force(d, v, np.array([strength, w, 2.0])),
                   lambda d, v: POWER_DAMPER.slope(d, v, strength, w, 2.0))
    spectra = steady(fam, theta, (law,), ("J5_slip",), noise=2e-4)
    evidence = gather(spectra, BAND)
    assert evidence.strong
    bench = bench_of(fam, evidence)
    begun = strong_starts(bench, np.zeros(fam.size))
    assert {h.effects[0].place for h in begun} == {"J5_slip"}
    best = refine(bench, min((pursue(bench, h) for h in begun), key=lambda h: h.cost), steps=10)
    assert best.effects[0].cls == "quad_damping"
    assert best.misfit_records < 1.1 * evidence.values
