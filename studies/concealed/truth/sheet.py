"""The answer sheet: what was hidden, how far it stands out, which places look alike, what the best linear model reaches."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from ..retune import Retuned, retune
from . import answers, catalogue
from .campaign import BURST, FS, OFF, PERIOD, PERIODS, STEADY, Entry
from .case import Made

Records = dict[str, tuple[np.ndarray, np.ndarray]]


def line_noise(made: Made, entry: Entry) -> np.ndarray:
    """Variance (k, s) of a record's lines, from the noise model's own colour: one draw, averaged over neighbours."""
    n = made.clean[entry.name][0].size
    noise, _ = made.noise.add(np.zeros((n, made.bench.sensors)), np.zeros(n), 10_000)
    power = np.abs(answers.spectrum(noise, entry)) ** 2
    kernel = np.ones(31) / 31
    return np.maximum(np.array([np.convolve(np.pad(p, 15, mode="edge"), kernel, "valid") for p in power.T]).T, 1e-30)


def measured_frf(made: Made, data: Records) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency responses from the open records of ``data``: ``hz`` (f,), ``H`` (f, s), ``variance`` (f, s)."""
    entries = [e for e in made.campaign.entries if not e.sealed and e.kind == (BURST if made.order.burst_only else STEADY)]
    hz = made.campaign.lines / PERIOD
    top = power = noise = 0.0
    for e in entries:
        force, accel = data[e.name]
        F, Y = answers.spectrum(force, e), answers.spectrum(accel, e)
        step = FS / (force.size / (PERIODS if e.kind == STEADY else 1))
        pick = np.round(hz / step).astype(int)
        v = line_noise(made, e)[pick]
        # Lines weigh by their signal to noise, which is the same noise in all records of one kind.
        top = top + F[pick, None].conj() * Y[pick]
        power = power + np.abs(F[pick, None]) ** 2
        noise = noise + np.abs(F[pick, None]) ** 2 * v
    H = top / power
    # Force noise acts like a share of the response.
    relative = (made.noise.force / made.campaign.rms) ** 2 / 30.0
    return hz, H, noise / power**2 + relative * np.abs(H) ** 2


def fitted(made: Made, data: Records) -> Retuned:
    """Best linear re-tuning of the nominal model on the open records of ``data``."""
    hz, H, variance = measured_frf(made, data)
    a = made.nominal
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
    return retune(nominal, asdict(made.scenery.tolerances), made.scenery.damping_ratio, hz, H, variance, dict(made.scenery.factors))


def predictions(made: Made, fit: Retuned, sealed: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Errors of a linear fit on the sealed records; its predictions are added to ``sealed``."""
    out = {}
    for e in made.campaign.entries:
        if e.sealed:
            force, accel = (x.astype(np.float32).astype(float) for x in made.noisy[e.name])
            guess = fit.predict(force, FS, PERIODS if e.kind == STEADY else 0)
            sealed[f"{e.name}_linear"] = guess.astype(np.float32)
            size = float(np.sqrt(np.mean(accel**2)))
            out[e.name] = {
                "nrmse_linear": float(np.sqrt(np.mean((guess - accel) ** 2))) / size,
                "noise_floor": float(np.sqrt(np.mean((made.clean[e.name][1] - accel) ** 2))) / size,
            }
    return out


def reach(made: Made, fit: Retuned, plain: Retuned) -> dict[str, float | bool]:
    """How far the effect stands out of noise, tolerances and the nominal model's own form error.

    ``chi2_change`` is the whole change of the measured channels, ``chi2_not_lti`` what no linear system absorbs, ``chi2_retuning`` how
    much worse (priors included) the best re-tuning ``fit`` is than the one of the same structure without the effect (``plain``).
    The latter counts in units of the form error that the engineer cannot know.  An effect is inside the tolerances when neither
    reaches ``answers.PROVABLE``.
    """
    variance = {e.name: line_noise(made, e) for e in made.campaign.entries if not e.sealed and e.kind != OFF}
    share, left = answers.change_not_lti(made.clean, made.campaign, variance)
    total = 0.0
    for e in made.campaign.entries:
        if e.name in variance:
            change = answers.spectrum(made.clean[e.name][1] - made.baseline[e.name][1], e)
            total += float(np.sum(np.abs(change) ** 2 / variance[e.name]))
    form = max(1.0, plain.misfit**2)
    beyond = (fit.cost - plain.cost) / form
    inside = bool(made.effects) and left < answers.PROVABLE and beyond < answers.PROVABLE
    return {
        "change_not_lti": share,
        "chi2_change": total,
        "chi2_not_lti": left,
        "chi2_retuning": beyond,
        "form_error_over_noise": plain.misfit,
        "inside_tolerances": inside,
    }


def answer(made: Made, sealed: dict[str, np.ndarray]) -> dict[str, Any]:
    """The answer sheet of a case; the linear predictions of the sealed records are added to ``sealed``."""
    fit = fitted(made, made.noisy)
    plain = fit
    if made.effects:
        entries = enumerate(made.campaign.entries)
        plain = fitted(made, {e.name: made.noise.add(made.baseline[e.name][1], made.baseline[e.name][0], i)[::-1] for i, e in entries})
    far = reach(made, fit, plain)
    energy = float(far["chi2_not_lti"]) + max(0.0, float(far["chi2_retuning"]))
    names = [*made.nominal.joint_names, *(f"P{i + 1}" for i in range(made.bench.sensors)), "SHAKER"]
    sigma = made.noise.sigma
    nominal_change = {e.name: made.clean[e.name][1] - made.baseline[e.name][1] for e in made.campaign.entries}
    reference = [e.name for e in made.campaign.entries if e.level == 1.0 and not e.sealed]
    ratio = [np.sqrt(np.mean(nominal_change[n] ** 2) / np.mean(made.baseline[n][1] ** 2)) for n in reference]
    alike = {e.loc: answers.equivalent_places(made.bench.plant, e.loc, names, made.bench, sigma, energy) for e in made.effects}
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
        **far,
        "equivalent_locations": alike,
        "true_factors": made.scenery.factors,
        "best_linear": {"misfit_over_noise": fit.misfit, "records": predictions(made, fit, sealed)},
        "support": made.scenery.nominal.support,
        "theories": {"truth": asdict(made.scenery.truth_mesh), "nominal": asdict(made.scenery.nominal_mesh)},
    }
