"""What is wrong with a recording, before anybody fits a model to it.

Every check compares a channel with itself: its extremes, its steps, its spectrum. Thresholds are set so that clean signals (multisines,
decays, noise, quantised or not) almost never raise a finding; `tests/recordings/test_checks.py` measures that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.recording import Channel, Recording

Floats = NDArray[np.float64]
Severity = Literal["note", "warning", "error"]

SHORT = 256           # samples below which a recording is too short for anything
FLAT = 3              # equal samples in a row at the extreme that make a flat top
FLAT_TOPS = 3         # flat tops that make clipping
PILE_UP = 2           # samples at the extreme, relative to those in the next 10 quantisation steps (a sine has 0.4)
NEARLY = 0.005        # distance from the extreme, relative to the range, within which turning points come close to it
HELD = 5              # equal samples in a row, far from the extremes, that are a hold
AROUND = 25           # samples before and after a hold that must move
SPIKE = 12.0          # robust standard deviations of the local prediction error
COARSE = 0.05         # quantisation step relative to the rms
DRIFT = 0.3           # change of the local mean relative to the rms
OFFSET = 1.0          # mean relative to the rms about it
ALIASING = 0.05       # part of the power in the last tenth below the Nyquist frequency
LASTING = 0.9         # rms of the last quarter over that of the first, in every channel, that no free decay has
DEAD = 1e-6           # rms relative to the median rms of channels of the same quantity


@final
@dataclass(frozen=True)
class Finding:
    """Something about one channel that a person should know.

    Parameters
    ----------
    severity : {"note", "warning", "error"}
        ``error``: the channel should not be used as it is.
    channel : str
        Its name; empty for the recording as a whole.
    sentence : str
        What was found.
    mend : str
        What to do about it.
    kind : str
        Key of the check, e.g. ``"clipping"``.
    """

    severity: Severity
    channel: str
    sentence: str
    mend: str
    kind: str = ""

    def __str__(self) -> str:
        return f"{self.severity}: {self.channel + ': ' if self.channel else ''}{self.sentence}; {self.mend}."


def check(recording: Recording) -> tuple[Finding, ...]:
    """Everything found in a recording, errors first.

    Parameters
    ----------
    recording : Recording

    Returns
    -------
    tuple of Finding
    """
    signals = [*zip(recording.channels, recording.response.T, strict=True), *zip(recording.inputs, recording.force.T, strict=True)]
    found: list[Finding] = []
    if recording.n < SHORT:
        found.append(Finding("error", "", f"holds only {recording.n} samples", f"record at least {SHORT}", "short"))
        return tuple(found)
    found += _alike(signals)
    found += _driven(recording)
    for channel, x in signals:
        found += _channel(recording, channel, np.asarray(x, dtype=float), signals)
    rank = {"error": 0, "warning": 1, "note": 2}
    return tuple(sorted(found, key=lambda f: rank[f.severity]))


def _channel(recording: Recording, channel: Channel, x: Floats, signals: list[tuple[Channel, Floats]]) -> Iterator[Finding]:
    """Checks of one channel; a dead one is not looked at further."""
    dead = _dead(recording, channel, x, signals)
    if dead is not None:
        yield dead
        return
    step = resolution(x)
    for finding in (_clipping(channel, x, step), _holds(recording, channel, x, step), _spikes(recording, channel, x, step),
                    _offset(channel, x), _drift(recording, channel, x), _aliasing(recording, channel, x),
                    _coarse(recording, channel, x, step)):
        if finding is not None:
            yield finding


def _dead(recording: Recording, channel: Channel, x: Floats, signals: list[tuple[Channel, Floats]]) -> Finding | None:
    """Constant, or silent beside its sisters."""
    spread = float(x.std())
    if np.ptp(x) <= 1e-12 * np.abs(x).max():
        severity: Severity = "note" if recording.role == "noise" else "error"
        return Finding(severity, channel.name, f"is constant at {x[0]:.4g}", "check the cable, or drop the channel", "dead")
    sisters = [float(y.std()) for c, y in signals if c.quantity == channel.quantity and c is not channel]
    if sisters and spread < DEAD * float(np.median(sisters)):
        return Finding("error", channel.name, f"is silent: rms {spread:.3g}, the others {np.median(sisters):.3g}",
                       "check the cable, or drop the channel", "dead")
    return None


def resolution(x: Floats) -> float:
    """The step in which a signal is quantised; 0 if none can be seen.

    Three quarters of all differences between neighbouring distinct values must be whole multiples of the smallest (its first percentile).
    """
    values = np.unique(x)
    if len(values) < 3:
        return float(np.ptp(values))
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-9 * np.ptp(values)]
    if not gaps.size:
        return 0.0
    step = float(np.percentile(gaps, 1))
    multiples = gaps / step
    return step if float(np.mean(np.abs(multiples - np.rint(multiples)) < 0.05)) > 0.75 else 0.0


def _runs(x: Floats) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """First samples and lengths of the stretches of equal samples."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1])
    return starts, np.diff(np.concatenate([starts, [len(x)]]))


