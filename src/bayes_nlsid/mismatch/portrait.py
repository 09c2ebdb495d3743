"""Numbers behind the figures of a diagnosed case: the law along the motion it was estimated on, what it leaves, the measuring chain.

What is left in the records is turned into a force at the place of a law and added to the force of the law: were the law right and the
sensors without noise, these points would lie on its curve. What a linear model absorbed of the law is in the curve and in the points alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import Chain, predict
from bayes_nlsid.mismatch.case import Case
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.diagnose import Analysis, Proof, Rival
from bayes_nlsid.mismatch.effects import Effect, along_period, pack, unpack
from bayes_nlsid.mismatch.explain import Latent
from bayes_nlsid.mismatch.linear import fields, receptances
from bayes_nlsid.mismatch.paths import bed
from bayes_nlsid.mismatch.polish import Hypothesis, simulate
from bayes_nlsid.mismatch.prove import Predictor, envelope
from bayes_nlsid.mismatch.shapes import accelerance, with_shape_errors
from bayes_nlsid.mismatch.spectra import local_mean, repeats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Numbers = dict[str, NDArray[Any]]
SHOWN = 6144         # samples of a record that was not used
SHIFT, GRID = 1e-4, 241
SEEN = 12.0          # standard deviations of noise alone from which there is something that is not linear
ATTACHED = ("added_mass", "unmodelled_mode", "other")
CHAINED = ("force_gain", "force_delay", "sensor_gain", "sensor_delay")
NOISY = 0.5          # relative error of a measured transfer function beyond which a line is not drawn


def portrait(analysis: Analysis, best: Rival | None, proof: Proof, predictor: Predictor) -> Numbers:
    """All numbers by the name of the figure they belong to.

    Parameters
    ----------
    best : the hypothesis that is reported; None where nothing is.
    predictor : the model that was finally used on records not fitted.
    """
    h = None if best is None else best.hypothesis
    out = {**_by_line(analysis, h), **_transfer(analysis, h), **_held(analysis, proof)}
    latents = sorted(analysis.found.latents, key=lambda x: -x.explained)
    evidence = analysis.evidence
    if evidence.chi2 - evidence.values < SEEN * np.sqrt(2 * evidence.values):
        latents = []   # shares of noise would say nothing
    out["place_names"], out["place_share"] = np.array([x.place for x in latents]), np.array([x.share for x in latents])
    if best is None:
        return out
    if h is not None:
        out |= _laws(analysis, h) | _drifts(h, max(analysis.scores.dispersion, 1.0)) | _chains(analysis, h) | _attached(analysis, h)
    out |= _clipped(analysis, best, h) | _quiet(analysis.case, best)
    if (h is None and not best.clip and not best.extra) or any(cls == "other" for cls, _ in best.key):
        out |= free_forces(latents, int(np.argmax(analysis.evidence.spectra.levels)))
    return out


def free_forces(latents: list[Latent], record: int) -> Numbers:
    """Law-free forces at the likeliest places, against the motion of the linear model there."""
    out: Numbers = {}
    for i, x in enumerate(latents[:3]):
        out[f"latent_{i}_force"], out[f"latent_{i}_displacement"] = x.force[record], x.displacement[record]
        out[f"latent_{i}_velocity"] = x.velocity[record]
    return out


def unexplained(analysis: Analysis, residual: Complex) -> Array:
    """Mean squared projected residual of each record (R,) on lines with force, over what noise leaves there; 1 where nothing is left."""
    evidence = analysis.evidence
    spectra, e = evidence.spectra, evidence.excited
    trust = evidence.trust[:, None, None]
    H = np.zeros(residual.shape[1:], dtype=complex)
    H[e] = evidence.H
    noise = (spectra.noise * trust).mean(0) + np.abs(H) ** 2 * (spectra.force_noise * evidence.trust[:, None]).mean(0)[:, None]
    ratio = np.abs(residual) ** 2 * trust / noise
    # a loud record draws the transfer function to itself and is left with less
    power = evidence.trust[:, None] * np.abs(spectra.force[:, e]) ** 2
    leverage = power / np.maximum(power.sum(0), 1e-300)
    return np.asarray(ratio[:, e].mean((1, 2)) / np.maximum(1 - leverage.mean(1), 1e-3))


def _by_line(analysis: Analysis, h: Hypothesis | None) -> Numbers:
    """What is not linear by record and by line, before and after."""
    evidence = analysis.evidence
    spectra = evidence.spectra
    out: Numbers = {"frequency": spectra.frequency, "line_number": spectra.lines, "line_excited": evidence.excited,
                    "record_names": np.array(spectra.names), "levels": spectra.levels, "starts": spectra.starts}
    strongest = int(np.argmax(spectra.levels))
    root = np.sqrt(2.0)   # from a two-sided line to its rms in time
    out["response_by_line"] = root * np.sqrt((np.abs(spectra.response[strongest]) ** 2).mean(1))
    out["residual_by_line"] = root * np.sqrt((np.abs(evidence.residual) ** 2).mean((0, 2)))
    out["noise_by_line"] = root * np.sqrt(spectra.noise.mean((0, 2)))
    out["record_before"] = unexplained(analysis, evidence.residual)
    if h is not None and h.forces:
        out["left_by_line"] = root * np.sqrt((np.abs(h.residual) ** 2).mean((0, 2)))
        out["record_after"] = unexplained(analysis, h.residual)
    return out


def _transfer(analysis: Analysis, h: Hypothesis | None) -> Numbers:
    """Transfer functions on excited lines: measured, as delivered, re-tuned, and with what was found."""
    evidence, fit, fam = analysis.evidence, analysis.fit, analysis.family
    e = evidence.excited
    out: Numbers = {"frf_frequency": evidence.spectra.frequency[e], "frf_measured": evidence.H, "frf_linear": fit.model,
                    "frf_error": np.sqrt(evidence.variance),
                    "frf_nominal": predict(fam, np.zeros(fam.size), fit.s, None, np.zeros(0))[0].H}
    if h is not None:
        # what a law makes of the mean transfer function was taken off the measurement before the linear model was fitted
        out["frf_extended"] = h.fit.model + (evidence.H - h.fit.measured)
    return out


def _held(analysis: Analysis, proof: Proof) -> Numbers:
    """The first record that was not used: its loudest stretch, and how the error follows amplitude and time."""
    case = analysis.case
    waves = {k: np.asarray(w, dtype=float) for k, w in proof.waves.items()}
    n = len(waves["measured"])
    loud = envelope(waves["measured"], case.rate).mean(1)
    first = int(np.clip(np.argmax(loud) - SHOWN // 3, 0, max(n - SHOWN, 0)))
    piece = slice(first, first + SHOWN)
    out: Numbers = {f"heldout_{k}": w[piece].astype(np.float32) for k, w in waves.items()}
    half = proof.bands.factor * proof.bands.sd(waves["extended"], case.rate)
    out["heldout_half"] = half[piece].astype(np.float32)
    out["heldout_time"] = np.arange(n)[piece] / case.rate
    out["heldout_channels"] = np.array(case.channels)
    out["heldout_units"] = np.array(["m/s^2"] * waves["measured"].shape[1])
    out["heldout_name"] = np.array(proof.records[0])
    return out


def _laws(analysis: Analysis, h: Hypothesis) -> Numbers:
    """Every force law along the motion of the loudest record, and the force that the records still ask for at its place."""
    if not h.forces:
        return {}
    fam, evidence = analysis.family, analysis.evidence
    spectra, channels = evidence.spectra, evidence.H.shape[1]
    modes, places = h.fit.fields.modes, [e.place for e in h.forces]
    rows = np.array([fam.places[p] for p in places])
    paths = bed(modes, spectra, rows, fam.shaker, lambda s: h.parts(channels)(s)[0])
    top = int(np.argmax(spectra.levels))
    moved = simulate(paths, spectra, h.forces, repeats(spectra), None).motions[top]
    d, v = paths.in_time(moved)
    attach, chain = h.parts(channels)(spectra.s)
    path = accelerance(fam, modes, spectra.s, rows, h.fit.shape_errors, attach)
    path = path if chain is None else np.moveaxis(chain.apply(np.moveaxis(path, 2, 0)), 0, 2)
    out: Numbers = {"law_record": np.array(spectra.names[top])}
    shown = 0
    for j, e in enumerate(h.forces):
        if e.law is None:
            continue
        # with its spring at rest, which the linear model carries: so a loop looks like one
        g = along_period(replace(e.law, excess=False), e.values, d[:, j], v[:, j], paths.dt, paths.periodic)
        lines = paths.to_lines(g[:, None])[spectra.lines, 0]
        left = left_force(analysis, h.residual[top], path[:, :, j], local_mean(np.abs(lines[:, None]) ** 2)[:, 0], top)
        key = f"law_{shown}"
        out |= {f"{key}_displacement": d[:, j], f"{key}_velocity": v[:, j], f"{key}_force": g, f"{key}_left": left,
                f"{key}_class": np.array(e.cls), f"{key}_place": np.array(e.place),
                f"{key}_unit": np.array("rad" if "rot" in e.place.lower() else "m"), f"{key}_phase": np.array(phase_of(e.cls))}
        if e.law.term.memory == "none":
            out |= {f"{key}_{k}": value for k, value in _curve(analysis, h, e, d[:, j], v[:, j]).items()}
        shown += 1
    return out


def phase_of(cls: str) -> str:
    """What a class follows: displacement, velocity, memory, ..."""
    return ROWS[cls].phase if cls in ROWS else "-"


def left_force(analysis: Analysis, residual: Complex, path: Complex, power: Array, record: int) -> Array:
    """Force (block,) at a place that would explain what is left of one record.

    Wiener's estimate: on lines where the sensors would not see a force of the size that the law has there it goes to zero (at low
    frequencies accelerometers say next to nothing of forces).

    Parameters
    ----------
    residual : (L, S). path : (L, S) accelerance from the place to the channels. power : (L,) of the law's force, N².
    record : its index.
    """
    evidence = analysis.evidence
    block = evidence.spectra.block
    weight = evidence.trust[record] * np.einsum("ls,ls->l", evidence.weight, np.abs(path) ** 2)
    z = evidence.trust[record] * np.einsum("ls,ls,ls->l", evidence.weight, path.conj(), residual)
    G = np.zeros(block // 2 + 1, dtype=complex)
    G[evidence.spectra.lines] = -z * power / (1 + weight * power)
    return np.asarray(np.fft.irfft(G * block, block))


def _curve(analysis: Analysis, h: Hypothesis, effect: Effect, d: Array, v: Array) -> Numbers:
    """The law over the range of its own coordinate, with the 90 % band that the parameters' errors make of it, to first order: the
    records pin down the force where the motion goes better than the parameters that make it up."""
    assert effect.law is not None
    follows = "velocity" if phase_of(effect.cls) == "velocity" else "displacement"
    own = v if follows == "velocity" else d
    grid = np.linspace(float(own.min()), float(own.max()), GRID)
    zero = np.zeros_like(grid)
    motion = (zero, grid) if follows == "velocity" else (grid, zero)
    edge = 0
    for e in h.forces:
        if e is effect:
            break
        edge += len(pack(e))
    x0 = pack(effect)
    block = np.linalg.pinv(h.curvature)[edge:edge + len(x0), edge:edge + len(x0)] * max(analysis.scores.dispersion, 1.0)
    with np.errstate(all="ignore"):
        middle = np.asarray(effect.law.term.static_force(*motion, effect.values))
        slopes = np.array([(effect.law.term.static_force(*motion, unpack(effect, x0 + SHIFT * e, effect).values)
                            - effect.law.term.static_force(*motion, unpack(effect, x0 - SHIFT * e, effect).values)) / (2 * SHIFT)
                           for e in np.eye(len(x0))])
    half = 1.645 * np.sqrt(np.maximum(np.einsum("ig,ij,jg->g", slopes, block, slopes), 0.0))
    return {"grid": grid, "curve": middle, "low": middle - half, "high": middle + half}


def _drifts(h: Hypothesis, dispersion: float) -> Numbers:
    """Stiffness by record of a drift, with standard errors."""
    out: Numbers = {}
    edge = 0
    for e in h.forces:
        size = len(pack(e))
        if e.law is None:
            unit = max(float(np.abs(e.values).max()), 1e-12)
            # the mean of the day is the linear model's: only deviations from it are told
            centre = np.eye(size) - 1 / size
            covariance = centre @ np.linalg.pinv(h.curvature)[edge:edge + size, edge:edge + size] @ centre * dispersion
            out |= {"drift_place": np.array(e.place), "drift_value": centre @ e.values, "drift_names": np.array(e.names),
                    "drift_start": np.array([_number(n) for n in e.names]), "drift_error": unit * np.sqrt(np.abs(np.diag(covariance))),
                    "drift_unit": np.array(e.units[0])}
        edge += size
    return out


def _number(name: str) -> float:
    """The time in ``at 25 s``."""
    return float(name.split()[1])


def _chains(analysis: Analysis, h: Hypothesis) -> Numbers:
    """For every fault of the measuring chain: measured over modelled transfer function with the fault taken out of the model."""
    fit, names = h.fit, analysis.case.channels
    count, kinds, edge, shown = len(names), list(h.kinds), 0, 0
    out: Numbers = {}
    for e in h.effects:
        if e.is_force or e.cls == "linear_stiffness":
            continue
        k = kinds.pop(0)
        x, edge = fit.x[edge:edge + len(k.start)], edge + len(k.start)
        if e.cls not in CHAINED or k.chain is None:
            continue
        bare = _without(fit.model, k.chain(x, fit.s, count))
        at = [names.index(e.place)] if e.place in names else list(range(count))
        power = (np.abs(bare[:, at]) ** 2 / fit.variance[:, at]).sum(1)
        ratio, effect = ((bare[:, at].conj() * H[:, at] / fit.variance[:, at]).sum(1) / power for H in (fit.measured, fit.model))
        seen = power > 1 / NOISY ** 2
        out |= {f"chain_{shown}_frequency": fit.s.imag[seen] / 2 / np.pi, f"chain_{shown}_ratio": ratio[seen],
                f"chain_{shown}_effect": effect[seen], f"chain_{shown}_sd": 1 / np.sqrt(2 * power[seen]),
                f"chain_{shown}_class": np.array(e.cls), f"chain_{shown}_place": np.array(e.place)}
        shown += 1
    return out


def _attached(analysis: Analysis, h: Hypothesis) -> Numbers:
    """Dynamic stiffness of what is attached at one place: as estimated, and line by line as the recordings ask for it without any law.

    With H₀ the model without it, h and r the paths from the place to the channels and to the place, r_F that from the shaker to the
    place: H = H₀ − h y r_F, y = z / (1 + z r).
    """
    fit, fam, modes = h.fit, analysis.family, h.fit.fields.modes
    attachments, chain = h.parts(fit.measured.shape[1])(fit.s)
    effect = next((e for e in h.effects if e.cls in ATTACHED), None)
    if len(attachments) != 1 or effect is None:
        return {}
    row = attachments[0].direction[None]
    bare = fields(fam, modes, fit.s)
    H0 = with_shape_errors(fam, bare, fit.s, fit.shape_errors)
    path = accelerance(fam, modes, fit.s, row, fit.shape_errors)[:, :, 0]
    if chain is not None:
        H0, path = chain.apply(H0), chain.apply(path)
    there = receptances(modes, fit.s, row, np.concatenate([row, fam.shaker[None]]))[:, 0]
    column = path * there[:, 1:]
    power = (np.abs(column) ** 2 / fit.variance).sum(1)
    y = -(column.conj() * (fit.measured - H0) / fit.variance).sum(1) / power
    turn = 1 - y * there[:, 0]
    return {"attached_frequency": fit.s.imag / 2 / np.pi, "attached_stiffness": y / turn,
            "attached_sd": 1 / np.sqrt(2 * power) / np.abs(turn) ** 2, "attached_law": np.asarray(attachments[0].z),
            "attached_class": np.array(effect.cls), "attached_place": np.array(effect.place),
            "attached_unit": np.array("N m/rad" if "rot" in effect.place.lower() else "N/m")}


def _without(model: Complex, chain: Chain) -> Complex:
    return np.asarray((model if chain.mix is None else model @ np.linalg.inv(chain.mix)) / chain.factor)


def _clipped(analysis: Analysis, best: Rival, h: Hypothesis | None) -> Numbers:
    """The clipped channel at its loudest, beside what the model without clipping has there."""
    case = analysis.case
    loud = [r for r in case.records if not r.sealed and r.kind != "off"]
    if not best.clip or not loud:
        return {}
    channel, level = best.clip[0]
    record = max(loud, key=lambda r: (r.level, r.kind == "steady"))
    fit = analysis.fit if h is None else h.fit
    wave, _ = Predictor(analysis.family, fit, h, int(case.usable.sum()), (), analysis.evidence.spectra).run(case, record)
    at = int(np.argmax(np.abs(wave[:, channel])))
    names = case.channels
    first = int(np.clip(at - 100, 0, max(len(wave) - 200, 0)))
    piece = slice(first, first + 200)
    return {"clip_time": record.time[piece], "clip_measured": record.accel[piece][:, case.usable][:, channel],
            "clip_model": wave[piece, channel], "clip_level": np.array(level), "clip_channel": np.array(names[channel]),
            "clip_record": np.array(record.name)}


def _quiet(case: Case, best: Rival) -> Numbers:
    """Spectrum with the shaker off of what hums, wanders or is shaken by the floor, beside the other channels."""
    places = [p for c, p in best.key if c in ("mains_hum", "sensor_drift", "base_motion")]
    offs = [r for r in case.records if r.kind == "off" and not r.sealed and len(r.accel)]
    if not places or not offs:
        return {}
    from scipy.signal import welch

    accel = offs[0].accel[:, case.usable]
    f, power = welch(accel, case.rate, nperseg=min(len(accel), int(case.rate)), axis=0, detrend="constant")
    names = case.channels
    own = [names.index(places[0])] if places[0] in names else list(range(len(names)))
    others = [i for i in range(len(names)) if i not in own]
    out: Numbers = {"quiet_frequency": f, "quiet_own": np.sqrt(power[:, own].mean(1)), "quiet_place": np.array(places[0]),
                    "quiet_mains": np.array(case.mains), "quiet_record": np.array(offs[0].name),
                    "quiet_class": np.array(next(c for c, p in best.key if p == places[0]))}
    return out | ({"quiet_others": np.sqrt(np.median(power[:, others], axis=1))} if others else {})


__all__ = ["Numbers", "free_forces", "left_force", "phase_of", "portrait", "unexplained"]
