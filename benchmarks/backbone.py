"""Row 4: bands of the backbone by harmonic balance and averaging, against a fine time integration."""

from __future__ import annotations

import numpy as np

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.model import Element, Model
from bayes_nlsid.prediction.bands import backbone_bands
from bayes_nlsid.prediction.fast import fast_bands
from bayes_nlsid.structure.modal import ModalModel
from benchmarks.case import START, Row, beam, quick, scattered, seconds

GRID = np.geomspace(4e-4, 3.5e-3, 12)
FINE = 65536.0   # Hz
FREQUENCY, DAMPING = 0.003, 0.03   # aims: Hz; share


def rows() -> list[Row]:
    """Time of 1,000 samples, distance to a fine integration, refusal where modes interact."""
    out = []
    for what, name, most in (("static", "iwan4", 0.3), ("with memory", "iwan4_memory", 1.0)):
        model = beam(LIBRARY[name])
        time = seconds(lambda model=model: fast_bands(scattered(1000), model, at="tip", start_amplitude=START), 2)  # type: ignore[misc]
        out.append(Row("4", f"backbone band of 1,000 samples, {what}", f"{most:g} s", quick(time), time <= most))
        out.append(_distance(model, what))
    return [*out, _refusal()]


def _distance(model: Model, what: str) -> Row:
    theta = scattered(6)
    fine = backbone_bands(theta, model, at="tip", start_amplitude=START, amplitudes=GRID, fs=FINE, scheme="exponential")
    fast = fast_bands(theta, model, at="tip", start_amplitude=START, amplitudes=GRID)
    frequency = float(np.nanmax(np.abs(fast.samples_frequency - fine.samples_frequency)))
    damping = float(np.nanmax(np.abs(fast.samples_damping / fine.samples_damping - 1)))
    return Row("4", f"its distance to the exponential step at 65,536 Hz, {what}, largest", "0.003 Hz; 3 % of damping",
               f"{frequency:.2g} Hz; {100 * damping:.2g} %", frequency <= FREQUENCY and damping <= DAMPING)


def _refusal() -> Row:
    """Two modes at 1 : 3.03 on one cubic spring: the third harmonic drives the second mode; a weak spring does not."""
    linear = ModalModel(2 * np.pi * np.array([10.0, 30.3]), np.full(2, 1e-3), ("x",), np.ones((1, 2)), ("x",), (), ("x",))
    status = fast_bands([[2e5], [1.0]], Model(linear, (Element(LIBRARY["cubic"], ("x",)),)), at="x", start_amplitude=0.1).status
    return Row("4", "two modes that exchange energy, beside the same with a weak spring", "refuses the first", str(status),
               status == {"modes interact": 1, "ok": 1})
