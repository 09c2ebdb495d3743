"""Every figure that the numbers of a diagnosis allow, with its caption, under the section of the report it belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayes_nlsid.mismatch.diagnosis import Diagnosis
from bayes_nlsid.study.sketch import Sketch

Pictures = dict[str, tuple[bytes, str]]
SECTIONS = {"where": ("where", "distortion", "errors"),
            "what": ("hypotheses", "latent_force", "latent_force_2", "free_force", "attached", "measuring_chain", "measuring_chain_2",
                     "drift", "clipping", "quiet"),
            "proof": ("before_after", "transfer_function")}
"""Names of figures by section, in reading order."""


def pictures(found: Diagnosis, sketch: Sketch | None = None) -> Pictures:
    """PNG and caption by name."""
    return _where(found, sketch) | _what(found) | _proof(found)


def _where(found: Diagnosis, sketch: Sketch | None) -> Pictures:
    from bayes_nlsid.study import figures_diagnosis as draw
    from bayes_nlsid.study.figures import png

    f, out = found.figures, {}
    locations = found.where.get("locations", [])
    if locations and found.verdict != "none":
        names, shares = np.asarray(f.get("place_names", np.zeros(0, dtype=str))), np.asarray(f.get("place_share", np.zeros(0)))
        places = [(str(x["name"]), float(x["probability"])) for i, x in enumerate(locations) if i < 3 or x["probability"] > 0.005]
        image = png(draw.where, places, locations[0].get("indistinguishable_from", []), names.tolist(), shares, sketch,
                    *([str(f["place_share_by"])] if "place_share_by" in f else []))
        disc = "Places on the structure, the area of a disc being the probability that something is missing there. "
        out["where"] = (image, (disc if sketch else "") + "Bars: all places of the hypotheses. Grey, where there is something that is not "
                        "linear: how much of what no linear model explains a force at each place takes away; a fault of the measuring "
                        "chain or of mass does not show there.")
    if "record_before" in f:
        caption = ("What no linear system can explain, whichever it is. Dots: root mean square over channels and records of the response "
                   "on lines without force, and of what is left of it on lines with force; odd and even lines tell even from odd "
                   "nonlinearity. Below: "
                   "the same by record, over what noise leaves there, in the order of the test day.")
        out["distortion"] = (png(draw.distortion, f), caption)
    if "error_frequency" in f:
        from bayes_nlsid.study.figures_effects import error_map

        out["errors"] = (png(error_map, f), f"Errors on {f['error_record']}, which was not used, channel {f['error_channel']}: by "
                                            "frequency, and for every stretch against time and against how loud it is.")
    return out


def _what(found: Diagnosis) -> Pictures:
    from bayes_nlsid.study import figures_diagnosis as draw
    from bayes_nlsid.study import figures_effects as effects
    from bayes_nlsid.study.figures import png

    f: Mapping[str, Any] = found.figures
    out: Pictures = {}
    if "hypothesis_names" in f:
        image = png(draw.hypotheses, f["hypothesis_names"].tolist(), f["hypothesis_probability"])
        out["hypotheses"] = (image, "Probability of every explanation that was weighed.")
    onset = float(found.where.get("amplitude", {}).get("onset", 0.0)) if found.where else 0.0
    withdrawn = " It did not help on the records that were not used and was withdrawn." if found.heldout.get("withdrawn") else ""
    for i, name in enumerate(("latent_force", "latent_force_2")):
        law = {k.removeprefix(f"law_{i}_"): v for k, v in f.items() if k.startswith(f"law_{i}_")}
        if law:
            out[name] = (png(effects.force_law, law, onset if i == 0 else 0.0), _about_law(law, str(f["law_record"])) + withdrawn)
    latents = [{"place": str(f["place_names"][i]), **{k: f[f"latent_{i}_{k}"] for k in ("force", "displacement", "velocity")}}
               for i in range(3) if f"latent_{i}_force" in f]
    if latents:
        out["free_force"] = (png(effects.latent_forces, latents), "The force that would explain the mismatch at the likeliest places, "
                             "recovered without assuming a law; what a linear model explains is taken off. A bend of the medians against "
                             "displacement is a spring, against velocity a damper; flat medians mean memory, another place, or no force "
                             "at all.")
    for i, name in enumerate(("measuring_chain", "measuring_chain_2")):
        if f"chain_{i}_ratio" in f:
            image = png(effects.measuring_chain, *(f[f"chain_{i}_{k}"] for k in ("frequency", "ratio", "effect", "sd")),
                        str(f[f"chain_{i}_class"]), str(f[f"chain_{i}_place"]))
            out[name] = (image, "Measured over modelled transfer function of the faulty channel (bars: 90 %). Left: the fault is left out "
                                "of the model; a delay turns the phase in proportion to frequency, a wrong gain shifts the size. Right: "
                                "were the fault all that is missing, size would be 1 and phase 0 within the errors.")
    return out | _disturbances(f)


def _about_law(law: Mapping[str, Any], record: str) -> str:
    kind = {"velocity": "velocity", "memory": "the history of displacement (loops)"}.get(str(law["phase"]), "displacement")
    said = ("The estimated law (red, with the 90 % band of its parameters)" if "curve" in law else
            "The estimated law along the loudest cycles (blue), its spring at rest included,")
    return (f"{said} at {law['place']} in {record}, the loudest record that was fitted: a force that follows {kind}. Grey: the force of "
            "the law plus the force that the record still asks for there; were the law right and the sensors without noise, the grey "
            "points would lie on it. What is left stands below by itself, on the same scale.")


def _disturbances(f: Mapping[str, Any]) -> Pictures:
    from bayes_nlsid.study import figures_effects as effects
    from bayes_nlsid.study.figures import png

    out: Pictures = {}
    if "attached_law" in f:
        image = png(effects.attached, *(f[f"attached_{k}"] for k in ("frequency", "stiffness", "sd", "law")),
                    *(str(f[f"attached_{k}"]) for k in ("class", "place", "unit")))
        out["attached"] = (image, "Force over displacement at the place that the recordings ask for and the rest of the model has not, "
                           "line by line without assuming a law, and the effect as estimated. A mass is a parabola that opens "
                           "downwards, a spring a constant, a resonator changes sign at its resonance, a relaxing branch stiffens and "
                           "loses. The bars are noise alone: what the rest of the model has wrong scatters beyond them.")
    if "drift_value" in f:
        image = png(effects.drift, f["drift_start"], f["drift_value"], f["drift_error"], str(f["drift_place"]), str(f["drift_unit"]))
        out["drift"] = (image, "Stiffness that each record asks for, less the mean of the day: a drift creeps, jumps or settles with time, "
                               "whatever the level of the record.")
    if "clip_level" in f:
        image = png(effects.clipping, f["clip_time"], f["clip_measured"], f["clip_model"], float(f["clip_level"]), str(f["clip_channel"]))
        out["clipping"] = (image, f"Channel {f['clip_channel']} where it should be loudest in {f['clip_record']}.")
    if "quiet_own" in f:
        mains = float(f["quiet_mains"]) if str(f["quiet_class"]) == "mains_hum" else 0.0
        image = png(effects.quiet, f["quiet_frequency"], f["quiet_own"], f.get("quiet_others"), str(f["quiet_place"]), mains)
        out["quiet"] = (image, f"Spectrum of {f['quiet_record']}, the shaker off: what is there does not come from the shaker.")
    return out


def _proof(found: Diagnosis) -> Pictures:
    from bayes_nlsid.study import figures_diagnosis as draw
    from bayes_nlsid.study.figures import png

    f: Mapping[str, Any] = found.figures
    out: Pictures = {}
    waves = {k: np.asarray(f[f"heldout_{k}"], dtype=float) for k in ("measured", "nominal", "updated", "extended") if f"heldout_{k}" in f}
    channels, units = (np.asarray(f.get(f"heldout_{key}", [])).tolist() for key in ("channels", "units"))
    if found.verdict == "none" or np.array_equal(waves.get("extended", np.zeros(0)), waves.get("updated", np.ones(0))):
        waves.pop("extended", None)   # nothing was added
    if "measured" in waves:
        facts = ", ".join(f"{words} {100 * found.heldout[key]:.3g} %" for words, key, name in (
            ("as delivered", "nrmse_nominal", "nominal"), ("re-tuned", "nrmse_updated_linear", "updated"),
            ("with what was found", "nrmse_extended", "extended")) if found.heldout.get(key) is not None and name in waves)
        half = np.asarray(f["heldout_half"], dtype=float) if "heldout_half" in f else None
        image = png(draw.before_after, f["heldout_time"], waves, _of_record(f) + facts, channels, units, half)
        out["before_after"] = (image, "A record that was not used, in the channel that what was found changes most (the loudest, if "
                                      "nothing was added). Every error has a scale of its own, said above it. The band is to hold 90 % of "
                                      "the samples of the measurement.")
    if "frf_measured" in f:
        numbers = dict(f)
        if "extended" not in waves:
            numbers.pop("frf_extended", None)
        image = png(draw.transfer_functions, numbers, channels)
        out["transfer_function"] = (image, "Measured transfer function of one channel over all fitted records, and the models; below, what "
                                           "each leaves against the error of the measurement (noise, and what is not linear).")
    return out


def _of_record(figures: Mapping[str, Any]) -> str:
    """Which record is drawn, if that is stored."""
    return f"in {figures['heldout_name']}. Error over all records not used: " if "heldout_name" in figures else ""
