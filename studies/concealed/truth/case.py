"""One case: draw, tune, record, write the folder an engineer would have, and the answer elsewhere."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg as la

from ..retune import prior_sd, retune
from . import answers, catalogue
from .beams import Assembled, assemble
from .campaign import BURST, FS, OFF, PERIOD, PERIODS, STEADY, Campaign, Entry, NoiseModel, Truth, draw_campaign
from .draw import Scenery, draw_scenery
from .effects import Bench, Effect, draw_effect, truth_of
from .excitation import multisine
from .modes import plant
from .response import steady


@dataclass(frozen=True)
class Order:
    """What a case is to contain: classes with target strengths, concealment, tier."""

    index: int
    effects: tuple[tuple[str, float], ...]
    conceal: str | None
    burst_only: bool
    few_sensors: bool

    @property
    def tier(self) -> str:
        return "hard" if self.burst_only or self.few_sensors else "normal"


CONCEALMENTS = ("loose_prior", "noise", "rare", "hidden_joint", "one_level")
STRENGTHS = (0.3, 0.1, 0.03, 0.01)


def plan(cases: int, seed: int, hard: float = 0.15) -> list[Order]:
    """Orders of a batch by quota: 20 % nothing, 12 % doubles, 40 % concealed, ``hard`` bursts only and/or four sensors."""
    rng = np.random.default_rng([seed, 1])
    nulls, doubles = round(0.2 * cases), round(0.12 * cases)
    classes = [c for c in catalogue.CLASSES if c != "none"] + ["other", "other"]
    deck: list[str] = []
    while len(deck) < cases + doubles:
        deck += list(rng.permutation(classes))
    strengths = [STRENGTHS[i % 4] for i in range(cases + doubles)]
    strengths = list(rng.permutation(strengths))
    contents: list[tuple[tuple[str, float], ...]] = []
    for i in range(cases):
        if i < nulls:
            contents.append(())
            continue
        count = 2 if i < nulls + doubles else 1
        drawn = [(str(deck.pop()), float(strengths.pop())) for _ in range(count)]
        if count == 2 and drawn[0][0] == drawn[1][0]:
            drawn[1] = (str(deck.pop()), drawn[1][1])
        contents.append(tuple(drawn))
    # Quotas within nulls and within the others alike, so that no concealment hints at an effect.
    hidden = _quota(rng, nulls, cases, 0.4)
    tough = _quota(rng, nulls, cases, hard)
    turn = {True: int(rng.integers(5)), False: int(rng.integers(5))}
    orders = []
    for i, content in enumerate(contents):
        conceal = None
        if hidden[i]:
            conceal = CONCEALMENTS[turn[i < nulls] % 5]
            turn[i < nulls] += 1
            if conceal == "rare" and content and not any(c in catalogue.MAY_BE_RARE for c, _ in content):
                conceal = str(rng.choice(["loose_prior", "noise", "hidden_joint", "one_level"]))
        kind = int(rng.integers(3)) if tough[i] else -1
        orders.append((content, conceal, kind in (0, 2), kind in (1, 2)))
    shuffled = rng.permutation(cases)
    return [Order(i, *orders[j]) for i, j in enumerate(shuffled)]


def _quota(rng: np.random.Generator, nulls: int, cases: int, share: float) -> np.ndarray:
    flags = np.zeros(cases, bool)
    for group in (np.arange(nulls), np.arange(nulls, cases)):
        flags[rng.permutation(group)[: round(share * group.size)]] = True
    return flags


@dataclass(frozen=True)
class Made:
    """A finished case in memory."""

    name: str
    order: Order
    scenery: Scenery
    nominal: Assembled
    bench: Bench
    campaign: Campaign
    effects: tuple[Effect, ...]
    truth: Truth
    noise: NoiseModel
    noise_rel: float
    clean: dict[str, tuple[np.ndarray, np.ndarray]]
    noisy: dict[str, tuple[np.ndarray, np.ndarray]]
    baseline: dict[str, tuple[np.ndarray, np.ndarray]]


def make(order: Order, seed: int) -> Made:
    """Build one case; the same order and seed give the same bytes."""
    rng = np.random.default_rng([seed, 2, order.index])
    name = "case_" + hashlib.sha256(f"{seed}-{order.index}".encode()).hexdigest()[:8]
    sensors = 4 if order.few_sensors else int(rng.integers(5, 13))
    scenery = draw_scenery(rng, sensors, order.conceal == "hidden_joint", order.conceal == "loose_prior")
    campaign = draw_campaign(rng, order.conceal == "one_level", order.burst_only)
    bench = _bench(scenery, campaign, sensors, int(rng.integers(2**62)))
    hidden = tuple(j for j in bench.joints if j.startswith("J"))
    effects: tuple[Effect, ...] = ()
    for cls, target in order.effects:
        effects += (draw_effect(cls, target, bench, rng, order.conceal, hidden, tuple(e.loc for e in effects)),)
    truth = truth_of(bench, effects)
    noise_rel = float(rng.uniform(0.05, 0.15) if order.conceal == "noise" else rng.uniform(0.0025, 0.01))
    quality = np.exp(0.15 * rng.standard_normal(sensors)) * np.where(rng.random(sensors) < 0.15, rng.uniform(2, 4, sensors), 1.0)
    noise = NoiseModel(
        noise_rel * bench.rms * quality,
        rng.uniform(2, 25, sensors),
        tuple((float(a), float(b)) for a, b in zip(rng.uniform(100, 900, sensors), rng.uniform(0, 1.5, sensors), strict=True)),
        float(10 ** rng.uniform(-3.3, -2.7)) * campaign.rms,
        int(rng.integers(2**62)),
    )
    clean = {e.name: truth.clean(campaign, e) for e in campaign.entries}
    plain = Truth(bench.plant, (), (), sensors, 0)
    baseline = {e.name: plain.clean(campaign, e) for e in campaign.entries} if effects else clean
    noisy = {e.name: noise.add(clean[e.name][1], clean[e.name][0], i)[::-1] for i, e in enumerate(campaign.entries)}
    nominal = assemble(scenery.nominal, scenery.nominal_mesh)
    return Made(name, order, scenery, nominal, bench, campaign, effects, truth, noise, noise_rel, clean, noisy, baseline)


def _bench(scenery: Scenery, campaign: Campaign, sensors: int, seed: int) -> Bench:
    model = assemble(scenery.truth, scenery.truth_mesh)
    base = plant(model, scenery.damping)
    force = multisine(np.random.default_rng([seed, 3]), campaign.lines, campaign.rms, FS, PERIOD)
    accel = steady(base, force, FS, [f"S{i + 1}" for i in range(sensors)], "SHAKER", FS, 2)
    own = {n: float(np.trace(k)) / float(model.vectors[n] @ model.vectors[n]) for n, k in model.K_parts.items() if n in model.joint_names}
    late = max(e.start_s for e in campaign.entries if not e.sealed and e.level == 1.0)
    return Bench(
        model,
        scenery.damping,
        base,
        campaign,
        force,
        accel,
        model.joint_names,
        own,
        sensors,
        scenery.tolerances.joint_stiffness_log_sd,
        seed,
        late,
    )


def write(made: Made, folder: Path, answer_folder: Path) -> None:
    """Write the case folder and, elsewhere, its answer and sealed responses."""
    case = folder / made.name
    case.mkdir(parents=True, exist_ok=True)
    answer_folder.mkdir(parents=True, exist_ok=True)
    _write_nominal(made, case)
    (case / "case.json").write_text(json.dumps(_case_json(made), indent=1))
    sealed: dict[str, np.ndarray] = {}
    for e in made.campaign.entries:
        force, accel = (a.astype(np.float32) for a in made.noisy[e.name])
        time = e.start_s + np.arange(force.size) / FS
        if e.sealed:
            np.savez(case / f"{e.name}_force.npz", time=time, force=force)
            sealed[f"{e.name}_accel"] = accel
            sealed[f"{e.name}_clean"] = made.clean[e.name][1].astype(np.float32)
        else:
            np.savez(case / f"{e.name}.npz", time=time, force=force, accel=accel)
    best = _best_linear(made, sealed)
    np.savez(answer_folder / f"{made.name}_sealed.npz", **sealed)
    (answer_folder / f"{made.name}.json").write_text(json.dumps(_answer(made, best), indent=1))


def _write_nominal(made: Made, case: Path) -> None:
    a = made.nominal
    sensors = np.array([a.vectors[f"S{i + 1}"] for i in range(made.bench.sensors)])
    np.savez(
        case / "nominal.npz",
        M=a.M,
        K=a.K,
        K_parts=np.array(list(a.K_parts.values())),
        K_part_names=np.array(list(a.K_parts)),
        M_parts=np.array(list(a.M_parts.values())),
        M_part_names=np.array(list(a.M_parts)),
        sensor_select=sensors,
        shaker_vector=a.vectors["SHAKER"],
        base_vector=a.vectors["BASE"],
        location_names=np.array(a.joint_names),
        location_vectors=np.array([a.vectors[n] for n in a.joint_names]),
    )


def _case_json(made: Made) -> dict[str, Any]:
    lay, n = made.scenery.nominal, made.bench.sensors
    burst_only = made.order.burst_only
    return {
        "case": made.name,
        "fs_hz": FS,
        "period_s": PERIOD,
        "band_hz": list(made.campaign.band),
        "units": {"time": "s", "force": "N", "accel": "m/s^2", "location_vectors": "m for *_slip, *_open, TIP_w; rad for ROOT_rot"},
        "excited_lines": [] if burst_only else [int(k) for k in made.campaign.lines],
        "line_spacing_hz": 1.0 / PERIOD,
        "records": [
            {"name": e.name, "level": e.level, "kind": e.kind, "start_s": e.start_s, "sealed": e.sealed} for e in made.campaign.entries
        ],
        "geometry": {
            "support": lay.support,
            "width": lay.width,
            "tip_mass_kg": lay.tip_mass,
            "beams": [
                {"name": b.name, "from": round(b.x0, 4), "to": round(b.x1, 4), "heights": [list(h) for h in b.heights]} for b in lay.beams
            ],
            "joints": [round(j.x, 4) for j in lay.joints],
            "sensors": [
                {"name": f"S{i + 1}", "beam": lay.beams[p.beam].name, "x": p.x, "mass_point": f"P{i + 1}"}
                for i, p in enumerate(lay.sensors)
            ],
            "shaker": {"beam": lay.beams[lay.shaker.beam].name, "x": lay.shaker.x},
        },
        "nominal_damping_ratio": made.scenery.damping_ratio,
        "tolerances": asdict(made.scenery.tolerances),
        "classes": list(catalogue.CLASSES),
        "locations": {
            "joints": list(made.nominal.joint_names),
            "mass_points": [*(f"P{i + 1}" for i in range(n)), "SHAKER"],
            "sensors": [f"S{i + 1}" for i in range(n)],
            "other": ["FORCE", "BASE", "ALL_SENSORS", "-"],
        },
        "mains_hz": 50.0,
        "note": "at most two effects are missing from the nominal model; none is possible",
    }


def _line_noise(made: Made, entry: Entry) -> np.ndarray:
    """Variance (k, s) of a record's lines, from the noise model's own colour: many draws are averaged over neighbours."""
    n = made.clean[entry.name][0].size
    rng_index = 10_000
    noise, _ = made.noise.add(np.zeros((n, made.bench.sensors)), np.zeros(n), rng_index)
    power = np.abs(answers.spectrum(noise, entry)) ** 2
    kernel = np.ones(31) / 31
    return np.maximum(np.array([np.convolve(np.pad(p, 15, mode="edge"), kernel, "valid") for p in power.T]).T, 1e-30)


def _reach(made: Made) -> dict[str, float | bool]:
    """Chi-square of the whole change over the open records, and what the stated tolerances cannot absorb of it."""
    if not made.effects:
        return {"chi2_change": 0.0, "chi2_beyond_tolerances": 0.0, "inside_tolerances": False}
    model, tolerance = made.bench.assembled, asdict(made.scenery.tolerances)
    w2, shapes = la.eigh(model.K, model.M, subset_by_value=[-np.inf, (2 * np.pi * 3000.0) ** 2])
    parts = {n: (shapes.T @ k @ shapes, prior_sd(n, tolerance), False) for n, k in model.K_parts.items()}
    parts |= {n: (shapes.T @ m @ shapes, prior_sd(n, tolerance), True) for n, m in model.M_parts.items()}
    w = np.sqrt(w2)
    rows = np.array([shapes.T @ model.vectors[n] for n in [*(f"S{i + 1}" for i in range(made.bench.sensors)), "SHAKER"]]).T
    hz = made.campaign.lines[::2] / PERIOD
    J = answers.sensitivities(w, made.scenery.damping(w / 2 / np.pi), rows, parts, hz, tolerance["damping_rel_sd"])
    changes, forces, picks, variances = [], [], [], []
    for e in made.campaign.entries:
        if e.sealed or e.kind == OFF:
            continue
        (f0, y0), (f1, y1) = made.baseline[e.name], made.clean[e.name]
        F0, F1 = answers.spectrum(f0, e), answers.spectrum(f1, e)
        change = answers.spectrum(y1, e) - answers.spectrum(y0, e)
        step = FS / (f0.size / (PERIODS if e.kind == STEADY else 1))
        pick = np.round(hz / step).astype(int)
        # A misread force is a change of the response expected from the force that is read.
        with np.errstate(divide="ignore", invalid="ignore"):
            misread = np.where(np.abs(F0) > 1e-6 * np.abs(F0).max(), (F1 - F0) / F0, 0.0)
        change = change - answers.spectrum(y0, e) * misread[:, None]
        changes.append(change)
        forces.append(F0)
        picks.append(pick)
        variances.append(_line_noise(made, e))
    thinned = [np.zeros_like(c) for c in changes]
    for full, thin, pick in zip(changes, thinned, picks, strict=True):
        thin[pick] = full[pick]
    _, on_lines_left = answers.beyond_tolerances(thinned, forces, picks, J, variances)
    total = sum(float(np.sum(np.abs(c) ** 2 / v)) for c, v in zip(changes, variances, strict=True))
    on_lines = sum(float(np.sum(np.abs(c) ** 2 / v)) for c, v in zip(thinned, variances, strict=True))
    # Only every second line was fitted; the share left over is carried to all lines that carry force.
    lit = sum(
        float(np.sum(np.abs(c[np.abs(f) > 1e-6 * np.abs(f).max()]) ** 2 / v[np.abs(f) > 1e-6 * np.abs(f).max()]))
        for c, v, f in zip(changes, variances, forces, strict=True)
    )
    left = on_lines_left * (lit / max(on_lines, 1e-30)) + (total - lit)
    return {"chi2_change": total, "chi2_beyond_tolerances": left, "inside_tolerances": bool(left < answers.PROVABLE)}


def _best_linear(made: Made, sealed: dict[str, np.ndarray]) -> dict[str, Any]:
    """Best linear re-tuning on the open records, and its prediction of the sealed ones (added to ``sealed``)."""
    hz, H, variance = measured_frf(made)
    a, factors = made.nominal, dict(made.scenery.factors)
    nominal = {
        "K_parts": np.array(list(a.K_parts.values())),
        "M_parts": np.array(list(a.M_parts.values())),
        "K_part_names": np.array(list(a.K_parts)),
        "M_part_names": np.array(list(a.M_parts)),
        "M": a.M,
        "K": a.K,
        "shaker_vector": a.vectors["SHAKER"],
        "sensor_select": np.array([a.vectors[f"S{i + 1}"] for i in range(made.bench.sensors)]),
    }
    fit = retune(nominal, asdict(made.scenery.tolerances), made.scenery.damping_ratio, hz, H, variance, factors)
    out: dict[str, Any] = {"misfit_over_noise": fit.misfit, "records": {}}
    for e in made.campaign.entries:
        if e.sealed:
            force, accel = (x.astype(np.float32).astype(float) for x in made.noisy[e.name])
            guess = fit.predict(force, FS, PERIODS if e.kind == STEADY else 0)
            sealed[f"{e.name}_linear"] = guess.astype(np.float32)
            size = float(np.sqrt(np.mean(accel**2)))
            out["records"][e.name] = {
                "nrmse_linear": float(np.sqrt(np.mean((guess - accel) ** 2))) / size,
                "noise_floor": float(np.sqrt(np.mean((made.clean[e.name][1] - accel) ** 2))) / size,
            }
    return out


def measured_frf(made: Made) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency responses from the open records: ``hz`` (f,), ``H`` (f, s), ``variance`` (f, s)."""
    entries = [e for e in made.campaign.entries if not e.sealed and e.kind == (BURST if made.order.burst_only else STEADY)]
    hz = made.campaign.lines / PERIOD
    top = power = noise = 0.0
    for e in entries:
        force, accel = made.noisy[e.name]
        F, Y = answers.spectrum(force, e), answers.spectrum(accel, e)
        step = FS / (force.size / (PERIODS if e.kind == STEADY else 1))
        pick = np.round(hz / step).astype(int)
        v = _line_noise(made, e)[pick]
        # Lines weigh by their signal to noise, which is the same noise in all records of one kind.
        top = top + F[pick, None].conj() * Y[pick]
        power = power + np.abs(F[pick, None]) ** 2
        noise = noise + np.abs(F[pick, None]) ** 2 * v
    H = top / power
    # Force noise acts like a share of the response.
    relative = (made.noise.force / made.campaign.rms) ** 2 / 30.0
    return hz, H, noise / power**2 + relative * np.abs(H) ** 2


