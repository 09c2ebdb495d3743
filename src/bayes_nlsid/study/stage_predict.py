"""Stage ``predict``: the backbone with its band, joint loops, and records kept for judging."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.model import Model
from bayes_nlsid.prediction.bands import Bands, backbone_bands
from bayes_nlsid.prediction.heldout import heldout
from bayes_nlsid.recordings.decay import measured_backbone
from bayes_nlsid.recordings.kinematics import kinematics
from bayes_nlsid.recordings.recording import SI_UNIT, Recording
from bayes_nlsid.study.context import Arrays, Context, Result
from bayes_nlsid.study.schema import PredictionEntry
from bayes_nlsid.study.stage_identify import band_of, observed, stored_model
from bayes_nlsid.study.stage_read import refuse_driven

LOOP_SAMPLES = 200
COARSE = 0.25
"""Share of the width of the band from which the integrator's error is told."""
AROUND = (0.5, 1.6)
"""Band of the backbone of a mode, relative to its frequency, where the study states none."""
Array = NDArray[np.float64]


def predict(context: Context) -> Result:
    """Simulate what the study asks for, for draws of the posterior or, without one, for the fit alone.

    Returns
    -------
    arrays, data
        The backbone arrays of the results folder; ``measured.*`` the backbone read from a recording; ``alt<k>.*`` that of each
        alternative's fit; ``loop<i>.q`` (n,), ``loop<i>.force`` (S, n); ``held<i>.time``, ``.measured``, ``.q05``, ``.q50``, ``.q95``.
    """
    entry = context.study.prediction
    assert entry is not None
    model, theta = stored_model(context)
    draws = posterior_draws(context, theta, max(entry.samples, entry.draws))
    arrays: Arrays = {}
    data: dict[str, Any] = {"at": entry.at, "mode": entry.mode, "notes": [], "alternatives": [], "loops": [], "heldout": []}
    context.progress(0.02, "backbone")
    bands = _bands(context, entry, model, draws[:entry.samples])
    arrays |= _band_arrays(bands)
    if entry.measured is not None:
        arrays |= _measured(context, entry)
    _alternatives(context, entry, bands.amplitude, arrays, data)
    context.progress(0.6, "joint forces")
    _loops(context, model, draws[:min(len(draws), 60)], arrays, data)
    context.progress(0.7, "records kept for judging")
    _heldout(context, entry, model, draws[:entry.draws], arrays, data)
    failed = {name: count for name, count in bands.status.items() if name != "ok"}
    data["status"] = "ok" if not failed else "backbone samples: " + ", ".join(f"{count} {name}" for name, count in failed.items())
    data["all_failed"] = bool(failed) and not bands.status.get("ok", 0)
    data["backbone"] = _summary(arrays)
    data["notes"] += _coarse(bands, entry.scheme)
    return arrays, data


def _coarse(bands: Bands, scheme: str) -> list[str]:
    """That the integrator's own error is not small against the band it draws; nothing where it is, or where there is no band."""
    width = bands.frequency[2] - bands.frequency[0]
    seen = np.isfinite(width) & np.isfinite(bands.numerical_error_frequency)
    if len(bands.samples_frequency) < 2 or not seen.any():
        return []
    error, wide = float(np.abs(bands.numerical_error_frequency[seen]).max()), float(np.median(width[seen]))
    if error <= COARSE * wide:
        return []
    mend = 'scheme = "exponential" or a higher fs' if scheme == "hht" else "a higher fs"
    return [f"the integrator's own error, up to {error:.1g} Hz, is not small against the band of the frequency, {wide:.1g} Hz wide: write "
            f"{mend} under [prediction]"]


def posterior_draws(context: Context, theta: Array, count: int, stage: str = "predict") -> Array:
    """Draws of theta (S, P): spread over the stored chains, or the fit once."""
    if "posterior" not in context.done:
        return theta[None]
    chains = np.asarray(context.done["posterior"].arrays["theta"], dtype=float)
    flat = chains.reshape(-1, chains.shape[-1])
    rng = np.random.default_rng(context.random(stage))
    return flat[rng.choice(len(flat), size=min(count, len(flat)), replace=False)]


