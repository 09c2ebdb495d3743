"""Draw cases and write them: one folder for each, and the answers in another place."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from studies.any_recording.truth import Chain, Law, draw_chain, excitation, laws, march, sensor_noise

Array = NDArray[np.float64]
FORCES = ("hardening", "softening", "clearance", "asymmetric", "coulomb", "quad_damping", "hysteresis")
OTHERS = ("force_delay", "sensor_gain", "stiffness_drift")
STRENGTHS = (0.03, 0.1, 0.3)
NULLS = 0.3          # share of cases with nothing missing
KEYS = {"accel": 2, "displacement": 0, "velocity": 1}


@dataclass(frozen=True)
class Plan:
    """What a test day looks like."""

    kind: str
    levels: tuple[float, ...]
    seconds: float
    rate: float
    key: str
    sensors: tuple[int, ...]
    shaker: int
    noise: float
    colour: str


def draw_plan(rng: np.random.Generator, chain: Chain) -> Plan:
    """Kind of excitation, levels, length, rate, sensors and noise."""
    n, f = len(chain.M), chain.frequencies
    kind = str(rng.choice(["noise", "sweep", "decay", "burst"], p=[0.35, 0.25, 0.25, 0.15]))
    levels = ((1.0,), (0.4, 1.0), (0.3, 1.0, 0.6))[int(rng.choice(3, p=[0.5, 0.25, 0.25]))]
    key = str(rng.choice(list(KEYS), p=[0.6, 0.3, 0.1]))
    seen = sorted(rng.choice(n, size=int(rng.integers(1, n + 1)), replace=False).tolist())
    noise = float(np.exp(rng.uniform(np.log(0.0005), np.log(0.02))))
    return Plan(kind, levels, float(rng.uniform(150, 350) / f[0]), float(f[-1] * rng.uniform(9, 20)), key, tuple(seen),
                int(rng.integers(n)), noise, str(rng.choice(["white", "slow", "pink"], p=[0.5, 0.25, 0.25])))


def make(seed: int, number: int) -> tuple[dict[str, Any], dict[str, Array], list[dict[str, Any]], dict[str, Any]]:
    """Case file, matrices, records and answer of one case."""
    rng = np.random.default_rng([seed, number])
    chain = draw_chain(rng, int(rng.choice([1, 2, 3], p=[0.5, 0.3, 0.2])))
    plan = draw_plan(rng, chain)
    cls, place, strength = "none", 0, 0.0
    if rng.random() >= NULLS:
        allowed = [*FORCES, *(c for c in OTHERS if (c != "force_delay" or plan.kind != "decay") and
                              (c != "sensor_gain" or len(plan.sensors) > 1 and len(chain.M) > 1) and
                              (c != "stiffness_drift" or len(plan.levels) > 2 and plan.kind != "decay"))]
        cls, place = str(rng.choice(allowed)), int(rng.integers(len(chain.M)))
        strength = float(rng.choice(STRENGTHS))
    records, told = _record(rng, chain, plan, cls, place, strength)
    name = f"case_{number:03d}"
    answer = {"case": name, "class": cls, "location": _where(cls, place, plan), "kind": plan.kind, "levels": list(plan.levels),
              "masses": len(chain.M), "sensors": len(plan.sensors), "quantity": plan.key, "noise": plan.noise,
              "colour": plan.colour, **told}
    return _meta(name, plan, len(chain.M)), _nominal(rng, chain, plan), records, answer


def _where(cls: str, place: int, plan: Plan) -> str:
    if cls == "none":
        return "-"
    return {"force_delay": "FORCE", "sensor_gain": f"S{place % len(plan.sensors) + 1}"}.get(cls, f"J{place + 1}")


def _record(rng: np.random.Generator, chain: Chain, plan: Plan, cls: str, place: int, strength: float
            ) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """All records with the effect at the wanted strength, noise and all, and what was achieved."""
    n, f = len(chain.M), chain.frequencies
    count = int(plan.seconds * plan.rate)
    times = np.arange(count) / plan.rate
    drive = np.eye(n)[plan.shaker]
    waves = [None if plan.kind == "decay" else excitation(rng, plan.kind, plan.seconds + 0.1, 0.3 * f[0], 1.3 * f[-1])
             for _ in plan.levels]
    blow = rng.standard_normal(n)
    own = 2 * np.pi * f[0]

    def run(level: float, wave: Any, law: Law | None, a: float, softer: Any = None) -> tuple[Array, Array, Array]:
        start = np.concatenate([np.zeros(n), level * blow * own]) if wave is None else np.zeros(2 * n)
        return march(chain, law, a, place, wave, level * drive * float(chain.K[0, 0]), start, times, level, softer)

    loud = int(np.argmax(plan.levels))
    plain = run(1.0, waves[loud], None, 0.0)
    b = chain.springs[place]
    q, v = plain[0] @ b, plain[1] @ b
    half = slice(0, max(8, int(count * (0.3 if plan.kind == "decay" else 1.0))))
    law, a, told = None, 0.0, {"formula": "", "strength": 0.0}
    which = KEYS[plan.key]
    if cls in FORCES:
        law = laws(rng, cls, float(q[half].std()), float(v[half].std()), float(np.abs(q).max()),
                   float(1 / (b @ np.linalg.solve(chain.K, b))))
        a, achieved = _tuned(lambda x: run(1.0, waves[loud], law, x)[which][:, list(plan.sensors)],
                             plain[which][:, list(plan.sensors)], strength)
        told = {"formula": law.formula, "strength": achieved, "factor": a}
    drift = 0.0
    if cls == "stiffness_drift":
        drift, told = strength * 0.3, {"formula": "between records", "strength": strength}
    out = []
    for i, (level, wave) in enumerate(zip(plan.levels, waves, strict=True)):
        change = drift * (i / max(len(waves) - 1, 1) - 0.5)
        motion = run(level, wave, law, a, (lambda t, change=change: change) if drift else None)[which][:, list(plan.sensors)]
        applied = np.zeros(count) if wave is None else level * float(chain.K[0, 0]) * wave(times)
        if cls == "force_delay":
            tau = strength / (2 * np.pi * float(f[-1]))
            applied = level * float(chain.K[0, 0]) * wave(np.maximum(times - tau, 0.0))
            told = {"formula": "delay", "strength": strength}
        if cls == "sensor_gain":
            motion = motion * np.where(np.arange(motion.shape[1]) == place % motion.shape[1], 1 + strength, 1.0)
            told = {"formula": "gain", "strength": strength}
        dirty = motion + plan.noise * motion.std(axis=0) / max(level, 0.5) * np.stack(
            [sensor_noise(rng, count, plan.colour) for _ in range(motion.shape[1])], axis=1)
        out.append({"name": f"run_{i + 1}", "level": level, "kind": plan.kind, "start_s": 600.0 * i, "time": times, plan.key: dirty,
                    "force": applied + 1e-3 * applied.std() * rng.standard_normal(count)})
    return out, told


def _tuned(run: Any, plain: Array, wanted: float) -> tuple[float, float]:
    """Factor of a law at which it changes the response by the wanted share, and the share achieved."""
    a, best = 0.3 * wanted, (0.0, 0.0)
    for _ in range(7):
        try:
            y = run(a)
            got = float(np.sqrt(np.mean((y - plain) ** 2) / np.mean(y ** 2)))
        except ArithmeticError:
            a *= 0.3
            continue
        if abs(np.log(max(got, 1e-9) / wanted)) < abs(np.log(max(best[1], 1e-9) / wanted)):
            best = a, got
        if abs(got / wanted - 1) < 0.15:
            break
        a *= float(np.clip((wanted / max(got, 1e-9)) ** 0.9, 0.15, 6.0))
    return best


def _meta(name: str, plan: Plan, n: int) -> dict[str, Any]:
    return {"case": name, "fs_hz": plan.rate, "units": "SI", "nominal_damping_ratio": 0.02,
            "records": [{"name": f"run_{i + 1}", "level": level, "kind": plan.kind, "start_s": 600.0 * i, "sealed": False}
                        for i, level in enumerate(plan.levels)],
            "tolerances": {"E_rel_sd": 0.04, "rho_rel_sd": 0.01, "joint_stiffness_log_sd": 0.1, "damping_rel_sd": 0.25},
            "locations": {"joints": [f"J{i + 1}" for i in range(n)], "sensors": [f"S{i + 1}" for i in range(len(plan.sensors))]}}


def _nominal(rng: np.random.Generator, chain: Chain, plan: Plan) -> dict[str, Array]:
    """The model as delivered: masses, springs and damping wrong within their tolerances."""
    n = len(chain.M)
    M = chain.M * float(np.exp(0.01 * rng.standard_normal()))
    root = np.linalg.inv(chain.springs)
    k = np.diag(root.T @ chain.K @ root) * np.exp(0.04 * rng.standard_normal(n))
    return {"M": M, "K": chain.springs.T @ np.diag(k) @ chain.springs, "C": chain.C * float(np.exp(0.25 * rng.standard_normal())),
            "sensor_select": np.eye(n)[list(plan.sensors)], "shaker_vector": np.eye(n)[plan.shaker],
            "location_names": np.array([f"J{i + 1}" for i in range(n)]), "location_vectors": chain.springs}


def generate(cases: int, seed: int, out: Path, answers: Path, first: int = 0) -> None:
    """Write all cases; what cannot be integrated is left out."""
    answers.mkdir(parents=True, exist_ok=True)
    for number in range(first, first + cases):
        try:
            meta, nominal, records, answer = make(seed, number)
        except ArithmeticError as error:
            print(f"case {number}: {error}")
            continue
        folder = out / f"case_{number:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "case.json").write_text(json.dumps(meta, indent=1) + "\n")
        np.savez(folder / "nominal.npz", **nominal)  # type: ignore[arg-type]
        for r in records:
            np.savez_compressed(folder / f"{r['name']}.npz", **{k: v for k, v in r.items() if isinstance(v, np.ndarray)})
        (answers / f"case_{number:03d}.json").write_text(json.dumps(answer) + "\n")
