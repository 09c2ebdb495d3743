"""The case folder an engineer would have, and the answer written elsewhere."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from . import catalogue
from .campaign import FS, PERIOD
from .case import Made
from .sheet import answer


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
    sheet = answer(made, sealed)
    np.savez(answer_folder / f"{made.name}_sealed.npz", **sealed)
    (answer_folder / f"{made.name}.json").write_text(json.dumps(sheet, indent=1))


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
