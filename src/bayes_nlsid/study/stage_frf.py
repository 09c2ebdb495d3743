"""Stage ``frf``: stepped-sine response curves for draws of the posterior, with bands."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.prediction.response_bands import ResponseBands, response_bands
from bayes_nlsid.study.context import Context, Result
from bayes_nlsid.study.stage_identify import stored_model
from bayes_nlsid.study.stage_predict import posterior_draws

SHARE_NEEDED = 0.9
MOST_ERROR = 0.01
"""Relative change of a peak by more harmonics that is no longer tolerated."""


def frf(context: Context) -> Result:
    """Response curves at every level of the force.

    Returns
    -------
    arrays, data
        Those of ``frf.npz``; ``data["summary"]`` what ``result.json`` says of them.
    """
    entry = context.study.frf
    assert entry is not None
    model, theta = stored_model(context)
    draws = posterior_draws(context, theta, entry.samples, "frf")
    try:
        bands = response_bands(draws, model, drive=entry.drive, at=entry.at, levels=entry.levels, band=entry.band,
                               harmonics=entry.harmonics, executor=context.executor, workers=context.workers, progress=context.progress)
    except ValueError as error:
        raise InputError(f"{context.study.file.name}: [frf]", str(error), "change input, output, levels or band") from None
    return bands.arrays(), {"input": entry.drive, "output": entry.at, "curves": [c.status for c in bands.curves],
                            "summary": _summary(bands, len(draws))}


def _summary(bands: ResponseBands, samples: int) -> dict[str, Any]:
    """Peaks with their bands, what failed, and how many harmonics were enough."""
    ok = np.isfinite(bands.peak_frequency)
    reasons = [f"{count} of {ok.size} curves: {name}" for name, count in bands.status.items() if name != "ok"]
    reasons += [f"{count} of {ok.size} curves: {name} within the band; what a sweep meets there is not given"
                for name, count in bands.lost.items()]
    short = bands.harmonic_error > MOST_ERROR
    reasons += [f"harmonics up to {bands.harmonics} are not enough at {level:g} N: more of them move the peak by {100 * error:.2g} %"
                for level, error in zip(bands.level[short], bands.harmonic_error[short], strict=True)]
    peaks = []
    for i, level in enumerate(bands.level):
        row: dict[str, Any] = {"level": float(level), "harmonic_error": float(bands.harmonic_error[i]), "usable": int(ok[:, i].sum())}
        for name, values in (("frequency", bands.peak_frequency), ("amplitude", bands.peak_amplitude)):
            seen = values[ok[:, i], i]
            quantiles = np.quantile(seen, (0.05, 0.5, 0.95)) if seen.size else np.full(3, np.nan)
            row |= {f"{name}_{q}": float(v) for q, v in zip(("q05", "q50", "q95"), quantiles, strict=True)}
        peaks.append(row)
    status = "ok" if (ok.mean(axis=0) >= SHARE_NEEDED).all() and not short.any() else "failed"
    return {"status": status, "reasons": reasons, "input": bands.drive, "output": bands.location, "samples": samples,
            "harmonics": bands.harmonics, "stability": bands.judged_by, "peaks": peaks}
