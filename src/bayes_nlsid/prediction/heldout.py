"""Prediction of a recording that was not used: forward simulation over draws, compared with what was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.model import Model
from bayes_nlsid.prediction.bands import Drawable
from bayes_nlsid.recordings.filtering import band_pass, extended, reach, skirts
from bayes_nlsid.recordings.noise import NoiseFloor, noise_psd
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.simulation.replay import Replay, predict_record
from bayes_nlsid.simulation.schemes import SchemeName

Array = NDArray[np.float64]
Start = Literal["rest", "estimate"]
START_CYCLES = 6
"""Cycles of the slowest mode in the band from which an unknown start is estimated; they do not count in the scores."""
START_ROUNDS = 6
AT_REST = 0.05
GAUSS90 = 1.6448536269514722


@final
@dataclass(frozen=True)
class Heldout:
    """How well a recording that was not used is predicted.

    Parameters
    ----------
    record : str
    time : ndarray (n,)
        s from the first sample.
    measured : ndarray (n, s)
        Inside the band, in the units of the channels.
    q05, q50, q95 : ndarray (n, s)
        Quantiles of what would be measured: draws of the parameters and noise of the sensors together; NaN if no draw could be simulated.
    nrmse : float
        Root mean square of measured minus q50 over that of measured, over the scored samples; channels of one quantity are pooled.
    noise_floor : float
        What sensor noise alone makes of ``nrmse``.
    coverage90 : float
        Share of the scored samples between q05 and q95; should be 0.90.
    rmse : float
        Numerator of ``nrmse`` for the quantity of the first channel, in its unit.
    noise_rms : ndarray (s,)
    scored : slice
        Samples behind the part that an unknown start was estimated from.
    start : {"rest", "estimate", "steady"}
    status : dict of str to int
        How many draws ended how; only ``"ok"`` count.
    numerical_error : float
        Estimated error of the integration, relative.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    record: str
    time: Array
    measured: Array
    q05: Array
    q50: Array
    q95: Array
    nrmse: float
    noise_floor: float
    coverage90: float
    rmse: float
    noise_rms: Array
    scored: slice
    start: str
    status: dict[str, int]
    numerical_error: float

    def __post_init__(self) -> None:
        for name in ("q05", "q50", "q95"):
            if getattr(self, name).shape != self.measured.shape:
                raise ValueError(f"heldout: {name} has shape {getattr(self, name).shape}, expected {self.measured.shape}")


