"""Linear modes from low-level data: the quiet end of a free decay, or a forced response with its measured force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.polefit import Complex, Lines, PoleFit, criterion, fit_poles, least_distance, with_another

ORDER = {"displacement": 0, "velocity": 1, "acceleration": 2}
HALF_BAND = 10.0  # half-width of a band: so many lines of a decay's window, or so many half-power widths of a forced response
CLOSE = 12.0  # modes nearer than so many lines share one band
LEAST_SIGNAL = 5.0  # residue over its standard deviation, in the best channel, below which a mode counts as not found
APART = 2.0  # lines between an uninvited resonance and any other
UNINVITED = 2  # further resonances that a band may hold beside the modes looked for
SURE = 0.05  # relative standard deviation of damping that a decay's window is lengthened for
REAL = 0.2  # rad of phase scatter beyond which a shape is not called real


def identify_modes(recording: Recording, nominal: ModalModel, modes: Sequence[int] | None = None, *, search: float = 0.1,
                   span: float = 10.0, floor: float = 10.0, window: tuple[float, float] | None = None) -> IdentifiedModes:
    """Frequencies, damping ratios and shapes near the modes of a nominal model.

    Free decay: each mode, or group of close modes, is fitted over the last stretch in which its amplitude stays above the noise, since
    there a nonlinear structure is nearest to its linear self. Forced response: the whole recording, whole periods averaged; the force is taken
    as free of noise.

    Parameters
    ----------
    recording : Recording
    nominal : ModalModel
        Where to look, and what shapes to expect.
    modes : sequence of int, optional
        0-based modes of the nominal model; all below 80 % of the Nyquist frequency if omitted.
    search : float
        Relative frequency range about each nominal frequency.
    span : float
        Free decay: ratio of largest to smallest amplitude within the window; up to ten times more where damping would else stay vague.
    floor : float
        Free decay: smallest amplitude in the window over the rms noise in the mode's own band.
    window : tuple of float, optional
        Free decay: fixed stretch in s instead of the choice above.

    Returns
    -------
    IdentifiedModes
        Modes that were not found are left out and named in the notes.

    Raises
    ------
    ValueError
        If a mode does not exist, or a setting is out of range.
    """
    chosen = [k for k in range(nominal.modes) if nominal.frequency[k] < 0.4 * recording.fs] if modes is None else [int(k) for k in modes]
    if not chosen or any(not 0 <= k < nominal.modes for k in chosen) or len(set(chosen)) != len(chosen):
        raise ValueError(f"modes {chosen} must be distinct indices below {nominal.modes}, some below 80 % of the Nyquist frequency")
    if not 0 < search < 1 or span <= 1 or floor <= 0:
        raise ValueError(f"search {search} must lie in (0, 1), span {span} be above 1 and floor {floor} positive")
    chosen = sorted(chosen)
    peaks = _peaks(recording, nominal, chosen, search)
    found, notes = [], [f"mode {k + 1} ({nominal.frequency[k]:.4g} Hz): no resonance within {100 * search:g} %" for k in chosen
                        if k not in peaks]
    if recording.free:
        for group in _decay_groups(recording, peaks, span, floor, window, notes):
            found += _widening(recording, nominal, group, peaks, (span, floor, window), notes)
    else:
        for group in _forced_groups(recording, nominal, peaks):
            found += _fit_forced(recording, nominal, group, peaks, notes)
    return _collect(recording, found, notes)


@final
@dataclass(frozen=True)
class _Peak:
    """A resonance in the rough spectrum: frequency (Hz) and how large each channel is there, as displacement (s,)."""

    frequency: float
    size: NDArray[np.float64]


@final
@dataclass(frozen=True)
class _Found:
    """One mode as fitted: everything of `IdentifiedModes` but for one mode."""

    nominal: int
    frequency: tuple[float, float]
    zeta: tuple[float, float]
    shape: NDArray[np.float64]
    shape_sd: NDArray[np.float64]
    scatter: float
    amplitude: float
    window: tuple[float, float]
    status: str


def _collect(recording: Recording, found: list[_Found], notes: list[str]) -> IdentifiedModes:
    found = sorted(found, key=lambda f: f.frequency[0])
    s = len(recording.channels)
    def column(values: list[float]) -> NDArray[np.float64]:
        return np.array(values, dtype=float)
    return IdentifiedModes(
        column([f.frequency[0] for f in found]), column([f.zeta[0] for f in found]),
        np.array([f.shape for f in found]).reshape(-1, s).T, tuple(c.name for c in recording.channels),
        tuple(c.location for c in recording.channels), tuple(f.nominal for f in found), column([f.frequency[1] for f in found]),
        column([f.zeta[1] for f in found]), np.array([f.shape_sd for f in found]).reshape(-1, s).T, column([f.scatter for f in found]),
        column([f.amplitude for f in found]), tuple(f.window for f in found), tuple(f.status for f in found), not recording.free,
        tuple(notes))


def _peaks(recording: Recording, nominal: ModalModel, chosen: list[int], search: float) -> dict[int, _Peak]:
    """The resonance that belongs to each mode, by nearness, likeness of shape and height together."""
    from scipy.optimize import linear_sum_assignment

    f, spectra = _rough_spectra(recording)
    total = np.sum(np.abs(spectra) ** 2, axis=1)
    shapes = np.abs(nominal.rows([c.location for c in recording.channels]))
    order = np.array([ORDER[c.quantity] for c in recording.channels])
    places = np.concatenate([_maxima(f, total, nominal.frequency[k], search) for k in chosen] or [np.zeros(0, dtype=int)])
    places = np.unique(places).astype(int)
    if places.size == 0:
        return {}
    cost = np.full((len(chosen), places.size), 1e6)
    seen = np.abs(spectra[places]) * (2 * np.pi * f[places, None]) ** (order.max() - order)
    for i, k in enumerate(chosen):
        near = np.abs(f[places] / nominal.frequency[k] - 1)
        likeness = (seen @ shapes[:, k]) ** 2 / (np.sum(seen**2, axis=1) * np.sum(shapes[:, k] ** 2))
        local = np.log10(total[places] / max(total[places][near <= search], default=1.0))
        cost[i] = np.where(near <= search, (near / search) ** 2 + 1 - likeness - 0.5 * np.maximum(local, -4), 1e6)
    rows, columns = linear_sum_assignment(cost)
    return {chosen[i]: _Peak(float(f[places[j]]), seen[j]) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 1e5}


def _rough_spectra(recording: Recording) -> tuple[NDArray[np.float64], Complex]:
    """Frequencies and spectra (f, s) in which resonances stand out: of the decay itself, or response over force."""
    n = recording.period or recording.n
    response = recording.response[:n * (recording.n // n)].reshape(-1, n, recording.response.shape[1]).mean(axis=0)
    f = np.fft.rfftfreq(n, recording.dt)
    spectra = np.fft.rfft(response - response.mean(axis=0), axis=0)
    if recording.free:
        return f, spectra
    force = recording.force[:n * (recording.n // n)].reshape(-1, n, recording.force.shape[1]).mean(axis=0)
    drive = np.fft.rfft(force, axis=0)
    main = drive[:, [int(np.argmax(np.sum(np.abs(drive) ** 2, axis=0)))]]
    if recording.period is None:  # smooth over neighbouring lines: H1 of a burst
        kernel = np.hanning(9)[1:-1]
        over = lambda x: np.stack([np.convolve(c, kernel, "same") for c in x.T], axis=1)  # noqa: E731
        power = over(np.abs(main) ** 2)
        return f, over(spectra * main.conj()) / (power + 1e-6 * power.max())
    lit = np.abs(main[:, 0]) > 1e-3 * np.abs(main).max()
    return f[lit], spectra[lit] / main[lit]


def _maxima(f: NDArray[np.float64], power: NDArray[np.float64], nominal: float, search: float) -> NDArray[np.int_]:
    """Indices of lines within the search range that stand highest among their neighbours and well above the median there."""
    inside = np.flatnonzero((f >= nominal * (1 - search)) & (f <= nominal * (1 + search)))
    if inside.size < 5:
        return np.zeros(0, dtype=int)
    reach = max(2, round(0.003 * nominal / (f[1] - f[0])))
    peak = [i for i in inside if power[i] == power[max(0, i - reach):i + reach + 1].max() and power[i] > 10 * np.median(power[inside])]
    return np.array(sorted(peak, key=lambda i: -power[i])[:8], dtype=int)


def _stretch(recording: Recording, peaks: dict[int, _Peak], k: int, span: float, floor: float,
             window: tuple[float, float] | None) -> tuple[int, int] | None:
    """Samples (first, last) of a mode's quiet end, or of the fixed window."""
    if window is None:
        return _quiet_end(recording, peaks[k].frequency, [p.frequency for key, p in peaks.items() if key != k], span, floor)
    i, j = round(window[0] / recording.dt), round(window[1] / recording.dt)
    if not 0 <= i < j - 20 or j > recording.n:
        raise ValueError(f"window {window} s must lie within the recording of {recording.n * recording.dt:g} s")
    return i, j


