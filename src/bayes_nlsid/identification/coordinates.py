"""Search coordinates of theta: symlog for what can be zero or negative, log10 for what is positive (Eq. 14, Section 2.2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
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

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """(P,) which entries are log10."""
        return self.scale == 0

    def to_s(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Search coordinates (..., P) of theta (..., P); −inf or NaN where a positive entry is not positive."""
        values = np.asarray(theta, dtype=float)
        positive = self.logarithmic
        out = np.empty(values.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            out[..., positive] = np.log10(values[..., positive])
        if not positive.all():
            out[..., ~positive] = symlog.forward(values[..., ~positive], self.scale[~positive])
        return out

    def to_theta(self, s: ArrayLike) -> NDArray[np.float64]:
        """Theta (..., P) of search coordinates (..., P)."""
        values = np.asarray(s, dtype=float)
        positive = self.logarithmic
        out = np.empty(values.shape)
        out[..., positive] = 10.0 ** values[..., positive]
        if not positive.all():
            out[..., ~positive] = symlog.inverse(values[..., ~positive], self.scale[~positive])
        return out

    def log_jacobian(self, s: ArrayLike) -> NDArray[np.float64]:
        """log |dtheta/ds|, (..., P)."""
        values = np.asarray(s, dtype=float)
        positive = self.logarithmic
        out = np.log(LN10) + LN10 * values
        if not positive.all():
            out[..., ~positive] = symlog.log_jacobian(values[..., ~positive], self.scale[~positive])
        return out
