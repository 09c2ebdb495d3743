"""Force on lines that the excitation leaves out: what the structure answers was driven there by the shaker, what it does not answer was
made by the force cell.

Distortion of the shaker is a real force, and the response to it is no sign of a structure that is not linear; a cell whose curve is bent
reads harmonics that nobody exerts. The answer of the structure, by its calibrated model, tells the two apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.case import Case, CaseRecord
from bayes_nlsid.mismatch.linear import Family, fields
from bayes_nlsid.mismatch.shapes import with_shape_errors
from bayes_nlsid.mismatch.spectra import Spectra, local_mean

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
ENOUGH = 25.0   # information (in noise variances) from which the answer to force between the lines can be judged
FEWEST = 8      # lines
POWERS = (2, 3, 4, 5, 6, 7)   # of a cell's curve beside its straight part


@final
@dataclass(frozen=True)
class Heard:
    """How the structure answers force on lines that the excitation leaves out.

    Parameters
    ----------
    share : float
        Part of the answer expected by the model that is there: 1 for a real force, 0 for one that only the cell reads.
    information : float
        Squared expected answer over what is measured there: the inverse of the variance of ``share``.
    expected : ndarray complex (R, L, S)
        That answer; zero on other lines.
    size : float
        rms of this force over that of the excitation, loudest record.
    """

    share: float
    information: float
    expected: Complex
    size: float

    @property
    def real(self) -> bool:
        """Whether the force is there."""
        return self.share > 0.5

    @property
    def gain(self) -> float:
        """Decrease of −2 log likelihood by a cell that makes the force up, against a structure that should have answered it."""
        return 2 * self.information * (1 - 2 * self.share)


def heard(spectra: Spectra, fam: Family, fit: LinearFit, band: tuple[float, float]) -> Heard | None:
    """The answer to force between the excited lines; None if there is too little of it to judge.

    Parameters
    ----------
    band : Hz, where the calibrated model holds.
    """
    f = spectra.frequency
    at = np.flatnonzero((np.abs(spectra.stray) > 0).any(axis=0) & (f > band[0]) & (f < band[1]))
    if len(at) < FEWEST:
        return None
    H = with_shape_errors(fam, fields(fam, fit.fields.modes, spectra.s[at]), spectra.s[at], fit.shape_errors)
    expected = H[None] * spectra.stray[:, at, None]
    measured = spectra.response[:, at]
    power = np.array([local_mean(np.abs(y) ** 2, 3) for y in measured]) + spectra.noise[:, at]
    information = float((np.abs(expected) ** 2 / power).sum())
    if information < ENOUGH:
        return None
    share = float((expected.conj() * measured / power).real.sum()) / information
    whole = np.zeros_like(spectra.response)
    whole[:, at] = expected
    top = int(np.argmax(spectra.levels))
    size = float(np.linalg.norm(spectra.stray[top, at]) / max(float(np.linalg.norm(spectra.force[top])), 1e-300))
    return Heard(share, information, whole, size)


def without(spectra: Spectra, found: Heard) -> Spectra:
    """Responses without the linear answer to a real force between the lines."""
    return replace(spectra, response=spectra.response - found.expected)


def straightened(case: Case, spectra: Spectra) -> Case | None:
    """The case with the curve of its force cell straightened by what that curve makes between the lines; None if that explains not half.

    The force that acts is x − Σ c_k x^k of the force x that is read; the coefficients are those that leave least on the lines without
    excitation.
    """
    block = spectra.block
    steady = [r for r in case.select("steady") if r.name in spectra.names]
    waves = np.array([r.force.reshape(r.periods, block).mean(axis=0) for r in steady])
    scale = float(np.abs(waves).max())
    at = spectra.lines[~spectra.excited]
    columns = np.array([np.fft.rfft((waves / scale) ** k, axis=1)[:, at].ravel() / block for k in POWERS])
    wanted = np.fft.rfft(waves, axis=1)[:, at].ravel() / block
    real = np.concatenate([columns.real, columns.imag], axis=1)
    goal = np.concatenate([wanted.real, wanted.imag])
    c = np.linalg.lstsq(real.T, goal, rcond=None)[0]
    if np.linalg.norm(goal - c @ real) ** 2 > 0.5 * np.linalg.norm(goal) ** 2:
        return None

    def straight(record: CaseRecord) -> CaseRecord:
        x = np.clip(record.force / scale, -1.0, 1.0)    # beyond the forces that showed it a curve goes on as it ended
        return replace(record, force=record.force - sum(ck * x ** k for ck, k in zip(c, POWERS, strict=True)))

    return replace(case, records=tuple(straight(r) for r in case.records))
