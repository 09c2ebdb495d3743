"""Frequency and damping against amplitude, from one decaying signal: the backbone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray


@final
@dataclass(frozen=True)
class Backbone:
    """Frequency and damping against amplitude.

    Parameters
    ----------
    amplitude : ndarray (K,)
        m, ascending.
    frequency : ndarray (..., K)
        Hz; NaN where the decay never passed that amplitude.
    damping : ndarray (..., K)
        Ratio.
    location : str
    status : str
        ``"ok"``, or what was found wrong.
    """

    amplitude: NDArray[np.float64]
    frequency: NDArray[np.float64]
    damping: NDArray[np.float64]
    location: str = ""
    status: str = "ok"

    def __post_init__(self) -> None:
        count = len(self.amplitude)
        for name in ("frequency", "damping"):
            if getattr(self, name).shape[-1:] != (count,):
                raise ValueError(f"backbone: {name} has shape {getattr(self, name).shape}, its last axis must be {count}")
