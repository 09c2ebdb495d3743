"""Recordings of any kind: an independent little generator (Runge–Kutta on physical coordinates) and what the engine says of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case_campaign import campaign_from_case, needs_general
from bayes_nlsid.mismatch.diagnosis import Diagnosis
from bayes_nlsid.mismatch.innovations import lay_out
from bayes_nlsid.mismatch.odds import Candidate, Findings, bench_findings, findings_from, odds_of, something
from bayes_nlsid.mismatch.recorded import start_of
from bayes_nlsid.mismatch.recorded_answer import diagnose_campaign

Array = NDArray[np.float64]
RATE, COUNT = 200.0, 2400
MASS, STIFFNESS, DAMPING = 2.0, 2.0 * (2 * np.pi * 8.0) ** 2, 2 * 0.02 * 2.0 * 2 * np.pi * 8.0


def band_noise(rng: np.random.Generator, n: int, low: float, high: float, finer: int) -> Array:
    """Random force in a band, on a grid ``finer`` times finer than `RATE`; not periodic in what is kept of it."""
    total = 2 * n * finer
    f = np.fft.rfftfreq(total, 1 / (RATE * finer))
    lines = np.where((f > low) & (f < high), np.exp(2j * np.pi * rng.random(len(f))), 0)
    x = np.fft.irfft(lines, total)[:n * finer + 1]
    return x / x.std()


def march(M: Array, C: Array, K: Array, law: Callable[[Array, Array], Array], force: Array, shape: Array, u0: Array, v0: Array, finer: int
          ) -> tuple[Array, Array, Array]:
    """Classical Runge–Kutta with the force linear over half steps; displacement, velocity, acceleration at `RATE`."""
    h, inverse = 2 / (RATE * finer), np.linalg.inv(M)

    def rate(u: Array, v: Array, F: float) -> Array:
        return inverse @ (shape * F - C @ v - K @ u - law(u, v))

    out, u, v = [], u0.astype(float), v0.astype(float)
    for i in range(0, len(force) - 2, 2):
        if i % finer == 0:
            out.append((u, v, rate(u, v, force[i])))
        a1 = rate(u, v, force[i])
        a2 = rate(u + h / 2 * v, v + h / 2 * a1, force[i + 1])
        v2 = v + h / 2 * a1
        a3 = rate(u + h / 2 * v2, v + h / 2 * a2, force[i + 1])
        v3 = v + h / 2 * a2
        v4 = v + h * a3
        a4 = rate(u + h * v3, v4, force[i + 2])
        u, v = u + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    q, w, a = (np.array(x) for x in zip(*out, strict=True))
    return q, w, a


def write_single(folder: Path, law: Callable[[Array, Array], Array], *, seed: int, stiffness: float = STIFFNESS, damping: float = DAMPING,
                 decay: bool = False, claimed: float = 1.0, push: float = 40.0) -> None:
    """A case folder with one mass, one record and nothing else: no period, no band, no noise record, no repeat."""
    rng = np.random.default_rng(seed)
    finer = 8
    M, C, K = np.array([[MASS]]), np.array([[damping]]), np.array([[stiffness]])
    force = np.zeros(COUNT * finer + 1) if decay else push * band_noise(rng, COUNT, 0.5, 30.0, finer)
    q, _, a = march(M, C, K, law, force, np.ones(1), np.array([0.02 if decay else 0.0]), np.zeros(1), finer)
    n = len(q)
    folder.mkdir(parents=True)
    key, clean = ("displacement", q) if stiffness == 0 else ("accel", a)
    record = {"time": np.arange(n) / RATE, key: clean + 1e-3 * clean.std() * rng.standard_normal(clean.shape)}
    if not decay:
        record["force"] = force[:n * finer:finer]
    np.savez(folder / "run.npz", **record)  # type: ignore[arg-type]
    np.savez(folder / "nominal.npz", M=M, K=claimed * K, C=C, sensor_select=np.ones((1, 1)), shaker_vector=np.ones(1),
             location_names=np.array(["spring"]), location_vectors=np.ones((1, 1)))
    (folder / "case.json").write_text(json.dumps({"case": "single", "fs_hz": RATE, "records": [{"name": "run", "level": 1.0,
                                                                                               "kind": "random"}]}))


def nothing(u: Array, v: Array) -> Array:
    return 0 * u


def named(found: Diagnosis) -> str:
    return found.hypotheses[0].effects[0][0]


def test_an_observer_of_the_true_system_leaves_white_innovations(tmp_path: Path) -> None:
    write_single(tmp_path / "c", nothing, seed=1)
    campaign = campaign_from_case(tmp_path / "c")
    assert needs_general(tmp_path / "c")
    bench = lay_out(campaign, start_of(campaign))
    e = bench.project(bench.innovations)
    n = len(e)
    # band-limited by the analysis, so white only up to its share of the clock
    part = bench.desks[0].part
    for lag in (3, 7, 19):
        assert abs(float(e[lag:] @ e[:-lag]) / float(e @ e)) < 5 / np.sqrt(part * n)
    # projecting twice changes nothing
    assert np.allclose(bench.project(e), e, atol=1e-9 * np.abs(e).max())


@pytest.mark.parametrize("decay", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_linear_system_is_not_given_physics(tmp_path: Path, decay: bool) -> None:
    write_single(tmp_path / "c", nothing, seed=2, decay=decay, claimed=1.06)
    found = diagnose_campaign(campaign_from_case(tmp_path / "c"))
    assert found.p_mismatch < 0.5 and found.verdict != "mismatch"
    assert sum(h.probability for h in found.hypotheses) == pytest.approx(1.0)
    assert found.heldout["nrmse_updated_linear"] < 0.3 * found.heldout["nrmse_nominal"]
    assert any("single record" in n for n in found.notes)


def cubic(u: Array, v: Array) -> Array:
    return 0.15 * STIFFNESS * u ** 3 / 0.006 ** 2


def rubbing(u: Array, v: Array) -> Array:
    return 8.0 * np.tanh(v / 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "cls", "free"), [(cubic, "hardening", False), (rubbing, "coulomb", False), (rubbing, "coulomb", True)])
def test_what_was_left_out_is_named_and_helps(tmp_path: Path, law: Callable[[Array, Array], Array], cls: str, free: bool) -> None:
    stiffness, damping = (0.0, 60.0) if free else (STIFFNESS, DAMPING)
    # with 40 N the hardening oscillator is chaotic: even the true system, run freely, leaves the recording within two seconds
    write_single(tmp_path / "c", law, seed=3, stiffness=stiffness, damping=damping, push=10.0 if law is cubic else 40.0)
    found = diagnose_campaign(campaign_from_case(tmp_path / "c"))
    assert found.p_mismatch > 0.8 and named(found) == cls
    held = found.heldout
    assert held["nrmse_extended"] < 0.5 * held["nrmse_updated_linear"]
    assert not held["withdrawn"]
    assert found.where["locations"][0]["name"] == "spring"


def test_damaged_channels_and_records_cost_a_sentence_not_the_analysis(tmp_path: Path) -> None:
    write_single(tmp_path / "c", nothing, seed=4)
    with np.load(tmp_path / "c" / "run.npz") as raw:
        good = dict(raw)
    wide = {**good, "accel": np.column_stack([good["accel"], np.full(len(good["accel"]), np.nan)])}
    np.savez(tmp_path / "c" / "run.npz", **wide)
    slow = {"time": good["time"][:999], "accel": np.zeros((10, 1)), "force": good["force"][:999]}
    np.savez(tmp_path / "c" / "slow.npz", **slow)
    with np.load(tmp_path / "c" / "nominal.npz") as raw:
        nominal = dict(raw)
    np.savez(tmp_path / "c" / "nominal.npz", **{**nominal, "sensor_select": np.ones((2, 1)), "K": -nominal["K"]})
    meta = json.loads((tmp_path / "c" / "case.json").read_text())
    meta["records"].append({"name": "slow", "level": 1.0, "kind": "random"})
    (tmp_path / "c" / "case.json").write_text(json.dumps(meta))
    campaign = campaign_from_case(tmp_path / "c")
    said = " ".join(campaign.notes)
    assert "S2" in said and "missing values" in said
    assert "not positive definite" in said and "slow" in said
    assert len(campaign.used("fit")) == 1 and len(campaign.used("fit")[0].recording.channels) == 1


def test_odds_sum_to_one_and_nothing_is_claimed_from_nothing() -> None:
    nothing_found = bench_findings([], [], 1000.0)
    odds = odds_of(nothing_found)
    assert sum(odds.values()) == pytest.approx(1.0) and odds[()] > 0.9
    assert something(nothing_found) < 0.05


def test_what_simulation_finds_worse_loses_odds_and_findings_survive_their_file() -> None:
    one, other = (("hardening", "J1"),), (("clearance", "J1"),)
    found = Findings((Candidate(one, 400.0, 0.0), Candidate(other, 390.0, 8.0)), (), 1000.0, error=30.0)
    held = Findings(found.singles, (), 1000.0, error=30.0, simulated=((one, 2.0, 0.1), (other, 0.0, 0.0)), lead=9.0, judged=(3.0, 0.2),
                    left=0.01, noise=0.005)
    assert odds_of(found)[one] > odds_of(found)[other] and odds_of(held)[other] > 0.8
    again = findings_from(json.loads(json.dumps(held.as_dict())))
    assert odds_of(again) == pytest.approx(odds_of(held))