def _answer(made: Made, best: dict[str, Any]) -> dict[str, Any]:
    reach = _reach(made)
    names = [*made.nominal.joint_names, *(f"P{i + 1}" for i in range(made.bench.sensors)), "SHAKER"]
    sigma = made.noise.sigma
    nominal_change = {e.name: made.clean[e.name][1] - made.baseline[e.name][1] for e in made.campaign.entries}
    reference = [e.name for e in made.campaign.entries if e.level == 1.0 and not e.sealed]
    ratio = [np.sqrt(np.mean(nominal_change[n] ** 2) / np.mean(made.baseline[n][1] ** 2)) for n in reference]
    alike = {
        e.loc: answers.equivalent_places(made.bench.plant, e.loc, names, made.bench, sigma, float(reach["chi2_beyond_tolerances"]))
        for e in made.effects
    }
    return {
        "case": made.name,
        "n_effects": len(made.effects),
        "effects": [
            {
                "cls": e.cls,
                "loc": e.loc,
                "target": e.target,
                "strength": e.achieved,
                "formula": e.formula,
                "params": e.params,
                "group": catalogue.group(e.cls),
                **({"kind": e.params["kind"]} if "kind" in e.params else {}),
            }
            for e in made.effects
        ],
        "tol_k": made.scenery.tolerances.joint_stiffness_log_sd,
        "conceal": made.order.conceal,
        "tier": made.order.tier,
        "burst_only": made.order.burst_only,
        "few_sensors": made.order.few_sensors,
        "noise_rel": made.noise_rel,
        "sigma": [float(s) for s in sigma],
        "change_measured": float(np.mean(ratio)),
        "change_not_lti": answers.change_not_lti(made.clean, made.campaign),
        **reach,
        "equivalent_locations": alike,
        "true_factors": made.scenery.factors,
        "best_linear": best,
        "support": made.scenery.nominal.support,
        "theories": {"truth": asdict(made.scenery.truth_mesh), "nominal": asdict(made.scenery.nominal_mesh)},
    }
