"""Search coordinates of theta: symlog for what can be zero or negative, log10 for what is positive (Eq. 14, Section 2.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid import symlog

LN10 = float(np.log(10.0))


@final
@dataclass(frozen=True, eq=False)
class Coordinates:
    """Map between theta and s, entry by entry.

    Parameters
    ----------
    scale : ndarray (P,)
        Symlog constant c of each entry, in its unit; 0 marks a positive entry, for which s = log10 theta.

    Raises
    ------
    ValueError
        If a scale is negative or not finite.
    """

    scale: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.scale.ndim != 1 or not np.isfinite(self.scale).all() or (self.scale < 0).any():
            raise ValueError(f"scale must be (P,), finite and not negative (0 means logarithmic), got {self.scale}")

    @property
    def logarithmic(self) -> NDArray[np.bool_]:
        """(P,) which entries are log10."""
        return self.scale == 0

    def to_s(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Search coordinates (..., P) of theta (..., P); −inf or NaN where a positive entry is not positive."""
        values = np.asarray(theta, dtype=float)
        positive = self.logarithmic
        with np.errstate(divide="ignore", invalid="ignore"):
            log = np.log10(np.where(positive, values, 1.0))
        return np.where(positive, log, symlog.forward(values, np.where(positive, 1.0, self.scale)))

    def to_theta(self, s: ArrayLike) -> NDArray[np.float64]:
        """Theta (..., P) of search coordinates (..., P)."""
        values = np.asarray(s, dtype=float)
        positive = self.logarithmic
        power = 10.0 ** np.where(positive, values, 0.0)
        return np.where(positive, power, symlog.inverse(np.where(positive, 0.0, values), np.where(positive, 1.0, self.scale)))

    def log_jacobian(self, s: ArrayLike) -> NDArray[np.float64]:
        """log |dtheta/ds|, (..., P)."""
        values = np.asarray(s, dtype=float)
        positive = self.logarithmic
        signed = symlog.log_jacobian(np.where(positive, 0.0, values), np.where(positive, 1.0, self.scale))
        return np.where(positive, np.log(LN10) + LN10 * values, signed)
