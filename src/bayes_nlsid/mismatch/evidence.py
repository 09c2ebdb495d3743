"""What a free linear system cannot explain, and the transfer function it leaves.

For every line and channel the transfer function is free: Ĥ = Σ c F* Y / Σ c |F|² over records; what remains of the response, and of every
candidate, is their projected part. A candidate is therefore judged twice, and independently: on the projected residual of the records
(no linear model enters its size) and on the transfer function it leaves for the calibrated model to explain. Both are parts of one sum
of squares, so their −2 log likelihoods add.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.spectra import Spectra, local_mean

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
STRONG = 1.5   # chi² of the projected residual over its expectation
CANDIDATE_ERROR = 0.05  # relative error of the paths from a place to the sensors, granted to every candidate


@final
@dataclass(frozen=True)
class Evidence:
    """Projected residuals and transfer function of one group of records.

    Parameters
    ----------
    spectra : Spectra
    trust : ndarray (R,)
        Relative weight of each record (its number of periods).
    weight : ndarray (L, S)
        Inverse variance of a projected residual of a record of weight 1.
    residual : ndarray complex (R, L, S)
        Projected responses; whole responses on lines without force.
    H : ndarray complex (Le, S), variance : ndarray (Le, S)
        Free transfer function on excited lines; its variance from noise and from what is not linear.
    statistic : float
        Mean squared projected residual over its noise expectation on excited lines (1 for a linear system); NaN with one record.
    odd, even : float
        The same on odd and even lines of the band without force; NaN if there are none.
    by_record : ndarray (R,)
        The same for each record alone.
    """

    spectra: Spectra
    trust: Array
    weight: Array
    residual: Complex
    H: Complex
    variance: Array
    statistic: float
    odd: float
    even: float
    by_record: Array

    @property
    def excited(self) -> NDArray[np.bool_]:
        """(L,)."""
        return self.spectra.excited

    @cached_property
    def chi2(self) -> float:
        """−2 log likelihood of the projected residual with nothing but noise."""
        return float(2 * np.einsum("r,ls,rls->", self.trust, self.weight, np.abs(self.residual) ** 2))

    @property
    def values(self) -> int:
        """Real degrees of freedom behind ``chi2``."""
        records, lines, channels = self.residual.shape
        return 2 * channels * (int(self.excited.sum()) * (records - 1) + int((~self.excited).sum()) * records)

    @property
    def strong(self) -> bool:
        """Whether what is not linear stands so far above the noise that the transfer function may be bent by it."""
        return self.chi2 > STRONG * self.values

    def doubted(self, residual: Complex) -> Array:
        """(Le, S): variance of the transfer function where it may be bent as much as the unexplained ``residual`` (R, L, S) is large."""
        size = np.einsum("r,rls->ls", self.trust, np.abs(residual[:, self.excited]) ** 2) / max(len(residual) - 1, 1)
        power = np.einsum("r,rl->l", self.trust, np.abs(self.spectra.force[:, self.excited]) ** 2)
        return np.asarray(np.maximum(self.variance, local_mean(size, 3) / power[:, None]))

    def project(self, force: Complex) -> Complex:
        """Remove from (..., R, L) what a free linear path from the shaker force explains."""
        return np.asarray(force - self.spectra.force * self.shadow(force)[..., None, :])

    def shadow(self, force: Complex) -> Complex:
        """(..., L): the transfer function from shaker force to ``force`` (..., R, L) that fits best; 0 on lines without force."""
        F = self.spectra.force
        top = np.einsum("r,rl,...rl->...l", self.trust, F.conj(), force)
        bottom = np.einsum("r,rl->l", self.trust, np.abs(F) ** 2)
        return np.asarray(np.where(self.excited, top / np.where(bottom > 0, bottom, 1), 0))


def gather(spectra: Spectra, band: tuple[float, float], mains: float = 0.0) -> Evidence:
    """Project a group of records; see :class:`Evidence`. Lines without force at multiples of ``mains`` (Hz) carry no weight."""
    F, Y = spectra.force, spectra.response
    noise_of_record = spectra.noise.mean((1, 2))
    trust = noise_of_record.mean() / noise_of_record
    noise = (spectra.noise * trust[:, None, None]).mean(0)
    force_noise = (spectra.force_noise * trust[:, None]).mean(0)
    power = np.einsum("r,rl->l", trust, np.abs(F) ** 2)
    excited = spectra.excited
    safe = np.where(power > 0, power, 1)
    H = np.where(excited[:, None], np.einsum("r,rl,rls->ls", trust, F.conj(), Y) / safe[:, None], 0)
    residual = Y - F[:, :, None] * H
    variance = noise + np.abs(H) ** 2 * force_noise[:, None]
    records = len(F)
    normal = np.abs(residual) ** 2 * trust[:, None, None] / variance
    frequency = spectra.frequency
    inside = (frequency > band[0]) & (frequency < band[1]) & ~excited
    dof = max(records - 1, 1) / records
    statistic = float(normal[:, excited].mean() / dof) if records > 1 and excited.any() else float("nan")
    odd, even = (float(normal[:, inside & (spectra.lines % 2 == k)].mean()) if (inside & (spectra.lines % 2 == k)).sum() > 5
                 else float("nan") for k in (1, 0))
    by_record = normal[:, excited].mean((1, 2)) / dof
    size = local_mean(np.where(excited[:, None], np.einsum("r,rls->ls", trust, np.abs(residual) ** 2) / max(records - 1, 1),
                               (np.abs(residual) ** 2).mean(0)), 3)
    distortion = np.maximum(size - variance, 0) if records > 1 else np.zeros_like(variance)
    total = variance + CANDIDATE_ERROR ** 2 * distortion
    variance_H = (variance + 0.1 * distortion)[excited] / safe[excited, None]
    hum = np.zeros(len(frequency), dtype=bool)
    if mains > 0 and spectra.kind == "steady":
        away = np.abs(frequency / mains - np.round(frequency / mains)) * mains
        hum = (away < 0.6 * spectra.rate / spectra.block) & ~excited
    weight = np.where(hum[:, None], 1e-9, 1.0) / total
    return Evidence(spectra, trust, weight, residual, H[excited], variance_H, statistic, odd, even, by_record)


def transfer(F: Complex, Y: Complex, trust: Array) -> tuple[Complex, Array]:
    """Transfer function (L, S) that fits records of force (R, L) and response (R, L, S) best, and the force's weighted power (L, 1)."""
    power = np.einsum("r,rl->l", trust, np.abs(F) ** 2)[:, None]
    return np.asarray(np.einsum("r,rl,rls->ls", trust, F.conj(), Y) / power), power


def level_transfer(evidence: Evidence) -> tuple[Complex, Array] | None:
    """Transfer function and variance (Le, S) of the records of the lowest level, where most laws sleep; None if there is one level only."""
    spectra = evidence.spectra
    low = spectra.levels < 0.5 * spectra.levels.max()
    if not low.any() or low.all():
        return None
    e = evidence.excited
    low = spectra.levels < 1.01 * spectra.levels.min()
    H, power = transfer(spectra.force[low][:, e], spectra.response[low][:, e], evidence.trust[low])
    noise = spectra.noise[:, e].mean(0)
    force = spectra.force_noise[:, e].mean(0)
    return H, (noise + np.abs(H) ** 2 * force[:, None]) / power + (0.003 * np.abs(H)) ** 2
