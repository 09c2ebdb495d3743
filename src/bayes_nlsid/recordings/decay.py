"""Frequency and damping against amplitude, from one decaying signal: the backbone.

Zero crossings give the phase (π apart), the values midway between crossings give the amplitude; a local cubic in time through
each gives frequency and damping. Midway in phase a linear decay x = A e^(−σt) cos(ω_d t) has exactly the value ±A e^(−σt), so nothing
is lost by not looking for the maximum. The amplitude of a nonlinear oscillation is its peak, not its fundamental.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.recordings.filtering import band_pass, continuations, reach, skirts, without_line

Floats = NDArray[np.float64]
WINDOW_DECAY = 0.3    # each local cubic reaches this far to both sides in log-amplitude
WINDOW_LEAST = 10     # and at least this many half-cycles
PER_CYCLE = 20        # samples per cycle below which the signal is interpolated first
AGREEMENT = 2e-3      # relative difference that the continuation beyond the ends may make to an amplitude
RISE = 0.02           # relative rise of the smoothed amplitude that is called a rise
GRID = 40             # amplitudes, if none are given
_NODES = np.arange(-3.0, 4.0)
_TO_POWERS = np.linalg.inv(np.vander(_NODES, increasing=True))


@final
@dataclass(frozen=True)
class Backbone:
    """Frequency and damping against amplitude.

    Parameters
    ----------
    amplitude : ndarray (K,)
        m, ascending.
    frequency : ndarray (..., K)
        Hz, of the zero crossings; NaN where the decay never passed that amplitude.
    damping : ndarray (..., K)
        Ratio.
    location : str
    status : str
        ``"ok"``, or what was found wrong.
    frequency_sd, damping_sd : ndarray (..., K)
        Standard errors of the local fits, Hz and ratio; NaN where not known.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    amplitude: Floats
    frequency: Floats
    damping: Floats
    location: str = ""
    status: str = "ok"
    frequency_sd: Floats = field(default_factory=lambda: np.zeros(0))
    damping_sd: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        count = len(self.amplitude)
        for name in ("frequency", "damping"):
            if getattr(self, name).shape[-1:] != (count,):
                raise ValueError(f"backbone: {name} has shape {getattr(self, name).shape}, its last axis must be {count}")
            if getattr(self, name + "_sd").size == 0:
                object.__setattr__(self, name + "_sd", np.full(getattr(self, name).shape, np.nan))
            if getattr(self, name + "_sd").shape != getattr(self, name).shape:
                raise ValueError(f"backbone: {name}_sd has shape {getattr(self, name + '_sd').shape}, not that of {name}")


def measured_backbone(time: ArrayLike, displacement: ArrayLike, band: tuple[float, float] | None = None,
                      amplitudes: ArrayLike | None = None, location: str = "") -> Backbone:
    """Backbone of decaying signals.

    Parameters
    ----------
    time : array_like (n,)
        s, constant step.
    displacement : array_like (..., n)
        m. The decay is followed from its largest half-cycle.
    band : tuple of float, optional
        (low, high) Hz around one mode: a zero-phase band-pass first, whose ends are discarded. Needed when there are other modes, an
        offset, or noise that is large between zero crossings.
    amplitudes : array_like (K,), optional
        m, ascending; by default 40, spaced logarithmically over what was passed.
    location : str

    Returns
    -------
    Backbone
        ``status`` names what was found wrong: no oscillation, too few cycles, an amplitude that rises (beating or forcing). In a batch
        it says for how many.

    Raises
    ------
    ValueError
        If shapes disagree, time does not step evenly, amplitudes do not ascend, or the band cannot be had.
    """
    t, x = np.asarray(time, dtype=float), np.asarray(displacement, dtype=float)
    dt, grid = _checked(t, x, band, amplitudes)
    rows = x.reshape(-1, len(t))
    decays = [_follow(row, dt, band) for row in rows]
    if grid is None:
        grid = _grid(decays)
    out = np.full((4, len(rows), len(grid)), np.nan)
    for i, decay in enumerate(decays):
        if decay.amplitude.size:
            out[:, i] = _local(decay, grid, band)
    shape = (*x.shape[:-1], len(grid))
    return Backbone(grid, out[0].reshape(shape), out[1].reshape(shape), location, _summary([d.status for d in decays]),
                    out[2].reshape(shape), out[3].reshape(shape))


