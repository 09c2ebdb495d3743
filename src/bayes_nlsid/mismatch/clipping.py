"""A clipped channel: the level at which it clips, and the evidence with the clipping undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit, descend, finish, floored
from bayes_nlsid.mismatch.case import Case
from bayes_nlsid.mismatch.evidence import Evidence
from bayes_nlsid.mismatch.linear import Family

Array = NDArray[np.float64]
WORTH = 5.0  # gain of the first look below which clipping is not pursued


def suspects(case: Case, noise: Array) -> list[tuple[int, float]]:
    """Channels (index among usable ones) whose largest values crowd at one level, and that level, m/s²; the most crowded first.

    A flat top piles values up within the noise of the largest one: there are then many more of them than in the band just below.

    Parameters
    ----------
    noise : (S,) rms of the noise of the usable channels, m/s².
    """
    out = []
    for i, channel in enumerate(np.flatnonzero(case.usable)):
        crowd, level = 0.0, 0.0
        for record in case.records:
            if record.sealed or record.kind == "off":
                continue
            y = np.abs(record.accel[:len(record.accel) // record.periods, channel])
            # only turning points count: a single smooth peak also has many samples near its top
            y = y[1:-1][(y[1:-1] >= y[:-2]) & (y[1:-1] >= y[2:])]
            top = float(np.sort(y)[-3:].min()) if len(y) > 30 else np.inf
            for width in (2 * noise[i], 5 * noise[i], 0.01 * top):
                if width > 0.15 * top:
                    continue
                near, below = int((y > top - width).sum()), int(((y > top - 2.5 * width) & (y <= top - 1.5 * width)).sum())
                if near >= 8 and near > 2.5 * (below + 2) and near / (below + 1) > crowd:
                    crowd, level = near / (below + 1), float(np.median(y[y > top - width]))
        if crowd > 0:
            out.append((crowd, i, level))
    return [(i, level) for _, i, level in sorted(out, reverse=True)]


def undo(evidence: Evidence, fit: LinearFit, channel: int, level: float) -> Evidence:
    """Evidence with the clipping of one channel taken out, as the linear model predicts it."""
    spectra = evidence.spectra
    half = np.zeros((len(spectra.names), spectra.block // 2 + 1), dtype=complex)
    half[:, spectra.lines[spectra.excited]] = fit.model[:, channel] * spectra.force[:, spectra.excited]
    y = np.fft.irfft(half * spectra.block, spectra.block, axis=1)
    X = np.fft.rfft(np.clip(y, -level, level) - y, axis=1)[:, spectra.lines] / spectra.block
    residual, H = evidence.residual.copy(), evidence.H.copy()
    residual[:, :, channel] -= evidence.project(X)
    H[:, channel] -= evidence.shadow(X)[spectra.excited]
    return replace(evidence, residual=residual, H=H)


def fit_clipping(fam: Family, evidence: Evidence, fit: LinearFit, channel: int, level: float
                 ) -> tuple[float, Evidence, LinearFit, float] | None:
    """Level, cleaned evidence, recalibrated model and total −2 log likelihood with one channel clipped; None if no level near ``level``
    explains anything."""
    grid = level * np.linspace(0.85, 1.08, 12)
    if min(undo(evidence, fit, channel, float(x)).chi2 for x in grid) > evidence.chi2 - WORTH:
        return None
    s = evidence.spectra.s[evidence.excited]
    variance = floored(evidence.H, evidence.variance)
    # the first model must not know the clipped channel
    blind = variance.copy()
    blind[:, channel] *= 1e6
    theta, _, _ = descend(fam, fit.theta, s, evidence.H, blind, 8, prior_sd=fit.sd, spread=fit.spread)
    now = finish(fam, theta, s, evidence.H, blind, prior_sd=fit.sd, spread=fit.spread, rounds=0)
    for turn in range(3):
        best = min((undo(evidence, now, channel, float(x)).chi2, float(x)) for x in grid)[1]
        cleaned = undo(evidence, now, channel, best)
        theta, _, _ = descend(fam, now.theta, s, cleaned.H, variance, 6, prior_sd=fit.sd, spread=fit.spread)
        now = finish(fam, theta, s, cleaned.H, variance, prior_sd=fit.sd, spread=fit.spread, rounds=6 if turn == 2 else 0)
        grid = best * np.linspace(0.985, 1.015, 7)
    cleaned = undo(evidence, now, channel, best)
    return best, cleaned, now, float(cleaned.chi2 + now.cost + np.log(max(evidence.H.size, 2)))
