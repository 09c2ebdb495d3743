"""Is one linear system enough? Tests that the records at hand allow, each with a number and a sentence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.campaign import RIGID, Trial
from bayes_nlsid.mismatch.innovations import linear_columns
from bayes_nlsid.mismatch.recorded import Evidence

Array = NDArray[np.float64]
LOUD = 2.0   # ratio of levels between loud and quiet stretches below which no trend can be tested


def detect(found: Evidence) -> tuple[dict[str, float], list[str]]:
    """Statistics by name, and what they say.

    ``linear_statistic``: squared innovations that the best single effect takes away, share; ``error_over_noise``: error of the re-tuned
    model on records not fitted over sensor noise; ``frequency_trend``, ``damping_trend``: change of the first elastic mode from quiet to
    loud stretches in standard errors; ``odd_lines``, ``even_lines``: power on lines that the force does not excite, over noise.
    """
    out: dict[str, float] = {}
    told: list[str] = []
    if found.singles:
        out["linear_statistic"] = found.singles[0].share
        out["gain_nats"], out["gain_error"] = found.singles[0].gain, found.singles[0].error
    noise = found.scores["noise"]
    if np.isfinite(found.scores["updated"]) and noise > 0:
        out["error_over_noise"] = found.scores["updated"] / noise
    trend = amplitude_trend(found)
    if trend is not None:
        (frequency, sigma), (damping, spread), levels = trend
        out["frequency_trend"], out["damping_trend"] = frequency / max(sigma, 1e-300), damping / max(spread, 1e-300)
        told.append(f"From quiet to loud stretches ({levels:.2g} times the level) the first mode changes by {100 * frequency:+.3g} % in "
                    f"frequency (± {100 * sigma:.2g}) and {100 * damping:+.3g} percentage points in damping (± {100 * spread:.2g}).")
    for t in found.campaign.used("fit"):
        lines = unexcited_lines(t)
        if lines is not None:
            out["odd_lines"], out["even_lines"] = lines
            told.append(f"Record {t.name}: on odd and even lines that the force does not excite the response is {lines[0]:.3g} and "
                        f"{lines[1]:.3g} times what differs between periods.")
            break
    return out, told


def amplitude_trend(found: Evidence) -> tuple[tuple[float, float], tuple[float, float], float] | None:
    """Relative change of frequency and change of damping ratio of the first elastic mode between the quiet and the loud half.

    Each with its standard error; and the ratio of levels. None where levels are too alike or there is no elastic mode.
    """
    bench, linear = found.scale.bench, found.linear
    elastic = np.flatnonzero(linear.modal.omega > RIGID)
    if not elastic.size:
        return None
    k, m = int(elastic[0]), linear.model.modes
    _, parts, _ = linear_columns(linear, bench.desks, False)
    columns = np.concatenate(parts, axis=1)
    level = np.concatenate([np.repeat(np.abs(d.smoothed.u[d.skip:, k]), len(d.trial.recording.channels)) for d in bench.desks])
    size = bench.per_block(level) / np.bincount(bench.block)
    loud = size > np.median(size)
    ratio = float(size[loud].mean() / max(size[~loud].mean(), 1e-300)) if loud.any() and (~loud).any() else 1.0
    if ratio < LOUD:
        return None
    values, errors = [], []
    for half in (~loud, loud):
        rows = half[bench.block]
        A, e = columns[:, rows].T, bench.innovations[rows]
        norm = np.linalg.norm(A, axis=0)
        keep = norm > 1e-12 * norm.max()
        A = A[:, keep] / norm[keep]
        at = [int(np.flatnonzero(np.flatnonzero(keep) == i)[0]) for i in (k, m + k)]
        U, sv, Vt = np.linalg.svd(A, full_matrices=False)
        inverse = np.where(sv > 1e-8 * sv[0], 1 / sv, 0.0)
        x = Vt.T @ (inverse * (U.T @ e))
        variance = float(np.mean((e - A @ x) ** 2)) / max(float(np.mean([d.part for d in bench.desks])), 1e-3)
        covariance = (Vt.T * inverse ** 2) @ Vt * variance
        values.append(x[at] / norm[[k, m + k]])
        errors.append(np.sqrt(np.diag(covariance)[at]) / norm[[k, m + k]])
    w = float(linear.modal.omega[k])
    change = np.asarray(values[1] - values[0]) / np.array([2 * w * w, 2 * w])
    sigma = np.hypot(errors[0], errors[1]) / np.array([2 * w * w, 2 * w])
    return (float(change[0]), float(sigma[0])), (float(change[1]), float(sigma[1])), ratio


def unexcited_lines(trial: Trial) -> tuple[float, float] | None:
    """Mean power on odd and on even lines that a periodic force leaves out, over what differs between periods; nan where there is none."""
    record = trial.recording
    if record.period is None or record.n // record.period < 2 or record.free:
        return None
    periods = record.n // record.period
    Y = np.fft.rfft(record.response.reshape(periods, record.period, -1), axis=1)
    F = np.abs(np.fft.rfft(record.force.reshape(periods, record.period, -1).mean(0), axis=0)).max(axis=1)
    mean, scatter = Y.mean(0), Y.var(0, ddof=1) / periods
    lines = np.arange(len(F))
    excited = F > 1e-3 * F.max()
    if not excited.any():
        return None
    inside = (lines > 0) & (lines <= lines[excited].max()) & ~excited
    out = []
    for odd in (True, False):
        use = inside & (lines % 2 == int(odd))
        out.append(float(np.mean(np.abs(mean[use]) ** 2) / max(float(np.mean(scatter[use])), 1e-300)) if use.sum() >= 3 else float("nan"))
    return (out[0], out[1]) if np.isfinite(out).any() else None
