"""What a simulation returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.simulation.schemes import SchemeName

Array = NDArray[np.float64]


@final
@dataclass(frozen=True)
class Response:
    """Motion at named locations for a batch of samples of theta.

    Parameters
    ----------
    dt : float
        Time between stored instants, s; the first is t = 0.
    locations : tuple of str, length L
    displacement, velocity, acceleration : ndarray (S, n, L)
        m, m/s, m/s²; n = 0 for a quantity that was not asked for. Accelerations fulfil the equation of motion at each instant. NaN from the
        instant at which a sample diverged.
    status : ndarray of str (S,)
        ``"ok"``; ``"newton"``: the joint forces of at least one step did not converge; ``"diverged"``: the motion left all bounds.
    iterations : ndarray of int (S,)
        Newton iterations beyond the one evaluation that every step takes.
    unconverged : ndarray of int (S,)
        Steps whose joint forces did not converge.
    scheme : {"hht", "exponential"}
    period_error, false_damping : ndarray (m,)
        What the step does to the linear modes of the first sample: relative error of the period, damping ratio added.
    final_displacement, final_velocity : ndarray (S, m)
        Modal state at the last instant; with memory terms it is not the whole state.
    compiled : bool
        Whether the compiled loop ran.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    dt: float
    locations: tuple[str, ...]
    displacement: Array
    velocity: Array
    acceleration: Array
    status: NDArray[np.str_]
    iterations: NDArray[np.int64]
    unconverged: NDArray[np.int64]
    scheme: SchemeName
    period_error: Array
    false_damping: Array
    final_displacement: Array
    final_velocity: Array
    compiled: bool = False

    def __post_init__(self) -> None:
        for name in ("displacement", "velocity", "acceleration"):
            shape = getattr(self, name).shape
            if len(shape) != 3 or shape[0] != len(self.status) or shape[2] != len(self.locations):
                raise ValueError(f"response: {name} has shape {shape}, expected ({len(self.status)}, n, {len(self.locations)})")

    @property
    def n(self) -> int:
        """Number of stored instants."""
        return max(a.shape[1] for a in (self.displacement, self.velocity, self.acceleration))

    @property
    def time(self) -> Array:
        """(n,) s."""
        return np.asarray(self.dt * np.arange(self.n), dtype=float)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(S,) which samples can be used."""
        return np.asarray(self.status == "ok")

    def at(self, location: str, quantity: str = "displacement") -> Array:
        """One location (S, n).

        Raises
        ------
        ValueError
            If the location or the quantity was not kept.
        """
        if location not in self.locations:
            raise ValueError(f"response holds locations {self.locations}, not {location!r}")
        array = getattr(self, quantity) if quantity in ("displacement", "velocity", "acceleration") else None
        if array is None or array.shape[1] == 0:
            raise ValueError(f"response does not hold {quantity!r}; ask for it with simulate(..., store=(...))")
        return np.asarray(array[:, :, self.locations.index(location)])
