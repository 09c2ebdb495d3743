"""``nlsid plan``: a plan of tests on disk: ``plan.json``, ``plan.html`` and its figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.prediction.planning import DECADE, LEARNED, ROUGHLY, MeasurementPlan, plan_test
from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.axes import brief_names, engineering
from bayes_nlsid.study.building import build_element, build_structure, library, reduce_structure
from bayes_nlsid.study.lock import held
from bayes_nlsid.study.schema import ElementEntry, PlanEntry, Study
from bayes_nlsid.study.store import make_folder, versions, write_atomic, writing

SENSORS = 12  # rows of tables
EXCITATIONS = 12


def run_plan(study: Study, out: Path, *, seed: int | None = None, progress: Callable[[float, str], None] | None = None) -> dict[str, Any]:
    """Compute and write a plan.

    Parameters
    ----------
    study : Study
        With a table ``[plan]``; recordings are not needed.
    out : Path

    Returns
    -------
    dict
        What ``plan.json`` holds.

    Raises
    ------
    InputError
        If ``[plan]`` is missing or cannot be carried out, or the folder cannot be written.
    """
    entry = study.plan
    if entry is None:
        raise InputError(f"{study.file.name}: [plan]", "is missing",
                         "add [plan] with sensors, inputs, band, levels, noise and [[plan.joints]]")
    number = study.seed if seed is None else seed
    figures = make_folder(out, "figures")
    with writing(out), held(figures / "lock"):
        found = _compute(study, entry, number, progress)
        said = record(found, study.title, number)
        write_atomic(out / "plan.json", (json.dumps(said, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())
        pictures = _pictures(found, said)
        for name, (image, _) in pictures.items():
            write_atomic(figures / f"{name}.png", image)
        write_atomic(out / "plan.html", _page(said, pictures, entry, dict(study.inputs)).encode())
    return said


def _compute(study: Study, entry: PlanEntry, seed: int, progress: Callable[[float, str], None] | None) -> MeasurementPlan:
    linear = reduce_structure(build_structure(study.structure), study.reduction, study.file)
    stated = study.linear.damping[:linear.modes]
    if stated:
        linear = replace(linear, zeta=np.concatenate([stated, linear.zeta[len(stated):]]))
    terms = library(study.terms)
    elements = [build_element(ElementEntry(j.term, j.locations, j.tied, j.excess), terms) for j in entry.joints]
    values = [v for j, e in zip(entry.joints, elements, strict=True) for _ in e.groups for _, v in j.values]
    try:
        return plan_test(linear, elements, values, sensors=entry.sensors, inputs=entry.inputs, band=entry.band, levels=entry.levels,
                         noise=entry.noise, seconds=entry.seconds, quantity=entry.quantity, seed=seed, progress=progress)
    except ValueError as error:
        raise InputError(f"{study.file.name}: [plan]", str(error), "correct these entries") from None


def record(found: MeasurementPlan, title: str, seed: int) -> dict[str, Any]:
    """The plan as plain values: excitations ranked, sensors for the best of them, what stays unknown."""
    ranked = found.ranked()
    good = [row for row in ranked if row[0].status == "ok"]
    best = good[0][0] if good else None
    names = found.joint_names
    everything = found.sd(sum((e.information.sum(axis=0) for e in found.excitations), np.zeros((len(found.names),) * 2)))
    excitations = [{"input": e.input, "level_n": e.level, "status": e.status, "gain_nats": gain,
                    "sd_log": dict(zip(names, map(float, sd), strict=True)),
                    "motion": {p: (float(m) if np.isfinite(m) else None) for p, m in zip(found.places, e.motion, strict=True)}}
                   for e, gain, sd in ranked]
    return {
        "format": 1, "title": title, "seed": seed, "versions": versions(),
        "parameters": [{"name": n, "unit": u, "assumed": float(v), "sd_log_at_best": float(s), "word": _word(s)}
                       for n, u, v, s in zip(names, found.units[found.linear:], found.values[found.linear:], everything, strict=True)],
        "excitations": excitations,
        "sensors": [] if best is None else [{"name": n, "gain_nats": g} for n, g in found.sensors_for(best)],
        "cannot_be_learned": [{"remaining_share_of_prior": share, "combination": dict(parts)} for share, parts in found.unlearnable()]}


def _word(sd: float) -> str:
    return "learned" if sd <= LEARNED else "roughly" if sd <= ROUGHLY else "not learned"


def sentences(said: Mapping[str, Any]) -> list[str]:
    """The plan in words."""
    good = [e for e in said["excitations"] if e["status"] == "ok"]
    if not good:
        return ["Every excitation made the simulation diverge: lower the levels, or correct the assumed values."]
    best, sensors = good[0], said["sensors"]
    enough = next((i + 1 for i, s in enumerate(sensors) if s["gain_nats"] >= 0.9 * sensors[-1]["gain_nats"]), len(sensors))
    out = [f"Excite at {best['input']} with {best['level_n']:g} N rms; of the sensors, {', '.join(s['name'] for s in sensors[:enough])} "
           f"{'gives' if enough == 1 else 'give'} nine tenths of what all {len(sensors)} give."]
    for word, verb in (("learned", "can be learned to within 10 %"), ("roughly", "can be learned roughly (within half its value)"),
                       ("not learned", "cannot be learned by any of these tests")):
        names = brief_names([p["name"] for p in said["parameters"] if p["word"] == word])
        out += [f"{', '.join(names)} {verb}."] if names else []
    for entry in said["cannot_be_learned"]:
        parts = entry["combination"]
        if len(parts) > 1:
            up, down = ([n for n, w in parts.items() if (w > 0) is sign] for sign in (True, False))
            way = f"{', '.join(up)} larger" + (f" with {', '.join(down)} smaller" if down else "")
            out.append(f"Whatever is measured, one combination stays open: {way} changes nothing that these sensors see.")
    weakest = next((e for e in reversed(sorted(good, key=lambda e: float(e["level_n"]))) if e["gain_nats"] < 0.5 * best["gain_nats"]), None)
    if weakest is not None:
        out.append(f"{weakest['level_n']:g} N at {weakest['input']} teaches less than half as much.")
    return out


def _pictures(found: MeasurementPlan, said: Mapping[str, Any]) -> dict[str, tuple[bytes, str]]:
    from bayes_nlsid.study import figures_planning as draw
    from bayes_nlsid.study.figures import png

    out: dict[str, tuple[bytes, str]] = {}
    good = [e for e in said["excitations"] if e["status"] == "ok"]
    if not good:
        return out
    same = sorted((e for e in good if e["input"] == good[0]["input"]), key=lambda e: float(e["level_n"]))
    names = found.joint_names
    if len(same) > 1:
        image = png(draw.learning, np.array([e["level_n"] for e in same]), np.array([[e["sd_log"][n] for n in names] for e in same]),
                    brief_names(names), (LEARNED, ROUGHLY, DECADE))
        out["plan_levels"] = (image, f"How well each parameter is known after one record at {good[0]['input']} with all sensors, "
                                     "against the level. At the upper dashed line nothing is learned.")
    if said["sensors"]:
        first = said["sensors"][:SENSORS]
        image = png(draw.sensors, [s["name"] for s in first], [s["gain_nats"] for s in first])
        out["plan_sensors"] = (image, "Sensors in the order in which each adds most, under the best excitation.")
    return out


def _page(said: Mapping[str, Any], pictures: Mapping[str, tuple[bytes, str]], entry: PlanEntry, inputs: Mapping[str, str]) -> str:
    """The plan on one page."""
    told = "".join(html.paragraph(s) for s in sentences(said))
    rows = [[p["name"], engineering(p["assumed"], p["unit"], 3), f"{p['sd_log_at_best']:.2g}", p["word"]] for p in said["parameters"]]
    body = [f'<p class="soft">bayes_nlsid {escape(str(said["versions"]["bayes_nlsid"]))}, seed {said["seed"]}</p>',
            f"<h1>{escape(said['title'])}: plan of tests</h1>", f'<div class="story">{told}</div>',
            "<section><h2>Parameters</h2>",
            html.table(["parameter", "assumed", "sd of ln p after all tests", ""], rows, "plan.json, parameters", numeric=(1, 2)),
            "</section>"]
    body += [html.picture(image, caption, f"plan.json; figures/{name}.png", caption.split(",")[0])
             for name, (image, caption) in pictures.items()]
    rows = [[e["input"], f"{e['level_n']:g}", f"{e['gain_nats']:.3g}", "; ".join(f"{n} {engineering(m, 'm', 3) if m is not None else '–'}"
                                                                               for n, m in e["motion"].items()), e["status"]]
            for e in said["excitations"][:EXCITATIONS]]
    body += ["<section><h2>Excitations, the best first</h2>",
             html.table(["at", "rms (N)", "information (nats)", "largest motion of the joints", ""], rows, "plan.json, excitations",
                        numeric=(1, 2)), "</section>"]
    facts = [f"Multisine from {entry.band[0]:g} to {entry.band[1]:g} Hz, records of {entry.seconds:g} s, noise {entry.noise:.3g} (SI, rms "
             f"in the band) of every {entry.quantity} sensor.",
             "Local to the assumed values: if they are far off, plan again with better ones.",
             "Joint parameters were given a prior of one decade, frequencies 5 %, damping 50 %."]
    body += ["<section><h2>What this rests on</h2>", html.listing(facts),
             html.table(["input file", "SHA-256"], [[n, h] for n, h in inputs.items()], "the study file", hashes=(1,)), "</section>"]
    return html.page(f"{said['title']}: plan of tests", "\n".join(body))