def _expected_flat(x: Floats, step: float) -> float:
    """Samples that a smooth extreme of the largest curvature stays within one quantisation step."""
    if step == 0:
        return 1.0
    curvature = float(np.percentile(np.abs(np.diff(x, 2)), 90))
    return 1 + 2 * np.sqrt(2 * step / curvature) if curvature > 0 else np.inf


def _clipping(channel: Channel, x: Floats, step: float) -> Finding | None:
    """The same extreme again and again, entered steeply and left flat.

    Rounding makes flat tops too, but not wide ones, and no more of them than in the steps below; a plateau that is held (a rest, an end
    stop) is entered slowly, or once.
    """
    starts, lengths = _runs(x)
    moves = np.abs(np.diff(x))
    usual = float(np.median(moves[moves > 0]))
    expected = _expected_flat(x, step)
    least = max(FLAT, int(np.ceil(1.5 * expected))) if np.isfinite(expected) else len(x)
    usual_count = len(x) / len(np.unique(x))
    sides = []
    for sign in (1, -1):
        extreme = float((sign * x).max())
        depth = extreme - sign * x[starts]  # of each stretch below the extreme
        at = (depth <= 1e-9 * np.ptp(x) + 0.25 * step) & (starts > 0) & (starts + lengths < len(x)) & (lengths < len(x) // 10)
        at &= np.abs(x[np.maximum(starts - 1, 0)] - x[starts]) > max(0.02 * usual, 1.5 * step)
        flat = at & (lengths >= least)
        near = max(3.5 * step, min(10 * step, 0.01 * np.ptp(x)))
        below = int(lengths[(depth > 0.25 * step) & (depth <= near)].sum()) if step else 0
        again = int(lengths[at].sum())
        # Without rounding, equality to the last bit is no accident, unless all samples repeat, as those of a steady signal do. With
        # rounding, the extreme must outweigh the steps next to it.
        piled = at.sum() >= FLAT_TOPS and again >= 6 + PILE_UP * max(usual_count, below) and (step == 0 or again >= 20 + PILE_UP * below)
        piled = piled and at.sum() >= 0.5 * _tops_just_below(depth, float(np.ptp(x)))
        if piled or (flat.sum() >= FLAT_TOPS and flat.sum() >= 0.2 * at.sum()):
            sides.append(f"{again} samples in {int(at.sum())} flat tops at {sign * extreme:.4g}")
    if not sides:
        return None
    return Finding("error", channel.name, f"is clipped: {' and '.join(sides)}",
                   "lower the gain and measure again, or choose a window without them", "clipping")


def _tops_just_below(depth: Floats, span: float) -> int:
    """Turning points that come close to the extreme and do not reach it: a sine of steady amplitude has many for each that reaches it by
    accident, a clipped signal few."""
    inner = depth[1:-1]
    turning = (inner < depth[:-2]) & (inner < depth[2:])
    return int((turning & (inner > 1e-9 * span) & (inner <= NEARLY * span)).sum())


def _holds(recording: Recording, channel: Channel, x: Floats, step: float) -> Finding | None:
    """Samples repeated although the signal was moving: a dropout of the recorder."""
    starts, lengths = _runs(x)
    move = float(np.median(np.abs(np.diff(x))))
    inside = (starts > 0) & (starts + lengths < len(x))
    extreme = (x[starts] == x.max()) | (x[starts] == x.min())
    motion = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(x)))])
    before = (motion[starts] - motion[np.maximum(starts - AROUND, 0)]) / AROUND
    ends = starts + lengths - 1
    after = (motion[np.minimum(ends + AROUND, len(x) - 1)] - motion[ends]) / AROUND
    moving = np.minimum(before, after) > max(0.1 * move, 3 * step)  # rounding repeats samples of slow signals
    jump = np.maximum(np.abs(x[starts] - x[np.maximum(starts - 1, 0)]), np.abs(x[np.minimum(ends + 1, len(x) - 1)] - x[ends]))
    moving &= jump > 6 * step  # nor is a rounded turning point a hold
    held = inside & ~extreme & moving & (lengths >= HELD)
    if not held.any():
        return None
    first = int(starts[held][0])
    zero = bool((x[starts[held]] == 0).all())
    return Finding("error", channel.name, f"{'drops to zero' if zero else 'is held'} for {int(lengths[held].max())} samples or fewer, "
                   f"{int(held.sum())} times, first at {first * recording.dt:.4g} s", "choose a window without it, or drop the channel",
                   "held")


