"""A small truth of its own for tests: lapped Timoshenko-free beams in transverse and axial motion, stepped in time with numba.

Nothing here comes from the package: own matrices, own laws (applied sample by sample at 16 times the recording rate on modal
coordinates with an exact linear propagator), own noise. The nominal model is made from the same elements with wrong numbers.
"""

from __future__ import annotations

import json
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]
RATE, PERIOD, BAND = 2048.0, 2.0, (20.0, 800.0)
FINER = 8


def beam(length: float, height: float, width: float, E: float, rho: float, count: int) -> tuple[Array, Array]:
    """Stiffness and mass (3 per node: axial u, transverse w, rotation) of a straight beam."""
    h, area, inertia = length / count, width * height, width * height ** 3 / 12
    k = np.zeros((6, 6))
    m = np.zeros((6, 6))
    ax, tr = [0, 3], [1, 2, 4, 5]
    k[np.ix_(ax, ax)] = E * area / h * np.array([[1, -1], [-1, 1]])
    m[np.ix_(ax, ax)] = rho * area * h / 6 * np.array([[2, 1], [1, 2]])
    k[np.ix_(tr, tr)] = E * inertia / h ** 3 * np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
                                                   [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]])
    m[np.ix_(tr, tr)] = rho * area * h / 420 * np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h],
                                                      [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]])
    K, M = np.zeros((3 * count + 3,) * 2), np.zeros((3 * count + 3,) * 2)
    for i in range(count):
        s = slice(3 * i, 3 * i + 6)
        K[s, s] += k
        M[s, s] += m
    return K, M


def structure(rng: np.random.Generator, sensors: int, elements: int = 14) -> dict:
    """Parts, directions and names of a two-beam structure with three lap bolts."""
    LA, LB, lap = rng.uniform(0.42, 0.55), rng.uniform(0.42, 0.55), 0.16
    hA, hB, width = rng.uniform(0.0065, 0.0085), rng.uniform(0.0065, 0.0085), 0.05
    nA = nB = elements
    KA, MA = beam(LA, hA, width, 205e9, 7850.0, nA)
    KB, MB = beam(LB, hB, width, 205e9, 7850.0, nB)
    n = len(KA) + len(KB)

    def place(matrix: Array, first: int) -> Array:
        out = np.zeros((n, n))
        out[first:first + len(matrix), first:first + len(matrix)] = matrix
        return out

    def row(x: float, which: str, beam_: str) -> Array:
        """Linear interpolation of axial or transverse motion or rotation at x of the assembly."""
        out = np.zeros(n)
        L, count, first, start = (LA, nA, 0, 0.0) if beam_ == "A" else (LB, nB, len(KA), LA - lap)
        position = np.clip((x - start) / L * count, 0, count - 1e-9)
        i, r = int(position), position % 1
        dof = {"u": 0, "w": 1, "t": 2}[which]
        out[first + 3 * i + dof], out[first + 3 * i + 3 + dof] = 1 - r, r
        return out

    vectors, parts = {}, {"E_A": place(KA, 0), "E_B": place(KB, len(KA))}
    for j, x in enumerate(np.linspace(LA - lap + 0.02, LA - 0.02, 3)):
        half = (hA + hB) / 2
        slip = row(x, "u", "B") - row(x, "u", "A") + hB / 2 * row(x, "t", "B") + hA / 2 * row(x, "t", "A")
        opening = row(x, "w", "B") - row(x, "w", "A")
        vectors[f"J{j + 1}_slip"], vectors[f"J{j + 1}_open"] = slip, opening
        parts[f"J{j + 1}_slip"] = rng.uniform(0.8, 1.5) * 4e6 * np.outer(slip, slip)
        parts[f"J{j + 1}_open"] = rng.uniform(0.8, 1.5) * 2e7 * (half / half) * np.outer(opening, opening)
    total = LA + LB - lap
    vectors["ROOT_rot"] = row(0.0, "t", "A")
    parts["ROOT_rot"] = 8e3 * np.outer(vectors["ROOT_rot"], vectors["ROOT_rot"])
    vectors["TIP_w"] = row(total, "w", "B")
    parts["TIP_w"] = 8e4 * np.outer(vectors["TIP_w"], vectors["TIP_w"])
    u, w = row(0.0, "u", "A"), row(0.0, "w", "A")
    parts["root_fix"] = 5e8 * (np.outer(u, u) + np.outer(w, w))
    at = np.linspace(0.05, total - 0.08, sensors)
    rows = np.array([row(x, "w", "A" if x < LA - lap / 2 else "B") for x in at])
    base = np.zeros(n)
    base[1::3] = 1.0
    return {"K_parts": parts, "M_parts": {"rho_A": place(MA, 0), "rho_B": place(MB, len(KA))}, "vectors": vectors, "rows": rows,
            "shaker": row(0.3 * LA + 0.06, "w", "A"), "base": base}


