"""One test run in SI units with named channels."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

Quantity = Literal["acceleration", "velocity", "displacement", "force"]
Role = Literal["train", "holdout", "noise", "linear"]
LEAST_REPEATED = 32
"""Samples of a repeated stretch from which a noise level may be taken."""
SI_UNIT = {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m", "force": "N"}


@final
@dataclass(frozen=True)
class Channel:
    """One measured signal.

    Parameters
    ----------
    name : str
        As the test engineer calls it.
    location : str
        The location of the model it measures (or drives, for a force).
    quantity : {"acceleration", "velocity", "displacement", "force"}
    unit : str
        Unit in the file, before conversion (kept for the report).
    polarity : {1, -1}
        −1 where the sensor is known to be mounted the other way round; already applied to the samples.
    """

    name: str
    location: str
    quantity: Quantity
    unit: str
    polarity: int = 1

    def __post_init__(self) -> None:
        if self.quantity not in SI_UNIT:
            raise ValueError(f"channel {self.name!r}: quantity must be one of {sorted(SI_UNIT)}, not {self.quantity!r}")
        if self.polarity not in (1, -1):
            raise ValueError(f"channel {self.name!r}: polarity must be 1 or -1, not {self.polarity!r}")


@final
@dataclass(frozen=True)
class Recording:
    """One test run: responses and, where measured, forces, in SI, one common clock.

    Parameters
    ----------
    name : str
    dt : float
        Time step, s.
    response : ndarray (n, s)
        m/s², m/s or m by channel.
    channels : tuple of Channel, length s
    force : ndarray (n, k)
        N; (n, 0) where none was measured.
    inputs : tuple of Channel, length k
    role : {"train", "holdout", "noise", "linear"}
        ``noise``: excitation off. ``linear``: low level, for modes only.
    period : int or None
        Samples per period, if the recording is a whole number of steady periods. With role ``noise``: what repeats after so many samples
        differs by noise alone.
    start : float
        When it was taken on the test day, s.
    source, sha256 : str
        File and the hash of its bytes.

    Raises
    ------
    ValueError
        If shapes disagree, the time step is not positive, or anything is not finite.
    """

    name: str
    dt: float
    response: NDArray[np.float64]
    channels: tuple[Channel, ...]
    force: NDArray[np.float64]
    inputs: tuple[Channel, ...] = ()
    role: Role = "train"
    period: int | None = None
    start: float = 0.0
    source: str = ""
    sha256: str = ""
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"recording {self.name!r}: dt must be positive, got {self.dt}")
        if self.response.ndim != 2 or self.response.shape[1] != len(self.channels):
            raise ValueError(f"recording {self.name!r}: response has shape {self.response.shape}, expected (n, {len(self.channels)})")
        if self.force.shape != (self.n, len(self.inputs)):
            raise ValueError(f"recording {self.name!r}: force has shape {self.force.shape}, expected {(self.n, len(self.inputs))}")
        if self.role not in ("train", "holdout", "noise", "linear"):
            raise ValueError(f"recording {self.name!r}: unknown role {self.role!r}")
        for array, what in ((self.response, "response"), (self.force, "force")):
            if not np.isfinite(array).all():
                raise ValueError(f"recording {self.name!r}: {what} holds NaN or infinite samples")
        if self.period is not None and self.role == "noise":
            if self.n < self.period + LEAST_REPEATED:
                raise ValueError(f"recording {self.name!r}: {self.n} samples hold no {LEAST_REPEATED} that repeat after {self.period}")
        elif self.period is not None and (self.period < 2 or self.n % self.period):
            raise ValueError(f"recording {self.name!r}: {self.n} samples are not a whole number of periods of {self.period}")

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.response.shape[0])

    @property
    def fs(self) -> float:
        """Sampling rate, Hz."""
        return 1.0 / self.dt

    @property
    def time(self) -> NDArray[np.float64]:
        """(n,) s from the first sample."""
        return np.asarray(self.dt * np.arange(self.n), dtype=float)

    @property
    def free(self) -> bool:
        """Whether no force was measured: a free decay, or an unknown input."""
        return len(self.inputs) == 0

    def window(self, start: float, stop: float) -> Recording:
        """The part from ``start`` to ``stop`` (s from the first sample); the period is dropped unless it still divides it.

        Raises
        ------
        ValueError
            If the window holds fewer than two samples.
        """
        i, j = max(0, round(start / self.dt)), min(self.n, round(stop / self.dt))
        if j - i < 2:
            raise ValueError(f"recording {self.name!r}: window {start}–{stop} s holds no samples (record is {self.n * self.dt:g} s long)")
        period = self.period if self.period and (j - i) % self.period == 0 else None
        return replace(self, response=self.response[i:j], force=self.force[i:j], start=self.start + i * self.dt, period=period)