def _spikes(recording: Recording, channel: Channel, x: Floats, step: float) -> Finding | None:
    """Single samples that neither neighbour announces, measured against the prediction error around them."""
    from scipy.ndimage import median_filter

    kernel = np.array([-1.0, 4.0, -6.0, 4.0, -1.0]) / 6  # fourth difference: what a cubic through the neighbours misses
    error = np.abs(np.convolve(x, kernel, mode="same"))
    error[:3] = error[-3:] = 0
    floor = float(np.median(error))
    local = median_filter(error, 31, mode="nearest")
    around = np.maximum(np.maximum(local, floor), step)
    spike = error > SPIKE * 1.4826 * np.maximum(around, 1e-12 * np.ptp(x))
    peak = np.flatnonzero(spike & (error >= np.roll(error, 1)) & (error >= np.roll(error, -1)) & (error > 0.05 * x.std()))
    # a wild sample leaves the whole kernel behind; the kink at an impact leaves (1, −2, 1), whose cosine with it is 0.976
    signed = np.convolve(x, kernel, mode="same")
    around_peak = signed[peak[:, None] + np.arange(-2, 3)]
    cosine = np.abs(around_peak @ kernel) / (np.linalg.norm(kernel) * np.linalg.norm(around_peak, axis=1))
    peak = peak[cosine > 0.988]
    count = len(peak)
    if count == 0 or count > len(x) // 200:
        return None
    first = int(peak[0])
    return Finding("warning" if count < 3 else "error", channel.name,
                   f"has {count} single-sample spike{'s' if count > 1 else ''}, the first at {first * recording.dt:.4g} s",
                   "check the cable, and choose a window without them", "spikes")


def _offset(channel: Channel, x: Floats) -> Finding | None:
    if channel.quantity in ("acceleration", "velocity") and abs(float(x.mean())) > OFFSET * float(x.std()):
        return Finding("note", channel.name, f"has an offset of {x.mean():.3g}, rms about it {x.std():.3g}",
                       "nothing: it lies below every band, but a sensor near its limit shows one", "offset")
    return None


def _drift(recording: Recording, channel: Channel, x: Floats) -> Finding | None:
    """The mean wanders: means of sixteenths of the record differ by more than their scatter allows."""
    if channel.quantity not in ("acceleration", "velocity") or recording.n < 16 * 32:
        return None
    size = recording.n // 16
    blocks = x[:16 * size].reshape(16, size)
    means = blocks.mean(axis=1)
    smooth = np.convolve(means, np.ones(4) / 4, mode="valid")
    change = float(np.ptp(smooth))
    quiet = float(np.median(blocks.std(axis=1)))
    t = np.arange(16) - 7.5
    rest = means - means.mean() - t * (t @ means) / (t @ t)
    trend = abs(float(t @ means) / float(t @ t)) * 15
    if change > DRIFT * quiet and trend > 3 * float(np.ptp(rest)) * 0.5:
        return Finding("warning", channel.name, f"drifts by {trend:.3g}, rms {quiet:.3g}",
                       "let the sensor warm up; the band-pass removes it, integration without one does not", "drift")
    return None


def _aliasing(recording: Recording, channel: Channel, x: Floats) -> Finding | None:
    """Power just below the Nyquist frequency that stands above a flat floor: there is more above it, folded down."""
    window = np.hanning(len(x) + 2)[1:-1]
    power = np.abs(np.fft.rfft((x - x.mean()) * window)) ** 2
    tenth = len(power) // 10
    last, before = float(power[-tenth:].sum()), float(np.median(power[len(power) // 2:-tenth])) * tenth / np.log(2)
    if last > ALIASING * float(power.sum()) and last > 5 * before:
        return Finding("warning", channel.name,
                       f"has {100 * last / power.sum():.0f} % of its power in the last tenth below the Nyquist frequency "
                       f"{recording.fs / 2:.4g} Hz", "check the anti-aliasing filter, or sample faster", "aliasing")
    return None


def _coarse(recording: Recording, channel: Channel, x: Floats, step: float) -> Finding | None:
    if step > COARSE * float(x.std()):
        return Finding("note" if recording.role == "noise" else "warning", channel.name,
                       f"is resolved in steps of {step:.3g}, its rms is {x.std():.3g}", "raise the gain", "coarse")
    return None


def _driven(recording: Recording) -> Iterator[Finding]:
    """Motion without a recorded force that goes on as it began."""
    if not recording.free or recording.role not in ("train", "linear") or recording.n < 4 * SHORT:
        return
    quarter = recording.n // 4
    first, last = (x.std(axis=0) for x in (recording.response[:quarter], recording.response[-quarter:]))
    if (last > LASTING * first).all() and first.any():
        yield Finding("warning", "", "no force is recorded, and yet the motion does not decay",
                      "name the channel of the force: without one the recording is taken for a free decay", "driven")


def _alike(signals: list[tuple[Channel, Floats]]) -> Iterator[Finding]:
    """Columns that are the same, or the negative of each other, sample by sample; each pair once."""
    for i, (one, x) in enumerate(signals):
        for other, y in signals[i + 1:]:
            if one.quantity != other.quantity or np.ptp(x) == 0 or np.ptp(y) == 0:
                continue
            sign = 1.0 if float(np.dot(x - x.mean(), y - y.mean())) >= 0 else -1.0
            if np.array_equal(x, sign * y):
                word = "the same as" if sign > 0 else "the negative of"
                yield Finding("error", one.name, f"is {word} {other.name!r}, sample by sample", "check the columns named in the study",
                              "alike")