@final
@dataclass(frozen=True)
class _Decay:
    """One decay as it was followed: crossings (c + 1,) s, and time (c,) s and amplitude (c,) m midway between them."""

    crossing: Floats
    time: Floats
    amplitude: Floats
    status: str


_EMPTY = np.zeros(0)


def _checked(t: Floats, x: Floats, band: tuple[float, float] | None, amplitudes: ArrayLike | None) -> tuple[float, Floats | None]:
    """Time step and grid, after the arguments were checked."""
    if t.ndim != 1 or len(t) < 8 or x.shape[-1:] != t.shape:
        raise ValueError(f"displacement has shape {x.shape}, its last axis must be that of time {t.shape}, at least 8 samples")
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    if not (np.isfinite(t).all() and dt > 0 and np.abs(np.diff(t) - dt).max() < 1e-2 * dt):
        raise ValueError("time must ascend by a constant step")
    if band is not None and not 0 < band[0] < band[1] <= 0.5 / dt * (1 + 1e-9):
        raise ValueError(f"band {band} Hz must ascend and lie between 0 and the Nyquist frequency {0.5 / dt:g} Hz")
    if amplitudes is None:
        return dt, None
    grid = np.asarray(amplitudes, dtype=float)
    if grid.ndim != 1 or grid.size == 0 or not (np.isfinite(grid).all() and (grid > 0).all() and (np.diff(grid) > 0).all()):
        raise ValueError(f"amplitudes of shape {grid.shape} must be positive, finite and ascending")
    return dt, grid


def _grid(decays: list[_Decay]) -> Floats:
    passed = [(d.amplitude.min(), d.amplitude.max()) for d in decays if d.amplitude.size]
    if not passed:
        return np.ones(1)
    low, high = min(p[0] for p in passed), max(p[1] for p in passed)
    return np.geomspace(low, high, GRID) if high > low else np.array([low])


def _summary(states: list[str]) -> str:
    wrong = [s for s in states if s != "ok"]
    if not wrong:
        return "ok"
    counts = {s: wrong.count(s) for s in dict.fromkeys(wrong)}
    return "; ".join(s if len(states) == 1 else f"{k} of {len(states)}: {s}" for s, k in counts.items())


