"""First search and joint estimation on a small synthetic chain (the motion solver is checked on its own elsewhere)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.mismatch.calibrate import calibrate
from bayes_nlsid.mismatch.effects import Effect
from bayes_nlsid.mismatch.evidence import gather
from bayes_nlsid.mismatch.explain import Candidate, scan_forces, scan_linear
from bayes_nlsid.mismatch.joint import estimate, refine
from bayes_nlsid.mismatch.linear import fields, solve
from bayes_nlsid.mismatch.paths import bed
from bayes_nlsid.mismatch.polish import Bench
from bayes_nlsid.mismatch.shapes import shape_columns
from tests.mismatch.test_mathematics import chain_family, cubic, steady

BAND = (1.0, 170.0)


@pytest.fixture(scope="module")
def hardened() -> tuple:
    fam = chain_family()
    theta = np.zeros(fam.size)
    theta[:3] = [0.1, -0.1, 0.1]
    probe = steady(fam, theta)
    scale = float(bed(solve(fam, theta), probe, fam.places["J5_slip"][None], fam.shaker).linear(1).std())
    d = float(np.sqrt(2 * (np.abs(bed(solve(fam, theta), probe, fam.places["J5_slip"][None], fam.shaker).linear(1)) ** 2).sum()))
    assert scale > 0
    stiffness = 0.015 * 4e5 / d ** 2
    spectra = steady(fam, theta, (cubic(stiffness),), ("J5_slip",), noise=2e-4)
    evidence = gather(spectra, BAND)
    fit = calibrate(fam, spectra.s[spectra.excited], evidence.H, evidence.variance)
    return fam, evidence, fit, stiffness, d


def test_latent_force_and_law_point_to_the_place(hardened: tuple) -> None:
    fam, evidence, fit, _, _ = hardened
    assert evidence.statistic > 1.2
    candidates, latents, _ = scan_forces(fam, fit, evidence, list(fam.places))
    assert candidates[0].effect.place == "J5_slip"
    assert candidates[0].effect.cls in ("hardening", "clearance")
    best = max(latents, key=lambda x: x.explained)
    assert best.place == "J5_slip" and best.share > 0.9


def test_latent_force_recovers_the_known_force(hardened: tuple) -> None:
    """What is left of the true force when a linear part is taken out must be what the latent force shows."""
    fam, evidence, fit, stiffness, _ = hardened
    _, latents, _ = scan_forces(fam, fit, evidence, list(fam.places))
    latent = next(x for x in latents if x.place == "J5_slip")
    spectra = evidence.spectra
    true = np.fft.rfft(stiffness * latent.displacement ** 3, axis=1)[:, spectra.lines] / spectra.block
    found = np.fft.rfft(latent.force, axis=1)[:, spectra.lines] / spectra.block
    a, b = evidence.project(true), evidence.project(found)
    agreement = np.abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b)
    assert agreement > 0.8  # the rest is noise on lines where the place is hardly seen


def test_joint_estimation_recovers_the_law(hardened: tuple) -> None:
    fam, evidence, fit, stiffness, d = hardened
    candidates, _, sizes = scan_forces(fam, fit, evidence, list(fam.places))
    bench = Bench(fam, evidence, ("a", "b", "c", "e"), 0.1, {"J3_slip": 4e5, "J5_slip": 4e5}, sizes)
    first = next(c for c in candidates if c.effect.key == ("hardening", "J5_slip"))
    h = estimate(bench, fit, (first,))
    force, reference, power = h.effects[0].values
    assert power == pytest.approx(3.0, abs=0.15)
    assert force * (d / reference) ** power == pytest.approx(stiffness * d ** 3, rel=0.1)
    assert h.misfit_records < 1.1 * evidence.values
    assert h.cost < evidence.chi2 + fit.cost - 100


def test_a_strong_law_is_found_from_a_calibration_that_it_has_bent() -> None:
    """A hardening of 30 % of the joint's stiffness: the mean transfer function is far from linear, and doubted as far as it is."""
    fam = chain_family()
    theta = np.zeros(fam.size)
    theta[:3] = [0.1, -0.1, 0.1]
    row = fam.places["J5_slip"][None]
    probe = bed(solve(fam, theta), steady(fam, theta), row, fam.shaker)
    d = float(np.sqrt(2 * (np.abs(probe.linear(1)) ** 2).sum()))
    stiffness = 0.3 * 4e5 / d ** 2
    spectra = steady(fam, theta, (cubic(stiffness),), ("J5_slip",), noise=2e-4)
    evidence = gather(spectra, BAND)
    s = spectra.s[spectra.excited]
    bent, soft = (calibrate(fam, s, evidence.H, v) for v in (evidence.variance, evidence.doubted(evidence.residual)))
    assert evidence.strong
    # the place itself takes up the mean stiffness of the law either way; the others are left alone
    assert all(np.abs(fit.theta[:2] - theta[:2]).max() < 0.01 for fit in (soft, bent))
    candidates, _, sizes = scan_forces(fam, soft, evidence, list(fam.places))
    bench = Bench(fam, evidence, ("a", "b", "c", "e"), 0.1, {"J3_slip": 4e5, "J5_slip": 4e5}, sizes)
    first = next(c for c in candidates if c.effect.key == ("hardening", "J5_slip"))
    h = refine(bench, estimate(bench, soft, (first,)))
    force, reference, power = h.effects[0].values
    assert power == pytest.approx(3.0, abs=0.15)
    assert force * (d / reference) ** power == pytest.approx(stiffness * d ** 3, rel=0.1)
    assert h.misfit_records < 1.1 * evidence.values


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_errors_of_the_form_of_the_model_are_not_given_physics(seed: int) -> None:
    """A structure outside the nominal family (modes mixed, detuned, coupled by dashpots, wrong at the shaker and the sensors)."""
    fam = chain_family()
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=fam.size) * fam.prior_sd
    theta[:3] = [0.3, -0.2, 0.1]
    spectra = steady(fam, theta, noise=1e-5)
    wrong = 0.003 * rng.normal(size=(4, len(fam.error_sd)))
    s = spectra.s
    errors = np.einsum("mls,sm->ls", shape_columns(fam, fields(fam, solve(fam, theta), s), s), wrong)
    spectra = replace(spectra, response=spectra.response + spectra.force[:, :, None] * errors)
    evidence = gather(spectra, BAND)
    fit = calibrate(fam, s[spectra.excited], evidence.H, evidence.variance)
    assert fit.cost < 1.15 * fit.dof
    bench = Bench(fam, evidence, ("S1", "S2", "S3", "S4"), 0.1, {"J3_slip": 4e5, "J5_slip": 4e5}, {})
    found = scan_linear(fam, fit, bench.channels, bench.mass, bench.stiffness, BAND)[:3]
    gains = [evidence.chi2 + fit.cost - estimate(bench, fit, (c,)).cost for c in found]
    assert max(gains) < 25.0


def test_linear_effects_are_found_by_their_column() -> None:
    fam = chain_family()
    spectra = steady(fam, np.zeros(fam.size), noise=1e-5)
    late = spectra.response.copy()
    late[:, :, 2] *= np.exp(-5e-5 * spectra.s)
    evidence = gather(replace(spectra, response=late), BAND)
    fit = calibrate(fam, spectra.s[spectra.excited], evidence.H, evidence.variance, restarts=0)
    names = ("S1", "S2", "S3", "S4")
    found = scan_linear(fam, fit, names, 0.1, {"J3_slip": 4e5, "J5_slip": 4e5}, BAND)
    assert found[0].effect.key == ("sensor_delay", "S3")
    bench = Bench(fam, evidence, names, 0.1, {"J3_slip": 4e5, "J5_slip": 4e5}, {})
    h = estimate(bench, fit, (Candidate(Effect("sensor_delay", "S3"), 0.0, found[0].start),))
    assert h.effects[0].values[0] == pytest.approx(5e-5, rel=0.05)
