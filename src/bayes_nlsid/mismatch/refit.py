"""Frequencies and damping of the linear model fitted to the recordings before anything else: every participation free.

A channel is the sum of modal responses to the measured forces and of free vibrations; for given frequencies and damping the factors of both
follow by least squares (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973). Records are cut into short windows, each
with a start of its own, first: an error of some per cent in a frequency costs little phase there. Then windows grow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrated import Linear
from bayes_nlsid.mismatch.campaign import RIGID, Campaign, Trial
from bayes_nlsid.mismatch.observer import ORDER, Modal
from bayes_nlsid.mismatch.prove import envelope
from bayes_nlsid.mismatch.seen import fed

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
CYCLES = (10.0, 40.0, 160.0)   # of the slowest mode in a window
SAMPLES = 20_000               # that are fitted, all records together
FREQUENCY_SD, DAMPING_SD = 0.05, 0.7   # logarithms
WORTH = 300.0                  # independent values that all errors together are worth against these priors
PART_SD = 0.5                  # of a participation, relative to the largest that the model has
ITERATIONS = 8
SHIFT = 1e-5
LOCAL = 0.1                    # share of the local level that counts as error beside the noise


@final
@dataclass(frozen=True, eq=False)
class Piece:
    """One record as it is fitted: its samples, weights (n, s) and force (n, k)."""

    trial: Trial
    weight: Array
    force: Array


def refitted(campaign: Campaign, linear: Linear) -> Linear:
    """The linear model with frequencies and damping at which its modes follow the recordings; unchanged if there is no elastic mode."""
    elastic = np.flatnonzero(linear.modal.omega > RIGID)
    if not elastic.size:
        return linear
    pieces = _pieces(campaign, linear)
    start = np.concatenate([np.log(linear.modal.omega[elastic]), np.log(np.clip(linear.modal.zeta[elastic], 1e-4, 0.5))])
    x, slowest = start.copy(), 2 * np.pi / float(linear.modal.omega[elastic[0]])
    for cycles in CYCLES:
        x = _descended(linear, pieces, elastic, x, start, cycles * slowest)
    omega, zeta = np.exp(np.split(x, 2))
    order = np.argsort(omega)
    stiffness, damping = linear.modal.stiffness.copy(), linear.modal.damping.copy()
    if (order != np.arange(len(order))).any():
        return linear   # modes have changed places: which is which cannot be said
    stiffness[elastic], damping[elastic] = omega ** 2, 2 * zeta * omega
    return replace(linear, modal=Modal(stiffness, damping))


def _pieces(campaign: Campaign, linear: Linear) -> list[Piece]:
    trials = sorted(campaign.used("fit"), key=lambda t: -t.level)[:6]
    most = max(800, SAMPLES // (len(trials) * max(len(t.recording.channels) for t in trials)))
    out = []
    for t in trials:
        record = replace(t.recording, period=None)
        record = record.window(0.0, min(record.n, most) * record.dt)
        centred = record.response - record.response.mean(axis=0)
        size = np.maximum(centred.std(axis=0), 1e-300)
        level = np.sqrt(t.noise ** 2 + (LOCAL * envelope(centred, record.fs)) ** 2 + (2e-3 * size) ** 2)
        out.append(Piece(replace(t, recording=replace(record, response=centred)), 1 / level, fed(linear.model, record)))
    total = sum(p.weight.size for p in out)
    return [replace(p, weight=p.weight * LOCAL / np.sqrt(total)) for p in out]


def _descended(linear: Linear, pieces: Sequence[Piece], elastic: NDArray[np.intp], x: Array, start: Array, seconds: float) -> Array:
    """Damped Gauss–Newton on frequencies and damping for one length of windows."""
    sd = np.repeat([FREQUENCY_SD, DAMPING_SD], len(elastic))

    def run(at: Array) -> Array:
        parts = [_left(linear, p, elastic, at, seconds) for p in pieces]
        return np.concatenate([*parts, (at - start) / sd / np.sqrt(WORTH)])

    residual, damping = run(x), 1e-3
    for _ in range(ITERATIONS):
        slope = np.stack([(run(x + SHIFT * e) - residual) / SHIFT for e in np.eye(len(x))], axis=1)
        curvature, gradient = slope.T @ slope, slope.T @ residual
        for _ in range(5):
            step = -np.linalg.solve(curvature + damping * np.diag(np.diag(curvature) + 1e-12), gradient)
            step = step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-300))
            tried = run(np.minimum(x + step, np.repeat([np.inf, np.log(0.7)], len(elastic))))
            if tried @ tried < residual @ residual:
                break
            damping *= 10
        else:
            return x
        better = 1 - float(tried @ tried) / float(residual @ residual)
        x, residual, damping = np.minimum(x + step, np.repeat([np.inf, np.log(0.7)], len(elastic))), tried, max(damping / 10, 1e-9)
        if better < 1e-5:
            break
    return x


def _left(linear: Linear, piece: Piece, elastic: NDArray[np.intp], x: Array, seconds: float) -> Array:
    """What modal responses and free vibrations leave of one record, weighted."""
    record = piece.trial.recording
    omega, zeta = linear.modal.omega.copy(), np.clip(linear.modal.zeta, 0.0, 0.7)
    omega[elastic], zeta[elastic] = np.exp(np.split(x, 2))
    poles = omega * (-zeta + 1j * np.sqrt(1 - zeta ** 2))
    n, dt = record.n, record.dt
    count = max(1, round(n * dt / seconds))
    forced = _forced(poles, piece.force, dt)
    edges = np.linspace(0, n, count + 1).astype(int)
    parts: list[Array] = []
    for j, channel in enumerate(record.channels):
        order = ORDER[channel.quantity]
        pushed = _seen(forced, poles, order, piece.force)
        kept_y, kept_x = [], []
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            w = piece.weight[a:b, j, None]
            ring = np.exp(poles * dt * np.arange(b - a)[:, None]) * poles ** order
            free = np.concatenate([ring.real, ring.imag, np.ones((b - a, 1))], axis=1) * w
            free = free / np.maximum(np.linalg.norm(free, axis=0), 1e-300)
            both = np.concatenate([record.response[a:b, j, None], pushed[a:b]], axis=1) * w
            basis, values, _ = np.linalg.svd(free, full_matrices=False)
            basis = basis[:, values > 1e-6 * values[0]]
            both = both - basis @ (basis.T @ both)
            kept_y.append(both[:, 0])
            kept_x.append(both[:, 1:])
        y, X = np.concatenate(kept_y), np.concatenate(kept_x)
        parts.append(_without(y, X, _participation(linear, channel.location)))
    return np.concatenate(parts)


def _without(y: Array, X: Array, expected: Array) -> Array:
    """y without what the columns explain, participations drawn towards those of the model; the cost of leaving them is added."""
    if not X.shape[1]:
        return y
    sd = PART_SD * max(float(np.abs(expected).max()), 1e-300)
    prior = np.eye(X.shape[1]) / sd / np.sqrt(WORTH)
    A, b = np.concatenate([X, prior]), np.concatenate([y, prior @ expected])
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    c = np.linalg.lstsq(A / size, b, rcond=1e-10)[0] / size
    return np.asarray(b - A @ c)


def _participation(linear: Linear, location: str) -> Array:
    """What the model expects of the columns of `_seen`: row times row of each input, then nothing directly."""
    model = linear.model
    row = model.rows([location])[0]
    inputs = model.rows(list(model.inputs)) if model.inputs else np.zeros((0, model.modes))
    return np.concatenate([(row * inputs).ravel(), np.zeros(len(inputs))])


def _forced(poles: Complex, force: Array, dt: float) -> Complex:
    """Complex modal states (k, n, m) under forces (n, k) that are straight between samples."""
    from scipy.signal import lfilter

    out = np.zeros((force.shape[1], len(force), len(poles)), dtype=complex)
    for i, pole in enumerate(poles):
        h = pole * dt
        step = np.exp(h)
        new, old = ((step - 1 - h) / (pole * h), (step * (h - 1) + 1) / (pole * h)) if abs(h) > 1e-3 else (dt / 2, dt / 2)
        for j in range(force.shape[1]):
            out[j, :, i] = lfilter([new, old], [1.0, -step], force[:, j].astype(complex))
    return out


def _seen(states: Complex, poles: Complex, order: int, force: Array) -> Array:
    """Modal responses to each force in the quantity of a channel (n, k m), and the forces themselves (n, k)."""
    k, n, m = states.shape
    wave = (states * poles ** order).imag / np.maximum(poles.imag, 1e-12)
    if order == 2:
        wave = wave + force.T[:, :, None]
    return np.concatenate([wave.transpose(1, 0, 2).reshape(n, k * m), force], axis=1)