@final
@dataclass(frozen=True)
class Replayed:
    """Draws simulated on one recording, each from its own start.

    Parameters
    ----------
    values : ndarray (S, n, s)
        In the units of the channels, not band-passed.
    status : ndarray of str (S,)
    scored : slice
        Samples behind the part that an unknown start was estimated from.
    start : {"rest", "estimate", "steady"}
    numerical_error : float
    """

    values: Array
    status: NDArray[np.str_]
    scored: slice
    start: str
    numerical_error: float

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(S,) which draws can be used."""
        return np.asarray(self.status == "ok")


def replayed(model: Model, theta: Array, recording: Recording, *, band: tuple[float, float] | None, noise: NoiseFloor,
             start: Start | None = None, seed: int = 0, scheme: SchemeName = "exponential", tolerance: float | None = None,
             compiled: bool | None = None, progress: Callable[[str], None] | None = None) -> Replayed:
    """Simulate a recording for draws theta (S, P), the start estimated where it is not known; parameters as in ``heldout``."""
    if tolerance is None:
        level = np.sqrt(np.mean(np.square(recording.response), axis=0))
        tolerance = float(np.clip(0.2 * np.min(noise.rms() / np.maximum(level, 1e-300)), 2e-5, 1e-3))
    first = _start_samples(model, recording, band)
    steady = recording.period is not None and not recording.free
    how = "steady" if steady else start or _usual_start(recording, first)
    keywords: dict[str, object] = {"scheme": scheme, "tolerance": tolerance, "compiled": compiled, "progress": progress}
    u0 = v0 = None
    if how == "estimate":
        sigma = float(np.median(noise.rms() / np.maximum(np.sqrt(np.mean(np.square(recording.response[:first]), axis=0)), 1e-300)))
        u0, v0 = _initial_state(model, theta, recording, band, first, keywords, sigma, seed)
    found: Replay = predict_record(model, theta, recording, u0=u0, v0=v0, **keywords)  # type: ignore[arg-type]
    return Replayed(found.values, found.status, slice(first if how == "estimate" else 0, recording.n), how, found.numerical_error)


def heldout(model: Model, draws: ArrayLike | Drawable, recording: Recording, *, band: tuple[float, float] | None = None,
            noise: NoiseFloor | None = None, start: Start | None = None, samples: int = 100, seed: int = 0,
            scheme: SchemeName = "exponential",
            tolerance: float | None = None, compiled: bool | None = None, progress: Callable[[str], None] | None = None) -> Heldout:
    """Predict a recording by forward simulation.

    Parameters
    ----------
    model : Model
    draws : array_like (S, P) or object with ``draws(count, seed)``
    recording : Recording
    band : tuple of float or None
        Hz in which measured and predicted are compared; all frequencies if None.
    noise : NoiseFloor or None
        Of the sensors; by default from the recording itself.
    start : {"rest", "estimate"} or None
        Where motion begins. None: estimated for free decays and for transients that are under way at the first sample, rest otherwise.
        The estimate is
        a least-squares fit of the modal state to the first cycles, for every draw, with what noise leaves open of it. Periodic
        recordings are predicted in steady state.
    samples, seed : int
        How many draws of a posterior; seed of these draws and of the draws of an estimated start.
    tolerance : float or None
        Relative error of the integrator that is accepted; None: a fifth of the noise, between 2e-5 and 1e-3.
    scheme, compiled, progress
        As in ``predict_record``.

    Returns
    -------
    Heldout

    Raises
    ------
    ValueError
        If a channel sits at a location that the model does not know.
    """
    theta = np.atleast_2d(draws.draws(samples, seed) if isinstance(draws, Drawable) else np.asarray(draws, dtype=float))
    floor = noise if noise is not None else noise_psd(recording)
    noise_rms = floor.rms(None if band is None else band)
    found = replayed(model, theta, recording, band=band, noise=floor, start=start, seed=seed, scheme=scheme, tolerance=tolerance,
                     compiled=compiled, progress=progress)
    measured = _inside(recording.response, recording, band)
    counts = {str(s): int((found.status == s).sum()) for s in np.unique(found.status)}
    scored = found.scored
    quantiles = _predictive(found.values[found.ok], recording, band, noise_rms)
    rmse, nrmse, noise_floor = _scores(measured[scored], quantiles[1][scored], noise_rms, recording)
    inside = (measured >= quantiles[0]) & (measured <= quantiles[2])
    coverage = float(inside[scored].mean()) if found.ok.any() else float("nan")
    return Heldout(recording.name, recording.time, measured, *quantiles, nrmse, noise_floor, coverage, rmse, noise_rms, scored, found.start,
                   counts,found.numerical_error)


def _start_samples(model: Model, recording: Recording, band: tuple[float, float] | None) -> int:
    frequency = model.linear.frequency[_active(model, band)]
    return int(min(recording.n // 2, max(8, np.ceil(START_CYCLES / (float(frequency.min()) * recording.dt)))))


def _active(model: Model, band: tuple[float, float] | None) -> NDArray[np.intp]:
    """Modes inside the band (all if none is): only their state can be estimated."""
    f = model.linear.frequency
    inside = np.flatnonzero((f >= band[0]) & (f <= band[1])) if band is not None else np.arange(len(f))
    return inside if inside.size else np.arange(len(f))


def _usual_start(recording: Recording, first: int) -> Start:
    if recording.free:
        return "estimate"
    early = np.sqrt(np.mean(np.square(recording.response[:max(2, first // START_CYCLES // 4)])))
    return "rest" if early < AT_REST * np.sqrt(np.mean(np.square(recording.response))) else "estimate"


def _inside(x: Array, recording: Recording, band: tuple[float, float] | None) -> Array:
    """(..., n, s) inside the band; the same linear filter for measured and predicted, so that only their difference matters."""
    if band is None:
        return x
    n = x.shape[-2]
    rows = np.moveaxis(x, -2, 0).reshape(n, -1)
    far = 0 if recording.period is not None else min(n - 1, reach(band, recording.dt))
    total = n + 2 * far
    padded = extended(rows, far, far, False) if far else rows
    gain = band_pass(np.fft.rfftfreq(total, recording.dt), band, skirts(band, recording.fs))[:, None]
    filtered = np.fft.irfft(np.fft.rfft(padded, axis=0) * gain, n=total, axis=0)[far:far + n]
    return np.moveaxis(filtered.reshape(n, *x.shape[:-2], x.shape[-1]), 0, -2)


def _predictive(values: Array, recording: Recording, band: tuple[float, float] | None, noise_rms: Array) -> tuple[Array, Array, Array]:
    """q05, q50, q95 (n, s) of prediction and noise together.

    Distances from the median add in quadrature: exact where both are normal, and where either of them is zero.
    """
    if not len(values):
        empty = np.full(recording.response.shape, np.nan)
        return empty, empty, empty
    low, middle, high = np.quantile(_inside(values, recording, band), (0.05, 0.5, 0.95), axis=0)
    return middle - np.hypot(middle - low, GAUSS90 * noise_rms), middle, middle + np.hypot(high - middle, GAUSS90 * noise_rms)


def _scores(measured: Array, predicted: Array, noise_rms: Array, recording: Recording) -> tuple[float, float, float]:
    """RMSE of the first quantity, NRMSE, and what noise alone makes of it."""
    quantities = [c.quantity for c in recording.channels]
    ratios, floors, first = [], [], float("nan")
    for quantity in dict.fromkeys(quantities):
        use = [i for i, name in enumerate(quantities) if name == quantity]
        power = float(np.mean(np.square(measured[:, use])))
        wrong = float(np.mean(np.square(measured[:, use] - predicted[:, use])))
        first = np.sqrt(wrong) if np.isnan(first) else first
        ratios.append(wrong / max(power, 1e-300))
        floors.append(float(np.mean(np.square(noise_rms[use]))) / max(power, 1e-300))
    return float(first), float(np.sqrt(np.mean(ratios))), float(np.sqrt(np.mean(floors)))


def _initial_state(model: Model, theta: Array, recording: Recording, band: tuple[float, float] | None, first: int,
                   keywords: dict[str, object], sigma: float, seed: int) -> tuple[Array, Array]:
    """Modal state (S, m) at the first sample: Gauss-Newton on the first cycles, with the Jacobian of the median draw.

    ``sigma``: noise over signal. With several draws each state is drawn from what this noise leaves open.
    """
    window = replace(recording, response=recording.response[:first], force=recording.force[:first], period=None)
    active = _active(model, band)
    scale = np.sqrt(np.mean(np.square(window.response), axis=0))
    weight = 1 / np.maximum(scale, 1e-6 * scale.max() + 1e-300)
    m, count = model.linear.modes, len(active)
    measured = (window.response * weight).ravel()
    centre = theta[[int(np.argmin(np.abs(theta - np.median(theta, axis=0)).sum(axis=1)))]]
    omega = model.linear.omega[active]

    def run(parameters: Array, x: Array, substeps: int | None) -> tuple[Array, int]:
        u, v = np.zeros((len(x), m)), np.zeros((len(x), m))
        u[:, active], v[:, active] = x[:, :count], x[:, count:] * omega
        found = predict_record(model, np.broadcast_to(parameters, (len(x), theta.shape[1])), window, u0=u, v0=v, substeps=substeps,
                               **keywords)  # type: ignore[arg-type]
        return (found.values * weight).reshape(len(x), -1), found.substeps

    x = np.zeros((len(theta), 2 * count))
    small = 1e-9
    substeps: int | None = None
    jacobian, column = np.eye(1), np.ones(1)
    for round_ in range(START_ROUNDS):
        # finite differences about the state of the centre; a first, tiny state gives the linear response
        state = x[[int(np.argmin(np.abs(theta - centre).sum(axis=1)))]]
        size = max(small, 1e-4 * float(np.abs(state).max()))
        moved, substeps = run(centre, np.concatenate([state, state + size * np.eye(2 * count)]), substeps if round_ > 1 else None)
        jacobian = ((moved[1:] - moved[0]) / size).T
        column = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        residual = measured - run(theta, x, substeps)[0]
        # a draw whose motion diverges keeps the state it has: it will be counted as diverged
        lost = ~np.isfinite(residual).all(axis=1)
        if not np.isfinite(jacobian).all():
            break
        change = np.linalg.lstsq(jacobian / column, np.where(lost, 0.0, residual.T), rcond=1e-6)[0].T / column
        x = x + change
        if np.abs(change).max() <= 1e-7 * np.abs(x).max():
            break
    if len(theta) > 1:
        _, values, right = np.linalg.svd(jacobian / column, full_matrices=False)
        open_ = right.T * np.where(values > 1e-6 * values[0], sigma / np.maximum(values, 1e-300), 0.0)
        x = x + np.random.default_rng(seed).standard_normal(x.shape) @ open_.T / column
    full = np.zeros((2, len(theta), m))
    full[0][:, active], full[1][:, active] = x[:, :count], x[:, count:] * omega
    return full[0], full[1]
