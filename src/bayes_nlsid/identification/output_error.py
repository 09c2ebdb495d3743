"""Least squares on the simulated response of recordings, started from the regression of Eq. 13.

The regression is quick and has no memory of its start, but noise in the measured motion biases it. The simulated response has no measured
motion in it; its error surface is only benign near the truth. So: regression first, then this.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.fit import Fit, Start
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.spectrum import Spectrum
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.simulation.integration import EVEN_BATCH, LONG_RUN
from bayes_nlsid.simulation.replay import predict_record

Array = NDArray[np.float64]
# step of a numerical derivative, share of the box: small against one radian of phase at the end of a record
DIFFERENCE = 1e-6
DAMPINGS = 10.0 ** np.arange(-2, 3)   # tried together, times the current one


@final
@dataclass(frozen=True, eq=False)
class Run:
    """One recording: what is compared, and the modal state from which its simulation starts."""

    recording: Recording
    spectrum: Spectrum
    measured: Array          # (2 bins, s), scaled
    scale: Array             # (s,)
    u0: Array | None         # (m,)
    v0: Array | None
    spread: Array            # (2 m,) size of the unknown part of the start; 0 where it is not estimated

    @property
    def unknown(self) -> NDArray[np.intp]:
        """Entries of (u0, v0) that are estimated along."""
        return np.flatnonzero(self.spread > 0)


@final
@dataclass(frozen=True, eq=False)
class OutputError:
    """Difference of simulated and measured channels, in-band, as a function of parameters and unknown initial states.

    Parameters
    ----------
    problem : Problem
    runs : tuple of Run
    substeps : tuple of int
        Integration steps per sample, fixed so that differences do not see the integrator change.
    compiled : bool or None
        Which time loop; None leaves it to each simulation.
    coordinates : Coordinates
        Those of the problem, but with a symlog constant of a tenth of the bound: on the way from one sign of a coefficient to the
        other a search must not cross the many decades around zero.
    """

    problem: Problem
    runs: tuple[Run, ...] = field(repr=False)
    substeps: tuple[int, ...]
    compiled: bool | None = None
    coordinates: Coordinates = field(init=False, repr=False)

    def __post_init__(self) -> None:
        scale = self.problem.scale
        wide = np.maximum(scale, 0.1 * np.abs(self.problem.bounds).max(axis=1))
        object.__setattr__(self, "coordinates", Coordinates(np.where(scale > 0, wide, 0.0)))

    @property
    def box(self) -> Array:
        """Bounds (2, P) in these coordinates."""
        return self.coordinates.to_s(self.problem.bounds.T)

    def theta(self, x: Array) -> Array:
        """Physical parameters (..., P), inside the bounds."""
        return np.clip(self.coordinates.to_theta(x[..., :self.size[0]]), self.problem.bounds[:, 0], self.problem.bounds[:, 1])

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of parameters and of unknown initial states."""
        return len(self.problem.names), sum(len(run.unknown) for run in self.runs)

    def residual(self, x: Array) -> Array:
        """Scaled in-band differences (S, N) of x (S, P + initial states), all in one batch; infinite where a simulation failed."""
        return self.difference(self.theta(x), x[:, self.size[0]:])

    def difference(self, theta: Array, states: Array, refine: int = 1) -> Array:
        """The same for theta (S, P) and unknown initial states (S, U) in units of their spread, with ``refine`` times the substeps."""
        parts, at = [], 0
        for run, substeps in zip(self.runs, self.substeps, strict=True):
            u0, v0 = start_state(run, states[:, at:at + len(run.unknown)])
            at += len(run.unknown)
            found = predict_record(self.problem.model, theta, run.recording, substeps=refine * substeps, u0=u0, v0=v0,
                                   compiled=self.compiled)
            with np.errstate(all="ignore"):
                values = np.moveaxis(run.spectrum.apply(np.moveaxis(found.values / run.scale, 1, 2)), 1, 2) - run.measured
            values[~found.ok] = np.inf
            parts.append(values.reshape(len(theta), -1))
        return np.concatenate(parts, axis=1)


def start_state(run: Run, states: Array) -> tuple[Array | None, Array | None]:
    """Modal state (S, m), (S, m) at the first sample for unknown parts (S, unknown) in units of their spread."""
    if run.u0 is None or run.v0 is None:
        return None, None
    start = np.tile(np.concatenate([run.u0, run.v0]), (len(states), 1))
    start[:, run.unknown] += states * run.spread[run.unknown]
    half = len(run.u0)
    return start[:, :half], start[:, half:]


