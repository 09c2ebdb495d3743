"""The beam all figures are measured on: ten modes of the paper's Table 2, five four-parameter Iwan joints."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.term import Term
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.model import Element, Model
from bayes_nlsid.structure.modal import ModalData, ModalModel

Array = NDArray[np.float64]
FREQUENCY = np.array([78.56, 288.84, 515.3, 837.91, 1329.66, 1481.95, 1938.58, 2509.94, 2929.71, 4383.22])
JOINT = np.array([2000.0, 1e8, -0.5, 0.1])
JOINTS = tuple(f"J{i + 1}" for i in range(5))
FS, ALPHA, TIP, START = 8192.0, -0.05, 0.86, 4e-3
RATE = 16384.0
"""Hz of the recording that rows 5 to 7 identify."""


def linear() -> ModalModel:
    """A stand-in for the beam of the paper: joint motion grows with frequency, the outer joints move most in mode 1."""
    rng = np.random.default_rng(1)
    shapes = 1.5e-3 * rng.standard_normal((5, 10)) * np.sqrt(FREQUENCY / FREQUENCY[0])
    shapes[:, 0] = np.array([1.1, 0.75, 0.25, 0.7, 1.05]) * 1e-2
    tip = np.zeros((1, 10))
    tip[0, 0] = TIP
    return ModalModel(2 * np.pi * FREQUENCY, np.full(10, 1e-3), (*JOINTS, "tip"), np.concatenate([shapes, tip]), ("tip",), (), JOINTS)


def beam(term: Term) -> Model:
    """The beam with one term at every joint."""
    return Model(linear(), (Element(term, JOINTS),))


def scattered(count: int, spread: float = 0.05) -> Array:
    """Parameters (count, 20) around the truth."""
    return np.tile(JOINT, 5) * (1 + spread * np.random.default_rng(0).standard_normal((count, 20)))


def released() -> Array:
    """Modal displacement (10,) with 4 mm at the tip."""
    u0 = np.zeros(10)
    u0[0] = START / TIP
    return u0


def recording(samples: int, seed: int = 0) -> ModalData:
    """A smooth motion of all ten modes, exact in all derivatives, and the modal forces that make it a solution, with 1 % of white noise.

    The outer joints reach macroslip now and then. The Iwan force is written anew here.
    """
    rng = np.random.default_rng(seed)
    model, t = linear(), np.arange(samples) / RATE
    u, v, a = (np.zeros((samples, 10)) for _ in range(3))
    envelope = 2 * np.pi * 1.3 * t[-1] ** -1
    for k, w in enumerate(model.omega):
        for share, factor in ((1.0, 0.985), (0.6, 1.011)):
            phase, size = rng.uniform(0, 2 * np.pi), share * 3.9e-3 * (FREQUENCY[0] / FREQUENCY[k]) ** 1.5
            for turn, part in ((0.0, 0.6), (envelope, 0.2), (-envelope, 0.2)):
                rate = w * factor + turn
                u[:, k] += size * part * np.sin(rate * t + phase)
                v[:, k] += size * part * rate * np.cos(rate * t + phase)
                a[:, k] -= size * part * rate**2 * np.sin(rate * t + phase)
    rows = model.rows(JOINTS)
    q, qd = u @ rows.T, v @ rows.T
    f_s, k_t, chi, beta = JOINT
    phi = f_s * (1 + beta) / (k_t * (beta + (chi + 1) / (chi + 2)))
    slip = np.minimum(np.abs(q) / phi, 1.0)
    joint = np.where(np.abs(q) < phi, k_t * q * (1 - slip ** (chi + 1) / ((1 + beta) * (chi + 2))), f_s * np.sign(q)) - k_t * q
    force = a + 2 * model.zeta * model.omega * v + model.omega**2 * u + joint @ rows
    force += 0.01 * np.std(joint @ rows, axis=0) * rng.standard_normal(force.shape)
    return ModalData("run", 1 / RATE, tuple(range(10)), u, v, a, force, JOINTS, q, qd, slice(0, samples), (20.0, 0.45 * RATE), np.zeros(10))


def problem(data: ModalData, elements: Sequence[Element] = (), places: int = 128, free: bool = False) -> Problem:
    """All ten equations (scenario S3) on one recording."""
    model = Model(linear(), tuple(elements), tuple(range(10)) if free else ())
    return Problem(model, (data,), scenario("S3", 10, 0), places=places)


def joints(name: str) -> Element:
    """One term at all joints, each with its own parameters."""
    return Element(LIBRARY[name], JOINTS)


def seconds(run: Callable[[], object], rounds: int = 1) -> float:
    """CPU time of this thread, s; with several rounds the smallest of them, after one to warm up."""
    times = []
    for i in range(rounds + (rounds > 1)):
        start = time.thread_time()
        run()
        if i or rounds == 1:
            times.append(time.thread_time() - start)
    return min(times)


@final
@dataclass(frozen=True)
class Row:
    """One line of the results: number in the table of aims, what, the aim, what was measured; ``met`` is None where there is no aim."""

    number: str
    what: str
    aim: str
    measured: str
    met: bool | None = None


def quick(value: float) -> str:
    """A time in the unit that fits."""
    scale, unit = next(((k, u) for k, u in ((1, "s"), (1e-3, "ms"), (1e-6, "µs")) if abs(value) >= k), (1e-9, "ns"))
    return f"{value / scale:.3g} {unit}"
