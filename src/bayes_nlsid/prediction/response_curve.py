"""One stepped-sine response curve: what a measurement of it would show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.prediction.harmonics import Basis

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
MARGIN = 1e-4
"""Growth in one period below which a motion still counts as stable: what the computation itself may add."""


@final
@dataclass(frozen=True)
class Curve:
    """Steady responses along one curve, in the order in which it was followed from the lower end of the band.

    Parameters
    ----------
    frequency : ndarray (n,)
        Hz; it turns back where the curve folds.
    locations : tuple of str, length L
        Where elements act, and the location asked for.
    coefficients : ndarray (n, L, C)
        m, of the functions of ``basis``.
    basis : Basis
    level : float
        Amplitude of the force, N.
    status : str
        ``"ok"``: the whole band; else where and why it ends.
    multiplier : ndarray (n,) of complex or None
        The largest Floquet multiplier at each point; None where it is not known (forces with memory, or not asked for).

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    frequency: Array
    locations: tuple[str, ...]
    coefficients: Array
    basis: Basis
    level: float
    status: str
    multiplier: Complex | None = None

    def __post_init__(self) -> None:
        shape = (len(self.frequency), len(self.locations), self.basis.size)
        if self.coefficients.shape != shape:
            raise ValueError(f"curve: coefficients have shape {self.coefficients.shape}, expected {shape}")
        if self.multiplier is not None and self.multiplier.shape != shape[:1]:
            raise ValueError(f"curve: multiplier has shape {self.multiplier.shape}, expected {shape[:1]}")

    @property
    def folded(self) -> NDArray[np.bool_]:
        """Points (n,) at which the curve runs backwards: between two turning points, where no sweep stays."""
        forward = np.diff(self.frequency) > 0
        return ~(np.append(forward, True) | np.insert(forward, 0, True)) if len(forward) else np.zeros(len(self.frequency), dtype=bool)

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Points (n,) where a small disturbance dies out; where multipliers are not known, all but those between turning points."""
        return ~self.folded if self.multiplier is None else np.abs(self.multiplier) <= 1 + MARGIN

    @property
    def lost(self) -> str:
        """How the steady motion that a sweep would meet is lost, at the point where it is lost fastest; "" where it is not."""
        if self.multiplier is None:
            return ""
        suspect = np.flatnonzero(~self.stable & ~self.folded & ~_beside(self.folded))
        if not suspect.size:
            return ""
        worst = self.multiplier[suspect[np.argmax(np.abs(self.multiplier[suspect]))]]
        if abs(worst.imag) > 1e-9 * abs(worst):
            return "a second frequency appears"
        return "the period doubles" if worst.real < 0 else "the motion leaves its symmetry"

    def harmonic(self, location: str, order: int = 1) -> Complex:
        """Complex amplitude (n,) of one harmonic of the displacement, m, relative to the force F cos Ωt."""
        values = self.basis.complex(self.coefficients[:, self.locations.index(location)])
        return values[:, self.basis.orders.index(order)]

    def largest(self, location: str) -> Array:
        """Largest displacement (n,) over the period, m."""
        fine = self.basis.at(np.linspace(0, 2 * np.pi, 512, endpoint=False))
        return np.asarray(np.abs(self.coefficients[:, self.locations.index(location)] @ fine.T).max(axis=1))

    def peak(self, location: str) -> tuple[float, float]:
        """Frequency (Hz) and amplitude (m) where the fundamental is largest, by a parabola along the curve; NaN without points."""
        size = np.abs(self.harmonic(location))
        if not size.size:
            return float("nan"), float("nan")
        i = int(np.argmax(size))
        if not 0 < i < len(size) - 1:
            return float(self.frequency[i]), float(size[i])
        near = slice(i - 1, i + 2)
        f, z = self.frequency[near], self.harmonic(location)[near]
        # length along the curve, of relative motion and of frequency in turn: whichever moves
        gap = np.abs(np.diff(z)) / size[i] + np.abs(np.diff(f)) / f[1]
        along = np.array([-gap[0], 0.0, gap[1]])
        square = np.polyfit(along, size[near] ** 2, 2)
        best = float(np.clip(-square[1] / (2 * square[0]), along[0], along[2])) if square[0] < 0 else 0.0
        return float(np.polyval(np.polyfit(along, f, 2), best)), float(np.sqrt(np.polyval(square, best)))

    def peak_stands(self, location: str) -> bool:
        """Whether a sweep would see the peak: at one of its neighbours at least the motion is stable."""
        i = int(np.argmax(np.abs(self.harmonic(location)))) if len(self.frequency) else 0
        return bool(self.stable[max(i - 1, 0):i + 2].any())

    def swept(self, location: str, frequency: Array, down: bool = False) -> Array:
        """Fundamental amplitude (K,), m, that a slow sweep meets at ascending frequencies (K,), Hz.

        A sweep stays on its branch up to the turning point and jumps there: upwards it meets the first point of the curve at each
        frequency, downwards the last. NaN where the curve does not reach, and where it does but is not stable.
        """
        f, size = self.frequency, np.abs(self.harmonic(location))
        unstable = ~self.stable & ~self.folded if self.multiplier is not None else np.zeros(len(f), dtype=bool)
        if down:
            f, size, unstable = -f[::-1], size[::-1], unstable[::-1]
        ahead = np.maximum.accumulate(f)
        reached = np.flatnonzero(np.diff(ahead, prepend=-np.inf) > 0)
        wanted = -np.asarray(frequency)[::-1] if down else np.asarray(frequency)
        upper = np.searchsorted(ahead[reached], wanted)
        inside = (upper > 0) & (upper < len(reached))
        high = reached[np.clip(upper, 1, len(reached) - 1)] if len(reached) > 1 else np.zeros(len(wanted), dtype=int)
        low = np.maximum(high - 1, 0)
        share = (wanted - f[low]) / np.where(f[high] > f[low], f[high] - f[low], 1.0)
        out = np.where(inside & (high > low) & ~(unstable[low] & unstable[high]), size[low] + share * (size[high] - size[low]), np.nan)
        out = np.where(wanted == f[0], size[0], out)
        return out[::-1] if down else out


def _beside(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Neighbours of marked points."""
    out = np.zeros_like(marked)
    out[1:] |= marked[:-1]
    out[:-1] |= marked[1:]
    return out