def output_error(fit: Fit, recordings: Sequence[Recording], *, iterations: int = 25, tolerance: float = 1e-3,
                 progress: Callable[[float, str], None] | None = None) -> Fit:
    """Refine a fit by least squares on simulated channels.

    Channels of one quantity share a scale (their common in-band rms), as sensors of one kind share a noise. Transients are simulated from
    the first trusted sample of their modal data, and the modal state there is estimated along; periodic recordings from their steady
    state. Memory terms start unloaded there. Every iteration costs two batches of simulations: all differences at once, then
    five damping factors at once.

    Parameters
    ----------
    fit : Fit
        Of the regression, on the same recordings.
    recordings : sequence of Recording
        Matched to the modal data of ``fit.problem`` by name.
    iterations : int
    tolerance : float
        Relative error of the integrator that is accepted.
    progress : callable or None
        Called with the share done and a sentence.

    Returns
    -------
    Fit
        ``mse`` is the mean square of the difference relative to that of the measured channels in the band; ``covariance`` takes
        the difference as white. The refined point stands first in ``starts``, followed by those of the regression.

    Raises
    ------
    ValueError
        If the fit failed, or a recording has no modal data in the problem.
    """
    if not np.isfinite(fit.theta).all():
        raise ValueError(f"the fit has failed ({', '.join(fit.reasons)}); output error needs a finite starting point")
    began = time.perf_counter()
    error, x = prepare(fit, recordings, tolerance, iterations)
    first = error.residual(x[None])[0]
    if not np.isfinite(first).all():
        return replace(fit, reasons=(*fit.reasons, "output error: the simulation from the regression failed; the regression stands"))
    point, cost, slope, status, spent = _descend(error, x, first, iterations, progress)
    problem, theta = fit.problem, error.theta(point)
    covariance, rank = _covariance(error, theta, slope, cost)
    mse = cost / max(1, len(first))
    reasons = [f"output error: relative mean square {float(first @ first) / max(1, len(first)):.3g} -> {mse:.3g}"]
    if piled := problem.piled(theta):
        reasons.append(f"at a bound: {', '.join(piled)}")
    start = Start(theta, mse, status, spent, time.perf_counter() - began)
    return Fit(theta, problem.to_s(theta), mse, covariance, rank, (start, *fit.starts), "ok" if status == "converged" else status,
               tuple(reasons),
               problem, fit.weights, fit.seed)


def prepare(fit: Fit, recordings: Sequence[Recording], tolerance: float, iterations: int,
            compiled: bool | None = None) -> tuple[OutputError, Array]:
    """What is compared, ready to be simulated, and the point (P + initial states,) that the fit stands for.

    Raises
    ------
    ValueError
        If a recording has no modal data in the problem.
    """
    problem = fit.problem
    named = {d.name: i for i, d in enumerate(problem.data)}
    missing = [r.name for r in recordings if r.name not in named]
    if missing or not recordings:
        raise ValueError(f"recordings {missing or 'none'} have no modal data in the problem, which has {sorted(named)}")
    cut, spectra, measured = [], [], []
    for recording in recordings:
        data = problem.data[named[recording.name]]
        part, u0, v0, spread = _begin(problem, recording, named[recording.name])
        spectrum = Spectrum(part.n, part.dt, slice(None), problem.band or data.band, part.period is not None, problem.taper)
        cut.append((part, u0, v0, spread))
        spectra.append(spectrum)
        measured.append(spectrum.apply(part.response.T).T)
    scales = _scales([c[0] for c in cut], measured)
    runs = tuple(Run(part, spectrum, values / scale, scale, u0, v0, spread)
                 for (part, u0, v0, spread), spectrum, values, scale in zip(cut, spectra, measured, scales, strict=True))
    # many runs follow: the compiled loop is worth loading for all of them where it would not be for one
    batch = len(problem.names) + sum(len(run.unknown) for run in runs) + len(DAMPINGS)
    if compiled is None and iterations * (1 + batch / EVEN_BATCH) * sum(run.recording.n for run in runs) > LONG_RUN:
        compiled = True
    substeps = []
    for run in runs:
        u0, v0 = start_state(run, np.zeros((1, len(run.unknown))))
        substeps.append(predict_record(problem.model, fit.theta[None], run.recording, tolerance=tolerance, u0=u0, v0=v0,
                                       compiled=compiled).substeps)
    error = OutputError(problem, runs, tuple(substeps), compiled)
    return error, np.concatenate([error.coordinates.to_s(fit.theta), np.zeros(error.size[1])])


def _begin(problem: Problem, recording: Recording, index: int) -> tuple[Recording, Array | None, Array | None, Array]:
    """The part that is simulated, the modal state at its first sample, and how large the unknown part of that state may be."""
    data, modes = problem.data[index], problem.model.linear.modes
    if recording.period is not None and not recording.free:
        return recording, None, None, np.zeros(2 * modes)
    at = data.valid.indices(data.n)[0]
    begin = round(at * data.dt / recording.dt)
    at = min(data.n - 1, round(begin * recording.dt / data.dt))
    u0, v0, spread = np.zeros(modes), np.zeros(modes), np.zeros(2 * modes)
    where = list(data.modes)
    u0[where], v0[where] = data.u[at], data.v[at]
    spread[where] = data.u.std(axis=0)
    spread[[modes + k for k in where]] = data.v.std(axis=0)
    part = recording if begin == 0 else recording.window(begin * recording.dt, recording.n * recording.dt)
    return replace(part, period=None), u0, v0, spread