def _bands(context: Context, entry: PredictionEntry, model: Model, draws: Array) -> Bands:
    band = _mode_band(context, entry) if model.linear.modes > 1 else entry.band
    try:
        return backbone_bands(draws, model, at=entry.at, start_amplitude=entry.amplitude, mode=entry.mode - 1,
                              amplitudes=entry.amplitudes or None, fs=entry.fs, scheme=entry.scheme, duration=entry.seconds,
                              band=band, seed=context.number("backbone"), progress=lambda sentence: context.progress(0.1, sentence))
    except ValueError as error:
        raise InputError(f"{context.study.file.name}: [prediction]", str(error), "change at, amplitude, mode or fs") from None


def _mode_band(context: Context, entry: PredictionEntry) -> tuple[float, float]:
    """The stated band, or one about the mode that reaches no farther than half-way (in ratios) to its neighbours."""
    if entry.band is not None:
        return entry.band
    f = context.model.frequency
    k = min(entry.mode - 1, len(f) - 1)
    low = max(AROUND[0] * f[k], np.sqrt(f[k] * f[k - 1]) if k else 0.0)
    high = min(AROUND[1] * f[k], np.sqrt(f[k] * f[k + 1]) if k + 1 < len(f) else np.inf)
    return float(low), float(high)


def _band_arrays(bands: Bands) -> Arrays:
    out: Arrays = {"amplitude": bands.amplitude, "samples_frequency": bands.samples_frequency, "samples_damping": bands.samples_damping,
                   "numerical_error_frequency": bands.numerical_error_frequency, "numerical_error_damping": bands.numerical_error_damping}
    for name, rows in (("frequency", bands.frequency), ("damping", bands.damping)):
        out |= {f"{name}_{level}": row for level, row in zip(("q05", "q50", "q95"), rows, strict=True)}
    return out


def _displacement(context: Context, recording: Recording, at: str) -> tuple[Array, Array]:
    """Time and displacement at a location that carries a sensor, band-passed around the identified modes."""
    where = [c.location for c in recording.channels]
    if at not in where:
        raise InputError(f"{context.study.file.name}: [prediction] measured", f"recording {recording.name!r} has no channel at {at!r}",
                         f"choose at among {', '.join(where)}")
    moved = kinematics(recording, band_of(context, context.model))
    part = moved.valid
    return recording.time[part], moved.displacement[part, where.index(at)]


def _measured(context: Context, entry: PredictionEntry) -> Arrays:
    """The backbone read directly from a recorded decay."""
    assert entry.measured is not None
    refuse_driven(context, context.recordings[entry.measured])
    time, displacement = _displacement(context, context.recordings[entry.measured], entry.at)
    found = measured_backbone(time, displacement, _mode_band(context, entry), location=entry.at)
    if found.status != "ok":
        context.note(f"backbone measured from {entry.measured}: {found.status}")
    keep = np.isfinite(found.frequency) & np.isfinite(found.damping)
    return {"measured.amplitude": found.amplitude[keep], "measured.frequency": found.frequency[keep],
            "measured.damping": found.damping[keep]}


def _alternatives(context: Context, entry: PredictionEntry, amplitude: Array, arrays: Arrays, data: dict[str, Any]) -> None:
    """The backbone of every rival's fit, on the amplitudes of the main one."""
    for k, record in enumerate(context.done["identify"].data["variants"][1:]):
        context.progress(0.4, f"backbone of {record['name']}")
        model, theta = stored_model(context, k + 1)
        bands = _bands(context, entry, model, theta[None])
        i = len(data["alternatives"])
        data["alternatives"].append(record["name"])
        arrays |= {f"alt{i}.amplitude": bands.amplitude, f"alt{i}.frequency": bands.frequency[1], f"alt{i}.damping": bands.damping[1]}


