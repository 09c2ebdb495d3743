"""What the sensors make of a modal motion: mode shapes with small errors, force fed through, a constant for each channel.

A linear model fitted to modes and springs still has the mode shapes of the nominal one, and lacks the modes above its band. Both errors are
linear in the modal motion and in the force, so their best values follow from any simulation by least squares (variable projection), and
belong to the honest linear rival as much as to every extension.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.recording import SI_UNIT, Channel, Quantity, Recording
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
SHAPE_SD = 0.1     # prior of a mode-shape error, relative to the largest shape of the mode
WORTH = 200.0      # independent values that the simulated errors are worth against that prior: most of them are model error
Key = tuple[str, str]


@final
@dataclass(frozen=True, eq=False)
class Seen:
    """Corrections of the channels.

    Parameters
    ----------
    keys : tuple of (location, quantity)
    shapes : ndarray (s, m)
        Added to the rows of the model.
    direct : ndarray (s, k)
        Channel per unit of each measured force.
    constant : ndarray (s,)
    """

    keys: tuple[Key, ...]
    shapes: Array
    direct: Array
    constant: Array

    def wave(self, model: ModalModel, record: Recording, motion: Array) -> Array:
        """Channels (..., n, s) of a modal motion (..., n, q, m), one axis for each of the `quantities` of the record."""
        at = [self.keys.index(key_of(c)) for c in record.channels]
        rows = model.rows([c.location for c in record.channels]) + self.shapes[at]
        order = [quantities(record).index(c.quantity) for c in record.channels]
        wave = np.stack([motion[..., o, :] @ row for o, row in zip(order, rows, strict=True)], axis=-1)
        return np.asarray(wave + self.constant[at] + fed(model, record) @ self.direct[at].T)


def key_of(channel: Channel) -> Key:
    """What tells a channel from others."""
    return channel.location, channel.quantity


def fed(model: ModalModel, record: Recording) -> Array:
    """Force (n, k) at the inputs of the model."""
    out = np.zeros((record.n, len(model.inputs)))
    for j, c in enumerate(record.inputs):
        if c.location in model.inputs:
            out[:, model.inputs.index(c.location)] += record.force[:, j]
    return out


def unseen(model: ModalModel, records: Sequence[Recording]) -> Seen:
    """No corrections, for all channels of some records."""
    keys = tuple(dict.fromkeys(key_of(c) for r in records for c in r.channels))
    return Seen(keys, np.zeros((len(keys), model.modes)), np.zeros((len(keys), len(model.inputs))), np.zeros(len(keys)))


def quantities(record: Recording) -> tuple[Quantity, ...]:
    """Displacement, velocity or acceleration: what the channels of a record show."""
    return tuple(dict.fromkeys(c.quantity for c in record.channels))


def modal_channels(record: Recording, modes: int) -> tuple[Channel, ...]:
    """Channels that show every mode at the locations `modal_locations` in the quantities of a record."""
    return tuple(Channel(f"{name} {q}", name, q, SI_UNIT[q]) for q in quantities(record) for name in modal_locations(modes))


def modal_locations(modes: int) -> tuple[str, ...]:
    """Names under which modal coordinates are simulated."""
    return tuple(f"mode {i + 1} itself" for i in range(modes))


def charge(model: ModalModel, seen: Seen) -> Array:
    """Residual (s m,) that errors of the mode shapes cost."""
    return np.asarray((seen.shapes * _prior(model)).ravel())


def _prior(model: ModalModel) -> Array:
    """Weight (m,) of an error of a shape in the residual."""
    largest = np.abs(model.rows(model.sensors or model.locations)).max(axis=0)
    return np.where(largest > 0, WORTH ** -0.5 / (SHAPE_SD * np.maximum(largest, 1e-300)), 0.0)


def corrected(model: ModalModel, records: Sequence[Recording], weights: Sequence[Array], motions: Sequence[Array]) -> Seen:
    """The best corrections for simulated modal motions (n, q, m) of several records, weights (n, s) as in the residual."""
    seen = unseen(model, records)
    m, k = model.modes, len(model.inputs)
    held = m * len(seen.keys) == 1   # the gain of the force says the same
    shapes, direct, constant = seen.shapes.copy(), seen.direct.copy(), seen.constant.copy()
    for i, key in enumerate(seen.keys):
        design, target, share = [], [], []
        for r, (record, weight, motion) in enumerate(zip(records, weights, motions, strict=True)):
            for j, c in enumerate(record.channels):
                if key_of(c) != key:
                    continue
                order = quantities(record).index(c.quantity)
                ones = np.zeros((record.n, len(records)))
                ones[:, r] = 1.0
                columns = np.concatenate([motion[:, order], fed(model, record), ones], axis=1)
                design.append(columns * weight[:, j, None])
                target.append((record.response[:, j] - motion[:, order] @ model.rows([c.location])[0]) * weight[:, j])
                share.append(r)
        A, b = np.concatenate(design), np.concatenate(target)
        if held:
            A[:, :m] = 0.0
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        rows = np.zeros((m, A.shape[1]))
        rows[:, :m] = np.diag(_prior(model))
        A, b = np.concatenate([A, rows]) / size, np.concatenate([b, np.zeros(m)])
        with np.errstate(all="ignore"):   # a simulation on its way to infinity
            normal, right = A.T @ A + 1e-10 * np.eye(A.shape[1]), A.T @ b
        if not (np.isfinite(normal).all() and np.isfinite(right).all()):
            continue
        x = np.linalg.solve(normal, right) / size
        shapes[i], direct[i] = (0.0 if held else x[:m]), x[m:m + k]
        constant[i] = float(np.mean(x[m + k:][share]))
    return Seen(seen.keys, shapes, direct, constant)