def _follow(x: Floats, dt: float, band: tuple[float, float] | None) -> _Decay:
    """Crossings and amplitudes of one row, from its largest half-cycle to where it stops being a decaying oscillation."""
    if not np.isfinite(x).all():
        return _Decay(_EMPTY, _EMPTY, _EMPTY, "not finite")
    x, other, step = _prepared(x, dt, band)
    half = _half_cycle(x)
    if half == 0:
        return _Decay(_EMPTY, _EMPTY, _EMPTY, "no oscillation")
    stride = max(1, int(half // 12))
    crossing = _crossings(x, half, stride)
    crossing = crossing[(crossing > 4 * stride) & (crossing < len(x) - 4 * stride - 1)]
    if len(crossing) < 4:
        return _Decay(_EMPTY, _EMPTY, _EMPTY, "too few cycles")
    middle = (crossing[1:] + crossing[:-1]) / 2
    amplitude = np.abs(_value(x, middle, stride))
    sure = np.abs(np.abs(_value(other, middle, stride)) - amplitude) <= AGREEMENT * amplitude
    first, last, status = _run(np.diff(crossing), amplitude, sure)
    if last - first < WINDOW_LEAST:
        return _Decay(_EMPTY, _EMPTY, _EMPTY, "too few cycles" if status == "ok" else status)
    return _Decay(step * crossing[first:last + 1], step * middle[first:last], amplitude[first:last], status)


def _prepared(x: Floats, dt: float, band: tuple[float, float] | None) -> tuple[Floats, Floats, float]:
    """Filtered if there is a band, interpolated if samples are few, for two continuations beyond the ends; and the new step."""
    if band is None:
        half = _half_cycle(x)
        if half == 0 or 2 * half >= PER_CYCLE:
            return x, x, dt
        finer = int(np.ceil(PER_CYCLE / (2 * half)))
        one, other = _interpolated(x, dt, (0.0, 0.4 / dt), (0.0, 0.5 / dt), 80, finer)
    else:
        finer = int(np.ceil(PER_CYCLE * band[1] * dt))
        line = without_line(x[:, None])[:, 0]
        one, other = _interpolated(line, dt, band, skirts(band, 1 / dt), reach(band, dt), finer)
    return one, other, dt / finer


def _interpolated(x: Floats, dt: float, band: tuple[float, float], stop: tuple[float, float], far: int, finer: int,
                  ) -> tuple[Floats, Floats]:
    """Band-passed, ``finer`` times as many samples, once for each of two continuations beyond the ends."""
    from scipy.fft import next_fast_len

    n = len(x)
    total = next_fast_len(n + 2 * far, real=True)
    gain = band_pass(np.fft.rfftfreq(total, dt), band, stop)
    both = []
    for longer in continuations(x[:, None], far, total - n - far, (band[0], band[1]), dt):
        spectrum = np.fft.rfft(longer[:, 0]) * gain
        both.append(finer * np.fft.irfft(spectrum, n=finer * total)[finer * far:finer * (far + n - 1) + 1])
    return both[0], both[1]


def _half_cycle(x: Floats) -> float:
    """Samples in half a cycle of the strongest line; 0 if there is none."""
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
    power[:2] = 0
    return len(x) / (2.0 * int(np.argmax(power))) if power.max() > 0 else 0.0


def _powers(x: Floats, centre: NDArray[np.int_], stride: int) -> Floats:
    """Coefficients (c, 7) of the polynomial through seven samples ``stride`` apart, in units of the stride."""
    return np.asarray(x[centre[:, None] + stride * _NODES.astype(int)] @ _TO_POWERS.T, dtype=float)


def _value(x: Floats, at: Floats, stride: int) -> Floats:
    """x at fractional samples."""
    centre = np.rint(at).astype(int)
    return np.asarray(np.einsum("ij,ij->i", _powers(x, centre, stride), ((at - centre) / stride)[:, None] ** np.arange(7.0)))


def _crossings(x: Floats, half: float, stride: int) -> Floats:
    """Fractional samples of the zero crossings; a change of sign counts only once the signal has clearly left zero."""
    from scipy.ndimage import maximum_filter1d

    level = 0.2 * maximum_filter1d(np.abs(x), 2 * max(1, round(half)) + 1, mode="nearest")
    clear = np.flatnonzero(np.abs(x) > level)
    change = np.flatnonzero(np.diff(np.signbit(x[clear]).astype(int)))
    left, right = clear[change], clear[change + 1]
    guess = left + (right - left) * np.abs(x[left]) / (np.abs(x[left]) + np.abs(x[right]))
    inside = (guess > 4 * stride) & (guess < len(x) - 4 * stride - 1)
    guess = guess[inside]
    centre = np.rint(guess).astype(int)
    powers, u = _powers(x, centre, stride), (guess - centre) / stride
    for _ in range(5):
        value = np.einsum("ij,ij->i", powers, u[:, None] ** np.arange(7.0))
        slope = np.einsum("ij,ij->i", powers[:, 1:] * np.arange(1.0, 7.0), u[:, None] ** np.arange(6.0))
        u = np.clip(u - np.divide(value, slope, out=np.zeros_like(value), where=slope != 0), -3, 3)
    return np.asarray(centre + stride * u, dtype=float)


def _run(half: Floats, amplitude: Floats, sure: NDArray[np.bool_]) -> tuple[int, int, str]:
    """(first, last + 1, status) of the half-cycles that belong to the decay: the longest regular stretch from its largest on."""
    if not sure.any():
        return 0, 0, "too few cycles"
    usual = float(np.median(half[sure & (amplitude > 0.1 * amplitude[sure].max())]))
    breaks = np.concatenate([[-1], np.flatnonzero(~sure | (half < 0.6 * usual) | (half > 1.6 * usual)), [len(half)]])
    longest = int(np.argmax(np.diff(breaks)))
    first, last = int(breaks[longest]) + 1, int(breaks[longest + 1])
    if last <= first:
        return 0, 0, "too few cycles"
    first += int(np.argmax(amplitude[first:last]))
    smooth = _smoothed(np.log(np.maximum(amplitude[first:last], np.finfo(float).tiny)))
    rising = smooth - np.minimum.accumulate(smooth) > RISE if len(smooth) else np.zeros(0, dtype=bool)
    if not rising.any():
        return first, last, "ok"
    stop = int(np.argmin(smooth[:int(np.argmax(rising)) + 1]))
    floor = np.exp(smooth[stop] - smooth[0]) < 0.05
    return first, first + stop, "ok" if floor else "amplitude rises (beating or forcing)"


def _smoothed(y: Floats) -> Floats:
    """Moving average over nine half-cycles, shorter at the ends."""
    sums = np.concatenate([[0.0], np.cumsum(y)])
    i = np.arange(len(y))
    reach_ = np.minimum(np.minimum(i, len(y) - 1 - i), 4)
    return np.asarray((sums[i + reach_ + 1] - sums[i - reach_]) / (2 * reach_ + 1), dtype=float)


def _local(decay: _Decay, grid: Floats, band: tuple[float, float] | None) -> Floats:
    """(4, K): frequency, damping and their standard errors on the grid, NaN outside what the decay passed."""
    log = np.log(decay.amplitude)
    falling = np.minimum.accumulate(_smoothed(log))
    inside = (np.log(grid) <= falling[0] + 1e-9) & (np.log(grid) >= falling[-1] - 1e-9)
    out = np.full((4, len(grid)), np.nan)
    if not inside.any():
        return out
    order = np.arange(len(log)) * 1e-12  # keeps flat stretches apart for the interpolation
    at = np.interp(-np.log(grid[inside]), -falling + order, decay.time)
    position = np.interp(at, decay.time, np.arange(len(log)))
    rate = np.abs(falling[-1] - falling[0]) / max(1, len(log) - 1)
    near = np.gradient(falling)[np.clip(np.rint(position).astype(int), 0, len(log) - 1)]
    width = np.clip(WINDOW_DECAY / np.maximum(np.abs(near), 0.1 * rate + 1e-12), WINDOW_LEAST, max(WINDOW_LEAST, len(log) / 4))
    usual = float(np.median(np.diff(decay.crossing)))
    half_width = usual * width
    sigma, sigma_sd = _slope(decay.time, -log, at, half_width)
    turns, turns_sd = _slope(decay.crossing, np.arange(float(len(decay.crossing))), at, half_width)
    frequency, frequency_sd = turns / 2, turns_sd / 2
    omega = 2 * np.pi * frequency
    correlated = 1.0 if band is None else np.sqrt(max(1.0, 1 / (usual * (band[1] - band[0]))))  # filtered noise is not white
    out[:, inside] = frequency, sigma / np.hypot(omega, sigma), frequency_sd * correlated, sigma_sd / omega * correlated
    return out


def _slope(t: Floats, y: Floats, at: Floats, half_width: Floats) -> tuple[Floats, Floats]:
    """Slope (K,) of a local cubic with tricube weights, and its standard error from the residuals."""
    lo, hi = np.searchsorted(t, at - half_width), np.searchsorted(t, at + half_width, side="right")
    # at an end the window keeps its length and becomes one-sided
    count = np.minimum(np.maximum(hi - lo, WINDOW_LEAST), len(t))
    lo = np.clip(np.minimum(lo, len(t) - count), 0, None)
    index = lo[:, None] + np.arange(int(count.max()))
    used = np.arange(int(count.max())) < count[:, None]
    index = np.minimum(index, len(t) - 1)
    span = np.max(np.abs(t[index] - at[:, None]) * used, axis=1, keepdims=True) * 1.05
    u = (t[index] - at[:, None]) / span
    weight = np.where(used, (1 - np.minimum(np.abs(u), 1.0) ** 3) ** 3, 0.0)
    basis = np.stack([np.ones_like(u), u, u**2, u**3], axis=-1)
    origin = y[index[:, :1]]
    gram = np.einsum("kw,kwi,kwj->kij", weight, basis, basis)
    inverse = np.linalg.inv(gram)
    hat = np.einsum("kij,kwj,kw->kiw", inverse, basis, weight)
    value = np.einsum("kiw,kw->ki", hat, y[index] - origin)
    residual = np.where(used, y[index] - origin - np.einsum("kwi,ki->kw", basis, value), 0.0)
    variance = np.sum(weight * residual**2, axis=1) / np.maximum(np.sum(weight, axis=1) * (1 - 4 / count), 1e-300)
    sd = np.sqrt(variance * np.sum(hat[:, 1] ** 2, axis=1))
    return value[:, 1] / span[:, 0], sd / span[:, 0]
