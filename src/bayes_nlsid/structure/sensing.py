"""Virtual sensing: modal coordinates and joint motion from what sensors measured (Eq. 11–12)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.kinematics import ORDER, Kinematics, kinematics
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.modal import ModalData, ModalModel

if TYPE_CHECKING:
    from bayes_nlsid.recordings.noise import NoiseFloor

LARGEST_CONDITION = 100.0
"""Condition number of the sensor rows beyond which modes cannot be told apart in practice."""
LEAK = 1e-3
"""Gain of a mode's filter at another mode's frequency from which that mode counts as present in the band."""
TINY = float(np.finfo(float).tiny)
Bands = Sequence[tuple[float, float]]


def modal_data(recording: Recording, model: ModalModel, modes: Sequence[int], joints: Sequence[str], band: tuple[float, float], *,
               noise: NoiseFloor | None = None, fs: float | None = None, bands: Bands | None = None,
               static_correction: bool = False) -> ModalData:
    """Modal motion u = (Φᵐ)⁺ xᵐ, weighted by channel noise, and the motion of joints Φᵘ u.

    Parameters
    ----------
    recording : Recording
    model : ModalModel
        Knows the location of every channel and input.
    modes : sequence of int
        0-based modes to observe.
    joints : sequence of str
    band : tuple of float
        (low, high) Hz.
    noise : NoiseFloor, optional
        Noise of the channels as recorded; estimated from the recording if omitted.
    fs : float, optional
        Lower sampling rate, Hz.
    bands : sequence of (float, float), optional
        One band per mode, Hz. Each mode is then filtered in its own band and told apart only from modes whose bands overlap it or which
        resonate in the skirts of its filter (half the lower to 1.25 times the upper edge), so that few sensors can feed many well
        separated modes; what a mode does outside its band is lost.
    static_correction : bool
        Take the measured force's quasi-static response of the modes left out (``model.residual``) from the measurement and add it to
        the joints. Good only if the residual flexibility is that of the structure, not merely of a reduced model of it.

    Returns
    -------
    ModalData

    Raises
    ------
    ValueError
        If there are fewer sensors than modes in a band, the sensors cannot tell modes apart (which ones is said), a channel sits at an
        unknown location, or the correction is asked for without residual flexibility.
    """
    chosen = tuple(int(k) for k in modes)
    if not chosen or len(set(chosen)) != len(chosen) or not all(0 <= k < model.modes for k in chosen):
        raise ValueError(f"modes {chosen} must be distinct indices below {model.modes}")
    if bands is not None and len(bands) != len(chosen):
        raise ValueError(f"bands: {len(bands)} given for {len(chosen)} modes; give one (low, high) per mode")
    if static_correction and model.residual is None:
        raise ValueError("static_correction needs a model with residual flexibility; build it with residual=True")
    rows = model.rows([c.location for c in recording.channels])
    psd = noise if noise is not None else _estimated_noise(recording)
    whole = list(range(len(chosen)))
    plan = [(whole, band)] if bands is None else [([i], bands[i]) for i in whole]
    columns: list[dict[str, NDArray[np.float64]]] = [{} for _ in whole]
    valid, conditions, dt = slice(0, recording.n), [], 0.0
    for own, limits in plan:
        motion = kinematics(recording, limits, fs)
        members = whole if bands is None else _heard(motion, model.frequency[list(chosen)], bands, own[0])
        x = _motions(recording, model, motion, limits, fs, static_correction)
        level, colour = acceleration_noise(psd, motion), noise_colour(psd, motion)
        picked = [chosen[i] for i in members]
        inverse, condition = modal_filter(rows[:, picked], level, [f"{k + 1} ({model.frequency[k]:.4g} Hz)" for k in picked])
        for i in own:
            row = inverse[members.index(i)]
            power = row**2 * level
            columns[i] = {"u": x[0] @ row, "v": x[1] @ row, "a": x[2] @ row, "noise": row**2 @ level,
                          "colour": colour @ power / max(float(power.sum()), TINY),
                          "force": motion.force @ model.rows([c.location for c in motion.inputs])[:, chosen[i]]}
        valid = slice(max(valid.start, motion.valid.start), min(valid.stop, motion.valid.stop))
        conditions.append(condition)
        dt = motion.dt
    if valid.stop <= valid.start:
        raise ValueError(f"recording {recording.name!r}: no samples are free of edge effects in all bands; raise the lower band edges")
    u, v, a, force, spread = (np.stack([c[name] for c in columns], axis=-1) for name in ("u", "v", "a", "force", "noise"))
    at = model.rows(tuple(joints))[:, list(chosen)]
    q, qd = u @ at.T, v @ at.T
    if static_correction and recording.inputs:
        static = _as_displacement(recording, band, fs)
        G = _residual(model, joints, recording)
        q, qd = q + static.displacement @ G.T, qd + static.velocity @ G.T
    return ModalData(recording.name, dt, chosen, u, v, a, force, tuple(joints), q, qd, valid, band, spread, max(conditions),
                     recording.period is not None, np.stack([c["colour"] for c in columns], axis=-1))


def _estimated_noise(recording: Recording) -> NoiseFloor:
    from bayes_nlsid.recordings.noise import noise_psd

    return noise_psd(recording)


def modal_filter(rows: NDArray[np.float64], noise: NDArray[np.float64], names: Sequence[str]) -> tuple[NDArray[np.float64], float]:
    """Pseudo-inverse (m, s) of sensor rows (s, m), least squares weighted by the channels' noise, and its condition number.

    Parameters
    ----------
    rows : ndarray (s, m)
    noise : ndarray (s,)
        Noise power of each channel in one unit; channels count equally if any is zero.
    names : sequence of str, length m
        Of the modes, for the message.

    Raises
    ------
    ValueError
        If there are fewer sensors than modes, or some combination of modes is nearly invisible; the modes are named.
    """
    sensors, count = rows.shape
    if sensors < count:
        raise ValueError(f"{sensors} sensors cannot tell {count} modes apart ({', '.join(names)}); observe at most {sensors} modes, or "
                         "give well separated modes a band each")
    weight = 1 / np.sqrt(noise / noise.max()) if (noise > 0).all() else np.ones(sensors)
    weighted = rows * weight[:, None]
    _, values, directions = np.linalg.svd(weighted, full_matrices=False)
    condition = float(values[0] / values[-1]) if values[-1] > 0 else np.inf
    if not condition < LARGEST_CONDITION:
        blind = np.abs(directions[-1])
        alike = [name for name, part in zip(names, blind, strict=True) if part > 0.3 * blind.max()]
        what = f"mode {alike[0]} is hardly seen" if len(alike) == 1 else f"modes {', '.join(alike)} cannot be told apart"
        raise ValueError(f"{what} by these {sensors} sensors (condition number {condition:.3g}, limit {LARGEST_CONDITION:g}); leave a mode "
                         "out, add a sensor, or give well separated modes a band each")
    return np.linalg.pinv(weighted) * weight, condition


def acceleration_noise(noise: NoiseFloor, motion: Kinematics) -> NDArray[np.float64]:
    """One-sided power spectral density (s,) of each channel's noise as an acceleration, averaged over the band, (m/s²)²/Hz."""
    inside, factor = _as_acceleration(noise, motion)
    return np.asarray(np.mean(noise.psd[inside] * factor, axis=0), dtype=float)