def _scales(parts: list[Recording], measured: list[Array]) -> list[Array]:
    """Scale (s,) of the channels of every recording: in-band rms per entry over all channels of the same quantity, all recordings
    together."""
    power: dict[str, list[float]] = {}
    for part, values in zip(parts, measured, strict=True):
        for channel, column in zip(part.channels, values.T, strict=True):
            power.setdefault(channel.quantity, []).append(float(np.mean(column**2)))
    common = {quantity: max(np.sqrt(np.mean(values)), 1e-300) for quantity, values in power.items()}
    return [np.array([common[c.quantity] for c in part.channels]) for part in parts]


def _descend(error: OutputError, x: Array, residual: Array, iterations: int,
             progress: Callable[[float, str], None] | None) -> tuple[Array, float, Array, str, int]:
    """Damped Gauss–Newton with bounds; gives point, cost, last derivative, status and number of simulations."""
    count, extra = error.size
    low, high = error.box
    lower, upper = np.concatenate([low, np.full(extra, -np.inf)]), np.concatenate([high, np.full(extra, np.inf)])
    width = np.concatenate([high - low, np.ones(extra)])
    step = DIFFERENCE * width
    cost, damping, spent, status = float(residual @ residual), 1e-3, 1, "iteration limit"
    slope = np.zeros((len(residual), count + extra))
    for i in range(iterations):
        move = np.where(x + step <= upper, step, -step)
        with np.errstate(invalid="ignore"):
            slope = ((error.residual(x + np.diag(move)) - residual) / move[:, None]).T
        slope[:, ~np.isfinite(slope).all(axis=0)] = 0.0
        trials = np.clip(x + _steps(slope * width, residual, (x - lower) / width, (upper - x) / width, damping) * width, lower, upper)
        tried = error.residual(trials)
        costs = np.where(np.isfinite(tried).all(axis=1), np.sum(np.where(np.isfinite(tried), tried, 0.0) ** 2, axis=1), np.inf)
        spent += len(x) + len(trials)
        best = int(np.argmin(costs))
        if progress is not None:
            progress((i + 1) / iterations, f"output error: relative mean square {min(cost, costs[best]) / len(residual):.4g}")
        if not costs[best] < cost:
            if damping > 1e6:
                status = "converged"
                break
            damping *= 1e3
            if np.max(np.abs(trials - x) / width) < 1e-7:
                status = "converged"
                break
            continue
        gain, cost, x, residual = cost - costs[best], float(costs[best]), trials[best], tried[best]
        damping = max(1e-12, damping * DAMPINGS[best])
        if gain < 1e-5 * cost or cost < 1e-20 * len(residual):
            status = "converged"
            break
    return x, cost, slope, status, spent


def _steps(slope: Array, residual: Array, room_below: Array, room_above: Array, damping: float) -> Array:
    """Steps (D, K) for every damping factor, entries held that a bound stops."""
    gradient, curvature = slope.T @ residual, slope.T @ slope
    loose = ~(((room_below <= 0) & (gradient > 0)) | ((room_above <= 0) & (gradient < 0)))
    out = np.zeros((len(DAMPINGS), len(gradient)))
    if not loose.any():
        return out
    scale = np.diag(curvature)[loose]
    scale = scale + 1e-10 * scale.max() + 1e-300
    for i, factor in enumerate(DAMPINGS):
        out[i, loose] = -np.linalg.solve(curvature[np.ix_(loose, loose)] + damping * factor * np.diag(scale), gradient[loose])
        out[i] *= min(1.0, 1 / 3 / max(float(np.max(np.abs(out[i]))), 1e-300))
    return out


def _covariance(error: OutputError, theta: Array, slope: Array, cost: float) -> tuple[Array, int]:
    """Covariance (P, P) in s of the problem, initial states marginalised, and the number of informed directions; see ``Fit.covariance``."""
    problem, (count, extra) = error.problem, error.size
    low, high = problem.to_s(problem.bounds.T)
    width = (high - low) / np.sqrt(12.0)
    stretch = np.exp(problem.coordinates.log_jacobian(problem.to_s(theta)) - error.coordinates.log_jacobian(error.coordinates.to_s(theta)))
    own, states = slope[:, :count] * stretch * width, slope[:, count:]
    if extra:
        basis = np.linalg.qr(states)[0]
        own = own - basis @ (basis.T @ own)
    variance = max(cost, 1e-16 * len(slope)) / max(1, len(slope) - count - extra)
    values, vectors = np.linalg.eigh(own.T @ own / variance)
    return (vectors / (1 + np.maximum(values, 0.0))) @ vectors.T * np.outer(width, width), int(np.sum(values > 1))
