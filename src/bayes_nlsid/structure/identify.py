"""Linear modes from low-level data: the quiet end of a free decay, or a forced response with its measured force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.recordings.kinematics import ORDER
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.polefit import Lines, PoleFit, criterion, fit_poles, least_distance, with_another
from bayes_nlsid.structure.resonances import Peak, find_peaks, quiet_end

Floats = NDArray[np.float64]
HALF_BAND = 10.0  # half-width of a band: so many lines of a decay's window, or so many half-power widths of a forced response
CLOSE = 12.0  # modes nearer than so many lines share one band
LEAST_SIGNAL = 5.0  # residue over its standard deviation, in the best channel, below which a mode counts as not found
APART = 2.0  # lines between an uninvited resonance and any other
UNINVITED = 2  # further resonances that a band may hold beside the modes looked for
SURE = 0.05  # relative standard deviation of damping that a decay's window is lengthened for
MOVED = 3.0  # combined standard deviations of two halves of a window beyond which a mode counts as depending on amplitude
REAL = 0.2  # rad of phase scatter beyond which a shape is not called real


def identify_modes(recording: Recording, nominal: ModalModel, modes: Sequence[int] | None = None, *, search: float = 0.1,
                   span: float = 10.0, floor: float = 10.0, window: tuple[float, float] | None = None) -> IdentifiedModes:
    """Frequencies, damping ratios and shapes near the modes of a nominal model.

    Free decay: each mode, or group of close modes, is fitted over the last stretch in which its amplitude stays above the noise, since
    there a nonlinear structure is nearest to its linear self. Forced response: the whole recording, whole periods averaged; the force
    is taken as free of noise.

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
    peaks = find_peaks(recording, nominal, chosen, search)
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


def _stretch(recording: Recording, peaks: dict[int, Peak], k: int, span: float, floor: float,
             window: tuple[float, float] | None) -> tuple[int, int] | None:
    """Samples (first, last) of a mode's quiet end, or of the fixed window."""
    if window is None:
        return quiet_end(recording, peaks[k].frequency, [p.frequency for key, p in peaks.items() if key != k], span, floor)
    i, j = round(window[0] / recording.dt), round(window[1] / recording.dt)
    if not 0 <= i < j - 20 or j > recording.n:
        raise ValueError(f"window {window} s must lie within the recording of {recording.n * recording.dt:g} s")
    return i, j


