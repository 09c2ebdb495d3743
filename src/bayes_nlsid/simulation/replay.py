"""A recording simulated: the same force, rate, sensors and length, for a batch of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.model import Model
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.simulation.schemes import SchemeName

Array = NDArray[np.float64]
TOLERANCE = 1e-3
MOST_SUBSTEPS = 32
TRY_CYCLES = 20
SETTLED = 1e-3
MOST_PERIODS = 60


@final
@dataclass(frozen=True)
class Replay:
    """A recording as the model has it.

    Parameters
    ----------
    values : ndarray (S, n, s)
        In the order and units of ``recording.channels``.
    status : ndarray of str (S,)
        ``"ok"``, ``"newton"``, ``"diverged"`` as in ``Response``, or ``"not periodic"``: still changing from period to period at the end.
    substeps : int
        Integration steps per sample of the recording.
    numerical_error : float
        Estimate of the integrator's error, rms over rms of the response, from halving the step on a stretch of the first sample.
    drift : ndarray (S,)
        Periodic recordings: rms change from one period to the next over rms; else 0.
    final_displacement, final_velocity : ndarray (S, m)
        Modal state at the last instant.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    values: Array
    status: NDArray[np.str_]
    substeps: int
    numerical_error: float
    drift: Array
    final_displacement: Array
    final_velocity: Array

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or len(self.values) != len(self.status):
            raise ValueError(f"replay: values {self.values.shape} must be (S, n, s) with S = {len(self.status)}")

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(S,) which samples can be used."""
        return np.asarray(self.status == "ok")


def predict_record(model: Model, theta: ArrayLike, recording: Recording, *, u0: ArrayLike | None = None, v0: ArrayLike | None = None,
                   scheme: SchemeName = "exponential", tolerance: float = TOLERANCE, substeps: int | None = None,
                   compiled: bool | None = None, progress: Callable[[str], None] | None = None, extra: Array | None = None) -> Replay:
    """Simulate what the sensors of a recording would have shown.

    Parameters
    ----------
    model : Model
    theta : array_like (S, P)
    recording : Recording
        Its force drives the model: repeated until steady if the recording is periodic, else once. Between samples it is interpolated,
        periodic forces
        exactly (Fourier), others by cubic splines.
    u0, v0 : array_like (m,) or (S, m) or None
        Modal state at the first sample; rest if None. Free decays need it. Periodic recordings start from the linear steady state.
    scheme : {"hht", "exponential"}
    tolerance : float
        Relative error of the integrator that is accepted; the step is halved until it is met.
    substeps : int or None
        Steps per sample, if known.
    compiled, progress
        As in ``simulate``.
    extra : ndarray (S, n, k) or None
        Force, N, that acts on each sample beside the recorded one, in the order of the model's inputs; transients only.

    Returns
    -------
    Replay

    Raises
    ------
    ValueError
        If a channel or an input sits at a location that the model does not know, or a free decay comes without a start.
    """
    if extra is not None and recording.period is not None:
        raise ValueError(f"recording {recording.name!r} is periodic; extra forces are for transients only")
    values = np.atleast_2d(np.asarray(theta, dtype=float))
    locations = tuple(dict.fromkeys(c.location for c in recording.channels))
    model.linear.rows(locations)
    if recording.free and u0 is None and v0 is None:
        raise ValueError(f"recording {recording.name!r} has no force; give the modal state u0, v0 at its first sample")
    source = _Source(model, recording, locations, scheme, compiled, progress)
    start = (None if u0 is None else np.asarray(u0, dtype=float), None if v0 is None else np.asarray(v0, dtype=float))
    error = 0.0
    if substeps is None:
        substeps, error = _substeps(source, values[:1], tuple(None if x is None else x[:1] if x.ndim == 2 else x for x in start), tolerance)
    if recording.period is not None and not recording.free:
        out, status, drift, end = _steady(source, values, substeps)
    else:
        force = source.force(substeps)
        if extra is not None:
            beside = np.moveaxis(_finer(np.moveaxis(extra, 1, 0), substeps), 0, 1)
            force = beside if force is None else force + beside
        found = source.run(values, substeps, force, start, 0)
        out, status, drift, end = found[0], found[1], np.zeros(len(values)), found[2]
    return Replay(out, status, substeps, error, drift, end[0], end[1])


@final
@dataclass(frozen=True)
class _Source:
    """The recording as a task for ``simulate``."""

    model: Model
    recording: Recording
    locations: tuple[str, ...]
    scheme: SchemeName
    compiled: bool | None
    progress: Callable[[str], None] | None

    def force(self, substeps: int, count: int | None = None) -> Array | None:
        """Force at the inputs of the model ((count − 1) · substeps + 1, k); one whole period without its end for periodic recordings."""
        recording, inputs = self.recording, self.model.linear.inputs
        if recording.free:
            return None
        where = [c.location for c in recording.inputs]
        unknown = sorted(set(where) - set(inputs))
        if unknown:
            raise ValueError(f"recording {recording.name!r}: force at {unknown}, which are no inputs of the model; it has {list(inputs)}")
        out = np.zeros((recording.n, len(inputs)))
        for j, location in enumerate(where):
            out[:, inputs.index(location)] += recording.force[:, j]
        if recording.period is not None:
            return _finer_periodic(out.reshape(-1, recording.period, len(inputs)).mean(axis=0), substeps)
        return _finer(out if count is None else out[:count], substeps)

    def run(self, theta: Array, substeps: int, force: Array | None, start: tuple[Array | None, ...], skip: int,
            count: int | None = None) -> tuple[Array, NDArray[np.str_], tuple[Array, Array]]:
        """Channels (S, count, s), status, final state; the first ``skip`` samples are integrated but not kept."""
        recording = self.recording
        kept = recording.n if count is None else count
        quantities = tuple(dict.fromkeys(c.quantity for c in recording.channels))
        response = simulate(self.model, theta, fs=recording.fs * substeps, samples=(skip + kept - 1) * substeps + 1, force=force,
                            u0=start[0],
                            v0=start[1], scheme=self.scheme, keep=self.locations, every=substeps, store=quantities, skip=skip * substeps,
                            compiled=self.compiled, progress=self.progress)
        full = np.full((len(theta), kept, len(recording.channels)), np.nan)
        for j, channel in enumerate(recording.channels):
            motion = response.at(channel.location, channel.quantity)
            full[:, :motion.shape[1], j] = motion
        return full, response.status, (response.final_displacement, response.final_velocity)


def _substeps(source: _Source, theta: Array, start: tuple[Array | None, ...], tolerance: float) -> tuple[int, float]:
    """Steps per sample for which the error estimate is below the tolerance, and the estimate."""
    recording = source.recording
    omega = source.model.linear_values(theta)[0]
    count = min(recording.n, max(64, int(TRY_CYCLES * 2 * np.pi / (float(omega.min()) * recording.dt))))
    if recording.period is not None:
        count = min(count, recording.period)
        start = _linear_steady(source, theta) if not recording.free else start

    def run(k: int) -> Array:
        force = source.force(k, count)
        return source.run(theta, k, None if force is None else force[:(count - 1) * k + 1], start, 0, count)[0][0]

    k, coarse = 1, run(1)
    while True:
        fine = run(2 * k)
        with np.errstate(over="ignore", invalid="ignore"):      # steps too long for a stiff model overflow: then shorter ones are tried
            size = np.sqrt(np.mean(np.square(fine), axis=0))
            change = np.sqrt(np.mean(np.square(fine - coarse), axis=0))
        # second order: the error of the coarser run is 4/3 of the change
        error = float(4 / 3 * np.max(change / np.maximum(size, 1e-3 * size.max() + 1e-300))) if np.isfinite(change).all() else np.inf
        if error <= tolerance:
            return k, error
        k, coarse = 2 * k, fine
        if k >= MOST_SUBSTEPS:
            return k, error / 4


def _steady(source: _Source, theta: Array, substeps: int) -> tuple[Array, NDArray[np.str_], Array, tuple[Array, Array]]:
    """Whole periods until the start has been forgotten; the last one, repeated to the length of the recording."""
    recording = source.recording
    period = int(recording.period or recording.n)
    one = source.force(substeps)
    omega, zeta = source.model.linear_values(theta)
    # the linear steady state is close, so a start error of order one need only fall to the tolerance; hysteresis forgets more slowly
    # than its linear part, hence twice that time and a stretch of a period before the one that counts
    forget = 2 * np.log(1 / SETTLED) / (recording.dt * max(float((omega * zeta).min()), 1e-12))
    lead = int(min(MOST_PERIODS * period, np.ceil(forget)))
    compared = min(lead, period)
    first = -(lead + compared) % period
    start = _linear_steady(source, theta, first)
    count = compared + period
    force = None if one is None else one[(first * substeps + np.arange((lead + count - 1) * substeps + 1)) % len(one)]
    both, status, end = source.run(theta, substeps, force, start, lead, count)
    last, before = both[:, compared:], both[:, :compared]
    size = np.sqrt(np.mean(np.square(last), axis=(1, 2)))
    drift = np.sqrt(np.mean(np.square(last[:, period - compared:] - before), axis=(1, 2))) / np.maximum(size, 1e-300)
    status = np.array(status, dtype="<U16")
    status[(status == "ok") & (drift > SETTLED)] = "not periodic"
    return np.tile(last, (1, recording.n // period, 1)), status, drift, end


def _linear_steady(source: _Source, theta: Array, at: int = 0) -> tuple[Array, Array]:
    """Modal displacement and velocity (S, m) of the linear part in steady state at a sample of the period."""
    force = source.force(1)
    if force is None:
        raise ValueError("a steady state needs a force")
    force = np.roll(force, -at, axis=0)
    lines = np.fft.rfft(force @ source.model.linear.rows(source.model.linear.inputs), axis=0)
    w = 2 * np.pi * np.fft.rfftfreq(len(force), source.recording.dt)[:, None]
    omega, zeta = source.model.linear_values(theta)
    u = lines / (omega[:, None] ** 2 - w**2 + 2j * zeta[:, None] * omega[:, None] * w)
    # value at t = 0 of the inverse transform: mean over all lines, negative ones included
    weight = np.full(len(w), 2.0)
    weight[0] = 1.0
    if len(force) % 2 == 0:
        weight[-1] = 1.0
    gain = source.model.gain(theta)
    scale = (np.ones(len(theta)) if gain is None else gain)[:, None] / len(force)
    return scale * np.einsum("f,sfm->sm", weight, u.real), scale * np.einsum("f,sfm->sm", weight, (1j * w * u).real)


def _finer_periodic(x: Array, factor: int) -> Array:
    """One period on a grid ``factor`` times finer, by its Fourier series."""
    if factor == 1:
        return x
    n = len(x)
    lines = np.fft.rfft(x, axis=0)
    if n % 2 == 0:
        lines[-1] *= 0.5  # the line at Nyquist stands for both signs
    return np.asarray(np.fft.irfft(lines, n=factor * n, axis=0) * factor, dtype=float)


def _finer(x: Array, factor: int) -> Array:
    """A transient on a grid ``factor`` times finer, by cubic splines."""
    if factor == 1 or len(x) < 4:
        return x if factor == 1 else np.stack([np.interp(np.arange((len(x) - 1) * factor + 1) / factor, np.arange(len(x)),
                                                         c) for c in x.T], axis=1)
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(np.arange(len(x)), x, axis=0)(np.arange((len(x) - 1) * factor + 1) / factor), dtype=float)
