"""Alternatives compared by what they foretell of records that none of them was fitted to.

Log-likelihoods of S1, S2 and S3 are of different data (one equation, or eight) and cannot be compared. Every alternative can be simulated,
though: the score is the log predictive density of the measured channels, block by block of time, each block long enough to be nearly
independent of the next. Neighbouring samples are never left out one by one, for they reveal each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.model import Model
from bayes_nlsid.prediction.heldout import Replayed, replayed
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.simulation.integration import EVEN_BATCH, LONG_RUN

Array = NDArray[np.float64]
CYCLES, DECAYS = 10, 3          # of the slowest mode in the band: a block is as long as the longer of the two
FEWEST, WANTED = 3, 8           # blocks of a record: needed, and wanted before decay times lengthen them
SMOOTH = 2                      # bins to each side over which the predicted power is averaged
SURE, ALMOST = 2.0, 4.0         # standard errors, and log units, below which alternatives are not told apart
CHANCE, FLIPS = 0.0228, 4096    # one-sided probability of two standard errors; random signs where there are too many to try all
ROUNDS = 2000
SUBSTEPS = 4                     # of the integrator for a sample, as a rule: only to guess the work


@final
@dataclass(frozen=True, eq=False)
class Alternative:
    """One model with draws of its posterior.

    Parameters
    ----------
    name : str
    model : Model
    theta : ndarray (S, P)
    k_hat : float or None
        Of the weights by which the draws were made; None where walkers drew them.
    note : str
    """

    name: str
    model: Model
    theta: Array = field(repr=False)
    k_hat: float | None = None
    note: str = ""

    def __post_init__(self) -> None:
        if self.theta.ndim != 2 or not len(self.theta):
            raise ValueError(f"alternative {self.name!r}: theta has shape {self.theta.shape}, expected (S, P) with at least one draw")


@final
@dataclass(frozen=True, eq=False)
class Comparison:
    """Scores of alternatives on the same blocks.

    Parameters
    ----------
    names : tuple of str (K,)
    blocks : tuple of str (B,)
    log_density : tuple of ndarray (S_k, B)
        Of every block for every draw.
    by_block : ndarray (K, B)
        Log predictive density of every block: logarithm of the mean over draws.
    discrepancy : ndarray (K,)
        Error of the model on the records it was fitted to beyond their noise, rms over rms of the signal; part of the prediction.
    nrmse : ndarray (K,)
        On the held-out records.
    k_hat : tuple of float or None (K,)

    Raises
    ------
    ValueError
        If alternatives were scored on different blocks.
    """

    names: tuple[str, ...]
    blocks: tuple[str, ...]
    log_density: tuple[Array, ...] = field(repr=False)
    by_block: Array = field(repr=False)
    discrepancy: Array
    nrmse: Array
    k_hat: tuple[float | None, ...]

    def __post_init__(self) -> None:
        if self.by_block.shape != (len(self.names), len(self.blocks)) or any(x.shape[1] != len(self.blocks) for x in self.log_density):
            raise ValueError("alternatives were scored on different blocks; densities of different data cannot be compared")

    @property
    def elpd(self) -> Array:
        """Sum (K,) of log predictive densities; −inf where a prediction failed."""
        return np.asarray(self.by_block.sum(axis=1))

    @property
    def best(self) -> int:
        """Index of the largest."""
        return int(np.argmax(self.elpd))

    def difference(self, k: int, reference: int | None = None) -> tuple[float, float]:
        """ELPD of an alternative minus that of a reference (the best), and its standard error from the scatter between blocks."""
        other = self.best if reference is None else reference
        if k == other:
            return 0.0, 0.0
        each = self.by_block[k] - self.by_block[other]
        if not np.isfinite(each).all():
            return float("-inf"), float("nan")
        return float(each.sum()), float(np.sqrt(len(each)) * each.std(ddof=1))

    def chance(self, k: int, reference: int | None = None) -> float:
        """Probability of a difference as negative as this if each block were as likely to speak for the one as for the other.

        Blocks differ in how much they hold: where one alternative loses in all of them, by a hundred here and by ten thousand there, the
        scatter between blocks is as large as the difference, and yet nothing is in doubt. So signs of the blocks' differences are flipped.
        """
        each = self.by_block[k] - self.by_block[self.best if reference is None else reference]
        if not np.isfinite(each).all():
            return 0.0
        count = len(each)
        if 2**count <= FLIPS:
            signs = 1 - 2 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
        else:
            signs = np.random.default_rng(0).choice([-1, 1], size=(FLIPS, count))
            signs[0] = 1
        return float(np.mean(signs @ each <= each.sum() + 1e-12 * np.abs(each).sum()))

    def told_apart(self, k: int) -> bool:
        """Whether an alternative is worse than the best: by two standard errors, or by signs that agree as seldom by chance."""
        value, error = self.difference(k)
        return value == -np.inf or (-value > ALMOST and (-value > SURE * error or self.chance(k) < CHANCE))

    @property
    def stacking(self) -> Array:
        """Weights (K,) whose mixture foretells the blocks best (Yao, Vehtari, Simpson and Gelman 2018), by fixed-point iteration."""
        alive = np.isfinite(self.elpd)
        weights = alive / max(1, alive.sum())
        if not alive.any():
            return np.asarray(weights, dtype=float)
        density = np.exp(self.by_block[alive] - self.by_block[alive].max(axis=0))
        w = weights[alive]
        for _ in range(ROUNDS):
            w = w * np.mean(density / np.maximum(w @ density, 1e-300), axis=1)
        weights = np.zeros(len(alive))
        weights[alive] = w / w.sum()
        return weights

    @property
    def sentence(self) -> str:
        """One sentence to quote."""
        order = [int(k) for k in np.argsort(-self.elpd, kind="stable")]
        if not np.isfinite(self.elpd[order[0]]):
            return "None of the alternatives could be simulated on the held-out records."
        best, rest = order[0], order[1:]
        if not rest:
            return f"{self.names[best]} is the only alternative."
        equal = [self.names[k] for k in rest if not self.told_apart(k)]
        worse = [k for k in rest if self.told_apart(k)]
        said = f"Over {len(self.blocks)} blocks of held-out motion {self.names[best]} predicts best"
        if equal:
            said = (f"Over {len(self.blocks)} blocks of held-out motion {self.names[best]} predicts best by chance only: "
                    f"{', '.join(equal)} cannot be told from it")
        if worse:
            told = []
            for k in worse[:4]:
                value, error = self.difference(k)
                told.append(f"{self.names[k]} by {-value:.3g} ± {error:.2g}" if np.isfinite(value) else f"{self.names[k]}, which fails")
            said += f"{'; it beats' if equal else ', ahead of'} {', '.join(told)} in log predictive density"
        return said + "."

    def rows(self) -> list[dict[str, Any]]:
        """One record for each alternative, best first."""
        weights = self.stacking
        out = []
        for k in np.argsort(-self.elpd, kind="stable"):
            value, error = self.difference(int(k))
            out.append({"name": self.names[k], "elpd": float(self.elpd[k]), "elpd_difference": value, "elpd_se": error,
                        "stacking_weight": float(weights[k]), "told_from_best": bool(k != self.best and self.told_apart(int(k))),
                        "discrepancy": float(self.discrepancy[k]), "nrmse": float(self.nrmse[k]), "k_hat": self.k_hat[k]})
        return out


def compare(alternatives: Sequence[Alternative], train: Sequence[tuple[Recording, NoiseFloor]],
            heldout: Sequence[tuple[Recording, NoiseFloor]], *, band: tuple[float, float], seed: int = 0,
            tolerance: float | None = None, progress: Any = None) -> Comparison:
    """Score alternatives on held-out records.

    Parameters
    ----------
    alternatives : sequence of Alternative
    train, heldout : sequence of (Recording, NoiseFloor)
        On those fitted, each alternative's own discrepancy is learnt; on the others it is scored.
    band : tuple of float
        Hz.
    seed : int
    tolerance : float or None
        Of the integrator, as in ``heldout``.
    progress : callable or None

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError
        If there is no alternative or no held-out record, or one is too short for three blocks.
    """
    if not alternatives or not heldout:
        raise ValueError("a comparison needs at least one alternative and one record that was not fitted")
    linear = alternatives[0].model.linear
    # the same records again and again: together they are long enough for the compiled loop, even if each is not
    work = sum(r.n for r, _ in (*train, *heldout)) * sum(1 + len(a.theta) / EVEN_BATCH for a in alternatives)
    compiled = True if SUBSTEPS * work > LONG_RUN else None
    cuts = [_cut(recording, linear.frequency, linear.zeta, band) for recording, _ in heldout]
    labels = tuple(f"{r.name}, {a * r.dt:.3g}-{b * r.dt:.3g} s" for (r, _), cut in zip(heldout, cuts, strict=True) for a, b in cut)
    densities, shares, errors = [], [], []
    for i, one in enumerate(alternatives):
        if progress is not None:
            progress(i / len(alternatives), f"predicting with {one.name}")
        share = _learnt(one, train, band, tolerance, seed, compiled)
        parts, wrong, total = [], 0.0, 0.0
        for (recording, floor), cut in zip(heldout, cuts, strict=True):
            found = replayed(one.model, one.theta, recording, band=band, noise=floor, tolerance=tolerance, seed=seed,
                             compiled=compiled)
            parts.append(_density(found, recording, floor, band, cut, share))
            ok = found.values[found.ok]
            middle = np.median(ok, axis=0) if len(ok) else np.full(recording.response.shape, np.nan)
            for a, b in cut:
                wrong += float(np.sum((recording.response[a:b] - middle[a:b]) ** 2))
                total += float(np.sum(recording.response[a:b] ** 2))
        densities.append(np.concatenate(parts, axis=1))
        shares.append(float(np.sqrt(np.mean(share))))
        errors.append(np.sqrt(wrong / max(total, 1e-300)))
    with np.errstate(divide="ignore"):
        by_block = np.array([_log_mean(x) for x in densities])
    return Comparison(tuple(a.name for a in alternatives), labels, tuple(densities), by_block, np.array(shares), np.array(errors),
                      tuple(a.k_hat for a in alternatives))


def _log_mean(log: Array) -> Array:
    """Logarithm of the mean over draws (S, B) -> (B,)."""
    top = np.where(np.isfinite(log.max(axis=0)), log.max(axis=0), 0.0)
    return np.asarray(np.log(np.mean(np.exp(log - top), axis=0)) + top)


def _cut(recording: Recording, frequency: Array, zeta: Array, band: tuple[float, float]) -> list[tuple[int, int]]:
    """First and last sample of every block; the start, from which an unknown state is estimated, is left out."""
    inside = np.flatnonzero((frequency >= band[0]) & (frequency <= band[1]))
    k = int(inside[0]) if inside.size else 0
    f, z = float(frequency[k]), float(np.broadcast_to(zeta, frequency.shape)[k])
    decay = 1 / (max(z, 1e-6) * 2 * np.pi * f * recording.dt)
    first = min(recording.n // 4, round(CYCLES / (f * recording.dt)))
    left = recording.n - first
    length = int(np.ceil(max(CYCLES / (f * recording.dt), min(DECAYS * decay, left / WANTED))))
    gap = int(min(decay, length / 4))
    count = (left + gap) // (length + gap)
    if count < FEWEST:
        raise ValueError(f"record {recording.name!r} is too short: {FEWEST} blocks of {CYCLES} cycles at {f:.4g} Hz are needed")
    return [(first + i * (length + gap), first + i * (length + gap) + length) for i in range(count)]


def _lines(values: Array, dt: float, band: tuple[float, float]) -> tuple[Array, NDArray[np.complex128]]:
    """Frequencies (F,) and Hann-windowed lines (..., F, s) of blocks (..., n, s), every second line, of unit variance for unit density."""
    n = values.shape[-2]
    window = np.hanning(n + 2)[1:-1]
    f = np.fft.rfftfreq(n, dt)
    picked = np.flatnonzero((f >= band[0]) & (f <= band[1]))[::2]
    lines = np.fft.rfft(values * window[:, None], axis=-2) * np.sqrt(2 * dt / np.sum(window**2))
    return np.asarray(f[picked], dtype=float), np.asarray(lines[..., picked, :])


def _power(lines: NDArray[np.complex128]) -> Array:
    """Power (F, s) averaged over neighbours, with a thousandth of its mean everywhere."""
    raw = np.abs(lines) ** 2
    padded = np.pad(raw, ((SMOOTH, SMOOTH), (0, 0)), mode="edge")
    smooth = np.mean([padded[i:i + len(raw)] for i in range(2 * SMOOTH + 1)], axis=0)
    return np.asarray(smooth + 1e-3 * raw.mean(axis=0))


def _pieces(found: Replayed, recording: Recording, floor: NoiseFloor, band: tuple[float, float], cut: Sequence[tuple[int, int]]) -> Any:
    """Measured lines (F, s), simulated ones (S, F, s), density of noise (F, s) and predicted power (F, s), block by block."""
    ok = found.values[found.ok]
    for a, b in cut:
        f, measured = _lines(recording.response[a:b], recording.dt, band)
        simulated = _lines(ok[:, a:b], recording.dt, band)[1]
        yield measured, simulated, np.maximum(floor.at(f), 1e-300), _power(np.median(simulated.real, axis=0)
                                                                          + 1j * np.median(simulated.imag, axis=0))


def _density(found: Replayed, recording: Recording, floor: NoiseFloor, band: tuple[float, float], cut: Sequence[tuple[int, int]],
             share: Array) -> Array:
    """Log density (S, B) of every block for every draw; −inf for draws that could not be simulated."""
    out = np.full((len(found.ok), len(cut)), -np.inf)
    if not found.ok.any():
        return out
    for i, (measured, simulated, noise, power) in enumerate(_pieces(found, recording, floor, band, cut)):
        variance = noise + share * power
        out[found.ok, i] = np.sum(-np.log(np.pi * variance) - np.abs(measured - simulated) ** 2 / variance, axis=(1, 2))
    return out


def _learnt(one: Alternative, train: Sequence[tuple[Recording, NoiseFloor]], band: tuple[float, float], tolerance: float | None,
            seed: int, compiled: bool | None) -> Array:
    """Discrepancy variance (s,) relative to the predicted power, the most likely one on the records that were fitted; one for all."""
    from scipy.optimize import minimize_scalar

    middle = np.median(one.theta, axis=0)[None]
    parts = []
    for recording, floor in train:
        found = replayed(one.model, middle, recording, band=band, noise=floor, tolerance=tolerance, seed=seed, compiled=compiled)
        if found.ok.any():
            cut = _cut(recording, one.model.linear.frequency, one.model.linear.zeta, band)
            parts += [(np.abs(m - s[0]) ** 2, n, p) for m, s, n, p in _pieces(found, recording, floor, band, cut)]
    if not parts:
        return np.ones(1)

    def cost(log: float) -> float:
        return float(sum(np.sum(np.log(n + np.exp(log) * p) + e / (n + np.exp(log) * p)) for e, n, p in parts))

    return np.array([np.exp(minimize_scalar(cost, bounds=(np.log(1e-10), np.log(10.0)), method="bounded").x)])