def _decay_groups(recording: Recording, peaks: dict[int, _Peak], span: float, floor: float, window: tuple[float, float] | None,
                  notes: list[str]) -> list[list[int]]:
    """Modes that share a band; those that never stand out of the noise are noted and left out."""
    length: dict[int, int] = {}
    for k in sorted(peaks, key=lambda key: peaks[key].frequency):
        stretch = _stretch(recording, peaks, k, span, floor, window)
        if stretch is None:
            notes.append(f"mode {k + 1} at {peaks[k].frequency:.4g} Hz: never {floor:g} times above its noise for long enough")
        else:
            length[k] = stretch[1] - stretch[0]
    groups: list[list[int]] = []
    for k, samples in length.items():
        last = groups[-1][-1] if groups else None
        if last is not None and peaks[k].frequency - peaks[last].frequency < CLOSE / (min(samples, length[last]) * recording.dt):
            groups[-1].append(k)
        else:
            groups.append([k])
    return groups


def _widening(recording: Recording, nominal: ModalModel, group: list[int], peaks: dict[int, _Peak],
              choice: tuple[float, float, tuple[float, float] | None], notes: list[str]) -> list[_Found]:
    """Fit the quietest stretch, or a longer one reaching up to larger amplitudes where it does not tell the damping to `SURE`."""
    span, floor, window = choice
    found: list[_Found] = []
    remarks: list[str] = []
    for factor in (1.0, 3.0, 10.0) if window is None else (1.0,):
        stretches = [_stretch(recording, peaks, k, span * factor, floor, window) for k in group]
        remarks = []
        found = _fit_decay(recording, nominal, group, peaks, _common([s for s in stretches if s is not None]), remarks)
        if len(found) == len(group) and all(f.zeta[1] <= SURE * f.zeta[0] for f in found):
            break
    notes += remarks
    return found


