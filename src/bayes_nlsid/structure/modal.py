"""Waist 1: what identification knows of a structure, and what virtual sensing makes of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

ASSUMED = 1.0
"""Relative standard deviation of a damping ratio that is no more than a guess."""


@final
@dataclass(frozen=True)
class ModalModel:
    """Linear modes and the named locations seen by them (Eq. 9–11).

    Parameters
    ----------
    omega : ndarray (m,)
        Undamped natural frequencies, rad/s, ascending, all positive (rigid-body modes removed, Eq. 15–18).
    zeta : ndarray (m,)
        Modal damping ratios.
    locations : tuple of str, length L
    shapes : ndarray (L, m)
        Row ``b_l`` of each location in mass-normalised modal coordinates, kg^-1/2 (times m/m, or rad/m for rotations).
    sensors, inputs, joints : tuple of str
        Which locations carry sensors, take measured forces, are suspected of nonlinearity.
    omega_sd, zeta_sd : ndarray (m,)
        How well they are known (one standard deviation, relative); 0 where not stated, `ASSUMED` or more where the value is a guess.
    residual : ndarray (L, L) or None
        Static flexibility m/N between locations of everything outside the modes kept.
    notes : tuple of str
        What was done and what it cost (frequency errors, joint flexibility lost), for the report.

    Raises
    ------
    ValueError
        If shapes disagree, frequencies are not positive and ascending, or a name is unknown or repeated.
    """

    omega: NDArray[np.float64]
    zeta: NDArray[np.float64]
    locations: tuple[str, ...]
    shapes: NDArray[np.float64]
    sensors: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    omega_sd: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    zeta_sd: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    residual: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        m, count = len(self.omega), len(self.locations)
        if self.omega.shape != (m,) or self.zeta.shape != (m,) or m == 0:
            raise ValueError(f"omega {self.omega.shape} and zeta {self.zeta.shape} must both be (m,), m > 0")
        if self.shapes.shape != (count, m):
            raise ValueError(f"shapes has shape {self.shapes.shape}, expected {(count, m)}")
        if not (np.isfinite(self.omega).all() and np.isfinite(self.zeta).all() and np.isfinite(self.shapes).all()):
            raise ValueError("omega, zeta and shapes must be finite")
        if (self.omega <= 0).any() or (np.diff(self.omega) < 0).any():
            raise ValueError("omega must be positive and ascending; remove rigid-body modes first")
        if len(set(self.locations)) != count:
            raise ValueError(f"location names repeat: {sorted(self.locations)}")
        for role in ("sensors", "inputs", "joints"):
            unknown = set(getattr(self, role)) - set(self.locations)
            if unknown:
                raise ValueError(f"{role} name unknown locations {sorted(unknown)}; known are {sorted(self.locations)}")
        for name in ("omega_sd", "zeta_sd"):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.zeros(m))
            if getattr(self, name).shape != (m,):
                raise ValueError(f"{name} must have shape {(m,)}")
        if self.residual is not None and self.residual.shape != (count, count):
            raise ValueError(f"residual has shape {self.residual.shape}, expected {(count, count)}")

    @property
    def modes(self) -> int:
        """Number of modes m."""
        return len(self.omega)

    @property
    def frequency(self) -> NDArray[np.float64]:
        """(m,) Hz."""
        return self.omega / (2 * np.pi)

    def rows(self, names: tuple[str, ...] | list[str]) -> NDArray[np.float64]:
        """Rows (len(names), m) of the named locations.

        Raises
        ------
        ValueError
            If a name is unknown.
        """
        unknown = [n for n in names if n not in self.locations]
        if unknown:
            raise ValueError(f"unknown locations {unknown}; known are {list(self.locations)}")
        return self.shapes[[self.locations.index(n) for n in names]]

    def take(self, modes: ArrayLike) -> ModalModel:
        """The same structure with only some of its modes (0-based indices)."""
        i = np.asarray(modes, dtype=int)
        return replace(self, omega=self.omega[i], zeta=self.zeta[i], shapes=self.shapes[:, i],
                       omega_sd=self.omega_sd[i], zeta_sd=self.zeta_sd[i])


@final
@dataclass(frozen=True)
class ModalData:
    """A recording in modal coordinates with the motion of every joint (Eq. 11–12): all that the residual of Eq. 13 needs.

    Parameters
    ----------
    name : str
        Of the recording.
    dt : float
        Time step, s.
    modes : tuple of int
        0-based indices of the modes of the ``ModalModel`` that were observed.
    u, v, a : ndarray (n, len(modes))
        Modal displacement, velocity, acceleration; kg^1/2 m, /s, /s².
    force : ndarray (n, len(modes))
        Modal force φᵀF; zero for a free decay.
    locations : tuple of str
        Joints.
    q, qd : ndarray (n, len(locations))
        Relative displacement and velocity there, from all observed modes, m, m/s.
    valid : slice
        Samples free of edge effects of filters; only these enter a residual. Memory terms see all samples.
    band : tuple of float
        (low, high) Hz in which all of it is to be trusted.
    noise : ndarray (len(modes),)
        One-sided power spectral density of the noise of ``a``, per mode, averaged over the band, (kg^1/2 m/s²)²/Hz.
    colour : ndarray (3, len(modes)), optional
        Shape of that noise over frequency, relative to ``noise``: coefficients (s^4, s², 1) of ω⁴, ω² and 1, the parts that are white as
        displacement, as velocity and as acceleration; white as acceleration if omitted.
    condition : float
        Condition number of the modal filter.
    periodic : bool
        Whether the samples are whole steady periods.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    name: str
    dt: float
    modes: tuple[int, ...]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    a: NDArray[np.float64]
    force: NDArray[np.float64]
    locations: tuple[str, ...]
    q: NDArray[np.float64]
    qd: NDArray[np.float64]
    valid: slice
    band: tuple[float, float]
    noise: NDArray[np.float64]
    condition: float = 1.0
    periodic: bool = False
    colour: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not self.colour.size:
            object.__setattr__(self, "colour", np.repeat([[0.0], [0.0], [1.0]], len(self.noise), axis=1))
        n, m, r = len(self.u), len(self.modes), len(self.locations)
        for name, shape in (("u", (n, m)), ("v", (n, m)), ("a", (n, m)), ("force", (n, m)), ("q", (n, r)), ("qd", (n, r)),
                            ("noise", (m,)), ("colour", (3, m))):
            if getattr(self, name).shape != shape:
                raise ValueError(f"modal data {self.name!r}: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if not 0 < self.band[0] < self.band[1] <= 0.5 / self.dt * (1 + 1e-9):
            raise ValueError(f"modal data {self.name!r}: band {self.band} Hz must lie below the Nyquist frequency {0.5 / self.dt:g} Hz")

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.u)

    def noise_density(self, mode: int, frequency: ArrayLike) -> NDArray[np.float64]:
        """One-sided density (...), (kg^1/2 m/s²)²/Hz, of the noise of the acceleration of a mode (by its index in the model), Hz."""
        w2 = (2 * np.pi * np.asarray(frequency, dtype=float)) ** 2
        i = self.modes.index(mode)
        displacement, velocity, acceleration = self.colour[:, i]
        return np.asarray(self.noise[i] * (acceleration + w2 * (velocity + w2 * displacement)), dtype=float)
