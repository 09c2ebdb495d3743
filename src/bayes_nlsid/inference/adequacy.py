"""Is the model good enough for its intervals to mean anything? Three tests on the error of the simulated recordings.

Innovation: the error against sensor noise as measured, chi-square. Meter: the force that the model must call unmeasured, against sensor
noise as a force. Library: whether the error points along the response to any of a few forces that the model does not have (score test
with the parameters profiled out). A model that fails gives intervals that are conditional on being wrong.

Passing is no proof: a force that resembles what the parameters do anyway can move them by many standard deviations before it shows
in the error. How far is worked out for each library force (``Unseen``): intervals that allow for one such force are so many times
longer. They answer "what if the form is not quite right", the others "given the form".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.output_error import start_state
from bayes_nlsid.inference.covariance import Levels, Noise
from bayes_nlsid.inference.forward import ForwardLikelihood
from bayes_nlsid.inference.prior import Prior
from bayes_nlsid.inference.unmeasured import NUDGE, POWER, forced_modes
from bayes_nlsid.model import Model
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Channel
from bayes_nlsid.simulation.replay import predict_record

Array = NDArray[np.float64]
TAIL = 3.2905           # standard deviations of a 99.9 % interval
METER = 3.0             # log of unmeasured force over sensor noise
SCORE = 4.0             # standard deviations of a library force
SUSPICIOUS, LOOKED_AT = 1.5, 4    # from which on, and for how many, a score is worked out again with the noise that the force leaves
FORCES = {
    "dry friction": lambda q, v: np.tanh(20 * v), "quadratic damping": lambda q, v: v * np.abs(v), "cubic damping": lambda q, v: v**3,
    "friction that grows with displacement": lambda q, v: q**2 * v, "cubic stiffness": lambda q, v: q**3,
    "quadratic stiffness, odd": lambda q, v: q * np.abs(q), "quintic stiffness": lambda q, v: q**5,
    "quadratic stiffness, even": lambda q, v: q**2, "micro-slip": lambda q, v: np.sign(v) * np.sqrt(np.abs(v)),
}


@final
@dataclass(frozen=True)
class Unseen:
    """What a force that the tests would not see does to a parameter.

    Parameters
    ----------
    parameter : str
    widening : float
        Standard deviation when one library force of unknown strength is allowed, over that given the form; limited by the prior.
    force : str
        The one that widens most.
    """

    parameter: str
    widening: float
    force: str


@final
@dataclass(frozen=True)
class Adequacy:
    """Outcome of the tests.

    Parameters
    ----------
    misfit : bool
    reasons : tuple of str
        Why, in words; empty when adequate.
    innovation : float or None
        Variance of the error over that of the measured sensor noise; None without a measured floor.
    innovation_limit : float or None
        Upper end of its 99.9 % interval.
    meter : float
        log of the density of unmeasured force over that of sensor noise seen as modal force; about 0 or below when the model is right.
    scores : tuple of (str, float)
        Library forces with their scores, largest first.
    notes : tuple of str
        What else was seen, such as lines left out.
    unseen : tuple of Unseen
        One for each parameter; empty without the score test.
    """

    misfit: bool
    reasons: tuple[str, ...]
    innovation: float | None
    innovation_limit: float | None
    meter: float
    scores: tuple[tuple[str, float], ...] = field(repr=False)
    notes: tuple[str, ...] = ()
    unseen: tuple[Unseen, ...] = field(default=(), repr=False)

    def record(self) -> dict[str, Any]:
        """For ``result.json``."""
        return {"found": self.misfit, "reasons": list(self.reasons), "innovation": self.innovation,
                "innovation_limit": self.innovation_limit, "log_unmeasured_force": self.meter,
                "scores": [{"force": n, "z": z} for n, z in self.scores[:8]], "notes": list(self.notes),
                "unseen": [{"parameter": x.parameter, "widening": x.widening, "force": x.force} for x in self.unseen]}


def adequacy(likelihood: ForwardLikelihood, floors: Sequence[NoiseFloor | None] = (), *, library: bool = True,
             priors: Sequence[Prior] = ()) -> Adequacy:
    """Test a fitted likelihood.

    Parameters
    ----------
    likelihood : ForwardLikelihood
    floors : sequence of NoiseFloor or None
        As given to ``forward_likelihood``; only measured ones are a standard.
    library : bool
        Whether to make the score test, nine simulations for each joint and recording.
    priors : sequence of Prior
        Limit what an unseen force can do; flat where none are given.
    """
    reasons = []
    ratio, limit = _innovation(likelihood, floors)
    if ratio is not None and limit is not None and ratio > limit:
        reasons.append(f"the error of the simulation has {ratio:.3g} times the variance of the measured sensor noise "
                       f"(99.9 % limit {limit:.3g})")
    meter = _meter(likelihood)
    if meter > METER:
        reasons.append(f"the model must call unmeasured a force {np.exp(0.5 * meter):.2g} times as strong as sensor noise would feign: "
                       f"physics left out, or a real disturbance")
    columns = _responses(likelihood) if library else {}
    scores = _once_allowed(likelihood, columns, _scores(likelihood, likelihood.noise, columns))
    if scores and abs(scores[0][1]) > SCORE:
        rivals = [name for name, z in scores[1:] if abs(z) > 0.6 * abs(scores[0][1])]
        reasons.append(f"the error points along {scores[0][0]} (score {scores[0][1]:+.1f})"
                       + (f"; nearly as well along {', '.join(rivals[:3])}" if rivals else ""))
    unseen = _unseen(likelihood, columns, dict(scores), priors) if library else ()
    return Adequacy(bool(reasons), tuple(reasons), ratio, limit, meter, scores, likelihood.dropped, unseen)


def _innovation(likelihood: ForwardLikelihood, floors: Sequence[NoiseFloor | None]) -> tuple[float | None, float | None]:
    """Ratio over all channels with a measured floor, and its limit: the floor itself is known to a few per cent only."""
    noise, known = likelihood.noise, [f for f in floors if f is not None and f.sure == "measured"]
    if not known or any(not np.isfinite(x.floor).all() for x in noise.layouts):
        return None, None
    bare = Noise(tuple(replace(x, columns=(), spill=np.zeros((0, *x.spill.shape[1:]))) for x in noise.layouts),
                 Levels(noise.levels.knots, np.zeros(0)), noise.information)
    z = bare.whiten(likelihood.expansion.error)
    share = float(np.mean(noise.information))
    ratio = float(z @ z) / share / bare.freedom
    # a density from half-overlapping Hann segments has about 1.9 degrees of freedom per line
    band = [np.sum((f.frequency >= x.frequency[0]) & (f.frequency <= x.frequency[-1])) * len(x.channel)
            for f, x in zip(known, noise.layouts, strict=False)]
    spread = np.sqrt(2 / (share * bare.freedom) + 2 / max(8.0, 8 * float(np.sum(band))))
    return ratio, 1 + TAIL * float(spread)


def _meter(likelihood: ForwardLikelihood) -> float:
    """Largest over modes of log(S_w/S_e), both as densities of modal force at resonance."""
    noise, error = likelihood.noise, likelihood.error
    model = error.problem.model
    out = [-np.inf]
    for q, k in enumerate(forced_modes(error)):
        omega, information = float(model.linear.omega[k]), 0.0
        for layout, run in zip(noise.layouts, error.runs, strict=True):
            at = int(np.argmin(np.abs(layout.frequency - omega / (2 * np.pi))))
            density = layout.sensor(noise.levels)[at] * run.scale**2 * 2 / run.recording.fs
            power = np.array([POWER[c.quantity] for c in run.recording.channels])
            rows = model.linear.rows([c.location for c in run.recording.channels])[:, k] * omega ** (power - 2.0)
            information = max(information, float(np.sum(rows**2 / density)))
        if information > 0:
            out.append(float(noise.levels.sources[q] + np.log(information)))
    return float(max(out))


def _responses(likelihood: ForwardLikelihood) -> dict[str, Array]:
    """Response (N,) to every library force at every joint; periodic recordings are left out."""
    error, at = likelihood.error, likelihood.expansion
    joints = tuple(dict.fromkeys(place for e in error.problem.model.elements for place in e.locations)) or error.problem.model.linear.joints
    theta = likelihood.coordinates.to_theta(at.s)
    columns: dict[str, list[Array]] = {}
    used = 0
    for run, substeps in zip(error.runs, error.substeps, strict=True):
        mine = at.states[used:used + len(run.unknown)]
        used += len(run.unknown)
        for name, column in _columns(likelihood, run, substeps, theta, mine, joints):
            columns.setdefault(name, []).append(column)
    return {name: np.concatenate(parts) for name, parts in columns.items()}


def _scores(likelihood: ForwardLikelihood, noise: Noise, columns: dict[str, Array]) -> tuple[tuple[str, float], ...]:
    """Score of every library force at every joint, parameters and initial state profiled out."""
    at = likelihood.expansion
    z, slope = noise.whiten(at.error), noise.whiten(at.slope[:, :len(at.s)].T)
    basis = np.linalg.svd(slope.T / np.maximum(np.linalg.norm(slope, axis=1), 1e-300), full_matrices=False)[0]
    out = []
    for name, column in columns.items():
        c = noise.whiten(column)
        whole = float(np.linalg.norm(c))
        c = c - basis @ (basis.T @ c)
        if np.linalg.norm(c) > 1e-3 * whole and whole > 0:
            out.append((name, float(-c @ z / np.linalg.norm(c))))
    return tuple(sorted(out, key=lambda x: -abs(x[1])))


def _once_allowed(likelihood: ForwardLikelihood, columns: dict[str, Array], scores: tuple[tuple[str, float], ...]
                  ) -> tuple[tuple[str, float], ...]:
    """Scores with the noise that is left once the force is allowed, for the few that are suspicious.

    Without the force the levels of noise must make room for it: "unmeasured force" hides what points along one law by ten standard
    deviations. A disturbance that is random stays when the law has been taken out, and the score with it.
    """
    at, noise = likelihood.expansion, likelihood.noise
    again = dict(scores)
    for name, z in scores[:LOOKED_AT]:
        if abs(z) > SUSPICIOUS:
            design = np.concatenate([at.slope[:, :len(at.s)], columns[name][:, None]], axis=1)
            design = design / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
            share = np.linalg.lstsq(noise.whiten(design.T).T, noise.whiten(at.error), rcond=1e-10)[0]
            left = noise.estimated(at.error - design @ share)
            found = dict(_scores(likelihood, left, {name: columns[name]}))
            again[name] = found.get(name, z) if abs(found.get(name, z)) > abs(z) else z
    return tuple(sorted(again.items(), key=lambda x: -abs(x[1])))


def _unseen(likelihood: ForwardLikelihood, columns: dict[str, Array], scores: dict[str, float], priors: Sequence[Prior]
            ) -> tuple[Unseen, ...]:
    """For each parameter, the library force that widens it most: coefficient and parameters together, the coefficient flat."""
    at, coordinates = likelihood.expansion, likelihood.coordinates
    slope = likelihood.noise.whiten(at.slope[:, :len(at.s)].T)
    spread = np.full(len(at.s), np.inf)
    if priors:
        shares = (np.arange(256) + 0.5) / 256
        spread = coordinates.to_s(np.stack([p.quantile(shares) for p in priors], axis=-1)).std(axis=0)
    scale = np.sqrt(np.maximum(np.sum(slope**2, axis=1) + spread**-2, 1e-300))
    information = (slope @ slope.T + np.diag(spread**-2)) / np.outer(scale, scale)
    covariance = np.linalg.pinv(information, 1e-12, hermitian=True) / np.outer(scale, scale)
    own = np.maximum(np.diag(covariance), 1e-300)
    widest, by = np.zeros(len(at.s)), [""] * len(at.s)
    for name, z in scores.items():
        c = likelihood.noise.whiten(columns[name])
        along = covariance @ (slope @ c)
        left = float(c @ c - (slope @ c) @ along)
        if left <= 1e-6 * float(c @ c):
            continue
        # the coefficient is z ± 1 in units of its own standard deviation
        extra = along**2 / left * (1 + z**2)
        for i in np.flatnonzero(extra > widest):
            widest[i], by[i] = extra[i], name
    total = np.minimum(own + widest, np.maximum(spread**2, own))
    return tuple(Unseen(name, float(np.sqrt(t / o)), force)
                 for name, t, o, force in zip(likelihood.problem.names, total, own, by, strict=True))


def _columns(likelihood: ForwardLikelihood, run: Any, substeps: int, theta: Array, states: Array, joints: tuple[str, ...]
             ) -> list[tuple[str, Array]]:
    """Response (N,) to each library force at each joint, along the simulated motion."""
    model, recording = likelihood.problem.model, run.recording
    names = [f"{what} at {place}" for place in joints for what in FORCES]
    if recording.period is not None:
        return [(name, np.zeros(run.measured.size)) for name in names]
    u0, v0 = (None if x is None else x[0] for x in start_state(run, states[None]))
    watch = tuple(Channel(f"{place} {q}", place, q, "") for place in joints for q in ("displacement", "velocity"))
    seen = replace(recording, channels=watch, response=np.zeros((recording.n, len(watch))))
    common: dict[str, Any] = {"u0": u0, "v0": v0, "substeps": substeps, "compiled": likelihood.error.compiled}
    motion = predict_record(model, theta[None], seen, **common).values[0]
    probed = Model(replace(model.linear, inputs=tuple(dict.fromkeys((*model.linear.inputs, *joints)))), model.elements, model.free_modes,
                   model.free_gain)
    extra = np.zeros((len(names) + 1, recording.n, len(probed.linear.inputs)))
    level = float(np.sqrt(np.mean(recording.response**2)))
    row = 0
    for j, place in enumerate(joints):
        q, v = motion[:, 2 * j], motion[:, 2 * j + 1]
        q, v = q / max(np.abs(q).max(), 1e-300), v / max(np.abs(v).max(), 1e-300)
        for law in FORCES.values():
            row += 1
            extra[row, :, probed.linear.inputs.index(place)] = NUDGE * level * law(q, v)
    asked = recording if not recording.free else replace(recording, force=np.zeros((recording.n, 1)),
                                                         inputs=(Channel("none", joints[0], "force", "N"),))
    found = predict_record(probed, np.broadcast_to(theta, (len(extra), len(theta))), asked, extra=extra, **common).values / run.scale
    moved = run.spectrum.apply(np.moveaxis(found[1:] - found[0], 1, 2))
    return [(name, np.nan_to_num(column.T.ravel())) for name, column in zip(names, moved, strict=True)]
