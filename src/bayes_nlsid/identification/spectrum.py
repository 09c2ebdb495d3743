"""The in-band Fourier transform in which every residual is measured."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray


def fast_length(n: int) -> int:
    """Largest number of samples up to ``n`` without prime factors above 5, for which the transform is quick.

    Raises
    ------
    ValueError
        If n is below 1.
    """
    for m in range(n, 0, -1):
        rest = m
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return m
    raise ValueError(f"n must be at least 1, got {n}")


def tukey(n: int, fraction: float) -> NDArray[np.float64]:
    """Cosine taper (n,) over ``fraction`` of the samples (half at each end), scaled to unit mean square.

    Raises
    ------
    ValueError
        If the fraction does not lie in [0, 1].
    """
    if not 0 <= fraction <= 1:
        raise ValueError(f"taper fraction must lie in [0, 1], got {fraction}")
    edge = fraction * n / 2
    position = np.arange(n) + 0.5
    distance = np.minimum(position, n - position)
    taper = np.ones(n)
    rising = distance < edge
    taper[rising] = 0.5 * (1 - np.cos(np.pi * distance[rising] / edge))
    return taper / np.sqrt(np.mean(taper**2))


@final
@dataclass(frozen=True, eq=False)
class Spectrum:
    """Real in-band DFT of the trusted samples of one recording.

    A transient is multiplied by a cosine taper: the residual is only meant inside the band, and without a taper the large residual
    below it (integration drift) would leak in through the jump between last and first sample. Steady periods need none. The transform is
    orthonormal and the taper has unit mean square, so that over the whole band the sum of squares is that of the tapered samples, and
    sum of squares / n estimates the in-band mean square.

    Taking only in-band bins is also the band-pass that the data went through: motion and force were band-passed before they came here,
    the nonlinear force of a band-passed motion is not band-limited (it has harmonics), so it must lose the same bins before it can
    balance them.

    Parameters
    ----------
    n : int
        Samples of the recording.
    dt : float
        s.
    valid : slice
        Trusted samples.
    band : tuple of float
        (low, high), Hz, both ends included.
    periodic : bool
        Whole steady periods: no taper.
    taper : float
        Fraction of the samples under the cosine edges.

    Raises
    ------
    ValueError
        If fewer than 16 samples are valid or fewer than 2 frequencies lie inside the band.
    """

    n: int
    dt: float
    valid: slice
    band: tuple[float, float]
    periodic: bool = False
    taper: float = 0.1
    start: int = field(init=False)
    count: int = field(init=False)
    frequency: NDArray[np.float64] = field(init=False, repr=False)
    window: NDArray[np.float64] = field(init=False, repr=False)
    _first: int = field(init=False, repr=False)
    _factor: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        start, stop, step = self.valid.indices(self.n)
        if step != 1 or stop - start < 16:
            raise ValueError(f"valid samples {self.valid} of {self.n}: at least 16 consecutive samples are needed")
        count = stop - start if self.periodic else fast_length(stop - start)
        frequencies = np.fft.rfftfreq(count, self.dt)
        tiny = 1e-9 / self.dt
        inside = np.flatnonzero((frequencies >= self.band[0] - tiny) & (frequencies <= self.band[1] + tiny))
        if len(inside) < 2:
            raise ValueError(f"band {self.band} Hz holds {len(inside)} frequencies of a record of {count * self.dt:g} s; widen it or "
                             f"use a longer record")
        frequency = frequencies[inside]
        # The zero and Nyquist bins have no mirror image, all others stand for two.
        single = (inside == 0) | ((count % 2 == 0) & (inside == count // 2))
        for name, value in (("start", start), ("count", count), ("frequency", frequency), ("_first", int(inside[0])),
                            ("window", np.ones(count) if self.periodic else tukey(count, self.taper)),
                            ("_factor", np.where(single, 1.0, np.sqrt(2.0)) / np.sqrt(count))):
            object.__setattr__(self, name, value)

    @property
    def bins(self) -> int:
        """Number of in-band frequencies; the transform has twice as many real entries."""
        return len(self.frequency)

    @property
    def samples(self) -> slice:
        """Samples that enter, a contiguous part of ``valid``."""
        return slice(self.start, self.start + self.count)

    @property
    def information(self) -> float:
        """Share of independent information left by the taper, (Σw²)²/(n Σw⁴): 1 without taper, 0.95 for the default."""
        return float(np.mean(self.window**2) ** 2 / np.mean(self.window**4))

    def apply(self, samples: ArrayLike) -> NDArray[np.float64]:
        """Transform (..., n) of the whole recording, or (..., count) of the samples that enter, to (..., 2 bins): real parts, then
        imaginary.

        Raises
        ------
        ValueError
            If the last axis has another length.
        """
        values = np.asarray(samples, dtype=float)
        if values.shape[-1] == self.n and self.n != self.count:
            values = values[..., self.samples]
        if values.shape[-1] != self.count:
            raise ValueError(f"samples have shape {values.shape}, the last axis must be {self.n} or {self.count}")
        transform = np.fft.rfft(values * self.window, axis=-1)[..., self._first:self._first + self.bins] * self._factor
        return np.concatenate([transform.real, transform.imag], axis=-1)