def _common(stretches: list[tuple[int, int]]) -> tuple[int, int]:
    """The stretch in which all modes of a group live: the overlap, or the earliest if there is none."""
    first, last = max(i for i, _ in stretches), min(j for _, j in stretches)
    return (first, last) if last - first > 0.5 * min(j - i for i, j in stretches) else min(stretches, key=lambda s: s[1])


def _quiet_end(recording: Recording, f: float, others: list[float], span: float, floor: float) -> tuple[int, int] | None:
    """Samples (first, last) of the last stretch in which a resonance stays above its noise, from ``span`` times its last amplitude on."""
    duration = recording.n * recording.dt
    gap = min((abs(f - other) for other in others), default=f)
    width = max(min(0.012 * f, gap / 4), 4 / duration)
    analytic, gain_power, low = _around(recording, f, width)
    n, dt = len(analytic), duration / len(analytic)
    envelope = np.abs(analytic)
    # One-sided density D gives a complex envelope of mean square 2 D ∫gain².
    noise = np.sqrt(2 * _noise_density(recording, f, [f, *others]) * gain_power)
    level = np.sqrt(np.mean((envelope / np.maximum(noise, 1e-12 * envelope.max())) ** 2, axis=1))
    reach = max(1, round(0.5 / width / dt))
    edge = min(2 * reach, n // 10)  # the filter rings at both ends of the recording
    turning = np.sum(analytic[1:] * analytic[:-1].conj(), axis=1)
    smooth = np.cumsum(np.concatenate([np.zeros(1), turning]))
    at = np.clip(np.arange(n), reach, n - 1 - reach)
    running = low + np.angle(smooth[at + reach] - smooth[at - reach]) / (2 * np.pi * dt) % (1 / dt)
    # What still rings where the frequency has wandered off is another resonance that leaks into the filter.
    alive = (level >= floor) & (np.abs(running - f) < max(width, 3 / duration))
    loudest = edge + int(np.argmax(level[edge:n - edge]))
    gone = np.flatnonzero(~alive[loudest:n - edge])
    last = loudest + int(gone[0]) - 1 if gone.size else n - edge - 1
    before = np.flatnonzero(level[loudest:max(last, loudest)] >= span * level[last])
    first = loudest + (int(before[-1]) if before.size else 0)
    stretch = round(first * dt / recording.dt), round((last + 1) * dt / recording.dt)
    return stretch if (last - first) * dt * f >= 8 and stretch[1] - stretch[0] >= 40 else None


def _around(recording: Recording, f: float, width: float) -> tuple[Complex, float, float]:
    """Complex envelopes (n', s) of the channels through a Gaussian filter, at a low rate; ∫gain² (Hz); the frequency they are shifted by."""
    n = recording.n
    spectrum = np.fft.rfft(recording.response - recording.response.mean(axis=0), axis=0)
    lines = np.fft.rfftfreq(n, recording.dt)
    inside = np.flatnonzero(np.abs(lines - f) <= 5 * width)
    gain = np.exp(-0.5 * ((lines[inside] - f) / width) ** 2)
    analytic = 2 * np.fft.ifft(spectrum[inside] * gain[:, None], axis=0) * inside.size / n
    return analytic, float(np.sum(gain**2) * lines[1]), float(lines[inside[0]])


def _noise_density(recording: Recording, f: float, resonances: list[float]) -> NDArray[np.float64]:
    """One-sided power density (s,) of the noise about a frequency, from the last half and the lines away from resonances."""
    tail = recording.response[recording.n // 2:]
    n = len(tail)
    t = 2 * np.pi * np.arange(n) / n
    taper = 0.35875 - 0.48829 * np.cos(t) + 0.14128 * np.cos(2 * t) - 0.01168 * np.cos(3 * t)  # Blackman-Harris: no leakage above -92 dB
    lines = np.fft.rfftfreq(n, recording.dt)
    psd = 2 * recording.dt * np.abs(np.fft.rfft((tail - tail.mean(axis=0)) * taper[:, None], axis=0)) ** 2 / np.sum(taper**2)
    for reach in (1.3, 1.6, 2.5):
        away = (lines > f / reach) & (lines < f * reach)
        for resonance in resonances:
            away &= np.abs(lines - resonance) > max(0.05 * resonance, 5 * (lines[1] - lines[0]))
        if away.sum() >= 8:
            return np.asarray(np.median(psd[away], axis=0) / np.log(2), dtype=float)
    return np.asarray(psd[(lines > f / 2) & (lines < 2 * f)].min(axis=0), dtype=float)


def _fit_decay(recording: Recording, nominal: ModalModel, group: list[int], peaks: dict[int, _Peak], stretch: tuple[int, int],
               notes: list[str]) -> list[_Found]:
    i, j = stretch
    piece = recording.response[i:j]
    n, dt = len(piece), recording.dt
    spacing = 1 / (n * dt)
    low, high = _limits(peaks, group, max(HALF_BAND, 2.0 * len(group) + 8) * spacing, recording.fs)
    f = np.fft.rfftfreq(n, dt)
    inside = (f >= low) & (f <= high)
    lines = Lines(2 * np.pi * f[inside], np.fft.rfft(piece, axis=0)[inside], np.zeros((int(inside.sum()), 0), complex), dt, True)
    at = np.array([peaks[k].frequency for k in group])
    fade = 1.0 / (np.pi * n * dt * at)  # damping that fades by e² over the window
    starts = [(at, np.full(len(group), 1.0) * z) for z in (fade, 3 * fade, nominal.zeta[group])]
    spread = 0.5 * spacing * (np.arange(len(group)) - (len(group) - 1) / 2)
    starts += [(at + spread, fade), (at - 0.5 * spacing, fade), (at + 0.5 * spacing, fade)]
    return _found(recording, group, peaks, lines, starts, (i * dt, j * dt), notes)


def _forced_groups(recording: Recording, nominal: ModalModel, peaks: dict[int, _Peak]) -> list[list[int]]:
    """Modes nearer than a few of their own widths share a band."""
    groups: list[list[int]] = []
    spacing = 1 / ((recording.period or recording.n) * recording.dt)
    for k in sorted(peaks, key=lambda key: peaks[key].frequency):
        if groups:
            last = groups[-1][-1]
            width = 2 * max(nominal.zeta[k], nominal.zeta[last]) * peaks[k].frequency
            if peaks[k].frequency - peaks[last].frequency < max(5 * width, CLOSE * spacing):
                groups[-1].append(k)
                continue
        groups.append([k])
    return groups


def _fit_forced(recording: Recording, nominal: ModalModel, group: list[int], peaks: dict[int, _Peak], notes: list[str]) -> list[_Found]:
    n = recording.period or recording.n
    averaged = [x[:n * (recording.n // n)].reshape(-1, n, x.shape[1]).mean(axis=0) for x in (recording.response, recording.force)]
    spectra, force = (np.fft.rfft(x, axis=0) for x in averaged)
    f = np.fft.rfftfreq(n, recording.dt)
    lit = np.sum(np.abs(force) ** 2, axis=1)
    spacing = f[1]
    at = np.array([peaks[k].frequency for k in group])
    width = float(np.max(2 * nominal.zeta[group] * at))
    for lines_wanted in (20, 40, 80, 160):  # sparse multisines need a wider band for as many lines
        low, high = _limits(peaks, group, max(HALF_BAND * width, lines_wanted * spacing), recording.fs)
        inside = (f >= low) & (f <= high)
        if recording.period is not None:
            inside &= lit > 1e-6 * lit.max()
        lines = Lines(2 * np.pi * f[inside], spectra[inside], force[inside], recording.dt, recording.period is None)
        if inside.sum() >= 2 * (lines.columns + len(group) * (lines.per_mode() + 1)) + 4:
            break
    starts = [(at, nominal.zeta[group] * factor) for factor in (0.3, 1.0, 3.0)]
    return _found(recording, group, peaks, lines, starts, (0.0, recording.n * recording.dt), notes)


def _limits(peaks: dict[int, _Peak], group: list[int], half: float, fs: float) -> tuple[float, float]:
    """Band (Hz) about a group, no farther than half-way to resonances outside it."""
    low, high = min(peaks[k].frequency for k in group), max(peaks[k].frequency for k in group)
    below = [peak.frequency for k, peak in peaks.items() if k not in group and peak.frequency < low]
    above = [peak.frequency for k, peak in peaks.items() if k not in group and peak.frequency > high]
    return (max(low - half, (low + max(below)) / 2 if below else 0.1 * low, 0.1 * low),
            min(high + half, (high + min(above)) / 2 if above else np.inf, 0.49 * fs))


def _found(recording: Recording, group: list[int], peaks: dict[int, _Peak], lines: Lines,
           starts: list[tuple[NDArray[np.float64], NDArray[np.float64]]], window: tuple[float, float], notes: list[str]) -> list[_Found]:
    """Fit one band, with poles for uninvited resonances where the data ask for them, and keep the modes that stand out of the noise."""
    need = lines.columns + len(group) * (lines.per_mode() + 1) + 2
    if len(lines.omega) < need:
        notes.append(f"modes {', '.join(str(k + 1) for k in group)}: only {len(lines.omega)} lines in their band, {need} needed; "
                     "record longer")
        return []
    fit = fit_poles(lines, starts)
    for _ in range(UNINVITED):
        if len(lines.omega) < need + lines.per_mode() + 1:
            break
        more = fit_poles(lines, with_another(lines, fit))
        # A pole on top of another only mimics a frequency that drifts with amplitude.
        if criterion(lines, more) >= criterion(lines, fit) or least_distance(lines, more) < APART:
            break
        fit, need = more, need + lines.per_mode() + 1
    found = []
    for k, i in _whose(recording, fit, [peaks[k] for k in group], group).items():
        signal = float(np.max(np.abs(fit.residues[i]) / np.maximum(fit.residues_sd[i], np.finfo(float).tiny)))
        if signal < LEAST_SIGNAL or not np.isfinite(fit.frequency_sd[i]):
            notes.append(f"mode {k + 1} near {fit.frequency[i]:.4g} Hz: lost in noise ({fit.status})")
            continue
        found.append(_one(recording, fit, i, k, window))
    return found


def _whose(recording: Recording, fit: PoleFit, peaks: list[_Peak], group: list[int]) -> dict[int, int]:
    """Which pole of a fit belongs to which mode: likeness to the size of its peak in each channel, nearness, strength."""
    from scipy.optimize import linear_sum_assignment

    order = np.array([ORDER[c.quantity] for c in recording.channels])
    size = np.abs(fit.residues) * (2 * np.pi * fit.frequency[:, None]) ** (order.max() - order)
    strength = np.log10(np.maximum(np.linalg.norm(size, axis=1), np.finfo(float).tiny))
    cost = np.empty((len(peaks), len(fit.frequency)))
    for i, peak in enumerate(peaks):
        likeness = (size @ peak.size) ** 2 / np.maximum(np.sum(size**2, axis=1) * np.sum(peak.size**2), np.finfo(float).tiny)
        cost[i] = np.abs(fit.frequency / peak.frequency - 1) / 0.02 + 1 - likeness - 0.5 * (strength - strength.max())
    rows, columns = linear_sum_assignment(cost)
    return {group[i]: int(j) for i, j in zip(rows, columns, strict=True)}


def _one(recording: Recording, fit: PoleFit, i: int, k: int, window: tuple[float, float]) -> _Found:
    """Displacement shape, turned to be as real as it can, with its uncertainty."""
    pole = 2 * np.pi * fit.frequency[i] * (-fit.zeta[i] + 1j * np.sqrt(1 - fit.zeta[i] ** 2))
    to_displacement = pole ** -np.array([float(ORDER[c.quantity]) for c in recording.channels])
    shape = fit.residues[i] * to_displacement
    sd = fit.residues_sd[i] * np.abs(to_displacement)
    weight = 1 / np.maximum(sd, np.finfo(float).tiny) ** 2
    turn = np.exp(-0.5j * np.angle(np.sum(weight * shape**2)))
    if not recording.free and (turn * -1j).real < 0:  # residue of φ_c φ_f / (2 i ω): the force fixes the sign
        turn = -turn
    real, imaginary = (shape * turn).real, (shape * turn).imag
    largest = float(np.abs(real).max())
    sign = 1.0 if not recording.free else float(np.sign(real[np.argmax(np.abs(real))]))
    scatter = float(np.arctan2(np.sqrt(np.sum(imaginary**2)), np.sqrt(np.sum(real**2))))
    amplitude = 2 * float(np.abs(shape).max()) if recording.free else _forced_amplitude(recording, fit.frequency[i], fit.zeta[i])
    remarks = [fit.status] if fit.status != "ok" else []
    if scatter > REAL:
        remarks.append(f"phases scatter by {np.degrees(scatter):.0f} degrees: not one real mode, or channels out of step")
    if fit.zeta_sd[i] > 0.3 * fit.zeta[i]:
        remarks.append("damping is hardly determined")
    return _Found(k, (float(fit.frequency[i]), float(fit.frequency_sd[i])), (float(fit.zeta[i]), float(fit.zeta_sd[i])),
                  sign * real / largest, sd / np.sqrt(2) / largest, scatter, amplitude, window, "; ".join(remarks) or "ok")


def _forced_amplitude(recording: Recording, frequency: float, zeta: float) -> float:
    """Largest displacement (m) of any channel within ± 5 half-power widths of the mode."""
    f = np.fft.rfftfreq(recording.n, recording.dt)
    inside = np.abs(f - frequency) <= max(10 * zeta * frequency, 3 / (recording.n * recording.dt))
    order = np.array([ORDER[c.quantity] for c in recording.channels])
    spectrum = np.fft.rfft(recording.response, axis=0)
    scaled = np.zeros_like(spectrum)
    scaled[inside] = spectrum[inside] * (2j * np.pi * f[inside, None]) ** (-order.astype(float))
    return float(np.abs(np.fft.irfft(scaled, n=recording.n, axis=0)).max())
