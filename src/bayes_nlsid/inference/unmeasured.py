"""What unmeasured force and unknown beginnings do to a simulated recording: columns of its error, through the tangent dynamics."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.identification.output_error import OutputError, Run, start_state
from bayes_nlsid.model import Model
from bayes_nlsid.recordings.recording import Channel
from bayes_nlsid.simulation.replay import predict_record

Array = NDArray[np.float64]
MOST_COLUMNS = 192      # per recording: two for each frequency near a resonance
HALF_WIDTHS = 10.0      # of a resonance in which unmeasured force is followed through the nonlinear motion
NUDGE = 1e-5            # of the motion: force by which the tangent is probed
BATCH = 48
POWER = {"displacement": 0, "velocity": 1, "acceleration": 2}


@final
class Unmeasured(NamedTuple):
    """Columns (N, K_k) of every mode near resonance, and variance (Q, bins, s) away from it, for force of unit density."""

    columns: tuple[Array, ...]
    spill: Array


def forced_modes(error: OutputError) -> tuple[int, ...]:
    """Modes inside the band of some recording: those that unmeasured force can be seen in."""
    frequency = error.problem.model.linear.frequency
    inside = [k for k, f in enumerate(frequency) if any(r.spectrum.frequency[0] <= f <= r.spectrum.frequency[-1] for r in error.runs)]
    return tuple(inside) or (error.problem.scenario.main,)


def unmeasured_force(error: OutputError, theta: Array, states: Array, modes: tuple[int, ...]) -> list[Unmeasured]:
    """For every recording, the response to white force on each of the modes, along the simulated motion.

    Each column is the response to a small force of one frequency added to the one that was measured, so it knows the tangent along
    the motion, its memory included. Away from resonance the structure is taken as linear.

    Parameters
    ----------
    error : OutputError
    theta : ndarray (P,)
    states : ndarray (U,)
    modes : tuple of int
    """
    out, at = [], 0
    for run, substeps in zip(error.runs, error.substeps, strict=True):
        mine = states[at:at + len(run.unknown)]
        at += len(run.unknown)
        picked = [_near(error, theta, run, k, len(modes)) for k in modes]
        spill = np.stack([_linear_power(error, theta, run, k) for k in modes])
        columns: tuple[Array, ...] = tuple(np.zeros((run.measured.size, 0)) for _ in modes)
        if run.recording.period is None:
            columns = _probed(error, theta, run, mine, substeps, modes, picked)
            for q, near in enumerate(picked):
                spill[q, near] = 0.0
        out.append(Unmeasured(columns, spill))
    return out


def _near(error: OutputError, theta: Array, run: Run, mode: int, sharing: int) -> NDArray[np.intp]:
    """Bins within ten half widths of where the mode resonates between small and large motion."""
    omega, zeta = (float(x[mode]) for x in error.problem.model.linear_values(theta))
    low, high = _range(error, theta, mode, omega)
    width = HALF_WIDTHS * zeta * omega / (2 * np.pi) + 2 / (run.recording.n * run.recording.dt)
    f = run.spectrum.frequency
    inside = np.flatnonzero((f >= low - width) & (f <= high + width))
    most = MOST_COLUMNS // (2 * sharing)
    if len(inside) > most:
        inside = np.sort(inside[np.argsort(np.abs(f[inside] - 0.5 * (low + high)), kind="stable")[:most]])
    return inside


def _range(error: OutputError, theta: Array, mode: int, omega: float) -> tuple[float, float]:
    """Hz between which the mode resonates: at rest, at the largest recorded motion and at half of it, each joint at its own."""
    model, observed = error.problem.model, error.problem.observed
    phase = np.linspace(0, 4 * np.pi, 128, endpoint=False)
    found = [omega**2]
    for share in (0.5, 1.0):
        square = omega**2
        for e, element in enumerate(model.elements):
            for place in element.locations:
                size = share * observed.peak(place)[0]
                path = motion(size * np.cos(phase), -size * omega * np.sin(phase), 4 * np.pi / omega / len(phase))
                force = force_along(element.term, path, model.element_values(theta, e, place), element.excess)[64:]
                lever = float(model.linear.rows((place,))[0, mode])
                square += lever**2 * float(np.mean(2 * force * np.cos(phase[64:]))) / max(size, 1e-300)
        found.append(square)
    values = np.sqrt(np.maximum(np.nan_to_num(found, nan=omega**2), 0.25 * omega**2)) / (2 * np.pi)
    return float(values.min()), float(values.max())


def _linear_power(error: OutputError, theta: Array, run: Run, mode: int) -> Array:
    """|H|² (bins, s) of the linear mode in the units of the entries, for modal force of unit one-sided density."""
    omega, zeta = (float(x[mode]) for x in error.problem.model.linear_values(theta))
    w = 2 * np.pi * run.spectrum.frequency
    rows = error.problem.model.linear.rows([c.location for c in run.recording.channels])[:, mode]
    power = np.array([POWER[c.quantity] for c in run.recording.channels])
    gain = np.abs(1 / (omega**2 - w**2 + 2j * zeta * omega * w))[:, None] * w[:, None] ** power * rows / run.scale
    return np.asarray(gain**2 * run.recording.fs / 2)


def _probed(error: OutputError, theta: Array, run: Run, states: Array, substeps: int, modes: tuple[int, ...],
            picked: list[NDArray[np.intp]]) -> tuple[Array, ...]:
    recording, model = run.recording, error.problem.model
    names = tuple(f"mode {k + 1} alone" for k in modes)
    linear = replace(model.linear, locations=(*model.linear.locations, *names),
                     shapes=np.concatenate([model.linear.shapes, np.eye(model.linear.modes)[list(modes)]]),
                     inputs=(*model.linear.inputs, *names), residual=None)
    probed = Model(linear, model.elements, model.free_modes, model.free_gain)
    force = np.concatenate([recording.force, np.zeros((recording.n, len(modes)))], axis=1)
    inputs = (*recording.inputs, *(Channel(name, name, "force", "N") for name in names))
    asked = replace(recording, force=force, inputs=inputs)
    # one period per record length: these lines span all forces in their band
    line = 1 / (recording.n * recording.dt)
    phase = 2 * np.pi * line * recording.time
    shapes = [(q, wave(j * phase)) for q, bins in enumerate(picked)
              for j in np.unique(np.round(run.spectrum.frequency[bins] / line)) for wave in (np.cos, np.sin)]
    level = float(np.sqrt(np.mean(recording.response**2))) / max(float(np.abs(linear.shapes).max()), 1e-300)
    u0, v0 = (None if x is None else x[0] for x in start_state(run, states[None]))
    units = [_unit(model, theta, run, k, level) for k in modes]

    def responses(extra: Array) -> Array:
        found = predict_record(probed, np.broadcast_to(theta, (len(extra), len(theta))), asked, u0=u0, v0=v0, substeps=substeps,
                               compiled=error.compiled, extra=extra)
        return found.values / run.scale

    still = responses(np.zeros((1, recording.n, force.shape[1])))[0]
    out: list[list[Array]] = [[] for _ in modes]
    for i in range(0, len(shapes), BATCH):
        some = shapes[i:i + BATCH]
        extra = np.zeros((len(some), recording.n, force.shape[1]))
        for j, (q, shape) in enumerate(some):
            extra[j, :, recording.force.shape[1] + q] = units[q] * shape
        moved = run.spectrum.apply(np.moveaxis(responses(extra) - still, 1, 2))
        for (q, _), column in zip(some, moved, strict=True):
            out[q].append(np.where(np.isfinite(column), column, 0.0).T.ravel() / units[q] * np.sqrt(line))
    return tuple(np.array(c).T.reshape(run.measured.size, len(c)) for c in out)


def _unit(model: Model, theta: Array, run: Run, mode: int, level: float) -> float:
    """Modal force that moves the mode by a small share of what was recorded."""
    omega, zeta = (float(x[mode]) for x in model.linear_values(theta))
    power = POWER[run.recording.channels[0].quantity]
    return NUDGE * level * 2 * max(zeta, 1e-4) * omega ** (2 - power)


def residual_terms(run: Run) -> Array:
    """Columns (N, X): what modes below and above the band may add to each channel, F and Ω² F in acceleration; none without force."""
    recording, spectrum = run.recording, run.spectrum
    count, bins = len(recording.channels), spectrum.bins
    if recording.free or not np.any(recording.force):
        return np.zeros((2 * bins * count, 0))
    w = 2 * np.pi * spectrum.frequency
    out = []
    for force in recording.force.T:
        real, imaginary = spectrum.apply(force).reshape(2, bins)
        lines = real + 1j * imaginary
        for i, channel in enumerate(recording.channels):
            for shape in (lines, w**2 * lines):
                values = shape / (1j * w) ** (2 - POWER[channel.quantity])
                column = np.zeros((2, bins, count))
                column[:, :, i] = values.real, values.imag
                out.append(column.ravel() / max(float(np.linalg.norm(column)), 1e-300))
    return np.array(out).T
