"""Matrices for the plant, exported from the solid model, and the virtual tests run on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from studies.virtual_beam import beam, truth
from studies.virtual_beam.beam import SLIP, Array
from studies.virtual_beam.truth import Plant

from bayes_nlsid.structure.modal import ModalModel

FINE = 16384.0   # Hz, step of the plant
RAW = 8192.0     # Hz, rate of the recorder, at which its noise is white


def export(model: ModalModel) -> Plant:
    """Plain arrays from a modal model with residual flexibility."""
    assert model.residual is not None
    at = {name: i for i, name in enumerate(model.locations)}
    joints, sensors, shaker = [at[n] for n in SLIP], [at[n] for n in model.sensors], at[beam.SHAKER]
    G = model.residual
    return Plant(model.omega, model.zeta, model.shapes[joints], model.shapes[sensors], model.shapes[shaker], G[np.ix_(joints, joints)],
                 G[np.ix_(sensors, joints)], G[joints, shaker], G[sensors, shaker])


def true_joints(count: int = len(SLIP)) -> Array:
    """(J, 4)."""
    return np.tile([beam.F_S, beam.K_T, beam.CHI, beam.BETA], (count, 1))


@dataclass(frozen=True)
class Tests:
    """Three virtual tests at ``rate``: 40 N for training, 30 N and 20 N (mode 2) for validation; arrays (n, 3, ...)."""

    rate: float
    acceleration: Array
    force: Array
    tip: Array
    q: Array
    g: Array
    seconds: float      # of shaking
    slip: Array         # (3, J) largest joint displacement over that of macroslip


def sweeps(modes: tuple[float, float], louder: float = 1.0) -> dict[str, tuple[float, float, float]]:
    """Start and end, Hz, amplitude, N, as far around the beam's own frequencies as the paper sweeps around 78.56 and 288.84 Hz."""
    one, two = modes[0] - beam.TABLE_2[0], modes[1] - beam.TABLE_2[1]
    return {"40 N, mode 1": (78.0 + one, 76.5 + one, 40.0 * louder), "30 N, mode 1": (78.0 + one, 76.5 + one, 30.0 * louder),
            "20 N, mode 2": (290.0 + two, 288.0 + two, 20.0 * louder)}


def run(plant: Plant, seconds: float, total: float, rate: float, fine: float = FINE, memory: bool = False, louder: float = 1.0) -> Tests:
    """All three at once, side by side."""
    f = plant.omega[:2] / (2 * np.pi)
    planned = sweeps((float(f[0]), float(f[1])), louder)
    force = np.stack([truth.sweep(a, b, seconds, total, amplitude, fine) for a, b, amplitude in planned.values()], axis=1)
    joint = truth.Joint.of(true_joints())
    law = truth.Memory(joint, 3) if memory else truth.Static(joint, 3)
    motion = truth.integrate(plant, law, force, 1 / fine)
    every = round(fine / rate)
    slip = np.abs(motion.q).max(axis=0) / joint.largest
    acceleration, F, tip, q, g = (truth.decimated(x.reshape(len(force), -1), every).reshape(-1, *x.shape[1:])
                                  for x in (motion.a, force, motion.x[..., -1], motion.q, motion.g))
    return Tests(rate, acceleration, F, tip, q, g, seconds, slip)
