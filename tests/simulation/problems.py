"""Models that the tests of this room share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.model import Element, Model
from bayes_nlsid.structure.modal import ModalModel


def oscillator(term: str | None = None, *, frequency: float = 10.0, zeta: float = 0.01, free: bool = False, excess: bool = True) -> Model:
    """Unit mass with one element."""
    linear = ModalModel(np.array([2 * np.pi * frequency]), np.array([zeta]), ("x",), np.ones((1, 1)), ("x",), ("x",), ("x",))
    elements = () if term is None else (Element(LIBRARY[term], ("x",), excess=excess),)
    return Model(linear, elements, (0,) if free else ())


def beam(*terms: str, free: tuple[int, ...] = ()) -> Model:
    """Three modes, two joints, a tip, a shaker point."""
    omega = 2 * np.pi * np.array([20.0, 57.0, 101.0])
    shapes = np.array([[0.02, -0.031, 0.04], [0.013, 0.029, 0.05], [0.9, -0.8, 0.7], [0.4, 0.6, -0.3]])
    linear = ModalModel(omega, np.array([0.004, 0.006, 0.01]), ("J1", "J2", "tip", "shaker"), shapes, ("tip",), ("shaker",), ("J1", "J2"))
    return Model(linear, tuple(Element(LIBRARY[t], ("J1", "J2")) for t in terms), free)


IWAN = np.tile([60.0, 1e6, -0.5, 0.3], 2)


def scattered(centre: NDArray[np.float64], count: int, spread: float = 0.05) -> NDArray[np.float64]:
    """(count, P) around a centre."""
    return centre * (1 + spread * np.random.default_rng(5).uniform(-1, 1, (count, len(centre))))