def _loops(context: Context, model: Model, draws: Array, arrays: Arrays, data: dict[str, Any]) -> None:
    """Force over one steady cycle at the largest recorded relative motion, after a first cycle that memory needs to settle."""
    recorded = observed(context)
    frequency = model.linear.frequency[recorded[0].modes[0]]
    phase = np.linspace(0, 4 * np.pi, 2 * LOOP_SAMPLES, endpoint=False)
    for e, element in enumerate(model.elements):
        for location in element.locations:
            size = max(float(np.abs(d.q[d.valid, d.locations.index(location)]).max()) for d in recorded)
            path = motion(size * np.sin(phase), size * 2 * np.pi * frequency * np.cos(phase), 1 / (LOOP_SAMPLES * frequency))
            force = force_along(element.term, path, model.element_values(draws, e, location), excess=element.excess)
            i = len(data["loops"])
            data["loops"].append({"location": location, "term": element.term.name, "amplitude": size})
            arrays |= {f"loop{i}.q": path.q[-LOOP_SAMPLES - 1:], f"loop{i}.force": force[:, -LOOP_SAMPLES - 1:]}  # ends where it began


def _heldout(context: Context, entry: PredictionEntry, model: Model, draws: Array, arrays: Arrays, data: dict[str, Any]) -> None:
    for i, name in enumerate(entry.heldout):
        recording = context.recordings[name]
        context.progress(0.7 + 0.3 * i / len(entry.heldout), f"predicting {name}")
        common: dict[str, Any] = {"band": band_of(context, context.model) if entry.score == "band" else None,
                                  "noise": context.noise(recording), "tolerance": entry.tolerance}
        judged = heldout(model, draws, recording, seed=context.number(f"heldout {name}"), **common)
        linear = heldout(Model(context.model), np.zeros((1, 0)), recording, **common)
        arrays |= {f"held{i}.time": judged.time, f"held{i}.measured": judged.measured, f"held{i}.q05": judged.q05,
                   f"held{i}.q50": judged.q50,
                   f"held{i}.q95": judged.q95}
        period = 1 / context.model.frequency[entry.mode - 1]
        units = [SI_UNIT[c.quantity] for c in recording.channels]
        coverage = judged.coverage90 if "posterior" in context.done else None  # a fit alone has no band
        data["heldout"].append({
            "record": name, "nrmse": judged.nrmse, "nrmse_linear": linear.nrmse, "noise_floor": judged.noise_floor,
            "noise_sure": common["noise"].sure, "coverage90": coverage, "rmse": judged.rmse,
            "channels": [c.name for c in recording.channels], "units": units,
            "unit": units[0], "noise_rms": judged.noise_rms.tolist(), "zoom": float(6 * period)})


def _summary(arrays: Arrays) -> dict[str, Any]:
    """Ends of the backbone, and how much of the measured one lies inside the band."""
    ok = np.isfinite(arrays["frequency_q50"]) & np.isfinite(arrays["damping_q50"])
    if not ok.any():
        return {}
    a = arrays["amplitude"]
    first, last = int(np.flatnonzero(ok)[0]), int(np.flatnonzero(ok)[-1])
    out: dict[str, Any] = {"amplitude_m": [a[first], a[last]],
                           "frequency_hz": [arrays["frequency_q50"][first], arrays["frequency_q50"][last]],
                           "damping": [arrays["damping_q50"][first], arrays["damping_q50"][last]],
                           "numerical_error_hz": float(np.nanmax(np.abs(arrays["numerical_error_frequency"])))}
    if "measured.amplitude" in arrays and len(arrays["measured.amplitude"]):
        x = arrays["measured.amplitude"]
        common = (x >= a[first]) & (x <= a[last])
        for name in ("frequency", "damping"):
            low, high = (np.interp(x[common], a[ok], arrays[f"{name}_{q}"][ok]) for q in ("q05", "q95"))
            middle = np.interp(x[common], a[ok], arrays[f"{name}_q50"][ok])
            values = arrays[f"measured.{name}"][common]
            out[f"inside_{name}"] = float(np.mean((values >= low) & (values <= high))) if common.any() else None
            out[f"largest_miss_{name}"] = float(np.abs(values - middle).max()) if common.any() else None
    return out