def noise_colour(noise: NoiseFloor, motion: Kinematics) -> NDArray[np.float64]:
    """Shape (3, s) of that density: coefficients of ω⁴, ω² and 1, taken as white in what each channel measures, with mean one in the band.

    The noise of a displacement sensor grows as ω⁴ on the way to acceleration: over a wide band its average would be that of the upper
    edge, and far too much below.
    """
    _, factor = _as_acceleration(noise, motion)
    out = np.zeros((3, len(motion.channels)))
    order = [ORDER[c.quantity] for c in motion.channels]
    out[order, np.arange(len(order))] = 1 / factor.mean(axis=0)
    return out


def _as_acceleration(noise: NoiseFloor, motion: Kinematics) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Frequencies of a noise floor within the band, and the factor (f, s) there from each channel's density to that of acceleration."""
    inside = (noise.frequency >= motion.band[0]) & (noise.frequency <= motion.band[1])
    if not inside.any():
        inside = np.zeros(len(noise.frequency), dtype=bool)
        inside[np.argmin(np.abs(noise.frequency - np.sqrt(motion.band[0] * motion.band[1])))] = True
    power = 2 * np.array([2 - ORDER[c.quantity] for c in motion.channels])
    return inside, (2 * np.pi * noise.frequency[inside, None]) ** power


def _heard(motion: Kinematics, frequency: NDArray[np.float64], bands: Bands, i: int) -> list[int]:
    """Modes to be solved for together in band i: those whose bands overlap it, and those that resonate in the skirts of its filter."""
    low, high = bands[i]
    return [k for k, other in enumerate(bands) if k == i or (other[0] < high and low < other[1]) or motion.gain(frequency[k]) > LEAK]


def _motions(recording: Recording, model: ModalModel, motion: Kinematics, band: tuple[float, float], fs: float | None,
             corrected: bool) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Displacement, velocity, acceleration of the channels, without the quasi-static answer of modes left out if asked for."""
    own = (motion.displacement, motion.velocity, motion.acceleration)
    if not corrected or not recording.inputs:
        return own
    static = _as_displacement(recording, band, fs)
    G = _residual(model, [c.location for c in recording.channels], recording)
    return own[0] - static.displacement @ G.T, own[1] - static.velocity @ G.T, own[2] - static.acceleration @ G.T


def _as_displacement(recording: Recording, band: tuple[float, float], fs: float | None) -> Kinematics:
    """Filtered forces with their first and second derivative (N, N/s, N/s²): what a static flexibility turns into motion."""
    channels = tuple(Channel(c.name, c.location, "displacement", "N") for c in recording.inputs)
    return kinematics(replace(recording, response=recording.force, channels=channels), band, fs)


def _residual(model: ModalModel, names: Sequence[str], recording: Recording) -> NDArray[np.float64]:
    """Residual flexibility (len(names), k) from the measured forces to named locations."""
    assert model.residual is not None
    to = [model.locations.index(name) for name in names]
    at = [model.locations.index(c.location) for c in recording.inputs]
    return model.residual[np.ix_(to, at)]
