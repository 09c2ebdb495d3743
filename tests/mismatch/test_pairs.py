"""Two laws at once: the second is tried again on the motion that both bring about."""

from __future__ import annotations

import numpy as np

from bayes_nlsid.mismatch.calibrate import calibrate
from bayes_nlsid.mismatch.evidence import gather
from bayes_nlsid.mismatch.explain import scan_forces
from bayes_nlsid.mismatch.joint import refine
from bayes_nlsid.mismatch.laws import POWER_DAMPER
from bayes_nlsid.mismatch.linear import solve
from bayes_nlsid.mismatch.pairs import _other_seconds
from bayes_nlsid.mismatch.paths import LawAlong, bed
from bayes_nlsid.mismatch.polish import Bench, begin
from tests.mismatch.test_mathematics import chain_family, cubic, steady


def test_a_second_law_of_the_wrong_class_is_replaced_by_the_right_one() -> None:
    fam = chain_family()
    theta = np.zeros(fam.size)
    theta[:3] = [0.1, -0.1, 0.1]
    rows = np.array([fam.places[p] for p in ("J5_slip", "J3_slip")])
    probe = steady(fam, theta)
    d, v = bed(solve(fam, theta), probe, rows, fam.shaker).in_time(bed(solve(fam, theta), probe, rows, fam.shaker).linear(1))
    size, w = float(np.abs(d[:, 0]).max()), float(v[:, 1].std())
    damper = LawAlong(lambda q, u, dt: POWER_DAMPER.static_force(q, u, np.array([20.0 * w, w, 2.0])),
                      lambda q, u: POWER_DAMPER.slope(q, u, 20.0 * w, w, 2.0))
    spectra = steady(fam, theta, (cubic(0.1 * 4e5 / size ** 2), damper), ("J5_slip", "J3_slip"), noise=2e-4)
    evidence = gather(spectra, (1.0, 170.0))
    fit = calibrate(fam, spectra.s[spectra.excited], evidence.H, evidence.variance)
    candidates, _, sizes = scan_forces(fam, fit, evidence, list(fam.places))
    bench = Bench(fam, evidence, ("a", "b", "c", "e"), 0.1, {"J3_slip": 4e5, "J5_slip": 4e5}, sizes)
    first = next(c for c in candidates if c.effect.key == ("hardening", "J5_slip"))
    wrong = next(c for c in candidates if c.effect.place == "J3_slip" and c.effect.law is not None and c.effect.cls != "quad_damping")
    pair = refine(bench, begin(bench, fit, (first, wrong)), steps=6)
    others = _other_seconds(bench, pair)
    best = min(others, key=lambda h: h.cost)
    assert [e.key for e in best.effects] == [("hardening", "J5_slip"), ("quad_damping", "J3_slip")]
    assert best.cost < pair.cost - 20