@numba.njit(cache=True)
def march(P: Array, Q: Array, force: Array, middle: Array, shaker: Array, b: Array, c: Array, w2: Array, law: int, p: Array, limits: Array,
          trend: Array, keep: int) -> Array:
    """Modal accelerations (n/keep, m) from rest, one local force along b.

    Every mode has its exact propagator over a fine step with the force of the middle of the step (``middle``); the local force there is
    extrapolated from the last two steps.
    """
    m, n = len(shaker), len(force)
    x = np.zeros((2, m))
    slider = np.zeros(len(limits))
    out = np.empty((n // keep, m))
    last_d, last_g = 0.0, 0.0
    for k in range(n):
        d, v = 0.0, 0.0
        for i in range(m):
            d += b[i] * x[0, i]
            v += b[i] * x[1, i]
        g = 0.0
        if law == 1:
            g = p[0] * np.sign(d) * (abs(d) / p[1]) ** p[2]
        elif law == 2:
            g = -p[0] * d * abs(d) / p[1] / (1 + abs(d) / p[1])
        elif law == 3:
            g = p[0] * np.sign(d) * max(abs(d) - p[1], 0.0)
        elif law == 4:
            g = p[0] * max(d - p[1], 0.0)
        elif law == 5:
            g = p[0] * np.tanh(v / p[1])
        elif law == 6:
            g = p[0] * np.sign(v) * (abs(v) / p[1]) ** p[2]
        elif law == 7:
            for j in range(len(slider)):
                s = min(max(slider[j] + d - last_d, -limits[j]), limits[j])
                slider[j] = s
                g += p[0] / len(slider) * (s - d)
        elif law == 8:
            g = trend[k] * d
        elif law == 9:
            # relaxing branch: force follows stretch and decays with p[1] seconds
            g = last_g * np.exp(-p[2] / p[1]) + p[0] * (d - last_d)
        elif law == 10:
            g = p[0] * np.sin(d / p[1])
        ahead = 1.5 * g - 0.5 * last_g
        if k % keep == 0:
            for i in range(m):
                out[k // keep, i] = shaker[i] * force[k] - b[i] * g - c[i] * x[1, i] - w2[i] * x[0, i]
        for i in range(m):
            f = shaker[i] * middle[k] - b[i] * ahead
            x0 = P[0, i] * x[0, i] + P[1, i] * x[1, i] + Q[0, i] * f
            x1 = P[2, i] * x[0, i] + P[3, i] * x[1, i] + Q[1, i] * f
            x[0, i], x[1, i] = x0, x1
        last_d, last_g = d, g
    return out


def propagators(omega: Array, zeta: Array, h: float) -> tuple[Array, Array]:
    """Exact step of ẍ + 2ζωẋ + ω²x = f with f constant over the step."""
    P, Q = np.empty((4, len(omega))), np.empty((2, len(omega)))
    for i, (w, z) in enumerate(zip(omega, zeta, strict=True)):
        A = np.array([[0, 1, 0], [-w * w, -2 * z * w, 1], [0, 0, 0]])
        E = linalg.expm(A * h)
        P[:, i], Q[:, i] = E[:2, :2].ravel(), E[:2, 2]
    return P, Q


def refine(signal: Array, shift: float) -> Array:
    """Band-limited samples at FINER times the rate, advanced by ``shift`` fine steps (the signal is taken as periodic)."""
    n = len(signal)
    F = np.fft.rfft(signal)
    F = F * np.exp(2j * np.pi * np.arange(len(F)) * shift / (n * FINER))
    full = np.zeros(n * FINER // 2 + 1, dtype=complex)
    full[:len(F) - 1] = F[:-1]
    return np.fft.irfft(full * FINER, n * FINER)


LAWS = {"hardening": 1, "softening": 2, "clearance": 3, "asymmetric": 4, "coulomb": 5, "quad_damping": 6, "hysteresis": 7,
        "stiffness_drift": 8,
        "maxwell": 9, "cogging": 10}


def write_case(folder: Path, cls: str = "none", place: str = "-", strength: float = 0.1, seed: int = 0, noise: float = 0.005,
               sensors: int = 8, tolerance: float = 0.12, one_level: bool = False, bursts_only: bool = False) -> dict:
    """Write a case folder with one hidden effect; returns the truth (with the noise-free sealed responses).

    ``strength`` is the relative change of the high-level response that the effect is tuned to (roughly).
    """
    rng = np.random.default_rng(seed)
    body = structure(rng, sensors)
    true = {k: v * _factor(rng, k, tolerance) for k, v in body["K_parts"].items()}
    K, M = sum(true.values()), sum(v * np.exp(0.006 * rng.normal()) for v in body["M_parts"].values())
    nominal_K, nominal_M = sum(body["K_parts"].values()), sum(body["M_parts"].values())
    lines = [k for k in range(41, 1600, 2) if rng.random() < 0.75]
    plant = {"K": K, "M": M, "rows": body["rows"].copy(), "shaker": body["shaker"], "zeta": 0.007 * np.exp(0.15 * rng.normal(size=400)),
             "vectors": body["vectors"], "errors": rng.normal(size=(sensors, 400)) * 0.003}
    chain = _linear_effects(plant, cls, place, strength, body, K, rng)
    records, waves = _campaign(rng, lines, one_level, bursts_only)
    modes = _modes(plant)
    law, p, limits = _tune(plant, modes, cls, place, strength, waves, records)
    folder.mkdir(parents=True, exist_ok=True)
    truth: dict = {"cls": cls, "place": place}
    scale = None
    start = [r["start_s"] for r in records]
    for r in sorted(records, key=lambda r: -r["level"]):
        f = waves[r["name"]]
        clean, reading = _run(plant, modes, r, f, law, p, limits, place, (r["start_s"] - np.mean(start)) / np.ptp(start))
        clean = chain["sensors"](clean)
        scale = noise * clean.std() if scale is None else scale
        measured = clean + scale * _coloured(rng, clean.shape)
        if cls == "sensor_drift":
            j = int(place[1:]) - 1
            measured[:, j] += strength * 200 * scale * np.cumsum(rng.normal(size=len(clean))) / np.sqrt(len(clean))
        if cls == "mains_hum":
            t = np.arange(len(clean)) / RATE
            measured += strength * 100 * scale * np.sin(2 * np.pi * 50 * t + rng.uniform(0, 6.28))[:, None]
        if cls == "clipping":
            j = int(place[1:]) - 1
            level = truth.setdefault("level", (1 - strength) * 2.6 * clean[:, j].std())
            measured[:, j] = np.clip(measured[:, j], -level, level)
        force = chain["force"](f)
        force = force + 2e-4 * f.std() * rng.normal(size=len(f))
        time = np.arange(len(f)) / RATE
        if r["sealed"]:
            np.savez(folder / f"{r['name']}_force.npz", time=time, force=force.astype(np.float32))
            truth[r["name"]] = clean
        else:
            np.savez(folder / f"{r['name']}.npz", time=time, force=force.astype(np.float32), accel=measured.astype(np.float32))
    quiet = scale * _coloured(rng, (4096, sensors))
    if cls == "mains_hum":
        quiet += strength * 100 * scale * np.sin(2 * np.pi * 50 * np.arange(4096) / RATE + 1.0)[:, None]
    np.savez(folder / "noise.npz", time=np.arange(4096) / RATE, force=np.zeros(4096), accel=quiet.astype(np.float32))
    records.append({"name": "noise", "level": 0.0, "kind": "shaker off", "start_s": 0.0, "sealed": False})
    np.savez(folder / "nominal.npz", M=nominal_M, K=nominal_K, K_parts=np.array(list(body["K_parts"].values())),
             K_part_names=np.array(list(body["K_parts"])), M_parts=np.array(list(body["M_parts"].values())),
             M_part_names=np.array(list(body["M_parts"])), sensor_select=body["rows"], shaker_vector=body["shaker"],
             base_vector=body["base"], location_names=np.array(list(body["vectors"])),
             location_vectors=np.array(list(body["vectors"].values())))
    (folder / "case.json").write_text(json.dumps({
        "case": folder.name, "fs_hz": RATE, "period_s": PERIOD, "band_hz": list(BAND), "excited_lines": lines, "line_spacing_hz": 0.5,
        "records": records, "nominal_damping_ratio": 0.007,
        "tolerances": {"E_rel_sd": 0.03, "rho_rel_sd": 0.008, "joint_stiffness_log_sd": tolerance, "root_fix_log_sd": 0.5,
                       "damping_rel_sd": 0.2},
        "locations": {"joints": list(body["vectors"]), "mass_points": [f"P{i + 1}" for i in range(sensors)] + ["SHAKER"],
                      "sensors": [f"S{i + 1}" for i in range(sensors)], "other": ["FORCE", "BASE", "ALL_SENSORS", "-"]}, "mains_hz": 50.0}))
    return truth


def _factor(rng: np.random.Generator, name: str, tolerance: float) -> float:
    return float(np.exp(rng.normal() * (0.02 if name.startswith("E") else 0.3 if name == "root_fix" else tolerance)))


def _modes(plant: dict) -> tuple[Array, Array]:
    values, shapes = linalg.eigh(plant["K"], plant["M"])
    keep = values < (2 * np.pi * 7000) ** 2
    return np.sqrt(values[keep]), shapes[:, keep]


def _linear_effects(plant: dict, cls: str, place: str, strength: float, body: dict, K: Array, rng: np.random.Generator) -> dict:
    """Put linear effects into the plant; returns what the measuring chain does."""
    points = {f"P{i + 1}": row for i, row in enumerate(body["rows"])} | {"SHAKER": body["shaker"]}
    sensors, force = (lambda y: y), (lambda f: f)
    mass = float(body["base"] @ plant["M"] @ body["base"])
    if cls == "added_mass":
        plant["M"] = plant["M"] + 0.12 * strength * mass * np.outer(points[place], points[place])
    elif cls == "unmodelled_mode":
        n, m = len(K), 0.06 * strength * mass
        row = np.append(points[place], -1.0)
        f = rng.uniform(80, 600)
        plant["M"] = linalg.block_diag(plant["M"], [[m]])
        plant["K"] = linalg.block_diag(plant["K"], [[0.0]]) + m * (2 * np.pi * f) ** 2 * np.outer(row, row)
        plant["rows"] = np.pad(plant["rows"], ((0, 0), (0, 1)))
        plant["shaker"] = np.append(plant["shaker"], 0.0)
        plant["vectors"] = {k: np.append(v, 0.0) for k, v in plant["vectors"].items()}
        assert len(plant["K"]) == n + 1
    elif cls == "linear_stiffness":
        own = body["K_parts"][place]
        plant["K"] = plant["K"] - own * (1 - np.exp(-8 * strength))
    elif cls == "sensor_gain":
        sensors = lambda y: y * np.where(np.arange(y.shape[1]) == int(place[1:]) - 1, 1 + 1.5 * strength, 1.0)  # noqa: E731
    elif cls == "sensor_delay":
        sensors = lambda y: _shifted(y, int(place[1:]) - 1, 2.5e-4 * strength)  # noqa: E731
    elif cls == "force_gain":
        force = lambda f: f * (1 + strength)  # noqa: E731
    elif cls == "force_delay":
        force = lambda f: _late(f, 2e-4 * strength)  # noqa: E731
    return {"sensors": sensors, "force": force}


def _late(f: Array, delay: float) -> Array:
    k = np.arange(len(f) // 2 + 1)
    return np.fft.irfft(np.fft.rfft(f) * np.exp(-2j * np.pi * k * RATE / len(f) * delay), len(f))


def _shifted(y: Array, channel: int, delay: float) -> Array:
    out = y.copy()
    out[:, channel] = _late(y[:, channel], delay)
    return out


def _campaign(rng: np.random.Generator, lines: list[int], one_level: bool, bursts_only: bool) -> tuple[list[dict], dict[str, Array]]:
    block = int(RATE * PERIOD)

    def multisine(level: float) -> Array:
        F = np.zeros(block // 2 + 1, dtype=complex)
        F[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
        f = np.fft.irfft(F, block)
        return np.tile(10 * level * f / f.std(), 3)

    def burst(level: float) -> Array:
        n = 20480
        F = np.fft.rfft(rng.normal(size=n))
        freq = np.arange(len(F)) * RATE / n
        F[(freq < BAND[0]) | (freq > BAND[1])] = 0
        f = np.fft.irfft(F, n)
        t = np.arange(n) / RATE
        return 10 * level * f / f.std() * np.clip(np.minimum(t / 0.2, (5.8 - t) / 0.3), 0, 1)

    levels = {"low_1": 0.1, "mid_1": 0.35, "high_1": 1.0, "high_2": 1.0, "mid_2": 0.35, "low_2": 0.1}
    records, waves = [], {}
    if not bursts_only:
        for i, (name, level) in enumerate(levels.items()):
            level = 1.0 if one_level else level
            records.append({"name": name, "level": level, "kind": "steady multisine, 3 periods", "start_s": 10.0 + 15 * i, "sealed": False})
            waves[name] = waves["low_1"] if name == "low_2" and not one_level else multisine(level)
    else:
        for i, level in enumerate((0.1, 0.3, 1.0, 1.0, 0.3)):
            records.append({"name": f"b{i + 1}", "level": level, "kind": "burst random from rest", "start_s": 10.0 + 15 * i,
                            "sealed": False})
            waves[f"b{i + 1}"] = burst(level)
    for name, level, sealed in (("burst_1", 1.0, False), ("sealed_ms", 1.0, True), ("sealed_burst", 1.15, True)):
        if name == "sealed_ms" and bursts_only:
            continue
        kind = "steady multisine, 3 periods" if name == "sealed_ms" else "burst random from rest"
        records.append({"name": name, "level": level, "kind": kind, "start_s": 100.0 + 15 * len(records), "sealed": sealed})
        waves[name] = multisine(level) if name == "sealed_ms" else burst(level)
    return records, waves


def _run(plant: dict, modes: tuple[Array, Array], record: dict, f: Array, law: int, p: Array, limits: Array, place: str, time: float
         ) -> tuple[Array, Array]:
    omega, shapes = modes
    m = len(omega)
    zeta = plant["zeta"][:m]
    P, Q = propagators(omega, zeta, 1 / (RATE * FINER))
    steady = "steady" in record["kind"]
    wave = f
    if steady:
        block = int(RATE * PERIOD)
        wave = np.concatenate([f[:block] * np.linspace(0, 1, block), np.tile(f[:block], 4), f])
    b = plant["vectors"][place] @ shapes if law else np.zeros(m)
    fine = refine(wave, 0.0) if not steady else refine(wave, 0.0)
    trend = np.full(len(fine), p[0] * time if law == 8 else 0.0)
    acc = march(P, Q, fine, refine(wave, 0.5), plant["shaker"] @ shapes, b, 2 * zeta * omega, omega ** 2, law, p, limits, trend, FINER)
    S = (plant["rows"] @ shapes) * (1 + plant["errors"][:, :m])
    out = acc @ S.T
    return out[-len(f):], out


def _tune(plant: dict, modes: tuple[Array, Array], cls: str, place: str, strength: float, waves: dict[str, Array], records: list[dict]
          ) -> tuple[int, Array, Array]:
    """Law parameters such that the response of the strongest record changes by about ``strength``."""
    law = LAWS.get(cls, 0)
    none = np.zeros(1)
    if law == 0:
        return 0, np.zeros(3), none
    omega, shapes = modes
    strong = max((r for r in records if not r["sealed"]), key=lambda r: (r["level"], "steady" in r["kind"]))
    f = waves[strong["name"]]
    reference, _ = _run(plant, modes, strong, f, 0, np.zeros(3), none, place, 1.0)
    n = len(f)
    s = 2j * np.pi * np.arange(n // 2 + 1) * RATE / n
    lift = plant["vectors"][place] @ shapes * (plant["shaker"] @ shapes)
    D = (lift / (s[:, None] ** 2 + 2 * 0.007 * omega * s[:, None] + omega ** 2)).sum(1)
    d = np.fft.irfft(D * np.fft.rfft(f), n)
    v = np.fft.irfft(s * D * np.fft.rfft(f), n)
    x, w = d.std(), v.std()
    stiff = 1 / float(plant["vectors"][place] @ np.linalg.solve(plant["K"], plant["vectors"][place]))
    limits = x * np.array([0.15, 0.4, 0.8, 1.3, 2.0, 3.0])
    base = {1: [stiff * x, x, 3.0], 2: [stiff, 1.5 * x, 0], 3: [stiff, 1.7 * x, 0], 4: [stiff, 0.3 * x, 0], 5: [stiff * x, 0.05 * w, 0],
            6: [stiff * x, w, 2.0], 7: [stiff, 0, 0], 8: [stiff, 0, 0], 9: [stiff, 8e-4, 1 / (RATE * FINER)],
            10: [stiff * x, 0.35 * x, 0]}[law]
    low, high = np.log(1e-5), np.log(3.0)
    p = np.array(base)
    for _ in range(11):
        middle = 0.5 * (low + high)
        p = np.array(base)
        p[0] *= np.exp(middle)
        trial, _ = _run(plant, modes, strong, f, law, p, limits, place, 0.5)
        change = np.linalg.norm(trial - reference) / np.linalg.norm(reference)
        low, high = (low, middle) if not np.isfinite(change) or change > strength else (middle, high)
    return law, p, limits


def _coloured(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    white = rng.normal(size=shape)
    F = np.fft.rfft(white, axis=0)
    f = np.maximum(np.arange(len(F)), 1) * RATE / shape[0]
    return np.fft.irfft(F * np.sqrt(1 + 4.0 / f)[:, None], shape[0], axis=0)
