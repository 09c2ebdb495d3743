"""The linear model as calibration has it, what drives its observer beside the known forces, and both found from the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.campaign import Trial
from bayes_nlsid.mismatch.observer import ORDER, Modal, Observer, observe
from bayes_nlsid.mismatch.seen import Seen, fed, key_of
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
DRIVES = 10.0 ** np.arange(-8.0, 1.0)   # variances of the modal drive that are tried, relative to that of the modal motion
NOISES = 10.0 ** np.arange(0.0, -4.1, -0.5)   # sensor noise that is tried, relative to the stated floor


@final
@dataclass(frozen=True, eq=False)
class Linear:
    """The linear model as calibration has it.

    Parameters
    ----------
    model : ModalModel
        Shapes and names; its own frequencies and damping are replaced by ``modal``.
    modal : Modal
    gain : float
        Factor on measured forces.
    offsets : ndarray (k,)
        Constant added to each measured force, N.
    seen : Seen or None
        Corrections of the channels: errors of the mode shapes there, force that is fed through.
    """

    model: ModalModel
    modal: Modal
    gain: float
    offsets: Array
    seen: Seen | None = None

    def rows(self, channels: Sequence[Channel]) -> Array:
        """Rows (s, m) of channels, corrected."""
        rows = self.model.rows([c.location for c in channels])
        return rows if self.seen is None else rows + self.seen.shapes[[self.seen.keys.index(key_of(c)) for c in channels]]

    def response(self, record: Recording) -> Array:
        """Channels (n, s) of a record without the force that is fed through."""
        if self.seen is None or record.free:
            return record.response
        at = [self.seen.keys.index(key_of(c)) for c in record.channels]
        return np.asarray(record.response - fed(self.model, record) @ self.seen.direct[at].T)

    def forces(self, trial: Trial) -> Array:
        """Known modal force (n, m) of a record."""
        record = trial.recording
        if record.free:
            return np.zeros((record.n, self.model.modes))
        names = [c.location for c in record.inputs]
        own = [self.model.inputs.index(n) if n in self.model.inputs else -1 for n in names]
        shift = np.array([self.offsets[i] if i >= 0 else 0.0 for i in own])
        return (self.gain * record.force + shift) @ self.model.rows(names)


@final
@dataclass(frozen=True, eq=False)
class Drive:
    """What moves the observer besides the known forces.

    ``force`` (m,): variance of the white modal force; ``noise``: factor on the stated standard deviation of the sensor noise.
    """

    force: Array
    noise: float


def observer_of(linear: Linear, trial: Trial, drive: Drive) -> Observer:
    """The steady filter of one record."""
    record = trial.recording
    rows = linear.rows(record.channels)
    size = np.std(record.response, axis=0)
    noise = np.maximum(trial.noise * drive.noise, 1e-6 * np.maximum(size, 1e-12 * size.max() + 1e-300))
    return Observer(linear.modal, record.dt, rows, tuple(ORDER[c.quantity] for c in record.channels), noise ** 2, drive.force)


def best_drive(linear: Linear, trials: Sequence[Trial], forces: Sequence[Array]) -> Drive:
    """Variances of the modal drive and of the sensor noise by likelihood; shares among modes from the smoothed latent force.

    The stated noise floor is often only a bound, so less noise is tried too.
    """
    longest = max(range(len(trials)), key=lambda i: trials[i].recording.n * trials[i].level)
    trial = trials[longest]
    some = min(trial.recording.n, max(1500, 12_000 // max(2, linear.model.modes)))
    short = replace(trial, recording=replace(trial.recording.window(0.0, some * trial.recording.dt), period=None))
    force = forces[longest][:some]
    share = np.ones(linear.model.modes) * _modal_scale(linear, short) ** 2
    best, likelihood, latent = Drive(share * DRIVES[3], 1.0), -np.inf, np.zeros((1, linear.model.modes))
    for _ in range(2):
        # the low-pass leaves less noise near the end of the band than a measured floor says, which likelihood would take for no noise
        for noise in NOISES if trial.bound else NOISES[:2]:
            for factor in DRIVES:
                drive = Drive(share * factor, noise)
                try:
                    found = observe(observer_of(linear, short, drive), linear.response(short.recording), force)
                except (np.linalg.LinAlgError, ValueError):
                    continue
                if np.isfinite(found.likelihood) and found.likelihood > likelihood:
                    best, likelihood, latent = drive, found.likelihood, found.latent
        if linear.model.modes == 1 or not np.isfinite(likelihood):
            break
        power = np.var(latent, axis=0)
        share = np.maximum(power, 1e-4 * power.max() + 1e-300)
        share = share / share.max() * best.force.max() / DRIVES[4]
    return best


def _modal_scale(linear: Linear, trial: Trial) -> float:
    """Size of the modal acceleration, from the loudest channel."""
    record = trial.recording
    rows = np.abs(linear.rows(record.channels)).max(axis=1)
    elastic = linear.modal.omega[linear.modal.omega > 1e-3]
    w = float(elastic[0]) if elastic.size else 2 * np.pi * 4 / (record.n * record.dt)
    order = np.array([ORDER[c.quantity] for c in record.channels])
    return float(np.max(np.std(record.response, axis=0) * w ** (2 - order) / np.maximum(rows, 1e-9 * rows.max() + 1e-300)))
