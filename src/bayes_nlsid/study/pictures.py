"""From stored stages to pictures with captions: nothing is computed here that is not stored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from bayes_nlsid.study.axes import engineering, floor_text, percent
from bayes_nlsid.study.progress import Progress
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.store import Saved

CAPTION_BAND = "Bands hold 90 % of the posterior (5–95 %)."


@final
@dataclass(frozen=True)
class Picture:
    """One figure of the report: file name without ending, section, caption, source, and the PNG."""

    name: str
    section: str
    caption: str
    source: str
    png: bytes


def draw_all(study: Study, done: Mapping[str, Saved], progress: Progress | None = None) -> list[Picture]:
    """Every picture that the finished stages allow, in the order of the report."""
    from bayes_nlsid.study.pictures_extras import response_curves, scatter

    makers: list[tuple[str, Callable[[Study, Mapping[str, Saved]], list[Picture]]]] = [
        ("read", _recordings), ("linear", _linear), ("identify", _selection), ("posterior", _posterior), ("predict", _backbone),
        ("predict", _loops), ("predict", _heldout), ("frf", response_curves), ("montecarlo", scatter)]
    out: list[Picture] = []
    for i, (stage, maker) in enumerate(makers):
        if progress is not None:
            progress(i / len(makers), "drawing")
        if stage in done:
            out += maker(study, done)
    return out


def _recordings(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import png, recording_overview

    saved = done["read"]
    modes = [row["measured_hz"] for row in done["linear"].data["modes"]] if "linear" in done else []
    band = tuple(done["identify"].data["band_hz"]) if "identify" in done else None
    out = []
    for k, view in enumerate(saved.data["views"]):
        signals = np.asarray(saved.arrays[f"view{k}.signals"], dtype=float)
        time = view["step"] * np.arange(len(signals))
        psd = np.asarray(saved.arrays[f"{view['noise']}.noise_psd"], dtype=float)
        full = np.full((len(psd), signals.shape[1]), np.nan)
        full[:, :psd.shape[1]] = psd
        whole = len(view["windows"]) == 1 and view["windows"][0]["span"][1] >= time[-1]
        windows = [] if whole else [(w["name"], *w["span"]) for w in view["windows"]]
        image = png(recording_overview, time, signals, view["labels"], view["units"], windows=windows, band=band, modes=modes,
                    noise=(np.asarray(saved.arrays[f"{view['noise']}.noise_frequency"]), full))
        roles = "; ".join(f"{w['name']}: {w['role']}" for w in view["windows"])
        caption = (f"What was measured ({roles}): every channel against time, and its amplitude spectrum with the noise floor, the band "
                   "used and the modes found.")
        out.append(Picture(f"recording_{k + 1}", "recordings", caption, "stages/read", image))
    return out


def _linear(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import linear_model, png

    saved = done["linear"]
    rows = saved.data["modes"]
    if not rows:
        return []
    stated = np.array([np.nan if r["stated_hz"] is None else r["stated_hz"] for r in rows])
    shapes = None
    if study.structure.kind == "beam":
        positions = dict(study.structure.parameters.get("sensors", ()))
        places = saved.data.get("shape_locations", [])
        if places and all(p in positions for p in places) and "line" in saved.arrays:
            x = np.array([positions[p] for p in places])
            along, line = saved.arrays["line_position"], saved.arrays["line"]
            shapes = {"position": x, "measured": saved.arrays["measured_shapes"], "line_position": along, "line": line,
                      "at_sensors": np.stack([np.interp(x, along, column) for column in line.T], axis=1)}
    image = png(linear_model, {"frequency": np.array([r["measured_hz"] for r in rows]), "zeta": np.array([r["zeta"] for r in rows]),
                               "frequency_sd": np.array([r["measured_sd"] for r in rows]), "number": np.array([r["number"] for r in rows]),
                               "zeta_sd": np.array([r["zeta_sd"] for r in rows], dtype=float)},
                {"frequency": np.array([r["model_hz"] for r in rows])}, np.asarray(saved.arrays["mac"], dtype=float), shapes=shapes,
                before=stated)
    caption = ("The linear model against the modes measured at low level: frequency error before and after updating, measured damping, "
               "modal assurance criterion at the sensors" + (", and mode shapes." if shapes else "."))
    return [Picture("linear_model", "linear", caption, "stages/linear", image)]


def _selection(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import png
    from bayes_nlsid.study.figures_inference import selection_path

    out = []
    for v, record in enumerate(done["identify"].data["variants"]):
        if "path" not in record:
            continue
        rounds = {(s["round"], s["action"]): i for i, s in enumerate([s for s in record["path"] if s["accepted"]])}
        steps = [{"phase": "forward" if s["action"] == "add" else "backward", "name": s["element"].split("[")[0], "mse": s["mse"]}
                 for s in record["path"] if s["accepted"]]
        tried = [{"step": rounds.get((t["round"], t["action"]), len(steps)), "name": t["element"].split("[")[0], "mse": t["mse"]}
                 for t in record["tried"] if np.isfinite(t["mse"])]
        tried = [t for t in tried if t["step"] < max(1, len(steps))]
        image = png(selection_path, steps, tried, floor=record["floor"], linear=record["mse_linear"])
        title = "" if v == 0 else f" (alternative “{record['name']}”)"
        caption = (f"Forward–backward selection{title}: the score after each accepted step, every candidate tried for it, and the ranking "
                   "of the first step. The dashed line is what sensor noise alone would leave.")
        out.append(Picture(f"selection_{v + 1}", "selection", caption, "stages/identify", image))
    return out


def worst_first(saved: Saved) -> list[int]:
    """Parameters ordered by how little the data narrowed them (posterior over prior width)."""
    return [int(i) for i in np.argsort(-np.asarray(saved.arrays["narrowing"], dtype=float), kind="stable")]


def _posterior(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import png
    from bayes_nlsid.study.figures_inference import convergence, posterior_marginals, posterior_pairs

    saved = done["posterior"]
    theta = np.asarray(saved.arrays["theta"], dtype=float)
    names, units = saved.data["names"], saved.data["units"]
    if not names:
        return []
    flat = theta.reshape(-1, theta.shape[-1])
    flat = flat[np.linspace(0, len(flat) - 1, min(len(flat), 20_000)).astype(int)]
    fit, prior = np.asarray(done["identify"].arrays["0.theta"], dtype=float), saved.arrays.get("prior_draws")
    order = worst_first(saved)
    first = png(posterior_marginals, flat, names, units, prior=prior, fit=fit, identifiable=saved.data["identifiable"])
    caption = ("Every parameter: posterior, prior (dashed), least-squares value and 90 % interval. Where the posterior follows the prior, "
               "the recordings say nothing.")
    out = [Picture("posterior", "posterior", caption, "stages/posterior", first)]
    if len(names) > 1:
        second = png(posterior_pairs, flat, names, units, worst=order, fit=fit)
        caption = "The parameters that the recordings narrow least, pairwise (+ marks least squares)."
        out.append(Picture("posterior_pairs", "posterior", caption, "stages/posterior", second))
    third = png(convergence, np.asarray(saved.arrays["log_prob"], dtype=float), theta, names, units,
                kept_from=int(saved.data.get("burn_in", 0)), worst=order)
    out.append(Picture("convergence", "posterior", "Convergence of the sampler: independent ensembles must lie on top of each other.",
                       "stages/posterior", third))
    return out


def _backbone(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import png
    from bayes_nlsid.study.figures_prediction import backbone_bands, compared

    saved = done["predict"]
    arrays, data = saved.arrays, saved.data
    if "amplitude" not in arrays or not np.isfinite(arrays["frequency_q50"]).any():
        return []
    measured = {k: arrays[f"measured.{k}"] for k in ("amplitude", "frequency", "damping")} if "measured.amplitude" in arrays else None
    rivals = [{"name": name, **{k: arrays[f"alt{i}.{k}"] for k in ("amplitude", "frequency", "damping")}}
              for i, name in enumerate(data.get("alternatives", []))]
    published = [{"label": p.label, "frequency": p.frequency, "damping": p.damping} for p in study.report.published]
    image = png(backbone_bands, arrays, measured, location=data["at"], alternatives=rivals, published=published,
                numerical=arrays.get("numerical_error_frequency"))
    circles = " Circles are read directly from the recording by zero crossings, without any model." if measured is not None else ""
    start = compared(arrays, measured)[0]
    below = (f" The model's curve goes on below what was measured, down to {engineering(float(arrays['amplitude'][0]), 'm')}, in "
             "backbone.npz.") if arrays["amplitude"][0] < 0.8 * start else ""
    caption = f"Backbone of mode {data['mode']}: frequency and damping against amplitude. {CAPTION_BAND}{circles}{below}"
    return [Picture("backbone", "prediction", caption, "stages/predict, backbone.npz", image)]


def _loops(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import png
    from bayes_nlsid.study.figures_prediction import joint_loops

    saved = done["predict"]
    loops = [{**entry, "q": saved.arrays[f"loop{i}.q"], "force": saved.arrays[f"loop{i}.force"]}
             for i, entry in enumerate(saved.data.get("loops", []))]
    moved = [loop for loop in loops if np.any(loop["force"])]
    if not moved:
        return []
    left_out = idle(saved)
    rest = f" Left out, because the force is zero over this whole motion: {'; '.join(left_out)}." if left_out else ""
    caption = ("Force of every joint beyond the linear model over one steady cycle at the amplitude of the largest recorded motion; thin "
               f"lines are single posterior draws.{rest}")
    return [Picture("joint_loops", "prediction", caption, "stages/predict", png(joint_loops, moved))]


def idle(saved: Saved) -> list[str]:
    """Force laws and places whose force is zero over the whole recorded motion in every draw: ``jenkins at J2_slip, J3_slip``."""
    found: dict[str, list[str]] = {}
    for i, entry in enumerate(saved.data.get("loops", [])):
        if not np.any(saved.arrays[f"loop{i}.force"]):
            found.setdefault(entry["term"], []).append(entry["location"])
    return [f"{term} at {', '.join(where)}" for term, where in found.items()]


def _heldout(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    from bayes_nlsid.study.figures import png
    from bayes_nlsid.study.figures_prediction import heldout_overlay

    saved = done["predict"]
    out = []
    for i, entry in enumerate(saved.data.get("heldout", [])):
        arrays = {k: np.asarray(saved.arrays[f"held{i}.{k}"], dtype=float) for k in ("time", "measured", "q05", "q50", "q95")}
        if not np.isfinite(arrays["q50"]).all():
            continue
        c = int(np.argmax(arrays["measured"].std(axis=0)))
        facts = f"NRMSE {percent(entry['nrmse'])}, noise floor {floor_text(entry)}"
        if entry.get("coverage90") is not None:
            facts += f", coverage of the 90 % band {100 * entry['coverage90']:.0f} %"
        shown = {name: arrays[name][:, c] for name in ("measured", "q05", "q50", "q95")}
        image = png(heldout_overlay, arrays["time"], *shown.values(), unit=entry["units"][c], zoom=entry["zoom"], facts=facts,
                    channel=f"{entry['record']}, {entry['channels'][c]}", noise=entry["noise_rms"][c])
        caption = (f"Record “{entry['record']}”, not used for fitting: simulated forward from its start, strongest channel. "
                   f"{CAPTION_BAND}")
        out.append(Picture(f"heldout_{i + 1}", "prediction", caption, "stages/predict", image))
    return out
