"""Whether sensors answer a measured force as the linear model says: with the same sign, and about as strongly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.kinematics import ORDER
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.polarity import SHAPE_ERROR, PolarityFinding

Floats = NDArray[np.float64]
Spectrum = NDArray[np.complex128]
ALIKE = 0.6
"""Correlation between computed and measured response from which the two are the same motion, whatever its sign and size."""
FACTOR = 3.0
"""Ratio of measured to computed response, or its inverse, that no model meant for this structure has."""
BAND = (0.8, 1.3)
"""Where a mode is looked at, relative to its nominal frequency; it ends half-way to its neighbours."""
SHIFTS = np.linspace(0.9, 1.2, 13)
"""Factors tried on the frequency of a mode: the model is a few per cent off, and loud motion shifts a resonance further."""
DAMPINGS = (1.0, 3.0, 10.0)
LEAST_LINES = 20
CONFUSED = ((9.80665, "m/s² taken for g, or g for m/s²"), (1e3, "a prefix too many, or one forgotten"),
            (1e6, "a prefix too many, or one forgotten"), (4.448222, "pounds-force taken for newtons, or the reverse"))
NEAR = 0.4
"""log-ratio within which a factor is told as one of `CONFUSED`: the model is known no better, least where it is loud."""


def response_findings(recording: Recording, model: ModalModel, modes: Sequence[int] | None = None, *,
                      scale: bool = True) -> tuple[PolarityFinding, ...]:
    """Channels that answer the recorded force with the wrong sign, or as if measured in another unit.

    The model's response to the recorded force is compared with each channel about each mode. Frequency and damping of the mode are tuned
    to the recording, by trial over `SHIFTS` and `DAMPINGS`; its shape and mass stay as stated. A mode says something of a channel
    where it is no node and the two responses correlate by `ALIKE`; of modes that contradict each other nothing is concluded.

    Parameters
    ----------
    recording : Recording
        With a measured force.
    model : ModalModel
        Nominal; shapes need to be right in sign, mass within a factor of `FACTOR`.
    modes : sequence of int, optional
        0-based modes to look at; all if omitted.
    scale : bool
        Whether the size counts; not where the gain of the force is unknown anyway.

    Returns
    -------
    tuple of PolarityFinding
        Kind ``"inverted"``, ``"scaled"``, or ``"swapped"`` for a force and a response that were exchanged; empty without a force, or
        where nothing correlates.
    """
    if recording.free:
        return ()
    wanted = list(range(model.modes) if modes is None else modes)
    answers = _answers(recording, model, wanted)
    negative = [a.channel for a in answers if a.gain < 0]
    out = [_inverted(a, len(negative) == len(answers), len(answers), recording) for a in answers if a.gain < 0]
    out += [_scaled(a) for a in answers if scale and abs(np.log(abs(a.gain))) > np.log(FACTOR)]
    return (*out, *_exchanged(recording, model, wanted, {a.channel for a in answers}))


def _exchanged(recording: Recording, model: ModalModel, modes: Sequence[int], known: set[str]) -> Iterator[PolarityFinding]:
    """A channel that makes no sense as an answer to the force, while the force does as an answer to the channel."""
    if len(recording.inputs) != 1:
        return
    for c, channel in enumerate(recording.channels):
        if channel.name in known:
            continue
        turned = replace(recording, response=recording.force, channels=(channel,), force=recording.response[:, [c]])
        for answer in _answers(turned, model, modes):
            force = recording.inputs[0].name
            text = f"{channel.name} and {force} look exchanged: what is called the force answers what is called the motion"
            yield PolarityFinding(channel.name, "swapped", answer.likeness, text, force)


@final
@dataclass(frozen=True)
class _Answer:
    """Measured over computed response of a channel, and how alike they are."""

    channel: str
    gain: float
    likeness: float


def _answers(recording: Recording, model: ModalModel, modes: Sequence[int]) -> list[_Answer]:
    at = model.rows(tuple(c.location for c in recording.channels))
    drive = model.rows(tuple(c.location for c in recording.inputs))
    largest = np.abs(model.shapes).max(axis=0)
    f = np.fft.rfftfreq(recording.n, recording.dt)
    measured = np.fft.rfft(recording.response, axis=0)
    found: dict[int, list[tuple[float, float]]] = {}
    for k in modes:
        low, high = _band(model, k, recording.fs)
        lines = np.flatnonzero((f >= low) & (f <= high))
        seen = np.flatnonzero(np.abs(at[:, k]) > SHAPE_ERROR * largest[k])
        if len(lines) < LEAST_LINES or not seen.size or np.abs(drive[:, k]).max() <= SHAPE_ERROR * largest[k]:
            continue
        gains, likeness = _tuned(recording, model, k, at, drive, lines, measured[lines])
        for c in seen[np.abs(likeness[seen]) >= ALIKE]:
            found.setdefault(int(c), []).append((float(gains[c]), float(abs(likeness[c]))))
    out = []
    for c, pairs in sorted(found.items()):
        gains = np.array([gain for gain, _ in pairs])
        if (gains > 0).all() or (gains < 0).all():
            out.append(_Answer(recording.channels[c].name, float(np.sign(gains[0]) * np.exp(np.median(np.log(np.abs(gains))))),
                               max(likeness for _, likeness in pairs)))
    return out


def _band(model: ModalModel, k: int, fs: float) -> tuple[float, float]:
    """Where a mode is looked at, Hz."""
    frequency = model.frequency
    below = (frequency[k - 1] + frequency[k]) / 2 if k else 0.0
    above = (frequency[k] + frequency[k + 1]) / 2 if k + 1 < model.modes else np.inf
    return max(BAND[0] * frequency[k], below), min(BAND[1] * frequency[k], above, 0.45 * fs)


def _tuned(recording: Recording, model: ModalModel, k: int, at: Floats, drive: Floats, lines: NDArray[np.int_],
           measured: Spectrum) -> tuple[Floats, Floats]:
    """Gain and correlation (s,) of every channel in the band of mode k, at the frequency and damping where they correlate best in all."""
    order = np.array([ORDER[c.quantity] for c in recording.channels])
    others = np.zeros_like(measured)
    for j in range(model.modes):
        if j != k and model.frequency[j] < 0.45 * recording.fs:
            others += _modal(recording, drive[:, j], model.omega[j], model.zeta[j], lines)[:, order] * at[:, j]
    size = np.linalg.norm(measured, axis=0)
    best: tuple[float, Floats, Floats] = (-1.0, np.zeros(len(order)), np.zeros(len(order)))
    for shift in SHIFTS:
        for factor in DAMPINGS:
            own = _modal(recording, drive[:, k], shift * model.omega[k], min(factor * max(model.zeta[k], 1e-4), 0.5), lines)
            computed = own[:, order] * at[:, k] + others
            power = np.linalg.norm(computed, axis=0)
            product = np.sum(computed.conj() * measured, axis=0).real
            likeness = product / np.maximum(power * size, np.finfo(float).tiny)
            if float(likeness @ likeness) > best[0]:
                best = float(likeness @ likeness), product / np.maximum(power**2, np.finfo(float).tiny), likeness
    return best[1], best[2]


def _modal(recording: Recording, drive: Floats, omega: float, zeta: float, lines: NDArray[np.int_]) -> Spectrum:
    """Spectra (lines, 3) of displacement, velocity and acceleration of one mode under the recorded force: steady where the recording holds
    whole periods, else from rest."""
    from scipy.signal import cont2discrete, lfilter

    modal = recording.force @ drive
    if recording.period:
        w = 2 * np.pi * np.fft.rfftfreq(recording.n, recording.dt)[lines]
        steady = np.fft.rfft(modal)[lines] / (omega**2 - w**2 + 2j * zeta * omega * w)
        return np.asarray(steady[:, None] * (1j * w[:, None]) ** np.arange(3), dtype=complex)
    out = []
    for order in range(3):
        b, a, _ = cont2discrete(([1.0] + [0.0] * order, [1.0, 2 * zeta * omega, omega**2]), recording.dt, method="foh")
        out.append(np.fft.rfft(lfilter(np.squeeze(b), a, modal))[lines])
    return np.column_stack(out)


def _inverted(answer: _Answer, every: bool, compared: int, recording: Recording) -> PolarityFinding:
    text = f"{answer.channel} answers the measured force with the sign opposite to the model's"
    if every:
        force = " and ".join(c.name for c in recording.inputs)
        sensors = "this channel is" if compared == 1 else "all channels are"
        text += f": either {force} is inverted, or {sensors}; write polarity = -1 for it once the wiring or the drawing has told which"
    else:
        text += ", and others do not: it is mounted the other way round; write polarity = -1 for it"
    return PolarityFinding(answer.channel, "inverted", answer.likeness, text)


def _scaled(answer: _Answer) -> PolarityFinding:
    gain = abs(answer.gain)
    guess = next((words for factor, words in CONFUSED if abs(abs(np.log(gain)) - np.log(factor)) < NEAR), "")
    text = (f"{answer.channel} answers the measured force {gain:.3g} times as strongly as the model does: check its unit and sensitivity, "
            "those of the force, and the mass of the model")
    return PolarityFinding(answer.channel, "scaled", answer.likeness, f"{text} (it looks like {guess})" if guess else text)
