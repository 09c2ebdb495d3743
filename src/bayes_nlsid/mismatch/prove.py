"""Forward prediction of whole records: nominal model, best linear re-tuning, extended model, with bands.

Nothing here looks at the accelerations it predicts. The width of the bands comes from a record that was never fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.case import Case, CaseRecord
from bayes_nlsid.mismatch.effects import law_of
from bayes_nlsid.mismatch.linear import Attachment, Family, Modes, fields, solve
from bayes_nlsid.mismatch.motion import settle
from bayes_nlsid.mismatch.paths import bed
from bayes_nlsid.mismatch.polish import Hypothesis, day
from bayes_nlsid.mismatch.shapes import accelerance, with_shape_errors
from bayes_nlsid.mismatch.spectra import Spectra

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@final
@dataclass(frozen=True)
class Predictor:
    """A model that can run any record: a linear member of the family, and effects beside it.

    Parameters
    ----------
    family : Family
    fit : LinearFit or None
        None for the nominal model as delivered.
    hypothesis : Hypothesis or None
    channels : int
    clip : tuple of (channel index, level m/s²), one for each clipped channel
    reference : Spectra
        Fitted records: the time scale of drifts.
    chained : bool
        Whether the measuring chain of the hypothesis applies.
    """

    family: Family
    fit: LinearFit | None
    hypothesis: Hypothesis | None
    channels: int
    clip: tuple[tuple[int, float], ...]
    reference: Spectra
    chained: bool = True

    def silent(self, case: Case, record: CaseRecord) -> Array:
        """Accelerations (n, S') of the channels that were left out, as the model has them."""
        fam = replace(self.family, sensors=self.family.silent)
        fit = None if self.fit is None else replace(self.fit, shape_errors=np.zeros((len(fam.sensors), len(fam.error_sd))))
        return replace(self, family=fam, fit=fit, clip=(), chained=False).run(case, record)[0]

    def run(self, case: Case, record: CaseRecord) -> tuple[Array, str]:
        """Accelerations (n, S) of the usable channels and a status."""
        fam = self.family
        modes = solve(fam, np.zeros(fam.size)) if self.fit is None else self.fit.fields.modes
        block, waveform = _drive(case, record, modes)
        spectra = _as_spectra(record, block, waveform, case.rate, self.reference)
        s = np.asarray(2j * np.pi * np.arange(block // 2 + 1) * case.rate / block, dtype=complex)
        F = np.fft.rfft(waveform) / block
        parts = ((), None) if self.hypothesis is None else self.hypothesis.parts(self.channels)(s)
        errors = None if self.fit is None else self.fit.shape_errors
        Y = driven(fam, modes, s, F, errors, parts[0])
        status = "ok"
        forces = () if self.hypothesis is None else self.hypothesis.forces
        if forces:
            rows = np.array([fam.places[e.place] for e in forces])
            attach = None if self.hypothesis is None else (lambda q: self.hypothesis.parts(self.channels)(q)[0])  # type: ignore[union-attr]
            paths = bed(modes, spectra, rows, fam.shaker, attach)
            time = float(day(self.reference, np.array([record.start]))[0])
            laws = tuple(law_of(e, float(np.clip(time, -1.0, 1.6)), paths.periodic) for e in forces)
            _, G, status = settle(paths, 0, laws, most=60)
            Y = Y - np.einsum("lsj,lj->ls", accelerance(fam, modes, s, rows, errors, parts[0]), G[:len(s)])
        if parts[1] is not None and self.chained:
            Y = parts[1].apply(Y)
        wave = np.fft.irfft(Y * block, block, axis=0)
        n = len(record.force)
        out = np.tile(wave, (record.periods, 1)) if record.kind == "steady" else wave[:n]
        for channel, level in self.clip:
            out[:, channel] = np.clip(out[:, channel], -level, level)
        return out, status


def driven(fam: Family, modes: Modes, s: Complex, force: Complex, errors: Array | None, attach: tuple[Attachment, ...], most: int = 2000
           ) -> Complex:
    """(L, S) accelerations to the shaker's force (L,), with all that calibration has corrected; lines without force are left at zero."""
    out = np.zeros((len(s), len(fam.sensors)), dtype=complex)
    lines = np.flatnonzero(np.abs(force) > 1e-7 * np.abs(force).max(initial=0.0))
    for at in np.array_split(lines, len(lines) // most + 1):
        local = tuple(replace(a, z=a.z[at]) for a in attach)
        fld = fields(fam, modes, s[at], local)
        H = fld.H if errors is None else with_shape_errors(fam, fld, s[at], errors)
        out[at] = H * force[at, None]
    return out


def _drive(case: Case, record: CaseRecord, modes: Modes) -> tuple[int, Array]:
    """Length of one period of the simulation and the force on it; a burst is padded until it has died away."""
    n = len(record.force)
    if record.kind == "steady":
        block = n // record.periods
        return block, record.force.reshape(record.periods, block).mean(0)
    slowest = float((modes.zeta * modes.omega)[:8].min())
    quiet = np.abs(record.force) > 0.02 * np.abs(record.force).max()
    last = int(np.flatnonzero(quiet)[-1]) if quiet.any() else n
    need = last + int(9 / slowest * case.rate)
    block = n if need <= n else _smooth_length(min(max(need, n), 3 * n))
    return block, np.concatenate([record.force, np.zeros(block - n)])


def _smooth_length(n: int) -> int:
    """The next even length with factors 2, 3 and 5 only."""
    while True:
        m = n
        for p in (2, 3, 5):
            while m % p == 0:
                m //= p
        if m == 1 and n % 2 == 0:
            return n
        n += 1


def _as_spectra(record: CaseRecord, block: int, waveform: Array, rate: float, reference: Spectra) -> Spectra:
    none = np.zeros((1, 0))
    return Spectra((record.name,), record.kind, block, rate, 0.0, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool),
                   none.astype(complex), np.zeros((1, 0, reference.response.shape[2]), dtype=complex),
                   np.zeros((1, 0, reference.response.shape[2])), none, waveform[None], np.zeros((0, 0, 0), dtype=complex),
                   np.array([record.level]), np.array([record.start]))


@final
@dataclass(frozen=True)
class Bands:
    """Error model of a predictor: ``sd² = noise² + relative² · envelope²`` per channel.

    Parameters
    ----------
    noise : ndarray (S,)
        m/s².
    relative : ndarray (S,)
        Error per local rms of the response.
    factor : float
        Number of standard deviations on each side (from coverage on the never-fitted record).
    """

    noise: Array
    relative: Array
    factor: float

    def sd(self, prediction: Array, rate: float) -> Array:
        """(n, S), m/s²."""
        return np.asarray(np.sqrt(self.noise ** 2 + (self.relative * envelope(prediction, rate)) ** 2))


def envelope(signal: Array, rate: float, seconds: float = 0.2) -> Array:
    """Local rms (n, S) over a centred window."""
    half = max(1, int(seconds * rate / 2))
    total = np.concatenate([np.zeros((1, signal.shape[1])), np.cumsum(signal ** 2, axis=0)])
    k = np.arange(len(signal))
    low, high = np.maximum(k - half, 0), np.minimum(k + half + 1, len(signal))
    return np.asarray(np.sqrt(np.maximum(total[high] - total[low], 0) / (high - low)[:, None]))


def calibrate_bands(noise: Array, measured: list[Array], predicted: list[Array], rate: float) -> Bands:
    """Bands that hold 90 % of the samples of records that were not fitted."""
    y, p = np.concatenate(measured), np.concatenate(predicted)
    env = np.concatenate([envelope(q, rate) for q in predicted])
    error = ((y - p) ** 2).mean(0)
    relative = np.sqrt(np.maximum(error - noise ** 2, 0) / np.maximum((env ** 2).mean(0), 1e-300))
    relative = np.maximum(relative, 1e-3)
    sd = np.sqrt(noise ** 2 + (relative * env) ** 2)
    factor = float(np.clip(np.quantile(np.abs(y - p) / sd, 0.90), 1.2, 2.6))
    return Bands(noise, relative, factor)


def nrmse(measured: Array, predicted: Array) -> float:
    """Root mean squared error over root mean square of the measurement, all channels together."""
    return float(np.sqrt(((measured - predicted) ** 2).mean() / max((measured ** 2).mean(), 1e-300)))


def elpd_difference(measured: Array, first: Array, second: Array, bands_first: Bands, bands_second: Bands, rate: float,
                    blocks: int = 24) -> tuple[float, float]:
    """Block-wise difference of log predictive density (second minus first) and its standard error.

    Samples are counted at the rate of independent values, taken as one in four.
    """
    def density(p: Array, b: Bands) -> Array:
        sd = b.sd(p, rate)
        return np.asarray((-0.5 * ((measured - p) / sd) ** 2 - np.log(sd)).sum(1))

    difference = (density(second, bands_second) - density(first, bands_first)) / 4
    parts = np.array([d.sum() for d in np.array_split(difference, blocks)])
    return float(parts.sum()), float(parts.std(ddof=1) * np.sqrt(blocks))