def _decay_groups(recording: Recording, peaks: dict[int, Peak], span: float, floor: float, window: tuple[float, float] | None,
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


def _widening(recording: Recording, nominal: ModalModel, group: list[int], peaks: dict[int, Peak],
              choice: tuple[float, float, tuple[float, float] | None], notes: list[str]) -> list[_Found]:
    """Fit the quietest stretch, or a longer one reaching up to larger amplitudes where it does not tell the damping to `SURE`."""
    span, floor, window = choice
    found: list[_Found] = []
    remarks: list[str] = []
    stretch, poles = (0, recording.n), None
    for factor in (1.0, 3.0, 10.0) if window is None else (1.0,):
        stretches = [_stretch(recording, peaks, k, span * factor, floor, window) for k in group]
        remarks = []
        stretch = _common([s for s in stretches if s is not None])
        found, poles = _fit_decay(recording, nominal, group, peaks, stretch, remarks)
        if len(found) == len(group) and all(f.zeta[1] <= SURE * f.zeta[0] for f in found):
            break
    notes += remarks
    return found if poles is None else _drifting(recording, group, peaks, stretch, found, poles, notes)


def _drifting(recording: Recording, group: list[int], peaks: dict[int, Peak], stretch: tuple[int, int], found: list[_Found],
              poles: PoleFit, notes: list[str]) -> list[_Found]:
    """Standard deviations that admit how far frequency and damping moved between the louder and the quieter half of the window.

    A nonlinear structure is not linear there either: what the noise alone leaves open would be far too little to allow for it.
    """
    if len(found) != 1 or len(poles.frequency) != 1:  # beating between neighbours would pass for a dependence on amplitude
        return found
    middle = sum(stretch) // 2
    halves = []
    for part in ((stretch[0], middle), (middle, stretch[1])):
        lines = _decay_lines(recording, group, peaks, part)
        if len(lines.omega) < lines.columns + lines.per_mode() + 3:
            return found
        halves.append(fit_poles(lines, [(poles.frequency, poles.zeta)]))
    (mode,), (loud, quiet) = found, halves
    frequency = _admitting(mode.frequency, *((float(h.frequency[0]), float(h.frequency_sd[0])) for h in halves))
    damping = _admitting(mode.zeta, *((float(h.zeta[0]), float(h.zeta_sd[0])) for h in halves))
    if (frequency, damping) != (mode.frequency, mode.zeta):
        notes.append(f"mode {mode.nominal + 1}: its frequency and damping depend on amplitude even in the quiet window, moving by "
                     f"{quiet.frequency[0] - loud.frequency[0]:+.2g} Hz and {100 * (quiet.zeta[0] - loud.zeta[0]):+.2g} % of critical")
    return [replace(mode, frequency=frequency, zeta=damping)]


def _admitting(whole: tuple[float, float], loud: tuple[float, float], quiet: tuple[float, float]) -> tuple[float, float]:
    """(value, sd) with the drift between the halves added to the sd, where it stands out of their noise and passes through the value of
    the whole window; elsewhere something other than amplitude moved it."""
    moved = quiet[0] - loud[0]
    share = (whole[0] - loud[0]) / moved if moved else 0.0
    drifts = MOVED * float(np.hypot(loud[1], quiet[1])) < abs(moved) < whole[0] and 0 < share < 1
    return (whole[0], float(np.hypot(whole[1], moved))) if drifts else whole


def _common(stretches: list[tuple[int, int]]) -> tuple[int, int]:
    """The stretch in which all modes of a group live: the overlap, or the earliest if there is none."""
    first, last = max(i for i, _ in stretches), min(j for _, j in stretches)
    return (first, last) if last - first > 0.5 * min(j - i for i, j in stretches) else min(stretches, key=lambda s: s[1])


def _fit_decay(recording: Recording, nominal: ModalModel, group: list[int], peaks: dict[int, Peak], stretch: tuple[int, int],
               notes: list[str]) -> tuple[list[_Found], PoleFit | None]:
    i, j = stretch
    n, dt = j - i, recording.dt
    spacing = 1 / (n * dt)
    lines = _decay_lines(recording, group, peaks, stretch)
    at = np.array([peaks[k].frequency for k in group])
    fade = 1.0 / (np.pi * n * dt * at)  # damping that fades by e² over the window
    starts = [(at, np.full(len(group), 1.0) * z) for z in (fade, 3 * fade, nominal.zeta[group])]
    spread = 0.5 * spacing * (np.arange(len(group)) - (len(group) - 1) / 2)
    starts += [(at + spread, fade), (at - 0.5 * spacing, fade), (at + 0.5 * spacing, fade)]
    return _found(recording, group, peaks, lines, starts, (i * dt, j * dt), notes)


def _decay_lines(recording: Recording, group: list[int], peaks: dict[int, Peak], stretch: tuple[int, int]) -> Lines:
    """Spectra of a stretch in the band of a group."""
    piece = recording.response[slice(*stretch)]
    n, dt = len(piece), recording.dt
    low, high = _limits(peaks, group, max(HALF_BAND, 2.0 * len(group) + 8) / (n * dt), recording.fs)
    f: Floats = np.asarray(np.fft.rfftfreq(n, dt), dtype=float)
    inside = (f >= low) & (f <= high)
    return Lines(2 * np.pi * f[inside], np.fft.rfft(piece, axis=0)[inside], np.zeros((int(inside.sum()), 0), complex), dt, True)


def _forced_groups(recording: Recording, nominal: ModalModel, peaks: dict[int, Peak]) -> list[list[int]]:
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


def _fit_forced(recording: Recording, nominal: ModalModel, group: list[int], peaks: dict[int, Peak], notes: list[str]) -> list[_Found]:
    n = recording.period or recording.n
    averaged = [x[:n * (recording.n // n)].reshape(-1, n, x.shape[1]).mean(axis=0) for x in (recording.response, recording.force)]
    spectra, force = (np.fft.rfft(x, axis=0) for x in averaged)
    f: Floats = np.asarray(np.fft.rfftfreq(n, recording.dt), dtype=float)
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
    return _found(recording, group, peaks, lines, starts, (0.0, recording.n * recording.dt), notes)[0]


def _limits(peaks: dict[int, Peak], group: list[int], half: float, fs: float) -> tuple[float, float]:
    """Band (Hz) about a group, no farther than half-way to resonances outside it."""
    low, high = min(peaks[k].frequency for k in group), max(peaks[k].frequency for k in group)
    below = [peak.frequency for k, peak in peaks.items() if k not in group and peak.frequency < low]
    above = [peak.frequency for k, peak in peaks.items() if k not in group and peak.frequency > high]
    return (max(low - half, (low + max(below)) / 2 if below else 0.1 * low, 0.1 * low),
            min(high + half, (high + min(above)) / 2 if above else np.inf, 0.49 * fs))


def _found(recording: Recording, group: list[int], peaks: dict[int, Peak], lines: Lines,
           starts: list[tuple[NDArray[np.float64], NDArray[np.float64]]], window: tuple[float, float],
           notes: list[str]) -> tuple[list[_Found], PoleFit | None]:
    """Fit one band, with poles for uninvited resonances where the data ask for them, and keep the modes that stand out of the noise."""
    need = lines.columns + len(group) * (lines.per_mode() + 1) + 2
    if len(lines.omega) < need:
        notes.append(f"modes {', '.join(str(k + 1) for k in group)}: only {len(lines.omega)} lines in their band, {need} needed; "
                     "record longer")
        return [], None
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
    return found, fit


def _whose(recording: Recording, fit: PoleFit, peaks: list[Peak], group: list[int]) -> dict[int, int]:
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
    weight = np.maximum(sd / np.abs(shape).max(), 1e-9) ** -2.0  # a dead channel has neither signal nor noise
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
