"""Modes identified from low-level recordings, and which mode of a model each of them is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.structure.modal import ModalModel

if TYPE_CHECKING:
    from bayes_nlsid.structure.structure import Modes

FARTHEST = 0.3
"""Largest log-ratio of frequencies between a measured mode and the model mode it is paired with."""


@final
@dataclass(frozen=True)
class IdentifiedModes:
    """Frequencies, damping and shapes seen by the sensors, with their uncertainty.

    Parameters
    ----------
    frequency : ndarray (m,)
        Undamped natural frequency, Hz, ascending.
    zeta : ndarray (m,)
        Damping ratio.
    shapes : ndarray (s, m)
        Real displacement shapes, the largest entry of each being 1; with a measured force (``signed``) it is ±1, and the sign is that
        of sensor motion times motion at the force.
    channels, locations : tuple of str, length s
    nominal : tuple of int, length m
        0-based mode of the nominal model that was looked for.
    frequency_sd, zeta_sd : ndarray (m,)
        One standard deviation, Hz and absolute.
    shapes_sd : ndarray (s, m)
    phase_scatter : ndarray (m,)
        rms angle of the complex shape from its straight line, rad, weighted by amplitude; large values: not one real mode.
    amplitude : ndarray (m,)
        Displacement of the largest channel where the fit begins (free decay: start of the window), m: identified modes hold below it.
    window : tuple of (float, float), length m
        Part of the recording used for each mode, s.
    status : tuple of str, length m
        ``"ok"``, or what to beware of.
    signed : bool
        Whether a measured force fixed the sign of the shapes.
    notes : tuple of str
        Modes looked for in vain, and choices made.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    frequency: NDArray[np.float64]
    zeta: NDArray[np.float64]
    shapes: NDArray[np.float64]
    channels: tuple[str, ...]
    locations: tuple[str, ...]
    nominal: tuple[int, ...]
    frequency_sd: NDArray[np.float64]
    zeta_sd: NDArray[np.float64]
    shapes_sd: NDArray[np.float64]
    phase_scatter: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    window: tuple[tuple[float, float], ...]
    status: tuple[str, ...]
    signed: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        m, s = len(self.frequency), len(self.channels)
        for name in ("zeta", "frequency_sd", "zeta_sd", "phase_scatter", "amplitude"):
            if getattr(self, name).shape != (m,):
                raise ValueError(f"identified modes: {name} has shape {getattr(self, name).shape}, expected {(m,)}")
        for name in ("shapes", "shapes_sd"):
            if getattr(self, name).shape != (s, m):
                raise ValueError(f"identified modes: {name} has shape {getattr(self, name).shape}, expected {(s, m)}")
        if len(self.locations) != s or len(self.nominal) != m or len(self.window) != m or len(self.status) != m:
            raise ValueError(f"identified modes: expected {s} locations and {m} nominal modes, windows and statuses")

    @property
    def modes(self) -> int:
        """Number of modes m."""
        return len(self.frequency)


def pair(measured: IdentifiedModes, model: ModalModel) -> tuple[tuple[int, int], ...]:
    """Pairs (measured mode, model mode), by likeness of frequency and shape together.

    Neither alone suffices: a few sensors see several modes alike, and joints shift frequencies past each other.

    Parameters
    ----------
    measured : IdentifiedModes
    model : ModalModel
        Knows the locations of the channels.
    """
    return pair_rows(measured, model.omega, model.rows(measured.locations))


def pair_modes(measured: IdentifiedModes, found: Modes, rows: NDArray[np.float64]) -> tuple[tuple[int, int], ...]:
    """The same for full-order modes and the rows (s, N) of the sensors."""
    return pair_rows(measured, found.omega, rows @ found.shapes)


def pair_rows(measured: IdentifiedModes, omega: NDArray[np.float64], shapes: NDArray[np.float64]) -> tuple[tuple[int, int], ...]:
    """The same for frequencies (m,), rad/s, and shapes at the sensors (s, m)."""
    from scipy.optimize import linear_sum_assignment

    from bayes_nlsid.structure.structure import mac

    apart = np.abs(np.log(2 * np.pi * measured.frequency[:, None] / omega))
    cost = np.minimum(apart, 10.0) / 0.1 + 1 - mac(measured.shapes, shapes)
    first, second = linear_sum_assignment(cost)
    return tuple((int(i), int(k)) for i, k in zip(first, second, strict=True) if apart[i, k] <= FARTHEST)
